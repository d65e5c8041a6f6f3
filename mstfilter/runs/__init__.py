"""Runs: `filter_recording` filters a recording and stores the results in a run folder.

>>> from mstfilter.runs.presets import load_config
>>> from mstfilter.runs import filter_recording
>>> from mstfilter.scoring import read_truth, score_pauses
>>> recording = mstfilter.open_recording("recordings/mine")                        # any format
>>> run = filter_recording(recording, load_config("mst"), Path("runs/mine"), seed=0)
>>> run.n_pauses, run.hypotheses(0), run.info(0)["ess"]
>>> rows = score_pauses(run.estimates(), read_truth(recording))

A repeated call resumes an interrupted run from ``pauses/NNN/state.npz`` of the last complete pause. A resumed run and
an uninterrupted run have the same result. The module `run` filters, and `run_folder` reads and writes files.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

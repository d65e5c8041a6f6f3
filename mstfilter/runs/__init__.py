"""Filters at work: presets, one run in its folder, live streams, and studies of many runs.

`filter_recording` filters a recording and stores the results in a run folder:

>>> from mstfilter.runs.presets import load_config
>>> from mstfilter.runs import filter_recording
>>> from mstfilter.scoring import read_truth, score_pauses
>>> recording = mstfilter.open_recording("recordings/mine")                        # any format
>>> run = filter_recording(recording, load_config("mst"), Path("runs/mine"), seed=0)
>>> run.n_pauses, run.hypotheses(0), run.info(0)["ess"]
>>> rows = score_pauses(run.estimates(), read_truth(recording))

If the run is interrupted, the same call resumes it from ``pauses/NNN/state.npz`` of the last complete pause, with the
result that an uninterrupted run has.

============  =========================================================================================
`presets`     filters by name, from TOML files
`run`         `filter_recording`
`run_folder`  `RunFolder`: reads and writes the folder of a run
`run_tables`  the rows of its tables: metrics, objects
`live`        `Stream`: frames that arrive one by one
`study`       many runs, compared in pairs
============  =========================================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

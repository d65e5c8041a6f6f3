"""Oracles: components that use the truth of a recording, so as to measure how much each stage loses.

A simulated recording knows its true voxels, instance images and poses. If a stage is replaced by its oracle, named
``true_...``, the gain in quality is what the errors of this stage cost:

>>> filter = mstfilter.preset("mst", "update.completer=true_completion", "transition=true_motions")
>>> filter = bind_truth(filter, recording)                  # a clip holds no truth; the recording does
>>> state, infos = filter.run(recording.clips(), seed=0)

`STAGES` has the overrides that replace each stage of the preset ``mst``.
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__components__ = {
    "transition": {"true_motions": "TrueMotions"},
    "proposal": {"true_masks": "TrueMasks"},
    "pairs": {"true_pairs": "TruePairs"},
    "boundary": {"true_boundary": "TrueBoundary"},
    "completer": {"true_completion": "TrueCompletion"},
    "free_space": {"true_free_space": "TrueFreeSpace"},
    "evidence": {"true_quality": "TrueQuality"},
}

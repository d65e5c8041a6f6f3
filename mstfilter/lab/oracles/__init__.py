"""Oracles replace stages of a filter by the ground truth of a recording.

A simulated recording contains its true voxels, instance images and poses. Components named ``true_...`` use the
truth instead of an estimate. The gain in quality shows how much quality each stage loses:

>>> filter = mstfilter.preset("mst", "update.completer=true_completion", "transition=true_motions")
>>> filter = bind_truth(filter, recording)                  # a clip holds no truth; the recording does
>>> state, infos = filter.run(recording.clips(), seed=0)

`STAGES` lists, for each stage, the overrides that replace the stage of the preset ``mst`` by its oracle.
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

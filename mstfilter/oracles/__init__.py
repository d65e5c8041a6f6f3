"""What is known to be right: worlds with an exact answer, and stages replaced by the truth of a recording."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__components__ = {
    "transition": {"true_motions": "TrueMotions"},
    "proposal": {"true_masks": "TrueMasks"},
    "update": {"true_fusion": "TrueFusion"},
    "resampler": {"true_best": "TrueBest"},
    "boundary": {"true_boundary": "TrueBoundary"},
    "completer": {"true_completion": "TrueCompletion"},
    "free_space": {"true_free_space": "TrueFreeSpace"},
    "evidence": {"true_quality": "TrueQuality"},
}

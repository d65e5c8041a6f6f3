"""Segmentation: image -> boundaries -> tree -> cuts -> hypotheses (paper IV-B)."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {
    "boundary": "BoundaryModel",
    "tree": "TreeBuilder",
    "value": "CutValue",
    "sampler": "CutSampler",
}
__components__ = {
    "proposal": {"tree_cuts": "TreeCutProposal"},
    "boundary": {"colour_depth": "ColourDepthBoundary"},
    "tree": {"learned": "LearnedTree", "ucm": "UcmTree"},
    "value": {"scenecut": "SceneCutObjectness", "merge_log_odds": "MergeLogOdds"},
    "sampler": {"mh": "MetropolisHastingsCuts", "exact": "ExactCuts", "optimal": "OptimalCut"},
}

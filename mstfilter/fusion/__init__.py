"""Predicted x proposed -> fused hypotheses: the measurement update of MST (paper, section IV-D)."""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {
    "free_space": "Projection",
    "crossover": "Crossover",
    "structure": "Structure",
    "division": "Division",
    "evidence": "Evidence",
    "mode_filter": "ModeFilter",
}
__components__ = {
    "update": {"fusion": "FusionUpdate", "projection": "ProjectionUpdate"},
    "similarity": {"weighted_coverage": "WeightedCoverage"},
    "equivalence": {"same_segmentation": "SameSegmentation"},
    "free_space": {"projective": "FreeSpace", "none": "NoFreeSpace"},
    "crossover": {"conflict_graph": "Crossover"},
    "structure": {"one_side_last": "OneSideLast", "random_order": "RandomOrder", "spanning_tree": "SpanningTree"},
    "division": {"none": "NoDivision", "rigid_motions": "RigidMotions"},
    "evidence": {"agreement": "Agreement"},
    "mode_filter": {"majority": "ModeFilter"},
}

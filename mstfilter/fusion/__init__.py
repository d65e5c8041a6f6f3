"""Fusion: the measurement update of MST (paper, section IV-D), and queries of the fused population.

>>> update = PartitionUpdate(completer=NetworkCompleter())
>>> fused = update.update(rng, predicted, proposed, clip)     # candidates, with weights
>>> belief = Belief(resampler.resample(rng, fused, 5))
>>> belief.occupancy()                                        # (X, Y, Z) probability

===============  =======================================================================================
`update`         `FusionUpdate`: the published update, which crosses every sample with every prediction
`free_space`     clears predicted voxels that the depth image observes as free
`division`       splits objects whose parts move apart in a clip
`partition`      `PartitionUpdate`: partitions of the image are drawn, shapes completed from all views
`cells`          the common refinement of partitions, and draws of partitions by its pairs of cells
`conflicts`      the conflict graph of two hypotheses (networkx), painting orders, merge probabilities
`crossover`      makes one hypothesis of two, and smooths the result by a mode filter
`similarity`     similarity of hypotheses, for diverse resampling and for evidence
`belief`         probabilities and expected information, for planners; `information` has the formulas
`interfaces`     `PairOdds`, `Projection`, `Division`, `Structure`, `Evidence`: what a user can replace
===============  =======================================================================================
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {
    "pairs": "PairOdds",
    "free_space": "Projection",
    "crossover": "Crossover",
    "structure": "Structure",
    "division": "Division",
    "evidence": "Evidence",
    "mode_filter": "ModeFilter",
}
__components__ = {
    "update": {"fusion": "FusionUpdate", "projection": "ProjectionUpdate", "partition": "PartitionUpdate"},
    "pairs": {"shares": "PairEvidence"},
    "similarity": {"weighted_coverage": "WeightedCoverage"},
    "equivalence": {"same_segmentation": "SameSegmentation"},
    "free_space": {"projective": "FreeSpace", "none": "NoFreeSpace"},
    "crossover": {"conflict_graph": "Crossover"},
    "structure": {"one_side_last": "OneSideLast", "random_order": "RandomOrder", "spanning_tree": "SpanningTree"},
    "division": {"none": "NoDivision", "rigid_motions": "RigidMotions"},
    "evidence": {"agreement": "Agreement"},
    "mode_filter": {"majority": "ModeFilter"},
}

"""Queries of a weighted population of hypotheses, for planners, and similarities of hypotheses.

>>> belief = Belief(resampler.resample(rng, fused, 5))
>>> belief.occupancy()                                        # (X, Y, Z) probability

=============  =========================================================================================
`queries`      `Belief`: probabilities and expected information
`information`  entropies and mutual information of weighted outcomes
`similarity`   similarity and equality of hypotheses, for resamplers that compare particles
=============  =========================================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__components__ = {
    "similarity": {"weighted_coverage": "WeightedCoverage"},
    "equivalence": {"same_segmentation": "SameSegmentation"},
}

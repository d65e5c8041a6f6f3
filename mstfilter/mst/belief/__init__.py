"""Questions to a weighted set of hypotheses, as a planner asks them, and similarities of hypotheses.

>>> belief = Belief(state.population)
>>> belief.occupancy()                                        # (X, Y, Z) probability
>>> belief.estimate()                                         # the best single hypothesis

=============  =========================================================================================
`queries`      `Belief`: probabilities, expected information, the estimate
`objects`      `ObjectTable`: the objects, with existence, place, shape, hidden or not
`rows`         the table as plain types, in any frame, for JSON and CSV
`information`  entropies and mutual information of weighted outcomes
`pushes`       `push_candidates`: pushes that decide between one object and two
`similarity`   similarity and equality of hypotheses, for resamplers that compare particles
=============  =========================================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__components__ = {
    "similarity": {"weighted_coverage": "WeightedCoverage"},
    "equivalence": {"same_segmentation": "SameSegmentation"},
}

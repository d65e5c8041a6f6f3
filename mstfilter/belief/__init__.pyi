from mstfilter.belief.queries import Belief as Belief
from mstfilter.belief.similarity import (
    SameSegmentation as SameSegmentation,
    WeightedCoverage as WeightedCoverage,
)

from mstfilter.belief.queries import Belief as Belief, Border as Border
from mstfilter.belief.similarity import SameSegmentation as SameSegmentation, WeightedCoverage as WeightedCoverage

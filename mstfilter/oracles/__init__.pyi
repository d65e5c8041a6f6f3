from mstfilter.oracles.choice import (
    TrueBest as TrueBest,
    TrueFreeSpace as TrueFreeSpace,
    TrueFusion as TrueFusion,
    TrueQuality as TrueQuality,
)
from mstfilter.oracles.completion import TrueCompletion as TrueCompletion
from mstfilter.oracles.degradation import degrade as degrade
from mstfilter.oracles.masks import TrueBoundary as TrueBoundary, TrueMasks as TrueMasks
from mstfilter.oracles.miniature.calibration import (
    DRAWS as DRAWS,
    rank as rank,
    statistics as statistics,
    uniformity as uniformity,
)
from mstfilter.oracles.miniature.exact import exact_filter as exact_filter
from mstfilter.oracles.miniature.filters import bootstrap_filter as bootstrap_filter, guided_filter as guided_filter
from mstfilter.oracles.miniature.measures import (
    MEASURES as MEASURES,
    class_weights as class_weights,
    iid_population as iid_population,
    measure as measure,
    total_variation as total_variation,
)
from mstfilter.oracles.miniature.shrunk import shrink as shrink
from mstfilter.oracles.miniature.weighting import ScoredFusion as ScoredFusion, balanced_filter as balanced_filter
from mstfilter.oracles.miniature.world import Glance as Glance, Miniature as Miniature
from mstfilter.oracles.motion import TrueMotions as TrueMotions
from mstfilter.oracles.truth import UsesTruth as UsesTruth, bind_truth as bind_truth, uses_truth as uses_truth

from mstfilter.oracles.degradation import degrade as degrade
from mstfilter.oracles.front_end import (
    TrueBoundary as TrueBoundary,
    TrueCompletion as TrueCompletion,
    TrueMasks as TrueMasks,
)
from mstfilter.oracles.miniature import Miniature as Miniature, MiniatureObservation as MiniatureObservation
from mstfilter.oracles.miniature_filters import (
    N_RANK_DRAWS as N_RANK_DRAWS,
    POSTERIOR_ERRORS as POSTERIOR_ERRORS,
    bootstrap_filter as bootstrap_filter,
    exact_filter as exact_filter,
    guided_filter as guided_filter,
    iid_weights as iid_weights,
    posterior_errors as posterior_errors,
    rank_of_truth as rank_of_truth,
    rank_uniformity as rank_uniformity,
    state_statistics as state_statistics,
    state_weights as state_weights,
    total_variation as total_variation,
)
from mstfilter.oracles.miniature_mst import (
    ScoredFusion as ScoredFusion,
    adapt_to_miniature as adapt_to_miniature,
    balanced_filter as balanced_filter,
)
from mstfilter.oracles.stages import (
    STAGES as STAGES,
    TrueFreeSpace as TrueFreeSpace,
    TrueFusion as TrueFusion,
    TrueMotions as TrueMotions,
    TrueQuality as TrueQuality,
    budget_arms as budget_arms,
    overrides_of as overrides_of,
)
from mstfilter.oracles.truth import UsesTruth as UsesTruth, bind_truth as bind_truth, uses_truth as uses_truth

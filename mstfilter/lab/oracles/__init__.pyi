from mstfilter.lab.oracles.front_end import (
    TrueBoundary as TrueBoundary,
    TrueCompletion as TrueCompletion,
    TrueMasks as TrueMasks,
)
from mstfilter.lab.oracles.stages import (
    STAGES as STAGES,
    TrueFreeSpace as TrueFreeSpace,
    TrueMotions as TrueMotions,
    TruePairs as TruePairs,
    TrueQuality as TrueQuality,
)
from mstfilter.lab.oracles.truth import UsesTruth as UsesTruth, bind_truth as bind_truth, uses_truth as uses_truth

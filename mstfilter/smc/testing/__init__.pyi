from mstfilter.smc.testing.contract import (
    FALSE_ALARM as FALSE_ALARM,
    CheckResult as CheckResult,
    Contract as Contract,
    check_properties as check_properties,
)
from mstfilter.smc.testing.models import ModelContract as ModelContract
from mstfilter.smc.testing.resampling import (
    ResamplerContract as ResamplerContract,
    WeightResamplerContract as WeightResamplerContract,
)
from mstfilter.smc.testing.transitions import (
    DensityTransitionContract as DensityTransitionContract,
    RejuvenationContract as RejuvenationContract,
    TransitionContract as TransitionContract,
)
from mstfilter.smc.testing.updates import (
    ProposalContract as ProposalContract,
    UpdateContract as UpdateContract,
)
from mstfilter.smc.testing.values import (
    CodecContract as CodecContract,
    EquivalenceContract as EquivalenceContract,
    LookaheadContract as LookaheadContract,
    SimilarityContract as SimilarityContract,
    SizeContract as SizeContract,
    TriggerContract as TriggerContract,
)

from mstfilter.testing.check import (
    CheckResult as CheckResult,
    contract_of as contract_of,
    run_contract as run_contract,
)
from mstfilter.testing.contract import (
    FALSE_ALARM as FALSE_ALARM,
    Contract as Contract,
    RandomContract as RandomContract,
    number_example as number_example,
)
from mstfilter.testing.moves import (
    DensityTransitionContract as DensityTransitionContract,
    ProposalContract as ProposalContract,
    RejuvenationContract as RejuvenationContract,
    TransitionContract as TransitionContract,
    UpdateContract as UpdateContract,
)
from mstfilter.testing.resampling import (
    ResamplerContract as ResamplerContract,
    TransformResamplerContract as TransformResamplerContract,
    WeightResamplerContract as WeightResamplerContract,
)
from mstfilter.testing.scenes import scene_example as scene_example
from mstfilter.testing.stages import (
    STAGE_OWNERS as STAGE_OWNERS,
    CompleterContract as CompleterContract,
    MotionRuleContract as MotionRuleContract,
    StageContract as StageContract,
)
from mstfilter.testing.starters import (
    Starter as Starter,
    starter_kinds as starter_kinds,
    write_starter as write_starter,
)
from mstfilter.testing.values import (
    CodecContract as CodecContract,
    EquivalenceContract as EquivalenceContract,
    EvidenceContract as EvidenceContract,
    LookaheadContract as LookaheadContract,
    SimilarityContract as SimilarityContract,
    SizeContract as SizeContract,
    TriggerContract as TriggerContract,
)

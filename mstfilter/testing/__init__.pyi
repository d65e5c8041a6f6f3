from mstfilter.testing.contracts import (
    CodecContract as CodecContract,
    Contract as Contract,
    EquivalenceContract as EquivalenceContract,
    EvidenceContract as EvidenceContract,
    LookaheadContract as LookaheadContract,
    ProposalContract as ProposalContract,
    RejuvenationContract as RejuvenationContract,
    ResamplerContract as ResamplerContract,
    SimilarityContract as SimilarityContract,
    SizeContract as SizeContract,
    TransitionContract as TransitionContract,
    TriggerContract as TriggerContract,
    UpdateContract as UpdateContract,
    verify as verify,
)
from mstfilter.testing.properties import (
    FALSE_ALARM as FALSE_ALARM,
    Broken as Broken,
    Outcome as Outcome,
    Property as Property,
    Suite as Suite,
    example as example,
)
from mstfilter.testing.scenes import scene_example as scene_example
from mstfilter.testing.starters import example_of as example_of, write_starter as write_starter

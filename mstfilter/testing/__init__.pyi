from mstfilter.resources import starter_kinds as starter_kinds, write_starter as write_starter
from mstfilter.testing.scenes import scene_example as scene_example
from mstfilter.testing.stages import (
    STAGE_OWNERS as STAGE_OWNERS,
    CompleterContract as CompleterContract,
    EvidenceContract as EvidenceContract,
    MotionRuleContract as MotionRuleContract,
    StageContract as StageContract,
    contract_of as contract_of,
    run_contract as run_contract,
)

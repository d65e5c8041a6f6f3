from mstfilter.base.resources import starter_kinds as starter_kinds, write_starter as write_starter
from mstfilter.mst.testing.checking import (
    check_of as check_of,
    contract_of as contract_of,
    is_model as is_model,
    run_contract as run_contract,
)
from mstfilter.mst.testing.hypotheses import (
    EvidenceContract as EvidenceContract,
    SceneProposalContract as SceneProposalContract,
    SceneSimilarityContract as SceneSimilarityContract,
    SceneTransitionContract as SceneTransitionContract,
)
from mstfilter.mst.testing.scenes import scene_example as scene_example
from mstfilter.mst.testing.stages import (
    STAGE_OWNERS as STAGE_OWNERS,
    BoundaryModelContract as BoundaryModelContract,
    CompleterContract as CompleterContract,
    MaskTrackerContract as MaskTrackerContract,
    MotionRuleContract as MotionRuleContract,
    ProjectionContract as ProjectionContract,
    RegistrationContract as RegistrationContract,
    StageContract as StageContract,
)

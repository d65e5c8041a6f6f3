from mstfilter.fusion.belief import Belief as Belief
from mstfilter.fusion.cells import Cells as Cells, PairEvidence as PairEvidence
from mstfilter.fusion.conflicts import (
    PREDICTED as PREDICTED,
    PROPOSED as PROPOSED,
    ConflictGraph as ConflictGraph,
    OneSideLast as OneSideLast,
    RandomOrder as RandomOrder,
    SpanningTree as SpanningTree,
    conflict_graph as conflict_graph,
    merge_probability as merge_probability,
)
from mstfilter.fusion.crossover import (
    ConflictResolution as ConflictResolution,
    Crossover as Crossover,
    ModeFilter as ModeFilter,
)
from mstfilter.fusion.division import NoDivision as NoDivision, PartRule as PartRule, RigidMotions as RigidMotions
from mstfilter.fusion.free_space import (
    FreeSpace as FreeSpace,
    NoFreeSpace as NoFreeSpace,
    ProjectionUpdate as ProjectionUpdate,
    log_quality as log_quality,
)
from mstfilter.fusion.interfaces import (
    Division as Division,
    Evidence as Evidence,
    PairOdds as PairOdds,
    Projection as Projection,
    Structure as Structure,
)
from mstfilter.fusion.partition import PartitionUpdate as PartitionUpdate
from mstfilter.fusion.similarity import (
    Agreement as Agreement,
    SameSegmentation as SameSegmentation,
    WeightedCoverage as WeightedCoverage,
    canonical as canonical,
)
from mstfilter.fusion.update import Claims as Claims, FusionUpdate as FusionUpdate

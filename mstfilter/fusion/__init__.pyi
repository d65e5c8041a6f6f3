from mstfilter.fusion.belief import Belief as Belief
from mstfilter.fusion.claims import Claims as Claims
from mstfilter.fusion.conflicts import (
    PREDICTED as PREDICTED,
    PROPOSED as PROPOSED,
    ConflictGraph as ConflictGraph,
    conflict_graph as conflict_graph,
)
from mstfilter.fusion.crossover import Crossover as Crossover, Draw as Draw
from mstfilter.fusion.division import NoDivision as NoDivision, RigidMotions as RigidMotions
from mstfilter.fusion.free_space import (
    SMALLEST_QUALITY as SMALLEST_QUALITY,
    FreeSpace as FreeSpace,
    NoFreeSpace as NoFreeSpace,
    Projection as Projection,
)
from mstfilter.fusion.interfaces import Division as Division, Evidence as Evidence
from mstfilter.fusion.merging import merge_probability as merge_probability
from mstfilter.fusion.mode_filter import ModeFilter as ModeFilter
from mstfilter.fusion.projection import ProjectionUpdate as ProjectionUpdate
from mstfilter.fusion.similarity import (
    Agreement as Agreement,
    SameSegmentation as SameSegmentation,
    WeightedCoverage as WeightedCoverage,
    canonical as canonical,
)
from mstfilter.fusion.structure import (
    OneSideLast as OneSideLast,
    RandomOrder as RandomOrder,
    SpanningTree as SpanningTree,
    Structure as Structure,
)
from mstfilter.fusion.update import FusionUpdate as FusionUpdate

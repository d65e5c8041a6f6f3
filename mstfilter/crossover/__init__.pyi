from mstfilter.crossover.conflicts import (
    PREDICTED as PREDICTED,
    PROPOSED as PROPOSED,
    ConflictGraph as ConflictGraph,
    OneSideLast as OneSideLast,
    RandomOrder as RandomOrder,
    SpanningTree as SpanningTree,
    Structure as Structure,
    conflict_graph as conflict_graph,
    merge_probability as merge_probability,
)
from mstfilter.crossover.cross import (
    ConflictResolution as ConflictResolution,
    Crossover as Crossover,
    ModeFilter as ModeFilter,
)
from mstfilter.crossover.update import CrossoverUpdate as CrossoverUpdate

from mstfilter.mst.crossover.conflicts import (
    PREDICTED as PREDICTED,
    PROPOSED as PROPOSED,
    ConflictGraph as ConflictGraph,
    ConflictResolution as ConflictResolution,
    RandomOrder as RandomOrder,
    SpanningTree as SpanningTree,
    Structure as Structure,
    conflict_graph as conflict_graph,
    merge_probability as merge_probability,
)
from mstfilter.mst.crossover.mode_filter import ModeFilter as ModeFilter
from mstfilter.mst.crossover.update import (
    Crossover as Crossover,
    CrossoverUpdate as CrossoverUpdate,
    assign_labels as assign_labels,
)

from mstfilter.crossover.conflicts import (
    PREDICTED as PREDICTED,
    PROPOSED as PROPOSED,
    ConflictGraph as ConflictGraph,
    conflict_graph as conflict_graph,
)
from mstfilter.crossover.cross import Crossover as Crossover, assign_labels as assign_labels
from mstfilter.crossover.mode_filter import ModeFilter as ModeFilter
from mstfilter.crossover.resolution import (
    ConflictResolution as ConflictResolution,
    RandomOrder as RandomOrder,
    SpanningTree as SpanningTree,
    Structure as Structure,
    merge_probability as merge_probability,
)
from mstfilter.crossover.update import CrossoverUpdate as CrossoverUpdate

from mstfilter.mst.partition.association import ConflictComponent as ConflictComponent, Overlaps as Overlaps
from mstfilter.mst.partition.candidates import Choices as Choices
from mstfilter.mst.partition.cells import (
    Alternatives as Alternatives,
    Cells as Cells,
    PairEvidence as PairEvidence,
    PairOdds as PairOdds,
    PairTerms as PairTerms,
    Readings as Readings,
)
from mstfilter.mst.partition.update import PartitionUpdate as PartitionUpdate

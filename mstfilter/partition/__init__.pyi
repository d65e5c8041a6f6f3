from mstfilter.partition.association import ConflictComponent as ConflictComponent, Overlaps as Overlaps
from mstfilter.partition.candidates import Choices as Choices
from mstfilter.partition.cells import (
    Alternatives as Alternatives,
    Cells as Cells,
    PairEvidence as PairEvidence,
    PairOdds as PairOdds,
    PairTerms as PairTerms,
    Readings as Readings,
)
from mstfilter.partition.update import PartitionUpdate as PartitionUpdate

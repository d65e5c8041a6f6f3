from mstfilter.partition.cells import Cells as Cells, PairEvidence as PairEvidence, PairOdds as PairOdds
from mstfilter.partition.division import (
    Division as Division,
    NoDivision as NoDivision,
    PartRule as PartRule,
    RigidMotions as RigidMotions,
)
from mstfilter.partition.update import PartitionUpdate as PartitionUpdate

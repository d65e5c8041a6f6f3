from mstfilter.mst.belief.objects import BelievedObject as BelievedObject, ObjectTable as ObjectTable
from mstfilter.mst.belief.pushes import PushCandidate as PushCandidate, push_candidates as push_candidates
from mstfilter.mst.belief.queries import Belief as Belief, Border as Border
from mstfilter.mst.belief.rows import (
    OBJECT_COLUMNS as OBJECT_COLUMNS,
    flat_row as flat_row,
    pause_document as pause_document,
)
from mstfilter.mst.belief.similarity import SameSegmentation as SameSegmentation, WeightedCoverage as WeightedCoverage

"""A cut value: how well a region of the tree fits one object.

mstfilter check ./value.py:MyValue
mstfilter run demo/recording proposal.value=./value.py:MyValue --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mstfilter.mst.segmentation import CutValue, MergeLogOdds, Tree
from mstfilter.scene import Frame


@dataclass(frozen=True)
class MyValue(CutValue):
    """Log odds of merges, and a cost of every region. Fields need an annotation and a default.

    Parameters
    ----------
    cost : float
        Cost of a region, in nats. Larger values give fewer and larger objects.
    merges : CutValue
        The value that the cost is subtracted from.
    """

    cost: float = 1.0
    merges: CutValue = field(default_factory=MergeLogOdds)

    def values(self, tree: Tree, frame: Frame) -> np.ndarray:
        """(N,) value of every node, higher is better. The value of a cut is the sum over its nodes."""
        return self.merges.values(tree, frame) - self.cost

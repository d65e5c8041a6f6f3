"""A tree builder: the hierarchy of image regions that segmentations are cut from.

mstfilter check ./tree.py:MyTree
mstfilter run demo/recording proposal.tree=./tree.py:MyTree --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mstfilter.mst.segmentation import Tree, TreeBuilder, UcmTree
from mstfilter.scene import Frame


@dataclass(frozen=True)
class MyTree(TreeBuilder):
    """The tree of another builder with other probabilities. Fields need an annotation and a default.

    Parameters
    ----------
    power : float
        Power of P(boundary). Above 1, merges become more probable.
    builder : TreeBuilder
        Builds the hierarchy.
    """

    power: float = 1.5
    builder: TreeBuilder = field(default_factory=UcmTree)

    def build(self, boundary: np.ndarray, frame: Frame | None = None, pixels: np.ndarray | None = None) -> Tree:
        """The tree of a boundary map (H, W): parents of nodes, leaves of pixels, P(boundary) of merges.

        `pixels` (H, W) bool are those of objects; by default all above the table.
        """
        tree = self.builder.build(boundary, frame, pixels)
        return Tree(tree.parent, tree.leaves, tree.start**self.power)

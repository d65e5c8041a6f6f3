"""A hierarchy of regions whose merges are judged one by one: same object or not.

The watershed regions of a boundary map merge best first. How likely two regions are different objects is a logistic
function of what is measured along their border and of how they would fit together (`joins.FEATURES`), measured anew
whenever one of them grows. The weights were fitted on simulated scenes alone.

>>> tree = LearnedTree().build(boundary, frame)
>>> w = MergeLogOdds().values(tree, frame)
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Frame
from mstfilter.segmentation.agglomerate import Agglomeration
from mstfilter.segmentation.interfaces import TreeBuilder
from mstfilter.segmentation.join_weights import JOIN_WEIGHTS
from mstfilter.segmentation.joins import FEATURES, features
from mstfilter.segmentation.regions import Regions, measure_regions
from mstfilter.segmentation.tree import Tree
from mstfilter.segmentation.ucm import UcmTree

__all__ = ["LearnedTree", "tree_of_merges"]

#: Log odds of the root, which joins the table and what never touched.
_CERTAIN = 30.0


@dataclass(frozen=True)
class LearnedTree(TreeBuilder):
    """Best-first merging of watershed regions by learned log odds.

    All regions of the table are one leaf, and only the root joins it to anything.

    Parameters
    ----------
    leaves : TreeBuilder
        Gives the regions to begin with: the leaves of its tree.
    table_tolerance : float
        Readings up to this much above the table are table, in sensor disparity units.
    clear_step : float
        Step of disparity that counts as clear, in sensor disparity units.
    """

    leaves: TreeBuilder = field(default_factory=UcmTree)
    table_tolerance: float = 2.0
    clear_step: float = 4.0

    def regions(self, boundary: np.ndarray, frame: Frame) -> tuple[Tree, Regions]:
        """The first tree, and its leaves measured."""
        tree = self.leaves.build(boundary, frame)
        return tree, measure_regions(tree.leaves, frame, boundary, self.table_tolerance, self.clear_step)

    def build(self, boundary: np.ndarray, frame: Frame | None = None) -> Tree:
        """The tree of a frame. Its `odds` are those of each merge; `start` is their running maximum as P."""
        if frame is None:
            raise InputError("LearnedTree needs the frame beside its boundary map", "tree.build(boundary, frame)")
        tree, regions = self.regions(boundary, frame)
        scale = frame.camera.width / 640
        weights = np.array([JOIN_WEIGHTS[name] for name in FEATURES])
        growing = Agglomeration(regions, lambda a, b, ab, at, bt: features(a, b, ab, at, bt, scale) @ weights)
        while (pair := growing.pop()) is not None:
            odds, i, j = pair
            growing.merge(i, j, odds)
        return tree_of_merges(regions.of_leaf[tree.leaves], len(regions.sums), growing.merges)


def tree_of_merges(image: np.ndarray, n_regions: int, merges: list[tuple[int, int, float]]) -> Tree:
    """The tree of merges (a, b, log odds), the k-th of which makes node n_regions + k; a root joins the rest.

    Parameters
    ----------
    image : (H, W) int
        Region of every pixel.
    n_regions : int
        Region 0 is the table.
    merges : list of (int, int, float)
    """
    if n_regions == 1:
        return Tree(np.zeros(1, np.int64), image, np.zeros(1), np.zeros(1))
    root = n_regions + len(merges)
    parent = np.full(root + 1, root)
    odds = np.zeros(root + 1)
    start = np.zeros(root + 1)
    odds[root], start[root] = _CERTAIN, 1.0
    for node, (a, b, value) in enumerate(merges, start=n_regions):
        parent[[a, b]] = node
        odds[node] = value
        start[node] = max(1 / (1 + np.exp(-value)), start[a], start[b])
    return Tree(parent, image, start, odds)

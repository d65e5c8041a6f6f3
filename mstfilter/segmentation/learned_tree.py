"""A segmentation tree whose merges are decided by learned log odds: same object or not.

Watershed regions of a boundary map are merged, the pair with the lowest log odds first. The log odds that two regions
are different objects are linear in features of their border and of their union (`PAIR_FEATURES`), which are
recomputed when a region grows. The weights were fitted on simulated scenes only.

>>> tree = LearnedTree().build(boundary, frame)
>>> w = MergeLogOdds().values(tree, frame)
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Frame
from mstfilter.segmentation.join_weights import JOIN_WEIGHTS
from mstfilter.segmentation.regions import BORDER, PAIR_FEATURES, REGION, Regions, measure_regions, pair_features
from mstfilter.segmentation.tree import Tree, TreeBuilder, UcmTree

#: Log odds (k,) that the regions of k pairs belong to different objects:
#: (rows of a, rows of b, borders, table borders of a, of b).
PairLogOdds = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]

_NO_BORDER = np.zeros(len(BORDER))
_ROOT_ODDS = 30.0  # the root joins the table and regions that never touched


class Agglomeration:
    """Best-first merging of regions by the log odds that they are different objects; region 0, the table, stays."""

    def __init__(self, regions: Regions, log_odds: PairLogOdds) -> None:
        n = len(regions.sums)
        self.log_odds = log_odds
        self.sums = np.zeros((2 * n, regions.sums.shape[1]))
        self.sums[:n] = regions.sums
        self.borders: list[dict[int, np.ndarray]] = [dict(near) for near in regions.borders]
        self.table = [near.pop(0, _NO_BORDER) for near in self.borders]
        self.alive = set(range(1, n))
        self.merges: list[tuple[int, int, float]] = []
        self.heap: list[tuple[float, int, int]] = []
        for i in range(1, n):
            self._push(i, [j for j in self.borders[i] if j > i])

    def _push(self, i: int, others: list[int]) -> None:
        if not others:
            return
        borders = np.array([self.borders[i][j] for j in others])
        table = np.array([self.table[j] for j in others])
        mine = np.broadcast_to(self.sums[i], (len(others), self.sums.shape[1]))
        odds = self.log_odds(mine, self.sums[others], borders, np.broadcast_to(self.table[i], table.shape), table)
        for j, value in zip(others, odds.tolist(), strict=True):
            heapq.heappush(self.heap, (value, min(i, j), max(i, j)))

    def pop(self) -> tuple[float, int, int] | None:
        """Remove the pair with the lowest log odds, (log odds, i, j); None if no pair is left."""
        while self.heap:
            odds, i, j = heapq.heappop(self.heap)
            if i in self.alive and j in self.alive and j in self.borders[i]:
                return odds, i, j
        return None

    def merge_all(self) -> None:
        """Merge until no two regions have a border."""
        while (pair := self.pop()) is not None:
            odds, i, j = pair
            self.merge(i, j, odds)

    def merge(self, i: int, j: int, odds: float) -> int:
        """Merge two regions and return the number of the new one."""
        new = len(self.borders)
        self.merges.append((i, j, odds))
        self.sums[new] = self.sums[i] + self.sums[j]
        common = self.borders[i].pop(j, _NO_BORDER)
        self.borders[j].pop(i, None)
        self.sums[new, REGION["perimeter"].start] -= 2 * common[0]
        near = {k: row for k, row in self.borders[i].items() if k in self.alive}
        for k, row in self.borders[j].items():
            if k in self.alive:
                near[k] = near[k] + row if k in near else row
        self.borders.append(near)
        self.table.append(self.table[i] + self.table[j])
        self.alive -= {i, j}
        self.alive.add(new)
        for k in near:
            self.borders[k][new] = self.borders[k].pop(i, _NO_BORDER) + self.borders[k].pop(j, _NO_BORDER)
        self._push(new, list(near))
        return new


@dataclass(frozen=True)
class LearnedTree(TreeBuilder):
    """Best-first merging of watershed regions, the leaves of the tree of `leaves`, by learned log odds.

    The table is one leaf. Only the root merges it with other regions.
    """

    leaves: TreeBuilder = field(default_factory=UcmTree)

    def regions(self, boundary: np.ndarray, frame: Frame) -> tuple[Tree, Regions]:
        """The initial tree and its measured leaves."""
        tree = self.leaves.build(boundary, frame)
        return tree, measure_regions(tree.leaves, frame, boundary)

    def build(self, boundary: np.ndarray, frame: Frame | None = None) -> Tree:
        """Build the tree. `odds` are the log odds of each merge, `start` the maximum of their probabilities below."""
        if frame is None:
            raise InputError("LearnedTree needs the frame of the boundary map", "tree.build(boundary, frame)")
        tree, regions = self.regions(boundary, frame)
        scale = frame.camera.width / 640
        weights = np.array([JOIN_WEIGHTS[name] for name in PAIR_FEATURES])
        growing = Agglomeration(regions, lambda a, b, ab, at, bt: pair_features(a, b, ab, at, bt, scale) @ weights)
        growing.merge_all()
        return tree_of_merges(regions.of_leaf[tree.leaves], len(regions.sums), growing.merges)


def tree_of_merges(image: np.ndarray, n_regions: int, merges: list[tuple[int, int, float]]) -> Tree:
    """The tree of a list of merges. Merge k creates node n_regions + k; a root joins the remaining regions.

    `image` (H, W) int has the region of every pixel; region 0 is the table. A merge is its two nodes and its log
    odds.
    """
    if n_regions == 1:
        return Tree(np.zeros(1, np.int64), image, np.zeros(1), np.zeros(1))
    root = n_regions + len(merges)
    parent = np.full(root + 1, root)
    odds = np.zeros(root + 1)
    start = np.zeros(root + 1)
    odds[root], start[root] = _ROOT_ODDS, 1.0
    for node, (a, b, value) in enumerate(merges, start=n_regions):
        parent[[a, b]] = node
        odds[node] = value
        start[node] = max(1 / (1 + np.exp(-value)), start[a], start[b])
    return Tree(parent, image, start, odds)

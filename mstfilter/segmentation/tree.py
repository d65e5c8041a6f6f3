"""The segmentation tree: a hierarchy of image regions, and the cuts through it.

A tree is a plain parent array. Leaves come first (0 .. n_leaves - 1), every parent has a larger index than its
children, the root is last; so a loop over ascending indices goes bottom-up and nothing recurses. A *cut* is an
ascending array of nodes that covers every leaf exactly once: one segmentation of the image.

>>> import numpy as np
>>> from mstfilter.segmentation.tree import Tree
>>> tree = Tree(parent=[3, 3, 4, 4, 4], leaves=[[0, 0], [1, 2]], start=[0, 0, 0, 0.2, 0.9])
>>> tree.children(4).tolist(), tree.area.tolist()
([2, 3], [2, 1, 1, 3, 4])
>>> tree.label_image(np.array([2, 3]))        # number of the cut's node, pixel by pixel
array([[1, 1],
       [1, 0]])
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import content_key, read_only

__all__ = ["Tree"]


@dataclass(frozen=True, eq=False)
class Tree:
    """A hierarchy of image regions.

    Parameters
    ----------
    parent : (N,) int
        Parent of every node; the root (last) is its own parent. ``parent[i] > i`` elsewhere.
    leaves : (H, W) int
        Which leaf every pixel belongs to.
    start : (N,) float
        Strength of the weakest boundary at which the region forms, 0 .. 1: P(boundary) of the merge that makes
        it. Leaves 0. Non-decreasing towards the root.
    odds : (N,) float, optional
        Log odds that the merge that makes the node joins different objects, where the builder judges every merge
        by itself; they need not grow towards the root. Leaves 0.
    """

    parent: np.ndarray
    leaves: np.ndarray
    start: np.ndarray
    odds: np.ndarray | None = None

    def __post_init__(self) -> None:
        parent = np.array(self.parent, dtype=np.int64)
        leaves = np.array(self.leaves, dtype=np.int32)
        start = np.array(self.start, dtype=np.float64)
        n = len(parent)
        if parent.ndim != 1 or n == 0 or parent[-1] != n - 1 or (parent[:-1] <= np.arange(n - 1)).any():
            raise InputError(
                "tree parents are not ordered: every parent must have a larger index than its children",
                "the root is the last node and its own parent",
            )
        if start.shape != (n,) or not np.isfinite(start).all():
            raise InputError(f"tree start heights have shape {start.shape}, expected {(n,)} finite numbers")
        inner = np.zeros(n, dtype=bool)
        inner[parent[:-1]] = True
        n_leaves = n - int(inner.sum())
        if inner[:n_leaves].any():
            raise InputError("tree nodes are not ordered: leaves must come before all inner nodes")
        if leaves.ndim != 2 or leaves.size == 0 or leaves.min() < 0 or leaves.max() >= n_leaves:
            raise InputError(f"leaf image must be 2-D with values 0 .. {n_leaves - 1}")
        if self.odds is not None:
            odds = np.array(self.odds, dtype=np.float64)
            if odds.shape != (n,) or not np.isfinite(odds).all():
                raise InputError(f"tree log odds have shape {odds.shape}, expected {(n,)} finite numbers")
            object.__setattr__(self, "odds", read_only(odds))
        object.__setattr__(self, "parent", read_only(parent))
        object.__setattr__(self, "leaves", read_only(leaves))
        object.__setattr__(self, "start", read_only(start))

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.parent)

    @cached_property
    def n_leaves(self) -> int:
        """Number of leaves."""
        return self.n_nodes - len(np.unique(self.parent[:-1]))

    @property
    def root(self) -> int:
        """Index of the root."""
        return self.n_nodes - 1

    @cached_property
    def key(self) -> bytes:
        """Name by content."""
        odds = () if self.odds is None else (self.odds,)
        return content_key("tree", self.parent, self.leaves, self.start, *odds)

    @cached_property
    def end(self) -> np.ndarray:
        """(N,) strength at which the region is merged away: its parent's `start`; the root's is 1."""
        end = self.start[self.parent]
        end[self.root] = 1.0
        return read_only(end)

    @cached_property
    def child_offsets(self) -> np.ndarray:
        """(N + 1,) CSR offsets: the children of i are ``child_list[child_offsets[i]:child_offsets[i + 1]]``."""
        counts = np.bincount(self.parent[:-1], minlength=self.n_nodes)
        return read_only(np.concatenate([[0], np.cumsum(counts)]))

    @cached_property
    def child_list(self) -> np.ndarray:
        """(N - 1,) children of all nodes, ascending within a node."""
        return read_only(np.argsort(self.parent[:-1], kind="stable"))

    @cached_property
    def child_tuples(self) -> tuple[tuple[int, ...], ...]:
        """Children of every node as Python integers: for loops, which numpy scalars slow down."""
        offsets, flat = self.child_offsets.tolist(), self.child_list.tolist()
        return tuple(tuple(flat[a:b]) for a, b in pairwise(offsets))

    def children(self, node: int) -> np.ndarray:
        """Children of a node, ascending; empty for a leaf."""
        return self.child_list[self.child_offsets[node] : self.child_offsets[node + 1]]

    def accumulate(self, leaf_values: np.ndarray) -> np.ndarray:
        """Sums (N, ...) over each node's leaves of values (n_leaves, ...)."""
        leaf_values = np.asarray(leaf_values)
        order, first, last = self._leaf_ranges
        sums = np.zeros((self.n_leaves + 1, *leaf_values.shape[1:]), dtype=np.result_type(leaf_values, np.int64))
        np.cumsum(leaf_values[order], axis=0, out=sums[1:])
        return sums[last] - sums[first]

    def accumulate_pixels(self, mask: np.ndarray) -> np.ndarray:
        """(N,) number of pixels of a boolean image (H, W) in each node."""
        return self.accumulate(np.bincount(self.leaves[mask], minlength=self.n_leaves))

    @cached_property
    def area(self) -> np.ndarray:
        """(N,) pixels of every node."""
        return read_only(self.accumulate(np.bincount(self.leaves.ravel(), minlength=self.n_leaves)))

    @cached_property
    def _leaf_ranges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Leaves in depth-first order, and the range of them that each node covers."""
        n, parent = self.n_nodes, self.parent.tolist()
        count = [1] * self.n_leaves + [0] * (n - self.n_leaves)
        for i in range(n - 1):
            count[parent[i]] += count[i]
        begin, free = [0] * n, [0] * n
        for i in range(n - 2, -1, -1):
            begin[i] = free[i] = free[parent[i]]
            free[parent[i]] += count[i]
        first = np.array(begin)
        order = np.empty(self.n_leaves, dtype=np.int64)
        order[first[: self.n_leaves]] = np.arange(self.n_leaves)
        return order, first, first + np.array(count)

    @cached_property
    def leaf_place(self) -> np.ndarray:
        """(n_leaves,) place of every leaf in depth-first order, in which the leaves of a node are neighbours."""
        return read_only(self._leaf_ranges[1][: self.n_leaves].copy())

    def lowest_common(self, first: np.ndarray, last: np.ndarray) -> np.ndarray:
        """The lowest nodes (k,) that hold the leaves at places `first` (k,) to `last` (k,), first <= last."""
        order, _, end = self._leaf_ranges
        node = order[np.asarray(first)]
        last = np.asarray(last)
        while True:
            short = end[node] <= last
            if not short.any():
                return node
            node = np.where(short, self.parent[node], node)

    def leaves_of(self, node: int) -> np.ndarray:
        """The leaves under a node."""
        order, first, last = self._leaf_ranges
        return order[first[node] : last[node]]

    def is_cut(self, cut: np.ndarray) -> bool:
        """Whether a set of nodes covers every leaf exactly once."""
        cut = np.asarray(cut, dtype=np.int64)
        if cut.size == 0 or cut.min() < 0 or cut.max() >= self.n_nodes:
            return False
        covered = np.zeros(self.n_leaves, dtype=np.int64)
        for node in cut.tolist():
            covered[self.leaves_of(node)] += 1
        return bool((covered == 1).all())

    def label_leaves(self, cut: np.ndarray) -> np.ndarray:
        """(n_leaves,) position in `cut` of the node that covers each leaf; -1 where none does."""
        labels = np.full(self.n_leaves, -1, dtype=np.int64)
        for k, node in enumerate(np.asarray(cut).tolist()):
            labels[self.leaves_of(node)] = k
        return labels

    def label_image(self, cut: np.ndarray) -> np.ndarray:
        """(H, W) position in `cut` of the node that covers each pixel; -1 where none does."""
        return self.label_leaves(cut)[self.leaves]

    def mask(self, node: int) -> np.ndarray:
        """(H, W) bool: the pixels of a node."""
        inside = np.zeros(self.n_leaves, dtype=bool)
        inside[self.leaves_of(node)] = True
        return inside[self.leaves]

"""The segmentation tree: a hierarchy of image regions, and its construction from a boundary map.

A tree is a parent array. Leaves come first (0 .. n_leaves - 1), the root is last, and every parent has a larger index
than its children, so a loop over ascending indices visits children first. A *cut* is an ascending array of nodes that
covers every leaf exactly once; in other words, it is a segmentation of the image.

>>> import numpy as np
>>> from mstfilter.mst.segmentation import Tree
>>> tree = Tree(parent=[3, 3, 4, 4, 4], leaves=[[0, 0], [1, 2]], start=[0, 0, 0, 0.2, 0.9])
>>> tree.children[4], tree.area.tolist()
((2, 3), [2, 1, 1, 3, 4])
>>> tree.label_image(np.array([2, 3]))        # index into the cut, for every pixel
array([[1, 1],
       [1, 0]])

`UcmTree` builds the ultrametric contour map (Arbelaez et al. 2011). Watershed regions of the boundary map are merged
in order of the mean strength of their common border, the *height* of the merge, and a logistic curve maps the height
to P(boundary), the probability that the merge joins different objects. The field `start` of a node is P(boundary) of
the merge that makes it. So it is near 0 for a node inside one object, and near 1 for a node with several objects.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import PositiveInt
from mstfilter.base.results import Checked, check_type, returns
from mstfilter.scene import Frame, content_key, read_only

#: A merge of two nodes: their numbers, and the log odds of different objects against one.
Merge = tuple[int, int, float]


@dataclass(frozen=True, eq=False)
class Tree:
    """A hierarchy of image regions."""

    #: (N,) int, parent of every node; the root (last) is its own parent. ``parent[i] > i`` elsewhere.
    parent: np.ndarray
    leaves: np.ndarray  #: (H, W) int, leaf of every pixel
    #: (N,) P(boundary) of the merge that creates the node, 0 .. 1. Zero for leaves, non-decreasing towards the
    #: root.
    start: np.ndarray
    #: (N,) log odds that the merge that creates the node joins different objects, if the builder estimates them.
    #: Zero for leaves; not necessarily monotone.
    odds: np.ndarray | None = None

    def __post_init__(self) -> None:
        parent = np.array(self.parent, dtype=np.int64)
        leaves = np.array(self.leaves, dtype=np.int32)
        n = len(parent)
        if parent.ndim != 1 or n == 0 or parent[-1] != n - 1 or (parent[:-1] <= np.arange(n - 1)).any():
            raise InputError(
                "tree parents are not ordered: every parent must have a larger index than its children",
                "the root is the last node and its own parent",
            )
        inner = np.zeros(n, dtype=bool)
        inner[parent[:-1]] = True
        n_leaves = n - int(inner.sum())
        if inner[:n_leaves].any():
            raise InputError("tree nodes are not ordered: leaves must come before all inner nodes")
        if leaves.ndim != 2 or leaves.size == 0 or leaves.min() < 0 or leaves.max() >= n_leaves:
            raise InputError(f"leaf image must be 2-D with values 0 .. {n_leaves - 1}")
        for name, values in (("start", self.start), ("odds", self.odds)):
            if values is not None:
                values = np.array(values, dtype=np.float64)
                if values.shape != (n,) or not np.isfinite(values).all():
                    raise InputError(f"tree {name} has shape {values.shape}, expected {(n,)} finite numbers")
                object.__setattr__(self, name, read_only(values))
        object.__setattr__(self, "parent", read_only(parent))
        object.__setattr__(self, "leaves", read_only(leaves))

    @property
    def n_nodes(self) -> int:
        return len(self.parent)

    @cached_property
    def n_leaves(self) -> int:
        return self.n_nodes - len(np.unique(self.parent[:-1]))

    @property
    def root(self) -> int:
        return self.n_nodes - 1

    @cached_property
    def key(self) -> bytes:
        """Hash of the content."""
        odds = () if self.odds is None else (self.odds,)
        return content_key("tree", self.parent, self.leaves, self.start, *odds)

    @cached_property
    def end(self) -> np.ndarray:
        """(N,) P(boundary) of the merge that absorbs each node (`start` of the parent), or 1 for the root."""
        end = self.start[self.parent]
        end[self.root] = 1.0
        return read_only(end)

    @cached_property
    def children(self) -> tuple[tuple[int, ...], ...]:
        """Children of every node in ascending order, as Python integers, which are fast in loops."""
        found: list[list[int]] = [[] for _ in range(self.n_nodes)]
        for node, parent in enumerate(self.parent[:-1].tolist()):
            found[parent].append(node)
        return tuple(map(tuple, found))

    def accumulate(self, leaf_values: np.ndarray) -> np.ndarray:
        """Sum of leaf values (n_leaves,) over the leaves of every node, (N,)."""
        return self.accumulate_nodes(np.append(leaf_values, np.zeros(self.n_nodes - self.n_leaves, np.int64)))

    def accumulate_nodes(self, values: np.ndarray) -> np.ndarray:
        """Sum of node values (N,) over every node and its descendants, (N,)."""
        total, parent = values.tolist(), self.parent.tolist()
        for node in range(self.n_nodes - 1):
            total[parent[node]] += total[node]
        return np.array(total)

    def accumulate_pixels(self, mask: np.ndarray) -> np.ndarray:
        """Number of true pixels of a boolean image (H, W) in every node, (N,)."""
        return self.accumulate(np.bincount(self.leaves[mask], minlength=self.n_leaves))

    @cached_property
    def area(self) -> np.ndarray:
        """(N,) number of pixels of every node."""
        return read_only(self.accumulate_pixels(np.ones(self.leaves.shape, bool)))

    @cached_property
    def _leaf_ranges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Leaves in depth-first order, and for every node the start and the end of its range in this order."""
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
    def leaf_position(self) -> np.ndarray:
        """(n_leaves,) position of every leaf in depth-first order. The leaves of a node are consecutive."""
        return read_only(self._leaf_ranges[1][: self.n_leaves].copy())

    def lowest_common(self, first: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Lowest nodes (k,) that contain the leaves at positions `first` (k,) to `last` (k,); first <= last."""
        order, _, end = self._leaf_ranges
        node = order[np.asarray(first)]
        last = np.asarray(last)
        while True:
            short = end[node] <= last
            if not short.any():
                return node
            node = np.where(short, self.parent[node], node)

    def leaves_of(self, node: int) -> np.ndarray:
        """The leaves below a node."""
        order, first, last = self._leaf_ranges
        return order[first[node] : last[node]]

    def label_image(self, cut: np.ndarray) -> np.ndarray:
        """(H, W) index into `cut` of the node that covers each pixel; -1 for pixels without a node."""
        labels = np.full(self.n_leaves, -1, dtype=np.int64)
        for k, node in enumerate(np.asarray(cut).tolist()):
            labels[self.leaves_of(node)] = k
        return labels[self.leaves]

    def mask(self, node: int) -> np.ndarray:
        """The pixels of a node, (H, W) bool."""
        inside = np.zeros(self.n_leaves, dtype=bool)
        inside[self.leaves_of(node)] = True
        return inside[self.leaves]


def _check_tree(
    self: TreeBuilder, found: Tree, boundary: np.ndarray, frame: Frame | None = None, pixels: np.ndarray | None = None
) -> Tree:
    check_type(found, Tree, "a Tree")
    if found.leaves.shape != boundary.shape:
        raise InputError(f"returns a tree of an image of shape {found.leaves.shape}, expected {boundary.shape}")
    return found


class TreeBuilder(Checked, ABC):
    """Builds a hierarchy of regions from a boundary map."""

    @returns(_check_tree)
    @abstractmethod
    def build(self, boundary: np.ndarray, frame: Frame | None = None, pixels: np.ndarray | None = None) -> Tree:
        """The tree of a boundary map (H, W).

        Some builders also use the frame and `pixels` (H, W) bool, which marks the pixels that can belong to objects.
        By default, `pixels` is the result of `pixels_above_table`.
        """


@dataclass(frozen=True)
class UcmTree(TreeBuilder):
    """Watershed and average linkage by mean boundary strength. Only the strongest merges are kept.

    The logistic curve and the colour weight of `ColourDepthBoundary` were fitted together on the 45 `learn` frames of
    mOSD. Results with other cameras are in experiments/osd_frames.

    Parameters
    ----------
    max_leaves : int
        Largest number of leaves. The tree has fewer than 2 `max_leaves` nodes.
    centre : float
        Merge height (mean boundary strength 0 .. 1) at which P(boundary) = 0.5.
    slope : float
        Slope of the log odds per unit of height.
    """

    max_leaves: PositiveInt = 501
    centre: float = 0.55
    slope: float = 12.0

    def build(self, boundary: np.ndarray, frame: Frame | None = None, pixels: np.ndarray | None = None) -> Tree:
        boundary = np.asarray(boundary)
        if boundary.ndim != 2 or boundary.size == 0:
            raise InputError(f"boundary map has shape {boundary.shape}, expected (H, W)")
        if not np.isfinite(boundary).all():
            raise InputError("boundary map contains a value that is not finite")
        parent, altitude, leaves = merge_tree(boundary)
        parent, altitude, leaves = prune(parent, altitude, leaves, self.max_leaves)
        n_leaves = int(leaves.max()) + 1
        start = np.zeros(len(parent))
        start[n_leaves:] = self.probability(altitude[n_leaves:])
        return Tree(parent, leaves, start)

    def probability(self, height: np.ndarray) -> np.ndarray:
        """P(boundary) for each merge height."""
        return 1 / (1 + np.exp(-self.slope * (np.asarray(height) - self.centre)))


def merge_tree(boundary: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The complete hierarchy: parents (N,), merge heights (N,) with 0 for leaves, and leaf image (H, W)."""
    import higra as hg

    shape = boundary.shape
    if boundary.size == 1:
        return np.array([0]), np.zeros(1), np.zeros(shape, np.int64)
    graph = hg.get_4_adjacency_graph(shape)
    weights = hg.weight_graph(graph, boundary.astype(np.float64), hg.WeightFunction.mean)
    found = linkage_tree(graph, weights, shape)
    if found is None:
        return np.array([0]), np.zeros(1), np.zeros(shape, np.int64)
    tree, altitude, leaves = found
    return np.array(tree.parents(), dtype=np.int64), altitude, leaves


def linkage_tree(
    graph: Any,
    weights: np.ndarray,
    shape: tuple[int, int],
    strength: Callable[[np.ndarray], np.ndarray] | None = None,
) -> tuple[Any, np.ndarray, np.ndarray] | None:
    """Watershed and average linkage of a pixel graph. Returns higra's tree, merge heights (N,), leaf image (H, W).

    `weights` (E,) belong to the edges of the graph. ``strength(arcs)`` returns the strength of the borders between
    the watershed regions. By default, the strength of a border is the mean of the `weights` of its edges. `arcs` (E,)
    has the number of the border of each edge, or -1 for edges within a region. Returns None for a single region.
    """
    import higra as hg

    # No edge orientations: the library's convention would weaken axis-parallel borders.
    rag, strengths = hg.oriented_watershed(graph, weights, shape)
    details = hg.CptRegionAdjacencyGraph.construct(rag)
    leaves = np.asarray(details["vertex_map"]).reshape(shape)
    if rag.num_vertices() == 1:
        return None
    if strength is not None:
        strengths = strength(np.asarray(details["edge_map"]))
    lengths = hg.rag_accumulate_on_edges(rag, hg.Accumulators.sum, np.ones(graph.num_edges()))
    tree, altitude = hg.binary_partition_tree_average_linkage(rag, strengths, lengths)
    # By rounding, the mean of a parent can be lower than that of its child; heights must not decrease upwards.
    altitude = hg.accumulate_and_max_sequential(tree, altitude, np.zeros(tree.num_leaves()), hg.Accumulators.max)
    return tree, np.array(altitude, dtype=np.float64), leaves


def prune(
    parent: np.ndarray, altitude: np.ndarray, leaves: np.ndarray, max_leaves: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keep the `max_leaves - 1` inner nodes of largest altitude in a binary tree. Other subtrees become leaves.

    A parent has at least the altitude of its children and comes after its children. So the root is kept, and the
    parent of each kept node is kept.
    """
    n = len(parent)
    n_leaves = (n + 1) // 2
    if n_leaves <= max_leaves:
        return parent, altitude, leaves
    inner = np.arange(n_leaves, n)
    order = np.lexsort((inner, altitude[inner]))
    kept = np.zeros(n, dtype=bool)
    if max_leaves == 1:
        return np.array([0]), np.zeros(1), np.zeros_like(leaves)
    kept[inner[order[-(max_leaves - 1) :]]] = True
    cut = ~kept & kept[parent]
    new = np.full(n, -1, dtype=np.int64)
    new[cut] = np.arange(int(cut.sum()))
    new[kept] = int(cut.sum()) + np.arange(int(kept.sum()))
    # Nodes below a new leaf take its number; parents come before children.
    below = new.copy()
    for node in range(n - 2, -1, -1):
        if below[node] < 0:
            below[node] = below[parent[node]]
    survivors = np.concatenate([np.flatnonzero(cut), np.flatnonzero(kept)])
    height = altitude[survivors].copy()
    height[: int(cut.sum())] = 0.0
    return new[parent[survivors]], height, below[leaves]

"""Ultrametric contour map: the hierarchy of regions from a boundary map (Arbelaez et al. 2011).

Watershed regions of the boundary map are merged in order of the mean strength of their common border. The merge
heights are mapped to P(boundary) by a logistic curve, because the node values presuppose probabilities: a region
inside one object starts near 0, one bordered by other objects ends near 1.

>>> tree = UcmTree().build(boundary)
>>> tree.n_leaves, tree.label_image(cut)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Frame
from mstfilter.segmentation.interfaces import TreeBuilder
from mstfilter.segmentation.tree import Tree

__all__ = ["UcmTree"]


@dataclass(frozen=True)
class UcmTree(TreeBuilder):
    """Oriented watershed, average linkage by mean boundary strength, pruned to the strongest merges.

    The curve and the colour weight of `ColourDepthBoundary` were fitted together on the 45 `learn` frames of mOSD
    (experiments/osd_frames reports what they reach on set-ups that they were not fitted on).

    Parameters
    ----------
    max_leaves : int
        Leaves kept; the tree has fewer than twice as many nodes.
    centre : float
        Merge height (mean boundary strength 0 .. 1) that means P(boundary) = 0.5.
    slope : float
        Steepness of the logistic there, per unit of height.
    calibrate : bool
        False leaves the merge heights as they are.
    """

    max_leaves: int = 501
    centre: float = 0.55
    slope: float = 12.0
    calibrate: bool = True

    def __post_init__(self) -> None:
        if self.max_leaves < 1:
            raise InputError(f"max_leaves is {self.max_leaves!r}, expected at least 1")

    def build(self, boundary: np.ndarray, frame: Frame | None = None) -> Tree:
        """The tree of a boundary map (H, W) with values 0 .. 1."""
        boundary = np.asarray(boundary)
        if boundary.ndim != 2 or boundary.size == 0:
            raise InputError(f"boundary map has shape {boundary.shape}, expected (H, W)")
        if not np.isfinite(boundary).all():
            raise InputError("boundary map holds a value that is not finite")
        parent, altitude, leaves = merge_tree(boundary)
        parent, altitude, leaves = prune(parent, altitude, leaves, self.max_leaves)
        n_leaves = int(leaves.max()) + 1
        start = np.zeros(len(parent))
        heights = altitude[n_leaves:]
        start[n_leaves:] = self.probability(heights) if self.calibrate else heights
        return Tree(parent, leaves, start)

    def probability(self, height: np.ndarray) -> np.ndarray:
        """P(boundary) of merge heights."""
        return 1 / (1 + np.exp(-self.slope * (np.asarray(height) - self.centre)))


def merge_tree(boundary: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All merges: parents (N,), merge heights (N,) with 0 for leaves, and the leaf image (H, W)."""
    import higra as hg

    shape = boundary.shape
    if boundary.size == 1:
        return np.array([0]), np.zeros(1), np.zeros(shape, np.int64)
    graph = hg.get_4_adjacency_graph(shape)
    weights = hg.weight_graph(graph, boundary.astype(np.float64), hg.WeightFunction.mean)
    # Edge orientations are left out on purpose: the library's convention weakens axis-parallel borders.
    rag, strengths = hg.oriented_watershed(graph, weights, shape)
    leaves = np.asarray(hg.CptRegionAdjacencyGraph.construct(rag)["vertex_map"]).reshape(shape)
    if rag.num_vertices() == 1:
        return np.array([0]), np.zeros(1), np.zeros(shape, np.int64)
    lengths = hg.rag_accumulate_on_edges(rag, hg.Accumulators.sum, np.ones(graph.num_edges()))
    tree, altitude = hg.binary_partition_tree_average_linkage(rag, strengths, lengths)
    # Averages of float edges: a parent may come out lower by rounding; heights must not decrease upwards.
    altitude = np.array(altitude, dtype=np.float64)
    parent = np.array(tree.parents(), dtype=np.int64)
    for node in range(rag.num_vertices(), len(parent) - 1):
        up = parent[node]
        if altitude[up] < altitude[node]:
            altitude[up] = altitude[node]
    return parent, altitude, leaves


def prune(
    parent: np.ndarray, altitude: np.ndarray, leaves: np.ndarray, max_leaves: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keep the `max_leaves - 1` highest merges of a binary tree; what they merge become the leaves.

    Because heights do not decrease upwards and parents come after children, the last merges are a rooted part.
    """
    n = len(parent)
    n_leaves = (n + 1) // 2
    if n_leaves <= max_leaves:
        return parent, altitude, leaves
    inner = np.arange(n_leaves, n)
    order = np.lexsort((inner, altitude[inner]))
    kept = np.zeros(n, dtype=bool)
    if max_leaves > 1:
        kept[inner[order[-(max_leaves - 1) :]]] = True
    else:
        return np.array([0]), np.zeros(1), np.zeros_like(leaves)
    cut = ~kept & kept[parent]
    new = np.full(n, -1, dtype=np.int64)
    new[cut] = np.arange(int(cut.sum()))
    new[kept] = int(cut.sum()) + np.arange(int(kept.sum()))
    # Everything below a new leaf belongs to it: hand the number down, parents first.
    below = new.copy()
    for node in range(n - 2, -1, -1):
        if below[node] < 0:
            below[node] = below[parent[node]]
    survivors = np.concatenate([np.flatnonzero(cut), np.flatnonzero(kept)])
    height = altitude[survivors].copy()
    height[: int(cut.sum())] = 0.0
    return new[parent[survivors]], height, below[leaves]

"""Which objects of two hypotheses claim the same voxels (paper, section IV-D, figure 5).

>>> graph = conflict_graph(proposed.labels, predicted.labels)
>>> graph.edges, graph.components()

A vertex is an object of one of the two hypotheses, an edge says that a proposed and a predicted object overlap.
The graph is bipartite: objects of one hypothesis never overlap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import networkx as nx
import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import MAX_LABEL, as_labels

__all__ = [
    "PREDICTED",
    "PROPOSED",
    "Claimed",
    "ConflictGraph",
    "claimed",
    "conflict_graph",
    "graph_of",
    "overlapping",
]

PROPOSED, PREDICTED = 0, 1


@dataclass(frozen=True, eq=False)
class ConflictGraph:
    """Objects of a proposed and a predicted hypothesis and their overlaps.

    Parameters
    ----------
    side : (n,) int
        0 proposed, 1 predicted.
    label : (n,) int
        Label of the object in its hypothesis.
    size : (n,) int
        Its voxels.
    edges : (m, 2) int
        Vertex numbers of overlapping pairs.
    intersection : (m,) int
        Voxels that both claim.

    Notes
    -----
    Vertices are numbered at their first voxel in a scan with x fastest, the proposed object first where both
    begin at the same voxel: the authors' numbering.
    """

    side: np.ndarray
    label: np.ndarray
    size: np.ndarray
    edges: np.ndarray
    intersection: np.ndarray

    def __len__(self) -> int:
        return len(self.label)

    def components(self) -> list[list[int]]:
        """Connected components with at least one edge, as ascending vertex numbers."""
        conflicted = [sorted(c) for c in nx.connected_components(self.networkx()) if len(c) > 1]
        return sorted(conflicted)

    def networkx(self) -> nx.Graph:
        """The graph in networkx: vertices carry side, label and size, edges the intersection in voxels."""
        graph = nx.Graph()
        for v in range(len(self)):
            graph.add_node(v, side=int(self.side[v]), label=int(self.label[v]), size=int(self.size[v]))
        for (a, b), count in zip(self.edges.tolist(), self.intersection.tolist(), strict=True):
            graph.add_edge(a, b, intersection=count)
        return graph

    def neighbours(self) -> list[list[int]]:
        """Adjacent vertices of each vertex, ascending."""
        adjacent: list[list[int]] = [[] for _ in range(len(self))]
        for a, b in self.edges.tolist():
            adjacent[a].append(b)
            adjacent[b].append(a)
        return [sorted(a) for a in adjacent]


class Claimed(NamedTuple):
    """The voxels that a proposed or a predicted hypothesis fills: a few percent of a grid, all that fusion looks at.

    at : (n,) flat indices; proposed, predicted : (n,) uint16 labels there, 0 free; shape : of the grid.
    """

    at: np.ndarray
    proposed: np.ndarray
    predicted: np.ndarray
    shape: tuple[int, ...]

    def spread(self, values: np.ndarray) -> np.ndarray:
        """A grid with these values (n,) in its claimed voxels and 0 elsewhere."""
        grid = np.zeros(self.shape, values.dtype)
        grid.reshape(-1)[self.at] = values
        return grid


def claimed(proposed: np.ndarray, predicted: np.ndarray) -> Claimed:
    """The voxels (X, Y, Z) that either label grid fills."""
    a, b = as_labels(proposed, "proposed label grid"), as_labels(predicted, "predicted label grid")
    if a.shape != b.shape:
        raise InputError(
            f"proposed and predicted label grids have shapes {a.shape} and {b.shape}, expected the same shape",
            "all hypotheses of a run share one workspace",
        )
    at = np.flatnonzero((a | b) != 0)
    return Claimed(at, a.reshape(-1)[at], b.reshape(-1)[at], a.shape)


def conflict_graph(proposed: np.ndarray, predicted: np.ndarray) -> ConflictGraph:
    """The conflict graph of two label grids (X, Y, Z) of the same shape."""
    return graph_of(claimed(proposed, predicted))


def graph_of(voxels: Claimed) -> ConflictGraph:
    """The conflict graph of two hypotheses, from the voxels that they claim."""
    position = np.ravel_multi_index(np.unravel_index(voxels.at, voxels.shape), voxels.shape, order="F")
    side, label, size, begin = [], [], [], []
    for which, labels in ((PROPOSED, voxels.proposed), (PREDICTED, voxels.predicted)):
        sizes = np.bincount(labels, minlength=1)
        first = np.full(len(sizes), math.prod(voxels.shape))
        np.minimum.at(first, labels.astype(np.intp), position)
        sizes[0] = 0
        present = np.flatnonzero(sizes)
        label.append(present)
        size.append(sizes[present])
        begin.append(first[present])
        side.append(np.full(len(present), which))
    sides, labels = np.concatenate(side), np.concatenate(label)
    order = np.lexsort((sides, np.concatenate(begin)))
    number = np.zeros((2, MAX_LABEL + 1), np.int64)
    number[sides[order], labels[order]] = np.arange(len(order))

    a, b, common = overlapping(voxels)
    edges = np.stack([number[PROPOSED, a], number[PREDICTED, b]], axis=1)
    return ConflictGraph(sides[order], labels[order], np.concatenate(size)[order], edges, common)


def overlapping(voxels: Claimed) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Proposed label, predicted label and common voxels (m,) of each overlapping pair, labels ascending."""
    both = (voxels.proposed != 0) & (voxels.predicted != 0)
    pair = voxels.proposed[both].astype(np.int64) * (MAX_LABEL + 1) + voxels.predicted[both]
    found, common = np.unique(pair, return_counts=True)
    a, b = np.divmod(found, MAX_LABEL + 1)
    return a, b, common

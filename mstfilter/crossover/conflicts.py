"""The conflict graph of two hypotheses (paper, section IV-D, figure 5).

>>> graph = conflict_graph(proposed.labels, predicted.labels)
>>> graph.edges, graph.components()
>>> networkx.draw(graph.networkx(), with_labels=True)

A vertex is an object of one of the two hypotheses; an edge joins a proposed and a predicted object that overlap. The
graph is bipartite, because objects of one hypothesis never overlap. `mstfilter.crossover.resolution` draws how the
conflicts are resolved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import networkx as nx
import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import MAX_LABEL, as_labels

PROPOSED, PREDICTED = 0, 1
SIDES = (PROPOSED, PREDICTED)


@dataclass(frozen=True, eq=False)
class ConflictGraph:
    """Objects of a proposed and a predicted hypothesis and their overlaps.

    Notes
    -----
    Vertices are numbered by their first voxel in a scan with x fastest, the proposed object first if two objects
    begin at the same voxel: the authors' numbering.
    """

    side: np.ndarray  #: (n,) int 0 proposed, 1 predicted
    label: np.ndarray  #: (n,) int, label of the object in its hypothesis
    size: np.ndarray  #: (n,) int, voxels of the object
    edges: np.ndarray  #: (m, 2) int, vertex numbers of overlapping pairs
    intersection: np.ndarray  #: (m,) int, voxels that both objects occupy

    def __len__(self) -> int:
        return len(self.label)

    def networkx(self) -> nx.Graph:
        """The graph in networkx.

        Vertices carry ``side``, ``label`` and ``size``, edges carry ``intersection``, in voxels. Neighbours ascend.
        """
        graph = nx.Graph()
        objects = zip(self.side.tolist(), self.label.tolist(), self.size.tolist(), strict=True)
        for v, (side, label, size) in enumerate(objects):
            graph.add_node(v, side=side, label=label, size=size)
        order = np.lexsort((self.edges[:, 1], self.edges[:, 0]))
        for (a, b), common in zip(self.edges[order].tolist(), self.intersection[order].tolist(), strict=True):
            graph.add_edge(a, b, intersection=common)
        return graph

    def components(self) -> list[list[int]]:
        """Connected components with at least one edge, as ascending vertex numbers."""
        return components_in_conflict(self.networkx())

    def by_label(self, side: int, values: np.ndarray) -> np.ndarray:
        """Values (n,) of the vertices as a table (65536,) over the labels of a side; 0 for labels without object."""
        table = np.zeros(MAX_LABEL + 1, values.dtype)
        of_side = self.side == side
        table[self.label[of_side]] = values[of_side]
        return table


def components_in_conflict(graph: nx.Graph) -> list[list[int]]:
    """Connected components of a graph with at least one edge, as ascending vertices."""
    return sorted(sorted(c) for c in nx.connected_components(graph) if len(c) > 1)


@dataclass(frozen=True, eq=False)
class OccupiedVoxels:
    """The voxels that a proposed or a predicted hypothesis occupies: a few percent of a grid."""

    at: np.ndarray  #: (n,) flat indices
    labels: tuple[np.ndarray, np.ndarray]  #: (n,) uint16 of the proposed and of the predicted hypothesis, 0 free
    shape: tuple[int, ...]  #: of the grid

    @classmethod
    def of(cls, proposed: np.ndarray, predicted: np.ndarray) -> OccupiedVoxels:
        """Of two label grids (X, Y, Z) of one shape."""
        a, b = as_labels(proposed, "proposed label grid"), as_labels(predicted, "predicted label grid")
        if a.shape != b.shape:
            raise InputError(
                f"proposed and predicted label grids have shapes {a.shape} and {b.shape}, expected the same shape",
                "all hypotheses of a run share one workspace",
            )
        at = np.flatnonzero((a | b) != 0)
        return cls(at, (a.reshape(-1)[at], b.reshape(-1)[at]), a.shape)

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Values (n,) in the shape of the grid, 0 elsewhere."""
        out = np.zeros(self.shape, values.dtype)
        out.reshape(-1)[self.at] = values
        return out

    def objects(self, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Label, voxels and position of the first voxel (k,) of the objects of a side; x is fastest in a position."""
        position = np.ravel_multi_index(np.unravel_index(self.at, self.shape), self.shape, order="F")
        labels = self.labels[side]
        sizes = np.bincount(labels, minlength=1)
        first = np.full(len(sizes), math.prod(self.shape))
        np.minimum.at(first, labels.astype(np.intp), position)
        present = np.flatnonzero(sizes[1:]) + 1
        return present, sizes[present], first[present]

    def overlaps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Proposed label, predicted label and common voxels (m,) of each overlapping pair, labels ascending."""
        proposed, predicted = self.labels
        both = (proposed != 0) & (predicted != 0)
        pair = proposed[both].astype(np.int64) * (MAX_LABEL + 1) + predicted[both]
        found, common = np.unique(pair, return_counts=True)
        return *np.divmod(found, MAX_LABEL + 1), common


def conflict_graph(proposed: np.ndarray, predicted: np.ndarray) -> ConflictGraph:
    """The conflict graph of two label grids (X, Y, Z) of the same shape."""
    return graph_of(OccupiedVoxels.of(proposed, predicted))


def graph_of(voxels: OccupiedVoxels) -> ConflictGraph:
    """The conflict graph of two hypotheses, from the voxels that they occupy."""
    objects = [voxels.objects(side) for side in SIDES]
    label, size, first = (np.concatenate(column) for column in zip(*objects, strict=True))
    side = np.repeat(SIDES, [len(labels) for labels, _, _ in objects])
    order = np.lexsort((side, first))
    number = np.zeros((2, MAX_LABEL + 1), np.int64)
    number[side[order], label[order]] = np.arange(len(order))
    proposed, predicted, common = voxels.overlaps()
    edges = np.stack([number[PROPOSED, proposed], number[PREDICTED, predicted]], axis=1)
    return ConflictGraph(side[order], label[order], size[order], edges, common)

"""Which objects of two hypotheses claim the same voxels (paper, section IV-D, figure 5).

>>> graph = conflict_graph(proposed.labels, predicted.labels)
>>> graph.edges, graph.components()

A vertex is an object of one of the two hypotheses, an edge says that a proposed and a predicted object overlap.
The graph is bipartite: objects of one hypothesis never overlap.
"""

from __future__ import annotations

from dataclasses import dataclass

import networkx as nx
import numpy as np

from mstfilter.scene.quality import overlap

__all__ = ["PREDICTED", "PROPOSED", "ConflictGraph", "conflict_graph"]

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


def conflict_graph(proposed: np.ndarray, predicted: np.ndarray) -> ConflictGraph:
    """The conflict graph of two label grids (X, Y, Z) of the same shape.

    One pass over the voxels finds all sizes and overlaps.
    """
    table = overlap(proposed, predicted)
    first = [_first_voxel(proposed, table.labels_a), _first_voxel(predicted, table.labels_b)]
    side, label, size, begin = [], [], [], []
    for which, (labels, sizes) in enumerate(((table.labels_a, table.sizes_a), (table.labels_b, table.sizes_b))):
        real = labels > 0
        label.append(labels[real])
        size.append(sizes[real])
        begin.append(first[which][real])
        side.append(np.full(int(real.sum()), which))
    n_proposed = len(label[0])
    order = np.lexsort((np.concatenate(side), np.concatenate(begin)))
    number = np.empty(len(order), np.int64)
    number[order] = np.arange(len(order))

    counts = table.counts[table.labels_a > 0][:, table.labels_b > 0]
    a, b = np.nonzero(counts)
    edges = np.stack([number[a], number[n_proposed + b]], axis=1) if len(a) else np.zeros((0, 2), np.int64)
    return ConflictGraph(
        np.concatenate(side)[order],
        np.concatenate(label)[order],
        np.concatenate(size)[order],
        edges,
        counts[a, b],
    )


def _first_voxel(labels: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Position of each label's first voxel in a scan with x fastest."""
    flat = np.asarray(labels).ravel(order="F")
    position = np.zeros(int(present[-1]) + 1 if len(present) else 1, np.int64)
    position[flat[::-1]] = np.arange(len(flat) - 1, -1, -1)  # written last = met first
    return position[present]

"""The conflict graph of two hypotheses, and the random choices that resolve it (paper, section IV-D, figure 5).

>>> graph = conflict_graph(proposed.labels, predicted.labels)
>>> graph.edges, graph.components()
>>> networkx.draw(graph.networkx(), with_labels=True)

A vertex is an object of one of the two hypotheses, and an edge joins a proposed and a predicted object that overlap.
The graph is bipartite, because objects of one hypothesis never overlap.

In each connected component, a `Structure` draws the order in which objects are painted, and directed edges from a
child to its parent, which is painted later. Along such an edge, a child with n1 voxels is merged into a parent with
n2 voxels and I common voxels, with a probability that `merge_probability` computes by one of these rules:

=============  =============================  ========================================================
rule           probability                    source
=============  =============================  ========================================================
``share``      min(1, I n2 / n1^2)            the authors' program: (covered share of the child) x (size
                                              ratio); about even odds on real conflicts

``printed``    min(1, IoU n2 / n1^2)          the formula as printed (paper, section IV-D); its dimension
                                              is 1 / voxels, so objects are almost never merged

``always``     1                              a control

``never``      0                              a control
=============  =============================  ========================================================
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import networkx as nx
import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.results import Checked, check_pair, check_type, returns
from mstfilter.scene import MAX_LABEL, as_labels

PROPOSED, PREDICTED = 0, 1
SIDES = (PROPOSED, PREDICTED)
MergeRule = Literal["share", "printed", "always", "never"]
MERGE_RULES: tuple[MergeRule, ...] = get_args(MergeRule)


@dataclass(frozen=True, eq=False)
class ConflictGraph:
    """Objects of a proposed and a predicted hypothesis and their overlaps.

    Notes
    -----
    Vertices are numbered by the first voxel of each object in Fortran order (x fastest). If two objects begin at the
    same voxel, the proposed object is first. The authors' program uses the same numbering.
    """

    side: np.ndarray  #: (n,) int 0 proposed, 1 predicted
    label: np.ndarray  #: (n,) int, label of the object in its hypothesis
    size: np.ndarray  #: (n,) int, voxels of the object
    edges: np.ndarray  #: (m, 2) int, vertex numbers of overlapping pairs
    intersection: np.ndarray  #: (m,) int, voxels that both objects occupy

    def __len__(self) -> int:
        return len(self.label)

    def networkx(self) -> nx.Graph:
        """The conflict graph as a `networkx.Graph`.

        Vertices have the attributes ``side``, ``label`` and ``size``, edges the attribute ``intersection``, in
        voxels; neighbours are in ascending order.
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
        """Table (65536,) of vertex `values` (n,), indexed by the labels of `side`; 0 for labels without an object."""
        table = np.zeros(MAX_LABEL + 1, values.dtype)
        of_side = self.side == side
        table[self.label[of_side]] = values[of_side]
        return table


def components_in_conflict(graph: nx.Graph) -> list[list[int]]:
    """Connected components of a graph with at least one edge, as ascending lists of vertices."""
    return sorted(sorted(c) for c in nx.connected_components(graph) if len(c) > 1)


@dataclass(frozen=True, eq=False)
class OccupiedVoxels:
    """The voxels that are occupied in a proposed or a predicted hypothesis, usually a few percent of a grid."""

    at: np.ndarray  #: (n,) flat indices
    labels: tuple[np.ndarray, np.ndarray]  #: (n,) uint16 of the proposed and of the predicted hypothesis, 0 free
    shape: tuple[int, ...]  #: of the grid

    @classmethod
    def of(cls, proposed: np.ndarray, predicted: np.ndarray) -> OccupiedVoxels:
        """The occupied voxels of two label grids (X, Y, Z) of one shape."""
        a, b = as_labels(proposed, "proposed label grid"), as_labels(predicted, "predicted label grid")
        if a.shape != b.shape:
            raise InputError(
                f"proposed and predicted label grids have shapes {a.shape} and {b.shape}, expected the same shape",
                "all hypotheses of a run share one workspace",
            )
        at = np.flatnonzero((a | b) != 0)
        return cls(at, (a.reshape(-1)[at], b.reshape(-1)[at]), a.shape)

    def spread(self, values: np.ndarray) -> np.ndarray:
        """A grid with values (n,) at the occupied voxels and 0 at all other voxels."""
        out = np.zeros(self.shape, values.dtype)
        out.reshape(-1)[self.at] = values
        return out

    def objects(self, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Labels, sizes and positions (Fortran order) of the first voxels (k,) of the objects of `side`."""
        position = np.ravel_multi_index(np.unravel_index(self.at, self.shape), self.shape, order="F")
        labels = self.labels[side]
        sizes = np.bincount(labels, minlength=1)
        first = np.full(len(sizes), math.prod(self.shape))
        np.minimum.at(first, labels.astype(np.intp), position)
        present = np.flatnonzero(sizes[1:]) + 1
        return present, sizes[present], first[present]

    def overlaps(self) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Proposed and predicted labels (m,) of overlapping pairs, ascending, and numbers of common voxels (m,)."""
        proposed, predicted = self.labels
        both = (proposed != 0) & (predicted != 0)
        pair = proposed[both].astype(np.int64) * (MAX_LABEL + 1) + predicted[both]
        found, common = np.unique(pair, return_counts=True)
        return np.divmod(found, MAX_LABEL + 1), common


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
    pairs, common = voxels.overlaps()
    edges = np.stack([number[which][labels] for which, labels in zip(SIDES, pairs, strict=True)], axis=1)
    return ConflictGraph(side[order], label[order], size[order], edges, common)


# Painting orders and merges -----------------------------------------------------------------------------------------

#: Vertices in painting order, and edges (child, parent); see `Structure.draw`.
OrderAndEdges = tuple[list[int], list[tuple[int, int]]]


class ConflictResolution(NamedTuple):
    """One resolution of all conflicts of a conflict graph."""

    #: Vertices in painting order, first to last.
    order: list[int]
    #: For each vertex, the vertex that is painted last in its group of merged objects; -1 if the object is dropped.
    group: np.ndarray


def _check_structure(
    self: Structure, found: Any, rng: Any, graph: nx.Graph, component: Sequence[int]
) -> OrderAndEdges:
    check_pair(found, "an order", "edges")
    order, edges = (check_type(part, (list, tuple), "lists") for part in found)
    if sorted(order) != sorted(component):
        raise InputError(f"returns the order {list(order)}, expected each vertex of {list(component)} once")
    place = {v: k for k, v in enumerate(order)}
    for edge in edges:
        if len(edge) != 2 or not graph.has_edge(*edge):
            raise InputError(f"returns the edge {edge}, which is no edge of the graph")
        if place[edge[0]] > place[edge[1]]:
            raise InputError(f"returns the edge {edge}: the child {edge[0]} is painted after its parent {edge[1]}")
    return list(order), list(edges)


class Structure(Checked, ABC):
    """Samples the painting order of conflicting objects, and the edges along which objects may be merged."""

    @returns(_check_structure)
    @abstractmethod
    def draw(self, rng: np.random.Generator, graph: nx.Graph, component: Sequence[int]) -> OrderAndEdges:
        """Draw an order and directed edges for one component of the conflict graph.

        Parameters
        ----------
        graph : networkx.Graph
            The conflict graph (`ConflictGraph.networkx`). The neighbours ``graph[v]`` are in ascending order.
        component : sequence of int
            Vertices of one connected component, ascending.

        Returns
        -------
        order : list of int
            All vertices of the component in painting order. Later vertices are painted over earlier vertices.
        edges : list of (child, parent)
            Edges of the graph along which a child may be merged into its parent. Parents are painted after children.
        """


@dataclass(frozen=True)
class RandomOrder(Structure):
    """The rule of the paper: a random acyclic orientation of the edges, and a topological order of the vertices.

    A uniformly random order of the vertices determines the orientation. Objects may be merged along every edge.
    """

    def draw(self, rng: np.random.Generator, graph: nx.Graph, component: Sequence[int]) -> OrderAndEdges:
        order = [component[k] for k in rng.permutation(len(component))]
        place = {v: k for k, v in enumerate(order)}
        return order, [(v, w) for v in order for w in graph[v] if place[v] < place[w]]


@dataclass(frozen=True)
class SpanningTree(Structure):
    """The rule in the authors' program: a uniform random spanning tree from a uniform random root.

    Objects are merged only along edges of the tree. Children are painted before their parent.
    """

    def draw(self, rng: np.random.Generator, graph: nx.Graph, component: Sequence[int]) -> OrderAndEdges:
        root, parent = random_spanning_tree(rng, graph, component)
        children: dict[int, list[int]] = {v: [] for v in component}
        for v in component:
            if v != root:
                children[parent[v]].append(v)
        order, stack = [], [root]
        while stack:  # parents first; the reverse has every child before its parent
            v = stack.pop()
            order.append(v)
            stack.extend(children[v])
        order.reverse()
        return order, [(v, parent[v]) for v in order if v != root]


def random_spanning_tree(
    rng: np.random.Generator, graph: nx.Graph, component: Sequence[int]
) -> tuple[int, dict[int, int]]:
    """Draw a uniformly random spanning tree of a connected component by Wilson's algorithm (1996).

    Loop-erased random walks run from each vertex to the existing tree. `networkx.random_spanning_tree` has the same
    distribution, but computes a determinant for every edge.

    Returns
    -------
    root : int
        Uniformly random root.
    parent : dict
        Parent of every other vertex.
    """
    neighbours = {v: list(graph[v]) for v in component}
    root = component[int(rng.integers(len(component)))]
    inside = {root}
    parent: dict[int, int] = {}
    for start in component:
        v = start
        while v not in inside:
            # The last exit from v counts, which erases the loops of the walk.
            parent[v] = neighbours[v][int(rng.integers(len(neighbours[v])))]
            v = parent[v]
        v = start
        while v not in inside:
            inside.add(v)
            v = parent[v]
    return root, parent


def merge_probability(
    rule: MergeRule, intersection: np.ndarray | int, child: np.ndarray | int, parent: np.ndarray | int
) -> np.ndarray:
    """Probability that a child object is merged into its parent, elementwise.

    The docstring of the module has the formulas. `intersection`, `child` and `parent` are the numbers of voxels in
    the intersection, in the child, and in the parent.
    """
    common, n1, n2 = (np.asarray(a, dtype=np.float64) for a in (intersection, child, parent))
    match rule:
        case "share":
            return np.minimum(1.0, common * n2 / n1**2)
        case "printed":
            return np.minimum(1.0, common / (n1 + n2 - common) * n2 / n1**2)
        case "always":
            return np.ones_like(common)
        case "never":
            return np.zeros_like(common)
    raise InputError(f"there is no merge rule {rule!r}", f"there are: {', '.join(MERGE_RULES)}")


def resolve(
    rng: np.random.Generator, graph: ConflictGraph, structure: Structure, merge: MergeRule, drop_rule: bool = False
) -> ConflictResolution:
    """Draw a resolution of all conflicts. Objects without conflict are painted first.

    `drop_rule` reproduces a fault of the authors' program: an object without conflict is lost if it has a larger
    vertex number than all objects in conflict.
    """
    links = graph.networkx()
    components = components_in_conflict(links)
    conflicted = {v for component in components for v in component}
    order = [v for v in range(len(graph)) if v not in conflicted]
    group = np.arange(len(graph))
    if drop_rule:
        last = max(conflicted, default=-1)
        group[[v for v in order if v > last]] = -1
        order = [v for v in order if v <= last]
    for component in components:
        painted, edges = structure.draw(rng, links, component)
        order.extend(painted)
        _unite(group, _merged(rng, graph, links, merge, edges), painted)
    return ConflictResolution(order, group)


def _merged(
    rng: np.random.Generator, graph: ConflictGraph, links: nx.Graph, rule: MergeRule, edges: list[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Select each edge (child, parent) with its merge probability. Objects are merged along the returned edges."""
    if not edges:
        return []
    child, parent = np.array(edges).T
    common = np.array([links.edges[edge]["intersection"] for edge in edges])
    probability = merge_probability(rule, common, graph.size[child], graph.size[parent])
    return [edge for edge, yes in zip(edges, rng.random(len(edges)) < probability, strict=True) if yes]


def _unite(group: np.ndarray, merged: list[tuple[int, int]], order: list[int]) -> None:
    """Merge groups of objects along edges, in place. The vertex that is painted last represents its group."""
    place = {v: k for k, v in enumerate(order)}
    for edge in merged:
        first, last = sorted((int(group[v]) for v in edge), key=place.__getitem__)
        group[group == first] = last

"""Random choices that resolve the conflicts of two hypotheses (paper, section IV-D, figure 5).

For each connected component of the conflict graph a `Structure` draws a painting order, and directed edges from a
child to its parent, which is painted later. `merge_probability` is the probability that a child with n1 voxels is
merged into its parent with n2 voxels, if they have I voxels in common:

=============  =============================  ========================================================
rule           probability                    source
=============  =============================  ========================================================
``share``      min(1, I n2 / n1^2)            the authors' program: (covered share of the child) x (size
                                              ratio); about even odds on real conflicts
``printed``    min(1, IoU n2 / n1^2)          the formula as printed (paper, section IV-D); its dimension
                                              is 1 / voxels, so it practically never merges
``always``     1                              a control
``never``      0                              a control
=============  =============================  ========================================================
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import networkx as nx
import numpy as np

from mstfilter.crossover.conflicts import ConflictGraph, components_in_conflict
from mstfilter.errors import InputError
from mstfilter.results import Checked, check_pair, check_type, returns

MergeRule = Literal["share", "printed", "always", "never"]
MERGE_RULES: tuple[MergeRule, ...] = get_args(MergeRule)

#: Vertices in painting order, and edges (child, parent); see `Structure.draw`.
OrderAndEdges = tuple[list[int], list[tuple[int, int]]]


class ConflictResolution(NamedTuple):
    """One resolution of all conflicts of a conflict graph."""

    #: Vertices in painting order, first to last.
    order: list[int]
    #: For each vertex, the vertex of its merge group that is painted last; -1 if the object is dropped.
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
    """Draws the order in which objects in conflict are painted, and the conflicts that may end in a merge."""

    @returns(_check_structure)
    @abstractmethod
    def draw(self, rng: np.random.Generator, graph: nx.Graph, component: Sequence[int]) -> OrderAndEdges:
        """Draw an order and directed edges for one component of the conflict graph.

        Parameters
        ----------
        graph : networkx.Graph
            The conflict graph (`ConflictGraph.networkx`). The neighbours of a vertex, ``graph[v]``, ascend.
        component : sequence of int
            Vertices of one connected component, ascending.

        Returns
        -------
        order : list of int
            All vertices of the component, first to last painted; later ones paint over earlier ones.
        edges : list of (child, parent)
            Edges of the graph along which the child may be merged into the parent, which is painted after it.
        """


@dataclass(frozen=True)
class RandomOrder(Structure):
    """The paper's text: edges get a random acyclic orientation, vertices a topological order of it.

    A uniformly random order of the vertices gives both. Every conflict may end in a merge.
    """

    def draw(self, rng: np.random.Generator, graph: nx.Graph, component: Sequence[int]) -> OrderAndEdges:
        order = [component[k] for k in rng.permutation(len(component))]
        place = {v: k for k, v in enumerate(order)}
        return order, [(v, w) for v in order for w in graph[v] if place[v] < place[w]]


@dataclass(frozen=True)
class SpanningTree(Structure):
    """The authors' program: a uniform random spanning tree from a uniform random root.

    Only edges of the tree may end in a merge. Children are painted before their parent, the root last.
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

    Loop-erased random walks run from each vertex to the tree so far. `networkx.random_spanning_tree` has the same
    law, but computes a determinant for every edge.

    Returns
    -------
    root : int
        Uniformly random.
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

    The table of the module has the formulas. `intersection`, `child` and `parent` are the voxels in common, of the
    child, and of the parent.
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

    `drop_rule` reproduces a fault of the authors' program: an object without conflict is lost if its vertex number
    exceeds that of every vertex in conflict.
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
    """The edges (child, parent) along which objects merge: each is drawn by its probability."""
    if not edges:
        return []
    child, parent = np.array(edges).T
    common = np.array([links.edges[edge]["intersection"] for edge in edges])
    probability = merge_probability(rule, common, graph.size[child], graph.size[parent])
    return [edge for edge, yes in zip(edges, rng.random(len(edges)) < probability, strict=True) if yes]


def _unite(group: np.ndarray, merged: list[tuple[int, int]], order: list[int]) -> None:
    """Merge groups along edges, in place. The vertex that is painted last represents its group."""
    place = {v: k for k, v in enumerate(order)}
    for edge in merged:
        first, last = sorted((int(group[v]) for v in edge), key=place.__getitem__)
        group[group == first] = last

"""In which order conflicting objects are painted, and which of their conflicts may end in a merge.

A structure turns a component of the conflict graph into a painting order (later paints over earlier) and a
list of directed edges child -> parent along which the child may be merged into the parent. A parent is always
painted after its child.

>>> order, edges = SpanningTree().draw(rng, [0, 3, 4], [[3, 4], ...])
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["OneSideLast", "RandomOrder", "SpanningTree", "Structure", "random_spanning_tree"]


class Structure(ABC):
    """Draws the order in which conflicts are resolved."""

    @abstractmethod
    def draw(
        self, rng: np.random.Generator, component: Sequence[int], neighbours: Sequence[Sequence[int]]
    ) -> tuple[list[int], list[tuple[int, int]]]:
        """Painting order of a component's vertices, first to last, and directed edges (child, parent).

        Parameters
        ----------
        rng : Generator
            For the draw.
        component : sequence of int
            Vertex numbers of one connected component.
        neighbours : sequence of sequences of int
            Adjacent vertices of every vertex of the graph.
        """


@dataclass(frozen=True)
class RandomOrder(Structure):
    """The paper's text: edges get a random acyclic orientation, vertices a topological order of it.

    A uniformly random order of the vertices gives both; every conflict may end in a merge.
    """

    def draw(
        self, rng: np.random.Generator, component: Sequence[int], neighbours: Sequence[Sequence[int]]
    ) -> tuple[list[int], list[tuple[int, int]]]:
        """Draw."""
        order = [component[k] for k in rng.permutation(len(component))]
        place = {v: k for k, v in enumerate(order)}
        edges = [(v, w) for v in order for w in neighbours[v] if place[v] < place[w]]
        return order, edges


@dataclass(frozen=True)
class OneSideLast(Structure):
    """All objects of one hypothesis over those of the other, by a fair coin for each component.

    In a random order of all vertices the hypothesis with more pieces wins more often: where one parent has an object
    whole and the other in k pieces, the whole one comes last in 1 of k + 1 cases only, and what was once cut stays
    cut. Every conflict may end in a merge.
    """

    def draw(
        self, rng: np.random.Generator, component: Sequence[int], neighbours: Sequence[Sequence[int]]
    ) -> tuple[list[int], list[tuple[int, int]]]:
        """Draw."""
        last = {component[0]: bool(rng.random() < 0.5)}
        queue = [component[0]]
        for v in queue:  # the graph is bipartite: sides alternate along edges
            for w in neighbours[v]:
                if w not in last:
                    last[w] = not last[v]
                    queue.append(w)
        shuffled = [component[k] for k in rng.permutation(len(component))]
        order = [v for v in shuffled if not last[v]] + [v for v in shuffled if last[v]]
        return order, [(v, w) for v in order if not last[v] for w in neighbours[v]]


@dataclass(frozen=True)
class SpanningTree(Structure):
    """The authors' program: a uniform random spanning tree from a uniform random root.

    Only tree edges may end in a merge. Children are painted before their parent, the root last.
    """

    def draw(
        self, rng: np.random.Generator, component: Sequence[int], neighbours: Sequence[Sequence[int]]
    ) -> tuple[list[int], list[tuple[int, int]]]:
        """Draw."""
        root, parent = random_spanning_tree(rng, component, neighbours)
        children: dict[int, list[int]] = {v: [] for v in component}
        for v in component:
            if v != root:
                children[parent[v]].append(v)
        order, stack = [], [root]
        while stack:  # preorder, parents first; reversed it finishes children before their parent
            v = stack.pop()
            order.append(v)
            stack.extend(children[v])
        order.reverse()
        return order, [(v, parent[v]) for v in order if v != root]


def random_spanning_tree(
    rng: np.random.Generator, component: Sequence[int], neighbours: Sequence[Sequence[int]]
) -> tuple[int, dict[int, int]]:
    """A uniformly random spanning tree of a connected component by Wilson's algorithm (1996).

    Loop-erased random walks from each vertex to the tree so far. Returns the root, uniform too, and the parent
    of every other vertex.
    """
    root = component[int(rng.integers(len(component)))]
    inside = {root}
    parent: dict[int, int] = {}
    for start in component:
        v = start
        while v not in inside:
            parent[v] = neighbours[v][int(rng.integers(len(neighbours[v])))]  # leaving again forgets the loop
            v = parent[v]
        v = start
        while v not in inside:
            inside.add(v)
            v = parent[v]
    return root, parent

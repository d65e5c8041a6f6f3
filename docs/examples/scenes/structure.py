"""A structure: in which order objects in conflict are painted, and which of them may be merged.

mstfilter check ./structure.py:MyStructure
mstfilter run demo/recording --preset mst_rules update.crossover.structure=./structure.py:MyStructure --replace
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np

from mstfilter.mst.crossover import Structure


@dataclass(frozen=True)
class MyStructure(Structure):
    """Paints larger objects first, so that smaller ones cover them. Fields need an annotation and a default.

    Parameters
    ----------
    noise : float
        Standard deviation of the noise that is added to the log of the volumes.
    """

    noise: float = 0.5

    def draw(
        self, rng: np.random.Generator, graph: nx.Graph, component: Sequence[int]
    ) -> tuple[list[int], list[tuple[int, int]]]:
        """All vertices of the component, first to last painted, and edges (child, parent) that may end in a merge."""
        # Vertices have "side", "label" and "size" (voxels); edges have "intersection" (voxels).
        noise = self.noise * rng.standard_normal(len(component))
        size = {v: np.log(graph.nodes[v]["size"]) + e for v, e in zip(component, noise, strict=True)}
        order = sorted(component, key=lambda v: -size[v])
        place = {v: k for k, v in enumerate(order)}
        return order, [(v, w) for v in order for w in graph[v] if place[v] < place[w]]

"""A direct implementation of the paper's conflict-graph crossover with numpy and networkx.

>>> labels = crossover(np.random.default_rng(0), proposed_labels, predicted_labels)

`fusion.py` compares with it. It has the same distribution as ``Crossover(RandomOrder(), "share", ModeFilter())``
and uses one mask per object, one count per pair of masks, and one window per voxel in the mode filter.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import networkx as nx
import numpy as np

PROPOSED, PREDICTED = 0, 1
Vertex = tuple[int, int]  # side, label


class Decisions(NamedTuple):
    """The random decisions of a crossover and the labels of its objects, to repeat a crossover of another program.

    priority : position of each vertex in a random order; chance : uniform number of each directed edge; name : label
    that each vertex is painted with.
    """

    priority: Mapping[Vertex, Any]
    chance: Mapping[tuple[Vertex, Vertex], float]
    name: Mapping[Vertex, int]


def decide(rng: np.random.Generator, graph: nx.Graph) -> Decisions:
    """Draw the decisions."""
    priority = dict(zip(graph.nodes, rng.random(len(graph)), strict=True))
    chance = {}
    for a, b in graph.edges:
        chance[a, b] = chance[b, a] = rng.random()
    return Decisions(priority, chance, {v: k for k, v in enumerate(graph.nodes, start=1)})


def crossover(
    rng: np.random.Generator | None, proposed: np.ndarray, predicted: np.ndarray, decisions: Decisions | None = None
) -> np.ndarray:
    """Labels (X, Y, Z) from two parents. Without `decisions` they are drawn with `rng`."""
    masks: dict[Vertex, np.ndarray] = {}
    graph = nx.Graph()
    for side, labels in ((PROPOSED, proposed), (PREDICTED, predicted)):
        for label in np.unique(labels):
            if label != 0:
                masks[side, int(label)] = labels == label
    for v, mask in masks.items():
        graph.add_node(v, size=np.count_nonzero(mask))
    for a in masks:
        for b in masks:
            if a[0] == PROPOSED and b[0] == PREDICTED:
                common = np.count_nonzero(masks[a] & masks[b])
                if common:
                    graph.add_edge(a, b, common=common)

    priority, chance, name = decide(rng, graph) if decisions is None else decisions
    out = np.zeros(proposed.shape, np.uint16)
    for component in nx.connected_components(graph):
        oriented = nx.DiGraph()
        oriented.add_nodes_from(component)
        for a, b in graph.subgraph(component).edges:
            oriented.add_edge(*((a, b) if priority[a] < priority[b] else (b, a)))
        order = list(nx.lexicographical_topological_sort(oriented, key=priority.__getitem__))
        merged = nx.Graph()
        merged.add_nodes_from(component)
        for child, parent in oriented.edges:
            size, common = graph.nodes[child]["size"], graph.edges[child, parent]["common"]
            if chance[child, parent] < min(1.0, common * graph.nodes[parent]["size"] / size**2):
                merged.add_edge(child, parent)
        painted = {}
        for group in nx.connected_components(merged):
            last = max(group, key=order.index)
            painted.update(dict.fromkeys(group, name[last]))
        for v in order:
            out[masks[v]] = painted[v]
    return mode_filter(out)


def mode_filter(
    labels: np.ndarray, window: int = 5, margin: int = 3, isolation: int = 120, sweeps: int = 100
) -> np.ndarray:
    """Give each occupied voxel the most frequent object of its window if that leads by `margin`."""
    half, outside = window // 2, np.iinfo(np.uint16).max
    names = [k for k in np.unique(labels) if k != 0]
    labels = labels.copy()
    for _ in range(sweeps):
        at = np.nonzero(labels)
        padded = np.pad(labels, half, constant_values=outside)
        windows = np.lib.stride_tricks.sliding_window_view(padded, (window,) * 3)[at].reshape(len(at[0]), -1)
        own, best = labels[at], np.zeros(len(at[0]), int)
        winner, own_count = own.copy(), np.zeros(len(at[0]), int)
        for k in names:
            count = np.count_nonzero(windows == k, axis=1)
            ahead = count >= best  # a tie goes to the larger name
            best[ahead], winner[ahead] = count[ahead], k
            own_count[own == k] = count[own == k]
        new = np.where((winner != own) & (best >= own_count + margin), winner, own)
        new[np.count_nonzero(windows == 0, axis=1) > isolation] = 0
        if (new == own).all():
            break
        labels[at] = new
    return labels

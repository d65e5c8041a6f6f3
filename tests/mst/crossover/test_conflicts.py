"""Conflict graphs, random structures and merges: against enumeration and against plain code."""

from __future__ import annotations

from itertools import combinations, permutations, product

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.mst.crossover import (
    ConflictGraph,
    Crossover,
    RandomOrder,
    SpanningTree,
    conflict_graph,
    merge_probability,
)
from mstfilter.mst.crossover.conflicts import MERGE_RULES, random_spanning_tree

labels = hnp.arrays(np.uint16, (4, 3, 5), elements=st.sampled_from([0, 0, 1, 2, 3, 9]))


@settings(max_examples=100, deadline=None)
@given(labels, labels)
def test_graph_against_plain_code(a, b):
    graph = conflict_graph(a, b)
    seen, order = [], []
    for flat in range(a.size):  # x fastest, the proposed label first
        index = np.unravel_index(flat, a.shape, order="F")
        for side, grid in ((0, a), (1, b)):
            if grid[index] and (side, grid[index]) not in seen:
                seen.append((side, grid[index]))
                order.append((side, int(grid[index])))
    assert list(zip(graph.side.tolist(), graph.label.tolist(), strict=True)) == order
    want = {}
    for i, (s, k) in enumerate(order):
        assert graph.size[i] == ((a, b)[s] == k).sum()
        for j, (r, m) in enumerate(order):
            common = int(((a == k) & (b == m)).sum()) if (s, r) == (0, 1) else 0
            if common:
                want[i, j] = common
    assert dict(zip(map(tuple, graph.edges.tolist()), graph.intersection.tolist(), strict=True)) == want


def test_the_conflict_graph_as_a_networkx_graph():
    """Users can inspect it."""
    a, b = np.zeros((2, 6, 1, 1), np.uint16)
    a[[0, 1, 3, 5], 0, 0] = 7, 7, 8, 9
    b[[1, 2, 3, 4], 0, 0] = 3, 3, 4, 4
    graph = conflict_graph(a, b)
    links = graph.networkx()
    assert isinstance(links, nx.Graph) and nx.is_bipartite(links)
    assert links.nodes[0] == {"side": 0, "label": 7, "size": 2}
    assert links.edges[0, 1] == {"intersection": 1}
    assert [list(links[v]) for v in links] == [[1], [0], [3], [2], []]
    assert graph.components() == [[0, 1], [2, 3]]


def path_graph(n, edges, sizes=None, common=None):
    sizes = np.full(n, 10) if sizes is None else np.asarray(sizes)
    edges = np.asarray(edges).reshape(-1, 2)
    common = np.ones(len(edges), int) if common is None else np.asarray(common)
    return ConflictGraph(np.zeros(n, int), np.arange(n), sizes, edges, common)


CONNECTED = [
    (n, edges)
    for n in (2, 3, 4)
    for k in range(n - 1, n * (n - 1) // 2 + 1)
    for edges in combinations(list(combinations(range(n), 2)), k)
    if nx.is_connected(nx.Graph(edges)) and len({v for e in edges for v in e}) == n
]
SHAPES = {tuple(sorted(d for _, d in nx.Graph(e).degree())): (n, e) for n, e in CONNECTED}


@pytest.mark.parametrize(
    ("n", "edges"), [*SHAPES.values(), (6, list(nx.octahedral_graph().edges)), (5, list(nx.wheel_graph(5).edges))]
)
def test_spanning_trees_are_uniform(n, edges):
    """Chi-square against Kirchhoff's count over all trees and roots; false alarm 1e-5 a graph."""
    graph = nx.Graph(list(edges))
    laplacian = nx.laplacian_matrix(graph, nodelist=range(n)).toarray()
    n_trees = round(np.linalg.det(laplacian[1:, 1:]))
    rng = np.random.default_rng(n + len(edges))
    draws, counts = max(4000, 12 * n * n_trees), {}
    for _ in range(draws):
        root, parent = random_spanning_tree(rng, graph, list(range(n)))
        tree = (root, frozenset(frozenset(e) for e in parent.items()))
        counts[tree] = counts.get(tree, 0) + 1
    assert len(counts) <= n * n_trees
    assert all(nx.is_tree(nx.Graph([tuple(e) for e in edges])) for _, edges in counts if edges)
    expected = draws / (n * n_trees)
    observed = np.array([*counts.values(), *([0] * (n * n_trees - len(counts)))])
    assert stats.chi2.sf(((observed - expected) ** 2 / expected).sum(), n * n_trees - 1) > 1e-5


def outcome(group, order):
    """What matters of a draw: the partition into objects, and who paints over whom in it."""
    return tuple(int(g) for g in group), tuple(order)


def exact_law(graph, structure, rule):
    """All draws with their probabilities, by enumeration."""
    n = len(graph)
    common = {}
    for (a, b), c in zip(graph.edges.tolist(), graph.intersection.tolist(), strict=True):
        common[a, b] = common[b, a] = c
    structures = []
    if isinstance(structure, RandomOrder):
        orders = list(permutations(range(n)))
        for order in orders:
            edges = [(v, w) for k, v in enumerate(order) for w in order[k + 1 :] if (v, w) in common]
            structures.append((order, edges, 1 / len(orders)))
    else:
        trees = [
            t
            for t in combinations(map(tuple, graph.edges.tolist()), n - 1)
            if nx.is_tree(nx.Graph(t)) and len(nx.Graph(t)) == n
        ]
        for tree in trees:
            for root in range(n):
                directed = nx.bfs_tree(nx.Graph(tree), root)
                parent = {child: up for up, child in directed.edges}
                children = {v: sorted(directed[v]) for v in directed}
                order, stack = [], [root]
                while stack:
                    v = stack.pop()
                    order.append(v)
                    stack.extend(children[v])
                order.reverse()
                structures.append((order, [(v, parent[v]) for v in order if v != root], 1 / (len(trees) * n)))
    law = {}
    for order, edges, p in structures:
        chance = [float(merge_probability(rule, common[e], graph.size[e[0]], graph.size[e[1]])) for e in edges]
        place = {v: k for k, v in enumerate(order)}
        for merged in product([False, True], repeat=len(edges)):
            q = p * np.prod([c if m else 1 - c for c, m in zip(chance, merged, strict=True)])
            if q == 0:
                continue
            united = nx.Graph([e for e, m in zip(edges, merged, strict=True) if m])
            united.add_nodes_from(range(n))
            group = [0] * n
            for part in nx.connected_components(united):
                top = max(part, key=place.__getitem__)
                for v in part:
                    group[v] = top
            key = outcome(group, order)
            law[key] = law.get(key, 0.0) + q
    assert sum(law.values()) == pytest.approx(1.0)
    return law


@pytest.mark.parametrize("structure", [RandomOrder(), SpanningTree()], ids=["order", "tree"])
@pytest.mark.parametrize(
    ("n", "edges"),
    [
        # Fast: all small graphs; of those with four segments the tree and the one with all conflicts.
        pytest.param(n, edges, marks=[pytest.mark.nightly] * (n == 4 and len(edges) in (4, 5)))
        for n, edges in SHAPES.values()
    ],
)
def test_outcomes_follow_the_enumerated_law(structure, n, edges):
    """Chi-square over all (merge partition, painting order); false alarm 1e-5 a case."""
    rng = np.random.default_rng(17)
    sizes = np.array([30, 12, 22, 9])[:n]
    common = np.array([4 + k for k in range(len(edges))])
    graph = path_graph(n, edges, sizes, common)
    law = exact_law(graph, structure, "share")
    crossover = Crossover(structure=structure, merge="share")
    draws, counts = 6000, dict.fromkeys(law, 0)
    for _ in range(draws):
        draw = crossover.resolve(rng, graph)
        counts[outcome(draw.group, draw.order)] += 1  # KeyError: an outcome that cannot be
    expected = np.array([draws * p for p in law.values()])
    observed = np.array([counts[k] for k in law])
    rare = expected < 5
    if rare.any():  # pooled
        expected = np.append(expected[~rare], expected[rare].sum())
        observed = np.append(observed[~rare], observed[rare].sum())
    assert stats.chi2.sf(((observed - expected) ** 2 / expected).sum(), len(expected) - 1) > 1e-5


def test_merge_probabilities():
    assert merge_probability("share", 5, 10, 20) == pytest.approx(1.0)
    assert merge_probability("share", 5, 20, 10) == pytest.approx(5 * 10 / 400)
    assert merge_probability("printed", 5, 20, 10) == pytest.approx(5 / 25 * 10 / 400)
    for rule in MERGE_RULES:
        p = merge_probability(rule, np.array([1, 5, 9]), np.array([9, 9, 9]), np.array([9, 30, 9]))
        assert ((p >= 0) & (p <= 1)).all()
    with pytest.raises(InputError, match="no merge rule"):
        merge_probability("maybe", 1, 2, 3)

"""Small trees for exact tests, and the transition matrix of a move rule."""

from __future__ import annotations

from math import exp

import numpy as np

from mstfilter.mst.segmentation.mh import AuthorsMoves, CutChain, CutState, MoveRule, NodeMoves, SubtreeRedraw
from mstfilter.mst.segmentation.tree import Tree


def random_tree(rng: np.random.Generator, n_leaves: int, most_children: int = 2) -> Tree:
    """Random merges of `n_leaves` one-pixel leaves, 2 .. most_children at a time."""
    parent = list(range(n_leaves))
    roots = list(range(n_leaves))
    while len(roots) > 1:
        k = min(len(roots), int(rng.integers(2, most_children + 1)))
        node = len(parent)
        parent.append(node)
        for child in rng.choice(roots, size=k, replace=False).tolist():
            parent[child] = node
            roots.remove(child)
        roots.append(node)
    n = len(parent)
    start = np.concatenate([np.zeros(n_leaves), np.sort(rng.random(n - n_leaves))])
    return Tree(np.array(parent), np.arange(n_leaves)[None], start)


def random_values(rng: np.random.Generator, tree: Tree) -> np.ndarray:
    """Negative values about as large for a parent as for its children together."""
    return -tree.area * rng.uniform(0.85, 1.15, tree.n_nodes)


def is_cut(tree: Tree, cut: np.ndarray) -> bool:
    """Whether a set of nodes covers every leaf exactly once."""
    covered = np.zeros(tree.n_leaves, dtype=np.int64)
    for node in np.asarray(cut).tolist():
        covered[tree.leaves_of(node)] += 1
    return bool((covered == 1).all())


def cuts_below(tree: Tree, node: int) -> list[list[int]]:
    """All cuts of the subtree of a node."""
    table: list[list[list[int]]] = []
    for i, children in enumerate(tree.children[: node + 1]):
        products: list[list[int]] = [[]]
        for child in children:
            products = [a + b for a in products for b in table[child]]
        table.append([[i], *(products if children else [])])
    return table[node]


def choices(rule: MoveRule, state: CutState) -> list[tuple[float, object]]:
    """All choices of a rule with their probabilities."""
    if isinstance(rule, NodeMoves):
        share = 0.5 / len(state.nodes)
        return [(share, (node, upward)) for node in state.nodes for upward in (False, True)]
    if isinstance(rule, AuthorsMoves):
        moves = rule.possible(state)
        return [(1 / len(moves), move) for move in moves] or [(1.0, None)]
    assert isinstance(rule, SubtreeRedraw)
    tree = rule.law.tree
    inner = range(tree.n_leaves, tree.n_nodes)
    if len(inner) == 0:
        return [(1.0, (tree.root, []))]
    return [
        (exp(rule.law.log_prob(cut, node)) / len(inner), (node, cut))
        for node in inner
        for cut in cuts_below(tree, node)
    ]


def all_cuts(tree: Tree) -> list[tuple[int, ...]]:
    """Every cut, as ascending tuples."""
    return [tuple(sorted(c)) for c in cuts_below(tree, tree.root)]


def target(tree: Tree, w: np.ndarray, sigma2: float) -> tuple[list[tuple[int, ...]], np.ndarray, float, float]:
    """All cuts with their probabilities under exp(-(v* - v)^2 / s2), written out; v* and s2."""
    cuts = all_cuts(tree)
    v = np.array([w[list(c)].sum() for c in cuts])
    s2 = sigma2 * v.max() ** 2
    p = np.exp(-((v.max() - v) ** 2) / s2)
    return cuts, p / p.sum(), float(v.max()), s2


def transition_matrix(tree: Tree, w: np.ndarray, best: float, s2: float, rule) -> np.ndarray:
    """Exact transition matrix over `all_cuts`, built from the code that the sampler runs."""
    cuts = all_cuts(tree)
    index = {c: i for i, c in enumerate(cuts)}
    T = np.zeros((len(cuts), len(cuts)))
    for i, cut in enumerate(cuts):
        chain = CutChain(tree, w, lambda v: -((best - v) ** 2) / s2, np.array(cut))
        for probability, choice in choices(rule, chain.state):
            move, _, log_ratio = chain.judge(rule, choice)
            accept = 0.0 if move is None else exp(min(0.0, log_ratio))
            T[i, i] += probability * (1 - accept)
            if move is not None:
                after = (set(cut) - set(move.removed)) | set(move.added)
                T[i, index[tuple(sorted(after))]] += probability * accept
    return T


def stationary(T: np.ndarray) -> np.ndarray:
    """Stationary law of a transition matrix."""
    n = len(T)
    A = np.vstack([T.T - np.eye(n), np.ones(n)])
    return np.linalg.lstsq(A, np.concatenate([np.zeros(n), [1.0]]), rcond=None)[0]


__all__ = ["all_cuts", "is_cut", "random_tree", "random_values", "stationary", "target", "transition_matrix"]

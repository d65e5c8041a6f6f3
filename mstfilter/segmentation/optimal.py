"""The best segmentation that a tree holds.

>>> cut = optimal_cut(tree, w)           # ascending nodes; maximises the sum of w over all cuts
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.errors import InputError
from mstfilter.segmentation.interfaces import CutSample, CutSampler
from mstfilter.segmentation.tree import Tree

__all__ = ["OptimalCut", "check_values", "optimal_cut"]


def check_values(tree: Tree, w: np.ndarray) -> np.ndarray:
    """Node values as float64 (N,), or an error that says what is wrong with them."""
    w = np.asarray(w, dtype=np.float64)
    if w.shape != (tree.n_nodes,):
        raise InputError(f"node values have shape {w.shape}, the tree has {tree.n_nodes} nodes")
    if not np.isfinite(w).all():
        raise InputError(f"value of tree node {int(np.flatnonzero(~np.isfinite(w))[0])} is not finite")
    return w


def optimal_cut(tree: Tree, w: np.ndarray) -> np.ndarray:
    """The cut of largest value, by one pass up the tree; where parent and children tie, the parent.

    Parameters
    ----------
    tree : Tree
    w : (N,) array
        Node values.

    Returns
    -------
    (n,) int array
        Ascending nodes of the cut.
    """
    best = check_values(tree, w).tolist()
    keep = [True] * tree.n_nodes
    for node in range(tree.n_leaves, tree.n_nodes):
        split = sum(best[child] for child in tree.child_tuples[node])
        # Sums of many terms: a split must win by more than their rounding.
        if split > best[node] + 1e-12 * abs(split):
            best[node], keep[node] = split, False
    cut, stack = [], [tree.root]
    while stack:
        node = stack.pop()
        if keep[node]:
            cut.append(node)
        else:
            stack.extend(tree.child_tuples[node])
    return np.sort(np.array(cut, dtype=np.int64))


@dataclass(frozen=True)
class OptimalCut(CutSampler):
    """No sampling: the optimal cut, `n` times. The single-frame baseline (SceneCut)."""

    def sample(self, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int) -> CutSample:
        """The optimal cut, `n` times; draws nothing."""
        cut = optimal_cut(tree, w)
        value = float(np.asarray(w, dtype=np.float64)[cut].sum())
        return CutSample((cut,) * n, np.full(n, value), np.zeros(n), {"size_of_best": len(cut)})

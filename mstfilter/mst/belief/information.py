"""Entropies and mutual information of weighted hypotheses, in nats.

How much would an action tell? Its expected information is the mutual information between the hypothesis and the
outcome. Under each hypothesis the action has one outcome, so this is simply the entropy of the distribution of the
outcomes. It is at most the entropy of the weights.

>>> import numpy as np
>>> rows = np.array([[1, 1, 0], [1, 1, 0], [0, 0, 0]])    # outcomes of three hypotheses in three groups of cells
>>> weights, sizes = np.array([0.25, 0.25, 0.5]), np.array([10, 5, 70])
>>> bool(np.isclose(outcome_information(weights, rows, hamming, sizes), np.log(2)))
True

**Tolerance.** This counts two outcomes as different even if they differ in one cell of 10,000, which no measurement
would show. A `tolerance` tau replaces the information by I_tau, where outcomes i and j differ in d_ij cells:

    ``I_tau = - sum_i w_i log sum_j w_j exp(-d_ij / tau)``

Outcomes that differ in far fewer than tau cells count as identical, those that differ in far more as different. I_0
is the information without noise, and I_tau decreases to 0 as tau grows. If every cell is measured with an independent
error of probability e, then I_tau with tau = -1 / log(2 sqrt(e (1 - e))) is a lower bound of the mutual information
of hypothesis and measurement (Kolchinsky and Tracey 2017, *Estimating mixture entropy with pairwise distances*, by
the Bhattacharyya distance).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import entr

from mstfilter.base.errors import check_number
from mstfilter.scene import canonical
from mstfilter.smc import first_seen


def entropy(probabilities: np.ndarray) -> float:
    """Entropy ``-sum p log p`` of probabilities (k,) that sum to one."""
    return max(0.0, float(entr(probabilities).sum()))


def binary_entropy(p: np.ndarray) -> np.ndarray:
    """Entropy ``-p log p - (1 - p) log(1 - p)`` of each probability; at most log 2."""
    p = np.clip(p, 0.0, 1.0)  # sums of weights may exceed 1 by rounding
    return np.asarray(entr(p) + entr(1 - p))


def outcome_information(
    weights: np.ndarray,
    outcomes: np.ndarray,
    distances: Callable[[np.ndarray, np.ndarray], np.ndarray],
    sizes: np.ndarray,
    tolerance: float = 0.0,
) -> float:
    """Information of an outcome that the hypothesis determines.

    Parameters
    ----------
    weights : (n,) float
        Sum 1.
    outcomes : (n, k) integer
        The outcome of each hypothesis in each group of cells. Identical rows are the same outcome.
    distances : callable
        ``distances(distinct outcomes, sizes)`` returns (d, d) numbers of cells that differ. Unused for tolerance 0.
    sizes : (k,) int
        Number of cells in each group.
    tolerance : float
        Tolerance tau in the formula of the module, in cells.
    """
    check_number("tolerance", tolerance, at_least=0, unit="number of voxels or pixels")
    which = first_seen(row.tobytes() for row in np.ascontiguousarray(outcomes))
    mass = np.bincount(which, weights)
    if tolerance == 0 or len(mass) == 1:
        return entropy(mass)
    distinct = outcomes[np.unique(which, return_index=True)[1]]
    nearness = np.exp(-distances(distinct, sizes) / tolerance)
    return max(0.0, float(-(mass * np.log(nearness @ mass)).sum()))


def hamming(rows: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Number (n, n) of cells in which pairs of outcomes (n, k) differ, for k groups of `sizes` cells."""
    return np.stack([(rows != row) @ sizes.astype(np.float64) for row in rows])


def canonical_rows(rows: np.ndarray) -> np.ndarray:
    """Partitions (n, k) with parts numbered in order of first cells; 0 is free. Equal rows are equal partitions."""
    return np.stack([canonical(row) for row in rows]) if rows.size else rows


def partition_distance(rows: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Least number (n, n) of cells that must change their object to make two partitions equal.

    ``d_ij = sum_c size_c [c is occupied in i or j] - max sum_k |A_k cap B_m(k)|``. A_k are the objects of partition i
    and B_k the objects of partition j. The maximum is over one-to-one matchings m of objects (Gusfield 2002,
    *Partition-distance*). `rows` (n, k) are `canonical_rows` of k groups of `sizes` cells.
    """
    n, width = len(rows), int(rows.max(initial=0)) + 1
    distance = np.zeros((n, n))
    for i in range(n):
        for j in range(i):
            table = np.bincount(rows[i].astype(np.int64) * width + rows[j], sizes, width * width)
            counts = table.reshape(width, width)
            kept = counts[1:, 1:][linear_sum_assignment(counts[1:, 1:], maximize=True)].sum()
            distance[i, j] = distance[j, i] = counts.sum() - counts[0, 0] - kept
    return distance

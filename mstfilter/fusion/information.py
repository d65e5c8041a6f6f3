"""Entropies and mutual information of a few weighted hypotheses, in nats, and their common refinement.

An action has one outcome under each hypothesis. Its expected information is the mutual information between the
hypothesis I and the outcome O,

    I(I; O) = H(O) - sum_i w_i H(O | I = i),

which is at most H(I). If the hypothesis determines the outcome, the second term is 0 and the information is the
entropy of the weights summed over equal outcomes.

>>> import numpy as np
>>> rows = np.array([[1, 1, 0], [1, 1, 0], [0, 0, 0]])    # outcomes of three hypotheses in three groups of cells
>>> weights, sizes = np.array([0.25, 0.25, 0.5]), np.array([10, 5, 70])
>>> float(outcome_information(weights, rows, hamming, sizes)) == np.log(2)
True

**Tolerance.** Without noise, two outcomes that differ in one cell of 10,000 are different. With `tolerance` tau

    I_tau = - sum_i w_i log sum_j w_j exp(-d_ij / tau),      d_ij = number of cells in which outcomes i and j differ,

decreases from the information without noise (tau = 0, exact) to 0: outcomes that differ in far fewer than tau cells
count as one, those that differ in far more count as two. If every cell is read with an independent error of
probability e, then I_tau with tau = -1 / log(2 sqrt(e (1 - e))) is a lower bound of the mutual information with the
reading (Kolchinsky, Tracey 2017, *Estimating mixture entropy with pairwise distances*, with the Bhattacharyya
distance).

**Common refinement.** A cell holds the voxels (or pixels) that belong to the same object in every segmentation. There
are far fewer cells than voxels, and a query about objects has the same answer for all voxels of a cell.

>>> both = common_refinement([np.array([0, 1, 1, 2]), np.array([0, 7, 7, 7])])
>>> both.cells, both.sizes
(array([0, 1, 1, 2]), array([1, 2, 1]))
>>> both.objects                       # numbered over both segmentations
array([[0, 1, 2],
       [0, 3, 3]])
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from mstfilter.errors import InputError
from mstfilter.fusion.similarity import canonical
from mstfilter.smc import first_seen


def entropy(probabilities: np.ndarray) -> float:
    """``-sum p log p`` of probabilities (k,) that sum to one."""
    p = probabilities[probabilities > 0]
    return max(0.0, float(-(p * np.log(p)).sum()))


def binary_entropy(p: np.ndarray) -> np.ndarray:
    """``-p log p - (1 - p) log(1 - p)`` of each probability; at most log 2."""
    p = np.clip(p, 0.0, 1.0)  # sums of weights may exceed 1 by rounding
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(p > 0, p * np.log(p), 0.0) + np.where(p < 1, (1 - p) * np.log1p(-p), 0.0)
    return np.maximum(-terms, 0.0)


def noisy_information(weights: np.ndarray, channel: np.ndarray) -> float:
    """Mutual information with a noisy outcome.

    Parameters
    ----------
    weights : (n,) float
        Sum 1.
    channel : (n, k) float
        Probability of each of k outcomes under each hypothesis; rows sum to 1.
    """
    conditional = sum(w * entropy(row) for w, row in zip(weights, channel, strict=True))
    return max(0.0, entropy(weights @ channel) - conditional)


def outcome_information(
    weights: np.ndarray,
    outcomes: np.ndarray,
    distances: Callable[[np.ndarray, np.ndarray], np.ndarray],
    sizes: np.ndarray,
    tolerance: float = 0.0,
) -> float:
    """Information of an outcome that each hypothesis determines; the module explains the tolerance.

    Parameters
    ----------
    weights : (n,) float
        Sum 1.
    outcomes : (n, k) integer
        The outcome of each hypothesis in each group of cells. Equal rows are equal outcomes.
    distances : callable
        ``distances(distinct outcomes, sizes)`` gives (d, d) numbers of cells; called only if `tolerance` > 0.
    sizes : (k,) int
        Cells in each group.
    tolerance : float
        Cells.
    """
    which = first_seen(row.tobytes() for row in np.ascontiguousarray(outcomes))
    mass = np.bincount(which, weights)
    if tolerance == 0 or len(mass) == 1:
        return entropy(mass)
    distinct = outcomes[np.unique(which, return_index=True)[1]]
    nearness = np.exp(-distances(distinct, sizes) / tolerance)
    return max(0.0, float(-(mass * np.log(nearness @ mass)).sum()))


def hamming(rows: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Number (n, n) of cells in which outcomes (n, k) differ, for k groups of `sizes` cells."""
    return np.stack([(rows != row) @ sizes.astype(np.float64) for row in rows])


def canonical_rows(rows: np.ndarray) -> np.ndarray:
    """Partitions (n, k), 0 for free, with parts numbered by their first cell: equal rows are equal partitions."""
    return np.stack([canonical(row) for row in rows]) if rows.size else rows


def partition_distance(rows: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Least number (n, n) of cells that must change their object to make two partitions equal.

    ``d_ij = sum_c size_c [c is occupied in i or j] - max sum_k |A_k cap B_m(k)|``, A and B the objects of i and j,
    the maximum over one-to-one matchings m (Gusfield 2002, *Partition-distance*, with free space as a part that
    matches free space only).

    Parameters
    ----------
    rows : (n, k) integer
        Canonical partitions of k groups of cells.
    sizes : (k,) int
    """
    n, width = len(rows), int(rows.max(initial=0)) + 1
    found = np.zeros((n, n))
    for i in range(n):
        for j in range(i):
            table = np.bincount(rows[i].astype(np.int64) * width + rows[j], sizes, width * width)
            counts = table.reshape(width, width)
            kept = counts[1:, 1:][linear_sum_assignment(counts[1:, 1:], maximize=True)].sum()
            found[i, j] = found[j, i] = counts.sum() - counts[0, 0] - kept
    return found


def check_tolerance(tolerance: float) -> float:
    """The tolerance as a float; raises InputError if it is not a finite number >= 0."""
    try:
        value = float(tolerance)
    except (TypeError, ValueError):
        value = -1.0
    if not (0 <= value < np.inf):
        raise InputError(f"tolerance is {tolerance!r}, expected a number of voxels or pixels, 0 or more")
    return value


@dataclass(frozen=True, eq=False)
class CommonRefinement:
    """Cells of several segmentations, and the objects that they belong to.

    Parameters
    ----------
    cells : int array of the segmentations' shape
        The cell of every position. Cell 0 is free in all segmentations and may be empty.
    objects : (n, k) int
        Object of each of k cells in each of n segmentations; 0 is free. Objects are numbered from 1 over all
        segmentations, so different segmentations have different objects.
    sizes : (k,) int
        Positions in each cell.
    first : (n + 1,) int
        Segmentation i has the objects first[i] + 1 .. first[i + 1].
    """

    cells: np.ndarray
    objects: np.ndarray
    sizes: np.ndarray
    first: np.ndarray

    @property
    def n_objects(self) -> int:
        """Number of objects of all segmentations."""
        return int(self.first[-1])

    def objects_in(self, cells: np.ndarray) -> np.ndarray:
        """Whether each object (n_objects + 1,) has one of these cells; False for 0, free."""
        present = np.zeros(self.n_objects + 1, bool)
        present[self.objects[:, cells]] = True
        present[0] = False
        return present

    def overlaps(self) -> np.ndarray:
        """Positions (n_objects + 1, n_objects + 1) that two objects share; row and column 0 (free) are 0."""
        total = self.n_objects + 1
        found = np.zeros((total, total))
        sizes = np.broadcast_to(self.sizes, self.objects.shape).ravel()
        for own, below, above in zip(self.objects, self.first, self.first[1:], strict=False):
            codes = np.where(own > 0, own - below, 0) * total + self.objects
            counts = np.bincount(codes.ravel(), sizes, (above - below + 1) * total).reshape(-1, total)
            found[below + 1 : above + 1, 1:] = counts[1:, 1:]
        return found


def common_refinement(segmentations: Sequence[np.ndarray]) -> CommonRefinement:
    """The common refinement of n label arrays of one shape, 0 is free."""
    occupied = np.logical_or.reduce([labels != 0 for labels in segmentations])
    count = int(occupied.sum())
    cell = np.zeros(count, np.int64)
    numbered = []
    first = np.zeros(len(segmentations) + 1, np.int64)
    for i, labels in enumerate(segmentations):
        present, compact = _compact(labels[occupied])
        numbered.append(np.where(compact > 0, compact + first[i], 0))
        first[i + 1] = first[i] + present
        cell = _compact(cell * (present + 1) + compact + 1)[1] - 1  # + 1: no code is 0, the free one
    k = int(cell.max(initial=-1)) + 2
    cells = np.zeros(occupied.shape, np.int64)
    cells[occupied] = cell + 1
    example = np.zeros(k, np.int64)
    example[cell + 1] = np.arange(count)
    objects = np.zeros((len(segmentations), k), np.int64)
    for row, own in zip(objects, numbered, strict=True):
        row[1:] = own[example[1:]]
    return CommonRefinement(cells, objects, np.bincount(cells.ravel(), minlength=k), first)


def _compact(codes: np.ndarray) -> tuple[int, np.ndarray]:
    """The number of different codes other than 0, and the codes renumbered 1, 2, ... in ascending order; 0 stays."""
    codes = codes.astype(np.int64)
    top = int(codes.max(initial=0))
    if top > 64 * len(codes) + 1024:  # a table would be mostly empty
        present, compact = np.unique(codes, return_inverse=True)
        free = int(len(present) > 0 and present[0] == 0)
        return len(present) - free, compact + 1 - free
    table = np.zeros(top + 1, np.int64)
    table[codes] = 1
    table[0] = 0
    return int(table.sum()), np.cumsum(table)[codes]

"""Which object a voxel belongs to when several claim it.

1. A voxel with readings belongs to the object that most of them show.
2. Otherwise to the one that is most probable there, if that reaches the threshold.
3. Otherwise to the one whose visible surface is nearest.

The order in which objects are listed plays no part: renumbering them renumbers the result.

>>> labels = arbitrate(completions, grid)        # (X, Y, Z) uint16, k + 1 for the k-th completion
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mstfilter.completion.completer import Completion
from mstfilter.scene import VoxelGrid

__all__ = ["arbitrate"]


def arbitrate(completions: Sequence[Completion], grid: VoxelGrid, threshold: float = 0.5) -> np.ndarray:
    """Label grid of several completions.

    Parameters
    ----------
    completions : sequence of Completion
        Of one hypothesis: their masks are disjoint.
    grid : VoxelGrid
        The grid they were made for.
    threshold : float
        Least probability of a voxel to be occupied.

    Returns
    -------
    (X, Y, Z) uint16
        0 free, k + 1 the k-th completion.
    """
    labels = np.zeros(grid.shape, dtype=np.uint16)
    most = np.zeros(grid.shape, dtype=np.int32)
    best = np.zeros(grid.shape, dtype=np.float32)
    tied = np.zeros(grid.shape, dtype=bool)
    for k, one in enumerate(completions):
        box = one.box
        p = np.where(one.probability >= threshold, one.probability, 0).astype(np.float32)
        claims = p > 0
        points = np.where(claims, one.points, 0)
        more = (points > most[box]) | ((points == most[box]) & (p > best[box]))
        equal = claims & (points == most[box]) & (p == best[box])
        tied[box] = (tied[box] | equal) & ~more
        labels[box][more] = k + 1
        most[box][more] = points[more]
        best[box][more] = p[more]
    if tied.any():
        _settle(labels, tied, most, best, completions, threshold)
    return labels


def _settle(
    labels: np.ndarray,
    tied: np.ndarray,
    most: np.ndarray,
    best: np.ndarray,
    completions: Sequence[Completion],
    threshold: float,
) -> None:
    """Give the tied voxels to the nearest visible surface; what is equally far, to the lesser content key."""
    from scipy.spatial import cKDTree

    voxels = np.argwhere(tied)
    at = tuple(voxels.T)
    nearest = np.full(len(voxels), np.inf)
    taken = np.zeros(len(voxels), dtype=bool)
    for k in sorted(range(len(completions)), key=lambda k: completions[k].key):
        one = completions[k]
        local = voxels - one.offset
        inside = ((local >= 0) & (local < one.probability.shape)).all(axis=1)
        here = np.flatnonzero(inside)
        if len(here) == 0:
            continue
        place = tuple(local[here].T)
        p = one.probability[place]
        points = np.where(p >= threshold, one.points[place], 0)
        contends = (p >= threshold) & (p == best[at][here]) & (points == most[at][here])
        here = here[contends]
        if len(here) == 0:
            continue
        distance = np.full(len(here), np.inf)
        if (one.points > 0).any():
            distance, _ = cKDTree(np.argwhere(one.points > 0) + one.offset).query(voxels[here])
        nearer = ~taken[here] | (distance < nearest[here] - 1e-9)
        nearest[here[nearer]] = distance[nearer]
        taken[here[nearer]] = True
        labels[tuple(voxels[here[nearer]].T)] = k + 1

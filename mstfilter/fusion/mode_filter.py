"""Consensus by majority in a window: removes speckle that crossover leaves (paper, section IV-D).

>>> ModeFilter(window=5, margin=3).apply(labels)

For an occupied voxel, the most frequent label of the window takes it over if it occurs at least `margin` times
more often than the voxel's own (ties go to the larger label; free space never takes over); an occupied voxel
with more than `isolation` free cells in its window becomes free. All voxels change at once, sweep after sweep,
until nothing changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene.voxels import as_labels

__all__ = ["ModeFilter"]


@dataclass(frozen=True)
class ModeFilter:
    """Majority filter over label grids.

    Parameters
    ----------
    window : int
        Edge of the cubic window in voxels, odd. 1 switches the filter off.
    margin : int
        By how many cells another label must win.
    isolation : int
        More free cells than this in the window set a voxel free. A value of at least ``window**3`` never does.
    max_sweeps : int
        Bound on the number of sweeps.
    scope : {"everywhere", "disputed"}
        Which voxels may change: all, or only those that fusion hands over as disputed between the two parents.
        The filter everywhere erases whatever is thinner than half a window: a 2 cm book or a rod.
    """

    window: int = 5
    margin: int = 3
    isolation: int = 120
    max_sweeps: int = 100
    scope: Literal["everywhere", "disputed"] = "everywhere"

    def __post_init__(self) -> None:
        if self.window < 1 or self.window % 2 == 0:
            raise InputError(f"mode filter window is {self.window}, expected an odd number of voxels")
        if self.max_sweeps < 1:
            raise InputError(f"mode filter has max_sweeps {self.max_sweeps}, expected at least 1")
        if self.scope not in ("everywhere", "disputed"):
            raise InputError(f'mode filter scope is {self.scope!r}, expected "everywhere" or "disputed"')

    def apply(self, labels: np.ndarray, disputed: np.ndarray | None = None) -> np.ndarray:
        """Filtered labels (X, Y, Z) uint16.

        Parameters
        ----------
        labels : (X, Y, Z) integer
            0 is free.
        disputed : (X, Y, Z) bool, optional
            Used where `scope` is "disputed"; no other voxel changes then.
        """
        labels = as_labels(labels)
        may_change = labels != 0
        if self.scope == "disputed":
            may_change = may_change & disputed if disputed is not None else np.zeros_like(may_change)
        if self.window == 1 or not may_change.any():
            return labels
        # Work inside the box that sweeps can touch.
        half = self.window // 2
        where = np.nonzero(may_change)
        box = tuple(
            slice(max(int(w.min()) - half, 0), min(int(w.max()) + half + 1, n))
            for w, n in zip(where, labels.shape, strict=True)
        )
        out = labels.copy()
        part, allowed = out[box], may_change[box]
        for _ in range(self.max_sweeps):
            swept = self._sweep(part, allowed, labels.shape, box)
            if np.array_equal(swept, part):
                break
            part = swept
        out[box] = part
        return out

    def _sweep(
        self,
        labels: np.ndarray,
        allowed: np.ndarray,
        shape: tuple[int, ...],
        box: tuple[slice, ...],
    ) -> np.ndarray:
        half = self.window // 2
        best = np.zeros(labels.shape, np.int32)
        winner = np.zeros(labels.shape, np.uint16)
        own = np.zeros(labels.shape, np.int32)
        occupied = _window_sum(labels != 0, half)
        for label in np.flatnonzero(np.bincount(labels.ravel()))[::-1]:
            if label == 0:
                continue
            mask = labels == label
            reach = _reach(mask, half)
            count = _window_sum(mask[reach], half)
            better = count > best[reach]  # descending labels: a tie stays with the larger one
            best[reach] = np.where(better, count, best[reach])
            winner[reach] = np.where(better, label, winner[reach])
            own[reach] = np.where(mask[reach], count, own[reach])
        take = allowed & (labels != 0) & (winner != labels) & (best >= own + self.margin)
        out = np.where(take, winner, labels)
        free = _window_cells(labels.shape, half, shape, box) - occupied
        out[allowed & (labels != 0) & (free > self.isolation)] = 0
        return out


def _reach(mask: np.ndarray, half: int) -> tuple[slice, ...]:
    """The box of a mask, grown by half a window."""
    box = []
    for axis in range(3):
        hit = np.flatnonzero(mask.any(axis=tuple(a for a in range(3) if a != axis)))
        box.append(slice(max(int(hit[0]) - half, 0), min(int(hit[-1]) + half + 1, mask.shape[axis])))
    return tuple(box)


def _window_sum(mask: np.ndarray, half: int) -> np.ndarray:
    """Number of True cells in the window of every cell; cells outside count nothing."""
    total = mask.astype(np.int32)
    for axis in range(3):
        n = total.shape[axis]
        padded = np.concatenate([np.zeros_like(total.take([0], axis)), np.cumsum(total, axis=axis)], axis=axis)
        high = np.minimum(np.arange(n) + half + 1, n)
        low = np.maximum(np.arange(n) - half, 0)
        total = padded.take(high, axis) - padded.take(low, axis)
    return total


def _window_cells(part: tuple[int, ...], half: int, shape: tuple[int, ...], box: tuple[slice, ...]) -> np.ndarray:
    """Number of cells of the whole grid in the window of every cell of the box."""
    sides = []
    for n, size, where in zip(part, shape, box, strict=True):
        index = np.arange(n) + where.start
        sides.append(np.minimum(index + half + 1, size) - np.maximum(index - half, 0))
    return sides[0][:, None, None] * sides[1][None, :, None] * sides[2][None, None, :]

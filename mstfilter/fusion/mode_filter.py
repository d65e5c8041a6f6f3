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
from mstfilter.scene import as_labels

__all__ = ["ModeFilter"]

_CHUNK = 2**19  # cells of windows that are looked at together: they fit in the cache


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
        for name in ("window", "margin", "isolation", "max_sweeps"):
            if not isinstance(getattr(self, name), (int, np.integer)):
                raise InputError(f"mode filter {name} is {getattr(self, name)!r}, expected a whole number")
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
        if labels.ndim != 3:
            raise InputError(f"label grid has shape {labels.shape}, the mode filter expects three axes")
        may_change = labels != 0
        if disputed is not None and (disputed.shape != labels.shape or disputed.dtype != bool):
            raise InputError(
                f"disputed is {disputed.dtype} of shape {disputed.shape}, expected bool of shape {labels.shape}"
            )
        if self.scope == "disputed":
            may_change = may_change & disputed if disputed is not None else np.zeros_like(may_change)
        if self.window == 1 or not may_change.any():
            return labels
        # Work inside the box that sweeps can touch, with a border of free cells so that every window is whole.
        half = self.window // 2
        where = np.nonzero(may_change)
        box = tuple(
            slice(max(int(w.min()) - half, 0), min(int(w.max()) + half + 1, n))
            for w, n in zip(where, labels.shape, strict=True)
        )
        part = np.pad(np.ascontiguousarray(labels[box]), half)  # C order whatever comes in
        at = np.ravel_multi_index([w - b.start + half for w, b in zip(where, box, strict=True)], part.shape)
        votes = _Votes(self, part, at, _window_cells(where, labels.shape, half))
        changed = votes.sweep(votes.unsettled())
        for _ in range(self.max_sweeps - 1):
            if not len(changed):
                break
            changed = votes.sweep(votes.beside(changed))
        out = labels.copy()
        out[box] = part[(slice(half, -half),) * 3]
        return out


class _Votes:
    """A label grid under the filter, swept in place.

    A voxel in whose window nothing has changed since the last sweep votes as it did then: only the first sweep looks
    at all voxels, and of these only at those whose window holds another object or much free space.

    Parameters
    ----------
    filter : ModeFilter
    labels : (X, Y, Z) uint16
        With a border of half a window, in C order. Is written to.
    at : (n,) int
        Flat indices of the voxels that may change.
    cells : (n,) int
        Cells of each one's window that lie in the grid.
    """

    def __init__(self, filter: ModeFilter, labels: np.ndarray, at: np.ndarray, cells: np.ndarray) -> None:
        self.filter, self.labels, self.flat, self.at, self.cells = filter, labels, labels.reshape(-1), at, cells
        steps = np.indices((filter.window,) * 3).reshape(3, -1) - filter.window // 2
        self.offsets = np.array(labels.strides) // labels.itemsize @ steps
        self.count_type = np.min_scalar_type(len(self.offsets))
        self.chunk = max(1, _CHUNK // len(self.offsets))

    def unsettled(self) -> np.ndarray:
        """Positions in `at` of voxels that a sweep might change."""
        window, half = self.filter.window, self.filter.window // 2
        inner = self.labels[(slice(half, -half),) * 3]
        below = self.labels - np.uint16(1)  # free becomes the largest: the smallest label of a window is an object's
        mixed = _over_window(np.maximum, self.labels, window) != inner
        mixed |= _over_window(np.minimum, below, window) != below[(slice(half, -half),) * 3]
        taken = _over_window(np.add, (self.labels != 0).astype(self.count_type), window)
        inside = np.zeros(self.labels.shape, bool)
        inside[(slice(half, -half),) * 3] = mixed
        counts = np.zeros(self.labels.shape, self.count_type)
        counts[(slice(half, -half),) * 3] = taken
        free = self.cells - counts.reshape(-1)[self.at]
        return np.flatnonzero(inside.reshape(-1)[self.at] | (free > self.filter.isolation))

    def beside(self, changed: np.ndarray) -> np.ndarray:
        """Positions in `at` of occupied voxels whose window holds one of the cells `changed` (flat indices)."""
        touched = np.zeros(self.flat.shape, bool)
        for k in range(0, len(changed), self.chunk):
            touched[changed[k : k + self.chunk, None] + self.offsets] = True
        return np.flatnonzero(touched[self.at] & (self.flat[self.at] != 0))

    def sweep(self, positions: np.ndarray) -> np.ndarray:
        """All voxels at these positions vote at once; flat indices of those that changed."""
        at, cells = self.at[positions], self.cells[positions]
        new = np.empty(len(at), np.uint16)
        for k in range(0, len(at), self.chunk):
            new[k : k + self.chunk] = self._elected(at[k : k + self.chunk], cells[k : k + self.chunk])
        differ = new != self.flat[at]
        self.flat[at[differ]] = new[differ]
        return at[differ]

    def _elected(self, at: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Labels (m,) after the vote of voxels `at` (m,) with `cells` (m,) grid cells in their windows."""
        windows = self.flat[at + self.offsets[:, None]]
        own = self.flat[at]
        is_own = windows == own
        own_count = self._count(is_own)
        taken = self._count(windows != 0)
        out = own.copy()
        # Only where the others together would win need they be told apart.
        open_ = np.flatnonzero(taken - own_count >= own_count + self.filter.margin)
        others = windows[:, open_] * ~is_own[:, open_]
        left = (taken - own_count)[open_]
        best, winner = np.zeros(len(own), np.int64), np.zeros(len(own), np.uint16)
        while True:  # label by label, the largest first: a tie stays with it
            going = left > best[open_]
            open_, left, others = open_[going], left[going], others[:, going]
            if not len(open_):
                break
            top = others.max(axis=0)
            is_top = others == top
            count = self._count(is_top)
            ahead = count > best[open_]
            best[open_[ahead]], winner[open_[ahead]] = count[ahead], top[ahead]
            left = left - count
            others *= ~is_top
        wins = (best > own_count) | ((best == own_count) & (winner > own))
        wins &= best >= own_count + self.filter.margin
        out[wins] = winner[wins]
        out[cells - taken > self.filter.isolation] = 0
        return out

    def _count(self, hit: np.ndarray) -> np.ndarray:
        """(m,) how many of the window's cells are True in (cells, m)."""
        return hit.sum(axis=0, dtype=self.count_type).astype(np.int64)


def _over_window(function: np.ufunc, cells: np.ndarray, window: int) -> np.ndarray:
    """`function` over the window of every cell that has a whole one: each axis is shorter by ``window - 1``."""
    for axis in range(3):
        n = cells.shape[axis] - window + 1
        along = np.moveaxis(cells, axis, 0)
        out = along[:n].copy()
        for k in range(1, window):
            function(out, along[k : k + n], out=out)
        cells = np.moveaxis(out, 0, axis)
    return cells


def _window_cells(at: tuple[np.ndarray, ...], shape: tuple[int, ...], half: int) -> np.ndarray:
    """Number of grid cells in the window of every voxel `at`."""
    sides = [np.minimum(w + half + 1, n) - np.maximum(w - half, 0) for w, n in zip(at, shape, strict=True)]
    return np.asarray(sides[0] * sides[1] * sides[2])

"""The mode filter, which removes speckle from painted labels (the authors' program; paper, section IV-D).

>>> smooth = ModeFilter(window=5, margin=3).apply(labels)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Annotated

import numpy as np
from scipy import ndimage

from mstfilter.base.errors import InputError
from mstfilter.base.fields import Bounded, Bounds, NonNegativeInt, PositiveInt
from mstfilter.scene import as_labels, occupied_box


@dataclass(frozen=True)
class ModeFilter(Bounded):
    """Majority filter over label grids.

    An occupied voxel takes the most frequent other label in its window (of equally frequent ones, the largest), if
    there are at least `margin` more of it than of its own. Free voxels do not count as a label, but an occupied voxel
    with more than `isolation` of them in its window becomes free. All voxels of a sweep change at the same time, and
    sweeps are repeated until none does. So objects thinner than half a window, for example a 2 cm book or a rod, are
    removed.

    Parameters
    ----------
    window : int
        Edge of the cubic window in voxels, an odd number. A window of 1 has no effect.
    margin : float
        By how many voxels the other label must at least outnumber the voxel's own.
    isolation : int
        Largest number of free voxels in the window of an occupied voxel. With more, it becomes free, so a number of
        at least ``window**3`` has no effect.
    max_sweeps : int
        Largest number of sweeps.
    """

    window: PositiveInt = 5
    margin: Annotated[float, Bounds()] = 3.0
    isolation: NonNegativeInt = 120
    max_sweeps: PositiveInt = 100

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window % 2 == 0:
            raise InputError(f"mode filter window is {self.window}, expected an odd number of voxels")

    def apply(self, labels: np.ndarray) -> np.ndarray:
        """Filtered labels (X, Y, Z) uint16, 0 is free."""
        labels = as_labels(labels)
        if labels.ndim != 3:
            raise InputError(f"label grid has shape {labels.shape}, the mode filter expects three axes")
        reach = occupied_box(labels != 0)  # voxels that may change
        if self.window == 1 or reach is None:
            return labels
        # Windows at the faces of the grid have fewer cells.
        cells = reduce(np.multiply.outer, (_window_sums(np.ones(n, np.int32), self.window) for n in labels.shape))
        out = labels.copy()
        for _ in range(self.max_sweeps):
            around = self._grown(reach, labels.shape)
            inside = tuple(slice(r.start - a.start, r.stop - a.start) for r, a in zip(reach, around, strict=True))
            swept = self._swept(out[around], cells[around])[inside]
            changed = occupied_box(swept != out[reach])
            out[reach] = swept
            if changed is None:
                break
            # A voxel can change again only if a cell in its window has changed.
            changed = tuple(slice(r.start + c.start, r.start + c.stop) for r, c in zip(reach, changed, strict=True))
            reach = self._grown(changed, labels.shape)
        return out

    def _grown(self, box: tuple[slice, ...], shape: tuple[int, ...]) -> tuple[slice, ...]:
        """The box of all cells whose window contains a cell of `box`."""
        half = self.window // 2
        return tuple(slice(max(s.start - half, 0), min(s.stop + half, n)) for s, n in zip(box, shape, strict=True))

    def _swept(self, labels: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Labels after one sweep of the filter. `cells` is the number of grid cells in the window of each voxel."""
        own, best = np.zeros(labels.shape, np.int32), np.zeros(labels.shape, np.int32)
        winner = np.zeros_like(labels)
        for label, box in enumerate(ndimage.find_objects(labels), start=1):
            if box is None:
                continue
            near = self._grown(box, labels.shape)
            inside = labels[near] == label
            count = self._window_counts(inside)
            own[near][inside] = count[inside]
            winner[near] = np.where(count >= best[near], label, winner[near])  # the larger label of a tie
            best[near] = np.maximum(best[near], count)
        occupied = labels != 0
        out = np.where(occupied & (best >= own + self.margin), winner, labels)
        out[occupied & (cells - self._window_counts(occupied) > self.isolation)] = 0
        return out

    def _window_counts(self, hit: np.ndarray) -> np.ndarray:
        """The number (X, Y, Z) int32 of True cells in the window of each cell. Cells beyond the array are False."""
        count = hit.astype(np.int32)
        for axis in range(3):
            count = _window_sums(count.swapaxes(0, axis), self.window).swapaxes(0, axis)
        return count


def _window_sums(values: np.ndarray, window: int) -> np.ndarray:
    """Sums over centred windows along the first axis."""
    total = values.copy()
    for k in range(1, window // 2 + 1):
        total[k:] += values[:-k]
        total[:-k] += values[k:]
    return total

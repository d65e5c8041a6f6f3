"""The mode filter, which removes the speckle that painting leaves (the authors' program; paper, section IV-D).

>>> smooth = ModeFilter(window=5, margin=3).apply(labels)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
from scipy import ndimage

from mstfilter.errors import InputError, check_integer, check_number
from mstfilter.scene import as_labels, occupied_box


@dataclass(frozen=True)
class ModeFilter:
    """Majority filter over label grids.

    The label of an occupied voxel is replaced by the most frequent other label in its window, if the count of this
    label exceeds that of its own by at least `margin`. Of equally frequent labels the larger one is used. Free cells
    are not counted as a label, but an occupied voxel with more than `isolation` free cells in its window becomes
    free. All voxels of a sweep change at the same time. Sweeps are repeated until no voxel changes. Objects that are
    thinner than half a window, for example a 2 cm book or a rod, are removed.

    Parameters
    ----------
    window : int
        Edge of the cubic window in voxels, odd. 1 switches the filter off.
    margin : int
        Least difference of the counts of the other label and the voxel's own label.
    isolation : int
        Largest number of free cells in the window of an occupied voxel; with more it becomes free. No effect if at
        least ``window**3``.
    max_sweeps : int
        Largest number of sweeps.
    """

    window: int = 5
    margin: int = 3
    isolation: int = 120
    max_sweeps: int = 100

    def __post_init__(self) -> None:
        check_integer("mode filter window", self.window)
        check_integer("mode filter isolation", self.isolation, at_least=0)
        check_integer("mode filter max_sweeps", self.max_sweeps)
        check_number("mode filter margin", self.margin)
        if self.window % 2 == 0:
            raise InputError(f"mode filter window is {self.window}, expected an odd number of voxels")

    def apply(self, labels: np.ndarray) -> np.ndarray:
        """Filtered labels (X, Y, Z) uint16, 0 is free."""
        labels = as_labels(labels)
        if labels.ndim != 3:
            raise InputError(f"label grid has shape {labels.shape}, the mode filter expects three axes")
        box = occupied_box(labels != 0)
        if self.window == 1 or box is None:
            return labels
        # Windows at the faces of the grid have fewer cells.
        along = [_window_sums(np.ones(n, np.int32), self.window, 0) for n in labels.shape]
        cells = reduce(np.multiply.outer, (cells[s] for cells, s in zip(along, box, strict=True)))
        out = labels.copy()
        for _ in range(self.max_sweeps):
            swept = self._swept(out[box], cells)
            if np.array_equal(swept, out[box]):
                break
            out[box] = swept
        return out

    def _swept(self, labels: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Labels after one sweep; `cells` is the number of grid cells in the window of each voxel."""
        own, best = np.zeros(labels.shape, np.int32), np.zeros(labels.shape, np.int32)
        winner = np.zeros_like(labels)
        for label, box in enumerate(ndimage.find_objects(labels), start=1):
            if box is None:
                continue
            near = tuple(slice(max(s.start - self.window // 2, 0), s.stop + self.window // 2) for s in box)
            inside = labels[near] == label
            count = self._window_counts(inside)
            own[near][inside] = count[inside]
            ahead = count >= best[near]  # labels ascend, so a tie goes to the larger one
            best[near][ahead], winner[near][ahead] = count[ahead], label
        occupied = labels != 0
        out = np.where(occupied & (best >= own + self.margin), winner, labels)
        out[occupied & (cells - self._window_counts(occupied) > self.isolation)] = 0
        return out

    def _window_counts(self, hit: np.ndarray) -> np.ndarray:
        """Number (X, Y, Z) int32 of True cells in the window of each cell; none lie beyond the array."""
        return reduce(lambda count, axis: _window_sums(count, self.window, axis), range(3), hit.astype(np.int32))


def _window_sums(values: np.ndarray, window: int, axis: int) -> np.ndarray:
    """Sums over windows along an axis."""
    return ndimage.correlate1d(values, np.ones(window), axis, mode="constant")

"""The common refinement of several segmentations: cells that no segmentation cuts.

A cell holds the voxels (or pixels) that belong to the same object as one another in every segmentation. There are far
fewer cells than voxels, and every question about objects has one answer a cell.

>>> import numpy as np
>>> both = refine([np.array([0, 1, 1, 2]), np.array([0, 7, 7, 7])])
>>> both.cells, both.sizes
(array([0, 1, 1, 2]), array([1, 2, 1]))
>>> both.objects                       # numbered through: an object of one segmentation is none of another
array([[0, 1, 2],
       [0, 3, 3]])
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["Refinement", "refine"]


@dataclass(frozen=True, eq=False)
class Refinement:
    """Cells and what they belong to.

    Parameters
    ----------
    cells : int array of the segmentations' shape
        The cell of every position. Cell 0 is free in all segmentations (it may be empty).
    objects : (n, k) int
        The object that each of k cells belongs to in each of n segmentations, numbered from 1 through all
        segmentations; 0 is free.
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
        """Objects of all segmentations together."""
        return int(self.first[-1])

    def named(self, cells: np.ndarray) -> np.ndarray:
        """(n_objects + 1,) bool: objects that have one of these cells; False for 0, free."""
        named = np.zeros(self.n_objects + 1, bool)
        named[self.objects[:, cells]] = True
        named[0] = False
        return named

    def overlaps(self) -> np.ndarray:
        """(n_objects + 1, n_objects + 1) positions that any two objects share; row and column 0, free, are 0."""
        total = self.n_objects + 1
        found = np.zeros((total, total))
        sizes = np.broadcast_to(self.sizes, self.objects.shape).ravel()
        for own, below, above in zip(self.objects, self.first, self.first[1:], strict=False):
            codes = np.where(own > 0, own - below, 0) * total + self.objects
            counts = np.bincount(codes.ravel(), sizes, (above - below + 1) * total).reshape(-1, total)
            found[below + 1 : above + 1, 1:] = counts[1:, 1:]
        return found


def refine(segmentations: Sequence[np.ndarray]) -> Refinement:
    """The common refinement of n label arrays of one shape; 0 is free. Labels are only names."""
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
    return Refinement(cells, objects, np.bincount(cells.ravel(), minlength=k), first)


def _compact(codes: np.ndarray) -> tuple[int, np.ndarray]:
    """How many different codes but 0 there are, and the codes as 1, 2, ... in ascending order; 0 stays."""
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

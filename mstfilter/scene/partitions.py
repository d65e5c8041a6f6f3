"""Partitions of voxels or pixels: renumbered labels, and the common refinement of several partitions.

A cell of the common refinement contains voxels (or pixels) that belong to the same object in every segmentation.
There are far fewer cells than voxels.

>>> both = common_refinement([np.array([0, 1, 1, 2]), np.array([0, 7, 7, 7])])
>>> both.cells, both.sizes
(array([0, 1, 1, 2]), array([1, 2, 1]))
>>> both.objects                       # numbered over both segmentations
array([[0, 1, 2],
       [0, 3, 3]])

`WeightedSegmentations` are many segmentations of one image with probabilities, stored by their cells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.scene.camera import Camera, rigid_from_matrix


def canonical(labels: np.ndarray) -> np.ndarray:
    """The same segmentation with labels 1, 2, ... in the order of their first voxels. Label 0 is free and stays 0."""
    flat = np.asarray(labels).ravel()
    present, first = np.unique(flat, return_index=True)
    order = np.argsort(np.where(present == 0, -1, first), kind="stable")
    table = np.zeros(int(flat.max(initial=0)) + 1, np.uint16)
    table[present[order]] = np.arange(len(present)) + (0 if present[0] == 0 else 1)
    return table[flat].reshape(np.shape(labels))


@dataclass(frozen=True, eq=False)
class CommonRefinement:
    """The cells of several segmentations, and the object of each cell in each segmentation."""

    #: Int array of the segmentations' shape: the cell of every position. Cell 0 is free in all segmentations and
    #: may be empty.
    cells: np.ndarray
    #: (n, k) int, object of each of k cells in each of n segmentations; 0 is free. Objects are numbered from 1 over
    #: all segmentations, so different segmentations have different objects.
    objects: np.ndarray
    sizes: np.ndarray  #: (k,) int, positions in each cell
    first: np.ndarray  #: (n + 1,) int, segmentation i has the objects first[i] + 1 .. first[i + 1]

    @property
    def n_objects(self) -> int:
        return int(self.first[-1])

    def objects_in(self, cells: np.ndarray) -> np.ndarray:
        """(n_objects + 1,) bool: whether each object contains at least one of the `cells`; False for free space."""
        present = np.zeros(self.n_objects + 1, bool)
        present[self.objects[:, cells]] = True
        present[0] = False
        return present

    def overlaps(self) -> np.ndarray:
        """Number of voxels that two objects share, (n_objects + 1, n_objects + 1). Row 0 and column 0 are zero."""
        total = self.n_objects + 1
        shared = np.zeros((total, total))
        sizes = np.broadcast_to(self.sizes, self.objects.shape).ravel()
        for row, below, above in zip(self.objects, self.first, self.first[1:], strict=False):
            codes = np.where(row > 0, row - below, 0) * total + self.objects
            counts = np.bincount(codes.ravel(), sizes, (above - below + 1) * total).reshape(-1, total)
            shared[below + 1 : above + 1, 1:] = counts[1:, 1:]
        return shared

    @staticmethod
    def jaccard(shared: np.ndarray) -> np.ndarray:
        """Intersection over union (k, k) of objects, from `overlaps`; 0 without a voxel in either."""
        sizes = shared.diagonal()
        union = np.add.outer(sizes, sizes) - shared
        return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def common_refinement(segmentations: Sequence[np.ndarray]) -> CommonRefinement:
    """The common refinement of n label arrays of the same shape. Labels are at least 0, and label 0 is free space."""
    occupied = np.logical_or.reduce([labels != 0 for labels in segmentations])
    count = int(occupied.sum())
    cell = np.zeros(count, np.int64)
    numbered = []
    first = np.zeros(len(segmentations) + 1, np.int64)
    for i, labels in enumerate(segmentations):
        present, compact = _renumbered(labels[occupied])
        numbered.append(np.where(compact > 0, compact + first[i], 0))
        first[i + 1] = first[i] + present
        cell = _renumbered(cell * (present + 1) + compact + 1)[1] - 1  # + 1: no code is 0, the free one
    k = int(cell.max(initial=-1)) + 2
    cells = np.zeros(occupied.shape, np.int64)
    cells[occupied] = cell + 1
    example = np.zeros(k, np.int64)
    example[cell + 1] = np.arange(count)
    objects = np.zeros((len(segmentations), k), np.int64)
    for row, numbers in zip(objects, numbered, strict=True):
        row[1:] = numbers[example[1:]]
    return CommonRefinement(cells, objects, np.bincount(cells.ravel(), minlength=k), first)


@dataclass(frozen=True, eq=False)
class WeightedSegmentations:
    """Segmentations of one image with their weights.

    >>> camera = Camera.from_intrinsics(500, 500, 1, 0, 3, 1, RigidTransform.identity())
    >>> cells, one, two = np.array([[0, 1, 2]]), [1, 1], [1, 2]
    >>> ways = WeightedSegmentations(cells, np.array([one, two]), np.array([0.4, 0.6]), camera)
    >>> ways.refinement.cells, ways.are_of(camera)
    (array([[0, 1, 2]]), True)

    Raises InputError if the shapes, labels or weights do not fit together.
    """

    cells: np.ndarray  #: (H, W) int, cell 1 .. K of each pixel; 0 for pixels of no object
    labels: np.ndarray  #: (m, K) int, segment of each cell in each segmentation; 0 is no object
    weights: np.ndarray  #: (m,) float, sum 1
    camera: Camera  #: of the image, with its pose

    def __post_init__(self) -> None:
        m, k = self.labels.shape if self.labels.ndim == 2 else (-1, -1)
        if self.cells.ndim != 2 or self.weights.shape != (m,) or int(self.cells.max(initial=0)) > k:
            raise InputError(
                f"segmentations have cells {self.cells.shape}, labels {self.labels.shape} and weights "
                f"{self.weights.shape}, expected (H, W), (m, K) with a column for each cell, and (m,)"
            )
        if self.cells.shape != (self.camera.height, self.camera.width):
            raise InputError(
                f"segmentations have cells {self.cells.shape}, and the image of their camera has "
                f"{(self.camera.height, self.camera.width)}"
            )
        if min(self.cells.min(initial=0), self.labels.min(initial=0)) < 0:
            raise InputError("segmentations have negative cells or labels")
        if not (self.weights >= 0).all() or not abs(float(self.weights.sum()) - 1) < 1e-6:
            raise InputError(f"the weights of segmentations sum to {float(self.weights.sum())}, expected 1")

    def __repr__(self) -> str:
        return f"WeightedSegmentations: {len(self.labels)} of {self.labels.shape[1]} cells"

    @cached_property
    def refinement(self) -> CommonRefinement:
        """The segmentations as a common refinement."""
        return self.refined_with(np.zeros((0, self.labels.shape[1]), np.int64))

    def refined_with(self, others: np.ndarray) -> CommonRefinement:
        """The segmentations as a common refinement, after other ones with the labels `others` (n, K)."""
        numbered = [canonical(row).astype(np.int64) for row in (*others, *self.labels)]
        first = np.cumsum([0, *(int(row.max(initial=0)) for row in numbered)])
        rows = [np.where(row > 0, row + before, 0) for row, before in zip(numbered, first, strict=False)]
        objects = np.pad(np.array(rows).reshape(len(numbered), self.labels.shape[1]), ((0, 0), (1, 0)))
        cells = self.cells.astype(np.int64)
        return CommonRefinement(cells, objects, np.bincount(cells.ravel(), minlength=objects.shape[1]), first)

    def cell_labels(self, image: np.ndarray) -> np.ndarray:
        """The label (K,) that most pixels of each cell have in an image (H, W) int; 0 if half of them have none."""
        n, k = int(image.max(initial=0)) + 1, self.labels.shape[1] + 1
        counts = np.bincount((self.cells.astype(np.int64) * n + image).ravel(), minlength=k * n).reshape(k, n)
        known = counts[:, 1:].sum(axis=1) > 0.5 * counts.sum(axis=1)
        return np.where(known, 1 + counts[:, 1:].argmax(axis=1) if n > 1 else 0, 0)[1:]

    def are_of(self, camera: Camera) -> bool:
        """Whether the image is that of a camera: same size, intrinsics and pose, up to rounding."""
        mine, theirs = self.camera, camera
        return bool(
            (mine.width, mine.height) == (theirs.width, theirs.height)
            and np.allclose(mine.K, theirs.K, rtol=1e-6)
            and theirs.T_world_camera is not None
            and np.allclose(mine.pose.as_matrix(), theirs.pose.as_matrix(), atol=1e-6)
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name, in small types."""
        cells, labels = (
            values.astype(np.min_scalar_type(int(values.max(initial=0)))) for values in (self.cells, self.labels)
        )
        pose = self.camera.pose.as_matrix()
        return {"cells": cells, "labels": labels, "weights": self.weights, "K": np.array(self.camera.K), "pose": pose}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray]) -> WeightedSegmentations:
        """The segmentations of `arrays`."""
        cells, labels, weights = (np.asarray(arrays[name]) for name in ("cells", "labels", "weights"))
        height, width = cells.shape
        return cls(cells, labels, weights, Camera(arrays["K"], width, height, rigid_from_matrix(arrays["pose"])))


def _renumbered(codes: np.ndarray) -> tuple[int, np.ndarray]:
    """The number of distinct nonzero codes, and the codes renumbered 1, 2, ... in ascending order. Code 0 stays 0."""
    codes = codes.astype(np.int64, copy=False)
    if codes.max(initial=0) > 8 * len(codes) + 1000:  # too large for a table
        codes = np.unique(np.append(codes, 0), return_inverse=True)[1][:-1]
    number = np.zeros(codes.max(initial=0) + 1, np.int64)
    number[codes] = 1
    number[0] = 0
    number = np.cumsum(number)
    return int(number[-1]), number[codes]

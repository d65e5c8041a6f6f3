"""From the visible part of an object to the space that it fills.

A segment of a depth image is a shell. A `Completer` guesses the rest, mask by mask: its answer depends on the
frame and on the mask alone, never on how the rest of the image is segmented, so hypotheses that share a segment
share the work. Masks that claim the same voxel are settled later, by `arbitration.arbitrate`.

>>> completions = Extrude().complete(rng, frame, [mask_a, mask_b], grid)
>>> labels = arbitrate(completions, grid)            # (X, Y, Z), 1 for mask_a, 2 for mask_b

To make your own, subclass `Completer` and override `fill`: the seen evidence in a small box comes in,
probabilities go out, and the veto by free space and the visible surface are seen to for you.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene.arrays import content_key, read_only
from mstfilter.scene.depth_noise import depth_sigma
from mstfilter.scene.frame import Frame
from mstfilter.scene.frame_geometry import frame_geometry
from mstfilter.scene.memo import memo
from mstfilter.scene.voxels import VoxelGrid

__all__ = ["Completer", "Completion", "Evidence", "evidence"]


@dataclass(frozen=True, eq=False)
class Completion:
    """Where one segment's object is, in a box of the grid.

    Parameters
    ----------
    offset : (3,) int
        Index of the box's first voxel in the grid.
    probability : (a, b, c) float32
        Probability of being occupied by the object; empty where the mask has no reading in the grid.
    points : (a, b, c) int32
        Depth readings of the mask in each voxel: the visible surface.
    key : str
        Name by content of frame, mask, grid and completer.
    """

    offset: np.ndarray
    probability: np.ndarray
    points: np.ndarray
    key: str

    @property
    def box(self) -> tuple[slice, slice, slice]:
        """Slices of the box in the grid."""
        a, b, c = (slice(int(o), int(o) + n) for o, n in zip(self.offset, self.probability.shape, strict=True))
        return a, b, c


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a frame says about a box of the grid, seen from one mask.

    Parameters
    ----------
    points : (a, b, c) int32
        Readings of the mask in each voxel.
    own : (a, b, c) bool
        Visible surface of the mask: enough readings, or the best voxel of its column.
    other : (a, b, c) bool
        Visible surface of anything else.
    free : (a, b, c) bool
        Seen through, and without a reading of the mask: surely not the object.
    behind : (a, b, c) bool
        Behind a reading of the mask.
    height : (c,) float
        Height of the voxel centres above the table in metres.
    """

    points: np.ndarray
    own: np.ndarray
    other: np.ndarray
    free: np.ndarray
    behind: np.ndarray
    height: np.ndarray


@dataclass(frozen=True)
class Completer(ABC):
    """Guesses the hidden part of objects.

    Parameters
    ----------
    min_points : int
        Readings that make a voxel visible surface; the best voxel of a column always is.
    free_margin : float
        A voxel is seen through if its centre is this far in front of the measured surface, in voxels.
    free_sigmas : float
        ... and also this far, in standard deviations of the depth reading.
    """

    min_points: int = 2
    free_margin: float = 0.5
    free_sigmas: float = 3.0

    #: Voxels around the visible part that `fill` may use, besides all those below it.
    padding: ClassVar[int] = 0
    #: Whether `fill` draws from its generator; what is drawn is not kept for the next hypothesis.
    stochastic: ClassVar[bool] = False

    @abstractmethod
    def fill(self, rng: np.random.Generator, seen: Evidence) -> np.ndarray:
        """(a, b, c) probability of being occupied."""

    def complete(
        self, rng: np.random.Generator, frame: Frame, masks: Sequence[np.ndarray], grid: VoxelGrid
    ) -> list[Completion]:
        """Complete several masks of a frame.

        Parameters
        ----------
        rng : Generator
            Only stochastic completers draw from it.
        frame : Frame
            With the pose that places it in the grid.
        masks : sequence of (H, W) bool
            Each one segment. Pixels without a reading, of the robot, or outside the grid are ignored.
        grid : VoxelGrid
            The lattice of the answer.

        Returns
        -------
        list of Completion
            One a mask. What was seen as free has probability 0; what is visible surface is kept as the completer
            decides, but at least one voxel of each visible column is 1, so the object shows in its own mask.
        """
        return [self._one(rng, frame, np.asarray(mask, dtype=bool), grid) for mask in masks]

    def _one(self, rng: np.random.Generator, frame: Frame, mask: np.ndarray, grid: VoxelGrid) -> Completion:
        if mask.shape != frame.depth.shape:
            raise InputError(f"mask has shape {mask.shape}, the frame is {frame.depth.shape}")
        name = content_key("mask", np.packbits(mask), frame.key, grid.key, self._key())

        def compute() -> Completion:
            offset, seen = evidence(
                frame, mask, grid, self.min_points, self.free_margin, self.free_sigmas, self.padding
            )
            p = np.array(self.fill(rng, seen), dtype=np.float32)
            p[seen.free] = 0
            p[_best_of_column(seen.points)] = 1
            return Completion(read_only(offset), read_only(p), read_only(seen.points), name.hex()[:16])

        return compute() if self.stochastic else memo("completion", name, compute)

    def _key(self) -> str:
        values: list[Any] = [(f.name, getattr(self, f.name)) for f in fields(self)]
        return f"{type(self).__module__}.{type(self).__qualname__}{values}"


def _frame_points(frame: Frame, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flat pixels with a reading inside the grid, their voxels, and the number of readings of every voxel."""

    def compute() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        index = grid.index_of(frame.points)
        inside = frame.valid & grid.contains(index)
        pixels = np.flatnonzero(inside)
        voxels = index.reshape(-1, 3)[pixels]
        flat = np.ravel_multi_index(tuple(voxels.T), grid.shape)
        count = np.bincount(flat, minlength=int(np.prod(grid.shape))).reshape(grid.shape)
        return read_only(pixels), read_only(voxels.astype(np.int32)), read_only(count.astype(np.int32))

    return memo("frame_points", (frame.key, grid.key), compute)


def _free(frame: Frame, grid: VoxelGrid, margin: float, sigmas: float) -> np.ndarray:
    def compute() -> np.ndarray:
        geometry = frame_geometry(frame, grid)
        distance = np.maximum(margin * grid.voxel_size, sigmas * depth_sigma(geometry.z - geometry.signed))
        return read_only(geometry.known_free(distance))

    return memo("seen_free", (frame.key, grid.key, margin, sigmas), compute)


def evidence(
    frame: Frame,
    mask: np.ndarray,
    grid: VoxelGrid,
    min_points: int = 2,
    free_margin: float = 0.5,
    free_sigmas: float = 3.0,
    padding: int = 0,
) -> tuple[np.ndarray, Evidence]:
    """What a frame says about the box of a mask: offset (3,) and the evidence in it.

    The box holds the mask's readings, everything below them, and `padding` voxels around.
    """
    pixels, voxels, count = _frame_points(frame, grid)
    mine = voxels[mask.ravel()[pixels]]
    if len(mine) == 0:
        empty = np.zeros((0, 0, 0))
        no = empty.astype(bool)
        return np.zeros(3, np.int64), Evidence(empty.astype(np.int32), no, no, no, no, np.zeros(0))
    low = np.maximum(mine.min(axis=0) - padding, 0).astype(np.int64)
    low[2] = 0
    high = np.minimum(mine.max(axis=0) + 1 + padding, grid.shape)
    box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    shape = tuple(int(n) for n in high - low)
    points = (
        np.bincount(np.ravel_multi_index(tuple((mine - low).T), shape), minlength=int(np.prod(shape)))
        .reshape(shape)
        .astype(np.int32)
    )
    others = count[box] - points
    own = ((points >= min_points) & (points >= others)) | _best_of_column(points)
    other = (others >= min_points) & ~own
    geometry = frame_geometry(frame, grid)
    pixel = geometry.pixel[box]
    with np.errstate(invalid="ignore"):
        behind = (pixel >= 0) & mask.ravel()[np.maximum(pixel, 0)] & (geometry.signed[box] > 0)
    free = _free(frame, grid, free_margin, free_sigmas)[box] & (points == 0)
    height = grid.origin[2] + (np.arange(shape[2]) + 0.5) * grid.voxel_size
    return low, Evidence(points, own, other, free, behind, height)


def _best_of_column(points: np.ndarray) -> np.ndarray:
    """The voxel with most readings of each vertical column that has any; the highest of equals."""
    best = np.zeros(points.shape, dtype=bool)
    if points.size:
        top = points.shape[2] - 1 - points[:, :, ::-1].argmax(axis=2)
        np.put_along_axis(best, top[..., None], points.max(axis=2)[..., None] > 0, axis=2)
    return best

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
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Frame, VoxelGrid, component_key, content_key, depth_sigma, frame_geometry, memo, read_only

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
        Visible surface of the mask: the centre's pixel is in the mask, and the centre is at the measured surface
        or just behind it. A mask so small that no centre falls into it has the voxel with most readings.
    other : (a, b, c) bool
        Visible surface of anything else, likewise.
    free : (a, b, c) bool
        Seen through: surely not the object.
    behind : (a, b, c) bool
        The centre's pixel is in the mask and the centre is behind the measured surface.
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
    in_front, depth : float
        A voxel is visible surface if its centre is at most `in_front` voxels in front of the measured surface and
        less than `depth` voxels behind it, along the optical axis. Asking for the centre rather than for any
        reading keeps objects from growing by half a voxel all round (rendered boxes: volume 1.13 of the truth
        instead of 1.41, quality .82 instead of .71; the two values were chosen on these).
    free_margin : float
        A voxel is seen through if its centre is this far in front of the measured surface, in voxels.
    free_sigmas : float
        ... and also this far, in standard deviations of the depth reading.
    """

    in_front: float = 0.2
    depth: float = 1.5
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
            One a mask. What was seen as free has probability 0. A mask with any reading in the grid has at least
            one voxel of probability 1, so every visible object exists.
        """
        return [self._one(rng, frame, np.asarray(mask, dtype=bool), grid) for mask in masks]

    def _one(self, rng: np.random.Generator, frame: Frame, mask: np.ndarray, grid: VoxelGrid) -> Completion:
        if mask.shape != frame.depth.shape:
            raise InputError(f"mask has shape {mask.shape}, the frame is {frame.depth.shape}")
        name = content_key("mask", np.packbits(mask), frame.key, grid.key, self._key())

        def compute() -> Completion:
            offset, seen = evidence(frame, mask, grid, self)
            p = np.array(self.fill(rng, seen), dtype=np.float32)
            p[seen.free] = 0
            if p.size and not (p == 1).any():
                p[seen.own] = 1
            return Completion(read_only(offset), read_only(p), read_only(seen.points), name.hex()[:16])

        return compute() if self.stochastic else memo("completion", name, compute, Completion)

    def _key(self) -> bytes:
        return component_key(self)


def _frame_points(frame: Frame, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Flat pixels with a reading inside the grid (k,), and their voxels (k, 3)."""

    def compute() -> tuple[np.ndarray, np.ndarray]:
        index = grid.index_of(frame.points)
        pixels = np.flatnonzero(frame.valid & grid.contains(index))
        return read_only(pixels), read_only(index.reshape(-1, 3)[pixels].astype(np.int32))

    return memo("frame_points", (frame.key, grid.key), compute)


def _free(frame: Frame, grid: VoxelGrid, margin: float, sigmas: float) -> np.ndarray:
    def compute() -> np.ndarray:
        geometry = frame_geometry(frame, grid)
        distance = np.maximum(margin * grid.voxel_size, sigmas * depth_sigma(geometry.z - geometry.signed))
        return read_only(geometry.known_free(distance))

    return memo("seen_free", (frame.key, grid.key, margin, sigmas), compute)


def evidence(frame: Frame, mask: np.ndarray, grid: VoxelGrid, rule: Completer) -> tuple[np.ndarray, Evidence]:
    """What a frame says about the box of a mask: offset (3,) and the evidence in it.

    The box holds the mask's readings, everything below them, and the margin that `rule` asks for; `rule` also
    says what counts as visible surface and as free.
    """
    pixels, voxels = _frame_points(frame, grid)
    mine = voxels[mask.ravel()[pixels]]
    if len(mine) == 0:
        empty = np.zeros((0, 0, 0))
        no = empty.astype(bool)
        return np.zeros(3, np.int64), Evidence(empty.astype(np.int32), no, no, no, no, np.zeros(0))
    # The surface may reach `depth` voxels behind the readings.
    margin = max(rule.padding, int(np.ceil(rule.depth)))
    low = np.maximum(mine.min(axis=0) - margin, 0).astype(np.int64)
    low[2] = 0
    high = np.minimum(mine.max(axis=0) + 1 + margin, grid.shape)
    box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    shape = tuple(int(n) for n in high - low)
    flat = np.ravel_multi_index(tuple((mine - low).T), shape)
    points = np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape).astype(np.int32)

    geometry = frame_geometry(frame, grid)
    pixel, signed = geometry.pixel[box], geometry.signed[box]
    inside = (pixel >= 0) & mask.ravel()[np.maximum(pixel, 0)]
    with np.errstate(invalid="ignore"):
        surface = (signed >= -rule.in_front * grid.voxel_size) & (signed < rule.depth * grid.voxel_size)
        behind = inside & (signed > 0)
    own = surface & inside
    free = _free(frame, grid, rule.free_margin, rule.free_sigmas)[box]
    if not own.any():
        own[np.unravel_index(points.argmax(), shape)] = True
        free = free & ~own
    height = grid.origin[2] + (np.arange(shape[2]) + 0.5) * grid.voxel_size
    return low, Evidence(points, own, surface & ~inside & ~own, free, behind, height)

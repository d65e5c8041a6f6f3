"""Completion: from the visible part of an object to the space that it fills (paper, section IV-B).

A segment of a depth image is a shell. A `Completer` estimates the hidden part of the object, mask by mask. The result
depends on the frame and on the mask alone, not on the rest of the segmentation, so hypotheses that share a segment
share the work.

>>> completions = Extrude().complete(rng, frame, [mask_a, mask_b], grid)
>>> labels = arbitrate(completions, grid)            # (X, Y, Z), 1 for mask_a, 2 for mask_b

For a new method, subclass `Completer` and override `fill`: the argument is an `ObservedBox`, a small box of the grid,
and the result is the probability of each voxel. `complete` clears voxels that are observed as free and keeps the
visible surface.

`arbitrate` makes the label grid. If several completions claim a voxel:

1. A voxel with readings belongs to the object with most readings in it.
2. Otherwise it belongs to the object with the largest probability, if that reaches the threshold.
3. Ties go to the object with the nearest visible surface.

The result does not depend on the order of the objects: renumbered completions give renumbered labels.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial import cKDTree

from mstfilter.errors import InputError
from mstfilter.scene import (
    Clip,
    Frame,
    VoxelGrid,
    component_key,
    content_key,
    depth_sigma,
    frame_geometry,
    memo,
    read_only,
)


@dataclass(frozen=True, eq=False)
class Completion:
    """The completed object of one segment, in a box of the grid."""

    offset: np.ndarray  #: (3,) int, index of the box's first voxel in the grid
    #: (a, b, c) float32, probability of being occupied by the object; empty if the mask has no reading in the grid.
    probability: np.ndarray
    points: np.ndarray  #: (a, b, c) int32: depth readings of the mask in each voxel: the visible surface
    key: str  #: key of the contents of frame, mask, grid and completer

    @property
    def box(self) -> tuple[slice, slice, slice]:
        """Slices of the box in the grid."""
        a, b, c = (slice(int(o), int(o) + n) for o, n in zip(self.offset, self.probability.shape, strict=True))
        return a, b, c


@dataclass(frozen=True, eq=False)
class ObservedBox:
    """What a frame shows of a box of the grid around one mask."""

    points: np.ndarray  #: (a, b, c) int32: readings of the mask in each voxel
    #: (a, b, c) bool, visible surface of the mask: the pixel of the voxel's centre is in the mask, and the centre
    #: is at the measured surface or just behind it. If no centre falls into a small mask, the voxel with most
    #: readings.
    surface: np.ndarray
    other_surface: np.ndarray  #: (a, b, c) bool, visible surface outside the mask, by the same rule
    free: np.ndarray  #: (a, b, c) bool, observed as free
    #: (a, b, c) bool, the pixel of the centre is in the mask and the centre is behind the measured surface.
    behind: np.ndarray
    height: np.ndarray  #: (c,) height of the voxel centres above the table in metres


@dataclass(frozen=True)
class Completer(ABC):
    """Estimates the hidden part of objects.

    Parameters
    ----------
    in_front, depth : float
        A voxel is visible surface if its centre is at most `in_front` voxels in front of the measured surface and
        less than `depth` voxels behind it, along the optical axis. A test of the centre, and not of any reading in
        the voxel, keeps objects from growing by half a voxel on all sides (rendered boxes: volume 1.13 of the truth
        instead of 1.41, quality .82 instead of .71; the two values were chosen on these).
    free_margin : float
        A voxel is free if its centre is this far in front of the measured surface, in voxels ...
    free_sigmas : float
        ... and also this far, in standard deviations of the depth reading.
    """

    in_front: float = 0.2
    depth: float = 1.5
    free_margin: float = 0.5
    free_sigmas: float = 3.0

    #: Voxels around the visible part that `fill` may use, besides all those below it.
    padding: ClassVar[int] = 0
    #: Whether `fill` draws random numbers. The result is then not reused for the next hypothesis.
    stochastic: ClassVar[bool] = False

    @abstractmethod
    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        """Probability (a, b, c) of being occupied."""

    def complete(
        self, rng: np.random.Generator, frame: Frame, masks: Sequence[np.ndarray], grid: VoxelGrid
    ) -> list[Completion]:
        """Complete several masks of a frame; the pose of the frame places it in the grid.

        Parameters
        ----------
        rng : Generator
            Only stochastic completers draw from it.
        masks : sequence of (H, W) bool
            Each one segment. Pixels without a reading, of the robot, or outside the grid are ignored.

        Returns
        -------
        list of Completion
            One for each mask. Voxels observed as free have probability 0. A mask with a reading in the grid has at
            least one voxel of probability 1, so every visible object exists.
        """
        return [self._one(rng, frame, np.asarray(mask, dtype=bool), grid) for mask in masks]

    def _one(self, rng: np.random.Generator, frame: Frame, mask: np.ndarray, grid: VoxelGrid) -> Completion:
        if mask.shape != frame.depth.shape:
            raise InputError(f"mask has shape {mask.shape}, the frame is {frame.depth.shape}")
        name = content_key("mask", np.packbits(mask), frame.key, grid.key, component_key(self))

        def compute() -> Completion:
            offset, seen = observed_box(frame, mask, grid, self)
            p = np.array(self.fill(rng, seen), dtype=np.float32)
            p[seen.free] = 0
            if p.size and not (p == 1).any():
                p[seen.surface] = 1
            return Completion(read_only(offset), read_only(p), read_only(seen.points), name.hex()[:16])

        return compute() if self.stochastic else memo("completion", name, compute, Completion)


class ClipCompleter(Completer):
    """A completer that depends on the clip, for example because it reads a folder for each pause."""

    @abstractmethod
    def at(self, clip: Clip) -> Completer:
        """The completer of the clip's last frame."""


def observed_box(frame: Frame, mask: np.ndarray, grid: VoxelGrid, rule: Completer) -> tuple[np.ndarray, ObservedBox]:
    """The box of a mask: its offset (3,) in the grid, and what the frame shows of it.

    The box holds the readings of the mask, the space below them, and a margin. `rule` has the parameters of the
    margin, the visible surface and the free space.
    """
    pixels, voxels = _frame_points(frame, grid)
    mine = voxels[mask.ravel()[pixels]]
    if len(mine) == 0:
        empty = np.zeros((0, 0, 0))
        no = empty.astype(bool)
        return np.zeros(3, np.int64), ObservedBox(empty.astype(np.int32), no, no, no, no, np.zeros(0))
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
    in_mask = surface & inside
    free = _free(frame, grid, rule.free_margin, rule.free_sigmas)[box]
    if not in_mask.any():
        in_mask[np.unravel_index(points.argmax(), shape)] = True
        free = free & ~in_mask
    height = grid.origin[2] + (np.arange(shape[2]) + 0.5) * grid.voxel_size
    return low, ObservedBox(points, in_mask, surface & ~inside & ~in_mask, free, behind, height)


def _frame_points(frame: Frame, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Flat pixels with a reading inside the grid (k,), and their voxels (k, 3)."""

    def compute() -> tuple[np.ndarray, np.ndarray]:
        index = grid.index_of(frame.points)
        pixels = np.flatnonzero(frame.valid & grid.contains(index))
        return read_only(pixels), read_only(index.reshape(-1, 3)[pixels].astype(np.int32))

    return memo("frame_points", (frame.key, grid.key), compute)


def _free(frame: Frame, grid: VoxelGrid, margin: float, sigmas: float) -> np.ndarray:
    """Voxels (X, Y, Z) bool in front of the measured surface by `margin` voxels and by `sigmas` of its noise."""

    def compute() -> np.ndarray:
        geometry = frame_geometry(frame, grid)
        distance = np.maximum(margin * grid.voxel_size, sigmas * depth_sigma(geometry.z - geometry.signed))
        return read_only(geometry.known_free(distance))

    return memo("seen_free", (frame.key, grid.key, margin, sigmas), compute)


def arbitrate(completions: Sequence[Completion], grid: VoxelGrid, threshold: float = 0.5) -> np.ndarray:
    """Label grid (X, Y, Z) uint16 of the completions of one hypothesis: 0 free, k + 1 the k-th completion.

    `threshold` is the least probability of an occupied voxel.
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
        _break_ties(labels, tied, most, best, completions, threshold)
    return labels


def _break_ties(
    labels: np.ndarray,
    tied: np.ndarray,
    most: np.ndarray,
    best: np.ndarray,
    completions: Sequence[Completion],
    threshold: float,
) -> None:
    """Give tied voxels to the object with the nearest visible surface; at equal distance, to the smaller key."""
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

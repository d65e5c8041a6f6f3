"""The input of completion: the observations of an object, in a box of the grid around the object.

>>> offset, seen = observed_box(frame, mask, grid, completer)     # of one frame
>>> bits, signed = encode_box(seen)                               # packed: the contents of an `ObjectView`
>>> offset, now, seen, views = observed_again(frame, mask, views, grid, completer)     # and of earlier frames

**Earlier frames.** When an object moves, its views move with it, and their values are read at the nearest voxel. A
view contributes the surface of the object, the space behind this surface, and the free space around it. Surfaces of
other objects, and the space that they occlude, are left out, because the other objects may have moved since. Where
the latest frame and a view differ about the surface, the latest frame decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
from scipy.ndimage import binary_dilation

from mstfilter.base.results import Checked
from mstfilter.scene import (
    Frame,
    ObjectView,
    Seen,
    VoxelGrid,
    depth_sigma,
    frame_geometry,
    frame_points,
    memo,
    read_only,
    scaled_area,
)

_REACH = 4.0  # voxels, distance from the surface at which `signed` saturates
_SHAPE = Seen.SURFACE | Seen.FREE | Seen.BEHIND  # what is evidence about the object's shape

# Shares at which the latest frame refutes a view: of its surface that is seen free, of the surface seen now that was
# free in it, and of its surface that is seen now.
_CLEARED, _PIERCED, _SEEN = 0.2, 0.15, 0.05
_CLEAR = 1.0  # voxels: space of an earlier frame is free if it lay this far in front of the surface


@dataclass(frozen=True)
class SurfaceRule(Checked):
    """Which voxels of a mask are visible surface, which voxels are free, and which box surrounds the mask.

    Parameters
    ----------
    in_front, depth : float
        A voxel is visible surface if its centre is at most `in_front` voxels in front of the measured surface, and
        less than `depth` voxels behind it, along the optical axis. If all voxels with readings were surface, objects
        would be half a voxel larger on all sides: on rendered boxes, on which the defaults were chosen, the volume
        would be 1.41 instead of 1.13 times the true one, and the quality .71 instead of .82.
    free_margin, free_sigmas : float
        A voxel is free if its centre is at least `free_margin` voxels, and at least `free_sigmas` standard deviations
        of the depth reading, in front of the measured surface.
    """

    in_front: float = 0.2
    depth: float = 1.5
    free_margin: float = 0.5
    free_sigmas: float = 3.0

    #: Voxels around the visible part that belong to the box, besides all those below it.
    padding: ClassVar[int] = 0

    def box(self, voxels: np.ndarray, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
        """First voxel (3,) of the box of a mask with readings in `voxels` (k, 3), and the voxel after the box."""
        # The surface may reach `depth` voxels behind the readings.
        return enclosing_box(voxels, grid, max(self.padding, int(np.ceil(self.depth))))


@dataclass(frozen=True, eq=False)
class ObservedBox:
    """The observation of a box of the grid around one mask by a frame."""

    points: np.ndarray  #: (a, b, c) int32: readings of the mask in each voxel
    #: (a, b, c) bool, visible surface of the mask: the pixel of the voxel's centre is in the mask, and the centre
    #: is at the measured surface or just behind it. If no centre falls into a small mask, the voxel with most
    #: readings.
    surface: np.ndarray
    other_surface: np.ndarray  #: (a, b, c) bool, visible surface outside the mask, by the same rule
    free: np.ndarray  #: (a, b, c) bool, observed as free
    #: (a, b, c) bool, the pixel of the centre is in the mask and the centre is behind the measured surface.
    behind: np.ndarray
    hidden: np.ndarray  #: (a, b, c) bool, the same for a pixel outside the mask: hidden by something else.
    #: (a, b, c) float32, voxels behind the measured surface along the optical axis; NaN if it is unknown.
    signed: np.ndarray
    height: np.ndarray  #: (c,) height of the voxel centres above the table in metres
    latest: ObservedBox | None = None  #: what the latest frame alone shows, if earlier views are in the other fields

    def __post_init__(self) -> None:
        for f in fields(self):
            if f.name != "latest":
                object.__setattr__(self, f.name, read_only(getattr(self, f.name)))

    @property
    def voxel_size(self) -> float:
        """Edge of a voxel in metres; 1 cm for a box with one layer, which does not show it."""
        return float(self.height[1] - self.height[0]) if len(self.height) > 1 else 0.01


def observed_box(
    frame: Frame, mask: np.ndarray, grid: VoxelGrid, rule: SurfaceRule
) -> tuple[np.ndarray, ObservedBox]:
    """The box of a mask: its offset (3,) in the grid, and the observation of the box by the frame.

    `rule` defines the size of the box, and which voxels are visible surface and free space.
    """
    offset, seen, _, _ = observed_again(frame, mask, (), grid, rule)
    return offset, seen


def mask_voxels(frame: Frame, mask: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Voxels (k, 3) of the readings of a mask (H, W)."""
    pixels, voxels = frame_points(frame, grid)
    return voxels[mask.ravel()[pixels]]


def observed_in(
    frame: Frame, mask: np.ndarray, grid: VoxelGrid, rule: SurfaceRule, low: np.ndarray, high: np.ndarray
) -> ObservedBox:
    """What a frame shows of the object of a mask, in the box from voxel `low` to `high`. The mask may be empty."""
    box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    shape = tuple(int(n) for n in high - low)
    mine = mask_voxels(frame, mask, grid)
    mine = mine[((mine >= low) & (mine < high)).all(axis=1)]
    flat = np.ravel_multi_index(tuple((mine - low).T), shape)
    points = np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape).astype(np.int32)

    geometry = frame_geometry(frame, grid)
    pixel, signed = geometry.pixel[box], geometry.signed[box]
    inside = (pixel >= 0) & mask.ravel()[np.maximum(pixel, 0)]
    with np.errstate(invalid="ignore"):
        surface = (signed >= -rule.in_front * grid.voxel_size) & (signed < rule.depth * grid.voxel_size)
        behind = signed > 0
    in_mask = surface & inside
    free = _free(frame, grid, rule.free_margin, rule.free_sigmas)[box]
    if len(mine) and not in_mask.any():
        in_mask[np.unravel_index(points.argmax(), shape)] = True
        free = free & ~in_mask
    height = grid.origin[2] + (low[2] + np.arange(shape[2]) + 0.5) * grid.voxel_size
    other = surface & ~inside & ~in_mask
    distance = signed / np.float32(grid.voxel_size)
    return ObservedBox(points, in_mask, other, free, behind & inside, behind & ~inside, distance, height)


def _free(frame: Frame, grid: VoxelGrid, margin: float, sigmas: float) -> np.ndarray:
    """Voxels (X, Y, Z) bool at least `margin` voxels and `sigmas` standard deviations in front of the surface.

    The space in front of an estimated depth is not known to be free.
    """

    def compute() -> np.ndarray:
        geometry = frame_geometry(frame, grid)
        distance = np.maximum(margin * grid.voxel_size, sigmas * depth_sigma(geometry.z - geometry.signed))
        free = geometry.known_free(distance)
        return read_only(free if frame.estimated is None else free & ~frame.estimated.ravel()[geometry.pixel])

    return memo("seen_free", (frame.key, grid.key, margin, sigmas), compute)


def encode_box(seen: ObservedBox) -> tuple[np.ndarray, np.ndarray]:
    """Packed box: flags of `Seen` (a, b, c) uint8, and signed distances (a, b, c) int8 in units of `_REACH` / 127."""
    bits = np.zeros(seen.surface.shape, np.uint8)
    shown = (seen.surface, seen.other_surface, seen.free, seen.behind, seen.hidden)
    for flag, one in zip(Seen, shown, strict=True):
        bits |= np.uint8(flag) * one
    signed = np.clip(np.nan_to_num(seen.signed, nan=0.0) / _REACH, -1, 1)
    return bits, np.rint(signed * 127).astype(np.int8)


def decode_signed(signed: np.ndarray) -> np.ndarray:
    """Signed distances in voxels, from the values of `encode_box`."""
    return np.asarray(signed, np.float32) * np.float32(_REACH / 127)


def observed_again(
    frame: Frame,
    mask: np.ndarray,
    views: Sequence[ObjectView],
    grid: VoxelGrid,
    rule: SurfaceRule,
    refute: bool = True,
) -> tuple[np.ndarray, ObservedBox, ObservedBox, tuple[ObjectView, ...]]:
    """The box of a mask and of earlier views of the object. The mask may be empty.

    Returns the offset (3,) of the box, the observation by the frame, the observation by the frame and the views
    together (`recall`), and the views. If `refute` is true, views that contradict the frame are omitted. The box is
    empty if no part of the object lies inside the grid.
    """
    if views and refute:
        voxels = _surface_voxels(frame, mask, views, grid)
        low, high = enclosing_box(voxels, grid, int(np.ceil(rule.depth)))
        views = _confirmed(observed_in(frame, mask, grid, rule, low, high), low, grid, views)
    voxels = _surface_voxels(frame, mask, views, grid)
    low, high = rule.box(voxels, grid) if len(voxels) else (np.zeros(3, np.int64),) * 2
    now = observed_in(frame, mask, grid, rule, low, high)
    return low, now, recall(now, low, grid, views), tuple(views)


def enclosing_box(voxels: np.ndarray, grid: VoxelGrid, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """First voxel (3,) and end (3,), excluded, of a box around `voxels` (k, 3) that reaches the grid's floor."""
    if not len(voxels):
        return np.zeros(3, np.int64), np.zeros(3, np.int64)
    low = np.maximum(voxels.min(axis=0) - margin, 0).astype(np.int64)
    low[2] = 0
    return low, np.minimum(voxels.max(axis=0) + 1 + margin, grid.shape).astype(np.int64)


def _surface_voxels(frame: Frame, mask: np.ndarray, views: Sequence[ObjectView], grid: VoxelGrid) -> np.ndarray:
    """Voxels (k, 3) of the readings of a mask, and of the surfaces of views.

    Readings are repeated or omitted to give the number in an image of 640 x 480 pixels, so crops do not depend on the
    image size.
    """
    readings = mask_voxels(frame, mask, grid)
    if not views:
        return readings
    share = scaled_area(1, frame.depth.size)
    readings = readings[:: round(share)] if share > 1 else np.repeat(readings, round(1 / share), axis=0)
    voxels = np.concatenate([readings, *(view_surface(view, grid) for view in views)])
    return voxels[grid.contains(voxels)]


def recall(seen: ObservedBox, offset: np.ndarray, grid: VoxelGrid, views: Sequence[ObjectView]) -> ObservedBox:
    """The observation of a box at `offset` (3,) by a frame and by earlier views of the object."""
    if not views:
        return seen
    shape = seen.surface.shape
    centres = grid.centre_of(np.indices(shape).reshape(3, -1).T + offset)
    bits: np.ndarray = np.zeros(len(centres), np.uint8)
    signed = np.full(len(centres), np.nan, np.float32)
    for view in views:
        inside, found, distance = _evidence(view, centres, grid)
        bits[inside] |= found
        signed[inside] = np.fmin(signed[inside], distance)
    bits = bits.reshape(shape)
    near = binary_dilation(seen.surface)  # an earlier surface there is the same one, seen with noise
    free = seen.free | (Seen.FREE.among(bits) & ~seen.surface)
    surface = (seen.surface | (Seen.SURFACE.among(bits) & ~near & ~seen.other_surface)) & ~free
    behind = (seen.behind | Seen.BEHIND.among(bits)) & ~free
    other, hidden = seen.other_surface & ~free, seen.hidden & ~free & ~behind
    distance = np.fmin(seen.signed, signed.reshape(shape))
    return ObservedBox(seen.points, surface, other, free, behind, hidden, distance, seen.height, seen)


def _evidence(view: ObjectView, centres: np.ndarray, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether centres (n, 3) lie in the box of a view (n,) bool, and the observation by the view at these centres.

    The observation consists of flags of `Seen` (k,), and signed distances (k,) in voxels, NaN if unknown.
    """
    index = grid.index_of(view.motion.inv().apply(centres)) - view.offset
    inside = ((index >= 0) & (index < view.bits.shape)).all(axis=1)
    at = tuple(index[inside].T)
    distance, found = decode_signed(view.signed[at]), view.bits[at] & np.uint8(_SHAPE)
    clear = np.where(distance > -_CLEAR, found & np.uint8(Seen.SURFACE | Seen.BEHIND), found)
    return inside, clear, np.where(found > 0, distance, np.nan)


def _confirmed(
    seen: ObservedBox, offset: np.ndarray, grid: VoxelGrid, views: Sequence[ObjectView]
) -> tuple[ObjectView, ...]:
    """The views that the latest frame does not contradict.

    A frame contradicts a view if it observes much of the view's surface as free, or much of the view's free space as
    surface. A view is also contradicted if little of its surface is near the current surface.
    """
    centres = grid.centre_of(np.indices(seen.surface.shape).reshape(3, -1).T + offset)
    now, near, n_now = seen.surface.ravel(), binary_dilation(seen.surface).ravel(), int(seen.surface.sum())
    kept = []
    for view in views:
        inside, found, _ = _evidence(view, centres, grid)
        own, free = Seen.SURFACE.among(found), Seen.FREE.among(found)
        n_own = int(own.sum())
        cleared = (own & seen.free.ravel()[inside]).sum() > _CLEARED * n_own
        pierced = (free & now[inside]).sum() > _PIERCED * n_now
        if not (cleared or pierced or (n_now and (own & near[inside]).sum() < _SEEN * n_own)):
            kept.append(view)
    return tuple(kept)


def view_surface(view: ObjectView, grid: VoxelGrid) -> np.ndarray:
    """Voxels (k, 3) of the moved surface of a view, inside and outside the grid."""
    centres = grid.centre_of(np.argwhere(Seen.SURFACE.among(view.bits)) + view.offset)
    return grid.index_of(view.motion.apply(centres)) if len(centres) else np.zeros((0, 3), np.int64)

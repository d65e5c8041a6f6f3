"""Geometry of a depth image: voxels in the image, the workspace.

>>> frame_geometry(frame, grid).known_free(0.005)         # voxels observed as free
>>> grid = workspace(frame)                               # voxels around the objects on the table
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.base.errors import InputError, check_number
from mstfilter.scene.arrays import read_only
from mstfilter.scene.cache import memo
from mstfilter.scene.camera import Camera
from mstfilter.scene.frame import Frame
from mstfilter.scene.planes import without_strips
from mstfilter.scene.voxels import VoxelGrid


@dataclass(frozen=True, eq=False)
class FrameGeometry:
    """Projection of the voxel centres of a grid into the image of a frame."""

    #: (X, Y, Z) int32: flat index of the pixel of the centre; -1 outside the image or behind the camera.
    pixel: np.ndarray
    z: np.ndarray  #: (X, Y, Z) float32, z-depth of the centre in metres
    #: (X, Y, Z) float32, `z` minus the measured depth of the pixel: negative in front of the surface, positive
    #: behind; NaN if it is unknown (outside the image, no reading, robot).
    signed: np.ndarray

    def known_free(self, margin: float | np.ndarray) -> np.ndarray:
        """(X, Y, Z) bool: voxel centres more than `margin` metres in front of the measured surface."""
        with np.errstate(invalid="ignore"):
            return self.signed < -np.asarray(margin, dtype=np.float32)


def frame_geometry(frame: Frame, grid: VoxelGrid) -> FrameGeometry:
    """The projection of the voxel centres of a grid into the image of a frame. The result is cached."""
    return memo("frame_geometry", (frame.key, grid.key), lambda: _frame_geometry(frame, grid))


def _frame_geometry(frame: Frame, grid: VoxelGrid) -> FrameGeometry:
    camera = frame.camera
    exact = camera.pose.as_matrix().tobytes()  # the camera's key is rounded
    pixel, z, z64 = memo("voxels in image", (camera.key, exact, grid.key), lambda: _projected(camera, grid))
    inside = pixel >= 0
    measured = np.where(frame.valid, frame.depth, np.nan).ravel()
    signed = np.full(grid.shape, np.nan, np.float32)
    signed[inside] = z64[inside] - measured[pixel[inside]]
    return FrameGeometry(pixel, z, read_only(signed))


def _projected(camera: Camera, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel of every voxel centre in the images of a camera, and its z-depth in single and in double precision."""
    u, v, z, inside = camera.pixels_of(grid.centres())
    pixel = np.where(inside & (z > 1e-6), v * camera.width + u, -1).astype(np.int32)
    return read_only(pixel), read_only(z.astype(np.float32)), read_only(z)


def frame_points(frame: Frame, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices (k,) of the pixels with a reading inside the grid, and the voxels (k, 3) of these readings."""

    def compute() -> tuple[np.ndarray, np.ndarray]:
        index = grid.index_of(frame.points)
        pixels = np.flatnonzero(frame.valid & grid.contains(index))
        return read_only(pixels), read_only(index.reshape(-1, 3)[pixels].astype(np.int32))

    return memo("frame_points", (frame.key, grid.key), compute)


def in_columns(grid: VoxelGrid, points: np.ndarray) -> np.ndarray:
    """(...) bool: whether x and y of points (..., 3) are inside the grid."""
    index = grid.index_of(points)[..., :2]
    return np.asarray(((index >= 0) & (index < np.array(grid.shape[:2]))).all(axis=-1))


_MIN_HEIGHT = 0.01  # metres above the table beyond which a reading may show an object

_BORDER = 0.03  # metres: a wall may stand at the border of the visible table
_MARGIN = 0.05  # metres of the workspace around the visible table
_LEAST_SIDE, _LARGEST_SIDE, _HEIGHT = 1.0, 2.0, 0.5  # metres


def workspace(frame: Frame, voxel_size: float = 0.01) -> VoxelGrid:
    """A grid with voxels of `voxel_size` metres around the visible part of the table. The table is at z = 0.

    The grid is .5 m high and 1 to 2 m long and wide. The grid covers as much of the table as possible. If the
    table is shorter or longer than the grid along an axis, the grid is shifted towards the depth readings that are
    more than 1 cm above the table. Readings outside the visible table, for example on a wall, are ignored.
    """
    check_number("voxel size", voxel_size, above=0, at_most=0.5, unit="number of metres")
    points = frame.points[frame.valid]
    table = without_strips(points[np.abs(points[:, 2]) < _MIN_HEIGHT, :2], frame.camera.position[:2])
    raised = points[(points[:, 2] > _MIN_HEIGHT) & (points[:, 2] < _HEIGHT), :2]
    if len(table):
        low, high = np.percentile(table, (1, 99), axis=0)
        raised = raised[((raised > low + _BORDER) & (raised < high - _BORDER)).all(axis=1)]
    elif len(raised):
        low, high = np.percentile(raised, (2, 98), axis=0)
    chosen = raised if len(raised) >= 200 else table
    if len(chosen) == 0:
        raise InputError(
            "no workspace: no depth reading is on or above the table",
            "check the pose (z is up, the table is at z = 0) and the depth scale",
            "or give the grid: VoxelGrid(origin, voxel_size, shape)",
        )
    side = np.clip(np.ceil((high - low + 2 * _MARGIN) * 10) / 10, _LEAST_SIDE, _LARGEST_SIDE)
    reach = np.sort([low - _MARGIN + side / 2, high + _MARGIN - side / 2], axis=0)  # of the centre
    centre = np.clip(np.percentile(chosen, (2, 98), axis=0).mean(axis=0), *reach)
    origin = np.append(np.round((centre - side / 2) / voxel_size) * voxel_size, 0.0)
    return VoxelGrid(origin, voxel_size, (*map(round, side / voxel_size), round(_HEIGHT / voxel_size)))

"""Places in a grid or an image that a query is about, checked: voxels, regions, pixels.

>>> voxel_of(grid, [0.1, 0.0, 0.02])             # metres -> (x, y, z) index
>>> region_of(grid, box_of(grid, lower, upper))  # (m,) flat numbers of the voxels of a region
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Camera, VoxelGrid

__all__ = ["box_of", "camera_of", "flat_of", "pixels_of", "region_of", "single", "voxel_of"]


def voxel_of(grid: VoxelGrid, points: Any) -> np.ndarray:
    """Voxels (..., 3) that hold world points (..., 3) in metres."""
    points = np.asarray(points, dtype=np.float64)
    if points.shape[-1:] != (3,):
        raise InputError(f"points have shape {points.shape}, expected (..., 3) in metres")
    index = grid.index_of(points)
    outside = ~grid.contains(index)
    if outside.any():
        raise InputError(
            f"point {points[outside][0].tolist()} m lies outside the grid ({outside.sum()} of {outside.size} do)",
            _reach(grid),
        )
    return index


def box_of(grid: VoxelGrid, lower: Any, upper: Any) -> np.ndarray:
    """(X, Y, Z) bool: voxels whose centres lie in the box between two corners (3,) in metres."""
    lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    if lower.shape != (3,) or upper.shape != (3,):
        raise InputError(f"corners of a box have shapes {lower.shape} and {upper.shape}, expected (3,) in metres")
    centres = grid.centres()
    inside = ((centres >= lower) & (centres <= upper)).all(axis=-1)
    if not inside.any():
        raise InputError(
            f"the box from {lower.tolist()} to {upper.tolist()} m holds the centre of no voxel", _reach(grid)
        )
    return inside


def flat_of(grid: VoxelGrid, voxels: Any) -> np.ndarray:
    """(...) flat numbers of voxels (..., 3)."""
    index = np.asarray(voxels)
    if index.shape[-1:] != (3,) or not np.issubdtype(index.dtype, np.integer):
        raise InputError(
            f"voxels have type {index.dtype} and shape {index.shape}, expected integers (..., 3)",
            "belief.voxel(points) finds the voxels of points in metres",
        )
    outside = ~grid.contains(index)
    if outside.any():
        raise InputError(f"voxel {index[outside][0].tolist()} lies outside the grid of {grid.shape} voxels")
    return np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), grid.shape)


def region_of(grid: VoxelGrid, region: Any) -> np.ndarray:
    """(m,) flat numbers of the voxels of a region, a bool array of the grid's shape or voxels (..., 3); each once."""
    where = np.asarray(region)
    if where.dtype != bool:
        return np.unique(flat_of(grid, where))
    if where.shape != grid.shape:
        raise InputError(f"region has shape {where.shape}, the grid is {grid.shape}")
    return np.flatnonzero(where)


def single(index: Any, k: int) -> np.ndarray:
    """One voxel (3,) or pixel (2,), not several."""
    index = np.asarray(index)
    if index.shape != (k,):
        raise InputError(f"one {'voxel' if k == 3 else 'pixel'} was expected, {k} integers, not shape {index.shape}")
    return index


def camera_of(camera: Any) -> Camera:
    """The camera, if it is one."""
    if not isinstance(camera, Camera):
        raise InputError(f"a view is from a Camera, not from {type(camera).__name__}")
    return camera


def pixels_of(camera: Camera, pixels: Any) -> tuple[np.ndarray, np.ndarray]:
    """Rows (...) and columns (...) of pixels (..., 2), which are (column, row)."""
    index = np.asarray(pixels)
    if index.shape[-1:] != (2,) or not np.issubdtype(index.dtype, np.integer):
        raise InputError(
            f"pixels have type {index.dtype} and shape {index.shape}, expected integers (..., 2)",
            "a pixel is (column, row)",
        )
    outside = ((index < 0) | (index >= (camera.width, camera.height))).any(axis=-1)
    if outside.any():
        raise InputError(
            f"pixel {index[outside][0].tolist()} lies outside the image of {camera.width} x {camera.height}",
            "a pixel is (column, row)",
        )
    return index[..., 1], index[..., 0]


def _reach(grid: VoxelGrid) -> str:
    return f"the grid reaches from {grid.origin.tolist()} to {grid.upper.tolist()} m"

"""Where every voxel of a grid lies in a depth image.

>>> geometry = frame_geometry(frame, grid)
>>> geometry.known_free(0.005)        # voxels that the sensor looked through

Computed once a frame and shared by completion, free space and scoring.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.scene.arrays import read_only
from mstfilter.scene.cache import memo
from mstfilter.scene.camera import Camera
from mstfilter.scene.frame import Frame
from mstfilter.scene.voxels import VoxelGrid

__all__ = ["FrameGeometry", "frame_geometry"]


@dataclass(frozen=True, eq=False)
class FrameGeometry:
    """Voxel centres of a grid seen from a frame.

    Parameters
    ----------
    pixel : (X, Y, Z) int32
        Flat index of the pixel that sees the centre; -1 outside the image or behind the camera.
    z : (X, Y, Z) float32
        z-depth of the centre in metres.
    signed : (X, Y, Z) float32
        `z` minus the measured depth there: negative in front of the surface, positive behind; NaN where
        nothing is known (outside the image, no reading, robot).
    """

    pixel: np.ndarray
    z: np.ndarray
    signed: np.ndarray

    def known_free(self, margin: float | np.ndarray) -> np.ndarray:
        """(X, Y, Z) bool: centres more than `margin` metres in front of the measured surface."""
        with np.errstate(invalid="ignore"):
            return self.signed < -np.asarray(margin, dtype=np.float32)

    @property
    def unknown(self) -> np.ndarray:
        """(X, Y, Z) bool: nothing was measured along the ray of the centre."""
        return np.isnan(self.signed)


def frame_geometry(frame: Frame, grid: VoxelGrid) -> FrameGeometry:
    """The geometry of a frame and a grid, memoised by content."""
    return memo("frame_geometry", (frame.key, grid.key), lambda: _compute(frame, grid))


def _compute(frame: Frame, grid: VoxelGrid) -> FrameGeometry:
    camera = frame.camera
    exact = camera.pose.as_matrix().tobytes()  # the camera's key is rounded
    pixel, z, z64 = memo("voxels in image", (camera.key, exact, grid.key), lambda: _projected(camera, grid))
    inside = pixel >= 0
    measured = np.where(frame.valid, frame.depth, np.nan).ravel()
    signed = np.full(grid.shape, np.nan, np.float32)
    signed[inside] = z64[inside] - measured[pixel[inside]]
    return FrameGeometry(pixel, z, read_only(signed))


def _projected(camera: Camera, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel, and z-depth in single and in double precision, of every voxel centre: the same for all frames."""
    uv, z = camera.project(grid.centres())
    with np.errstate(invalid="ignore"):
        u, v = np.rint(uv[..., 0]), np.rint(uv[..., 1])
        inside = (z > 1e-6) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    pixel = np.full(grid.shape, -1, np.int32)
    pixel[inside] = (v[inside] * camera.width + u[inside]).astype(np.int32)
    return read_only(pixel), read_only(z.astype(np.float32)), read_only(z)

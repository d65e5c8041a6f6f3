"""Heights of depth readings above the table, in the units of the sensor and of its noise.

>>> above_table(frame)                  # (H, W) sensor units, which grow with the square of depth in metres
>>> height_in_noise(frame)              # (H, W) in units of the noise of this sensor at this place
>>> readings_above_table(frame, grid)   # (H, W) bool, every reading above the table

The noise of a Kinect is about one sensor unit at any distance, and readings of its table are at most two units
(`TABLE_TOLERANCE`) from the plane. Other sensors are noisier, up to five times on a dark table, and tables bend. Both
show in the readings below the table, where nothing else is. The table is the plane z = 0 if the camera has a pose,
else `fit_support_plane`.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from mstfilter.scene.arrays import read_only
from mstfilter.scene.cache import memo
from mstfilter.scene.camera import Camera, scaled_length
from mstfilter.scene.frame import Frame
from mstfilter.scene.planes import TABLE_TOLERANCE, fit_support_plane, table_residual
from mstfilter.scene.voxels import VoxelGrid

# Lengths are those of an image of 640 x 480 pixels.
_NOISE_REACH = 40.0  # standard deviation of the surroundings that show the noise of the table, pixels
_NEAR_MEAN = 3.0  # in units of noise: readings farther from the mean of the table are not of the table
_DEEPEST = 20.0  # sensor units: readings farther below are not of the table
_FEW_READINGS = 0.1  # share of readings of the table around a pixel at which those of the whole table count as much
_ROUNDS = 3  # of mean and noise, each without the readings that the other says are not of the table
_KINECT = 1.25  # standard deviation of the readings of a Kinect on a table, in sensor units
_DENSE = 0.8  # share of readings beside a reading: with less, depth has holes everywhere
_FINE = 20.0  # pixels: means over less than this are computed at half of the resolution, others at a quarter


def above_table(frame: Frame) -> np.ndarray:
    """Disparity minus the disparity of the table, (H, W) float32 in sensor units; NaN at pixels without a reading.

    One sensor unit is 1/8 px at f = 525 px, or 3.2 mm of depth at 1 m.
    """
    return fit_support_plane(frame).residual if frame.camera.T_world_camera is None else table_residual(frame)


def filled_above_table(frame: Frame) -> np.ndarray:
    """The values of `above_table`. For a sparse sensor, missing pixels take the value of the nearest reading."""
    return _filled(frame, above_table(frame))


def _filled(frame: Frame, height: np.ndarray) -> np.ndarray:
    beside = cv2.blur(frame.valid.astype(np.float32), (3, 3))[frame.valid]
    return fill_from_nearest(height, ~frame.valid) if len(beside) and beside.mean() < _DENSE else height


def fill_from_nearest(depth: np.ndarray, holes: np.ndarray) -> np.ndarray:
    """Depth (H, W) in which each pixel of `holes` (H, W) bool has the depth of the nearest reading."""
    if not holes.any() or holes.all():
        return depth
    rows, columns = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
    return np.asarray(depth[rows, columns])


def posed_camera(frame: Frame) -> Camera:
    """The camera of a frame. A missing pose is computed relative to the fitted table (`fit_support_plane`)."""
    camera = frame.camera
    return camera if camera.T_world_camera is not None else camera.at(fit_support_plane(frame).T_world_camera)


def pixels_above_table(frame: Frame) -> np.ndarray:
    """Pixels (H, W) that have a reading above the table and do not show the robot."""
    with np.errstate(invalid="ignore"):
        return frame.valid & (above_table(frame) > TABLE_TOLERANCE)


def height_in_noise(frame: Frame, filled: bool = False) -> np.ndarray:
    """The values of `above_table` in units of the noise of this sensor at this place, (H, W) float32.

    Around each pixel, the mean of the readings of the table is subtracted if it is negative, because the table bends
    down there. The noise is the root mean square of the readings below this mean, relative to that of a Kinect, and
    at least that of a Kinect. Readings above the mean are not used, because they can be of flat objects. With
    `filled`, missing pixels are as in `filled_above_table`. The result is cached.
    """
    height = memo("height_in_noise", frame.key, lambda: read_only(_height_in_noise(frame)))
    return _filled(frame, height) if filled else height


def _height_in_noise(frame: Frame) -> np.ndarray:
    height = above_table(frame)
    with np.errstate(invalid="ignore"):
        below = frame.valid & (height > -_DEEPEST) & (height < 0)
    if not below.any():
        return height
    typical = max(1.0, -float(np.median(height[below])) / 0.6745)  # the median of |x| for a normal x is .6745
    mean, noise = np.zeros_like(height), np.full_like(height, typical)
    for _ in range(_ROUNDS):
        with np.errstate(invalid="ignore"):
            off = np.where(frame.valid, height - mean, np.nan)
            table = (np.abs(off) < _NEAR_MEAN * noise) & (height > -_DEEPEST)
            mean = np.minimum(mean + _mean_around(off, table), 0)
            off = np.where(frame.valid, height - mean, np.nan)
            below = (off < 0) & (off > -_NEAR_MEAN * noise) & (height > -_DEEPEST)
        noise = np.sqrt(np.maximum(_mean_around(off**2, below) / _KINECT**2, 1))
    return ((height - mean) / noise).astype(np.float32)


def _mean_around(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Mean (H, W) of an image at the `pixels` (H, W) bool around each pixel; where they are few, of all of them."""
    own = np.where(pixels, image, 0).astype(np.float32)
    few = _FEW_READINGS / max(int(pixels.sum()), 1)
    share = surroundings(pixels.astype(np.float32), _NOISE_REACH) + _FEW_READINGS
    return (surroundings(own, _NOISE_REACH) + few * float(own.sum(dtype=np.float64))) / share


def readings_above_table(frame: Frame, grid: VoxelGrid | None = None) -> np.ndarray:
    """The `pixels_above_table` (H, W) bool with a reading in the grid. Without a grid, no pixel is excluded."""
    pixels = pixels_above_table(frame)
    return pixels if grid is None else pixels & grid.contains(grid.index_of(frame.points))


def surroundings(image: np.ndarray, reach: float) -> np.ndarray:
    """Mean of an image (H, W, ...) around each pixel, computed at a lower resolution."""
    size, step = (image.shape[1], image.shape[0]), 4 if reach > _FINE else 2
    small = cv2.resize(image, (max(1, size[0] // step), max(1, size[1] // step)), interpolation=cv2.INTER_AREA)
    spread = max(1.0, scaled_length(reach, size[0]) / step)
    small = cv2.GaussianBlur(small, (0, 0), spread, borderType=cv2.BORDER_CONSTANT)
    return cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)

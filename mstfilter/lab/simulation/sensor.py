"""Models of a structured-light depth sensor and of a colour camera.

The depth sensor shifts pixels on depth edges sideways, in small patches. Disparity has Gaussian noise and is rounded
to eighths of a Kinect pixel (f = 525 pixels, baseline 75 mm). Noise and rounding give depth a standard deviation of
1.85 mm (z / m)^2, as measured on real table tops. There is no reading in the shadow of the projector (to the left of
objects), at some depth edges, on surfaces at a grazing angle, and out of range. The colour camera has optical blur,
photon noise and the sRGB curve.

>>> import numpy as np
>>> from mstfilter.lab.simulation.sensor import DepthSensor
>>> flat = np.full((40, 60), 0.8, np.float32)
>>> noisy = DepthSensor().read(np.random.default_rng(0), flat, np.ones_like(flat))
>>> bool(abs(np.nanmean(noisy) - 0.8) < 0.001)
True
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mstfilter.base.fields import Bounded, NonNegativeFloat, Share

_FOCAL, _BASELINE = 525.0, 0.075  # pixels of the sensor's raster of 640 pixels per row, metres
_EIGHTHS = 8.0 * _FOCAL * _BASELINE  # disparity at one metre, eighths of a pixel
_DISPARITY_NOISE = 0.5  # standard deviation before rounding, eighths of a pixel
_EDGE_STEP = 0.02  # relative difference of depth between neighbours from which they form an edge
_PATCH = 3  # side of the square of pixels of the raster that are shifted or lost together
_GRAZING = 1.4  # angle of incidence beyond which there is no reading, radians
_NEAREST, _FARTHEST = 0.4, 4.0  # range, metres

_BLUR = 0.45  # standard deviation of the blur of the colour camera's optics, pixels
_PHOTON_NOISE = 0.010  # standard deviation at white, as a share of white; proportional to the root of the light
_READ_NOISE = 0.002  # standard deviation in the dark, as a share of white

#: Pairs of views of an image that hold vertical and horizontal neighbours.
NEIGHBOURS = ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1]))


@dataclass(frozen=True)
class DepthSensor(Bounded):
    """Depth noise of a Kinect v1 or Xtion.

    Parameters
    ----------
    lateral : float
        Standard deviation of the sideways shift on depth edges, in pixels of the sensor's raster.
    edge_dropout : float
        Probability that a patch of pixels within two pixels of a depth edge has no reading. `edge_dropout` and `fill`
        were fitted to the frequencies of missing readings 1 .. 10 pixels beside objects in 45 real frames.
    fill : float
        Width by which the sensor narrows a projector shadow, in pixels of the sensor's raster.
    """

    lateral: NonNegativeFloat = 0.5
    edge_dropout: Share = 0.12
    fill: NonNegativeFloat = 2.5

    def read(self, rng: np.random.Generator, depth: np.ndarray, slant: np.ndarray) -> np.ndarray:
        """Depth image (H, W) float32 in metres, NaN for no reading.

        `depth` (H, W) is the true z-depth in metres, with NaN for no surface. `slant` (H, W) is the cosine of
        incidence.
        """
        h, w = depth.shape
        edge = _depth_edges(depth)
        # The raster has 640 pixels per row; smaller images are scaled from it. The sideways shift frays edges; within
        # a surface it is part of the axial noise, which was measured on tilted tables.
        scale = w / 640.0
        side = max(1, round(_PATCH * scale))
        aside = self.lateral * scale * edge
        rows = np.arange(h)[:, None] + np.rint(_patches(rng.standard_normal, h, w, side) * aside).astype(np.int64)
        columns = np.arange(w)[None, :] + np.rint(_patches(rng.standard_normal, h, w, side) * aside).astype(np.int64)
        at = np.clip(rows, 0, h - 1), np.clip(columns, 0, w - 1)
        z, cosine = depth[at], slant[at]
        noise = rng.standard_normal((h, w)) * _DISPARITY_NOISE
        with np.errstate(invalid="ignore", divide="ignore"):
            reading = _EIGHTHS / np.maximum(np.rint(_EIGHTHS / z + noise), 1.0)
        wide = edge.copy()
        for axis in (0, 1):
            wide |= np.roll(edge, 1, axis) | np.roll(edge, -1, axis)
        lost = wide & (_patches(rng.uniform, h, w, side) < self.edge_dropout)
        lost |= self._unlit(depth)[at]
        lost |= (cosine < np.cos(_GRAZING)) | (reading < _NEAREST) | (reading > _FARTHEST)
        return np.where(lost | ~np.isfinite(z), np.nan, reading).astype(np.float32)

    def _unlit(self, depth: np.ndarray) -> np.ndarray:
        """Pixels (H, W) bool that the projector does not illuminate. The projector is to the right of the camera.

        A pixel in column u with depth z is in column u - f b / z of the projector's image. A pixel is in shadow if
        a pixel to its right in the camera's image is to its left in the projector's image.
        """
        w = depth.shape[1]
        disparity = _FOCAL * w / 640.0 * _BASELINE / np.where(np.isfinite(depth), depth, np.inf)
        there = np.arange(w) - disparity
        least = np.minimum.accumulate(there[:, ::-1], axis=1)[:, ::-1]
        return there > least + self.fill * w / 640.0


def _depth_edges(depth: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool on either side of a step in depth."""
    edge = np.zeros(depth.shape, bool)
    for here, there in NEIGHBOURS:
        first, second = depth[here], depth[there]
        with np.errstate(invalid="ignore"):
            step = ~(np.abs(first - second) <= _EDGE_STEP * np.minimum(first, second))
        step &= np.isfinite(first) | np.isfinite(second)
        edge[here] |= step
        edge[there] |= step
    return edge


def _patches(draw: Callable[..., np.ndarray], h: int, w: int, side: int) -> np.ndarray:
    """Random values (h, w) that are constant within squares of side x side pixels."""
    small = draw(size=(-(-h // side), -(-w // side)))
    return np.repeat(np.repeat(small, side, axis=0), side, axis=1)[:h, :w]


def colour_reading(rng: np.random.Generator, linear: np.ndarray) -> np.ndarray:
    """sRGB image (H, W, 3) uint8 of a colour camera from exposed linear light (H, W, 3), in which 1 is white."""
    import cv2

    light = np.maximum(cv2.GaussianBlur(linear, (0, 0), _BLUR), 0.0)
    # Compress highlights instead of clipping them, as cameras do.
    light = np.where(light > 0.7, 0.7 + 0.3 * np.tanh((light - 0.7) / 0.3), light)
    noise = rng.standard_normal(light.shape, dtype=np.float32)
    light = light + noise * np.sqrt(_PHOTON_NOISE**2 * light + _READ_NOISE**2)
    return _DISPLAY[np.clip(light * 4095.0 + 0.5, 0, 4095).astype(np.int64)]


def _display_curve() -> np.ndarray:
    light = np.arange(4096) / 4095.0
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.clip(np.rint(255.0 * value), 0, 255).astype(np.uint8)


_DISPLAY = _display_curve()

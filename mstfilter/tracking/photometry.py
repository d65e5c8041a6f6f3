"""Colours of one frame in the exposure of another.

A camera's automatic exposure and white balance change the colour of everything when something moves: on real
pauses most of an untouched table differs by more than 12 grey levels. A gain and an offset per channel,
fitted where depth says that nothing changed, take that out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mstfilter.scene import Frame, depth_sigma, memo

__all__ = ["matched_colour", "same_depth"]

N_PIXELS = 20000
PRIOR = 20.0**2  # grey levels squared: where colours vary less than this the gain stays near 1


def same_depth(first: Frame, other: Frame, sigmas: float = 4.0) -> NDArray[np.bool_]:
    """(H, W): both frames have a reading off the robot, and they differ by less than noise explains."""
    limit = sigmas * np.sqrt(2.0) * depth_sigma(first.depth)
    with np.errstate(invalid="ignore"):
        return (np.abs(other.depth - first.depth) <= limit) & first.valid & other.valid


def smooth_colour(frame: Frame, width: int = 3) -> NDArray[np.float32]:
    """Colour (H, W, 3) blurred over ``width`` pixels, so that a shift below a pixel costs little."""
    import cv2

    return memo(
        "smooth colour",
        (frame.key, width),
        lambda: cv2.GaussianBlur(frame.rgb, (width, width), 0).astype(np.float32),
    )


def matched_colour(frame: Frame, reference: Frame, width: int = 3) -> NDArray[np.float32]:
    """Smooth colour (H, W, 3) of a frame, as if taken with the exposure of the reference. Memoised."""

    def compute() -> NDArray[np.float32]:
        gain, offset = _exposure(frame, reference)
        return smooth_colour(frame, width) * gain + offset

    return memo("matched colour", (frame.key, reference.key, width), compute)


def _exposure(frame: Frame, reference: Frame) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Gain (3,) and offset (3,) that take colours of the frame to those of the reference."""
    still = np.flatnonzero(same_depth(reference, frame))
    if len(still) < 500:  # no depth: most of the image is taken to be still
        still = np.arange(frame.depth.size)
    still = still[:: max(1, len(still) // N_PIXELS)]
    x_all = smooth_colour(frame).reshape(-1, 3)[still].astype(np.float64)
    y_all = smooth_colour(reference).reshape(-1, 3)[still].astype(np.float64)
    inside = ((x_all > 3) & (x_all < 252) & (y_all > 3) & (y_all < 252)).all(axis=1)  # not clipped
    x_all, y_all = x_all[inside], y_all[inside]
    gain, offset = np.ones(3), np.zeros(3)
    if len(x_all) < 100:
        return gain.astype(np.float32), offset.astype(np.float32)
    for c in range(3):
        x, y = x_all[:, c], y_all[:, c]
        g, o = 1.0, float(np.median(y - x))
        for _ in range(5):
            error = np.abs(y - (g * x + o))
            keep = error <= max(2.5 * float(np.median(error)), 1.0)
            mx, my = x[keep].mean(), y[keep].mean()
            g = (((x[keep] - mx) * (y[keep] - my)).mean() + PRIOR) / (x[keep].var() + PRIOR)
            o = my - g * mx
        if 0.4 < g < 2.5:
            gain[c], offset[c] = g, o
    return gain.astype(np.float32), offset.astype(np.float32)

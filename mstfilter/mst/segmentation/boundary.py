"""Boundary maps from colour gradients and concave depth edges, without learned weights.

>>> boundary = ColourDepthBoundary().boundary(frame)       # (H, W) float32 in 0 .. 1

Most objects are convex. So where two of them touch, or where one stands on the table, depth has a concave crease or a
step, while a convex crease, such as the edge of a box, lies inside one object. Both are looked for in disparity, D =
8 f b / z (f focal length, b baseline, z depth), because D is affine in the pixel coordinates on a plane and its noise
does not depend on depth: the largest eigenvalue of its Hessian responds to creases and steps only. Colour adds the
boundaries that depth does not show, with a low weight, because print on a box is no boundary.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import cv2
import numpy as np

from mstfilter.base.results import Checked, check_array, check_type, returns
from mstfilter.scene import (
    BASELINE,
    TABLE_TOLERANCE,
    Clip,
    Frame,
    fill_from_nearest,
    filled_above_table,
    scaled_length,
)

#: Focal length in pixels that defines the sensor's disparity unit: 1/8 pixel of a 640 x 480 Kinect, whatever the
#: size of the image. The noise (0.58 units) and all thresholds then stay the same when an image is resized.
SENSOR_FOCAL = 525.0
_LIGHTNESS_UNIT, _CHROMA_UNIT = 20.0, 8.0  # differences of L and of a, b (CIE Lab) of colour strength 1


class BoundaryModel(Checked, ABC):
    """Estimates the boundaries between objects in a frame."""

    @returns(lambda self, found, frame: check_array(found, frame.depth.shape, "f", 0, 1))
    @abstractmethod
    def boundary(self, frame: Frame) -> np.ndarray:
        """(H, W) float32 in 0 .. 1: boundary strength of each pixel."""


class ClipBoundary(BoundaryModel):
    """A boundary model that depends on the clip, for example because it reads a file for each pause."""

    @returns(lambda self, found, clip: check_type(found, BoundaryModel, "a BoundaryModel"))
    @abstractmethod
    def at(self, clip: Clip) -> BoundaryModel:
        """The model for the last frame of a clip. Its `component_key` includes the content of its files."""


@dataclass(frozen=True)
class ColourDepthBoundary(BoundaryModel):
    """The maximum of weighted colour edges (structure tensor) and concave depth edges (disparity Hessian).

    Parameters
    ----------
    colour_weight : float
        Weight of the colour edges; 0 disables colour.
    quiet_table : float
        The boundary is 0 at pixels farther than this from all surfaces above the table, in pixels of a 640 px wide
        image, so print and shadows on the table are ignored. A negative distance disables this.
    """

    colour_weight: float = 0.4
    quiet_table: float = 12.0

    def boundary(self, frame: Frame) -> np.ndarray:
        """Boundary strength (H, W). The strength is 1 at the rim of the robot and 0 inside the robot."""
        resize = scaled_length(1, frame.camera.width)
        edges: np.ndarray = np.zeros(frame.depth.shape, np.float32)
        if self.colour_weight > 0:
            edges = self.colour_weight * _colour_edges(frame.rgb, resize)
        if frame.valid.any():
            concave, _ = curvature(filled_disparity(frame), resize)
            # The response is reduced where missing depth was filled in.
            missing = cv2.GaussianBlur((~frame.valid).astype(np.float32), (0, 0), _blur(resize))
            edges = np.maximum(edges, concave * (1 - missing))
        if self.quiet_table >= 0 and frame.valid.any():
            height = filled_above_table(frame)
            with np.errstate(invalid="ignore"):
                object_like = (height > TABLE_TOLERANCE).astype(np.uint8)
            # Single pixels above the table are noise; blocks of 3 x 3 are not.
            object_like = cv2.morphologyEx(object_like, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
            reach = 2 * max(1, round(self.quiet_table * resize)) + 1
            near = cv2.dilate(object_like, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
            edges = np.where(near > 0, edges, 0)
        if frame.robot_mask is not None and frame.robot_mask.any():
            robot = frame.robot_mask.astype(np.uint8)
            inside = cv2.erode(robot, np.ones((3, 3), np.uint8), borderValue=1)
            edges = np.where(inside > 0, 0, np.where(robot > 0, 1, edges))
        return np.clip(edges, 0, 1).astype(np.float32)


def _colour_edges(rgb: np.ndarray, resize: float) -> np.ndarray:
    """e / (1 + e) for the strength e of the structure tensor of Lab colour, averaged over three scales."""
    lab = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)
    lab /= np.array([_LIGHTNESS_UNIT, _CHROMA_UNIT, _CHROMA_UNIT], np.float32)
    xx = np.zeros(rgb.shape[:2], np.float32)
    yy, xy = xx.copy(), xx.copy()
    for scale in (1.0, 2.0, 4.0):
        s = max(0.7, scale * resize)
        smooth = cv2.GaussianBlur(lab, (0, 0), s)
        # A Sobel filter gives 8 times the derivative per pixel; the factor s makes scales comparable.
        gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) * (s / 8)
        gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1) * (s / 8)
        xx += (gx * gx).sum(axis=2) / 3
        yy += (gy * gy).sum(axis=2) / 3
        xy += (gx * gy).sum(axis=2) / 3
    middle, radius = _eigenvalues(xx, yy, xy)
    strength = np.sqrt(np.maximum(middle + radius, 0))
    return strength / (1 + strength)


def filled_disparity(frame: Frame) -> np.ndarray:
    """Disparity (H, W) float32 in sensor units. Pixels without a reading take the nearest value."""
    return (8 * SENSOR_FOCAL * BASELINE / fill_from_nearest(frame.depth, ~frame.valid)).astype(np.float32)


def curvature(disparity: np.ndarray, resize: float) -> tuple[np.ndarray, np.ndarray]:
    """Two maps (H, W) of the strength of the concave and of the convex curvature of a disparity image (H, W).

    A curvature x has the strength x / (x + 2). The concave one is the largest eigenvalue of the Hessian, the convex
    one minus the smallest. `resize` is the image width / 640.
    """
    s = _blur(resize)
    smooth = cv2.GaussianBlur(disparity, (0, 0), s)
    factor = s * s / 4
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0) * factor
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2) * factor
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1) * factor
    middle, radius = _eigenvalues(xx, yy, xy)
    concave, convex = np.maximum(middle + radius, 0), np.maximum(radius - middle, 0)
    return concave / (concave + 2), convex / (convex + 2)


def _blur(resize: float) -> float:
    """Standard deviation in pixels of the blur that is applied before the Hessian."""
    return max(1.0, 2.5 * resize)


def _eigenvalues(xx: np.ndarray, yy: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and half the difference of the eigenvalues of the symmetric matrices [[xx, xy], [xy, yy]]."""
    return (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)

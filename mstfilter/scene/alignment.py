"""Measurements in several frames: whether depth lies below colour, and whether the camera moved between two pauses.

>>> peak, lost, shift = edge_agreement([Edges(frame) for frame in frames])
>>> still, moved, metres = Corners(frame, grid).moved(Corners(later, grid))
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mstfilter.scene.frame import Frame
from mstfilter.scene.geometry import in_columns
from mstfilter.scene.voxels import VoxelGrid

_SHIFTS = 16  # pixels of an image of 320 columns
_MIN_EDGES = 120  # pixels of depth edges; fewer are taken for noise
_BOX = np.ones((3, 3), np.uint8)


class Edges:
    """The depth edges of a frame, and the places of the colour image where the colour changes most."""

    def __init__(self, frame: Frame) -> None:
        import cv2

        depth = np.where(frame.valid, frame.depth, np.nan)
        near, far = cv2.erode(np.nan_to_num(depth, nan=9.0), _BOX), cv2.dilate(np.nan_to_num(depth, nan=0.0), _BOX)
        known = cv2.erode(frame.valid.astype(np.uint8), _BOX) > 0
        inner = slice(_SHIFTS, -_SHIFTS)
        self.rgb, self.width = frame.rgb, frame.depth.shape[1]
        #: (H - 32, W - 32) float32, 0 or 1
        self.depth = (known & (far - near > 0.03 + 0.02 * near)).astype(np.float32)[inner, inner]

    def under_colour(self, sigma: float) -> np.ndarray:
        """(33, 33): sum of the ranks of colour gradients at the depth edges, for each shift of -16 to 16 pixels.

        If `sigma` is not 0, the colour image is smoothed with this standard deviation in pixels.
        """
        import cv2

        smooth = cv2.GaussianBlur(self.rgb.astype(np.float32), (0, 0), sigma) if sigma else None
        rgb = cv2.GaussianBlur(self.rgb, (3, 3), 0).astype(np.float32) if smooth is None else smooth
        across, down = np.abs(np.diff(rgb, axis=1, append=rgb[:, -1:])), np.abs(np.diff(rgb, axis=0, append=rgb[-1:]))
        gradient = np.maximum(across, down).max(axis=2)
        ranks = np.searchsorted(np.sort(gradient, axis=None), gradient) / gradient.size
        return np.asarray(cv2.matchTemplate(ranks.astype(np.float32), self.depth, cv2.TM_CCORR))


def edge_agreement(edges: Sequence[Edges], sigma: float = 0.0) -> tuple[float, float, tuple[int, int]]:
    """Agreement of depth edges and colour edges at all pauses, for different shifts of the colour images.

    Returns the best agreement minus the median over all shifts, the relative loss of this difference without a
    shift, and the best shift (rows, columns) in pixels of an image with 320 columns. If `sigma` is not 0, the colour
    images are smoothed with this standard deviation in pixels, so that finer texture has no effect.
    """
    edges = [edge for edge in edges if min(edge.depth.shape) >= 2 * _SHIFTS]
    count = sum(float(edge.depth.sum()) for edge in edges)
    if count < _MIN_EDGES:
        return 0.0, 0.0, (0, 0)
    scores = np.sum([edge.under_colour(sigma) for edge in edges], axis=0) / count
    row, column = np.unravel_index(scores.argmax(), scores.shape)
    peak = float(scores.max() - np.median(scores))
    middle = slice(_SHIFTS - 1, _SHIFTS + 2)
    lost = float(scores.max() - scores[middle, middle].max()) / max(peak, 1e-9)
    return peak, lost, (int(row) - _SHIFTS, int(column) - _SHIFTS)


MIN_MOVED = 15  #: matched corners that agree with a moved camera
_MIN_HEIGHT = 0.01  # metres above the table beyond which a reading may show an object


class Corners:
    """Image corners (ORB) on static surfaces: on the table and outside the workspace."""

    def __init__(self, frame: Frame, grid: VoxelGrid) -> None:
        import cv2

        points = frame.points
        with np.errstate(invalid="ignore"):
            still = (np.abs(points[..., 2]) < _MIN_HEIGHT) | ~in_columns(grid, points)
        mask = cv2.erode((still & frame.valid).astype(np.uint8), np.ones((9, 9), np.uint8))
        grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        corners, self.features = cv2.ORB_create(1000, fastThreshold=4).detectAndCompute(grey, mask)  # type: ignore[attr-defined]
        self.pixels = np.array([corner.pt for corner in corners]).reshape(-1, 2)
        column, row = np.rint(self.pixels).astype(int).T
        self.points, self.camera = points[row, column], frame.camera

    def moved(self, other: Corners) -> tuple[int, int, float]:
        """Number of corners at rest, number of corners that moved together, and median shift (m) of the latter."""
        import cv2

        if self.features is None or other.features is None:
            return 0, 0, 0.0
        matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(self.features, other.features)
        pairs = np.array([(m.queryIdx, m.trainIdx) for m in matches if m.distance < 50], int).reshape(-1, 2)
        expected, z = other.camera.project(self.points[pairs[:, 0]])
        pairs, expected, z = (part[np.isfinite(expected[:, 0])] for part in (pairs, expected, z))
        found, tolerance = other.pixels[pairs[:, 1]], other.camera.width / 160
        if len(pairs) < MIN_MOVED:
            return len(pairs), 0, 0.0
        distance = np.linalg.norm(found - expected, axis=1)
        inlier = cv2.findHomography(expected, found, cv2.RANSAC, tolerance / 2, maxIters=500)[1]
        away = (np.zeros(len(pairs), bool) if inlier is None else inlier.ravel() > 0) & (distance > tolerance)
        metres = distance[away] * z[away] / other.camera.K[0, 0]
        return int((distance <= tolerance).sum()), int(away.sum()), float(np.median(metres)) if away.any() else 0.0

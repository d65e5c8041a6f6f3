"""Precision, recall and F of segments and of their borders, for objects matched one to one.

The measures are defined by Y. Xie, Y. Xiang, A. Mousavian, D. Fox, "Unseen object instance segmentation for robotic
environments" (2021), section VI-A. Objects are matched so that the sum of F is largest, and the pixels of all objects
are pooled. A border pixel is correct if its distance to the true border is at most .3 % of the image's diagonal.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

_NEAR = 0.003


def segment_f(labels: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Overlap F and boundary F of labels (H, W) against true labels (H, W). In both, 0 means no object."""
    size = int(labels.max()) + 1, int(truth.max()) + 1
    both = np.bincount((labels * size[1] + truth).ravel(), minlength=size[0] * size[1]).reshape(size)
    areas, true_areas = both.sum(axis=1)[1:], both.sum(axis=0)[1:]
    shared = both[1:, 1:]
    f = 2 * shared / np.maximum(areas[:, None] + true_areas[None], 1)
    rows, columns = linear_sum_assignment(-f)
    found = shared[rows, columns].sum()
    square = np.ones((3, 3), np.uint8)
    radius = int(np.ceil(_NEAR * np.hypot(*labels.shape)))
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    borders = [_border(labels == k, square) for k in range(1, size[0])]
    true_borders = [_border(truth == k, square) for k in range(1, size[1])]
    right = hit = 0
    for a, b in zip(rows.tolist(), columns.tolist(), strict=True):
        if shared[a, b]:
            right += int((borders[a] & cv2.dilate(true_borders[b], disk)).sum())
            hit += int((true_borders[b] & cv2.dilate(borders[a], disk)).sum())
    return (
        _f(found, areas.sum(), found, true_areas.sum()),
        _f(right, sum(int(one.sum()) for one in borders), hit, sum(int(one.sum()) for one in true_borders)),
    )


def _border(mask: np.ndarray, square: np.ndarray) -> np.ndarray:
    """The pixels (H, W) uint8 of a mask that touch another label."""
    inside = mask.astype(np.uint8)
    return inside & (1 - cv2.erode(inside, square, borderValue=1))


def _f(right: float, claimed: float, hit: float, true: float) -> float:
    """F score for precision `right` / `claimed` and recall `hit` / `true` (numbers of pixels)."""
    precision, recall = (a / b if b else 0.0 for a, b in ((right, claimed), (hit, true)))
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0

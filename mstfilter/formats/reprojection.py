"""Images of cameras with the same optical centre and the same axes, brought into one camera.

>>> colour_in(rgb, source, target), depth_in(depth, source, target), labels_in(mask, source, target)

Pixel (u, v) of the target shows the same ray as pixel ((u - c) f_source / f_target + c_source) of the source, in each
direction, whatever the depth is. So depth that a recorder has registered to colour, but stores smaller, needs no
projection of points.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.scene import Camera

_SAME = 0.02  # pixels
_SURFACE = 0.01  # share of the depth: neighbours that differ by more are on two surfaces


def colour_in(image: np.ndarray, source: Camera, target: Camera) -> np.ndarray:
    """A colour image (H, W, 3) uint8 of `source` as `target` sees it, with the mean of the pixels that are joined."""
    import cv2

    factor = target.K[0, 0] / source.K[0, 0]
    if factor < 0.75:  # the interpolation below would skip pixels
        source = source.scaled(factor)
        image = cv2.resize(image, (source.width, source.height), interpolation=cv2.INTER_AREA)
    return image if _same(source, target) else _remap(image, source, target, cv2.INTER_LINEAR, 0)


def labels_in(image: np.ndarray, source: Camera, target: Camera) -> np.ndarray:
    """A label image or mask (H, W) of `source` as `target` sees it."""
    import cv2

    return image if _same(source, target) else _remap(image, source, target, cv2.INTER_NEAREST, 0)


def depth_in(depth: np.ndarray, source: Camera, target: Camera) -> np.ndarray:
    """A depth image (H, W) float32 of `source` as `target` sees it.

    The inverse depth is interpolated, so that a plane remains a plane, except between two surfaces and at holes.
    There, each pixel has the depth of the nearest pixel.
    """
    import cv2

    if _same(source, target):
        return depth
    nearest = _remap(depth, source, target, cv2.INTER_NEAREST, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        smooth = 1 / _remap(1 / depth, source, target, cv2.INTER_LINEAR, np.nan)
        on_surface = np.abs(smooth - nearest) <= _SURFACE * nearest
    return np.where(on_surface, smooth, nearest).astype(np.float32)


def resized_to(camera: Camera, shape: tuple[int, ...], where: str) -> Camera:
    """The camera of an image with this shape (height, width) that shows the same view.

    Raises InputError if the sizes are not in proportion, since the image then shows another view.
    """
    height, width = shape[:2]
    resized = camera.scaled(width / camera.width)
    if abs(resized.height - height) > 1:
        raise InputError(
            f"{where} has depth of {width} x {height}, colour of {camera.width} x {camera.height}: depth is not "
            "registered to colour",
            "align depth to colour when recording (each depth pixel must belong to the colour pixel above it)",
        )
    return resized if resized.height == height else Camera(resized.K, width, height)


def _same(source: Camera, target: Camera) -> bool:
    sizes = (source.width, source.height) == (target.width, target.height)
    return sizes and bool(np.abs(source.K - target.K).max() < _SAME)


def _remap(image: np.ndarray, source: Camera, target: Camera, how: int, outside: Any) -> np.ndarray:
    import cv2

    pixels = np.arange(target.width), np.arange(target.height)
    x, y = (
        ((p - target.K[i, 2]) / target.K[i, i] * source.K[i, i] + source.K[i, 2]).astype(np.float32)
        for i, p in enumerate(pixels)
    )
    u, v = np.broadcast_to(x, (len(y), len(x))), np.broadcast_to(y[:, None], (len(y), len(x)))
    border = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": outside}
    return np.asarray(cv2.remap(image, np.ascontiguousarray(u), np.ascontiguousarray(v), how, **border))

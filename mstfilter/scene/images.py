"""Image files: written so that the same pixels give the same bytes, read so that a broken file is one clear error."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mstfilter.errors import InputError

__all__ = ["read_depth", "read_labels", "read_rgb", "write_image"]

_PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\x00\x00\x00\x00IEND\xaeB\x60\x82"


def _decode(path: Path, flags: int) -> np.ndarray:
    import cv2

    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(
            f"image is missing: {path}", "record the frame again, or take it out of manifest.json"
        ) from None
    except OSError as error:
        raise InputError(f"image cannot be read: {path} ({error.strerror})") from error
    if data.startswith(_PNG_START) and not data.endswith(_PNG_END):
        # The decoder would fill the lost rows with zeros and say nothing.
        raise InputError(f"image is truncated: {path} ({len(data)} bytes, no end of PNG)", "copy the file again")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise InputError(f"image cannot be decoded: {path} ({len(data)} bytes)", "expected a PNG or JPEG file")
    return image


def read_rgb(path: Path) -> np.ndarray:
    """Colour image (H, W, 3) uint8, RGB."""
    import cv2

    image = _decode(path, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(image[..., ::-1])


def read_depth(path: Path, scale: float) -> np.ndarray:
    """Depth image (H, W) float32 in metres, NaN where the file holds 0; `scale` is metres a unit."""
    import cv2

    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise InputError(
            f"depth image {path} has shape {image.shape} and type {image.dtype}, expected one channel of 16 bits"
        )
    return np.where(image > 0, image * np.float32(scale), np.float32(np.nan)).astype(np.float32)


def read_labels(path: Path) -> np.ndarray:
    """Label image (H, W) uint8 or uint16."""
    import cv2

    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"label image {path} has shape {image.shape} and type {image.dtype}, expected one channel")
    return image


def write_image(path: Path, image: np.ndarray) -> None:
    """Write a PNG: (H, W, 3) uint8 RGB, or (H, W) uint8 / uint16."""
    import cv2

    data = image[..., ::-1] if image.ndim == 3 else image
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(data), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not done:
        raise InputError(f"image cannot be written: {path}, shape {image.shape}, type {image.dtype}")
    path.write_bytes(encoded.tobytes())

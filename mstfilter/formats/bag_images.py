"""Images of ROS messages: sensor_msgs/Image and sensor_msgs/CompressedImage as arrays.

>>> colour_of(message, "message 3 of /camera/color/image_raw")        # (H, W, 3) uint8 RGB
>>> depth_of(message, 0.001, "message 3 of /camera/depth/image_raw")  # (H, W) float32 metres, NaN = no reading

16UC1 and mono16 are units of the depth scale (millimetres by convention, REP 118), 32FC1 is metres. Compressed depth
is a PNG, or the ``compressedDepth`` transport: 12 bytes of header (quantisation A, B of 32FC1), then a PNG.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from mstfilter.errors import InputError

__all__ = ["COLOUR", "DEPTH", "GREY", "colour_of", "depth_of", "encoding_of"]

COLOUR = ("rgb8", "bgr8", "rgba8", "bgra8", "mono8", "8UC1", "8UC3", "8UC4", "yuv422", "yuv422_yuy2", "uyvy", "yuyv")
"""Encodings of colour images that are read."""
GREY = ("mono8", "8UC1")
"""Those of them without colour."""
DEPTH = ("16UC1", "mono16", "32FC1")
"""Encodings of depth images that are read."""
_PNG = b"\x89PNG\r\n\x1a\n"


def encoding_of(message: Any, compressed: bool) -> str:
    """The encoding of an image message; of a compressed one ``16UC1``, ``32FC1`` or ``compressed colour``."""
    if not compressed:
        return str(message.encoding)
    named = str(message.format)
    return next((e for e in DEPTH if named.startswith(e) or ("compressedDepth" in named and e in named)), "") or (
        "16UC1" if "compressedDepth" in named else "compressed colour"
    )


def colour_of(message: Any, compressed: bool, where: str) -> np.ndarray:
    """Colour image (H, W, 3) uint8, RGB."""
    import cv2

    if compressed:
        image = cv2.imdecode(np.frombuffer(bytes(message.data), np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise InputError(f"{where} cannot be decoded: {message.format!r}, {len(message.data)} bytes")
        return np.ascontiguousarray(image[..., ::-1])
    encoding = str(message.encoding)
    if encoding not in COLOUR:
        raise InputError(
            f"{where} has encoding {encoding!r}, which is not read as colour", f"read are: {', '.join(COLOUR)}"
        )
    if encoding in GREY:
        return np.repeat(_pixels(message, np.dtype(np.uint8), 1, where), 3, axis=2)
    if encoding in ("yuv422", "uyvy", "yuv422_yuy2", "yuyv"):
        code = cv2.COLOR_YUV2RGB_UYVY if encoding in ("yuv422", "uyvy") else cv2.COLOR_YUV2RGB_YUY2
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(_pixels(message, np.dtype(np.uint8), 2, where)), code))
    channels = 4 if encoding in ("rgba8", "bgra8", "8UC4") else 3
    image = _pixels(message, np.dtype(np.uint8), channels, where)[..., :3]
    return np.ascontiguousarray(image if encoding.startswith("rgb") else image[..., ::-1])


def depth_of(message: Any, compressed: bool, depth_scale: float, where: str) -> np.ndarray:
    """Depth image (H, W) float32 in metres, NaN where there is no reading."""
    encoding = encoding_of(message, compressed)
    if encoding not in DEPTH:
        raise InputError(f"{where} has encoding {encoding!r}, which is no depth", f"depth is: {', '.join(DEPTH)}")
    if compressed:
        metres = _compressed_depth(bytes(message.data), encoding, depth_scale, where)
    elif encoding == "32FC1":
        metres = _pixels(message, np.dtype(np.float32), 1, where)[..., 0].astype(np.float32)
    else:
        metres = _pixels(message, np.dtype(np.uint16), 1, where)[..., 0] * np.float32(depth_scale)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(np.nan)).astype(np.float32)


def _pixels(message: Any, kind: np.dtype[Any], channels: int, where: str) -> np.ndarray:
    """Pixels (H, W, channels) of an uncompressed image; rows may be padded."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    if min(height, width) < 1 or step < width * channels * kind.itemsize or data.size < height * step:
        raise InputError(
            f"{where} says {width} x {height} of {message.encoding} in rows of {step} bytes, holds {data.size} bytes"
        )
    rows = data[: height * step].reshape(height, step)[:, : width * channels * kind.itemsize]
    order = kind.newbyteorder(">" if message.is_bigendian else "<")
    return np.ascontiguousarray(rows).view(order).reshape(height, width, channels).astype(kind)


def _compressed_depth(data: bytes, encoding: str, depth_scale: float, where: str) -> np.ndarray:
    import cv2

    start = data.find(_PNG, 0, 64)
    image = None
    if start >= 0:
        image = cv2.imdecode(np.frombuffer(data[start:], np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2 or image.dtype != np.uint16:
        raise InputError(
            f"{where} is not a 16-bit PNG ({len(data)} bytes)",
            "compressed depth is read as PNG only, not RVL or JPEG",
        )
    if encoding != "32FC1":
        return image * np.float32(depth_scale)
    if start != 12:
        raise InputError(f"{where} is compressed 32FC1 without its header of 12 bytes")
    a, b = struct.unpack("<ff", data[4:12])
    with np.errstate(divide="ignore"):
        return np.where(image > 0, a / (image.astype(np.float64) - b), np.nan).astype(np.float32)

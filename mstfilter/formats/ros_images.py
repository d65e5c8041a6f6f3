"""Images in ROS messages: sensor_msgs/Image, CompressedImage and the transport ``compressedDepth``.

>>> rgb = colour_image(message, False, "a message")                # (H, W, 3) uint8
>>> metres = depth_image(message, False, 0.001, "a message")       # (H, W) float32, NaN = no reading

Depth with encoding 16UC1 or mono16 is in units of the depth scale (millimetres by convention, REP 118). Depth with
encoding 32FC1 is in metres. Compressed depth is a PNG. In the transport ``compressedDepth``, a header of 12 bytes
(quantisation A, B of 32FC1) precedes the PNG.

The messages may be those of rosbags or of a ROS node. The library rosbags-image does not replace this module: it
ignores the padding of rows (`step`), has no compressed depth, and takes ``8UC3`` for RGB.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.formats.images import decode_image
from mstfilter.scene import check_depth

#: Encoding of a colour image -> its channels, and OpenCV's conversion to RGB.
_COLOUR = {
    "rgb8": (3, ""),
    "bgr8": (3, "BGR2RGB"),
    "8UC3": (3, "BGR2RGB"),
    "rgba8": (4, "RGBA2RGB"),
    "bgra8": (4, "BGRA2RGB"),
    "8UC4": (4, "BGRA2RGB"),
    "mono8": (1, "GRAY2RGB"),
    "8UC1": (1, "GRAY2RGB"),
    "yuv422": (2, "YUV2RGB_UYVY"),
    "uyvy": (2, "YUV2RGB_UYVY"),
    "yuv422_yuy2": (2, "YUV2RGB_YUY2"),
    "yuyv": (2, "YUV2RGB_YUY2"),
}
GREY, DEPTH = ("mono8", "8UC1"), ("16UC1", "mono16", "32FC1")  #: encodings of grey images, and of depth


def image_encoding(message: Any, compressed: bool) -> str:
    """The encoding of an image message; ``16UC1``, ``32FC1`` or ``compressed colour`` for a compressed image."""
    if not compressed:
        return str(message.encoding)
    named = str(message.format)
    packed = "compressedDepth" in named
    known = [e for e in DEPTH if named.startswith(e) or (packed and e in named)]
    return known[0] if known else "16UC1" if packed else "compressed colour"


def colour_image(message: Any, compressed: bool, where: str) -> np.ndarray:
    """Colour image (H, W, 3) uint8, RGB."""
    import cv2

    if compressed:
        problem = f"{where} cannot be decoded: {message.format!r}, {len(message.data)} bytes"
        image = decode_image(bytes(message.data), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, problem)
        return np.ascontiguousarray(image[..., ::-1])
    _check_encoding(str(message.encoding), _COLOUR, f"{where}: colour")
    channels, conversion = _COLOUR[str(message.encoding)]
    pixels = _pixels(message, np.dtype(np.uint8), channels, where)
    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}"))) if conversion else pixels


def depth_image(message: Any, compressed: bool, depth_scale: float, where: str) -> np.ndarray:
    """Depth image (H, W) float32 in metres, NaN without a reading."""
    encoding = image_encoding(message, compressed)
    _check_encoding(encoding, DEPTH, f"{where}: depth")
    if compressed:
        metres = _compressed_depth(bytes(message.data), encoding, depth_scale, where)
    elif encoding == "32FC1":
        metres = _pixels(message, np.dtype(np.float32), 1, where)[..., 0]
        check_depth(metres, where)
    else:
        metres = _metres(_pixels(message, np.dtype(np.uint16), 1, where)[..., 0], depth_scale)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(np.nan)).astype(np.float32)


def _check_encoding(encoding: str, known: Iterable[str], what: str) -> None:
    if encoding not in known:
        text = f"{what} has encoding {encoding!r}, which is not supported"
        raise InputError(text, f"supported: {', '.join(known)}")


def _pixels(message: Any, kind: np.dtype[Any], channels: int, where: str) -> np.ndarray:
    """Pixels (H, W, channels) of an uncompressed image. The rows of the image may be padded."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    if min(height, width) < 1 or step < width * channels * kind.itemsize or data.size < height * step:
        raise InputError(
            f"{where} has {data.size} bytes for {width} x {height} of {message.encoding} in rows of {step} bytes"
        )
    rows = data[: height * step].reshape(height, step)[:, : width * channels * kind.itemsize]
    order = kind.newbyteorder(">" if message.is_bigendian else "<")
    return np.ascontiguousarray(rows).view(order).reshape(height, width, channels).astype(kind)


def _metres(units: np.ndarray, depth_scale: float) -> np.ndarray:
    """Depth in metres of an image (H, W) uint16; NaN for the value 65535, which means that there is no reading."""
    return np.where(units < 65535, units * np.float32(depth_scale), np.float32(np.nan))


def _compressed_depth(data: bytes, encoding: str, depth_scale: float, where: str) -> np.ndarray:
    import cv2

    start = data.find(b"\x89PNG\r\n\x1a\n", 0, 64)
    problem, hint = (
        f"{where} is not a 16-bit PNG ({len(data)} bytes)",
        "compressed depth must be PNG, not RVL or JPEG",
    )
    image = decode_image(data[start:] if start >= 0 else b"", cv2.IMREAD_UNCHANGED, problem, hint)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise InputError(problem, hint)
    if encoding != "32FC1":
        return _metres(image, depth_scale)
    if start != 12:
        raise InputError(f"{where} is compressed 32FC1 without its header of 12 bytes")
    a, b = struct.unpack("<ff", data[4:12])
    with np.errstate(divide="ignore"):
        return np.where(image > 0, a / (image.astype(np.float64) - b), np.nan).astype(np.float32)

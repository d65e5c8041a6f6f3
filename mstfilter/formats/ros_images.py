"""Images in ROS messages: sensor_msgs/Image, CompressedImage and the transport ``compressedDepth``.

>>> rgb = colour_image(message, False, "a message")                # (H, W, 3) uint8
>>> metres = depth_image(message, False, 0.001, "a message")       # (H, W) float32, NaN = no reading

Depth with encoding 16UC1 or mono16 is in units of the depth scale (millimetres by convention, REP 118). Depth with
encoding 32FC1 is in metres. Compressed depth is a PNG or RVL (`mstfilter.formats.rvl`). In the transport
``compressedDepth``, a header of 12 bytes precedes it. It has the numbers A and B of 32FC1, whose pixels are
A / depth + B.

Colour of 16 bits per channel is reduced to 8, and a Bayer pattern or NV12 becomes RGB. A grey image ``mono16`` counts
as depth unless it is chosen as colour.

The messages may be those of rosbags or of a ROS node. The library rosbags-image does not replace this module: it
ignores the padding of rows (`step`), has no compressed depth, and takes ``8UC3`` for RGB.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.formats.images import decode_image, is_depth_png
from mstfilter.formats.rvl import decode_rvl
from mstfilter.scene import check_depth

#: Encoding of a colour image -> its type, channels, and OpenCV's conversion to RGB.
_COLOUR: dict[str, tuple[type[np.generic], int, str]] = {
    "rgb8": (np.uint8, 3, ""),
    "bgr8": (np.uint8, 3, "BGR2RGB"),
    "8UC3": (np.uint8, 3, "BGR2RGB"),
    "rgba8": (np.uint8, 4, "RGBA2RGB"),
    "bgra8": (np.uint8, 4, "BGRA2RGB"),
    "8UC4": (np.uint8, 4, "BGRA2RGB"),
    "mono8": (np.uint8, 1, "GRAY2RGB"),
    "8UC1": (np.uint8, 1, "GRAY2RGB"),
    "yuv422": (np.uint8, 2, "YUV2RGB_UYVY"),
    "uyvy": (np.uint8, 2, "YUV2RGB_UYVY"),
    "yuv422_yuy2": (np.uint8, 2, "YUV2RGB_YUY2"),
    "yuyv": (np.uint8, 2, "YUV2RGB_YUY2"),
    "nv12": (np.uint8, 1, "YUV2RGB_NV12"),
    "nv21": (np.uint8, 1, "YUV2RGB_NV21"),
    "mono16": (np.uint16, 1, "GRAY2RGB"),
    "rgb16": (np.uint16, 3, ""),
    "bgr16": (np.uint16, 3, "BGR2RGB"),
    "16UC3": (np.uint16, 3, "BGR2RGB"),
    "rgba16": (np.uint16, 4, "RGBA2RGB"),
    "bgra16": (np.uint16, 4, "BGRA2RGB"),
}
for _pattern in ("RGGB", "BGGR", "GBRG", "GRBG"):  # the colours of the first two pixels of the first two rows
    for _bits, _type in (("8", np.uint8), ("16", np.uint16)):
        _COLOUR[f"bayer_{_pattern.lower()}{_bits}"] = (_type, 1, f"Bayer{_pattern}2RGB")
_HALF = {"nv12", "nv21"}  #: below the brightness, half as many rows have the chroma
GREY, DEPTH = ("mono8", "8UC1"), ("16UC1", "mono16", "32FC1")  #: encodings of grey images, and of depth


def image_encoding(message: Any, compressed: bool) -> str:
    """The encoding of an image message; ``16UC1``, ``32FC1`` or ``compressed colour`` for a compressed image."""
    if not compressed:
        return str(message.encoding)
    named = str(message.format)
    packed = "compressedDepth" in named
    known = [e for e in DEPTH if named.startswith(e) or (packed and e in named)]
    if not known and not packed and is_depth_png(bytes(message.data[:32])):  # a plain PNG of depth
        return "16UC1"
    return known[0] if known else "16UC1" if packed else "compressed colour"


def colour_image(message: Any, compressed: bool, where: str) -> np.ndarray:
    """Colour image (H, W, 3) uint8, RGB."""
    import cv2

    if compressed:
        problem = f"{where} cannot be decoded: {message.format!r}, {len(message.data)} bytes"
        image = decode_image(bytes(message.data), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, problem)
        return np.ascontiguousarray(image[..., ::-1])
    _check_encoding(str(message.encoding), _COLOUR, f"{where}: colour")
    encoding = str(message.encoding)
    kind, channels, conversion = _COLOUR[encoding]
    rows = int(message.height) * 3 // 2 if encoding in _HALF else int(message.height)
    pixels = _pixels(message, np.dtype(kind), channels, where, rows)
    rgb = np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}"))) if conversion else pixels
    return rgb if kind is np.uint8 else np.rint(rgb / 257).astype(np.uint8)


def depth_image(message: Any, compressed: bool, depth_scale: float, where: str) -> np.ndarray:
    """Depth image (H, W) float32 in metres, NaN without a reading."""
    encoding = image_encoding(message, compressed)
    _check_encoding(encoding, DEPTH, f"{where}: depth")
    if compressed:
        packed = _rvl_depth if "rvl" in str(message.format).lower() else _png_depth
        metres = _dequantised(bytes(message.data), packed(bytes(message.data), where), encoding, depth_scale, where)
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


def _pixels(message: Any, kind: np.dtype[Any], channels: int, where: str, rows: int = 0) -> np.ndarray:
    """Pixels (H, W, channels) of an uncompressed image. The rows of the image may be padded.

    `rows` is the number of stored rows, if it is not the height of the image.
    """
    height, width, step = rows or int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    if min(height, width) < 1 or step < width * channels * kind.itemsize or data.size < height * step:
        raise InputError(
            f"{where} has {data.size} bytes for {width} x {height} of {message.encoding} in rows of {step} bytes"
        )
    used = data[: height * step].reshape(height, step)[:, : width * channels * kind.itemsize]
    order = kind.newbyteorder(">" if message.is_bigendian else "<")
    return np.ascontiguousarray(used).view(order).reshape(height, width, channels).astype(kind)


def _metres(units: np.ndarray, depth_scale: float) -> np.ndarray:
    """Depth in metres of an image (H, W) uint16; NaN for the value 65535, which means that there is no reading."""
    return np.where(units < 65535, units * np.float32(depth_scale), np.float32(np.nan))


_HEADER = 12  # bytes before compressed depth


def _png_depth(data: bytes, where: str) -> np.ndarray:
    """The pixels (H, W) uint16 of compressed depth in a PNG."""
    import cv2

    start = data.find(b"\x89PNG\r\n\x1a\n", 0, 64)
    problem = f"{where} is neither RVL nor a 16-bit PNG ({len(data)} bytes)"
    hint = "publish the depth with compressedDepth as png or rvl; JPEG loses depth"
    image = decode_image(data[start:] if start >= 0 else b"", cv2.IMREAD_UNCHANGED, problem, hint)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise InputError(problem, hint)
    return image


def _rvl_depth(data: bytes, where: str) -> np.ndarray:
    """The pixels (H, W) uint16 of compressed depth in RVL, after width and height."""
    if len(data) < _HEADER + 8:
        raise InputError(f"{where} has {len(data)} bytes, too few for RVL", "copy the file again")
    width, height = struct.unpack("<II", data[_HEADER : _HEADER + 8])
    return decode_rvl(data[_HEADER + 8 :], width, height, where)


def _dequantised(data: bytes, pixels: np.ndarray, encoding: str, depth_scale: float, where: str) -> np.ndarray:
    """Depth in metres. 32FC1 is quantised in inverse depth, with the numbers A and B of the header."""
    if encoding != "32FC1":
        return _metres(pixels, depth_scale)
    if data.find(b"\x89PNG", 0, 64) not in (-1, _HEADER):
        raise InputError(f"{where} is compressed 32FC1 without its header of {_HEADER} bytes")
    a, b = struct.unpack("<ff", data[4:_HEADER])
    with np.errstate(divide="ignore"):
        return np.where(pixels > 0, a / (pixels.astype(np.float64) - b), np.nan).astype(np.float32)

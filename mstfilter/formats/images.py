"""Image files: colour, depth and label images, read safely and written without loss.

>>> rgb = read_rgb(path)                     # (H, W, 3) uint8
>>> depth = read_depth(path, scale=0.001)    # (H, W) float32 metres, NaN = no reading

PNG, JPEG and TIFF files are decoded by OpenCV, which keeps 16 bits. Pillow reads the size in the header before, since
a small file can announce an image that fills the memory.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.files import reading
from mstfilter.base.reading import read_arrays, read_bytes
from mstfilter.scene import check_depth

MAX_PIXELS = 2**25  #: Largest image that is decoded; 8K video has fewer pixels


def read_rgb(path: Path) -> np.ndarray:
    """Colour image (H, W, 3) uint8, RGB."""
    import cv2

    # The orientation is ignored, as in the depth image. The bits are kept, so that depth is not taken for colour.
    image = _decode_file(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.dtype != np.uint8:
        raise InputError(f"colour image {path} has type {image.dtype}, expected 8 bits", "is it a depth image?")
    return np.ascontiguousarray(image[..., ::-1])


def read_depth(path: Path, scale: float) -> np.ndarray:
    """Depth image (H, W) float32 in metres, NaN for no reading: the values 0 and (of 16 bits) 65535 in the file.

    16-bit integers are multiplied by `scale` (metres per unit). Floating-point values (.npy, .tif) must be in metres.
    """
    import cv2

    if path.suffix.lower() == ".npy":
        image = read_arrays(path, "an image", "expected .npy with an array (H, W)").get("", np.zeros(0))
    else:
        image = _decode_file(path, cv2.IMREAD_UNCHANGED)
    image = image.astype(image.dtype.newbyteorder("="), copy=False)
    floating = np.issubdtype(image.dtype, np.floating)
    if image.ndim != 2 or not (floating or image.dtype in (np.uint16, np.int16)):
        raise InputError(
            f"depth image {path} has shape {image.shape} and type {image.dtype}, expected one channel of 16 bits or "
            "float"
        )
    if floating:
        check_depth(image, f"depth image {path}")
        image = image.astype(np.float32)
    read = (image > 0) & (image != 65535)
    return np.where(read, image * np.float32(1 if floating else scale), np.float32(np.nan)).astype(np.float32)


def read_labels(path: Path) -> np.ndarray:
    """Label image (H, W) uint8 or uint16."""
    import cv2

    image = _decode_file(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"label image {path} has shape {image.shape} and type {image.dtype}, expected one channel")
    return image


def read_optional(path: Path | None = None) -> np.ndarray | None:
    """A label image or mask (H, W), or None if there is no such file."""
    return read_labels(path) if path is not None and path.is_file() else None


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3) uint8 RGB, or (H, W) uint8 or uint16, as a PNG file."""
    import cv2

    if image.dtype not in (np.uint8, np.uint16):  # OpenCV would clip the values to 8 bits
        raise InputError(f"image cannot be written: {path}, type {image.dtype}, expected uint8 or uint16")
    data = image[..., ::-1] if image.ndim == 3 else image
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(data), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not done:
        raise InputError(f"image cannot be written: {path}, shape {image.shape}, type {image.dtype}")
    path.write_bytes(encoded.tobytes())


def decode_image(data: bytes, flags: int, problem: str, *hints: str) -> np.ndarray:
    """Decode the bytes of a PNG, JPEG or TIFF file. `flags` are those of ``cv2.imdecode``.

    Raises InputError with the message `problem` if the bytes are not an image. An image of more than `MAX_PIXELS`
    pixels is not decoded and also raises InputError.
    """
    import cv2

    no_image = InputError(problem, *(hints or ("expected a PNG or JPEG file",)))
    size = _size(data)
    if size is None:
        raise no_image
    if size[0] * size[1] > MAX_PIXELS:
        raise InputError(f"{problem}: it has more than {MAX_PIXELS} pixels, the most that are read", *hints)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise InputError(f"{problem}: {str(error).splitlines()[0]}", *hints) from error
    if image is None or image.shape[:2] not in (size[::-1], size):  # turned, if its orientation is used
        raise no_image
    return image


def is_depth_png(data: bytes) -> bool:
    """Whether the first bytes of a file are those of a PNG with one channel of 16 bits."""
    return data.startswith(b"\x89PNG\r\n\x1a\n") and data[24:26] == b"\x10\x00"


def _size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the header of a PNG, JPEG or TIFF file; None for other files."""
    from PIL import Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin

    # Pillow imports the readers of all formats if it does not know one of these.
    readers = (PngImagePlugin.PngImageFile, JpegImagePlugin.JpegImageFile, TiffImagePlugin.TiffImageFile)
    try:
        with Image.open(io.BytesIO(data), formats=[reader.format for reader in readers]) as image:
            return image.size
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        return MAX_PIXELS, 2  # at least
    except Exception:  # the readers raise errors of many types for a damaged header
        return None


def _decode_file(path: Path, flags: int) -> np.ndarray:
    with reading(path, "an image"):
        if not path.exists():
            raise InputError(f"image is missing: {path}", "copy or record it again, or leave the frame out")
    data = read_bytes(path, "an image")
    # The decoder would fill the missing rows with zeros without an error.
    if data.startswith(b"\x89PNG") and not data.endswith(b"IEND\xaeB\x60\x82"):
        raise InputError(f"image is truncated: {path} ({len(data)} bytes, no end of PNG)", "copy the file again")
    if data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < len(data) // 2:  # its header may hold a small JPEG
        raise InputError(f"image is truncated: {path} ({len(data)} bytes, no end of JPEG)", "copy the file again")
    return decode_image(data, flags, f"image cannot be decoded: {path} ({len(data)} bytes)")

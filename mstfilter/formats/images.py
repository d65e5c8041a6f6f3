"""Image files: colour, depth and label images, read safely and written without loss.

>>> rgb = read_rgb(path)                     # (H, W, 3) uint8
>>> depth = read_depth(path, scale=0.001)    # (H, W) float32 metres, NaN = no reading

PNG, JPEG, TIFF, PGM, PPM and BMP files are decoded by OpenCV, which keeps 16 bits. Pillow reads the size in the
header before, since a small file can announce an image that fills the memory. Depth may also be an array (.npy,
.npz), or OpenEXR. OpenCV's wheels are built without OpenEXR, so the library OpenEXR (extra ``exr``) reads it. A file
may be a member of an archive, as `zipfile.Path` has it.
"""

from __future__ import annotations

import io
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from mstfilter.base.errors import InputError, missing_library
from mstfilter.base.files import reading
from mstfilter.base.reading import MAX_FILE, read_arrays, read_bytes
from mstfilter.scene import check_depth

MAX_PIXELS = 2**25  #: Largest image that is decoded; 8K video has fewer pixels
COLOUR_SUFFIXES = (".png", ".jpg", ".jpeg", ".ppm", ".bmp")
DEPTH_SUFFIXES = (".png", ".npy", ".npz", ".exr", ".tif", ".tiff", ".pgm")
_FAR = 1e5  #: metres; renderers write such numbers for pixels without a surface

File = Path | zipfile.Path


def read_rgb(path: File) -> np.ndarray:
    """Colour image (H, W, 3) uint8, RGB. 16 bits per channel are reduced to 8.

    A grey image of 16 bits, and one with three equal channels of 16 bits, is an error: it is probably depth.
    """
    import cv2

    # The orientation is ignored, as in the depth image. The bits are kept, so that depth is not taken for colour.
    image = _decode_file(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.dtype == np.uint16 and (image != image[..., :1]).any():
        image = np.rint(image / 257).astype(np.uint8)
    if image.dtype != np.uint8:
        raise InputError(f"colour image {path} has type {image.dtype}, expected 8 bits", "is it a depth image?")
    return np.ascontiguousarray(image[..., ::-1])


def read_depth(path: File, scale: float) -> np.ndarray:
    """Depth image (H, W) float32 in metres, NaN for no reading: the values 0 and (of 16 bits) 65535 in the file.

    16-bit integers are multiplied by `scale` (metres per unit). Floating-point values must be in metres. Three equal
    channels count as one.
    """
    import cv2

    kind = Path(path.name).suffix.lower()
    if kind in (".npy", ".npz"):
        image = _array(path)
    elif kind == ".exr":
        image = _read_exr(path)
    else:
        image = _decode_file(path, cv2.IMREAD_UNCHANGED)
    return depth_of(image, scale, f"depth image {path}")


def depth_of(image: np.ndarray, scale: float, where: str) -> np.ndarray:
    """Depth (H, W) float32 in metres from the stored numbers. See `read_depth`."""
    image = image.astype(image.dtype.newbyteorder("="), copy=False)
    floating = np.issubdtype(image.dtype, np.floating)
    stored = f"{where} has shape {image.shape} and type {image.dtype}"
    if image.dtype == np.uint8:
        hint = "8 bits, or the colours of a colour map, do not hold depth: export it with 16 bits or as floats"
        raise InputError(f"{stored}, expected one channel of 16 bits or float", hint)
    if image.ndim == 3 and image.shape[2] in (1, 3) and (image == image[..., :1]).all():
        image = image[..., 0]
    if image.ndim != 2 or not (floating or np.issubdtype(image.dtype, np.integer)):
        raise InputError(f"{stored}, expected one channel of 16 bits or float")
    if floating:
        image = np.where(np.abs(image) < _FAR, image, 0).astype(np.float32)  # also NaN
        check_depth(image, where)
    read = (image > 0) & (image != 65535)
    return np.where(read, image * np.float32(1 if floating else scale), np.float32(np.nan)).astype(np.float32)


def _array(path: File) -> np.ndarray:
    """The array of an .npy file; of an .npz file the only one, or the one with the name ``depth``."""
    hint = "expected an array (H, W), in an .npz file the only one or the one named depth"
    if not isinstance(path, Path):
        raise InputError(f"{path} is an array in an archive", "unpack the archive")
    arrays = read_arrays(path, "an image", hint)
    if path.suffix.lower() == ".npy":
        return arrays.get("", np.zeros(0))
    if "depth" not in arrays and len(arrays) != 1:
        raise InputError(f"depth image {path} has the arrays {', '.join(sorted(arrays))}", hint)
    return arrays["depth"] if "depth" in arrays else next(iter(arrays.values()))


def _read_exr(path: File) -> np.ndarray:
    """The depth (H, W) of an OpenEXR file: its only channel, or Z, depth or V, or R if R, G and B are equal."""
    try:
        import OpenEXR
    except ImportError as error:
        convert = "or convert the images to .npy or 16-bit .png"
        raise missing_library(error, "depth in OpenEXR files", convert, library="OpenEXR") from error
    data = file_content(path)
    with tempfile.TemporaryDirectory() as folder, reading(Path(str(path)), "an image"):
        file = Path(folder) / "depth.exr"  # the library reads files only
        file.write_bytes(data)
        low, high = OpenEXR.File(str(file), header_only=True).header()["dataWindow"]
        if np.prod(np.subtract(high, low) + 1.0) > MAX_PIXELS:
            raise InputError(f"image {path} has more than {MAX_PIXELS} pixels, the most that are read")
        channels = OpenEXR.File(str(file), separate_channels=True).channels()
        images = {name: np.array(channel.pixels) for name, channel in channels.items()}
    named = [name for name in images if name.rpartition(".")[2].lower() in ("z", "depth", "v")]
    if len(named) == 1 or len(images) == 1:
        return images[named[0] if len(named) == 1 else next(iter(images))]
    if set("RGB") <= set(images) and all(np.array_equal(images["R"], images[k], equal_nan=True) for k in "GB"):
        return images["R"]
    raise InputError(
        f"depth image {path} has the channels {', '.join(sorted(images))}", "name the channel of depth Z"
    )


def read_labels(path: File) -> np.ndarray:
    """Label image (H, W) uint8 or uint16."""
    import cv2

    image = _decode_file(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"label image {path} has shape {image.shape} and type {image.dtype}, expected one channel")
    return image


def read_optional(path: File | None = None) -> np.ndarray | None:
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
    """Decode the bytes of an image file. `flags` are those of ``cv2.imdecode``.

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
    """Width and height in the header of a PNG, JPEG, TIFF, PPM or BMP file; None for other files."""
    from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, PpmImagePlugin, TiffImagePlugin

    # Pillow imports the readers of all formats if it does not know one of these.
    readers = (PngImagePlugin.PngImageFile, JpegImagePlugin.JpegImageFile, TiffImagePlugin.TiffImageFile)
    plain = (PpmImagePlugin.PpmImageFile, BmpImagePlugin.BmpImageFile)
    try:
        with Image.open(io.BytesIO(data), formats=[reader.format for reader in (*readers, *plain)]) as image:
            return image.size
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        return MAX_PIXELS, 2  # at least
    except Exception:  # the readers raise errors of many types for a damaged header
        return None


def file_content(path: File) -> bytes:
    """The bytes of a file or of a member of an archive."""
    if isinstance(path, Path):
        with reading(path, "an image"):
            if not path.exists():
                raise InputError(f"image is missing: {path}", "copy or record it again, or leave the frame out")
        return read_bytes(path, "an image")
    with reading(Path(str(path)), "an image"):
        if (size := path.root.getinfo(path.at).file_size) > MAX_FILE:
            raise InputError(f"{path} has {size} bytes, at most {MAX_FILE} are read")
        return bytes(path.read_bytes())


def _decode_file(path: File, flags: int) -> np.ndarray:
    data = file_content(path)
    # The decoder would fill the missing rows with zeros without an error.
    if data.startswith(b"\x89PNG") and not data.endswith(b"IEND\xaeB\x60\x82"):
        raise InputError(f"image is truncated: {path} ({len(data)} bytes, no end of PNG)", "copy the file again")
    if data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < len(data) // 2:  # its header may hold a small JPEG
        raise InputError(f"image is truncated: {path} ({len(data)} bytes, no end of JPEG)", "copy the file again")
    return decode_image(data, flags, f"image cannot be decoded: {path} ({len(data)} bytes)")

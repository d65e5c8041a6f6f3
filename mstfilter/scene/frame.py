"""RGB-D images: frames, clips, image files and depth noise.

>>> frame = Frame(rgb, depth, camera)          # rgb (H, W, 3) uint8, depth (H, W) metres, NaN = no reading
>>> frame.points                               # (H, W, 3) world points in metres
>>> clip = Clip([frame, frame_2], grid, 1)     # the frames from pause 0 to pause 1
>>> clip.before, clip.after                    # its first and its last frame

If several cameras see the scene, one of them is the main camera, and only its images are segmented and tracked. The
others help to see what is free. Their simultaneous frames are the `views` of the main camera's frame:

>>> frame = Frame(rgb, depth, camera, views=(Frame(rgb_2, depth_2, camera_2),))
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from mstfilter.base.errors import InputError
from mstfilter.base.files import reading
from mstfilter.base.lazy import late
from mstfilter.base.reading import read_arrays, read_bytes
from mstfilter.scene.arrays import content_key, frozen, read_only
from mstfilter.scene.camera import Camera
from mstfilter.scene.voxels import VoxelGrid

_SIGMA_AT_ONE_METRE = 0.00185
MAX_PIXELS = 2**25  #: Largest image that is decoded; 8K video has fewer pixels


def depth_sigma(z: ArrayLike) -> np.ndarray:
    """Standard deviation (m) of a depth reading at z-depth `z` (m), in the shape of `z`.

    The sensor measures disparity, so the standard deviation grows with the square of depth: sigma = 0.00185 m (z /
    m)^2. The factor 0.00185 m was fitted to image patches of tables in 45 Kinect v1 and Xtion frames (0.6 to 1.5 m).
    Up to a depth of 1.2 m, the formula is within 10 % of the measured values.
    """
    z = np.asarray(z)
    return _SIGMA_AT_ONE_METRE * z * z


_PNG_START = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_PNG_END = b"\x00\x00\x00\x00IEND\xaeB\x60\x82"


def _decode(path: Path, flags: int) -> np.ndarray:
    with reading(path, "an image"):
        if not path.exists():
            raise InputError(f"image is missing: {path}", "copy or record it again, or leave the frame out")
    data = read_bytes(path, "an image")
    if data.startswith(_PNG_START) and not data.endswith(_PNG_END):
        # The decoder would fill the missing rows with zeros without an error.
        raise InputError(f"image is truncated: {path} ({len(data)} bytes, no end of PNG)", "copy the file again")
    if data.startswith(_JPEG_START) and data.rfind(_JPEG_END) < len(data) // 2:  # the header may hold a small JPEG
        raise InputError(f"image is truncated: {path} ({len(data)} bytes, no end of JPEG)", "copy the file again")
    return decode_image(data, flags, f"image cannot be decoded: {path} ({len(data)} bytes)")


def decode_image(data: bytes, flags: int, problem: str, *hints: str) -> np.ndarray:
    """Decode the bytes of a PNG, JPEG or TIFF file. `flags` are those of ``cv2.imdecode``.

    Raises InputError with the message `problem` if the bytes are not an image. An image of more than `MAX_PIXELS`
    pixels is not decoded and also raises InputError.
    """
    import cv2

    size = image_size(data)
    if size is None:
        raise InputError(problem, *(hints or ("expected a PNG or JPEG file",)))
    if size[0] * size[1] > MAX_PIXELS:
        raise InputError(f"{problem}: it is {size[0]} x {size[1]}, at most {MAX_PIXELS} pixels are read", *hints)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise InputError(f"{problem}: {str(error).splitlines()[0]}", *hints) from error
    if image is None or image.shape[:2] not in (size[::-1], size):  # turned, if its orientation is used
        raise InputError(problem, *(hints or ("expected a PNG or JPEG file",)))
    return image


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the header of a PNG, JPEG or TIFF file; None for other files."""
    if data.startswith(_PNG_START) and len(data) >= 24:
        return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    with contextlib.suppress(struct.error):
        if data.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff_size(data, "<" if data[:1] == b"I" else ">")
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the first frame header of a JPEG file. Raises struct.error if no header is found."""
    at = 2
    while True:
        mark, kind, length = struct.unpack_from(">BBH", data, at)
        if mark != 0xFF:
            return None
        if kind == 0xFF:  # a fill byte
            at += 1
        elif 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        else:
            at += 2 + length


def _tiff_size(data: bytes, order: str) -> tuple[int, int] | None:
    """Width and height in the first directory of a TIFF file. Raises struct.error for an incomplete directory."""
    (at,) = struct.unpack_from(f"{order}I", data, 4)
    (n,) = struct.unpack_from(f"{order}H", data, at)
    found = {}
    for k in range(n):
        tag, kind = struct.unpack_from(f"{order}HH", data, at + 2 + 12 * k)
        (found[tag],) = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", data, at + 10 + 12 * k)
    return (found[256], found[257]) if {256, 257} <= set(found) else None


_IN_METRES = "floating-point depth is read in metres, whatever the depth scale is: multiply millimetres by 0.001"


def check_depth(depth: np.ndarray, where: str, hint: str = _IN_METRES) -> None:
    """Raise InputError if the median of a depth image (H, W) is not plausible in metres. It may have no reading."""
    with np.errstate(invalid="ignore"):
        metres = depth[np.isfinite(depth) & (depth > 0)]
    median = float(np.median(metres)) if metres.size else 1.0
    if not 0.05 < median < 30:
        raise InputError(f"{where} has a median of {median:g} m, expected between 0.05 and 30 m", hint)


def read_rgb(path: Path) -> np.ndarray:
    """Colour image (H, W, 3) uint8, RGB."""
    import cv2

    # The orientation is ignored, as in the depth image. The bits are kept, so that depth is not taken for colour.
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
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
        image = _decode(path, cv2.IMREAD_UNCHANGED)
    image = image.astype(image.dtype.newbyteorder("="), copy=False)
    if image.ndim != 2 or not (image.dtype in (np.uint16, np.int16) or np.issubdtype(image.dtype, np.floating)):
        raise InputError(
            f"depth image {path} has shape {image.shape} and type {image.dtype}, expected one channel of 16 bits or "
            "float"
        )
    unit = scale
    if np.issubdtype(image.dtype, np.floating):
        unit = 1
        check_depth(image, f"depth image {path}")
        image = image.astype(np.float32)
    read = (image > 0) & (image != 65535)
    return np.where(read, image * np.float32(unit), np.float32(np.nan)).astype(np.float32)


def read_labels(path: Path) -> np.ndarray:
    """Label image (H, W) uint8 or uint16."""
    import cv2

    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"label image {path} has shape {image.shape} and type {image.dtype}, expected one channel")
    return image


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


def without_alpha(rgb: np.ndarray) -> np.ndarray:
    """Colour images (..., 3), from those or from images with an alpha channel (..., 4)."""
    return np.ascontiguousarray(rgb[..., :3]) if rgb.ndim > 2 and rgb.shape[-1] == 4 else rgb


_BLOCKS_ACROSS = 80


def grey_blocks(rgb: np.ndarray) -> np.ndarray:
    """Mean grey levels (h, w) float32 of the square blocks of an image (H, W, 3), with about 80 blocks per row."""
    grey = np.asarray(rgb, dtype=np.float32).mean(axis=2)
    side = max(1, grey.shape[1] // _BLOCKS_ACROSS)
    h, w = grey.shape[0] // side, grey.shape[1] // side
    return grey[: h * side, : w * side].reshape(h, side, w, side).mean(axis=(1, 3))


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB-D image with its camera: colour, and depth in metres that is registered to it.

    Parameters
    ----------
    rgb : (H, W, 3) uint8
        Colour image. A fourth channel (alpha) is dropped.
    depth : (H, W) float
        z-depth in metres, that is, along the optical axis. NaN, 0 and whatever is not positive and finite means that
        the pixel has no reading.
    camera : Camera
        Intrinsics and pose.
    robot_mask : (H, W) bool, optional
        Pixels that show the robot. What is behind them is unknown, not free.
    views : tuple of Frame
        Simultaneous frames of other cameras, which add free space. All cameras then need a pose in one world.
    estimated : (H, W) bool, optional
        Pixels whose depth is an estimate, not a reading (`mstfilter.scene.foreground`).
    """

    rgb: np.ndarray
    depth: np.ndarray
    camera: Camera
    robot_mask: np.ndarray | None = None
    views: tuple[Frame, ...] = ()
    estimated: np.ndarray | None = None

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width)
        rgb, depth = without_alpha(np.asarray(self.rgb)), np.ma.filled(self.depth, 0)
        if rgb.shape != (*shape, 3) or rgb.dtype != np.uint8:
            raise InputError(
                f"colour image has shape {rgb.shape} and type {rgb.dtype}, expected {(*shape, 3)} uint8",
                "image and camera must have the same size; colour is RGB with 8 bits per channel",
            )
        if depth.shape != shape:
            raise InputError(f"depth image has shape {depth.shape}, expected {shape}, the size of the camera")
        if not np.issubdtype(depth.dtype, np.floating):
            raise InputError(
                f"depth image has type {depth.dtype}, expected metres as float",
                "multiply raw readings by the depth scale, for example 0.001 for millimetres",
            )
        depth = depth.astype(np.float32, copy=True)
        with np.errstate(invalid="ignore"):
            depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
        check_depth(depth[::4, ::4], "depth image of the frame")
        object.__setattr__(self, "rgb", frozen(rgb))
        object.__setattr__(self, "depth", read_only(depth))
        for name in ("robot_mask", "estimated"):
            if (given := getattr(self, name)) is not None:
                mask = np.asarray(given, dtype=bool)
                if mask.shape != shape:
                    raise InputError(f"{name} of the frame has shape {mask.shape}, expected {shape}")
                object.__setattr__(self, name, frozen(mask))
        object.__setattr__(self, "views", tuple(self.views))
        if any(view.views for view in self.views):
            raise InputError("a view has views", "list all cameras as views of one frame")
        if self.views and any(view.camera.T_world_camera is None for view in self.all_views):
            raise InputError(
                f"at least one of {len(self.all_views)} cameras of a frame has no pose",
                "give every camera its T_world_camera in one world",
            )

    def __repr__(self) -> str:
        known = self.depth[np.isfinite(self.depth)]
        depth = "no depth"
        if len(known):
            share = known.size / self.depth.size
            depth = f"depth {known.min():.2f} to {known.max():.2f} m in {share:.0%} of the pixels"
        more = "" if self.robot_mask is None else ", robot mask"
        more += f", {len(self.views)} more views" if self.views else ""
        return f"Frame: {depth}{more}\n  {self.camera!r}"

    _repr_html_ = late("mstfilter.app.report.display:to_html", "What a notebook shows.")

    @cached_property
    def key(self) -> bytes:
        """Content key."""
        robot = b"" if self.robot_mask is None else self.robot_mask
        estimated = () if self.estimated is None else (self.estimated,)
        key = content_key("frame", self.rgb, self.depth, self.camera.key, robot, *estimated)
        return content_key("views", key, *(view.key for view in self.views)) if self.views else key

    def resized(self, camera: Camera, centred: bool = True) -> Frame:
        """The frame in the image size of a camera, without views.

        Depth is taken from the pixel at the centre of the new pixel, or at its upper left corner if not `centred`.
        """
        if camera is self.camera:
            return self
        import cv2

        size = camera.width, camera.height
        if size == (self.camera.width, self.camera.height):
            return Frame(self.rgb, self.depth, camera, self.robot_mask)
        robot, rule = self.robot_mask, cv2.INTER_NEAREST_EXACT if centred else cv2.INTER_NEAREST
        if robot is not None:
            robot = cv2.resize(robot.astype(np.uint8), size, interpolation=rule) > 0
        depth = cv2.resize(self.depth, size, interpolation=rule)
        return Frame(cv2.resize(self.rgb, size, interpolation=cv2.INTER_AREA), depth, camera, robot)

    @property
    def all_views(self) -> tuple[Frame, ...]:
        """The frame itself and its views."""
        return (self, *self.views)

    @cached_property
    def valid(self) -> np.ndarray:
        """(H, W) bool: pixels with a depth reading that do not show the robot."""
        valid = np.isfinite(self.depth)
        if self.robot_mask is not None:
            valid &= ~self.robot_mask
        return read_only(valid)

    @cached_property
    def points(self) -> np.ndarray:
        """(H, W, 3) float64 world points in metres, NaN at pixels without a reading."""
        return read_only(self.camera.unproject(self.depth))


@dataclass(frozen=True, eq=False)
class Clip:
    """What a filter observes in one step: the frames from one pause to the next, and the workspace.

    At a pause nothing moves, so the first frame (`before`) and the last one (`after`) can be segmented; those between
    show the action, through which objects are tracked. The first clip of a recording has a single frame.

    Parameters
    ----------
    frames : sequence of Frame
        The frames in time order. The first and the last show the scene at rest. They may be read on access.
    grid : VoxelGrid
        The workspace.
    index : int
        Number of the pause at the end of the clip, counted from 0. It is a part of the identities of new objects, so
        the numbers of successive clips have to ascend.
    times : tuple of float, optional
        Time of each frame in seconds.
    """

    frames: Sequence[Frame]
    grid: VoxelGrid
    index: int = 0
    times: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.frames) == 0:
            raise InputError(f"clip {self.index} has no frames")
        if self.times and len(self.times) != len(self.frames):
            raise InputError(f"clip {self.index} has {len(self.frames)} frames and {len(self.times)} times")

    def __repr__(self) -> str:
        seconds = f" over {self.times[-1] - self.times[0]:.1f} s" if self.times else ""
        frames = "1 frame" if len(self) == 1 else f"{len(self)} frames"
        return f"Clip {self.index}: {frames}{seconds}\n  {self.grid.text}"

    _repr_html_ = late("mstfilter.app.report.display:to_html", "What a notebook shows.")

    @cached_property
    def key(self) -> bytes:
        """Content key of all frames and the grid. The first access reads every image."""
        return content_key("frames", self.grid.key, *(frame.key for frame in self.frames))

    @property
    def before(self) -> Frame:
        """The frame at the previous pause."""
        return self.frames[0]

    @property
    def after(self) -> Frame:
        """The frame at the pause that ends the clip."""
        return self.frames[-1]

    def __len__(self) -> int:
        return len(self.frames)

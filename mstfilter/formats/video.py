"""Videos with depth: the interface of all readers, and common functions.

A reader is a subclass of `RecordingFormat`. A reader of videos is a `VideoFormat` with the method ``video(path)``:

>>> reader = Tum(K=(525, 525, 319.5, 239.5))
>>> if reader.detects(path):
...     recording = reader.open(path)

To read another layout, see the page "File formats" of the documentation. `Video` checks every frame on access.

By default, the camera pose at the first pause is computed from the support plane. Stored camera poses are used only
relative to the stored pose at the first pause, because the table is seldom at z = 0 in the axes of stored poses. A
`Camera` has no distortion, so distorted images are undistorted on access.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError, warn_user
from mstfilter.base.fields import Bounded, NonNegativeFloat, NonNegativeInt
from mstfilter.formats.images import read_depth, read_optional, read_rgb
from mstfilter.formats.pauses import Still
from mstfilter.scene import (
    WORKING_PIXELS,
    Camera,
    Frame,
    LazyFrames,
    PauseRule,
    Recording,
    VoxelGrid,
    check_depth,
    find_world,
    pauses_with_depth,
    rigid_from_matrix,
)


class RecordingFormat(ABC):
    """A layout of RGB-D data on disk. Subclasses are frozen dataclasses, with fields for data that the files lack."""

    @classmethod
    @abstractmethod
    def detects(cls, path: Path) -> bool:
        """Whether the file names at a path match the layout. The method raises no error."""

    @abstractmethod
    def open(self, path: Path) -> Recording:
        """The recording, with images in memory or read on access. Raises InputError if the data are not valid."""


_NEGLIGIBLE = 0.5  # pixels


def undistortion_map(camera: Camera, distortion: tuple[float, ...]) -> np.ndarray | None:
    """Column and row in the distorted image for each pixel of the undistorted image, (H, W, 2) float32.

    `distortion` has OpenCV's coefficients k1, k2, p1, p2, k3, ... None if all pixels move by less than half a pixel.
    """
    if not any(distortion):
        return None
    if len(distortion) not in (4, 5, 8, 12, 14) or not np.isfinite(distortion).all():
        raise InputError(
            f"distortion has {len(distortion)} numbers {tuple(distortion)}, expected 4, 5, 8, 12 or 14",
            "k1, k2, p1, p2, k3, ... in the order of OpenCV",
        )
    import cv2

    size = (camera.width, camera.height)
    x, y = cv2.initUndistortRectifyMap(camera.K, np.array(distortion, float), None, camera.K, size, cv2.CV_32FC1)
    source = np.stack([x, y], axis=-1)
    v, u = np.mgrid[: camera.height, : camera.width]
    return source if np.abs(source - np.stack([u, v], axis=-1)).max() >= _NEGLIGIBLE else None


def _undistort(image: np.ndarray, source: np.ndarray | None, outside: float = 0, smooth: bool = False) -> np.ndarray:
    """The undistorted image. `smooth` interpolates the values, which would be wrong for depth and labels."""
    import cv2

    if source is None:
        return image
    how = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
    fill: Any = outside
    return np.asarray(cv2.remap(image, source, None, how, borderMode=cv2.BORDER_CONSTANT, borderValue=fill))


@dataclass(frozen=True)
class KnownWorld:
    """Known camera pose and workspace. Empty fields are computed from the frame at the first pause."""

    #: tuple of 16 float: pose of the camera at the first pause, row by row: z up, table at z = 0, metres.
    T_world_camera: tuple[float, ...] = ()
    workspace: tuple[float, ...] = ()  #: tuple of 6 float: x, y, z of the lower, then of the upper corner, metres
    voxel_size: float = 0.01  #: metres

    @cached_property
    def pose(self) -> RigidTransform | None:
        """The given camera pose, or None if no pose is given."""
        if not (numbers := self.T_world_camera):
            return None
        if len(numbers) != 16:
            raise InputError(f"world.T_world_camera has {len(numbers)} numbers, expected 16, row by row")
        return rigid_from_matrix(np.reshape(numbers, (4, 4)), "world.T_world_camera")

    @cached_property
    def grid(self) -> VoxelGrid | float:
        """The given workspace, or its voxel size in metres if no workspace is given."""
        if not (box := self.workspace):
            return self.voxel_size
        if len(box) != 6:
            raise InputError(f"world.workspace has {len(box)} numbers, expected 6: x y z lower, x y z upper")
        return VoxelGrid.from_bounds(np.array(box[:3]), np.array(box[3:]), self.voxel_size)


@dataclass(frozen=True, eq=False)
class Video:
    """Frames on disk and their calibration."""

    name: str  #: for messages and reports
    times: tuple[float, ...]  #: seconds, one per frame, ascending
    read_rgb: Callable[[int], np.ndarray]  #: colour image (H, W, 3) uint8 of a frame, by index
    #: Depth image (H, W) float32 of a frame in metres, registered to the colour image; NaN = no reading.
    read_depth: Callable[[int], np.ndarray]
    K: tuple[float, ...]  #: fx, fy, cx, cy in pixels
    path: Path  #: file or folder
    depth_scale: float  #: metres per unit of the stored depth
    motion: Sequence[RigidTransform] | None = None  #: camera poses in any world, one per frame
    #: True label image of a frame, by index.
    read_instance: Callable[[int], np.ndarray | None] = field(default=lambda index: None)
    #: Image of a frame that is 0 except at the robot, by index.
    read_robot: Callable[[int], np.ndarray | None] = field(default=lambda index: None)
    distortion: tuple[float, ...] = ()  #: OpenCV's k1, k2, p1, p2, k3, ... of both images; they are undistorted
    max_pixels: int = WORKING_PIXELS  #: larger images are reduced; 0 means no limit

    @classmethod
    def of_files(
        cls,
        name: str,
        times: tuple[float, ...],
        pairs: Sequence[tuple[Path, ...]],
        K: tuple[float, ...],
        path: Path,
        depth_scale: float,
        **more: Any,
    ) -> Video:
        """A video with a colour file, a depth file and an optional file of the robot mask for each frame."""
        more["read_robot"] = lambda index: read_optional(*pairs[index][2:])
        images = lambda k: read_rgb(pairs[k][0]), lambda k: read_depth(pairs[k][1], depth_scale)
        return cls(name, times, *images, K, path, depth_scale, **more)

    def between(self, start_s: float, stop_s: float) -> Video:
        """The frames from `start_s` to `stop_s` seconds after the first frame."""
        kept = [k for k, t in enumerate(self.times) if start_s <= t - self.times[0] <= stop_s]
        if len(kept) == len(self.times):
            return self
        if not kept:
            raise InputError(
                f"{self.path}: no frame is between start_s={start_s:g} and stop_s={stop_s:g}; the video lasts "
                f"{self.times[-1] - self.times[0]:.1f} s"
            )
        return replace(
            self,
            times=tuple(self.times[k] for k in kept),
            read_rgb=lambda index: self.read_rgb(kept[index]),
            read_depth=lambda index: self.read_depth(kept[index]),
            motion=None if self.motion is None else [self.motion[k] for k in kept],
            read_instance=lambda index: self.read_instance(kept[index]),
            read_robot=lambda index: self.read_robot(kept[index]),
        )

    def frame_reader(self) -> tuple[Camera, Any, Callable[[int, Camera], Frame]]:
        """The camera without a pose, the undistortion map, and a function (index, camera) that reads a frame."""
        if not self.times:
            raise InputError(f"{self.path} has no pair of a colour and a depth image")
        if len(self.K) != 4:
            raise InputError(f"{self.path}: K has {len(self.K)} numbers, expected fx, fy, cx, cy in pixels")
        height, width = self.read_rgb(0).shape[:2]
        fx, fy, cx, cy = self.K
        if not (0 < cx < width and 0 < cy < height):
            raise InputError(
                f"{self.path}: K has the principal point ({cx:g}, {cy:g}), outside images of {width} x {height}",
                "K is fx, fy, cx, cy in pixels of these images; adapt it if they were resized or cropped",
            )
        stored = Camera.from_intrinsics(fx, fy, cx, cy, width, height)
        source = undistortion_map(stored, self.distortion)
        return stored, source, lambda index, camera: self._frame(index, stored, source).resized(camera)

    def recording(self, pauses: PauseRule, world: KnownWorld) -> Recording:
        """The recording of the video. The call computes pose and workspace. Frames are read on access."""
        stored, source, read = self.frame_reader()
        camera = stored.limited(self.max_pixels)
        read(0, camera)  # raises an error in the first frame before all frames are searched for pauses
        # A stream of the same frames finds the pauses in these images.
        changed = bool(self.distortion) or camera.width != stored.width
        found = pauses.find(self.times, (lambda k: read(k, camera).rgb) if changed else self.read_rgb)
        has_depth = lambda k: bool(np.isfinite(self.read_depth(k)).any())  # noqa: E731
        found = pauses_with_depth(found, self.times, has_depth, str(self.path))
        first_pause = found[0]
        camera = camera if world.pose is None else camera.at(world.pose)
        camera, grid, _ = find_world(read(first_pause, camera), world.grid)
        cameras: dict[int, Camera] = {}

        def camera_at(index: int) -> Camera:
            if self.motion is None:
                return camera
            if index not in cameras:
                cameras[index] = camera.at(camera.pose * (self.motion[first_pause].inv() * self.motion[index]))
            return cameras[index]

        def instance(index: int) -> np.ndarray | None:
            image = self.read_instance(index)
            if image is not None and image.shape != (stored.height, stored.width):
                raise InputError(f"instance image of frame {index} of {self.path} has shape {image.shape}")
            if image is None:
                return None
            import cv2

            size = camera.width, camera.height
            return np.asarray(cv2.resize(_undistort(image, source), size, interpolation=cv2.INTER_NEAREST_EXACT))

        return Recording(
            LazyFrames(lambda index: read(index, camera_at(index)), len(self.times)),
            grid,
            found,
            tuple(t - self.times[0] for t in self.times),
            name=self.name,
            path=self.path,
            depth_scale=self.depth_scale,
            instance=instance,
        )

    def _frame(self, index: int, camera: Camera, source: np.ndarray | None) -> Frame:
        rgb, depth = self.read_rgb(index), self.read_depth(index)
        check_images(rgb, depth, camera, self.depth_scale, f"frame {index} of {self.path}")
        robot = self.read_robot(index)
        if robot is not None and robot.shape != depth.shape:
            raise InputError(f"robot mask of frame {index} of {self.path} has shape {robot.shape}, not {depth.shape}")
        robot = None if robot is None else _undistort(robot, source) > 0
        return Frame(_undistort(rgb, source, smooth=True), _undistort(depth, source, np.nan), camera, robot)


def warn_of_unread(file: Path, stored: Iterable[str], read: Iterable[str], notes: Iterable[str] = ()) -> None:
    """Warn of entries of a file, except `notes`, that are not read."""
    if unread := sorted(set(stored) - {*read, *notes}):
        warn_user(f"{file}: not read: {', '.join(unread)}", f"the entries that are read are {', '.join(read)}")


_AZURE_SIZES = ((640, 576), (320, 288), (512, 512), (1024, 1024))  # of the depth camera of an Azure Kinect
_AZURE = "if ffmpeg took them from the .mkv of an Azure Kinect: Open3D's azure_kinect_mkv_reader.py aligns them"


def check_images(rgb: np.ndarray, depth: np.ndarray, camera: Camera, scale: float, where: str) -> None:
    """Raise InputError unless colour and depth have the size of the camera, and depth is plausible in metres."""
    sizes = [f"{image.shape[1]} x {image.shape[0]}" for image in (rgb, depth)]
    if rgb.shape[:2] != depth.shape[:2]:
        raise InputError(
            f"{where} has depth of {sizes[1]}, colour of {sizes[0]}: depth is not registered to colour",
            "align depth to colour when recording (each depth pixel must belong to the colour pixel above it)",
            *([_AZURE] if depth.shape[::-1] in _AZURE_SIZES else []),
        )
    if rgb.shape[:2] != (camera.height, camera.width):
        raise InputError(f"{where} is {sizes[0]}, the camera has {camera.width} x {camera.height}")
    hint = "check the depth scale: millimetres need 0.001, TUM images 0.0002"
    check_depth(depth, f"depth of {where} with {scale:g} m per unit", hint)


@dataclass(frozen=True)
class VideoFormat(RecordingFormat, Bounded):
    """A layout of RGB-D videos on disk.

    Parameters
    ----------
    K : tuple of 4 float
        Intrinsics fx, fy, cx, cy in pixels. By default, K is read from the files.
    depth_scale : float
        Metres per unit of 16-bit depth.
    distortion : tuple of float
        OpenCV's distortion coefficients k1, k2, p1, p2, k3 of colour and depth images. By default, the coefficients
        in the files are used, if any.
    tolerance_s : float
        Largest difference in seconds between the time stamps of the colour and the depth image of a frame.
    start_s, stop_s : float
        Times of the first and the last frame to use, in seconds after the first frame of the video.
    max_pixels : int
        Images with more pixels are reduced to this number. 0 means no limit.
    pauses : PauseRule
        The rule that finds the pauses.
    world : KnownWorld
        Known camera pose and workspace.
    """

    K: tuple[float, ...] = ()
    depth_scale: NonNegativeFloat = 0.001
    distortion: tuple[float, ...] = ()
    tolerance_s: NonNegativeFloat = 0.02
    start_s: float = 0.0
    stop_s: float = math.inf
    max_pixels: NonNegativeInt = WORKING_PIXELS
    pauses: PauseRule = field(default_factory=Still)
    world: KnownWorld = field(default_factory=KnownWorld)

    @abstractmethod
    def video(self, path: Path) -> Video:
        """All frames of the files, and their calibration. Raises InputError if the data are not valid."""

    def open(self, path: Path) -> Recording:
        """The recording of the selected part of the video."""
        video = replace(self.video(path), max_pixels=self.max_pixels)
        return video.between(self.start_s, self.stop_s).recording(self.pauses, self.world)


def object_numbers(labels: np.ndarray) -> np.ndarray:
    """A label image (H, W) uint16 in which object 255 has another number, because 255 is reserved for the robot."""
    free = np.setdiff1d(np.arange(256, 65536), labels)[0]
    return np.where(labels == 255, free, labels).astype(np.uint16)


def pair_stamps(
    colour: Sequence[float], depth: Sequence[float], tolerance_s: float, where: str
) -> tuple[tuple[int, int], ...]:
    """Pairs (colour index, depth index) in order of time.

    The two stamps of a pair are mutually nearest and at most `tolerance_s` apart.

    Warns if more than a tenth of the colour images are in no pair. Raises InputError if there is no pair.
    """
    if len(colour) == 0 or len(depth) == 0:
        raise InputError(f"{where}: there are {len(colour)} colour and {len(depth)} depth images")
    a, b = np.asarray(colour, dtype=float), np.asarray(depth, dtype=float)
    to_b, to_a = _nearest(a, b), _nearest(b, a)
    pairs = [(i, int(j)) for i, j in enumerate(to_b) if to_a[j] == i and abs(a[i] - b[j]) <= tolerance_s]
    pairs.sort(key=lambda pair: a[pair[0]])
    kept = [pair for k, pair in enumerate(pairs) if k == 0 or a[pair[0]] > a[pairs[k - 1][0]]]
    if not kept:
        raise InputError(
            f"{where}: no colour image has a depth image within {tolerance_s:g} s; the closest pair is "
            f"{np.abs(a - b[to_b]).min():.3g} s apart",
            "check that both use the same clock and are in seconds, or raise the limit: tolerance_s=0.1",
        )
    if len(kept) < 0.9 * len(a):
        warn_user(
            f"{where}: {len(a) - len(kept)} of {len(a)} colour images are omitted, without a depth image within "
            f"{tolerance_s:g} s ({len(b)} depth images)",
            "raise the limit: tolerance_s=0.1",
        )
    return tuple(kept)


def _nearest(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Index of the element of b nearest to each element of a."""
    order = np.argsort(b, kind="stable")
    right = np.searchsorted(b[order], a).clip(0, len(b) - 1)
    left = (right - 1).clip(0)
    return order[np.where(np.abs(a - b[order][left]) <= np.abs(b[order][right] - a), left, right)]

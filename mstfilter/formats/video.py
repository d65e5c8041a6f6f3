"""Videos with depth: the interface of all readers, and what they share.

A reader is a subclass of `RecordingFormat`:

>>> reader = Tum(K=(525, 525, 319.5, 239.5))
>>> if reader.detects(path):
...     recording = reader.open(path)

To read another layout, define a subclass in a file: ``mstfilter convert IN OUT --format ./mine.py:Mine``. Its fields
are options of the command line. It is best built with `Video`, which checks every frame when it is read; for arrays
in memory use `Recording.from_arrays`.

>>> video = Video("tum", times, read, K, path, depth_scale=0.0002)
>>> video.recording(pauses=Still(), world=KnownWorld())

The camera pose is found from the support plane of the first pause unless it is given. If the layout stores the motion
of the camera, only the motion relative to the first pause is used, because the world of a trajectory seldom has its
table at z = 0. Cameras have no distortion: distorted images are undistorted when they are read (`Lens`).
"""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.errors import InputError, InputWarning
from mstfilter.formats.pauses import PauseRule, Still
from mstfilter.scene import (
    Camera,
    Frame,
    LazyFrames,
    Recording,
    VoxelGrid,
    check_depth,
    find_world,
    rigid_from_matrix,
)


class RecordingFormat(ABC):
    """A layout of RGB-D data on disk. Subclasses are frozen dataclasses; fields hold what the files do not store."""

    @classmethod
    @abstractmethod
    def detects(cls, path: Path) -> bool:
        """Whether the names of files show that a path has this layout. Raises no error."""

    @abstractmethod
    def open(self, path: Path) -> Recording:
        """The recording; its images may be read when they are used. Raises InputError if the data are not valid."""


_NEGLIGIBLE = 0.5  # pixels


@dataclass(frozen=True, eq=False)
class Lens:
    """Source pixels of an undistorted image.

    Parameters
    ----------
    source : (H, W, 2) float32, optional
        Column and row in the distorted image; None if the lens has no distortion.
    """

    source: np.ndarray | None = None

    @classmethod
    def of(cls, camera: Camera, distortion: tuple[float, ...]) -> Lens:
        """The lens of OpenCV's coefficients k1, k2, p1, p2, k3, ...; distortion below half a pixel is ignored."""
        if not any(distortion):
            return cls()
        if len(distortion) not in (4, 5, 8, 12, 14) or not np.isfinite(distortion).all():
            raise InputError(
                f"distortion has {len(distortion)} numbers {tuple(distortion)}, expected 4, 5, 8, 12 or 14",
                "k1, k2, p1, p2, k3, ... in the order of OpenCV",
            )
        import cv2

        size = (camera.width, camera.height)
        x, y = cv2.initUndistortRectifyMap(
            camera.K, np.array(distortion, dtype=float), None, camera.K, size, cv2.CV_32FC1
        )
        source = np.stack([x, y], axis=-1)
        v, u = np.mgrid[: camera.height, : camera.width]
        return cls() if np.abs(source - np.stack([u, v], axis=-1)).max() < _NEGLIGIBLE else cls(source)

    def undistort(self, image: np.ndarray) -> np.ndarray:
        """Undistort a colour image."""
        import cv2

        return image if self.source is None else self._remap(image, cv2.INTER_LINEAR, 0)

    def undistort_nearest(self, image: np.ndarray, outside: float) -> np.ndarray:
        """Undistort an image of depth or labels, without interpolation."""
        import cv2

        return image if self.source is None else self._remap(image, cv2.INTER_NEAREST, outside)

    def _remap(self, image: np.ndarray, how: int, outside: float) -> np.ndarray:
        import cv2

        fill: Any = outside
        remapped: np.ndarray = cv2.remap(
            image, self.source, None, how, borderMode=cv2.BORDER_CONSTANT, borderValue=fill
        )
        return remapped


@dataclass(frozen=True, eq=False)
class RgbdImages:
    """Images of one instant.

    Parameters
    ----------
    rgb : (H, W, 3) uint8
        Colour.
    depth : (H, W) float32
        Metres, registered to the colour image; NaN = no reading.
    rgb_name, depth_name : str
        Names of the images, for messages.
    """

    rgb: np.ndarray
    depth: np.ndarray
    rgb_name: str
    depth_name: str


@dataclass(frozen=True)
class KnownWorld:
    """Camera pose and workspace, if they are known; what is empty is found from the first pause.

    Parameters
    ----------
    T_world_camera : tuple of 16 float
        Pose of the camera at the first pause, row by row: z up, table at z = 0, metres.
    workspace : tuple of 6 float
        x, y, z of the lower, then of the upper corner, metres.
    voxel_size : float
        Metres; used with `workspace`.
    """

    T_world_camera: tuple[float, ...] = ()
    workspace: tuple[float, ...] = ()
    voxel_size: float = 0.01

    @cached_property
    def pose(self) -> RigidTransform | None:
        """The pose; None if it is not given."""
        if not self.T_world_camera:
            return None
        if len(self.T_world_camera) != 16:
            raise InputError(f"world.T_world_camera has {len(self.T_world_camera)} numbers, expected 16, row by row")
        return rigid_from_matrix(np.reshape(self.T_world_camera, (4, 4)), "world.T_world_camera")

    @cached_property
    def grid(self) -> VoxelGrid | None:
        """The workspace; None if it is not given."""
        if not self.workspace:
            return None
        if len(self.workspace) != 6:
            raise InputError(
                f"world.workspace has {len(self.workspace)} numbers, expected 6: x y z lower, x y z upper"
            )
        return VoxelGrid.from_bounds(np.array(self.workspace[:3]), np.array(self.workspace[3:]), self.voxel_size)


def _camera_from(K: Sequence[float], width: int, height: int, where: str) -> Camera:
    """A camera from fx, fy, cx, cy. Raises InputError if they do not fit the image size."""
    if len(K) != 4:
        raise InputError(f"{where}: K has {len(K)} numbers, expected fx, fy, cx, cy in pixels")
    fx, fy, cx, cy = (float(v) for v in K)
    camera = Camera.from_intrinsics(fx, fy, cx, cy, width, height)
    if not (0 < cx < width and 0 < cy < height):
        raise InputError(
            f"{where}: K has the principal point ({cx:g}, {cy:g}), outside images of {width} x {height}",
            "K is fx, fy, cx, cy in pixels of these images; adapt it if they were resized or cropped",
        )
    return camera


@dataclass(frozen=True, eq=False)
class Video:
    """Frames on disk and their calibration.

    Parameters
    ----------
    name : str
        For messages and reports.
    times : tuple of float
        Seconds, one per frame, ascending.
    read : callable
        Images of a frame, by index.
    K : tuple of float
        fx, fy, cx, cy in pixels.
    path : Path
        File or folder.
    depth_scale : float
        Metres per unit of the stored depth.
    read_rgb : callable, optional
        The colour image of a frame, if reading it alone is faster.
    motion : sequence of RigidTransform, optional
        Camera poses in any world, one per frame.
    read_instance : callable, optional
        True label image of a frame, by index.
    distortion : tuple of float
        OpenCV's k1, k2, p1, p2, k3, ... of both images; they are undistorted.
    """

    name: str
    times: tuple[float, ...]
    read: Callable[[int], RgbdImages]
    K: tuple[float, ...]
    path: Path
    depth_scale: float
    read_rgb: Callable[[int], np.ndarray] | None = None
    motion: Sequence[RigidTransform] | None = None
    read_instance: Callable[[int], np.ndarray | None] = field(default=lambda index: None)
    distortion: tuple[float, ...] = ()

    def between(self, start_s: float, stop_s: float) -> Video:
        """The frames from `start_s` to `stop_s` seconds after the first."""
        kept = [k for k, t in enumerate(self.times) if start_s <= t - self.times[0] <= stop_s]
        if len(kept) == len(self.times):
            return self
        if not kept:
            raise InputError(
                f"{self.path}: no frame is between start_s={start_s:g} and stop_s={stop_s:g}; the video lasts "
                f"{self.times[-1] - self.times[0]:.1f} s"
            )
        read_rgb = self.read_rgb
        return replace(
            self,
            times=tuple(self.times[k] for k in kept),
            read=lambda index: self.read(kept[index]),
            read_rgb=None if read_rgb is None else lambda index: read_rgb(kept[index]),
            motion=None if self.motion is None else [self.motion[k] for k in kept],
            read_instance=lambda index: self.read_instance(kept[index]),
        )

    def recording(self, pauses: PauseRule, world: KnownWorld) -> Recording:
        """The recording; pose and workspace are found now, images are read when they are used."""
        if not self.times:
            raise InputError(f"{self.path} has no pair of a colour and a depth image")
        first = self.read(0)
        height, width = first.rgb.shape[:2]
        camera = _camera_from(self.K, width, height, str(self.path))
        lens = Lens.of(camera, self.distortion)
        self._frame(0, camera, lens)  # raises an error in the first frame before all frames are searched for pauses
        found = pauses.find(self.times, self.read_rgb or (lambda index: self.read(index).rgb))
        first_pause = found[0]
        camera = camera if world.pose is None else camera.at(world.pose)
        camera, grid = find_world(self._frame(first_pause, camera, lens), world.grid)
        cameras: dict[int, Camera] = {}

        def camera_at(index: int) -> Camera:
            if self.motion is None:
                return camera
            if index not in cameras:
                cameras[index] = camera.at(camera.pose * (self.motion[first_pause].inv() * self.motion[index]))
            return cameras[index]

        def instance(index: int) -> np.ndarray | None:
            image = self.read_instance(index)
            if image is not None and image.shape != (height, width):
                raise InputError(f"instance image of frame {index} of {self.path} has shape {image.shape}")
            return image if image is None else lens.undistort_nearest(image, 0)

        return Recording(
            LazyFrames(lambda index: self._frame(index, camera_at(index), lens), len(self.times)),
            grid,
            found,
            tuple(t - self.times[0] for t in self.times),
            name=self.name,
            path=self.path,
            depth_scale=self.depth_scale,
            instance=instance,
        )

    def _frame(self, index: int, camera: Camera, lens: Lens) -> Frame:
        images = self.read(index)
        (h, w), (dh, dw) = images.rgb.shape[:2], images.depth.shape[:2]
        if (h, w) != (dh, dw):
            raise InputError(
                f"{images.depth_name} is {dw} x {dh}, the colour image {w} x {h}: depth is not registered to colour",
                "align depth to colour when recording (each depth pixel must belong to the colour pixel above it)",
            )
        if (h, w) != (camera.height, camera.width):
            raise InputError(f"{images.rgb_name} is {w} x {h}, the first is {camera.width} x {camera.height}")
        check_depth(images.depth, f"{images.depth_name} with {self.depth_scale:g} m per unit")
        return Frame(lens.undistort(images.rgb), lens.undistort_nearest(images.depth, np.nan), camera)


@dataclass(frozen=True)
class VideoFormat(RecordingFormat):
    """A layout of videos.

    Parameters
    ----------
    K : tuple of 4 float
        fx, fy, cx, cy in pixels. Default: from the files.
    depth_scale : float
        Metres per unit of 16-bit depth.
    start_s, stop_s : float
        Part of the video that is used, in seconds after its first frame.
    pauses : PauseRule
        The rule that finds the pauses.
    world : KnownWorld
        Pose and workspace, if they are known.
    """

    K: tuple[float, ...] = ()
    depth_scale: float = 0.001
    start_s: float = 0.0
    stop_s: float = math.inf
    pauses: PauseRule = field(default_factory=Still)
    world: KnownWorld = field(default_factory=KnownWorld)

    def recording_of(self, video: Video) -> Recording:
        """The recording of the part of a video that is used."""
        return video.between(self.start_s, self.stop_s).recording(self.pauses, self.world)


def pair_stamps(
    colour: Sequence[float], depth: Sequence[float], tolerance_s: float, where: str
) -> tuple[tuple[int, int], ...]:
    """Pairs (colour index, depth index) in order of time: mutually nearest stamps, at most `tolerance_s` apart.

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
            "check that both use the same clock, or raise the limit: tolerance_s=0.1",
        )
    if len(kept) < 0.9 * len(a):
        warnings.warn(
            InputWarning(
                f"{where}: {len(a) - len(kept)} of {len(a)} colour images are omitted, without a depth image within "
                f"{tolerance_s:g} s ({len(b)} depth images)",
                "raise the limit: tolerance_s=0.1",
            ),
            stacklevel=2,
        )
    return tuple(kept)


def _nearest(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Index of the element of b nearest to each element of a."""
    order = np.argsort(b, kind="stable")
    right = np.searchsorted(b[order], a).clip(0, len(b) - 1)
    left = (right - 1).clip(0)
    return order[np.where(np.abs(a - b[order][left]) <= np.abs(b[order][right] - a), left, right)]

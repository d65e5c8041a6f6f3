"""Recordings of phones and scenes of data sets, whose folders `mstfilter.formats.layouts` describes.

>>> KnownLayout().open(Path("scan"))                            # finds out which layout it is
>>> KnownLayout(layout="bop", pauses=EveryNth()).open(Path("test/000048"))

Colour, depth and labels are brought into one camera: that of the colour images, with the intrinsics of the first
frame, reduced to `max_pixels`. So a phone may store small depth, and other intrinsics for each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, check_choice, naming, warn_user
from mstfilter.base.fields import NonNegativeFloat
from mstfilter.base.files import reading
from mstfilter.formats.image_folders import mask_of, number_of, seconds_in
from mstfilter.formats.images import File, read_optional, read_rgb
from mstfilter.formats.layouts import LAYOUTS, Files, Layout, Sensor, find_layouts
from mstfilter.formats.movies import Movie
from mstfilter.formats.reprojection import colour_in, depth_in, labels_in, resized_to
from mstfilter.formats.video import Video, VideoFormat, object_numbers, pair_stamps
from mstfilter.scene import Camera, rigid_from_matrix

_ARCHIVES = (".r3d", ".zip")
_MOVIES = (".mp4", ".mov", ".mkv")
_FINE = 0.00025  # metres per unit in which interpolated depth is stored


@dataclass(frozen=True)
class KnownLayout(VideoFormat):
    """Phones and data sets: Stray Scanner, Record3D, ARKitScenes, BOP, ScanNet, 7-Scenes, BundleSDF and DexYCB.

    Camera poses and true labels are read if the layout has them. If any frame has a pose, those without are omitted.
    Depth that is smaller than the colour image is interpolated on surfaces, not between them.

    Further parameters: `VideoFormat`.

    Parameters
    ----------
    layout : str
        Name of the layout in `mstfilter.formats.layouts.LAYOUTS`. By default, it is detected.
    depth_scale : float
        Metres per unit of integer depth. The default is that of the layout.
    fps : float
        Frames per second, if no file has the times. The default is that of the layout.
    """

    layout: str = ""
    depth_scale: NonNegativeFloat = 0.0
    fps: NonNegativeFloat = 0.0

    @classmethod
    def detects(cls, path: Path) -> bool:
        if not path.is_dir() and not (path.is_file() and path.suffix.lower() in _ARCHIVES):
            return False
        try:
            return bool(find_layouts(Files(path)))
        except InputError:  # a damaged archive
            return False

    def video(self, path: Path) -> Video:
        files = Files(path)
        layout = self._layout(files)
        frames = self._frames(files, layout)
        sensors = [frame.sensor for frame in frames]
        movie = next((frame.colour for frame in frames if isinstance(frame.colour, Movie)), None)
        picture = lambda j: movie[int(frames[j].number)] if movie else read_rgb(frames[j].colour)  # noqa: E731
        cameras = _cameras(sensors, picture(0).shape, str(path))
        view = cameras[0].limited(self.max_pixels).limited(self.max_pixels)  # sizes are rounded
        scales = [self.depth_scale or sensor.unit or layout.unit for sensor in sensors]
        with reading(path, f"a folder of {layout.title}"):
            read_depth, labels = layout.read_depth(files), layout.labels(files)

        def depth_image(j: int) -> np.ndarray:
            image, K = read_depth(frames[j].depth, scales[j]), sensors[j].depth_K
            if not K:
                return depth_in(image, resized_to(cameras[j], image.shape, f"frame {j} of {path}"), view)
            return depth_in(image, Camera(np.array(K), image.shape[1], image.shape[0]), view)

        def in_view(image: np.ndarray | None, j: int) -> np.ndarray | None:
            if image is None or image.shape != (cameras[j].height, cameras[j].width):
                return image  # `Video` reports a wrong size
            return labels_in(image, cameras[j], view)

        def instance(j: int) -> np.ndarray | None:
            with reading(path, "true labels"):
                image = None if movie else in_view(labels(frames[j].colour), j)
            return image if image is None or layout.hands else object_numbers(image)

        def robot(j: int) -> np.ndarray | None:
            if movie or not isinstance(file := frames[j].colour, Path):
                return None
            image = read_optional(mask_of(path, file))
            if image is None and layout.hands and (shown := labels(file)) is not None:
                image = (shown == 255).astype(np.uint8)
            return in_view(image, j)

        posed = [s.pose for s in sensors if s.pose is not None]
        motion = [rigid_from_matrix(pose, f"{path}: pose of frame {j}") for j, pose in enumerate(posed)]
        stored = read_depth(frames[0].depth, scales[0]).shape
        exact = view is cameras[0] and stored == (view.height, view.width) and not sensors[0].depth_K
        return Video(
            path.resolve().stem,
            self._times(frames, layout),
            lambda j: colour_in(picture(j), cameras[j], view),
            depth_image,
            (view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]),
            path,
            scales[0] if exact else min(scales[0], _FINE),
            motion=motion or None,
            read_instance=instance,
            read_robot=robot,
            distortion=self.distortion,
        )

    def _layout(self, files: Files) -> Layout:
        names = [self.layout] if self.layout else find_layouts(files)
        if len(names) != 1:
            found = f"may be {' or '.join(names)}" if names else "has none of the layouts of phones and data sets"
            raise InputError(f"{files.path} {found}", f"name it: -o layout=NAME, of {', '.join(names or LAYOUTS)}")
        check_choice("layout", names[0], list(LAYOUTS))
        layout = LAYOUTS[names[0]]
        if layout.note:
            warn_user(f"{files.path}: {layout.note}")
        return layout

    def _frames(self, files: Files, layout: Layout) -> list[_Frame]:
        """The frames with colour, depth, intrinsics, and a pose if others have one."""
        path, colour, depth = files.path, files.find(*layout.colour), files.find(*layout.depth)
        for found, patterns in ((colour, layout.colour), (depth, layout.depth)):
            if not found:
                raise InputError(f"{path}: {layout.title} has no {' or '.join(patterns)}", "copy it again")
        pictures: Sequence[Any] = colour
        numbers = [[*map(number_of, side)] for side in (colour, depth)]
        if colour[0].name.lower().endswith(_MOVIES):
            if not isinstance(colour[0], Path):
                raise InputError(f"{colour[0]} is a video in an archive", "unpack the archive")
            movie = Movie(colour[0])
            pictures, numbers[0] = [movie] * len(movie), [*map(Decimal, range(len(movie)))]
        stamps = [[seconds_in(number) for number in side] for side in numbers]
        pairs: Sequence[tuple[int, int]]
        if all(stamp is not None for side in stamps for stamp in side):
            seconds = [[float(stamp or 0) for stamp in side] for side in stamps]
            pairs = pair_stamps(seconds[0], seconds[1], self.tolerance_s, str(path))
        else:
            pairs = _pairs(numbers[0], numbers[1], str(path))
        listed = [numbers[0][i] for i, _ in pairs]
        with reading(path, f"a folder of {layout.title}"):
            sensors = [_usable(s) for s in layout.sensors(files, [pictures[i] for i, _ in pairs], listed)]
        if self.K:
            sensors = [s and replace(s, K=self.K, size=None) for s in sensors]
        if any(s is not None and not s.K for s in sensors):
            hint = f"give them: -o K=fx,fy,cx,cy; {layout.intrinsics}"
            raise InputError(f"{path}: intrinsics are missing", hint)
        posed = any(s is not None and s.pose is not None for s in sensors)
        frames = [
            _Frame(pictures[i], depth[j], number, sensor)
            for (i, j), number, sensor in zip(pairs, listed, sensors, strict=True)
            if sensor is not None and not (posed and sensor.pose is None)
        ]
        if not frames:
            raise InputError(f"{path}: no frame of {layout.title} has intrinsics and a pose", "copy the folder again")
        if len(frames) < 0.9 * len(pairs):
            warn_user(f"{path}: {len(pairs) - len(frames)} of {len(pairs)} frames are omitted: they have no pose")
        return frames

    def _times(self, frames: Sequence[_Frame], layout: Layout) -> tuple[float, ...]:
        times = [frame.sensor.time for frame in frames]
        if None not in times and not self.fps:
            return tuple(time or 0.0 for time in times)
        numbers = [frame.number for frame in frames]
        if (first := seconds_in(numbers[0])) is not None:
            return tuple(float((seconds_in(number) or first) - first) for number in numbers)
        return tuple(float(number - numbers[0]) / (self.fps or layout.fps) for number in numbers)


@dataclass(frozen=True)
class _Frame:
    colour: Any  #: file, or the video
    depth: File
    number: Decimal  #: in the video, or in the name of the file
    sensor: Sensor


def _cameras(sensors: Sequence[Sensor], shape: tuple[int, ...], where: str) -> list[Camera]:
    """The camera of the colour image of each frame."""
    height, width = shape[:2]
    for sensor in sensors:
        if len(sensor.K) != 4:
            raise InputError(f"{where}: K has {len(sensor.K)} numbers, expected fx, fy, cx, cy in pixels")
        if sensor.size not in (None, (width, height)):
            text = f"{where}: the intrinsics are of images of {sensor.size}, the images have {width} x {height}"
            raise InputError(text, "give those of the images: -o K=fx,fy,cx,cy")
    with naming(where):
        made = {K: Camera(np.array(K), width, height) for K in {sensor.K for sensor in sensors}}
    return [made[sensor.K] for sensor in sensors]


def _usable(sensor: Sensor | None) -> Sensor | None:
    """The sensor, without the pose that a tracker writes when it is lost."""
    if sensor is None or sensor.pose is None or np.isfinite(sensor.pose).all():
        return sensor
    return replace(sensor, pose=None)


def _pairs(colour: Sequence[Decimal], depth: Sequence[Decimal], where: str) -> list[tuple[int, int]]:
    """Pairs of images with the same number."""
    first, second = ({number: k for k, number in enumerate(side)} for side in (colour, depth))
    shift = min(first) - min(second)
    if shift and {number + shift for number in second} == set(first):
        text = f"{where}: colour images begin with number {min(first)}, depth images with {min(second)}"
        raise InputError(text, "give both the same numbers: ffmpeg counts from 1, unless it gets -start_number 0")
    both = sorted(first.keys() & second.keys())
    if not both:
        raise InputError(f"{where}: no colour image has a depth image of the same number", "name them alike")
    if len(both) < 0.9 * max(len(first), len(second)):
        text = f"{where}: {len(both)} frames of {len(first)} colour and {len(second)} depth images are read"
        warn_user(text, "the others have no partner of the same number")
    return [(first[number], second[number]) for number in both]

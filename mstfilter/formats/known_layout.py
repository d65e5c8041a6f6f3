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

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError, check_choice, warn_user
from mstfilter.base.fields import NonNegativeFloat
from mstfilter.formats.image_folders import number_of, seconds_in
from mstfilter.formats.images import File, read_optional, read_rgb
from mstfilter.formats.layouts import LAYOUTS, Files, Layout, Sensor, find_layouts
from mstfilter.formats.movies import Movie
from mstfilter.formats.reprojection import colour_in, depth_in, labels_in, resized_to
from mstfilter.formats.video import Video, VideoFormat, object_numbers, pair_stamps
from mstfilter.scene import Camera, rigid_from_matrix

_ARCHIVES = (".r3d", ".zip")
_MOVIES = (".mp4", ".mov", ".mkv")
_FINE = 0.00025  # metres per unit in which depth is stored that is not a multiple of a unit


@dataclass(frozen=True)
class KnownLayout(VideoFormat):
    """Phones and data sets: Stray Scanner, Record3D, ARKitScenes, BOP, ScanNet, 7-Scenes, BundleSDF and DexYCB.

    Camera poses and true labels are read if the layout has them. Frames without a pose are omitted if others have one.
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
        return (path.is_dir() or (path.is_file() and path.suffix.lower() in _ARCHIVES)) and bool(_found(path))

    def video(self, path: Path) -> Video:
        files = Files(path)
        name = self.layout or self._only(path, find_layouts(files))
        check_choice("layout", name, list(LAYOUTS))
        layout = LAYOUTS[name]
        if layout.note:
            warn_user(f"{path}: {layout.note}")
        colour, depth, movie, numbers = self._frames(files, layout)
        sensors = self._sensors(files, layout, colour, numbers)
        posed = any(sensor is not None and sensor.pose is not None for sensor in sensors)
        kept = [k for k, s in enumerate(sensors) if s is not None and not (posed and s.pose is None)]
        if not kept:
            raise InputError(f"{path}: no frame of {layout.title} has a pose", "copy the folder again")
        if len(kept) < 0.9 * len(sensors):
            warn_user(f"{path}: {len(sensors) - len(kept)} of {len(sensors)} frames are omitted: they have no pose")
        known = [sensors[k] or Sensor() for k in kept]
        frame, read_depth = [int(numbers[k]) if movie else k for k in kept], layout.read_depth(files)
        picture = (lambda j: movie[frame[j]]) if movie else (lambda j: read_rgb(colour[frame[j]]))
        cameras = self._cameras(path, known, picture(0).shape)
        view = cameras[0].limited(self.max_pixels).limited(self.max_pixels)  # sizes are rounded
        scales = [self.depth_scale or sensor.unit or layout.unit for sensor in known]

        def depth_image(j: int) -> np.ndarray:
            image, where = read_depth(depth[kept[j]], scales[j]), f"frame {j} of {path}"
            K = known[j].depth_K
            own = Camera.from_intrinsics(*K, *image.shape[::-1]) if K else resized_to(cameras[j], image.shape, where)
            return depth_in(image, own, view)

        def in_view(image: np.ndarray | None, j: int) -> np.ndarray | None:
            if image is None or image.shape != (cameras[j].height, cameras[j].width):
                return image  # the reader of the frame reports a wrong size
            return labels_in(image, cameras[j], view)

        labels = layout.labels(files)

        def instance(j: int) -> np.ndarray | None:
            image = None if movie else in_view(labels(colour[frame[j]]), j)
            return image if image is None or layout.hands else object_numbers(image)

        def robot(j: int) -> np.ndarray | None:
            if movie or not isinstance(file := colour[frame[j]], Path):
                return None
            image = read_optional(path / "robot" / f"{file.stem}.png")
            if image is None and layout.hands and (shown := labels(file)) is not None:
                image = (shown == 255).astype(np.uint8)
            return in_view(image, j)

        poses = [sensor.pose for sensor in known]
        exact = view is cameras[0] and not any(sensor.depth_K for sensor in known)
        return Video(
            path.resolve().stem,
            self._times(known, [numbers[k] for k in kept], layout),
            lambda j: colour_in(picture(j), cameras[j], view),
            depth_image,
            (view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]),
            path,
            scales[0] if exact else min(scales[0], _FINE),
            motion=_motion(poses, str(path)) if posed else None,
            read_instance=instance,
            read_robot=robot,
            distortion=self.distortion,
        )

    def _only(self, path: Path, names: list[str]) -> str:
        if len(names) == 1:
            return names[0]
        found = f"may be {' or '.join(names)}" if names else "has none of the layouts of phones and data sets"
        raise InputError(f"{path} {found}", f"name it: -o layout=NAME, of {', '.join(names or LAYOUTS)}")

    def _frames(self, files: Files, layout: Layout) -> tuple[list[File], list[File], Movie | None, list[Decimal]]:
        """Colour files, depth files, the video instead of colour files, and numbers of the frames that have both."""
        colour, depth = files.find(*layout.colour), files.find(*layout.depth)
        for found, patterns in ((colour, layout.colour), (depth, layout.depth)):
            if not found:
                raise InputError(f"{files.path}: {layout.title} has no {' or '.join(patterns)}", "copy it again")
        movie = None
        if Path(colour[0].name).suffix.lower() in _MOVIES:
            if not isinstance(colour[0], Path):
                raise InputError(f"{colour[0]} is a video in an archive", "unpack the archive")
            movie = Movie(colour[0])
        sides = [list(map(Decimal, range(len(movie)))) if movie else _numbers(colour), _numbers(depth)]
        if all(seconds_in(number) is not None for side in sides for number in side):
            stamps = [[float(seconds_in(number) or 0) for number in side] for side in sides]
            pairs = pair_stamps(stamps[0], stamps[1], self.tolerance_s, str(files.path))
        else:
            pairs = _pairs(sides, str(files.path))
        chosen = colour if movie else [colour[i] for i, _ in pairs]
        return chosen, [depth[j] for _, j in pairs], movie, [sides[0][i] for i, _ in pairs]

    def _sensors(
        self, files: Files, layout: Layout, colour: Sequence[File], numbers: Sequence[Decimal]
    ) -> list[Sensor | None]:
        sensors = list(layout.sensors(files, colour, numbers))
        if self.K:
            return [None if s is None else replace(s, K=self.K, size=None) for s in sensors]
        if any(s is not None and not s.K for s in sensors):
            raise InputError(
                f"{files.path}: intrinsics are missing", f"give them: -o K=fx,fy,cx,cy; {layout.intrinsics}"
            )
        return sensors

    def _cameras(self, path: Path, sensors: Sequence[Sensor], shape: tuple[int, ...]) -> list[Camera]:
        """The camera of the colour image of each frame."""
        height, width = shape[:2]
        for sensor in sensors:
            if len(sensor.K) != 4:
                raise InputError(f"{path}: K has {len(sensor.K)} numbers, expected fx, fy, cx, cy in pixels")
            if sensor.size not in (None, (width, height)):
                text = f"{path}: the intrinsics are of images of {sensor.size}, the images have {width} x {height}"
                raise InputError(text, "give those of the images: -o K=fx,fy,cx,cy")
        made = {K: Camera.from_intrinsics(*K, width, height) for K in {sensor.K for sensor in sensors}}
        return [made[sensor.K] for sensor in sensors]

    def _times(self, sensors: Sequence[Sensor], numbers: Sequence[Decimal], layout: Layout) -> tuple[float, ...]:
        seconds = [float(number) for number in numbers]
        if sensors[0].time is not None and not self.fps:
            seconds = [sensor.time or 0.0 for sensor in sensors]
        elif seconds_in(numbers[0]) is None:
            seconds = [(second - seconds[0]) / (self.fps or layout.fps) for second in seconds]
        return tuple(seconds)


def _found(path: Path) -> list[str]:
    try:
        return find_layouts(Files(path))
    except InputError:  # a damaged archive
        return []


def _numbers(files: Sequence[File]) -> list[Decimal]:
    return [number_of(Path(file.name)) for file in files]


def _pairs(sides: Sequence[Sequence[Decimal]], where: str) -> list[tuple[int, int]]:
    """Pairs of images with the same number."""
    first, second = ({number: k for k, number in enumerate(side)} for side in sides)
    shift = min(first) - min(second)
    if shift and len(first) == len(second) and {number + shift for number in second} == set(first):
        text = f"{where}: colour images begin with number {min(first)}, depth images with {min(second)}"
        raise InputError(text, "give both the same numbers: ffmpeg counts from 1, unless it gets -start_number 0")
    both = sorted(first.keys() & second.keys())
    if not both:
        raise InputError(f"{where}: no colour image has a depth image of the same number", "name them alike")
    if len(both) < 0.9 * max(len(first), len(second)):
        text = f"{where}: {len(both)} frames of {len(first)} colour and {len(second)} depth images are read"
        warn_user(text, "the others have no partner of the same number")
    return [(first[number], second[number]) for number in both]


def _motion(poses: Sequence[np.ndarray | None], where: str) -> list[RigidTransform]:
    return [rigid_from_matrix(pose, f"{where}: pose of frame {j}") for j, pose in enumerate(poses)]

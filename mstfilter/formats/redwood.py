"""Folders of colour and depth images as Redwood and Open3D write them, also while images are added to them.

>>> Redwood().open(Path("bedroom"))
>>> for seconds, frame in Redwood().arriving(Path("session")): ...
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

from mstfilter.base.errors import InputError, warn_user
from mstfilter.base.fields import NonNegativeFloat
from mstfilter.formats.image_folders import (
    INTRINSICS,
    Intrinsics,
    check_aligned,
    check_masks,
    is_recording,
    mask_of,
    number_of,
    numbers_in,
    seconds_in,
)
from mstfilter.formats.images import COLOUR_SUFFIXES, DEPTH_SUFFIXES
from mstfilter.formats.known_layout import KnownLayout
from mstfilter.formats.video import Video, VideoFormat, pair_stamps
from mstfilter.scene import Frame

_COLOUR = "color", "image", "rgb", "colour"
_POLL_S = 0.02
_WRITTEN_S = 0.3  # age of the last files after which they are complete
_PARTNER_S = 2.0  # how long a pair waits for its second image, or to become readable


@dataclass(frozen=True)
class Redwood(VideoFormat):
    """Folders rgb/ (or color/, colour/, image/) and depth/ with intrinsics, as in Redwood and Open3D.

    Intrinsics are read from a file in the same folder, or given as ``K``. ``intrinsics.json`` or ``camera.json``
    holds ``fx``, ``fy``, ``cx``, ``cy``, or ``K`` (3 x 3), or the entries of pyrealsense2. ``intrinsic.json`` or
    ``camera_intrinsic.json`` holds Open3D's ``intrinsic_matrix`` in column-major order. Colour and depth images are
    paired by the last number in their names, or by time if the numbers are time stamps. Depth files are 16-bit PNG,
    TIFF or PGM, arrays (.npy, .npz), or floating-point in metres (also .tif, .exr). An optional robot mask
    robot/NAME.png has the name of its colour image. The camera must not move. Format: http://redwood-data.org/indoor/fileformat.html.

    Further parameters: `VideoFormat`.

    Parameters
    ----------
    depth_scale : float
        Metres per unit of integer depth. The default is the scale in the file of intrinsics, else 0.001.
    fps : float
        Frames per second, used if names are not time stamps. The default is the rate in the intrinsics file, else 30.
    """

    depth_scale: NonNegativeFloat = 0.0
    fps: NonNegativeFloat = 0.0

    @classmethod
    def detects(cls, path: Path) -> bool:
        if not (path / "depth").is_dir() or is_recording(path) or KnownLayout.detects(path):
            return False
        folders = tuple(name for name in _COLOUR if name != "rgb" or not (path / "rgb.txt").is_file())
        return any((path / name).is_dir() for name in folders)

    def arriving(self, path: Path, idle_s: float = 10.0) -> Iterator[tuple[float, Frame]]:
        """Yield the time in seconds and the frame (without a pose) of each image pair that is added to a folder.

        A pair is read when a later pair exists, or when the files of the pair no longer change. A colour image
        waits 2 s for the depth image of the same number, and a pair 2 s to become readable; then it is skipped. A
        colour image is also skipped without a robot mask if there is a folder
        robot/. The iteration ends after `idle_s` seconds without a new pair.
        """
        known: set[str] = set()  # names of the images that were read
        pairs: list[tuple[Path, Path]] = []  # the first and the latest one
        trial: tuple[Path, Path] | None = None  # the pair that is being read
        n, since, failed, age = 0, time.monotonic(), None, _Ages()
        while time.monotonic() - since < idle_s:
            try:
                new, images = self._files(path, known)
                new = [file for file in new if mask_of(path, file).is_file()] if (path / "robot").is_dir() else new
                for pair in _complete(new, images, pairs[-1:], age):
                    trial = pair
                    colour, depth = map(list, zip(*pairs[:1], pair, strict=True))
                    video = self._video(path, colour, depth)
                    camera, _, read = video.frame_reader()
                    stamped = seconds_in(number_of(pair[0])) is not None
                    seconds = video.times[-1] if stamped else n / self._rate(_calibration(path))
                    yield seconds, read(len(video.times) - 1, camera)
                    pairs, n = [*pairs[:1], pair], n + 1
                    known.update(file.name for file in pair)
                    since, failed, trial = time.monotonic(), None, None
            except InputError as error:  # there is no image yet, or a file is incomplete
                failed = error
                if trial and min(map(age, trial)) > _PARTNER_S:
                    warn_user(f"images {trial[0].name}, {trial[1].name} of {path} are skipped: {error.message}")
                    known.update(file.name for file in trial)
                    n, trial, failed = n + 1, None, None
            time.sleep(_POLL_S)
        if failed is not None:
            raise failed

    def video(self, path: Path) -> Video:
        if len(found := [name for name in _COLOUR if (path / name).is_dir()]) > 1:
            warn_user(f"{path} has the colour folders {', '.join(found)}: {found[0]} is read", "remove the others")
        colour, depth = self._files(path)
        check_masks(path, colour)
        return self._video(path, colour, depth)

    def _files(self, path: Path, known: Collection[str] = ()) -> tuple[list[Path], list[Path]]:
        """Files of colour images and of depth images, except files with names in `known`."""
        folder = next((path / name for name in _COLOUR if (path / name).is_dir()), path / _COLOUR[0])
        if not known:
            check_aligned(path, {"depth"}, "rename depth/ to raw/, and {name}/ to depth/")
        return _images(folder, COLOUR_SUFFIXES, known), _images(path / "depth", DEPTH_SUFFIXES, known)

    def _rate(self, calibration: Intrinsics) -> float:
        """Frame rate in frames per second."""
        return self.fps or calibration.number("fps", 30)

    def _video(self, path: Path, colour: list[Path], depth: list[Path]) -> Video:
        pairs, stamps = _paired(path, colour, depth, self.tolerance_s)
        calibration = _calibration(path)
        times = stamps or tuple(k / self._rate(calibration) for k in range(len(pairs)))
        files = [(rgb, image, mask_of(path, rgb)) for rgb, image in pairs]
        return calibration.video(self, path.resolve().name, times, files, self.depth_scale or calibration.depth_scale)


def _calibration(path: Path) -> Intrinsics:
    return Intrinsics.read(path, INTRINSICS, "fps", "depth_scale")


def _images(folder: Path, suffixes: tuple[str, ...], known: Collection[str] = ()) -> list[Path]:
    """Image files of a folder, except files with names in `known`, ordered by the number in the name."""
    if not folder.is_dir():
        raise InputError(f"not a folder of colour and depth images: {folder} is missing", "it holds rgb/ and depth/")
    new = [folder / name for name in set(os.listdir(folder)).difference(known)]
    files = [p for p in new if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    if not files and not known:
        raise InputError(f"{folder} has no image", f"expected {', '.join(suffixes)}")
    ordered = sorted(files, key=number_of)
    for a, b in pairwise(ordered):
        if number_of(a) == number_of(b):
            raise InputError(
                f"{folder}: names of images have no numbers that differ: {a.name}, {b.name}",
                "name them 000000, 000001, ..., or by time in seconds",
            )
    for before, after in zip(ordered, sorted(files, key=numbers_in), strict=True):
        if before != after:
            raise InputError(
                f"{folder}: the order is not clear: {after.name} or {before.name} first",
                "name the images 000000, 000001, ..., or by time in seconds, as in 1700000000.250",
            )
    return ordered


class _Ages:
    """Seconds since the last change of a file was seen. The time in the file system may be that of another clock."""

    def __init__(self) -> None:
        self._seen: dict[Path, tuple[tuple[int, int], float]] = {}

    def __call__(self, file: Path) -> float:
        found, now = file.stat(), time.monotonic()
        state = found.st_size, found.st_mtime_ns
        if self._seen.get(file, (None, now))[0] != state:
            self._seen[file] = state, now
        return now - self._seen[file][1]


def _complete(
    colour: list[Path], depth: list[Path], after: list[tuple[Path, Path]], age: Callable[[Path], float]
) -> list[tuple[Path, Path]]:
    """Pairs of images with equal numbers that are completely written and later than the last pair in `after`."""
    last = number_of(after[0][0]) if after else Decimal(-2)
    of_number = {number_of(file): file for file in depth}
    later = [file for file in colour if number_of(file) > last]
    late = [number_of(file) for file in later if number_of(file) not in of_number and age(file) < _PARTNER_S]
    later = [file for file in later if number_of(file) < min(late, default=Decimal("inf"))]
    pairs = [(file, of_number[n]) for file in later if (n := number_of(file)) in of_number]
    if not pairs and not after:
        raise InputError(
            "no colour image has a depth image of the same number",
            "a live run pairs images by number: give both images of a pair the same name",
        )
    if not pairs or min(map(age, pairs[-1])) > _WRITTEN_S:
        return pairs
    return pairs[:-1]


def _paired(
    path: Path, colour: list[Path], depth: list[Path], tolerance_s: float
) -> tuple[list[tuple[Path, Path]], tuple[float, ...]]:
    """Pairs of files, and the times of the pairs in seconds; no times if the names are frame numbers."""
    numbers = [[number_of(file) for file in files] for files in (colour, depth)]
    seconds = [_times(side) for side in numbers]
    if all(value is not None for side in seconds for value in side):
        stamps = [[float(value - seconds[0][0]) for value in side] for side in seconds]  # type: ignore[operator]
        chosen = pair_stamps(stamps[0], stamps[1], tolerance_s, str(path))
        return [(colour[i], depth[j]) for i, j in chosen], tuple(stamps[0][i] for i, _ in chosen)
    if len(colour) != len(depth):
        alone = min(set(numbers[0]) ^ set(numbers[1]), default=None)
        first_alone = next((file.name for file in (*colour, *depth) if number_of(file) == alone), colour[-1].name)
        raise InputError(
            f"{path}: there are {len(colour)} colour images and {len(depth)} depth images",
            f"each frame needs both; {first_alone} has no partner",
        )
    for a, b, first, second in zip(colour, depth, *numbers, strict=True):
        if first != second:
            raise InputError(
                f"{path}: colour image {a.name} does not fit depth image {b.name}",
                "an image is missing, or the two are numbered differently; rename one side to match",
            )
    return list(zip(colour, depth, strict=True)), ()


def _times(numbers: list[Decimal]) -> list[Decimal | None]:
    """Time stamps in seconds. If a number has decimals, numbers without decimals are seconds too."""
    decimals = any(number.as_tuple().exponent != 0 for number in numbers)
    return [seconds_in(n) or (n if decimals and n >= 0 else None) for n in numbers]

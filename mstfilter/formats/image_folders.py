"""Folders of colour and depth images: pairs of images, rgb/ and depth/ (Redwood, Open3D), TUM RGB-D.

>>> PairedImages(frames=("learn2", "learn3", "learn4")).open(Path("frames"))
>>> Redwood().open(Path("bedroom"))
>>> Tum(K=(525.0, 525.0, 319.5, 239.5)).open(Path("rgbd_dataset"))
"""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.base.errors import InputError, check_number, warn_user
from mstfilter.base.fields import NonNegativeFloat
from mstfilter.base.files import reading
from mstfilter.base.reading import MAX_TEXT, read_bytes, read_json, read_text
from mstfilter.formats.images import read_optional
from mstfilter.formats.pauses import EveryNth
from mstfilter.formats.video import Video, VideoFormat, object_numbers, pair_stamps, warn_of_unread
from mstfilter.scene import Frame, PauseRule, Recording, table_residual


@dataclass(frozen=True)
class PairedImages(VideoFormat):
    """A folder of pairs NAME_rgb.png, NAME_depth.png with an info.json. By default, every frame is a pause.

    ``info.json`` holds ``K`` (fx, fy, cx, cy, or a 3x3 matrix) and ``depth_scale_m``, metres per unit of the 16-bit
    depth images. Label images NAME_label.png (8 or 16 bits, one number for each object) are used as the true label
    images. Label 0, and labels with most of their depth readings on the support plane, are background. Robot masks
    NAME_robot.png are optional. The frames have the times 0, 1, 2, ... s.

    Further parameters: `VideoFormat`.

    Parameters
    ----------
    frames : tuple of str
        Names of the frames in order. By default, all frames are read, sorted by name with numbers in numerical order.
    depth_scale : float
        Metres per unit of integer depth. The default is the scale in info.json.
    """

    frames: tuple[str | int, ...] = ()
    depth_scale: NonNegativeFloat = 0.0
    pauses: PauseRule = field(default_factory=EveryNth)

    @classmethod
    def detects(cls, path: Path) -> bool:
        return (path / "info.json").is_file() and any(path.glob("*_rgb.png"))

    def video(self, path: Path) -> Video:
        source = _read_intrinsics(path, ("info.json",), "depth_scale_m")
        scale: Any = self.depth_scale or source[1].get("depth_scale_m")
        hint = 'for example {"K": [525, 525, 319.5, 239.5], "depth_scale_m": 0.001}'
        check_number(f"{path / 'info.json'}: depth_scale_m", scale, hint, above=0)
        names = {p.name.removesuffix(end) for end in ("_rgb.png", "_depth.png") for p in path.glob(f"*{end}")}
        key = lambda name: [w.zfill(20) if w.isdigit() else w for w in re.split(r"(\d+)", name)]  # noqa: E731
        present = sorted(sorted(names), key=key)
        chosen = [str(name) for name in self.frames] or present or ["NAME"]
        files = [tuple(path / f"{name}_{part}.png" for part in ("rgb", "depth", "robot")) for name in chosen]
        for name, pair in zip(chosen, files, strict=True):
            if lost := [file.name for file in pair[:2] if not file.is_file()]:
                hint = (
                    f"a pair is NAME_rgb.png and NAME_depth.png; there are {len(present)}: {', '.join(present[:8])}"
                )
                raise InputError(f"no frame {name!r} in {path}: {' and '.join(lost)} missing", hint)
        title = chosen[0] if len(chosen) == 1 else f"{chosen[0]}-{chosen[-1]}"
        times = tuple(float(k) for k in range(len(chosen)))
        made = _calibrated(self, path, source, title, times, files, scale)
        return replace(made, read_instance=lambda k: read_optional(path / f"{chosen[k]}_label.png"))

    def open(self, path: Path) -> Recording:
        made = super().open(path)
        return replace(made, instance=lambda index: _objects(made.frames[index], made.instance(index)))


def _objects(frame: Frame, labels: np.ndarray | None) -> np.ndarray | None:
    """The label image (H, W) of a frame without the labels of the table."""
    if labels is None:
        return None
    with np.errstate(invalid="ignore"):
        on_plane = np.abs(table_residual(frame)) < _ON_PLANE
    known = np.unique(labels[frame.valid])
    background = [k for k in known if on_plane[frame.valid & (labels == k)].mean() > 0.5]
    return object_numbers(np.where(np.isin(labels, background), 0, labels))


_ON_PLANE = 2.0  # disparity in 1/8 pixels of a Kinect: 6 mm at 1 m
_COLOUR, _SUFFIXES = ("color", "image", "rgb", "colour"), (".png", ".jpg", ".jpeg")
_DEPTH_SUFFIXES = (".png", ".npy", ".tif", ".tiff")
_ALIGNED = re.compile(r"depth.*(align|regist|(to|2)_?(colou?r|rgb))|(align|regist).*depth")
_STILL = "remove the file if the camera stands still"
_POLL_S = 0.02
_WRITTEN_S = 0.3  # age of the last files after which they are complete
_PARTNER_S = 2.0  # how long a pair waits for its second image, or to become readable
INTRINSICS = ("intrinsic.json", "camera_intrinsic.json", "intrinsics.json", "camera.json")
_ENTRIES = INTRINSICS, "fps", "depth_scale"
_READ = ("K", "fx", "fy", "cx", "cy", "intrinsic_matrix", "distortion", "width", "height")
_OF_PYREALSENSE = {"ppx": "cx", "ppy": "cy", "coeffs": "distortion"}  # names of pyrealsense2, which has `model` too
#: Distortion models, as text or number of pyrealsense2, whose coefficients are those of OpenCV. The library projects
#: by the same formula for all of them.
_MODELS = re.compile(r"brown|plumb_bob|rational|opencv|none|^$|^[0124]$")
#: Entries of the recorders of Open3D, and of info.json, that say nothing about the images.
_NOTES = {"device_name", "serial_number", "serial_number_", "stream_length_usec", "color_format", "depth_format"}
_NOTES |= {"color_mode", "depth_mode", "class_name", "version_major", "version_minor", "frames", "classes", "source"}
_Source = tuple[Path | None, dict[str, Any]]  # a file of intrinsics, and its entries


@dataclass(frozen=True)
class Redwood(VideoFormat):
    """Folders rgb/ (or color/, colour/, image/) and depth/ with intrinsics, as in Redwood and Open3D.

    Intrinsics are read from a file in the same folder, or given as ``K``. ``intrinsics.json`` or ``camera.json``
    holds ``fx``, ``fy``, ``cx``, ``cy``, or ``K`` (3 x 3), or the entries of pyrealsense2. ``intrinsic.json`` or
    ``camera_intrinsic.json`` holds Open3D's ``intrinsic_matrix`` in column-major order. Colour and depth images are
    paired by the last number in their names, or by time if the numbers are time stamps. Depth files are 16-bit PNG or
    TIFF, or floating-point in metres (.npy, .tif). An optional robot mask robot/NAME.png has the name of its colour
    image. The camera must not move. Format: http://redwood-data.org/indoor/fileformat.html.

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
        if not (path / "depth").is_dir() or is_recording(path) or (path / "scene_camera.json").is_file():
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
                new = [file for file in new if _mask(path, file).is_file()] if (path / "robot").is_dir() else new
                for pair in _complete(new, images, pairs[-1:], age):
                    trial = pair
                    colour, depth = map(list, zip(*pairs[:1], pair, strict=True))
                    video = self._video(path, colour, depth)
                    camera, _, read = video.frame_reader()
                    stamped = _seconds(_number(pair[0])) is not None
                    seconds = video.times[-1] if stamped else n / self._rate(*_read_intrinsics(path, *_ENTRIES))
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
        _check_masks(path, colour)
        return self._video(path, colour, depth)

    def _files(self, path: Path, known: Collection[str] = ()) -> tuple[list[Path], list[Path]]:
        """Files of colour images and of depth images, except files with names in `known`."""
        folder = next((path / name for name in _COLOUR if (path / name).is_dir()), path / _COLOUR[0])
        if not known:
            _check_aligned(path, {"depth"}, "rename depth/ to raw/, and {name}/ to depth/")
        return _images(folder, _SUFFIXES, known), _images(path / "depth", _DEPTH_SUFFIXES, known)

    def _rate(self, file: Path | None, stored: dict[str, Any]) -> float:
        """Frame rate in frames per second."""
        return self.fps or _stored(file, stored, "fps", 30)

    def _video(self, path: Path, colour: list[Path], depth: list[Path]) -> Video:
        pairs, stamps = _paired(path, colour, depth, self.tolerance_s)
        file, stored = _read_intrinsics(path, *_ENTRIES)
        scale = self.depth_scale or _stored_scale(file, stored)
        times = stamps or tuple(k / self._rate(file, stored) for k in range(len(pairs)))
        files = [(rgb, image, _mask(path, rgb)) for rgb, image in pairs]
        return _calibrated(self, path, (file, stored), path.resolve().name, times, files, scale)


def _calibrated(
    reader: VideoFormat, path: Path, source: _Source, name: str, times: tuple[float, ...], files: Any, scale: float
) -> Video:
    """The video of triples of files, with the options of a reader or else the entries of a file of intrinsics."""
    file, stored = source
    K = reader.K or _stored_matrix(path, *source)
    distortion = reader.distortion or tuple(stored.get("distortion", ()))
    video = Video.of_files(name, times, files, K, path, scale, distortion=distortion)
    for side, n in zip(("height", "width"), video.read_rgb(0).shape, strict=False):
        if not reader.K and _stored(file, stored, side, n) != n:
            text = f"{file} is for images of another {side}: the images have {n}"
            raise InputError(text, "scale the intrinsics, or give them: K=fx,fy,cx,cy")
    return video


def _mask(path: Path, colour: Path) -> Path:
    """The file of the optional robot mask of a colour image."""
    return path / "robot" / f"{colour.stem}.png"


def _check_masks(path: Path, colour: Iterable[Path]) -> None:
    """Warn of robot masks that belong to no colour image, or are in a folder with another name."""
    if near := [name for name in os.listdir(path) if re.search("robot.|mask", name.lower()) and "." not in name]:
        warn_user(f"{path / near[0]} is not read", "rename it to robot/ if it has the robot masks")
    if other := sorted({*path.glob("robot/[!.]*")} - {_mask(path, file) for file in colour}):
        text = f"{path / 'robot'}: {len(other)} masks of no colour image are not read, for example {other[0].name}"
        warn_user(text, "name a robot mask as its colour image: robot/000000.png for rgb/000000.jpg")


def _check_aligned(path: Path, used: Collection[str], hint: str) -> None:
    """Raise InputError if a folder beside the `used` folders of depth images is named as one of aligned depth."""
    folders = sorted(p.name for p in path.iterdir() if p.is_dir()) if path.is_dir() else []
    aligned = [name for name in folders if _ALIGNED.search(name.lower())]
    if aligned and not set(aligned) & set(used):
        text = f"{path}: {', '.join(sorted(used))}/ would be read, but {aligned[0]}/ is there: depth must be aligned"
        raise InputError(text, hint.format(name=aligned[0]), f"or, if they are no depth images: rename {aligned[0]}/")


def is_recording(path: Path) -> bool:
    """Whether a folder is a recording folder: it has a manifest.json, or a camera.json with a workspace."""
    camera = path / "camera.json"
    ours = camera.is_file() and b'"workspace"' in read_bytes(camera, "a camera file", limit=MAX_TEXT)
    return ours or (path / "manifest.json").is_file()


def _images(folder: Path, suffixes: tuple[str, ...], known: Collection[str] = ()) -> list[Path]:
    """Image files of a folder, except files with names in `known`, ordered by the number in the name."""
    if not folder.is_dir():
        raise InputError(f"not a folder of colour and depth images: {folder} is missing", "it holds rgb/ and depth/")
    new = [folder / name for name in set(os.listdir(folder)).difference(known)]
    files = [p for p in new if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    if not files and not known:
        raise InputError(f"{folder} has no image", f"expected {', '.join(suffixes)}")
    ordered = sorted(files, key=_number)
    for a, b in pairwise(ordered):
        if _number(a) == _number(b):
            raise InputError(
                f"{folder}: names of images have no numbers that differ: {a.name}, {b.name}",
                "name them 000000, 000001, ..., or by time in seconds",
            )
    for before, after in zip(ordered, sorted(files, key=_numbers), strict=True):
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
    last = _number(after[0][0]) if after else Decimal(-2)
    of_number = {_number(file): file for file in depth}
    later = [file for file in colour if _number(file) > last]
    late = [_number(file) for file in later if _number(file) not in of_number and age(file) < _PARTNER_S]
    later = [file for file in later if _number(file) < min(late, default=Decimal("inf"))]
    pairs = [(file, of_number[n]) for file in later if (n := _number(file)) in of_number]
    if not pairs and not after:
        raise InputError(
            "no colour image has a depth image of the same number",
            "a live run pairs images by number: give both images of a pair the same name",
        )
    if not pairs or min(map(age, pairs[-1])) > _WRITTEN_S:
        return pairs
    return pairs[:-1]


def _numbers(file: Path) -> list[Decimal]:
    """The numbers in a file name."""
    return [Decimal(number) for number in re.findall(r"\d+(?:\.\d+)?", file.stem)]


def _number(file: Path) -> Decimal:
    """The last number in a file name, or -1 for a name without numbers."""
    return (_numbers(file) or [Decimal(-1)])[-1]


def _paired(
    path: Path, colour: list[Path], depth: list[Path], tolerance_s: float
) -> tuple[list[tuple[Path, Path]], tuple[float, ...]]:
    """Pairs of files, and the times of the pairs in seconds; no times if the names are frame numbers."""
    numbers = [[_number(file) for file in files] for files in (colour, depth)]
    seconds = [_times(side) for side in numbers]
    if all(value is not None for side in seconds for value in side):
        stamps = [[float(value - seconds[0][0]) for value in side] for side in seconds]  # type: ignore[operator]
        chosen = pair_stamps(stamps[0], stamps[1], tolerance_s, str(path))
        return [(colour[i], depth[j]) for i, j in chosen], tuple(stamps[0][i] for i, _ in chosen)
    if len(colour) != len(depth):
        alone = min(set(numbers[0]) ^ set(numbers[1]), default=None)
        first_alone = next((file.name for file in (*colour, *depth) if _number(file) == alone), colour[-1].name)
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
    return [_seconds(n) or (n if decimals and n >= 0 else None) for n in numbers]


def _seconds(number: Decimal) -> Decimal | None:
    """A time stamp in seconds, from a Unix time in s, ms, us or ns or another number with decimals; else None."""
    unit = next((unit for unit in (1, 10**3, 10**6, 10**9) if 10**9 <= number / unit < 10**10), None)
    if unit is not None:
        return number / unit
    return number if number.as_tuple().exponent != 0 else None


def _stamp(word: str) -> float:
    """The time in seconds of a line of a TUM file."""
    return float(_seconds(Decimal(word)) or Decimal(word))


def _read_intrinsics(path: Path, names: Iterable[str], *more: str) -> _Source:
    """Path of the intrinsics file, and the entries in the file. The reader also uses the entries `more`."""
    file = next((path / name for name in names if (path / name).is_file()), None)
    if file is None:
        return None, {}
    kind = "a file of intrinsics"
    with reading(file, kind):
        stored = read_json(file, kind)
        if not isinstance(stored, dict):
            raise TypeError(f"it holds a {type(stored).__name__}, expected an object with the entry K")
        stored = {**{ours: stored[name] for name, ours in _OF_PYREALSENSE.items() if name in stored}, **stored}
        stored["distortion"] = np.ravel(stored.get("distortion", ())).astype(float).tolist()
    model = str(stored.get("model", ""))
    if any(stored["distortion"]) and not _MODELS.search(model.lower()):
        text = f"{file}: the distortion model is {model!r}, which is not supported"
        raise InputError(text, "rectify the images, and store the coefficients 0, 0, 0, 0")
    warn_of_unread(file, stored, (*_READ, *more), {*_NOTES, *_OF_PYREALSENSE, "model"})
    return file, stored


def _stored(file: Path | None, stored: dict[str, Any], name: str, default: float) -> float:
    """The number `name` in the intrinsics file (at least 1), or `default`."""
    value = stored.get(name, default)
    check_number(f"{file}: {name}", value, f"give it: {name}=VALUE", at_least=1)
    return float(value)


def _stored_scale(file: Path | None, stored: dict[str, Any]) -> float:
    """Metres per unit of integer depth. In the file, values from 1 on are units per metre, as Open3D writes them."""
    value = stored.get("depth_scale", 0.001)
    check_number(f"{file}: depth_scale", value, "give it in metres per unit: depth_scale=0.001", above=0)
    return float(value) if value < 1 else 1 / float(value)


def _stored_matrix(path: Path, file: Path | None, stored: dict[str, Any]) -> tuple[float, ...]:
    """Intrinsics fx, fy, cx, cy from the intrinsics file."""
    if file is None:
        raise InputError(
            f"{path}: intrinsics are missing, there is no {' or '.join(INTRINSICS)}",
            "give them: -o K=fx,fy,cx,cy (the default of Redwood is 525,525,319.5,239.5)",
        )
    hint = "expected fx, fy, cx, cy, or K row by row, or intrinsic_matrix of Open3D column by column; or give K"
    with reading(file, "a file of intrinsics", hint):
        if "intrinsic_matrix" in stored:
            K = _four(np.reshape(stored["intrinsic_matrix"], (3, 3)).T)
        else:
            K = _four([stored[name] for name in ("fx", "fy", "cx", "cy")] if "fx" in stored else stored["K"])
    for name, value in zip(("fx", "fy", "cx", "cy"), K, strict=True):
        check_number(f"{file}: {name}", value, hint, above=0)
    return K


def _four(K: Any) -> tuple[float, ...]:
    """Intrinsics fx, fy, cx, cy from four numbers, or from the nine numbers of a 3 x 3 matrix."""
    values = np.asarray(K, dtype=float)
    if values.size == 4:
        return tuple(values.ravel().tolist())
    if values.size != 9:
        raise ValueError(f"the matrix has {values.size} numbers, expected 4 or 9")
    matrix = values.reshape(3, 3)
    if not np.allclose(matrix[2], (0, 0, 1)):
        raise ValueError(f"the matrix is {matrix.tolist()}, expected the rows fx 0 cx, 0 fy cy, 0 0 1")
    return tuple(matrix[(0, 1, 0, 1), (0, 1, 2, 2)].tolist())


@dataclass(frozen=True)
class Tum(VideoFormat):
    """TUM RGB-D: rgb.txt, depth.txt, and groundtruth.txt if the camera moves. The parameter `K` is required.

    Lines of rgb.txt and depth.txt are ``timestamp filename``. Lines of groundtruth.txt are ``timestamp tx ty tz qx qy
    qz qw``. Depth is in units of 1/5000 m. The format is described by Sturm et al. (2012).

    Parameters: `VideoFormat`.
    """

    depth_scale: NonNegativeFloat = 0.0002

    @classmethod
    def detects(cls, path: Path) -> bool:
        return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()

    def video(self, path: Path) -> Video:
        colour, depth = (_table(path / name, 2) for name in ("rgb.txt", "depth.txt"))
        if not self.K:
            raise InputError(
                f"{path}: intrinsics are missing, TUM folders do not store them",
                "give them: K=fx,fy,cx,cy (the default of TUM is 525,525,319.5,239.5)",
            )
        outside = [row[1] for row in (*colour, *depth) if Path(row[1]).is_absolute() or ".." in Path(row[1]).parts]
        if outside:
            raise InputError(f"{path}: image {outside[0]} is outside the folder", "names are relative to the folder")
        used = {(*Path(row[1]).parent.parts, ".")[0] for row in depth}
        _check_aligned(path, used, "name the files of {name}/ in depth.txt")
        stamps = [[_stamp(row[0]) for row in table] for table in (colour, depth)]
        pairs = pair_stamps(stamps[0], stamps[1], self.tolerance_s, str(path))
        times = tuple(stamps[0][i] for i, _ in pairs)
        truth, images = path / "groundtruth.txt", [path / row[1] for row in colour]
        _check_masks(path, images)
        return Video.of_files(
            path.resolve().name,
            times,
            [(images[i], path / depth[j][1], _mask(path, images[i])) for i, j in pairs],
            self.K,
            path,
            self.depth_scale,
            motion=_motion(truth, times) if truth.is_file() else None,
            distortion=self.distortion,
        )


def _table(path: Path, columns: int) -> list[list[str]]:
    """Rows of a text file as lists of words, without comments."""
    lines = read_text(path, "a TUM folder", "it holds rgb.txt and depth.txt").splitlines()
    rows = []
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            Decimal(words[0]) + 0  # refuses signalling values
            words = words if math.isfinite(float(words[0])) else []
        except (ValueError, ArithmeticError):
            words = []
        if len(words) < columns:
            raise InputError(
                f"{path}, line {number}: found {line[:60]!r}, expected {columns} columns, time stamp first"
            )
        rows.append(words)
    return rows


def _motion(path: Path, times: tuple[float, ...]) -> list[RigidTransform]:
    """Camera poses at given times, each from the line of the file with the nearest time stamp."""
    try:
        rows = np.array([[_stamp(row[0]), *map(float, row[1:8])] for row in _table(path, 8)])
        if not np.isfinite(rows).all():
            raise ValueError("a value is not finite")
        stamps = rows[:, 0]
        poses = RigidTransform.from_components(rows[:, 1:4], Rotation.from_quat(rows[:, 4:8]))
    except (ValueError, IndexError) as error:
        raise InputError(f"{path} does not hold poses: {error}", _STILL) from error
    nearest = [int(np.abs(stamps - t).argmin()) for t in times]
    difference = max(abs(stamps[k] - t) for k, t in zip(nearest, times, strict=True))
    if difference > 0.1:
        raise InputError(
            f"{path}: the nearest pose is {difference:.2f} s from an image, expected at most 0.1 s",
            "check that it belongs to this recording",
            _STILL,
        )
    return [poses[k] for k in nearest]

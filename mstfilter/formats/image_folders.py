"""What the readers of image folders share: files of intrinsics, robot masks, and the times in names of images.

>>> calibration = Intrinsics.read(path, INTRINSICS)
>>> calibration.K, calibration.number("fps", 30)
>>> seconds_in(number_of(Path("1700000000250.png")))        # milliseconds
Decimal('1700000000.25')
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, check_number, warn_user
from mstfilter.base.files import reading
from mstfilter.base.reading import MAX_TEXT, read_bytes, read_json
from mstfilter.formats.images import File
from mstfilter.formats.video import Video, VideoFormat, warn_of_unread

INTRINSICS = ("intrinsic.json", "camera_intrinsic.json", "intrinsics.json", "camera.json")
_READ = ("K", "fx", "fy", "cx", "cy", "intrinsic_matrix", "distortion", "width", "height")
_OF_PYREALSENSE = {"ppx": "cx", "ppy": "cy", "coeffs": "distortion"}  # names of pyrealsense2, which has `model` too
#: Distortion models, as text or number of pyrealsense2, whose coefficients are those of OpenCV. The library projects
#: by the same formula for all of them.
_MODELS = re.compile(r"brown|plumb_bob|rational|opencv|none|^$|^[0124]$")
#: Entries of the recorders of Open3D, and of info.json, that say nothing about the images.
_NOTES = {"device_name", "serial_number", "serial_number_", "stream_length_usec", "color_format", "depth_format"}
_NOTES |= {"color_mode", "depth_mode", "class_name", "version_major", "version_minor", "frames", "classes", "source"}


@dataclass(frozen=True)
class Intrinsics:
    """A file of intrinsics beside images, with entries as this package, Open3D or pyrealsense2 name them."""

    folder: Path
    file: Path | None  #: None if the folder has no such file
    entries: dict[str, Any]

    @classmethod
    def read(cls, folder: Path, names: Iterable[str], *more: str) -> Intrinsics:
        """Read the first existing file of `names`. The reader also uses the entries `more`; others give a warning."""
        file = next((folder / name for name in names if (folder / name).is_file()), None)
        if file is None:
            return cls(folder, None, {})
        with reading(file, "a file of intrinsics"):
            stored = read_json(file, "a file of intrinsics")
            if not isinstance(stored, dict):
                raise TypeError(f"it holds a {type(stored).__name__}, expected an object with the entry K")
            stored = {**{ours: stored[name] for name, ours in _OF_PYREALSENSE.items() if name in stored}, **stored}
            stored["distortion"] = np.ravel(stored.get("distortion", ())).astype(float).tolist()
        model = str(stored.get("model", ""))
        if any(stored["distortion"]) and not _MODELS.search(model.lower()):
            text = f"{file}: the distortion model is {model!r}, which is not supported"
            raise InputError(text, "rectify the images, and store the coefficients 0, 0, 0, 0")
        warn_of_unread(file, stored, (*_READ, *more), {*_NOTES, *_OF_PYREALSENSE, "model"})
        return cls(folder, file, stored)

    @property
    def K(self) -> tuple[float, ...]:
        """Intrinsics fx, fy, cx, cy in pixels."""
        if self.file is None:
            raise InputError(
                f"{self.folder}: intrinsics are missing, there is no {' or '.join(INTRINSICS)}",
                "give them: -o K=fx,fy,cx,cy (the default of Redwood is 525,525,319.5,239.5)",
            )
        hint = "expected fx, fy, cx, cy, or K row by row, or intrinsic_matrix of Open3D column by column; or give K"
        names = ("fx", "fy", "cx", "cy")
        with reading(self.file, "a file of intrinsics", hint):
            if "intrinsic_matrix" in self.entries:
                K = four_intrinsics(np.reshape(self.entries["intrinsic_matrix"], (3, 3)).T)
            else:
                K = four_intrinsics(
                    [self.entries[name] for name in names] if "fx" in self.entries else self.entries["K"]
                )
        for name, value in zip(names, K, strict=True):
            check_number(f"{self.file}: {name}", value, hint, above=0)
        return K

    @property
    def depth_scale(self) -> float:
        """Metres per unit of integer depth. Values from 1 on are units per metre, as Open3D writes them."""
        value = self.entries.get("depth_scale", 0.001)
        check_number(f"{self.file}: depth_scale", value, "give it in metres per unit: depth_scale=0.001", above=0)
        return float(value) if value < 1 else 1 / float(value)

    def number(self, name: str, default: float) -> float:
        """The entry `name`, a number of at least 1, or `default`."""
        value = self.entries.get(name, default)
        check_number(f"{self.file}: {name}", value, f"give it: {name}=VALUE", at_least=1)
        return float(value)

    def video(
        self, reader: VideoFormat, name: str, times: tuple[float, ...], files: Any, depth_scale: float
    ) -> Video:
        """The video of triples of files. Options of the reader replace entries of the file."""
        K, distortion = reader.K or self.K, reader.distortion or tuple(self.entries.get("distortion", ()))
        video = Video.of_files(name, times, files, K, self.folder, depth_scale, distortion=distortion)
        for side, n in zip(("height", "width"), video.read_rgb(0).shape, strict=False):
            if not reader.K and self.number(side, n) != n:
                text = f"{self.file} is for images of another {side}: the images have {n}"
                raise InputError(text, "scale the intrinsics, or give them: K=fx,fy,cx,cy")
        return video


def four_intrinsics(K: Any) -> tuple[float, ...]:
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


def is_recording(path: Path) -> bool:
    """Whether a folder is a recording folder: it has a manifest.json, or a camera.json with a workspace."""
    camera = path / "camera.json"
    ours = camera.is_file() and b'"workspace"' in read_bytes(camera, "a camera file", limit=MAX_TEXT)
    return ours or (path / "manifest.json").is_file()


def mask_of(path: Path, colour: Path) -> Path:
    """The file of the optional robot mask of a colour image."""
    return path / "robot" / f"{colour.stem}.png"


def check_masks(path: Path, colour: Iterable[Path]) -> None:
    """Warn of robot masks that belong to no colour image, or are in a folder with another name."""
    if near := [name for name in os.listdir(path) if re.search("robot.|mask", name.lower()) and "." not in name]:
        warn_user(f"{path / near[0]} is not read", "rename it to robot/ if it has the robot masks")
    if other := sorted({*path.glob("robot/[!.]*")} - {mask_of(path, file) for file in colour}):
        text = f"{path / 'robot'}: {len(other)} masks of no colour image are not read, for example {other[0].name}"
        warn_user(text, "name a robot mask as its colour image: robot/000000.png for rgb/000000.jpg")


_ALIGNED = re.compile(r"depth.*(align|regist|(to|2)_?(colou?r|rgb))|(align|regist).*depth")


def check_aligned(path: Path, used: Collection[str], hint: str) -> None:
    """Raise InputError if a folder beside the `used` folders of depth images is named as one of aligned depth."""
    folders = sorted(p.name for p in path.iterdir() if p.is_dir()) if path.is_dir() else []
    aligned = [name for name in folders if _ALIGNED.search(name.lower())]
    if aligned and not set(aligned) & set(used):
        text = f"{path}: {', '.join(sorted(used))}/ would be read, but {aligned[0]}/ is there: depth must be aligned"
        raise InputError(text, hint.format(name=aligned[0]), f"or, if they are no depth images: rename {aligned[0]}/")


_SCAN = re.compile(r"(\d+)-(\d{12})")  # names of Redwood's object scans: number of the frame, and microseconds


def numbers_in(file: File) -> list[Decimal]:
    """The numbers in a file name. The time in the name of an object scan is in seconds, with decimals."""
    stem = file.name.rpartition(".")[0]
    if scan := _SCAN.fullmatch(stem):
        return [Decimal(scan[1]), Decimal(scan[2]).scaleb(-6)]
    return [Decimal(number) for number in re.findall(r"\d+(?:\.\d+)?", stem)]


def number_of(file: File) -> Decimal:
    """The last number in a file name, or -1 for a name without numbers."""
    return (numbers_in(file) or [Decimal(-1)])[-1]


def seconds_in(number: Decimal) -> Decimal | None:
    """A time stamp in seconds, from a Unix time in s, ms, us or ns or another number with decimals; else None."""
    unit = next((unit for unit in (1, 10**3, 10**6, 10**9) if 10**9 <= number / unit < 10**10), None)
    if unit is not None:
        return number / unit
    return number if number.as_tuple().exponent != 0 else None

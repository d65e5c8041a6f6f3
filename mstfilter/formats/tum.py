"""The layout of the TUM RGB-D benchmark: lists of colour images, depth images and camera poses by time.

>>> Tum(K=(525.0, 525.0, 319.5, 239.5)).open(Path("rgbd_dataset"))
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.base.errors import InputError
from mstfilter.base.fields import NonNegativeFloat
from mstfilter.base.reading import read_text
from mstfilter.formats.image_folders import check_aligned, check_masks, mask_of, seconds_in
from mstfilter.formats.video import Video, VideoFormat, pair_stamps


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
        check_aligned(path, used, "name the files of {name}/ in depth.txt")
        stamps = [[_stamp(row[0]) for row in table] for table in (colour, depth)]
        pairs = pair_stamps(stamps[0], stamps[1], self.tolerance_s, str(path))
        times = tuple(stamps[0][i] for i, _ in pairs)
        truth, images = path / "groundtruth.txt", [path / row[1] for row in colour]
        check_masks(path, images)
        return Video.of_files(
            path.resolve().name,
            times,
            [(images[i], path / depth[j][1], mask_of(path, images[i])) for i, j in pairs],
            self.K,
            path,
            self.depth_scale,
            motion=_motion(truth, times) if truth.is_file() else None,
            distortion=self.distortion,
        )


def _stamp(word: str) -> float:
    """The time in seconds of a line of a TUM file."""
    return float(seconds_in(Decimal(word)) or Decimal(word))


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
        raise InputError(
            f"{path} does not hold poses: {error}", "remove the file if the camera stands still"
        ) from error
    nearest = [int(np.abs(stamps - t).argmin()) for t in times]
    difference = max(abs(stamps[k] - t) for k, t in zip(nearest, times, strict=True))
    if difference > 0.1:
        raise InputError(
            f"{path}: the nearest pose is {difference:.2f} s from an image, expected at most 0.1 s",
            "check that it belongs to this recording",
            "remove the file if the camera stands still",
        )
    return [poses[k] for k in nearest]

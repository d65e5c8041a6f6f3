"""TUM RGB-D: ``rgb.txt`` and ``depth.txt`` name images by time stamp; depth in units of 1/5000 m.

>>> Tum(K=(525.0, 525.0, 319.5, 239.5)).open(Path("rgbd_dataset"))

Lines of the two lists are ``timestamp filename``; ``groundtruth.txt`` (``timestamp tx ty tz qx qy qz qw``), where
present, says how the camera moved. The layout holds no intrinsics: they have to be given. Format: Sturm et al. 2012.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.errors import InputError
from mstfilter.formats.interfaces import Format
from mstfilter.formats.pauses import PauseRule
from mstfilter.formats.still import Still
from mstfilter.formats.video import Images, Video, World, pair_stamps
from mstfilter.scene import Recording, read_depth, read_rgb

__all__ = ["Tum"]


@dataclass(frozen=True)
class Tum(Format):
    """TUM RGB-D: rgb.txt, depth.txt, groundtruth.txt where the camera moves; K has to be given.

    Parameters
    ----------
    K : tuple of 4 float
        fx, fy, cx, cy in pixels.
    distortion : tuple of float
        OpenCV's k1, k2, p1, p2, k3.
    depth_scale : float
        Metres a unit.
    tolerance_s : float
        A colour and a depth image at most this far apart are one frame.
    moving : bool
        Use groundtruth.txt where it is present.
    start_s, stop_s : float
        Part of the video that is used, in seconds after its first frame.
    pauses : PauseRule
        Where the video is cut.
    world : World
        Pose and workspace, where known.
    """

    K: tuple[float, ...] = ()
    distortion: tuple[float, ...] = ()
    depth_scale: float = 0.0002
    tolerance_s: float = 0.02
    moving: bool = True
    start_s: float = 0.0
    stop_s: float = math.inf
    pauses: PauseRule = field(default_factory=Still)
    world: World = field(default_factory=World)

    @classmethod
    def detects(cls, path: Path) -> bool:
        """See `Format`."""
        return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()

    def open(self, path: Path) -> Recording:
        """See `Format`."""
        colour, depth = (_table(path / name, 2) for name in ("rgb.txt", "depth.txt"))
        if not self.K:
            raise InputError(
                f"{path}: intrinsics are missing, TUM folders hold none",
                "give them: K=fx,fy,cx,cy (TUM's own default is 525,525,319.5,239.5)",
            )
        stamps = [[float(row[0]) for row in table] for table in (colour, depth)]
        pairs = pair_stamps(stamps[0], stamps[1], self.tolerance_s, str(path))

        def read(index: int) -> Images:
            names = [path / table[k][1] for table, k in zip((colour, depth), pairs[index], strict=True)]
            return Images(
                read_rgb(names[0]),
                read_depth(names[1], self.depth_scale),
                f"colour image {names[0]}",
                f"depth image {names[1]}",
            )

        times = tuple(stamps[0][i] for i, _ in pairs)
        truth = path / "groundtruth.txt"
        return (
            Video(
                path.resolve().name,
                times,
                read,
                self.K,
                path,
                self.depth_scale,
                read_rgb=lambda index: read_rgb(path / colour[pairs[index][0]][1]),
                motion=_motion(truth, times) if self.moving and truth.is_file() else None,
                distortion=self.distortion,
            )
            .part(self.start_s, self.stop_s)
            .recording(self.pauses, self.world)
        )


def _table(path: Path, columns: int) -> list[list[str]]:
    """Rows of a text file, comments left out."""
    try:
        lines = path.read_text().splitlines()
    except FileNotFoundError:
        raise InputError(f"not a TUM folder: {path} is missing", "it holds rgb.txt and depth.txt") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    rows = []
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            float(words[0])
        except ValueError:
            words = []
        if len(words) < columns:
            raise InputError(
                f"{path}, line {number}: found {line[:60]!r}, expected {columns} columns, time stamp first"
            )
        rows.append(words)
    return rows


def _motion(path: Path, times: tuple[float, ...]) -> list[RigidTransform]:
    """Camera poses at given times, from the nearest line."""
    try:
        rows = np.array([[float(v) for v in row[:8]] for row in _table(path, 8)])
        if not np.isfinite(rows).all():
            raise ValueError("a value is not finite")
        stamps = rows[:, 0]
        poses = RigidTransform.from_components(rows[:, 1:4], Rotation.from_quat(rows[:, 4:8]))
    except (ValueError, IndexError) as error:
        raise InputError(f"{path} does not hold poses: {error}", "or leave it out: moving=false") from error
    nearest = [int(np.abs(stamps - t).argmin()) for t in times]
    apart = max(abs(stamps[k] - t) for k, t in zip(nearest, times, strict=True))
    if apart > 0.1:
        raise InputError(
            f"{path}: the nearest pose is {apart:.2f} s from an image, expected at most 0.1 s",
            "is it of another recording? leave it out: moving=false",
        )
    return [poses[k] for k in nearest]

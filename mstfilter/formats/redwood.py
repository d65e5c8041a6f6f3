"""Redwood and Open3D: ``color/`` and ``depth/`` with numbered images, an ``intrinsic.json``, a trajectory ``.log``.

>>> Redwood().open(Path("bedroom"))

``intrinsic.json`` (or ``camera_intrinsic.json``) is Open3D's: width, height, ``intrinsic_matrix`` column by column.
A trajectory has five lines a frame: three numbers, then a 4x4 camera-to-world matrix. Images are paired by the
first number in their names. Depth is in millimetres unless said otherwise.
Format: http://redwood-data.org/indoor/fileformat.html.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.errors import InputError
from mstfilter.formats.interfaces import Format
from mstfilter.formats.pauses import PauseRule
from mstfilter.formats.still import Still
from mstfilter.formats.video import Images, Video, World
from mstfilter.scene import Recording, read_depth, read_rgb, rigid_from_matrix

__all__ = ["Redwood"]

_COLOUR, _SUFFIXES = ("color", "image", "rgb", "colour"), (".png", ".jpg", ".jpeg")
_INTRINSICS = ("intrinsic.json", "camera_intrinsic.json", "intrinsics.json")


@dataclass(frozen=True)
class Redwood(Format):
    """Redwood / Open3D: color/, depth/, intrinsic.json, and a trajectory .log where the camera moves.

    Parameters
    ----------
    K : tuple of 4 float
        fx, fy, cx, cy in pixels. Default: from intrinsic.json.
    distortion : tuple of float
        OpenCV's k1, k2, p1, p2, k3.
    depth_scale : float
        Metres a unit.
    fps : float
        The layout has no times: frame k is at k / fps seconds.
    moving : bool
        Use the trajectory where there is one.
    start_s, stop_s : float
        Part of the video that is used, in seconds after its first frame.
    pauses : PauseRule
        Where the video is cut.
    world : World
        Pose and workspace, where known.
    """

    K: tuple[float, ...] = ()
    distortion: tuple[float, ...] = ()
    depth_scale: float = 0.001
    fps: float = 30.0
    moving: bool = True
    start_s: float = 0.0
    stop_s: float = math.inf
    pauses: PauseRule = field(default_factory=Still)
    world: World = field(default_factory=World)

    @classmethod
    def detects(cls, path: Path) -> bool:
        """See `Format`."""
        known = any((path / name).is_file() for name in _INTRINSICS) or any(path.glob("*.log"))
        folders = _COLOUR if known else _COLOUR[:2]  # rgb/ and depth/ alone may be anything
        return (path / "depth").is_dir() and any((path / name).is_dir() for name in folders)

    def open(self, path: Path) -> Recording:
        """See `Format`."""
        folder = next((path / name for name in _COLOUR if (path / name).is_dir()), path / _COLOUR[0])
        colour, depth = _numbered(folder), _numbered(path / "depth")
        if len(colour) != len(depth):
            raise InputError(
                f"{path}: there are {len(colour)} colour images and {len(depth)} depth images",
                f"each frame needs both; {folder.name}/ ends with {colour[-1].name}, depth/ with {depth[-1].name}",
            )
        for a, b in zip(colour, depth, strict=True):
            if _number(a) != _number(b):
                raise InputError(
                    f"{path}: colour image {a.name} would be paired with depth image {b.name}",
                    "an image is missing, or the two are numbered differently; rename one side to match",
                )

        def read(index: int) -> Images:
            names = f"colour image {colour[index]}", f"depth image {depth[index]}"
            return Images(read_rgb(colour[index]), read_depth(depth[index], self.depth_scale), *names)

        logs = sorted(path.glob("*.log")) if self.moving else []
        if len(logs) > 1:
            raise InputError(f"{path} holds {len(logs)} trajectories: {', '.join(p.name for p in logs)}", "keep one")
        return (
            Video(
                path.resolve().name,
                tuple(k / self.fps for k in range(len(colour))),
                read,
                self.K or _intrinsics(path),
                path,
                self.depth_scale,
                read_rgb=lambda index: read_rgb(colour[index]),
                motion=_trajectory(logs[0], len(colour)) if logs else None,
                distortion=self.distortion,
            )
            .part(self.start_s, self.stop_s)
            .recording(self.pauses, self.world)
        )


def _numbered(folder: Path) -> list[Path]:
    """Images of a folder in the order of the first number in their names."""
    if not folder.is_dir():
        raise InputError(f"not a Redwood folder: {folder} is missing", "it holds color/ and depth/")
    files = [p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES and not p.name.startswith(".")]
    if not files:
        raise InputError(f"{folder} holds no image", f"expected {', '.join(_SUFFIXES)}")

    return sorted(files, key=lambda file: (_number(file), file.name))


def _number(file: Path) -> int:
    """The first number in the name; -1 without any."""
    found = re.search(r"\d+", file.stem)
    return int(found.group()) if found else -1


def _intrinsics(path: Path) -> tuple[float, ...]:
    """fx, fy, cx, cy from Open3D's file."""
    file = next((path / name for name in _INTRINSICS if (path / name).is_file()), None)
    if file is None:
        raise InputError(
            f"{path}: intrinsics are missing, there is no {_INTRINSICS[0]}",
            "give them: K=fx,fy,cx,cy (Redwood's own default is 525,525,319.5,239.5)",
        )
    try:
        matrix = np.reshape(np.asarray(json.loads(file.read_text())["intrinsic_matrix"], dtype=float), (3, 3)).T
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file} does not hold Open3D's intrinsic_matrix: {error!r}") from error
    if not np.allclose(matrix[2], (0, 0, 1)):
        raise InputError(
            f"{file}: intrinsic_matrix is {matrix.T.ravel().tolist()}, expected 9 numbers column by column",
            "fx 0 0 0 fy 0 cx cy 1",
        )
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _trajectory(path: Path, n: int) -> list[RigidTransform]:
    """Camera-to-world poses of a .log file, one a frame."""
    try:
        rows = [[float(v) for v in line.split()] for line in path.read_text().splitlines() if line.strip()]
    except (OSError, ValueError) as error:
        raise InputError(f"trajectory cannot be read: {path} ({error})", "or leave it out: moving=false") from error
    if len(rows) != 5 * n or any(len(row) != (3 if k % 5 == 0 else 4) for k, row in enumerate(rows)):
        raise InputError(
            f"trajectory {path} has {len(rows)} lines for {n} frames, expected five a frame: 3 numbers, then 4 x 4",
            "or leave it out: moving=false",
        )
    return [rigid_from_matrix(np.array(rows[5 * k + 1 : 5 * k + 5]), f"{path}: pose of frame {k}") for k in range(n)]

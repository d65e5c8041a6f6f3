"""Folders of colour and depth images: pairs of images, Redwood / Open3D, TUM RGB-D.

>>> PairedImages(frames=("learn2", "learn3", "learn4")).open(Path("frames"))
>>> Redwood().open(Path("bedroom"))
>>> Tum(K=(525.0, 525.0, 319.5, 239.5)).open(Path("rgbd_dataset"))
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.errors import InputError, check_number
from mstfilter.files import reading
from mstfilter.formats.video import RecordingFormat, Video, VideoFormat, object_numbers, pair_stamps
from mstfilter.reading import read_json, read_text
from mstfilter.scene import Frame, Recording, read_depth, read_labels, read_rgb, rigid_from_matrix, table_residual


@dataclass(frozen=True)
class PairedImages(RecordingFormat):
    """A folder of pairs NAME_rgb.png, NAME_depth.png with an info.json; every frame is a pause.

    ``info.json`` holds ``K`` (fx, fy, cx, cy, or a 3x3 matrix) and ``depth_scale_m``, metres per unit of the 16-bit
    depth images. There is no pose: the world is found from the support plane. Label images NAME_label.png (8 or 16
    bits, one number for each object) become the true instances.

    Parameters
    ----------
    frames : tuple of str
        Names of the frames in order. Default: all, by name; numbers in names count as numbers.
    background : tuple of int
        Labels that are no objects, besides 0. Default: those with most of their readings on the support plane.
    """

    frames: tuple[str | int, ...] = ()
    background: tuple[int, ...] = ()

    @classmethod
    def detects(cls, path: Path) -> bool:
        return (path / "info.json").is_file() and any(path.glob("*_rgb.png"))

    def open(self, path: Path) -> Recording:
        example = 'for example {"K": [525, 525, 319.5, 239.5], "depth_scale_m": 0.001}'
        with reading(path / "info.json", "pairs of images", example):
            info = read_json(path / "info.json", "pairs of images", example)
            K, scale = np.asarray(info["K"], dtype=float), float(info["depth_scale_m"])
        if K.shape == (4,):
            K = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])
        names = [p.name.removesuffix("_rgb.png") for p in path.glob("*_rgb.png")]
        present = sorted(
            names, key=lambda name: [w.zfill(20) if w.isdigit() else w for w in re.split(r"(\d+)", name)]
        )
        chosen = [str(name) for name in self.frames] or present
        missing = [name for name in chosen if name not in present]
        if missing:
            raise InputError(
                f"no frame {missing[0]!r} in {path}", f"there are {len(present)}: {', '.join(present[:8])}, ..."
            )
        rgb = [read_rgb(path / f"{name}_rgb.png") for name in chosen]
        depth = [read_depth(path / f"{name}_depth.png", scale) for name in chosen]
        for name, image in zip(chosen, rgb, strict=True):
            if image.shape != rgb[0].shape:
                raise InputError(f"frame {name} of {path} has shape {image.shape}, the first has {rgb[0].shape}")
        label = chosen[0] if len(chosen) == 1 else f"{chosen[0]}-{chosen[-1]}"
        made = Recording.from_arrays(np.stack(rgb), np.stack(depth), K, pauses=range(len(chosen)), name=label)

        def instance(index: int) -> np.ndarray | None:
            return self._instance(made.frames[index], path / f"{chosen[index]}_label.png")

        return replace(made, path=path, depth_scale=scale, instance=instance)

    def _instance(self, frame: Frame, file: Path) -> np.ndarray | None:
        """The true objects (H, W) of a frame; None if there is no label image."""
        if not file.is_file():
            return None
        labels = read_labels(file)
        if labels.shape != frame.depth.shape:
            raise InputError(f"label image {file} has shape {labels.shape}, its frame has {frame.depth.shape}")
        background = self.background
        if not background:
            with np.errstate(invalid="ignore"):
                on_plane = np.abs(table_residual(frame)) < _ON_PLANE
            known = np.unique(labels[frame.valid])
            background = tuple(int(k) for k in known if on_plane[frame.valid & (labels == k)].mean() > 0.5)
        return object_numbers(np.where(np.isin(labels, background), 0, labels))


_ON_PLANE = 2.0  # disparity in 1/8 pixels of a Kinect: 6 mm at 1 m
_COLOUR, _SUFFIXES = ("color", "image", "rgb", "colour"), (".png", ".jpg", ".jpeg")
_INTRINSICS = ("intrinsic.json", "camera_intrinsic.json", "intrinsics.json")


@dataclass(frozen=True)
class Redwood(VideoFormat):
    """Redwood / Open3D: color/, depth/, intrinsic.json, and a trajectory .log if the camera moves.

    ``intrinsic.json`` (or ``camera_intrinsic.json``) is the file of Open3D: width, height, ``intrinsic_matrix``
    column by column, and from its recorders ``depth_scale`` (units per metre) and ``fps``. A trajectory has five
    lines per frame: three numbers, then a 4x4 camera-to-world matrix. Images are paired by the first number in their
    names. Format: http://redwood-data.org/indoor/fileformat.html.

    Further parameters: `VideoFormat`.

    Parameters
    ----------
    depth_scale : float
        Metres per unit of 16-bit depth. Default: from ``intrinsic.json``, else 0.001.
    distortion : tuple of float
        OpenCV's k1, k2, p1, p2, k3.
    fps : float
        Frames per second. Default: from ``intrinsic.json``, else 30; the layout stores no times.
    moving : bool
        Use the trajectory, if there is one.
    """

    depth_scale: float = 0.0
    distortion: tuple[float, ...] = ()
    fps: float = 0.0
    moving: bool = True

    @classmethod
    def detects(cls, path: Path) -> bool:
        known = any((path / name).is_file() for name in _INTRINSICS) or any(path.glob("*.log"))
        folders = _COLOUR if known else _COLOUR[:2]  # rgb/ and depth/ occur in other layouts, too
        return (path / "depth").is_dir() and any((path / name).is_dir() for name in folders)

    def open(self, path: Path) -> Recording:
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
                    f"{path}: colour image {a.name} does not fit depth image {b.name}",
                    "an image is missing, or the two are numbered differently; rename one side to match",
                )

        logs = sorted(path.glob("*.log")) if self.moving else []
        if len(logs) > 1:
            raise InputError(
                f"{path} has {len(logs)} trajectories: {', '.join(p.name for p in logs)}", "remove all but one"
            )
        scale = self.depth_scale or 1 / _stored(path, "depth_scale", 1000)
        fps = self.fps or _stored(path, "fps", 30)
        video = Video(
            path.resolve().name,
            tuple(k / fps for k in range(len(colour))),
            lambda index: read_rgb(colour[index]),
            lambda index: read_depth(depth[index], scale),
            self.K or _intrinsics(path),
            path,
            scale,
            motion=_trajectory(logs[0], len(colour)) if logs else None,
            distortion=self.distortion,
        )
        for name, n in zip(("height", "width"), video.read_rgb(0).shape, strict=False):
            if not self.K and _stored(path, name, n) != n:
                raise InputError(
                    f"{_open3d_file(path)} is for images of another {name}: the images have {n}",
                    "scale the intrinsics, or give them: K=fx,fy,cx,cy",
                )
        return self.recording_of(video)


def _numbered(folder: Path) -> list[Path]:
    """Images of a folder, ordered by the first number in their names."""
    if not folder.is_dir():
        raise InputError(f"not a Redwood folder: {folder} is missing", "it holds color/ and depth/")
    files = [p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES and not p.name.startswith(".")]
    if not files:
        raise InputError(f"{folder} has no image", f"expected {', '.join(_SUFFIXES)}")
    return sorted(files, key=lambda file: (_number(file), file.name))


def _number(file: Path) -> int:
    """The first number in the name; -1 if there is none."""
    found = re.search(r"\d+", file.stem)
    return int(found.group()) if found else -1


def _open3d_file(path: Path) -> Path | None:
    return next((path / name for name in _INTRINSICS if (path / name).is_file()), None)


def _stored(path: Path, name: str, default: float) -> float:
    """A number from 1 of Open3D's file: ``depth_scale`` (units per metre), ``fps``, ``width`` or ``height``."""
    file = _open3d_file(path)
    if file is None:
        return default
    with reading(file, "a file of Open3D"):
        value = read_json(file, "a file of Open3D").get(name, default)
    check_number(f"{file}: {name}", value, f"give it: {name}=VALUE", at_least=1)
    return float(value)


def _intrinsics(path: Path) -> tuple[float, ...]:
    """fx, fy, cx, cy from Open3D's file."""
    file = _open3d_file(path)
    if file is None:
        raise InputError(
            f"{path}: intrinsics are missing, there is no {_INTRINSICS[0]}",
            "give them: K=fx,fy,cx,cy (the default of Redwood is 525,525,319.5,239.5)",
        )
    with reading(file, "a file of Open3D"):
        values = read_json(file, "a file of Open3D")["intrinsic_matrix"]
        matrix = np.reshape(np.asarray(values, dtype=float), (3, 3)).T
    if not np.allclose(matrix[2], (0, 0, 1)):
        raise InputError(
            f"{file}: intrinsic_matrix is {matrix.T.ravel().tolist()}, expected 9 numbers column by column",
            "fx 0 0 0 fy 0 cx cy 1",
        )
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _trajectory(path: Path, n: int) -> list[RigidTransform]:
    """Camera-to-world poses of a .log file, one per frame."""
    with reading(path, "a trajectory", "or ignore it: moving=false"):
        lines = read_text(path, "a trajectory").splitlines()
        rows = [[float(v) for v in line.split()] for line in lines if line.strip()]
    if len(rows) != 5 * n or any(len(row) != (3 if k % 5 == 0 else 4) for k, row in enumerate(rows)):
        raise InputError(
            f"trajectory {path} has {len(rows)} lines for {n} frames, expected five per frame: 3 numbers, then 4 x 4",
            "or ignore it: moving=false",
        )
    return [rigid_from_matrix(np.array(rows[5 * k + 1 : 5 * k + 5]), f"{path}: pose of frame {k}") for k in range(n)]


@dataclass(frozen=True)
class Tum(VideoFormat):
    """TUM RGB-D: rgb.txt, depth.txt, groundtruth.txt if the camera moves; K must be given.

    Lines of rgb.txt and depth.txt are ``timestamp filename``, those of groundtruth.txt
    ``timestamp tx ty tz qx qy qz qw``. Depth is in units of 1/5000 m. Format: Sturm et al. 2012.

    Further parameters: `VideoFormat`.

    Parameters
    ----------
    distortion : tuple of float
        OpenCV's k1, k2, p1, p2, k3.
    tolerance_s : float
        Largest difference of the time stamps of a colour and a depth image of one frame.
    moving : bool
        Use groundtruth.txt, if it exists.
    """

    depth_scale: float = 0.0002
    distortion: tuple[float, ...] = ()
    tolerance_s: float = 0.02
    moving: bool = True

    @classmethod
    def detects(cls, path: Path) -> bool:
        return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()

    def open(self, path: Path) -> Recording:
        colour, depth = (_table(path / name, 2) for name in ("rgb.txt", "depth.txt"))
        if not self.K:
            raise InputError(
                f"{path}: intrinsics are missing, TUM folders do not store them",
                "give them: K=fx,fy,cx,cy (the default of TUM is 525,525,319.5,239.5)",
            )
        outside = [row[1] for row in (*colour, *depth) if Path(row[1]).is_absolute() or ".." in Path(row[1]).parts]
        if outside:
            raise InputError(f"{path}: image {outside[0]} is outside the folder", "names are relative to the folder")
        stamps = [[float(row[0]) for row in table] for table in (colour, depth)]
        pairs = pair_stamps(stamps[0], stamps[1], self.tolerance_s, str(path))

        times = tuple(stamps[0][i] for i, _ in pairs)
        truth = path / "groundtruth.txt"
        video = Video(
            path.resolve().name,
            times,
            lambda index: read_rgb(path / colour[pairs[index][0]][1]),
            lambda index: read_depth(path / depth[pairs[index][1]][1], self.depth_scale),
            self.K,
            path,
            self.depth_scale,
            motion=_motion(truth, times) if self.moving and truth.is_file() else None,
            distortion=self.distortion,
        )
        return self.recording_of(video)


def _table(path: Path, columns: int) -> list[list[str]]:
    """Rows of a text file without comments."""
    lines = read_text(path, "a TUM folder", "it holds rgb.txt and depth.txt").splitlines()
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
    """Camera poses at given times: those of the nearest lines."""
    try:
        rows = np.array([[float(v) for v in row[:8]] for row in _table(path, 8)])
        if not np.isfinite(rows).all():
            raise ValueError("a value is not finite")
        stamps = rows[:, 0]
        poses = RigidTransform.from_components(rows[:, 1:4], Rotation.from_quat(rows[:, 4:8]))
    except (ValueError, IndexError) as error:
        raise InputError(f"{path} does not hold poses: {error}", "or ignore it: moving=false") from error
    nearest = [int(np.abs(stamps - t).argmin()) for t in times]
    difference = max(abs(stamps[k] - t) for k, t in zip(nearest, times, strict=True))
    if difference > 0.1:
        raise InputError(
            f"{path}: the nearest pose is {difference:.2f} s from an image, expected at most 0.1 s",
            "check that it belongs to this recording, or ignore it: moving=false",
        )
    return [poses[k] for k in nearest]

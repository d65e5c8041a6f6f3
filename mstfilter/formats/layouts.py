"""What the folders of phones and data sets look like: where colour, depth, intrinsics, poses and labels lie.

>>> files = Files(Path("scan"))                     # a folder, or an archive (.zip, .r3d)
>>> find_layouts(files)
['stray']
>>> LAYOUTS["stray"].sensors(files, colour, numbers)      # intrinsics, pose and time of each frame

A `Layout` names the files by patterns, and has a function for the numbers beside them. To add a layout, add an entry
to `LAYOUTS`. `mstfilter.formats.known_layout` reads all of them.
"""

from __future__ import annotations

import csv
import io
import json
import re
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mstfilter.base.errors import InputError
from mstfilter.base.files import reading
from mstfilter.base.reading import MAX_TEXT, read_arrays, read_bytes
from mstfilter.formats.image_folders import four_intrinsics, number_of
from mstfilter.formats.images import File, file_content, read_depth, read_labels
from mstfilter.formats.record3d import read_lzfse_depth

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # axes right, up, back of OpenGL and ARKit: to right, down, forward


class Files:
    """The files of a folder, or the members of an archive."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._root: Any = None
        if path.is_file():
            with reading(path, "an archive"):
                self._root = zipfile.Path(path).root

    def _matching(self, pattern: str) -> Iterator[File]:
        if self._root is None:
            return (file for file in self.path.glob(pattern) if not file.name.startswith("."))
        names = (name for name in self._root.namelist() if not name.startswith("__MACOSX"))
        return (zipfile.Path(self._root, name) for name in names if PurePosixPath(name).match(pattern))

    def has(self, pattern: str) -> bool:
        """Whether there is a file of a pattern."""
        return next(self._matching(pattern), None) is not None

    def find(self, *patterns: str) -> list[File]:
        """Files of the first pattern that has any, in the order of their numbers."""
        for pattern in patterns:
            if found := list(self._matching(pattern)):
                return sorted(found, key=lambda file: (number_of(file), file.name))
        return []

    def one(self, *patterns: str) -> File:
        """The first file of the first pattern that has any. Raises InputError if there is none."""
        if not (found := self.find(*patterns)):
            raise InputError(f"{self.path}: {patterns[0]} is missing", "copy the folder again, with all its files")
        return found[0]

    def text(self, *patterns: str) -> str:
        """The text of the first file."""
        file = self.one(*patterns)
        data = file_content(file)
        with reading(Path(str(file)), "a recording"):
            if len(data) > MAX_TEXT:
                raise InputError(f"{file} has {len(data)} bytes, at most {MAX_TEXT} are parsed")
            return data.decode("utf-8-sig")

    def json(self, *patterns: str) -> dict[str, Any]:
        """The object of the first file, in JSON."""
        with reading(Path(str(self.one(*patterns))), "a recording"):
            stored = json.loads(self.text(*patterns))
            if not isinstance(stored, dict):
                raise TypeError(f"it holds a {type(stored).__name__}, expected an object")
            return stored

    def numbers(self, *patterns: str) -> np.ndarray:
        """The numbers (rows, columns) of the first file, separated by commas or spaces."""
        with reading(Path(str(self.one(*patterns))), "a table of numbers"):
            return np.loadtxt(io.StringIO(self.text(*patterns).replace(",", " ")), ndmin=2)


@dataclass(frozen=True)
class Sensor:
    """What is known of the camera in one frame. Empty fields are not known."""

    K: tuple[float, ...] = ()  #: fx, fy, cx, cy of the colour image
    depth_K: tuple[float, ...] = ()  #: of the depth image; by default, it shows the view of the colour image
    pose: np.ndarray | None = None  #: T_world_camera (4, 4), with axes right, down, forward; metres
    time: float | None = None  #: seconds
    unit: float | None = None  #: metres per unit of depth
    size: tuple[int, int] | None = None  #: width and height of the colour image to which K belongs


_Sensors = Iterator[Sensor | None]
#: From the files of a recording: a function that reads the label image of a frame, by its colour file.
Labels = Callable[[Files], Callable[[File], np.ndarray | None]]


@dataclass(frozen=True)
class Layout:
    """Where the data of a recording lie, as patterns of names relative to its folder."""

    title: str
    signs: tuple[str, ...]  #: a folder with a file of each of these patterns has this layout
    colour: tuple[str, ...]  #: patterns of colour images, or a video; the first that is there is read
    depth: tuple[str, ...]
    #: What is known of each frame, by its colour file and number; None for a frame that cannot be used.
    sensors: Callable[[Files, Sequence[Any], Sequence[Decimal]], _Sensors]
    labels: Labels = lambda files: lambda colour: None  #: true label images (H, W), 0 for background
    hands: bool = False  #: whether label 255 is a hand or robot
    read_depth: Callable[[Files], Callable[[File, float], np.ndarray]] = lambda files: read_depth
    unit: float = 0.001  #: metres per unit of integer depth, and of depth that is stored again
    fps: float = 30.0  #: frames per second, if nothing has the times
    intrinsics: str = ""  #: where to get K, if the layout does not have it
    note: str = ""  #: what the user should know of the data


def find_layouts(files: Files) -> list[str]:
    """Names of the layouts whose signs are there."""
    return [name for name, layout in LAYOUTS.items() if all(map(files.has, layout.signs))]


def _rigid(R: Any, t: Any) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.reshape(R, (3, 3)), t
    return pose


def _stray(files: Files, colour: Sequence[Any], numbers: Sequence[Decimal]) -> _Sensors:
    """Stray Scanner: one row of odometry.csv for each frame; newer versions of the app write K in it."""
    shared = four_intrinsics(files.numbers("camera_matrix.csv"))
    with reading(files.path / "odometry.csv", "a table of poses"):
        table = csv.DictReader(io.StringIO(files.text("odometry.csv")), skipinitialspace=True)
        rows = {int(float(row["frame"])): {k: float(v) for k, v in row.items() if k and v} for row in table}
        for row in map(rows.get, map(int, numbers)):
            if row is None:
                yield None
                continue
            R = Rotation.from_quat([row[k] for k in ("qx", "qy", "qz", "qw")]).as_matrix()
            K = tuple(row[k] for k in ("fx", "fy", "cx", "cy")) if row.get("fx") else shared
            yield Sensor(K, pose=_rigid(R, [row[k] for k in "xyz"]), time=row["timestamp"])


def _arkit(files: Files, colour: Sequence[Any], numbers: Sequence[Decimal]) -> _Sensors:
    """ARKitScenes: a .pincam for each image, and poses (world to camera, axis and angle) at 10 Hz, to interpolate."""
    folder = f"{colour[0].parent.name}_intrinsics"
    cameras = files.find(f"{folder}/*.pincam")
    if not cameras:
        raise InputError(f"{files.path}: {folder}/ has no .pincam file", "download it too")
    stamps = np.array([float(number_of(file)) for file in cameras])
    table = files.numbers("*.traj") if files.has("*.traj") else None
    for second in map(float, numbers):
        name = cameras[int(np.abs(stamps - second).argmin())].name
        width, height, *K = files.numbers(f"{folder}/{name}").ravel().tolist()
        pose = None if table is None else _between(table, second)
        yield Sensor(tuple(K), pose=pose, time=second, size=(int(width), int(height)))


def _between(table: np.ndarray, second: float) -> np.ndarray | None:
    """The pose at a time, from rows of a time, axis and angle, and translation that map the world to the camera."""
    k = int(np.searchsorted(table[:, 0], second).clip(1, max(len(table) - 1, 1)))
    rows = table[k - 1 : k + 1]
    if not rows[0, 0] - 0.05 <= second <= rows[-1, 0] + 0.05:
        return None
    share = float(np.clip((second - rows[0, 0]) / max(np.ptp(rows[:, 0]), 1e-9), 0, 1))
    R = Rotation.from_rotvec(rows[:, 1:4]).inv()
    centres = -R.apply(rows[:, 4:7])
    turned = R[0] * Rotation.from_rotvec(share * (R[0].inv() * R[-1]).as_rotvec())
    return _rigid(turned.as_matrix(), (1 - share) * centres[0] + share * centres[-1])


def _record3d(files: Files, colour: Sequence[Any], numbers: Sequence[Decimal]) -> _Sensors:
    """Record3D: a file of metadata. K is stored by columns; a pose is quaternion and position in axes of OpenGL."""
    stored = files.json("metadata", "metadata.json")
    with reading(Path(str(files.one("metadata", "metadata.json"))), "the metadata of Record3D"):
        shared = four_intrinsics(np.reshape(stored["K"], (3, 3)).T)
        each, poses, times = (stored.get(n) or [] for n in ("perFrameIntrinsicCoeffs", "poses", "frameTimestamps"))
        size = (int(stored["w"]), int(stored["h"])) if "w" in stored and "h" in stored else None
        for k in map(int, numbers):
            K = tuple(map(float, each[k][:4])) if k < len(each) else shared
            time = float(times[k]) if k < len(times) else k / float(stored.get("fps") or 30)
            pose = None
            if k < len(poses):
                pose = _rigid(Rotation.from_quat(poses[k][:4]).as_matrix(), poses[k][4:7]) @ _OPENGL
            yield Sensor(K, pose=pose, time=time, size=size)


def _record3d_depth(files: Files) -> Callable[[File, float], np.ndarray]:
    stored = files.json("metadata")
    shape = (int(stored["dh"]), int(stored["dw"])) if "dh" in stored and "dw" in stored else None
    aspect = float(stored["w"]) / float(stored["h"]) if "w" in stored and "h" in stored else 0.75
    return lambda file, scale: read_lzfse_depth(file, shape, aspect)


def _bop(files: Files, colour: Sequence[Any], numbers: Sequence[Decimal]) -> _Sensors:
    """BOP: an entry of scene_camera.json for each image; lengths are in millimetres."""
    stored = files.json("scene_camera.json")
    with reading(files.path / "scene_camera.json", "the cameras of a BOP scene"):
        for entry in (stored.get(str(int(number))) for number in numbers):
            if entry is None:
                yield None
                continue
            pose = None
            if "cam_R_w2c" in entry:
                pose = np.linalg.inv(_rigid(entry["cam_R_w2c"], np.asarray(entry["cam_t_w2c"], float) / 1000))
            yield Sensor(four_intrinsics(entry["cam_K"]), pose=pose, unit=float(entry.get("depth_scale", 1)) / 1000)


def _bop_labels(files: Files) -> Callable[[File], np.ndarray | None]:
    """Masks of the visible parts. Objects have their numbers in scene_gt.json, or those of masks if one is twice."""
    stored = files.json("scene_gt.json") if files.has("scene_gt.json") else {}
    objects = {key: [int(entry["obj_id"]) for entry in entries] for key, entries in stored.items()}
    alone = bool(objects) and all(len(set(ids)) == len(ids) for ids in objects.values())

    def read(colour: File) -> np.ndarray | None:
        labels: np.ndarray | None = None
        for file in files.find(f"mask_visib/{_stem(colour)}_*.png"):
            mask, k = read_labels(file), int(number_of(file))
            labels = np.zeros(mask.shape, np.uint16) if labels is None else labels
            labels[mask > 0] = objects[str(int(number_of(colour)))][k] if alone else k + 1
        return labels

    return read


def _scannet(files: Files, colour: Sequence[Any], numbers: Sequence[Decimal]) -> _Sensors:
    """ScanNet: one matrix of intrinsics for colour and one for depth, and a pose for each frame."""
    of_colour, of_depth = (
        [f"{name}_{part}.txt" for name in ("intrinsic/intrinsic", "intrinsics/intrinsic", "intrinsics", "intrinsic")]
        for part in ("color", "depth")
    )
    depth_K = four_intrinsics(files.numbers(*of_depth)[:3, :3])
    K = four_intrinsics(files.numbers(*of_colour)[:3, :3]) if files.find(*of_colour) else depth_K
    for file in colour:
        yield Sensor(K, depth_K, files.numbers(f"pose/{_stem(file)}.txt"))


def _seven_scenes(files: Files, colour: Sequence[Any], numbers: Sequence[Decimal]) -> _Sensors:
    """7-Scenes: a pose for each frame, and no intrinsics."""
    return (Sensor(pose=files.numbers(file.name.replace(".color.png", ".pose.txt"))) for file in colour)


def _one_matrix(files: Files, colour: Sequence[Any], numbers: Sequence[Decimal]) -> _Sensors:
    """BundleSDF and FoundationPose: cam_K.txt."""
    return iter([Sensor(four_intrinsics(files.numbers("cam_K.txt")))] * len(numbers))


def _masks(files: Files) -> Callable[[File], np.ndarray | None]:
    """The mask of the one object, often of the first frame only."""

    def read(colour: File) -> np.ndarray | None:
        found = files.find(f"masks/{_stem(colour)}.png")
        return (read_labels(found[0]) > 0).astype(np.uint16) if found else None

    return read


def _dexycb(files: Files, colour: Sequence[Any], numbers: Sequence[Decimal]) -> _Sensors:
    """DexYCB: the folder of one still camera, with its intrinsics in calibration/ beside the subjects."""
    folder = files.path.resolve()
    calibration = folder / "../../../calibration/intrinsics"
    stored = next(iter(sorted(calibration.glob(f"{folder.name}_*.yml"))), None)
    K: tuple[float, ...] = ()
    if stored is not None:
        with reading(stored, "intrinsics of DexYCB"):
            text = read_bytes(stored, "intrinsics of DexYCB", limit=MAX_TEXT).decode()
            (block,) = re.findall(r"^color:\s*\n((?:[ \t]+.*\n?)+)", text, re.MULTILINE)
            values = dict(re.findall(r"(\w+):\s*([-+.\deE]+)", block))
            K = tuple(float(values[name]) for name in ("fx", "fy", "ppx", "ppy"))
    return iter([Sensor(K)] * len(numbers))


def _dexycb_labels(files: Files) -> Callable[[File], np.ndarray | None]:
    """Objects 1 to 21, and 255 for the hand."""

    def read(colour: File) -> np.ndarray | None:
        file = files.path / f"labels_{int(number_of(colour)):06d}.npz"
        with reading(file, "labels of DexYCB"):
            return read_arrays(file, "labels of DexYCB")["seg"].astype(np.uint16) if file.is_file() else None

    return read


def _stem(file: File) -> str:
    return file.name.rpartition(".")[0]


_RGB = ("rgb/*.png", "rgb/*.jpg", "rgb/*.jpeg")
_REGISTERED = "the authors give no calibration: depth and colour are not registered, and edges differ by some pixels"

LAYOUTS = {
    "stray": Layout(
        "Stray Scanner",
        ("odometry.csv", "camera_matrix.csv", "depth/*"),
        ("rgb.mp4", *_RGB),
        ("depth/*.png", "depth/*.npy"),
        _stray,
    ),
    "record3d": Layout(
        "Record3D (.r3d)",
        ("metadata", "rgbd/*.depth"),
        ("rgbd/*.jpg", "rgbd/*.png"),
        ("rgbd/*.depth",),
        _record3d,
        read_depth=_record3d_depth,
        unit=0.00025,
    ),
    "record3d_exr": Layout(
        "Record3D (EXR and JPG)", ("metadata.json", "depth/*.exr"), _RGB, ("depth/*.exr",), _record3d, unit=0.00025
    ),
    "arkitscenes": Layout(
        "ARKitScenes",
        ("lowres_depth/*.png", "*_intrinsics/*.pincam"),
        ("vga_wide/*.png", "lowres_wide/*.png"),
        ("lowres_depth/*.png",),
        _arkit,
    ),
    "bop": Layout(
        "BOP",
        ("scene_camera.json", "depth/*"),
        (*_RGB, "rgb/*.tif", "gray/*.png", "gray/*.tif"),
        ("depth/*.png", "depth/*.tif"),
        _bop,
        labels=_bop_labels,
    ),
    "scannet": Layout(
        "ScanNet",
        ("pose/*.txt", "depth/*.png", "color/*"),
        ("color/*.jpg", "color/*.png"),
        ("depth/*.png",),
        _scannet,
    ),
    "seven_scenes": Layout(
        "7-Scenes",
        ("*.color.png", "*.depth.png", "*.pose.txt"),
        ("*.color.png",),
        ("*.depth.png",),
        _seven_scenes,
        intrinsics="K=585,585,320,240 is that of the authors",
        note=_REGISTERED,
    ),
    "cam_k": Layout(
        "BundleSDF, FoundationPose",
        ("cam_K.txt", "depth/*"),
        _RGB,
        ("depth/*.png", "depth/*.npy"),
        _one_matrix,
        labels=_masks,
    ),
    "dexycb": Layout(
        "DexYCB",
        ("color_*.jpg", "aligned_depth_to_color_*.png"),
        ("color_*.jpg",),
        ("aligned_depth_to_color_*.png",),
        _dexycb,
        labels=_dexycb_labels,
        hands=True,
        intrinsics="they are in calibration/intrinsics/ beside the folders of the subjects: fx, fy, ppx, ppy",
    ),
}

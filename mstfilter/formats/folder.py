"""The recording folder of mstfilter: reader and writer.

>>> with RecordingWriter("recordings/mine", camera, grid) as writer:
...     writer.add_frame(rgb, depth, time_s=0.0, role="static")
>>> recording = RecordingFolder().open(Path("recordings/mine"))
>>> save_recording(recording, "recordings/copy")

The page "File formats" of the documentation describes the files. If camera.json has no pose, the support plane at the
first pause defines the world axes. If the table of a given pose is not at z = 0, the world is shifted. If camera.json
has no workspace, a grid is placed around the visible table. A recording is written under a temporary name and renamed
when it is complete. If writing fails, no file remains.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, Field, model_validator

from mstfilter.base.errors import InputError, check_choice, check_number, naming
from mstfilter.base.files import atomic_folder, check_output, locked, reading, write_sums, writing
from mstfilter.base.reading import read_arrays, read_json, read_model
from mstfilter.formats.images import read_depth, read_optional, read_rgb, write_image
from mstfilter.formats.video import RecordingFormat, check_images, warn_of_unread
from mstfilter.scene import (
    Camera,
    Frame,
    LazyFrames,
    PauseRule,
    Recording,
    VoxelGrid,
    as_labels,
    examine,
    find_world,
    report_findings,
    rigid_from_matrix,
    truth_reader,
)

VERSION = 1  #: Version of the layout
_SCALE = "camera.json holds depth_scale in metres per unit, without a default: 0.001 for millimetres, 0.0002 for TUM"
_HINTS = (
    "a recording folder holds manifest.json, camera.json, rgb/, depth/",
    "other layouts: mstfilter.open_recording(path), or `mstfilter convert`",
)


class _Workspace(BaseModel, extra="forbid"):
    min: tuple[float, float, float]
    max: tuple[float, float, float]
    voxel: float

    @classmethod
    def of(cls, grid: VoxelGrid) -> _Workspace:
        return cls(min=tuple(grid.origin.tolist()), max=tuple(grid.upper.tolist()), voxel=grid.voxel_size)

    @property
    def grid(self) -> VoxelGrid:
        return VoxelGrid.from_bounds(np.array(self.min), np.array(self.max), self.voxel)


class RecordingWriter:
    """Writes a recording folder, frame by frame.

    The folder must be new or empty, and no other process may write into the folder. `camera` may lack a pose. `grid`
    is the workspace. `depth_scale` is in metres per unit of the 16-bit depth images. Further keyword arguments, such
    as generator and seed, are stored in manifest.json.
    """

    def __init__(
        self,
        path: str | Path,
        camera: Camera,
        grid: VoxelGrid | None = None,
        *,
        depth_scale: float = 0.001,
        **manifest: Any,
    ) -> None:
        self.path = Path(path)
        check_output(self.path, folder=True)
        self._camera, self._grid, self._scale = camera, grid, depth_scale
        self._manifest = _stored({"version": VERSION, **manifest}, "an entry of the manifest")
        self._frames: list[dict[str, Any]] = []
        self._poses: list[dict[str, Any]] = []
        self._voxels: list[np.ndarray] = []
        self._voxel_frames: list[int] = []
        with self._writing(), ExitStack() as stack:
            stack.enter_context(locked(self.path))
            self._folder = stack.enter_context(atomic_folder(self.path))
            self._open = stack.pop_all()

    def add_frame(
        self,
        rgb: np.ndarray,
        depth: np.ndarray,
        time_s: float,
        role: Literal["static", "action"],
        *,
        instance: np.ndarray | None = None,
        robot_mask: np.ndarray | None = None,
        poses: Mapping[Any, Any] | None = None,
        **entry: Any,
    ) -> int:
        """Add a frame and return its index.

        `rgb` is (H, W, 3) uint8. `depth` is (H, W) float in metres, with NaN for no reading. `time_s` is in seconds.
        The role is "static" at a pause and "action" at other frames. `instance` (H, W) uint8 or uint16 has the true
        object number of each pixel. `robot_mask` (H, W) bool marks the robot. `poses` maps object numbers to the true
        4x4 T_world_object. Further keyword arguments are stored in the entry of the frame in manifest.json.
        """
        index = len(self._frames)
        check_choice(f"role of frame {index}", role, ("static", "action"))
        entry = _stored(entry, f"an entry of frame {index}")
        before = self._frames[-1]["time_s"] if index else -np.inf
        check_number(f"time of frame {index}", time_s, "times are in seconds and ascend", above=before)
        units = np.rint(np.nan_to_num(np.ma.filled(depth, 0).astype(np.float64) / self._scale, nan=0.0, posinf=0.0))
        units[(units < 0) | (units > 65535)] = 0  # out of range: no reading
        if not units.any() and np.any(np.isfinite(depth) & (np.asarray(depth) > 0)):
            raise InputError(
                f"depth image of frame {index} has only readings beyond {65535 * self._scale:g} m",
                "depth is in metres: multiply raw readings by the depth scale",
            )
        images: dict[str, np.ndarray | None] = {
            "rgb": rgb,
            "depth": units.astype(np.uint16),
            "instance": instance,
            "robot": None if robot_mask is None else np.asarray(robot_mask, dtype=bool).astype(np.uint8) * 255,
        }
        for part, image in images.items():
            if image is None:
                continue
            size = (self._camera.height, self._camera.width, *((3,) if part == "rgb" else ()))
            kinds = (np.uint8, np.uint16) if part in ("instance", "depth") else (np.uint8,)
            if image.shape != size or image.dtype not in kinds:
                raise InputError(
                    f"{part} image of frame {index} has shape {image.shape} and type {image.dtype}, "
                    f"expected {size} and {' or '.join(np.dtype(kind).name for kind in kinds)}"
                )
            with self._writing():
                (self._folder / part).mkdir(exist_ok=True)
                write_image(self._folder / part / f"{index:06d}.png", image)
        self._frames.append({"index": index, "time_s": float(time_s), "role": role, **entry})
        if poses is not None:
            objects = {str(k): np.asarray(T, dtype=float).tolist() for k, T in poses.items()}
            self._poses.append({"frame": index, "T_world_object": objects})
        return index

    def add_voxels(self, labels: np.ndarray) -> None:
        """Add the true labels (X, Y, Z) at the last added frame."""
        if self._grid is None or labels.shape != self._grid.shape:
            raise InputError(
                f"true labels have shape {labels.shape}, the workspace is {self._grid and self._grid.shape}"
            )
        self._voxels.append(as_labels(labels).copy())
        self._voxel_frames.append(len(self._frames) - 1)

    def close(self) -> Path:
        """Write the remaining files and rename the folder to its final name."""
        camera, grid = self._camera, self._grid
        workspace = None if grid is None else _Workspace.of(grid)
        described = _CameraFile.of(camera, depth_scale=self._scale, workspace=workspace).model_dump()
        manifest = {**self._manifest, "frames": self._frames}
        with self._writing(), self._open:
            if not self._frames:
                raise InputError(f"recording {self.path} has no frame", "call add_frame before close")
            (self._folder / "camera.json").write_text(json.dumps(described, indent=1), encoding="utf-8")
            (self._folder / "manifest.json").write_text(json.dumps(manifest, indent=1), encoding="utf-8")
            if self._poses:
                (self._folder / "poses.json").write_text(json.dumps(self._poses), encoding="utf-8")
            if grid is not None and self._voxels:
                np.savez_compressed(
                    self._folder / "voxels.npz",
                    labels=np.stack(self._voxels),
                    frame=np.array(self._voxel_frames),
                    origin=grid.origin,
                    voxel_size=grid.voxel_size,
                )
            write_sums(self._folder)
        return self.path

    def _writing(self) -> AbstractContextManager[None]:
        return writing(f"recording {self.path}", "the unfinished files are removed")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: Any) -> None:
        if kind is None:
            self.close()
        else:
            self._open.__exit__(kind, *error)  # removes all files written so far


def _stored(entries: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Entries as JSON stores them. Raises InputError for values that JSON cannot store."""
    number = np.ndarray, np.generic
    try:
        plain = json.dumps(entries, default=lambda value: value.tolist() if isinstance(value, number) else str(value))
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} cannot be stored as JSON: {error}") from error
    return dict(json.loads(plain))


def save_recording(
    recording: Recording,
    path: str | Path,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
    **manifest: Any,
) -> Path:
    """Write a recording as a new recording folder. If the camera moves, the poses are stored in manifest.json.

    Depth is stored in units of the recording's `depth_scale`. `progress` is called with the number of frames written
    and the number of all frames. Further keyword arguments, such as the generator, are stored in manifest.json.
    """
    report_findings(examine(recording.frames, recording.pauses, recording.grid), f"recording {recording.name}")
    camera, total = recording.frames[recording.pauses[0]].camera, len(recording)
    manifest = {"name": recording.name, "depth_scale": recording.depth_scale, **manifest}
    with RecordingWriter(path, camera, recording.grid, **manifest) as writer:
        for index in range(total):
            frame = recording.frames[index]
            pause = index in recording.pauses
            where = f"frame {index} of {recording.name}"
            if not np.array_equal(frame.camera.K, camera.K):
                text = f"{where} has camera matrix {frame.camera.K.tolist()}, frame {recording.pauses[0]} has "
                text += f"{camera.K.tolist()}: a recording folder stores one"
                raise InputError(text, "convert frames of one camera only")
            if frame.views:
                text = f"{where} has images of {len(frame.all_views)} cameras: a recording folder stores one"
                raise InputError(text, "write one recording per camera, and join the frames by Frame(..., views=...)")
            pose = {"T_world_camera": frame.camera.pose.as_matrix().tolist()}
            moved = {} if frame.camera.key == camera.key else pose
            writer.add_frame(
                frame.rgb,
                frame.depth,
                recording.times[index],
                "static" if pause else "action",
                instance=recording.instance(index),
                robot_mask=frame.robot_mask,
                poses=recording.poses(index),
                **moved,
            )
            truth = recording.truth(recording.pauses.index(index)) if pause else None
            if truth is not None:
                writer.add_voxels(truth)
            progress(index + 1, total)
    return writer.path


class CameraFile(BaseModel):
    """The entries of a camera in the JSON files of recordings and runs."""

    K: Any  # checked by Camera, as the pose is by rigid_from_matrix
    width: int
    height: int
    T_world_camera: Any = None

    @classmethod
    def of(cls, camera: Camera, **more: Any) -> Self:
        """The entries of a camera. `more` has the additional entries of a subclass."""
        pose = None if camera.T_world_camera is None else camera.T_world_camera.as_matrix().tolist()
        size = {"width": camera.width, "height": camera.height}
        return cls(K=camera.K.tolist(), T_world_camera=pose, **size, **more)

    @property
    def camera(self) -> Camera:
        """The camera. Raises InputError if the matrix or the pose cannot be used."""
        matrix = self.T_world_camera
        pose = None if matrix is None else rigid_from_matrix(matrix, "T_world_camera")
        return Camera(self.K, self.width, self.height, pose)


class _CameraFile(CameraFile):
    depth_scale: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    workspace: _Workspace | None = None


class _FrameEntry(BaseModel):
    index: int
    time_s: float
    role: Literal["static", "action"]
    T_world_camera: Any = None


class _Manifest(BaseModel, extra="allow"):
    version: Literal[1]
    frames: Annotated[list[_FrameEntry], Field(min_length=1)]

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if [entry.index for entry in self.frames] != list(range(len(self.frames))):
            raise ValueError("frame indices are not 0, 1, 2, ...")
        return self


@dataclass(frozen=True)
class RecordingFolder(RecordingFormat):
    """Reader of the recording folder of mstfilter (manifest.json, camera.json, rgb/, depth/).

    Images and true poses are read on access. All other files are checked when the folder is opened. If `pauses` is a
    rule, the rule replaces the pauses in manifest.json. True volumes are known only at the pauses in manifest.json.
    """

    pauses: PauseRule | None = None

    @classmethod
    def detects(cls, path: Path) -> bool:
        return (path / "manifest.json").is_file()

    def open(self, path: Path) -> Recording:
        if not path.is_dir():
            raise InputError(f"recording folder does not exist: {path}")
        if not any(path.iterdir()):
            raise InputError(f"recording folder is empty: {path}", *_HINTS)
        manifest, manifest_data = read_model(path / "manifest.json", _Manifest, "a recording", *_HINTS)
        camera_file, stored = read_model(path / "camera.json", _CameraFile, "a recording", _SCALE, *_HINTS)
        warn_of_unread(path / "camera.json", stored, _CameraFile.model_fields)
        keys = {key for entry in manifest_data["frames"] for key in entry}
        notes = (key for key in keys if "cam" not in key.lower() and key.lower() != "pose")
        warn_of_unread(path / "manifest.json", keys, _FrameEntry.model_fields, notes)
        entries, scale = manifest.frames, camera_file.depth_scale

        with reading(path / "camera.json", "a recording"):
            camera = camera_file.camera
            grid = 0.01 if camera_file.workspace is None else camera_file.workspace.grid
        times = tuple(e.time_s for e in entries)
        marked = tuple(e.index for e in entries if e.role == "static")
        if self.pauses is not None:
            marked = self.pauses.find(times, lambda index: read_rgb(path / "rgb" / f"{index:06d}.png"))
        if not marked:
            raise InputError(
                f"{path / 'manifest.json'}: no frame has role static, so there is no pause to segment",
                "give the pauses: --pauses still, or --pauses 0,40,85 (frames)",
            )

        where = f"{path / 'manifest.json'}: T_world_camera of frame"
        posed = [e for e in entries if e.T_world_camera is not None]
        poses = {e.index: rigid_from_matrix(e.T_world_camera, f"{where} {e.index}") for e in posed}

        def read(index: int, view: Camera) -> Frame:
            name = f"{index:06d}.png"
            rgb, depth = read_rgb(path / "rgb" / name), read_depth(path / "depth" / name, scale)
            check_images(rgb, depth, view, scale, f"frame {index} of {path}")
            robot = read_optional(path / "robot" / name)
            return Frame(rgb, depth, view, None if robot is None else robot > 0)

        truth, true_poses = path / "voxels.npz", path / "poses.json"
        known = truth.exists() or true_poses.exists()  # the truth is in the world of the files
        if camera.T_world_camera is None or not isinstance(grid, VoxelGrid) or not known:
            given = camera.at(poses[marked[0]]) if marked[0] in poses else camera
            found, grid, shift = find_world(read(marked[0], given), grid)
            if shift is not None:
                poses = {index: shift * pose for index, pose in poses.items()}
            if camera.T_world_camera is None:
                camera = found
            elif shift is not None:
                camera = camera.at(shift * camera.pose)

        def read_posed(index: int) -> Frame:
            return read(index, camera.at(poses[index]) if index in poses else camera)

        true_volumes = _read_voxels(truth, grid, marked) if truth.exists() else lambda t: None
        with naming(str(path / "manifest.json")):
            return Recording(
                LazyFrames(read_posed, len(entries)),
                grid,
                marked,
                times,
                name=str(manifest_data.get("name") or path.name),
                depth_scale=scale,
                path=path,
                manifest=manifest_data,
                truth=true_volumes,
                instance=lambda index: read_optional(path / "instance" / f"{index:06d}.png"),
                poses=_read_poses(true_poses) if true_poses.exists() else lambda index: None,
            )


def _read_poses(path: Path) -> Any:
    """A function for `Recording.poses`, which reads the file at its first call."""

    @cache
    def load() -> dict[int, dict[int, np.ndarray]]:
        with reading(path, "true poses"):
            entries = {int(e["frame"]): dict(e["T_world_object"]) for e in read_json(path, "true poses")}
            return {i: {int(k): rigid_from_matrix(T).as_matrix() for k, T in e.items()} for i, e in entries.items()}

    return lambda index: load().get(index)


def _read_voxels(path: Path, grid: VoxelGrid, pauses: tuple[int, ...]) -> Any:
    data = read_arrays(path, "true volumes")
    with reading(path, "true volumes"):
        labels, frames = as_labels(data["labels"], "labels"), [int(frame) for frame in data["frame"]]
        origin, size = data["origin"].astype(float), float(data["voxel_size"])
        if (
            labels.shape[1:] != grid.shape
            or not np.allclose(origin, grid.origin)
            or abs(size - grid.voxel_size) > 1e-9
        ):
            raise InputError(
                f"{path}: grid {labels.shape[1:]} at {origin.tolist()} with voxels of {size} m differs from "
                f"the workspace {grid.shape} at {grid.origin.tolist()} with {grid.voxel_size} m"
            )
        if len(labels) != len(frames):
            raise InputError(f"{path}: there are {len(labels)} label grids for {len(frames)} frames")
    return truth_reader(labels, frames, pauses)

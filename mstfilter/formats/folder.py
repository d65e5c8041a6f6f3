"""Our own recording folder: reading, with one clear error for whatever is wrong.

>>> recording = open_recording("recordings/mine")

The layout stands in `mstfilter.scene.recording`; `mstfilter.formats.writer` writes it.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections import OrderedDict
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from mstfilter.errors import InputError
from mstfilter.formats.interfaces import Format
from mstfilter.formats.writer import VERSION, RecordingWriter, save
from mstfilter.scene import (
    Camera,
    Frame,
    LazyFrames,
    Recording,
    VoxelGrid,
    as_labels,
    check_range,
    find_world,
    read_depth,
    read_labels,
    read_rgb,
    rigid_from_matrix,
    truth_reader,
)

__all__ = ["RecordingFolder", "RecordingWriter", "open_recording", "save"]


class _Workspace(BaseModel):
    model_config = ConfigDict(extra="forbid")
    min: tuple[float, float, float]
    max: tuple[float, float, float]
    voxel: float


class _CameraFile(BaseModel):
    K: list[list[float]]
    width: int
    height: int
    depth_scale: float
    T_world_camera: list[list[float]] | None = None
    workspace: _Workspace | None = None


class _FrameEntry(BaseModel):
    index: int
    time_s: float
    role: Literal["static", "action"]
    T_world_camera: list[list[float]] | None = None


class _Manifest(BaseModel):
    model_config = ConfigDict(extra="allow")
    version: int
    frames: list[_FrameEntry]


def _load(path: Path, model: type[BaseModel]) -> Any:
    try:
        data = json.loads(path.read_text())
    except FileNotFoundError:
        raise InputError(
            f"not a recording: {path} is missing",
            "a recording folder holds manifest.json, camera.json, rgb/, depth/",
        ) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid JSON: {error}") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    try:
        return model.model_validate(data), data
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        hint = (
            "metres a unit: 0.001 for millimetres, 0.0002 for TUM images; there is no safe default"
            if "depth_scale" in where
            else "the layout is described in mstfilter.scene.recording"
        )
        found = first["input"]
        value = "nothing" if first["type"] == "missing" else repr(found)[:80]
        raise InputError(f"{path}: {where}: {first['msg'].lower()}, found {value}", hint) from error


@dataclass(frozen=True)
class RecordingFolder(Format):
    """Our own recording folder: manifest.json, camera.json, rgb/, depth/."""

    @classmethod
    def detects(cls, path: Path) -> bool:
        """See `Format`."""
        return (path / "manifest.json").is_file()

    def open(self, path: Path) -> Recording:
        """See `Format`."""
        return open_recording(path)


def open_recording(path: str | Path) -> Recording:
    """Read a recording folder.

    Everything but the images is checked now. Images are read when they are first used; `Recording.check` reads them
    all.
    """
    path = Path(path)
    if not path.is_dir():
        raise InputError(f"recording folder does not exist: {path}")
    if not any(path.iterdir()):
        raise InputError(
            f"recording folder is empty: {path}",
            "a recording folder holds manifest.json, camera.json, rgb/, depth/",
        )
    manifest, raw = _load(path / "manifest.json", _Manifest)
    described, _ = _load(path / "camera.json", _CameraFile)
    if manifest.version != VERSION:
        raise InputError(f"{path / 'manifest.json'}: version is {manifest.version}, this program reads {VERSION}")
    if not (math.isfinite(described.depth_scale) and described.depth_scale > 0):
        raise InputError(
            f"{path / 'camera.json'}: depth_scale is {described.depth_scale}, expected metres a unit > 0"
        )
    entries = manifest.frames
    if [e.index for e in entries] != list(range(len(entries))):
        raise InputError(f"{path / 'manifest.json'}: frame indices are not 0, 1, 2, ...")
    if not entries:
        raise InputError(f"{path / 'manifest.json'}: there are no frames")

    where = f"{path / 'camera.json'}: T_world_camera"
    pose = None if described.T_world_camera is None else rigid_from_matrix(described.T_world_camera, where)
    camera = Camera(described.K, described.width, described.height, pose)
    grid = None
    if described.workspace is not None:
        w = described.workspace
        grid = VoxelGrid.from_bounds(np.array(w.min), np.array(w.max), w.voxel)
    pauses = tuple(e.index for e in entries if e.role == "static")
    if not pauses:
        raise InputError(f"{path / 'manifest.json'}: no frame has role static, so there is no pause to segment")

    poses = {
        e.index: rigid_from_matrix(e.T_world_camera, f"{path / 'manifest.json'}: T_world_camera of frame {e.index}")
        for e in entries
        if e.T_world_camera is not None
    }

    def read(index: int, view: Camera) -> Frame:
        name = f"{index:06d}.png"
        rgb, depth = read_rgb(path / "rgb" / name), read_depth(path / "depth" / name, described.depth_scale)
        for what, image in (("rgb", rgb), ("depth", depth)):
            if image.shape[:2] != (view.height, view.width):
                raise InputError(
                    f"image {path / what / name} is {image.shape[1]} x {image.shape[0]}, "
                    f"camera.json says {view.width} x {view.height}"
                )
        readings = depth[np.isfinite(depth)]
        if readings.size == 0:
            raise InputError(f"depth image {path / 'depth' / name} has no reading at all: every pixel is 0")
        check_range(readings, f"depth image {path / 'depth' / name} with depth_scale {described.depth_scale:g}")
        robot_path = path / "robot" / name
        robot = read_labels(robot_path) > 0 if robot_path.exists() else None
        return Frame(rgb, depth, view, robot)

    if camera.T_world_camera is None or grid is None:
        camera, grid = find_world(
            read(pauses[0], camera.at(poses[pauses[0]]) if pauses[0] in poses else camera), grid
        )

    def read_posed(index: int) -> Frame:
        return read(index, camera.at(poses[index]) if index in poses else camera)

    def read_instance(index: int) -> np.ndarray | None:
        file = path / "instance" / f"{index:06d}.png"
        return read_labels(file) if file.exists() else None

    truth, true_poses = path / "voxels.npz", path / "poses.json"
    return Recording(
        LazyFrames(read_posed, range(len(entries)), OrderedDict()),
        grid,
        pauses,
        tuple(e.time_s for e in entries),
        name=str(raw.get("name") or path.name),
        depth_scale=described.depth_scale,
        path=path,
        manifest=raw,
        read_truth=_read_voxels(truth, grid, pauses) if truth.exists() else lambda t: None,
        read_instance=read_instance,
        read_poses=_read_poses(true_poses) if true_poses.exists() else lambda index: None,
    )


def _read_poses(path: Path) -> Any:
    """A `read_poses`; the file is looked at when it is first asked for."""

    @cache
    def load() -> dict[int, dict[int, np.ndarray]]:
        try:
            entries = {int(e["frame"]): dict(e["T_world_object"]) for e in json.loads(path.read_text())}
            return {i: {int(k): rigid_from_matrix(T).as_matrix() for k, T in e.items()} for i, e in entries.items()}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"true poses cannot be read: {path} ({error})") from error

    return lambda index: load().get(index)


def _read_voxels(path: Path, grid: VoxelGrid, pauses: tuple[int, ...]) -> Any:
    try:
        with np.load(path, allow_pickle=False) as data:
            labels, frames, origin, size = (
                data["labels"],
                data["frame"],
                data["origin"],
                float(data["voxel_size"]),
            )
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"true volumes cannot be read: {path} ({error})") from error
    if labels.shape[1:] != grid.shape or not np.allclose(origin, grid.origin) or abs(size - grid.voxel_size) > 1e-9:
        raise InputError(
            f"{path}: grid {labels.shape[1:]} at {origin.tolist()} with voxels of {size} m differs from "
            f"the workspace {grid.shape} at {grid.origin.tolist()} with {grid.voxel_size} m"
        )
    if len(labels) != len(frames):
        raise InputError(f"{path}: there are {len(labels)} label grids for {len(frames)} frames")
    return truth_reader(as_labels(labels, f"{path}: labels"), frames, pauses)

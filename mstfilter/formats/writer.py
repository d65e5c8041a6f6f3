"""Writing our own recording folder, frame by frame, or a whole recording at once.

>>> with RecordingWriter("recordings/mine", camera, grid) as writer:
...     writer.add_frame(rgb, depth, time_s=0.0, role="static")

The layout stands in `mstfilter.scene.recording`. Nothing is left behind when writing fails: a recording is
written under a temporary name and renamed when it is complete.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Camera, Recording, VoxelGrid, as_labels, warn_if_missed, write_image

__all__ = ["VERSION", "RecordingWriter", "check_writable", "save"]

VERSION = 1
"""Version of the layout."""


def check_writable(path: Path) -> None:
    """Whether a new recording may be called so: nothing is there, or an empty folder."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(
            f"cannot write a recording to {path}: it exists and is not an empty folder",
            "choose another name, or remove it",
        )


class RecordingWriter:
    """Writes a recording folder, frame by frame.

    Parameters
    ----------
    path : path
        The folder to make. It must not exist, or be empty.
    camera : Camera
        Intrinsics, and the pose if it is known.
    grid : VoxelGrid, optional
        Workspace.
    depth_scale : float
        Metres a unit of the 16-bit depth images.
    **manifest
        What else manifest.json should say: generator, seed, ...
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
        check_writable(self.path)
        self._camera, self._grid, self._scale = camera, grid, depth_scale
        self._manifest = {"version": VERSION, **manifest}
        self._frames: list[dict[str, Any]] = []
        self._poses: list[dict[str, Any]] = []
        self._voxels: list[np.ndarray] = []
        self._voxel_frames: list[int] = []
        self._folder = self.path.with_name(f".{self.path.name}.partial")
        try:
            if self._folder.exists():
                shutil.rmtree(self._folder)
            self._folder.mkdir(parents=True)
        except OSError as error:
            raise InputError(f"cannot write recording {self.path}: {error.strerror}") from error

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
        """Add a frame; its index.

        Parameters
        ----------
        rgb : (H, W, 3) uint8
            Colour.
        depth : (H, W) float
            Metres, NaN = no reading.
        time_s : float
            Seconds.
        role : {"static", "action"}
            At a pause, or between.
        instance : (H, W) uint8 or uint16, optional
            True object of each pixel.
        robot_mask : (H, W) bool, optional
            Pixels of the robot.
        poses : dict, optional
            True 4x4 T_world_object by object number.
        **entry
            What else the manifest should say of the frame.
        """
        index = len(self._frames)
        units = np.rint(np.nan_to_num(np.asarray(depth, dtype=np.float64) / self._scale, nan=0.0, posinf=0.0))
        units[(units < 0) | (units > 65535)] = 0  # out of the file's range: no reading, not its largest number
        images: dict[str, np.ndarray | None] = {
            "rgb": rgb,
            "depth": units.astype(np.uint16),
            "instance": instance,
            "robot": None if robot_mask is None else robot_mask.astype(np.uint8) * 255,
        }
        for part, image in images.items():
            if image is None:
                continue
            if image.shape[:2] != (self._camera.height, self._camera.width):
                raise InputError(
                    f"{part} image of frame {index} has shape {image.shape}, "
                    f"the camera is {self._camera.width} x {self._camera.height}"
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
        """True labels (X, Y, Z) at the frame added last."""
        if self._grid is None or labels.shape != self._grid.shape:
            raise InputError(
                f"true labels have shape {labels.shape}, the workspace is {self._grid and self._grid.shape}"
            )
        self._voxels.append(as_labels(labels))
        self._voxel_frames.append(len(self._frames) - 1)

    def close(self) -> Path:
        """Write what is left and give the folder its name."""
        camera = self._camera
        described: dict[str, Any] = {
            "K": camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
            "depth_scale": self._scale,
            "T_world_camera": None if camera.T_world_camera is None else camera.T_world_camera.as_matrix().tolist(),
            "workspace": None,
        }
        if self._grid is not None:
            described["workspace"] = {
                "min": self._grid.origin.tolist(),
                "max": self._grid.upper.tolist(),
                "voxel": self._grid.voxel_size,
            }
        with self._writing():
            self._finish(described)
        return self.path

    def _finish(self, described: dict[str, Any]) -> None:
        (self._folder / "camera.json").write_text(json.dumps(described, indent=1))
        (self._folder / "manifest.json").write_text(json.dumps({**self._manifest, "frames": self._frames}, indent=1))
        if self._poses:
            (self._folder / "poses.json").write_text(json.dumps(self._poses))
        if self._voxels:
            assert self._grid is not None
            np.savez_compressed(
                self._folder / "voxels.npz",
                labels=np.stack(self._voxels),
                frame=np.array(self._voxel_frames),
                origin=self._grid.origin,
                voxel_size=self._grid.voxel_size,
            )
        if self.path.exists():
            self.path.rmdir()
        self._folder.rename(self.path)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """A disk that is full or not writable is the user's to mend."""
        try:
            yield
        except OSError as error:
            raise InputError(
                f"cannot write recording {self.path}: {error.strerror}", "nothing of it is left behind"
            ) from error

    def discard(self) -> None:
        """Leave nothing behind."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.discard()
            return
        try:
            self.close()
        except BaseException:
            self.discard()
            raise


def save(
    recording: Recording,
    path: str | Path,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
    **manifest: Any,
) -> Path:
    """Write any recording as a folder of our own; a camera that moves keeps its pose in every frame.

    Parameters
    ----------
    recording : Recording
        What to write. Its depth is stored in units of its `depth_scale`.
    path : path
        The folder to make. It must not exist, or be empty.
    progress : callable
        Called with (frames done, frames in all).
    **manifest
        What else manifest.json should say: generator, ...
    """
    home, total = recording.frames[recording.pauses[0]].camera, len(recording)
    manifest = {"name": recording.name, "depth_scale": recording.depth_scale, **manifest}
    with RecordingWriter(path, home, recording.grid, **manifest) as writer:
        for index in range(total):
            frame = recording.frames[index]
            pause = index in recording.pauses
            if not np.array_equal(frame.camera.K, home.K):
                raise InputError(
                    f"frame {index} of {recording.name} has camera matrix {frame.camera.K.tolist()}, frame "
                    f"{recording.pauses[0]} has {home.K.tolist()}: a recording folder holds one",
                    "convert frames of one camera only",
                )
            if frame.views:
                raise InputError(
                    f"frame {index} of {recording.name} has images of {len(frame.all_views)} cameras: a recording "
                    "folder holds those of one",
                    "write one recording a camera, and join their frames by Frame(..., views=...)",
                )
            moved = {} if frame.camera.key == home.key else {"T_world_camera": frame.camera.pose.as_matrix().tolist()}
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
    warn_if_missed((recording.frames[p] for p in recording.pauses), recording.grid, f"recording {recording.name}")
    return writer.path

"""Recordings: RGB-D videos with pauses (times at which nothing moves), from arrays or from files.

>>> recording = Recording.from_arrays(rgb, depth, K)         # depth in metres
>>> recording = mstfilter.open_recording("recordings/table-7")
>>> for clip in recording.clips():
...     clip.before, clip.after                              # Frames, read when they are used

In the world of a recording, z points up and the table is at z = 0. If the pose of the camera is not given, it is
found from the support plane at the first pause.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, overload

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError, warn_user
from mstfilter.base.lazy import late
from mstfilter.scene.arrays import content_key
from mstfilter.scene.camera import Camera
from mstfilter.scene.frame import Clip, Frame
from mstfilter.scene.from_arrays import cameras_of, images_of, masks_of, seconds_of
from mstfilter.scene.geometry import workspace
from mstfilter.scene.pauses import PauseRule, indices_of, pauses_with_depth, rule_for
from mstfilter.scene.planes import fit_support_plane, table_height
from mstfilter.scene.plausibility import examine, report_findings, unreadable
from mstfilter.scene.voxels import VoxelGrid, as_labels


class LazyFrames(Sequence[Frame]):
    """Frames that ``read(index)`` reads on access. The 40 frames used last are kept in memory."""

    def __init__(self, read: Callable[[int], Frame], n: int) -> None:
        self._read = lru_cache(maxsize=40)(read)
        self._indices = range(n)

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, position: int) -> Frame: ...
    @overload
    def __getitem__(self, position: slice) -> LazyFrames: ...
    def __getitem__(self, position: Any) -> Any:
        if isinstance(position, slice):
            part = copy(self)
            part._indices = self._indices[position]
            return part
        return self._read(self._indices[position])


@dataclass(frozen=True, eq=False)
class Recording:
    """An RGB-D video, the pauses at which nothing moves in it, and the workspace.

    `Recording.from_arrays` makes one of your own images, and `mstfilter.open_recording` reads files. `clips` divides
    it into what a filter observes step by step. A simulated recording also knows the truth.

    Parameters
    ----------
    frames : sequence of Frame
        The frames in time order. They are in memory, or read on access (`LazyFrames`).
    grid : VoxelGrid
        The workspace.
    pauses : tuple of int
        Indices of the frames at the pauses, ascending.
    times : tuple of float
        Time of each frame in seconds.
    name : str
        Name for messages and reports.
    path : Path, optional
        The folder or file from which the recording was read.
    depth_scale : float
        Metres per unit of the depth images, if the recording is saved.
    manifest : dict
        Content of manifest.json, for recordings read from a folder.
    truth : callable
        ``truth(t)`` returns the true labels (X, Y, Z) uint16 at pause `t`, on `grid`, or None if unknown.
    instance : callable
        ``instance(index)`` returns the true label image (H, W) of a frame, or None if unknown.
    poses : callable
        ``poses(index)`` returns the true T_world_object (4, 4) in a frame for each label, or None if unknown.
    """

    frames: Sequence[Frame]
    grid: VoxelGrid
    pauses: tuple[int, ...]
    times: tuple[float, ...]
    name: str = "arrays"
    path: Path | None = None
    depth_scale: float = 0.001
    manifest: dict[str, Any] = field(default_factory=dict)
    truth: Callable[[int], np.ndarray | None] = lambda t: None
    instance: Callable[[int], np.ndarray | None] = lambda index: None
    poses: Callable[[int], dict[int, np.ndarray] | None] = lambda index: None

    def __post_init__(self) -> None:
        n, pauses = len(self.frames), tuple(int(p) for p in self.pauses)
        object.__setattr__(self, "times", seconds_of(self.times, n, self.name))
        if n == 0 or not pauses:
            raise InputError(f"recording {self.name} has {n} frames and {len(pauses)} pauses, expected at least 1")
        if list(pauses) != sorted(set(pauses)) or pauses[0] < 0 or pauses[-1] >= n:
            raise InputError(f"pauses of recording {self.name} are {pauses}, expected ascending indices below {n}")
        if not np.isfinite(self.times).all():
            raise InputError(f"times of recording {self.name} are not {n} ascending numbers")
        for k, (a, b) in enumerate(pairwise(self.times)):
            if b <= a:
                raise InputError(f"times of recording {self.name} do not ascend: frames {k}, {k + 1} at {a}, {b} s")
        object.__setattr__(self, "pauses", pauses)

    def __repr__(self) -> str:
        pauses = ", ".join(map(str, self.pauses[:10])) + ", ..." * (len(self.pauses) > 10)
        n, seconds = len(self), self.times[-1] - self.times[0]
        frames = "1 frame" if n == 1 else f"{n} frames over {seconds:.1f} s"
        where = "" if self.path is None else f"\n  {str(self.path)[-100:]}"
        return f"Recording {self.name[:60]!r}: {frames}, pauses at {pauses}\n  {self.grid.text}{where}"

    plot = late("mstfilter.app.report.display:plot_recording", "Images at the pauses, and the time line.")
    _repr_html_ = late("mstfilter.app.report.display:to_html", "What a notebook shows.")

    @classmethod
    def from_arrays(
        cls,
        rgb: np.ndarray,
        depth: np.ndarray,
        K: np.ndarray,
        *,
        pauses: Sequence[int] | str | PauseRule | None = None,
        T_world_camera: np.ndarray | RigidTransform | Sequence[RigidTransform] | None = None,
        grid: VoxelGrid | float | None = 0.01,
        robot_masks: np.ndarray | None = None,
        times: Sequence[float] | None = None,
        name: str = "arrays",
    ) -> Recording:
        """A recording from images in memory: a video, or a single image.

        Parameters
        ----------
        rgb : (H, W, 3) or (T, H, W, 3) uint8
            One image or a video. A fourth channel (alpha) is dropped.
        depth : (H, W) or (T, H, W) float
            Depth in metres; NaN or 0 means no reading.
        K : (3, 3) array, or four numbers
            Intrinsics in pixels: the camera matrix, or fx, fy, cx, cy.
        pauses : sequence of int, str or PauseRule, optional
            Frames at which nothing moves; the filter gives hypotheses at each of them. Instead of listing them, name
            a rule that finds them: a `PauseRule`, or a text such as "still", "ends", "every" or "0s,4.2s". The
            default is "still" if `times` are given for more than two frames, else "ends".
        T_world_camera : (4, 4) or (T, 4, 4) array, RigidTransform or T of them, optional
            Pose of the camera, or one pose per frame if the camera moves. z of the world must point up; a world whose
            table is not at z = 0 is shifted. By default, the pose is found from the support plane at the first
            pause.
        grid : VoxelGrid or float
            Workspace, or the voxel size in metres of one that covers the table (sides of 1 to 2 m, height 0.5 m).
        robot_masks : (T, H, W) bool, or T of (H, W) bool or None, optional
            Pixels that show the robot.
        times : sequence of float, optional
            Times in seconds. The default times are 0, 1, 2, ...
        name : str
            Name for messages and reports.

        Raises
        ------
        InputError
            If the arrays are invalid, or `examine` finds that no hypothesis can be correct.
        """
        rgb, depth = images_of(rgb, depth, name)
        n, height, width = depth.shape
        masks = masks_of(robot_masks, depth, name)
        cameras = cameras_of(Camera(K, width, height), T_world_camera, n)
        stamps = seconds_of(times, n, name)
        rule = rule_for(pauses, n, times is not None, name)
        chosen = rule.find(stamps, lambda k: rgb[k]) if isinstance(rule, PauseRule) else indices_of(rule, n, name)
        readings = lambda k: bool(np.any(np.isfinite(depth[k]) & (depth[k] > 0)))  # noqa: E731
        chosen = pauses_with_depth(chosen, stamps, readings, name)
        frames = [Frame(*images) for images in zip(rgb, depth, cameras, masks, strict=True)]
        posed, grid, shift = find_world(frames[chosen[0]], grid)
        if T_world_camera is None:
            frames = [replace(frame, camera=posed) for frame in frames]
        elif shift is not None:
            frames = [replace(frame, camera=frame.camera.at(shift * frame.camera.pose)) for frame in frames]
        made = cls(frames, grid, chosen, stamps, name)
        made._examined  # noqa: B018
        return made

    @cached_property
    def key(self) -> bytes:
        """Content key of all frames, the grid, the pauses and the times. The first access reads every image."""
        return content_key(self.grid.key, self.pauses, self.times, *(frame.key for frame in self.frames))

    @cached_property
    def truth_key(self) -> bytes:
        """Content key of the ground truth: volumes, label images, poses. The first access reads every frame."""
        keys = [content_key(self.truth(t)) for t in range(len(self.pauses))]
        for index in range(len(self)):
            poses = sorted((self.poses(index) or {}).items())
            keys.append(content_key(self.instance(index), *(part for pair in poses for part in pair)))
        return content_key(*keys)

    def __len__(self) -> int:
        return len(self.frames)

    def clips(self) -> tuple[Clip, ...]:
        """One clip per pause: what a filter observes, step by step.

        The first clip has the one frame at the first pause, each other clip the frames from one pause to the next.
        The first call examines the input (`mstfilter.scene.examine`). It warns if something is not plausible, and
        raises InputError if no hypothesis can be correct.
        """
        self._examined  # noqa: B018
        clips = []
        for t, end in enumerate(self.pauses):
            span = slice(self.pauses[max(t - 1, 0)], end + 1)
            clips.append(Clip(self.frames[span], self.grid, t, tuple(self.times[span])))
        return tuple(clips)

    def in_world_of(self, other: Recording) -> Recording:
        """A copy with the workspace and the first camera pose of another recording, without true volumes and poses.

        The clips of the one recording can then update hypotheses of the other, as in
        ``open_recording(path, options=["start_s=30"]).in_world_of(first)``. This is right only if the camera really
        had the same pose at the first pause of each.
        """
        own = self.frames[self.pauses[0]].camera.pose
        moved = other.frames[other.pauses[0]].camera.pose * own.inv()

        def read(index: int) -> Frame:
            frame = self.frames[index]
            return replace(frame, camera=frame.camera.at(moved * frame.camera.pose))

        frames = LazyFrames(read, len(self))
        return replace(self, frames=frames, grid=other.grid, truth=lambda t: None, poses=lambda index: None)

    def check(self) -> None:
        """Read every image and examine the recording, so that faults raise InputError before a run."""
        _ = self.key
        self.__dict__.pop("_examined", None)
        self._examined  # noqa: B018

    @cached_property
    def _examined(self) -> None:
        """Check the frames at the pauses (`examine`), and warn or raise InputError. The checks run once."""
        report_findings(examine(self.frames, self.pauses, self.grid), f"recording {self.name}")


class UsesFiles(ABC):
    """Additional base class of components that read files of the user."""

    #: Fields with paths of files or folders, whose hashes a run records.
    path_fields: ClassVar[tuple[str, ...]] = ("folder", "weights", "checkpoint")
    #: Whether the files belong to one recording, such as masks of its images. Studies refuse them for several.
    of_one_recording: ClassVar[bool] = False

    @abstractmethod
    def check_files(self, recording: Recording) -> None:
        """Raise InputError before a run if a file is missing or cannot be used for a recording."""


def find_world(first: Frame, grid: VoxelGrid | float | None) -> tuple[Camera, VoxelGrid, RigidTransform | None]:
    """The camera with a pose, and the workspace. What is missing is computed from the `first` frame.

    The table of the returned world is at z = 0. If it is not in the world of the given pose, as in the world of a
    robot's base, the world is shifted along z. The third value is the motion from the given world to the returned
    one, or None if they are the same.
    """
    report_findings((finding for finding in unreadable(first, "the first pause") if finding.stop), "recording")
    camera, shift = first.camera, None
    if camera.T_world_camera is None:
        camera = camera.at(fit_support_plane(first).T_world_camera)
    elif height := table_height(first):
        down = np.array([0.0, 0.0, -height])
        camera = camera.at(RigidTransform.from_translation(down) * camera.pose)
        shift = camera.pose * first.camera.pose.inv()
        if isinstance(grid, VoxelGrid) and abs(grid.origin[2]) > abs(grid.origin[2] - height):  # not yet on the table
            grid = VoxelGrid(grid.origin + down, grid.voxel_size, grid.shape)
        warn_user(
            f"the table is at z = {height:.3f} m in the world of the given pose: the world is shifted, so it is at 0",
            f"results are in the shifted world: add {height:.3f} m to z for the world of the given pose",
            "if the table is at z = 0 in the world of the pose: check the pose, and the depth scale",
        )
    if not isinstance(grid, VoxelGrid):
        grid = workspace(Frame(first.rgb, first.depth, camera, first.robot_mask), 0.01 if grid is None else grid)
    return camera, grid, shift


def truth_reader(
    labels: np.ndarray, frames: Sequence[int], pauses: tuple[int, ...]
) -> Callable[[int], np.ndarray | None]:
    """Make the function `Recording.truth` from true labels (S, X, Y, Z) at the frame indices `frames` (S,)."""
    row = {int(frame): s for s, frame in enumerate(frames)}

    def read(t: int) -> np.ndarray | None:
        s = row.get(pauses[t])
        return None if s is None else as_labels(labels[s], "true labels")

    return read

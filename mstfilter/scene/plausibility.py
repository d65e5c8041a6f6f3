"""Warnings about input that can be used but is probably not what was meant.

>>> warn_if_implausible(frames, grid, "recording table-7")

Wrong units, a camera matrix of another image size, or a pose of another camera give hypotheses without objects, or
with objects of wrong shapes, and no error. The warnings say what to check.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable
from itertools import chain
from types import FrameType

import numpy as np

from mstfilter.errors import InputError, InputWarning
from mstfilter.scene.frame import Frame
from mstfilter.scene.geometry import fit_support_plane
from mstfilter.scene.voxels import VoxelGrid

_MIN_HEIGHT = 0.01  # metres above the table beyond which a reading may show an object
_DISTANCES = (0.2, 4.0)  # metres: median depth of the readings
_FIELDS = (12.0, 130.0)  # degrees: horizontal field of view
_VOXELS = (0.001, 0.05)  # metres
_MAX_TILT, _MAX_HEIGHT = 4.0, 0.025  # degrees and metres between the plane of the readings and z = 0
_OTHER_PLANE = 30.0  # degrees: a plane that is tilted by more is a wall or the side of a box, not the table
_MIN_ON_TABLE = 0.1  # share of the readings within `_MAX_HEIGHT` of z = 0, as `fit_support_plane` demands


def warn_if_implausible(frames: Iterable[Frame], grid: VoxelGrid, where: str) -> None:
    """Warn if the first frame does not fit its camera, or if no frame has readings above the table in the grid.

    The frames are those at the pauses, with poses; they are read as needed. `where` names the recording.
    """
    frames = iter(frames)
    first = next(frames, None)
    if first is None or not first.valid.any():
        return
    for message, *hints in (*_scale(first, grid), *_intrinsics(first), *_plane(first)):
        _warn(f"{where}: {message}", *hints)
    _warn_if_empty(chain((first,), frames), grid, where)


def _scale(frame: Frame, grid: VoxelGrid) -> list[tuple[str, ...]]:
    """Depth and voxels that are not those of objects on a table."""
    found: list[tuple[str, ...]] = []
    median = float(np.median(frame.depth[frame.valid]))
    if not _DISTANCES[0] <= median <= _DISTANCES[1]:
        found.append(
            (
                f"the median depth is {median:.3g} m, expected {_DISTANCES[0]:g} to {_DISTANCES[1]:g} m",
                "check the depth scale: millimetres need 0.001, TUM images 0.0002; arrays are in metres",
            )
        )
    if not _VOXELS[0] <= grid.voxel_size <= _VOXELS[1]:
        found.append(
            (
                f"the voxels have edges of {grid.voxel_size:g} m, expected {_VOXELS[0]} to {_VOXELS[1]} m",
                "check the workspace: its bounds and its voxel size are in metres",
            )
        )
    points = frame.points[frame.valid]
    index = grid.index_of(points)
    beside = ((index[:, :2] >= 0) & (index[:, :2] < np.array(grid.shape[:2]))).all(axis=1)
    raised = beside & (points[:, 2] > _MIN_HEIGHT)
    if raised.sum() >= 200 and (index[raised, 2] >= grid.shape[2]).mean() > 0.5:
        found.append(
            (
                f"most readings above the table are above the workspace, which ends at z = {grid.upper[2]:.2f} m",
                "check the depth scale: objects on a table are not metres high; or give a higher workspace",
                "is the plane of the table found on the floor or on a wall? then give the pose T_world_camera",
            )
        )
    return found


def _intrinsics(frame: Frame) -> list[tuple[str, ...]]:
    """Focal lengths that no usual camera has."""
    camera = frame.camera
    fx, fy = float(camera.K[0, 0]), float(camera.K[1, 1])
    angle = float(np.degrees(2 * np.arctan(camera.width / (2 * fx))))
    hint = "check K: it is in pixels of these images; scale it if they were resized"
    if not _FIELDS[0] <= angle <= _FIELDS[1]:
        text = f"a focal length of {fx:.4g} pixels gives images of {camera.width} pixels"
        return [(f"{text} a field of view of {angle:.3g} degrees", hint)]
    if not 0.8 <= fx / fy <= 1.25:
        return [(f"the focal lengths are {fx:.4g} and {fy:.4g} pixels, expected nearly equal ones", hint)]
    return []


def _plane(frame: Frame) -> list[tuple[str, ...]]:
    """A pose and intrinsics that contradict the plane of the readings."""
    try:
        plane = fit_support_plane(frame)
    except InputError:
        return []
    fitted, given = plane.T_world_camera.inv(), frame.camera.pose
    normal = given.rotation.apply(fitted.rotation.apply([0.0, 0.0, 1.0]))
    height = float((given * fitted).apply(np.zeros(3))[2])
    tilt = float(np.degrees(np.arccos(np.clip(normal[2], -1, 1))))
    hints = (
        "check the pose: z of the world is up, the table is at z = 0; without a pose it is found from the table",
        "T_world_camera maps points of the camera to the world; is this the inverse?",
        f"check K: its focal length is {frame.camera.K[0, 0]:.4g} pixels for images of {frame.camera.width} pixels",
        "check the depth scale",
    )
    if tilt < _OTHER_PLANE:
        if tilt > _MAX_TILT or abs(height) > _MAX_HEIGHT:
            text = f"the table in the depth image is tilted by {tilt:.1f} degrees and at z = {height:.3f} m"
            return [(f"{text}, expected z = 0", *hints)]
        return []
    z = frame.points[frame.valid][:, 2]
    if (np.abs(z) < _MAX_HEIGHT).mean() < _MIN_ON_TABLE:
        return [(f"no table is at z = 0: the largest plane is tilted by {tilt:.0f} degrees", *hints)]
    return []


_MIN_READINGS = 30  # fewer are taken for noise


def _warn_if_empty(frames: Iterable[Frame], grid: VoxelGrid, where: str) -> None:
    """Warn if no frame has readings inside the grid and above the table.

    Objects are searched inside the voxel grid only. A grid in other units, at another place, or below a pose that is
    upside down gives hypotheses without objects and no error. The frames are those at the pauses; they are read until
    one has such readings. `where` names the recording in the message.
    """
    spans = []
    for frame in frames:
        points = frame.points[frame.valid]
        inside = points[grid.contains(grid.index_of(points))]
        if (inside[:, 2] > _MIN_HEIGHT).sum() >= _MIN_READINGS:
            return
        if len(points):
            spans.append(np.percentile(points, (2, 98), axis=0))
    if not spans:
        return
    low, high = np.min(spans, axis=0)[0], np.max(spans, axis=0)[1]
    seen = ", ".join(f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", low, high, strict=True))
    spanned = ", ".join(
        f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", grid.origin, grid.upper, strict=True)
    )
    _warn(
        f"the workspace of {where} has no reading above the table, so no object can be found: "
        f"it spans {spanned} m, depth readings span {seen} m",
        "give a workspace around the objects, or none: it is then placed around the objects on the table",
        "check the pose: z of the world is up, the table is at z = 0",
        "check the depth scale, and that the images show objects on a table and not only a wall",
    )


def _warn(message: str, *hints: str) -> None:
    """Warn at the line that called this package."""
    level = 1
    frame: FrameType | None = sys._getframe()
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] in ("mstfilter", "functools"):
        level, frame = level + 1, frame.f_back
    warnings.warn(InputWarning(message, *hints), stacklevel=level)

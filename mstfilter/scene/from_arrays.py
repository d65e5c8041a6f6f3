"""What a user gives to `Recording.from_arrays`, checked: one function for images, masks, times and cameras each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError
from mstfilter.scene.camera import Camera, rigid_from_matrix
from mstfilter.scene.frame import check_depth, without_alpha


def images_of(rgb: Any, depth: Any, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Colour images (T, H, W, 3) and depth images (T, H, W) in metres, from those or from one image of each."""
    if depth is None:
        raise InputError(
            "depth is None: hypotheses in 3-D need a depth image for every colour image",
            "record with an RGB-D camera, or estimate depth in metres with a program of your choice",
        )
    depth = [np.ma.filled(d, 0) for d in depth] if isinstance(depth, list | tuple) else np.ma.filled(depth, 0)
    rgb, depth = _stacked(rgb, f"colour images of {name}"), _stacked(depth, f"depth images of {name}")
    rgb = without_alpha(rgb)
    if rgb.ndim == 3 and depth.ndim == 2:
        rgb, depth = rgb[None], depth[None]
    if rgb.ndim != 4 or rgb.shape[-1] != 3 or depth.shape != rgb.shape[:3]:
        raise InputError(
            f"rgb has shape {rgb.shape} and depth {depth.shape}, expected (T, H, W, 3) and (T, H, W)",
            "one image is (H, W, 3) and (H, W); depth must be registered to the colour image",
        )
    if np.issubdtype(depth.dtype, np.integer):
        raise InputError(
            f"depth has type {depth.dtype}, expected metres as float",
            "multiply raw readings by the depth scale: depth * 0.001 for millimetres",
        )
    if not len(depth):
        raise InputError(f"{name} has no frame")
    for index, image in enumerate(depth):
        check_depth(image, f"depth image of frame {index} of {name}")
    return rgb, depth


def masks_of(robot_masks: Any, depth: np.ndarray, name: str) -> list[np.ndarray | None]:
    """The robot mask (H, W) bool of each of the depth images (T, H, W), or None."""
    if robot_masks is None:
        return [None] * len(depth)
    masks = [robot_masks] if len(depth) == 1 and np.shape(robot_masks) == depth.shape[1:] else robot_masks
    if len(masks) != len(depth):
        shape = getattr(robot_masks, "shape", (len(masks),))
        raise InputError(f"robot_masks has shape {shape}, expected {depth.shape} of {name}")
    return [None if mask is None else np.asarray(mask, dtype=bool) for mask in masks]


def seconds_of(times: Sequence[Any] | None, n: int, name: str) -> tuple[float, ...]:
    """Times of `n` frames as numbers: 0, 1, 2, ... if none are given, seconds since the first of NumPy's dates."""
    stamps = np.asarray(range(n) if times is None else times)
    if stamps.size and stamps.dtype.kind in "mM":
        stamps = (stamps - stamps[0]) / np.timedelta64(1, "s")
    if len(stamps) != n:
        raise InputError(f"there are {len(stamps)} times for {n} frames of {name}")
    try:
        return tuple(float(t) for t in stamps)
    except (TypeError, ValueError) as error:
        hint = "for datetime objects: [(t - times[0]).total_seconds() for t in times]"
        raise InputError(f"times of {name} begin with {stamps.flat[0]!r}, expected seconds", hint) from error


def cameras_of(camera: Camera, poses: Any, n: int) -> list[Camera]:
    """The camera of each of `n` frames, from one pose, no pose, or one pose for each frame."""
    if poses is None:
        return [camera] * n
    listed = list(poses) if _stacked(poses, "the parts of T_world_camera").ndim in (1, 3) else [poses]
    if len(listed) not in (1, n):
        raise InputError(
            f"T_world_camera has {len(listed)} poses for {n} frames",
            "give one pose (4, 4), or one for each frame (T, 4, 4)",
        )
    rigid = [
        pose if isinstance(pose, RigidTransform) else rigid_from_matrix(pose, f"T_world_camera of frame {k}")
        for k, pose in enumerate(listed)
    ]
    return [camera.at(rigid[0])] * n if len(rigid) == 1 else [camera.at(pose) for pose in rigid]


def _stacked(images: Any, what: str) -> np.ndarray:
    """Stack images into one array. Raises InputError if the images have different shapes."""
    try:
        return np.asarray(images)
    except ValueError as error:
        shapes = sorted({np.shape(image) for image in images})
        raise InputError(f"{what} have different shapes: {', '.join(map(str, shapes))}") from error

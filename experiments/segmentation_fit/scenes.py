"""Simulated first pauses with true labels, for the fit of the learned tree and its check."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mstfilter.scene import Camera, Frame, VoxelGrid
from mstfilter.simulation import SCENE_FAMILIES, SceneFamily, SimulatedScene

_TABLE, _DEMO = SCENE_FAMILIES["table"], SCENE_FAMILIES["demo"]

#: To fit on: sizes and printed names of the tuning catalogue only; 3 - 9 objects, alone, touching and stacked.
FITTED = {
    "mix": replace(_TABLE, name="mix", catalogue="tuning", n_objects_min=3, n_objects_max=7, n_stacked=1),
    "small": replace(_DEMO, name="mixd", catalogue="tuning", n_objects_min=2, n_objects_max=6),
    "crowd": replace(
        _TABLE, name="mixc", catalogue="tuning", n_objects_min=6, n_objects_max=9, n_stacked=2, contact=0.9
    ),
}
FITTED_SEEDS = range(20, 100)
#: To check on: the named families, seeds that nothing was fitted on.
CHECKED = ("demo", "table", "s1", "s2", "s3")
CHECKED_SEEDS = range(10)  # the tuning seeds of the protocol


@dataclass(frozen=True, eq=False)
class Pause:
    """A frame with its true labels in the image (H, W) and in space (X, Y, Z); 0 is no object."""

    frame: Frame
    image: np.ndarray
    grid: VoxelGrid
    volume: np.ndarray


def small(family: SceneFamily) -> SceneFamily:
    """A family with a quarter of the pixels and an eighth of the voxels, for `--smoke`."""
    return replace(family, width=family.width // 2, height=family.height // 2, voxel_size=2 * family.voxel_size)


def first_pause(family: SceneFamily, seed: int) -> Pause:
    """The first pause of a scene."""
    scene = SimulatedScene(family, seed)
    seen = scene.frame_images(0)
    robot = seen["robot_mask"]
    camera: Camera = scene.camera
    frame = Frame(seen["rgb"], seen["depth"], camera, robot if robot.any() else None)
    image = np.where(robot, 0, seen["instance"]).astype(np.int64)
    return Pause(frame, image, scene.grid, scene.truth())

"""Simulated images with true labels, for the fits of the learned trees and their check."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mst_training.border_data import BorderSamples
from mstfilter.lab.simulation import SCENE_FAMILIES, SceneFamily, SimulatedScene
from mstfilter.scene import Frame, VoxelGrid

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
    """A frame with its true labels."""

    frame: Frame
    image: np.ndarray  #: (H, W) int, object of every pixel; 0 is no object, -1 is unknown
    grid: VoxelGrid


def small(family: SceneFamily) -> SceneFamily:
    """A family with a quarter of the pixels and an eighth of the voxels, for `--smoke`."""
    return replace(family, width=family.width // 2, height=family.height // 2, voxel_size=2 * family.voxel_size)


def pauses(family: SceneFamily, seed: int, pushes: tuple[int, ...] = (0,)) -> Iterator[Pause]:
    """The pauses of a scene after some numbers of pushes, in ascending order."""
    scene = SimulatedScene(family, seed)
    for action in range(pushes[-1] + 1):
        if action in pushes:
            seen = scene.frame_images(0)
            robot = seen["robot_mask"]
            frame = Frame(seen["rgb"], seen["depth"], scene.camera, robot if robot.any() else None)
            yield Pause(frame, np.where(robot, 0, seen["instance"]).astype(np.int64), scene.grid)
        if action < pushes[-1]:
            scene.play(scene.choose_push(action), lambda _: None)


class PlainSamples(BorderSamples):
    """Training images of the border network in which every surface has one colour."""

    @staticmethod
    def albedo(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
        colour = rng.uniform(0.02, 0.95, 3) ** 1.5
        if rng.uniform() < 0.4:  # grey, from black to white
            colour[:] = colour.mean()
        return np.broadcast_to(colour, points.shape).copy()


def training_images(samples: type[BorderSamples], seed: int, index: int) -> Iterator[Pause]:
    """Images of a scene of other kinds of objects, seen by random cameras; see `mst_training.border_data`."""
    grid = VoxelGrid.from_bounds(np.array([-0.5, -0.5, 0.0]), np.array([0.5, 0.5, 0.5]), 0.01)
    found = samples.of_scene(seed, index)
    for k in range(len(found)):
        yield Pause(found.frame(k), found.instance[k].astype(np.int64), grid)

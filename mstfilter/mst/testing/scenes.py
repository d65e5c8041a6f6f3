"""Example input for components that use images: hypotheses and a clip of three boxes on a table. One box is pushed.

>>> population, clip = scene_example(np.random.default_rng(0), 4)
>>> len(population), clip.before.depth.shape
(4, (96, 128))

To use this input in a contract, return it from the contract's method `example`, or define ``example = scene_example``
in the file of a component.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.scene import Camera, Clip, Frame, Hypothesis, VoxelGrid, look_at, render
from mstfilter.smc import Population

_GRID = VoxelGrid(np.array([-0.24, -0.24, 0.0]), 0.02, (24, 24, 8))
_FINE = VoxelGrid(_GRID.origin, _GRID.voxel_size / 4, (96, 96, 32))
_COLOURS = np.array([[160, 140, 110], [190, 60, 50], [60, 100, 180], [70, 160, 80]])


def _labels(shift: int) -> np.ndarray:
    """Labels (24, 24, 8) of three boxes. The first box is moved by `shift` voxels along x."""
    labels = np.zeros(_GRID.shape, np.uint16)
    labels[4 + shift : 9 + shift, 9:14, :4] = 1
    labels[15:20, 5:12, :3] = 2
    labels[14:18, 14:19, :5] = 3
    return labels


@lru_cache(maxsize=2)
def _clip(turned: bool = False) -> Clip:
    """Three frames of a moving box, from a camera in front and above, with a texture and without noise."""
    pose = look_at(np.array([0.0, -0.5, 0.45]), np.array([0.0, 0.0, 0.03]))
    camera = Camera.from_intrinsics(105, 105, 63.5, 47.5, 128, 96, pose)
    texture = np.random.default_rng(1).integers(-35, 36, (4, 64, 64))
    directions = camera.rays() @ camera.pose.as_matrix()[:3, :3].T
    frames = []
    for k in (0, 1, 2):
        motion = _turn(0.5 * k) if turned else RigidTransform.from_translation([k * _GRID.voxel_size, 0.0, 0.0])
        seen = render(_fine_labels(motion), _FINE, camera) if turned else render(_labels(k), _GRID, camera)
        table = -camera.position[2] / np.minimum(directions[..., 2], -1e-6)
        depth = np.where(seen.labels > 0, seen.depth, table)
        point = camera.position + depth[..., None] * directions
        pushed = seen.labels == 1
        point[pushed] = motion.inv().apply(point[pushed])  # the texture moves with its box
        cell = np.floor(point / 0.008).astype(int)
        pattern = texture[seen.labels, cell[..., 0] % 64, (cell[..., 1] + 7 * cell[..., 2]) % 64]
        rgb = np.clip(_COLOURS[seen.labels] + pattern[..., None], 0, 255).astype(np.uint8)
        frames.append(Frame(rgb, depth.astype(np.float32), camera))
    return Clip(tuple(frames), _GRID, index=1, times=(0.0, 0.2, 0.4))


def _turn(share: float) -> RigidTransform:
    """A share of the turn of the first box about its vertical axis."""
    centre = np.array([-0.11, -0.01, 0.0])
    turn = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, 0.5 * share]))
    return RigidTransform.from_translation(centre) * turn * RigidTransform.from_translation(-centre)


def _fine_labels(motion: RigidTransform) -> np.ndarray:
    """Labels (96, 96, 32) of the three boxes, the first one moved."""
    centres = _FINE.origin + (np.moveaxis(np.indices(_FINE.shape), 0, -1) + 0.5) * _FINE.voxel_size

    def at(points: np.ndarray) -> np.ndarray:
        index = _GRID.index_of(points)
        inside = _GRID.contains(index)
        return np.where(inside, _labels(0)[tuple(np.where(inside[..., None], index, 0).T)].T, 0)

    labels = at(centres)
    labels[labels == 1] = 0
    labels[at(motion.inv().apply(centres.reshape(-1, 3)).reshape(centres.shape)) == 1] = 1
    return labels.astype(np.uint16)


@dataclass(frozen=True, eq=False)
class KnownMotion:
    """A clip of three boxes, and what is true about it."""

    clip: Clip
    before: Hypothesis  #: the three boxes at the begin of the clip
    after: Hypothesis  #: the same at the end
    motions: Mapping[int, RigidTransform]  #: by label; the first box moves, the others rest


@lru_cache(maxsize=1)
def known_motions() -> tuple[KnownMotion, ...]:
    """The clip of `scene_example`, in which the first box is pushed by two voxels, and one in which it turns."""
    before, rest = Hypothesis.from_labels(_labels(0), _GRID), RigidTransform.identity()
    push = RigidTransform.from_translation([2 * _GRID.voxel_size, 0.0, 0.0])
    turned = _fine_labels(_turn(1.0))[2::4, 2::4, 2::4]
    return tuple(
        KnownMotion(_clip(turns), before, before.with_labels(labels), {1: motion, 2: rest, 3: rest})
        for turns, labels, motion in ((False, _labels(2), push), (True, turned, _turn(1.0)))
    )


def scene_example(rng: np.random.Generator, n: int) -> tuple[Population, Clip]:
    """`n` hypotheses with unequal weights before a box is pushed, and the clip of the push.

    Some hypotheses are correct. In other hypotheses two boxes are merged, a box is missing, or a box is split.
    """
    hypotheses = []
    for _ in range(n):
        labels = _labels(0)
        fault = rng.integers(4)
        if fault == 1:
            labels[labels == 3] = 2
        elif fault == 2:
            labels[labels == rng.integers(1, 4)] = 0
        elif fault == 3:
            labels[6:, :, :][labels[6:, :, :] == 1] = 4
        hypotheses.append(Hypothesis.from_labels(labels, _GRID))
    return Population(tuple(hypotheses), 0.5 * rng.standard_normal(n)), _clip()

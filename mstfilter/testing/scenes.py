"""Example input for components that use images: hypotheses and a clip of three boxes on a table. One box is pushed.

>>> population, clip = scene_example(np.random.default_rng(0), 4)
>>> len(population), clip.before.depth.shape
(4, (96, 128))

To use this input in a contract, return it from the contract's method `example`, or define ``example = scene_example``
in the file of a component.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from mstfilter.scene import Camera, Clip, Frame, Hypothesis, VoxelGrid, look_at, render
from mstfilter.smc import Population

_GRID = VoxelGrid(np.array([-0.24, -0.24, 0.0]), 0.02, (24, 24, 8))
_COLOURS = np.array([[160, 140, 110], [190, 60, 50], [60, 100, 180], [70, 160, 80]])


def _labels(shift: int) -> np.ndarray:
    """Labels (24, 24, 8) of three boxes. The first box is moved by `shift` voxels along x."""
    labels = np.zeros(_GRID.shape, np.uint16)
    labels[4 + shift : 9 + shift, 9:14, :4] = 1
    labels[15:20, 5:12, :3] = 2
    labels[14:18, 14:19, :5] = 3
    return labels


@lru_cache(maxsize=1)
def _clip() -> Clip:
    """Three frames of the push of a box, from a camera in front and above, with a texture and without noise."""
    pose = look_at(np.array([0.0, -0.5, 0.45]), np.array([0.0, 0.0, 0.03]))
    camera = Camera.from_intrinsics(105, 105, 63.5, 47.5, 128, 96, pose)
    texture = np.random.default_rng(1).integers(-35, 36, (4, 64, 64))
    directions = camera.rays() @ camera.pose.as_matrix()[:3, :3].T
    frames = []
    for shift in (0, 1, 2):
        seen = render(_labels(shift), _GRID, camera)
        table = -camera.position[2] / np.minimum(directions[..., 2], -1e-6)
        depth = np.where(seen.labels > 0, seen.depth, table)
        point = camera.position + depth[..., None] * directions
        point[..., 0] -= np.where(seen.labels == 1, shift * _GRID.voxel_size, 0.0)  # the texture moves with its box
        cell = np.floor(point / 0.008).astype(int)
        pattern = texture[seen.labels, cell[..., 0] % 64, (cell[..., 1] + 7 * cell[..., 2]) % 64]
        rgb = np.clip(_COLOURS[seen.labels] + pattern[..., None], 0, 255).astype(np.uint8)
        frames.append(Frame(rgb, depth.astype(np.float32), camera))
    return Clip(tuple(frames), _GRID, index=1, times=(0.0, 0.2, 0.4))


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

"""Volumetric truth: which voxels lie in which object, hidden ones included.

>>> import numpy as np
>>> from mstfilter.scene import VoxelGrid
>>> from mstfilter.simulation.shapes import draw_shape
>>> from mstfilter.simulation.truth import label_voxels
>>> ball = draw_shape(np.random.default_rng(0), "ball")
>>> grid = VoxelGrid((-0.2, -0.2, -0.2), 0.01, (40, 40, 40))
>>> labels = label_voxels([ball], np.eye(4)[None], grid)
>>> bool(abs(labels.sum() * 1e-6 / ball.pieces[0].volume - 1) < 0.1)
True
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mstfilter.scene import VoxelGrid
from mstfilter.simulation.shapes import Shape

__all__ = ["label_voxels"]


def label_voxels(shapes: Sequence[Shape], poses: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Labels (X, Y, Z) uint16: k + 1 where the voxel's centre lies in shape k, 0 where it lies in none.

    Parameters
    ----------
    shapes : sequence of Shape
        The objects.
    poses : (n, 4, 4)
        T_world_object of each.
    grid : VoxelGrid
        Workspace.

    Notes
    -----
    Objects at rest overlap by less than a millimetre; a centre that lies in two goes to the first.
    """
    labels = np.zeros(grid.shape, np.uint16)
    for k, (shape, pose) in enumerate(zip(shapes, poses, strict=True)):
        reach = np.abs(pose[:3, :3]) @ shape.half + grid.voxel_size
        low = np.maximum(grid.index_of(pose[:3, 3] - reach), 0)
        high = np.minimum(grid.index_of(pose[:3, 3] + reach) + 1, grid.shape)
        if (high <= low).any():
            continue
        box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
        index = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), -1)
        local = (grid.centre_of(index) - pose[:3, 3]) @ pose[:3, :3]
        free = labels[box] == 0
        labels[box][free & shape.inside(local)] = k + 1
    return labels

"""A small exact scene: boxes on a table, rendered through the ray caster, with a textured colour image."""

from __future__ import annotations

import numpy as np

from mstfilter.scene.camera import Camera, look_at
from mstfilter.scene.frame import depth_sigma
from mstfilter.scene.rendering import render
from mstfilter.scene.voxels import VoxelGrid

GRID = VoxelGrid((-0.3, -0.3, 0.0), 0.01, (60, 60, 30))
CAMERA = Camera.from_intrinsics(131, 131, 79.5, 59.5, 160, 120, look_at((0.0, -0.6, 0.5), (0, 0, 0.03)))


def table_scene(
    shift: int = 0, noise: np.random.Generator | None = None, empty: bool = False, camera: Camera = CAMERA
):
    """Colour (120, 160, 3), depth (120, 160) metres and true labels; box 1 stands `shift` voxels further right."""
    labels = np.zeros(GRID.shape, np.uint16)
    if not empty:
        labels[15 + shift : 25 + shift, 25:35, :12] = 1
        labels[38:46, 20:40, :6] = 2
    seen = render(labels, GRID, camera)
    directions = camera.rays() @ camera.pose.as_matrix()[:3, :3].T
    table = -camera.position[2] / np.minimum(directions[..., 2], -1e-6)
    depth = np.where(seen.labels > 0, seen.depth, table)
    point = camera.position + depth[..., None] * directions
    checks = ((np.floor(point / 0.03).astype(int).sum(axis=-1)) % 2) * 30
    colours = np.array([[150, 130, 110], [190, 60, 50], [50, 90, 180]])
    rgb = np.clip(colours[np.minimum(seen.labels, 2)] + checks[..., None], 0, 255).astype(np.uint8)
    if noise is not None:
        depth = depth + noise.normal(size=depth.shape) * depth_sigma(depth)
    return rgb, depth.astype(np.float32), labels

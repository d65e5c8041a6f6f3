"""A rendered table scene: truth is known, no real data needed."""

from __future__ import annotations

import numpy as np

from mstfilter.scene import Camera, Clip, Frame, VoxelGrid, look_at, render

GRID = VoxelGrid((-0.3, -0.3, 0.0), 0.01, (60, 60, 30))
COLOURS = np.array([[200, 190, 170], [200, 40, 40], [40, 160, 60], [40, 60, 200], [220, 200, 60]], np.uint8)


def boxes(*corners: tuple[tuple[int, int, int], tuple[int, int, int]]) -> np.ndarray:
    """Label grid with box k + 1 between the given voxel corners."""
    labels = np.zeros(GRID.shape, np.uint16)
    for k, (a, b) in enumerate(corners, start=1):
        labels[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = k
    return labels


def camera(width: int = 320, known: bool = True) -> Camera:
    pose = look_at(np.array([0.0, -0.75, 0.75]), np.array([0.0, 0.0, 0.05])) if known else None
    f = 525 * width / 640
    height = width * 3 // 4
    return Camera.from_intrinsics(f, f, width / 2 - 0.5, height / 2 - 0.5, width, height, pose)


def frame_of(labels: np.ndarray, width: int = 320, noise: float = 0.0, robot: np.ndarray | None = None) -> Frame:
    """The scene on a table z = 0; `noise` in disparity units (1/8 px at f = 525)."""
    view = camera(width)
    seen = render(labels, GRID, view)
    direction = view.rays() @ view.pose.as_matrix()[2, :3]
    table = np.where(direction < 0, -view.position[2] / direction, np.nan)
    depth = np.where(seen.labels > 0, seen.depth, table)
    disparity = 315.0 / depth + noise * np.random.default_rng(0).standard_normal(depth.shape)
    return Frame(COLOURS[seen.labels], (315.0 / disparity).astype(np.float32), view, robot)


def clip_of(labels: np.ndarray, **options) -> Clip:
    return Clip((frame_of(labels, **options),), GRID, 0)


TWO = boxes(((15, 20, 0), (27, 34, 12)), ((36, 22, 0), (48, 36, 8)))
TOUCHING = boxes(((20, 20, 0), (32, 34, 14)), ((32, 22, 0), (44, 36, 7)))

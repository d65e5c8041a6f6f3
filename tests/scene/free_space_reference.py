"""A reference for free space, which checks one voxel and one camera at a time, and small scenes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from mstfilter.scene import Camera, Frame, VoxelGrid, look_at, render

SMALL = VoxelGrid((-0.1, -0.12, -0.04), 0.04, (5, 6, 5))  # the lowest layer lies below the table
SIGMA = 0.00185


def camera(position, width=12, height=9, focal=14.0) -> Camera:
    pose = look_at(np.array(position), np.array([0.0, 0.0, 0.05]))
    return Camera.from_intrinsics(focal, focal * 1.1, width / 2 - 0.3, height / 2 - 0.6, width, height, pose)


CAMERAS = (camera((0.03, -0.55, 0.41)), camera((0.52, 0.1, 0.3)), camera((-0.37, 0.31, 0.5)))


def frame_of(depth, cam, robot=None, views=()) -> Frame:
    return Frame(np.zeros((*depth.shape, 3), np.uint8), depth, cam, robot, views)


def image(rng: np.random.Generator, cam: Camera) -> Frame:
    """A frame that shows a slanted wall in or behind the grid, with patches nearer, farther, missing, or robot."""
    v, u = np.mgrid[: cam.height, : cam.width]
    depth = rng.choice([0.45, 0.55, 0.65]) + 0.01 * u * rng.integers(-1, 2) + 0.01 * v * rng.integers(-1, 2)
    robot = np.zeros(depth.shape, bool)
    for _ in range(rng.integers(6)):
        a, b = rng.integers(cam.height), rng.integers(cam.width)
        patch = np.s_[a : a + rng.integers(1, 6), b : b + rng.integers(1, 6)]
        match rng.integers(4):
            case 0:
                robot[patch] = True
            case 1:
                depth[patch] = np.nan
            case _:
                depth[patch] += rng.uniform(-0.25, 0.25)
    depth += rng.normal(scale=0.003, size=depth.shape)
    return frame_of(depth.astype(np.float32), cam, robot)


def _views(seed: int, n: int) -> Frame:
    rng = np.random.default_rng(seed)
    first, *others = (image(rng, cam) for cam in CAMERAS[:n])
    return frame_of(first.depth, first.camera, first.robot_mask, tuple(others))


def views(n: int):
    """A frame of the first n cameras."""
    return st.builds(_views, st.integers(0, 10**6), st.just(n))


@dataclass
class ObservedVoxels:
    """State of every voxel; `unsure` where the result depends on rounding."""

    free: np.ndarray
    hit: np.ndarray
    unsure: np.ndarray


def observe(frame: Frame, grid: VoxelGrid, voxels: float, sigmas: float, table: float) -> ObservedVoxels:
    """Evaluates the definition with a pinhole camera, voxel by voxel."""
    found = ObservedVoxels(*(np.zeros(grid.shape, bool) for _ in range(3)))
    for view in (frame, *frame.views):
        _mark_hits(view, grid, found)
    for index in np.ndindex(*grid.shape):
        centre = [grid.origin[a] + (index[a] + 0.5) * grid.voxel_size for a in range(3)]
        if centre[2] < table:
            found.free[index], found.hit[index] = True, False
            continue
        answers = [_one(view, centre, grid.voxel_size, voxels, sigmas) for view in (frame, *frame.views)]
        found.unsure[index] |= "unsure" in answers
        found.free[index] = "free" in answers and not found.hit[index]
    return found


def _mark_hits(view: Frame, grid: VoxelGrid, found: ObservedVoxels) -> None:
    K, T = view.camera.K, view.camera.T_world_camera.as_matrix()
    for v, u in np.ndindex(view.camera.height, view.camera.width):
        d = float(view.depth[v, u])
        if np.isnan(d) or (view.robot_mask is not None and view.robot_mask[v, u]):
            continue
        local = np.array([(u - K[0, 2]) / K[0, 0] * d, (v - K[1, 2]) / K[1, 1] * d, d, 1.0])
        where = ((T @ local)[:3] - grid.origin) / grid.voxel_size
        index = tuple(int(np.floor(x)) for x in where)
        if all(0 <= index[a] < grid.shape[a] for a in range(3)):
            found.hit[index] = True
            if np.abs(where - np.round(where)).min() < 1e-6:
                found.unsure[index] = True


def _one(view: Frame, centre, size: float, voxels: float, sigmas: float) -> str:
    K, T = view.camera.K, view.camera.T_world_camera.as_matrix()
    x, y, z = T[:3, :3].T @ (np.array(centre) - T[:3, 3])
    if z <= 0:
        return "unknown"
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    if min(abs(u - np.floor(u) - 0.5), abs(v - np.floor(v) - 0.5)) < 1e-6:
        return "unsure"
    column, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
    if not (0 <= column < view.camera.width and 0 <= row < view.camera.height):
        return "unknown"
    d = float(view.depth[row, column])
    if np.isnan(d) or (view.robot_mask is not None and view.robot_mask[row, column]):
        return "unknown"
    margin = voxels * size + sigmas * SIGMA * d * d
    if abs(abs(z - d) - margin) < 1e-5:
        return "unsure"
    return "free" if z < d - margin else "not free"


def shelf(voxel: float):
    """Grid, true labels, frame: a box, a book of 2 cm on it, an upright rod one voxel thick; rendered, no noise."""
    grid = VoxelGrid((-0.2, -0.2, 0.0), voxel, tuple(round(x / voxel) for x in (0.4, 0.4, 0.26)))
    labels = np.zeros(grid.shape, np.uint16)

    def put(k, lower, upper):
        a, b = (np.round((np.array(p) - grid.origin) / voxel).astype(int) for p in (lower, upper))
        labels[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = k

    put(1, (-0.14, -0.1, 0), (0.02, 0.06, 0.08))
    put(2, (-0.12, -0.08, 0.08), (0.0, 0.04, 0.1))
    put(3, (0.1, -0.02, 0), (0.1 + voxel, -0.02 + voxel, 0.2))
    cam = Camera.from_intrinsics(262, 262, 159.5, 119.5, 320, 240, look_at((0.05, -0.6, 0.5), (0, 0, 0.05)))
    seen = render(labels, grid, cam)
    directions = cam.rays() @ cam.pose.as_matrix()[:3, :3].T
    table = -cam.position[2] / np.minimum(directions[..., 2], -1e-6)
    depth = np.where(seen.labels > 0, seen.depth, table)
    point = cam.position + depth[..., None] * directions
    checks = ((np.floor(point / 0.02).astype(int).sum(axis=-1)) % 2) * 30
    colours = np.array([[150, 130, 110], [190, 60, 50], [50, 90, 180], [60, 150, 70]])
    rgb = np.clip(colours[seen.labels] + checks[..., None], 0, 255).astype(np.uint8)
    return grid, labels, Frame(rgb, depth.astype(np.float32), cam)

"""Rendering of label grids by exact ray casting through voxels.

>>> image = project(hypothesis, camera)            # label image (H, W): PROJECT in section IV-C of the paper
>>> labels, depth = render_hypothesis(hypothesis, camera)
>>> labels, depth = render(label_grid, grid, camera)

The ray of each pixel is followed from voxel to voxel. The ray jumps in free space. If the nearest occupied voxel has
the chessboard distance D, the cube of half-width D - 1 around the current voxel is empty. The ray continues at the
face where it leaves this cube. With D = 1 this is the voxel traversal of Amanatides and Woo (1987). The jumps save
steps and do not change the result. A hypothesis is rendered object by object, and hypotheses share their objects.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_cdt, find_objects

from mstfilter.scene.arrays import content_key, max_of_three, read_only
from mstfilter.scene.cache import memo
from mstfilter.scene.camera import Camera
from mstfilter.scene.voxels import Hypothesis, VoxelGrid, labels_on, occupied_box

_Box = tuple[slice, ...]


class Rendering(NamedTuple):
    """Label image (H, W) uint16 with 0 without a hit, and z-depth (H, W) float32 in metres with NaN without a hit."""

    labels: np.ndarray
    depth: np.ndarray


def project(hypothesis: Hypothesis, camera: Camera) -> np.ndarray:
    """Label image (H, W) uint16 of a hypothesis; 0 where no object is visible. Cached by content."""
    return render_hypothesis(hypothesis, camera).labels


def render_hypothesis(hypothesis: Hypothesis, camera: Camera) -> Rendering:
    """Label image and depth of a hypothesis, read-only. Cached by content."""

    def compute() -> Rendering:
        image = np.zeros((camera.height, camera.width), np.uint16)
        depth = np.full(image.shape, np.inf, np.float32)
        for label, box in enumerate(find_objects(hypothesis.labels), 1):
            if box is not None:
                window, of_object = _object_depth(hypothesis.labels[box] == label, box, hypothesis.grid, camera)
                nearer = of_object < depth[window]
                image[window][nearer] = label
                depth[window][nearer] = of_object[nearer]
        depth[image == 0] = np.nan
        return Rendering(read_only(image), read_only(depth))

    return memo("render", (hypothesis.key, camera.key), compute)


def _object_depth(mask: np.ndarray, box: _Box, grid: VoxelGrid, camera: Camera) -> tuple[_Box, np.ndarray]:
    """A window of the image and the depth (h, w) of an object in it, inf without a hit. Hypotheses share objects.

    `mask` (a, b, c) are its voxels in a box of the grid.
    """

    def compute() -> tuple[_Box, np.ndarray]:
        window, _, depth = _cast(mask, box, grid, camera)
        return window, read_only(depth)

    corner = tuple(side.start for side in box)
    return memo("render_object", (content_key("object", mask, grid.key), corner, camera.key), compute)


def render(labels: np.ndarray, grid: VoxelGrid, camera: Camera) -> Rendering:
    """Cast one ray through each pixel centre into a label grid (X, Y, Z), in which 0 is free."""
    labels = labels_on(grid, labels)
    image = np.zeros((camera.height, camera.width), np.uint16)
    depth = np.full(image.shape, np.nan, np.float32)
    box = occupied_box(labels != 0)
    if box is not None:
        window, voxel, found = _cast(labels[box], box, grid, camera)
        hit = voxel >= 0
        image[window][hit] = labels[box].ravel()[voxel[hit]]
        depth[window][hit] = found[hit]
    return Rendering(image, depth)


def _cast(labels: np.ndarray, box: _Box, grid: VoxelGrid, camera: Camera) -> tuple[_Box, np.ndarray, np.ndarray]:
    """Cast rays into a box of the grid that has these labels (a, b, c).

    Returns the window of the image that can show the box, and two arrays (h, w) of its pixels: the flat voxel, and
    the depth as float32. Without a hit they are -1 and inf.
    """
    lower = np.array([side.start for side in box])
    # Ray: start + t * direction, in voxels of the box; the directions have z = 1 m, so that t is z-depth in metres.
    matrix = camera.pose.as_matrix()
    start = (matrix[:3, 3] - grid.origin) / grid.voxel_size - lower
    window = _window(labels.shape, grid, lower, camera)
    rays = camera.rays()[window]
    directions = rays.reshape(-1, 3) @ (matrix[:3, :3].T / grid.voxel_size)
    # A component of exactly 0 never meets a face of its axis; a tiny one behaves the same without special cases.
    directions[np.abs(directions) < 1e-12] = 1e-12
    voxel, depth = np.full(len(directions), -1), np.full(len(directions), np.inf, np.float32)
    hit, at, t = _traverse(labels, start, directions)
    voxel[hit], depth[hit] = at, t
    return window, voxel.reshape(rays.shape[:2]), depth.reshape(rays.shape[:2])


def _window(shape: tuple[int, ...], grid: VoxelGrid, lower: np.ndarray, camera: Camera) -> tuple[slice, slice]:
    """Image rows and columns that can show the box, or all of them if a corner is not in front of the camera."""
    corners = np.array(np.meshgrid(*[(0, n) for n in shape], indexing="ij")).reshape(3, -1).T
    uv, z = camera.project(grid.origin + (corners + lower) * grid.voxel_size)
    if (z < 1e-3).any():
        return slice(0, camera.height), slice(0, camera.width)
    size = np.array([camera.width, camera.height])
    first = np.clip(np.floor(uv.min(axis=0)).astype(int), 0, size)
    last = np.clip(np.ceil(uv.max(axis=0)).astype(int) + 1, first, size)
    return slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))


def _traverse(
    box: np.ndarray, start: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Follow rays (n, 3) from `start`. Returns ray number, flat voxel index and t of rays that hit a voxel."""
    distance = distance_transform_cdt(box == 0, metric="chessboard").astype(np.int32).ravel()
    shape = np.array(box.shape)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    forward = directions > 0
    inverse = 1.0 / directions
    # Slabs: a ray is inside the box between the last entry and the first exit of the three axes.
    near = (np.where(forward, 0.0, shape) - start) * inverse
    far = (np.where(forward, shape, 0.0) - start) * inverse
    enter = np.maximum(max_of_three(near), 0.0)
    alive = np.flatnonzero(enter < -max_of_three(-far))

    t = enter[alive]
    inverse, forward, directions = inverse[alive], forward[alive], directions[alive]
    voxel = np.floor(start + t[:, None] * directions).astype(np.int32)
    # Rounding may put the entry point just outside the box.
    np.clip(voxel, 0, shape - 1, out=voxel)
    rays, cells, depths = [], [], []
    while len(alive):
        flat = voxel @ strides
        free = distance[flat]
        stop = free == 0
        if stop.any():
            rays.append(alive[stop])
            cells.append(flat[stop])
            depths.append(t[stop])
            go = ~stop
            alive, voxel, free = alive[go], voxel[go], free[go]
            inverse, forward, directions = inverse[go], forward[go], directions[go]
        if not len(alive):
            break
        half = free[:, None]  # D; the empty cube spans voxel - D + 1 to voxel + D
        faces = np.where(forward, voxel + half, voxel - half + 1)
        leave = (faces - start) * inverse
        axis = leave.argmin(axis=1)
        row = np.arange(len(alive))
        t = leave[row, axis]
        point = np.floor(start + t[:, None] * directions).astype(np.int32)
        np.clip(point, voxel - half + 1, voxel + half - 1, out=point)
        point[row, axis] = np.where(forward[row, axis], voxel[row, axis] + free, voxel[row, axis] - free)
        a, b, c = ((point >= 0) & (point < shape)).T
        inside = a & b & c
        if not inside.all():
            alive, point, t = alive[inside], point[inside], t[inside]
            inverse, forward, directions = inverse[inside], forward[inside], directions[inside]
        voxel = point
    if not rays:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    return np.concatenate(rays), np.concatenate(cells), np.concatenate(depths)

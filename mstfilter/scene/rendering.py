"""Rendering of label grids by exact ray casting through voxels.

>>> image = project(hypothesis, camera)            # label image (H, W): PROJECT in section IV-C of the paper
>>> labels, depth = render_hypothesis(hypothesis, camera)
>>> labels, depth = render(label_grid, grid, camera)

The ray of each pixel is followed from voxel to voxel, with jumps over free space. If the nearest occupied voxel has
the chessboard distance D, the cube of half-width D - 1 around the current voxel is empty. The ray continues at the
face where the ray leaves the empty cube. Without jumps, the method is the voxel traversal of Amanatides and Woo
(1987). The jumps do not change the result. Hypotheses with the same object share the cached image of the object.
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
    """Label image (H, W) uint16, and z-depth (H, W) float32 in metres. Pixels without an object have depth NaN."""

    labels: np.ndarray
    depth: np.ndarray


def project(hypothesis: Hypothesis, camera: Camera) -> np.ndarray:
    """Label image (H, W) uint16 of a hypothesis. Pixels without a visible object are 0."""
    return render_hypothesis(hypothesis, camera).labels


def render_hypothesis(hypothesis: Hypothesis, camera: Camera) -> Rendering:
    """Read-only label image and depth image of a hypothesis. The images of its objects are cached."""
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


def _object_depth(mask: np.ndarray, box: _Box, grid: VoxelGrid, camera: Camera) -> tuple[_Box, np.ndarray]:
    """Image window around an object, and depth image (h, w) of the object in the window. Other pixels have depth inf.

    `mask` (a, b, c) marks the voxels of the object in a box of the grid.
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
    """Cast rays into a box of the grid. `labels` (a, b, c) are the labels in the box.

    Returns the image window that can show the box, and two arrays (h, w): the flat voxel index and the depth
    (float32) of each pixel. A pixel with no occupied voxel on its ray has index -1 and depth inf.
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
    """Image rows and columns that can show a box, or the whole image if a corner of the box is behind the camera."""
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
    """Follow rays with directions (n, 3). Returns ray number, flat voxel index and ray parameter t of each hit."""
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

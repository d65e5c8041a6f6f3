"""The true volume of a triangle mesh, by parallel rays.

Along a line that crosses a closed surface, the parts between the first and second, third and fourth (...) crossing
are inside. Lines along all three axes give the share of each small cell that is inside (`volume_fractions`).

Lines also show whether a mesh has an inside at all. If a line crosses the surface an odd number of times, a ray from
a point to one end and the ray to the other end disagree whether the point is inside. `volume_fractions` returns the
mean share of rays that agree, 1 for a closed surface:

>>> import numpy as np
>>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) * 0.1
>>> faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
...                   [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])
>>> volume = volume_fractions(corners, faces, 0.002)
>>> bool(abs(volume.share.sum() * 0.002**3 - 1e-3) < 1e-5), volume.agreement
(True, 1.0)
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

#: Lines off the middle of a cell, in cells: such lines seldom meet an edge of a mesh.
OFF_MIDDLE = np.array([0.5 + 0.0414, 0.5 - 0.0732])


@dataclass(frozen=True, eq=False)
class Volume:
    """The inside of a mesh on a raster of small cells."""

    origin: np.ndarray  #: (3,) metres, lower corner of cell (0, 0, 0)
    cell: float  #: metres, edge of a cell
    share: np.ndarray  #: (X, Y, Z) float32: share of each cell that is inside
    agreement: float  #: mean share of rays that agree whether a point is inside

    @functools.cached_property
    def _blurred(self) -> np.ndarray:
        from scipy.ndimage import uniform_filter

        return np.asarray(uniform_filter(self.share, 2, mode="constant", origin=-1))

    def resampled(
        self, origin: np.ndarray, axes: np.ndarray, step: float, shape: tuple[int, ...], blur: bool = False
    ) -> np.ndarray:
        """Shares (shape) float32 interpolated at the points ``origin + step * (axes @ (i, j, k))`` of the raster.

        `origin` (3,) in metres and the columns of `axes` (3, 3) are in the frame of the mesh. With `blur`, a share is
        the mean of 2 x 2 x 2 cells, so that walls of a cell are not missed by points that are farther apart.
        """
        from scipy.ndimage import affine_transform

        first = (origin - self.origin) / self.cell - (1.0 if blur else 0.5)
        share = self._blurred if blur else self.share
        matrix = axes * (step / self.cell)
        return np.asarray(affine_transform(share, matrix, first, shape, order=1, mode="grid-constant"))


def lattice_points(flat: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Lattice points in triangles (F, 3, 2), in units of the lattice: faces (n,), points (n, 2), weights (n, 3).

    A lattice point on an edge that two triangles share lies in exactly one of them: the test of an edge uses the same
    order of end points for both triangles. The result comes in blocks.
    """
    low, high = np.ceil(flat.min(axis=1)).astype(np.int64), np.floor(flat.max(axis=1)).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    count = size.prod(axis=1)
    blocks = np.searchsorted(np.cumsum(count), np.arange(0, max(int(count.sum()), 1), 2_000_000), side="right")
    for faces in np.split(np.arange(len(flat)), blocks[1:]):
        face = np.repeat(faces, count[faces])
        if not len(face):
            continue
        number = np.arange(len(face)) - np.repeat(np.cumsum(count[faces]) - count[faces], count[faces])
        point = low[face] + np.stack([number // size[face, 1], number % size[face, 1]], axis=1)
        areas = np.empty((len(face), 3))
        for k in range(3):
            a, b = flat[faces, (k + 1) % 3], flat[faces, (k + 2) % 3]
            swap = (a[:, 0] > b[:, 0]) | (a[:, 0] == b[:, 0]) & (a[:, 1] > b[:, 1])
            a, b = np.where(swap[:, None], b, a), np.where(swap[:, None], a, b)
            start, edge = (np.repeat(x, count[faces], axis=0) for x in (a, b - a))
            sign = np.repeat(np.where(swap, -1.0, 1.0), count[faces])
            areas[:, k] = sign * (edge[:, 0] * (point[:, 1] - start[:, 1]) - edge[:, 1] * (point[:, 0] - start[:, 0]))
        inside = (areas > 0).all(axis=1) | (areas < 0).all(axis=1)
        areas = areas[inside]
        yield face[inside], point[inside], areas / areas.sum(axis=1, keepdims=True)


def volume_fractions(vertices: np.ndarray, faces: np.ndarray, cell: float) -> Volume:
    """The share of each cell inside a mesh of vertices (V, 3) and faces (F, 3), from one line a cell and axis.

    Lines that cross the mesh an odd number of times are left out of the shares.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    shape = np.maximum(np.ceil((high - low) / cell).astype(int), 1) + 2
    origin = (low + high) / 2 - shape * cell / 2
    corners = (vertices[faces] - origin) / cell
    total, lines = np.zeros(shape, np.float32), np.zeros(shape, np.int8)
    for_inside = np.zeros(shape, np.int8)  # of six rays from each cell
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        n, m = shape[others], int(shape[axis])
        found = []
        for face, point, weights in lattice_points(corners[:, :, others] - OFF_MIDDLE):
            height = np.einsum("nk,nk->n", weights, corners[face][:, :, axis])
            valid = ((point >= 0) & (point < n)).all(axis=1)
            found.append(np.stack([point[valid, 0] * n[1] + point[valid, 1], height[valid]], axis=1))
        crossings = np.concatenate(found) if found else np.zeros((0, 2))
        column, height = crossings[np.lexsort((crossings[:, 1], crossings[:, 0]))].T
        column = column.astype(np.int64)
        per_column = np.bincount(column, minlength=int(n.prod()))
        order = np.arange(len(column)) - (np.cumsum(per_column) - per_column)[column]
        sign = np.where(order % 2 == 0, 1.0, -1.0)
        at = np.clip(height.astype(np.int64), 0, m - 1)
        # A crossing at height h in cell i covers i + 1 - h of cell i and all cells above; an even one takes it back.
        begun = np.zeros((int(n.prod()), m + 1))
        np.add.at(begun, (column, at + 1), sign)
        covered = np.cumsum(begun, axis=1)[:, :m]
        np.add.at(covered, (column, at), sign * (at + 1 - height))
        even = per_column % 2 == 0
        below = np.zeros((int(n.prod()), m), np.int64)
        np.add.at(below, (column, np.clip(np.ceil(height - 0.5).astype(np.int64), 0, m - 1)), 1)
        below = np.cumsum(below, axis=1)
        votes = below % 2 + (per_column[:, None] - below) % 2

        def back(a: np.ndarray, n: np.ndarray = n, m: int = m, axis: int = axis) -> np.ndarray:
            return np.moveaxis(a.reshape(*n, m), 2, axis)

        total += back((covered * even[:, None]).astype(np.float32))
        lines += back(np.broadcast_to(even[:, None], covered.shape).astype(np.int8))
        for_inside += back(votes.astype(np.int8))
    inner = for_inside[1:-1, 1:-1, 1:-1].astype(float)
    agreement = float(np.maximum(inner, 6 - inner).mean() / 6)
    share = np.clip(total / np.maximum(lines, 1), 0, 1).astype(np.float32)
    return Volume(origin, cell, share, agreement)

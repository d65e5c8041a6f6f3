"""Truncated signed distances of one object: depth images averaged over time (Curless and Levoy 1996).

>>> volume = ObjectVolume.of(hypothesis.mask(3), grid, truncation=0.03, weight=2.0)
>>> volume = volume.integrate(frame, grid, np.eye(4), mine, others)
>>> volume.occupied                     # (a, b, c) bool, at volume.box of the grid

Distances are positive outside the object. Beside them stands how often a voxel's surface was seen in the object's own
mask and in another's, as in MID-Fusion (Xu et al. 2019).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mstfilter.scene import Frame, VoxelGrid
from mstfilter.tracking import apply

__all__ = ["ObjectVolume"]


@dataclass(frozen=True, eq=False)
class ObjectVolume:
    """Signed distances in a box of the grid.

    Parameters
    ----------
    offset : (3,) int
        Index of the box's first voxel in the grid.
    distance : (a, b, c) float
        Metres to the surface, negative inside, at most `truncation` either way.
    weight : (a, b, c) float
        Images behind each distance.
    own, other : (a, b, c) float
        Images in which the voxel's surface was in the object's mask, in another object's.
    truncation : float
        Metres.
    """

    offset: np.ndarray
    distance: np.ndarray
    weight: np.ndarray
    own: np.ndarray
    other: np.ndarray
    truncation: float

    @classmethod
    def of(cls, mask: np.ndarray, grid: VoxelGrid, truncation: float, weight: float) -> ObjectVolume:
        """The volume of voxels (X, Y, Z) bool, not empty, with a margin in which the object can grow."""
        from scipy.ndimage import distance_transform_edt

        margin = int(np.ceil(truncation / grid.voxel_size)) + 1
        where = np.nonzero(mask)
        low = np.array([max(int(w.min()) - margin, 0) for w in where])
        high = np.array([min(int(w.max()) + 1 + margin, n) for w, n in zip(where, grid.shape, strict=True)])
        inside = mask[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
        # Half a voxel: the surface lies between the last centre inside and the first one outside.
        signed = np.where(
            inside, 0.5 - distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1, 1:-1],
            distance_transform_edt(~inside) - 0.5,
        )  # fmt: skip
        distance = np.clip(signed * grid.voxel_size, -truncation, truncation)
        full = np.full(inside.shape, float(weight))
        return cls(low, distance, full, full, np.zeros(inside.shape), truncation)

    @property
    def box(self) -> tuple[slice, slice, slice]:
        """Slices of the box in the grid."""
        a, b, c = (slice(int(o), int(o) + n) for o, n in zip(self.offset, self.distance.shape, strict=True))
        return a, b, c

    @property
    def occupied(self) -> np.ndarray:
        """(a, b, c) bool: inside the surface, and more often the object's than another's."""
        return (self.distance < 0) & (self.own > self.other)

    def integrate(
        self, frame: Frame, grid: VoxelGrid, T: np.ndarray, mine: np.ndarray, others: np.ndarray
    ) -> ObjectVolume:
        """The volume after another image.

        Parameters
        ----------
        frame : Frame
        grid : VoxelGrid
        T : (4, 4) array
            Motion in world metres that carries the object from where the volume is to where the frame shows it.
        mine, others : (H, W) bool
            Pixels that show this object, and another one. A surface counts where it is the object's own; free space
            counts wherever it is seen.
        """
        index = np.stack(np.meshgrid(*(np.arange(n) for n in self.distance.shape), indexing="ij"), axis=-1)
        uv, z = frame.camera.project(apply(T, grid.centre_of(index.reshape(-1, 3) + self.offset)))
        with np.errstate(invalid="ignore"):
            pixel = np.rint(uv)
            inside = (
                (z > 1e-6)
                & (pixel >= 0).all(axis=-1)
                & (pixel < [frame.camera.width, frame.camera.height]).all(axis=-1)
            )
        u, v = np.where(inside[:, None], pixel, 0).astype(np.int64).T
        inside &= frame.valid[v, u]
        sdf = np.where(inside, frame.depth[v, u] - z, -np.inf)
        near = np.abs(sdf) <= self.truncation
        taken = (sdf > self.truncation) | (near & mine[v, u])
        shape = self.distance.shape
        w = taken.reshape(shape).astype(float)
        step = np.where(taken, np.clip(sdf, -self.truncation, self.truncation), 0).reshape(shape)
        weight = self.weight + w
        return replace(
            self,
            distance=(self.distance * self.weight + step * w) / weight,
            weight=weight,
            own=self.own + (near & mine[v, u]).reshape(shape),
            other=self.other + (near & others[v, u]).reshape(shape),
        )

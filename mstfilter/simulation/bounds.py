"""Which rays can meet which bodies: capsules that bound them, tested without casting.

A capsule seen from a point lies in a cone and, if it is long, between two planes. The test errs on one side
only: a ray that is said not to meet a bound does not meet it.

>>> import numpy as np
>>> from mstfilter.simulation.bounds import Bounds
>>> ball = Bounds(np.array([[0.0, 0, 1]]), np.array([[0.0, 0, 1]]), np.array([0.1]))
>>> ball.seen_from(np.zeros(3)).meet(np.array([[0.0, 0.05, 1.0], [0.5, 0.0, 1.0]], np.float32)).tolist()
[True, False]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Bounds", "Cones"]

_SLACK = 1e-4  # of angles, against single precision


@dataclass(frozen=True, eq=False)
class Cones:
    """Bounds as seen from one point.

    Parameters
    ----------
    axis : (k, 3) float32
        Unit vectors along which they are seen.
    cosine : (k,) float32
        Least cosine between a ray that meets one and its axis.
    across : (k, 3) float32
        Unit normals of the planes through the point and long ones; 0 for balls.
    slab : (k,) float32
        Greatest sine between a ray and that plane.
    """

    axis: np.ndarray
    cosine: np.ndarray
    across: np.ndarray
    slab: np.ndarray

    def meet(self, rays: np.ndarray) -> np.ndarray:
        """(n,) bool: whether rays (n, 3) float32 of any length, from the point, may meet one of the bounds."""
        met = np.zeros(len(rays), bool)
        x, y, z = (np.ascontiguousarray(rays[:, i]) for i in range(3))
        length = np.sqrt(x * x + y * y + z * z)
        for a, cosine, n, slab in zip(self.axis, self.cosine, self.across, self.slab, strict=True):
            inside = x * a[0] + y * a[1] + z * a[2] >= cosine * length
            if n.any():
                few = np.flatnonzero(inside)
                off = np.abs(x[few] * n[0] + y[few] * n[1] + z[few] * n[2])
                met[few] |= off <= slab * length[few]
            else:
                met |= inside
        return met


@dataclass(frozen=True, eq=False)
class Bounds:
    """Capsules.

    Parameters
    ----------
    a, b : (k, 3) metres
        Ends of their axes; equal for balls.
    radius : (k,) metres
    """

    a: np.ndarray
    b: np.ndarray
    radius: np.ndarray

    def __len__(self) -> int:
        return len(self.radius)

    def joined(self, other: Bounds) -> Bounds:
        """Both."""
        return Bounds(
            np.concatenate([self.a, other.a]),
            np.concatenate([self.b, other.b]),
            np.concatenate([self.radius, other.radius]),
        )

    def of(self, which: np.ndarray) -> Bounds:
        """Those of an index or mask."""
        return Bounds(self.a[which], self.b[which], self.radius[which])

    def seen_from(self, point: np.ndarray) -> Cones:
        """What rays from a point are tested with."""
        a, b = self.a - point, self.b - point
        along = b - a
        square = np.maximum((along**2).sum(axis=1), 1e-30)
        share = np.clip(-(a * along).sum(axis=1) / square, 0.0, 1.0)
        nearest = np.linalg.norm(a + share[:, None] * along, axis=1)
        within = nearest <= self.radius * 1.001
        safe = np.where(within, 1.0, nearest)
        first, second = _unit(a), _unit(b)
        spread = np.arccos(np.clip((first * second).sum(axis=1), -1.0, 1.0))
        ratio = np.minimum(self.radius / safe, 1.0)
        angle = spread / 2 + np.arcsin(ratio) + _SLACK
        cosine = np.where(within | (angle >= np.pi / 2), -2.0, np.cos(np.minimum(angle, np.pi)))
        across = np.where((within | (spread < 1e-3))[:, None], 0.0, _unit(np.cross(a, b)))
        single = [np.asarray(v, np.float32) for v in (_unit(first + second), cosine, across, ratio + _SLACK)]
        return Cones(*single)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)

"""Convex pieces: the one description from which physics, rays and volumetric truth are made.

A rigid object is a union of convex pieces by construction. MuJoCo collides and ray-casts exactly these
pieces and `Piece.inside` answers for the same solids, so a picture and its truth cannot disagree.

>>> from mstfilter.simulation.solids import box
>>> box((0.02, 0.03, 0.04)).inside([[0.0, 0.0, 0.039], [0.0, 0.0, 0.041]]).tolist()
[True, False]


Which rays can meet which bodies: capsules that bound them, tested without casting.

A capsule seen from a point lies in a cone and, if it is long, between two planes. The test errs on one side
only: a ray that is said not to meet a bound does not meet it.

>>> import numpy as np
>>> from mstfilter.simulation.solids import Bounds
>>> ball = Bounds(np.array([[0.0, 0, 1]]), np.array([[0.0, 0, 1]]), np.array([0.1]))
>>> ball.seen_from(np.zeros(3)).meet(np.array([[0.0, 0.05, 1.0], [0.5, 0.0, 1.0]], np.float32)).tolist()
[True, False]
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["Bounds", "Cones", "Piece", "box", "capsule", "cylinder", "ellipsoid", "frustum", "hull", "ring"]

# A voxel centre on the face that two pieces share must not fall between them.
TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Piece:
    """A convex solid in the frame of its body.

    Parameters
    ----------
    kind : {"box", "cylinder", "ellipsoid", "capsule", "hull"}
        Which solid.
    size : tuple of float
        Metres, MuJoCo's convention: half edges; radius and half height; half axes; radius and half
        length of the axis. Empty for a hull.
    centre : (3,) metres
        Where its own frame lies in the body.
    rotation : (3, 3)
        Columns are its own axes in the body.
    vertices : (n, 3) metres
        Of a hull, in its own frame.
    plain : bool
        Painted in one colour (a handle), not with the body's print.
    """

    kind: str
    size: tuple[float, ...]
    centre: np.ndarray
    rotation: np.ndarray
    vertices: np.ndarray | None = None
    plain: bool = False

    @cached_property
    def _hull(self) -> Any:  # scipy's ConvexHull, imported late
        from scipy.spatial import ConvexHull

        return ConvexHull(self.vertices)

    def inside(self, points: ArrayLike) -> np.ndarray:
        """(...) bool: points (..., 3) of the body's frame that lie in the solid or on its surface."""
        p = (np.asarray(points, dtype=np.float64) - self.centre) @ self.rotation
        if self.kind == "box":
            return (np.abs(p) <= np.array(self.size) + TOLERANCE).all(axis=-1)
        if self.kind == "cylinder":
            radius, half = self.size
            return (np.hypot(p[..., 0], p[..., 1]) <= radius + TOLERANCE) & (np.abs(p[..., 2]) <= half + TOLERANCE)
        if self.kind == "ellipsoid":
            return ((p / np.array(self.size)) ** 2).sum(axis=-1) <= 1.0 + TOLERANCE
        if self.kind == "capsule":
            radius, half = self.size
            p = p.copy()
            p[..., 2] -= np.clip(p[..., 2], -half, half)
            return (p**2).sum(axis=-1) <= radius**2 + TOLERANCE
        planes = self._hull.equations
        return (p @ planes[:, :3].T + planes[:, 3] <= TOLERANCE).all(axis=-1)

    @property
    def volume(self) -> float:
        """Cubic metres."""
        if self.kind == "box":
            return 8.0 * float(np.prod(self.size))
        if self.kind == "cylinder":
            return 2.0 * np.pi * self.size[0] ** 2 * self.size[1]
        if self.kind == "ellipsoid":
            return 4.0 / 3.0 * np.pi * float(np.prod(self.size))
        if self.kind == "capsule":
            return np.pi * self.size[0] ** 2 * (2.0 * self.size[1] + 4.0 / 3.0 * self.size[0])
        return float(self._hull.volume)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Minimum and maximum corner in the body's frame, exact but for hulls' rounding."""
        if self.kind == "hull":
            corners = self.vertices @ self.rotation.T + self.centre
            return corners.min(axis=0), corners.max(axis=0)
        r = self.rotation
        if self.kind == "box":
            reach = np.abs(r) @ np.array(self.size)
        elif self.kind == "ellipsoid":
            reach = np.sqrt((r**2) @ np.array(self.size) ** 2)
        elif self.kind == "capsule":
            reach = self.size[0] + np.abs(r[:, 2]) * self.size[1]
        else:
            reach = self.size[0] * np.sqrt(np.maximum(0.0, 1.0 - r[:, 2] ** 2)) + np.abs(r[:, 2]) * self.size[1]
        return self.centre - reach, self.centre + reach


def _piece(kind: str, size: tuple[float, ...], at: ArrayLike, rotation: ArrayLike | None, plain: bool) -> Piece:
    turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
    return Piece(kind, tuple(float(s) for s in size), np.asarray(at, dtype=np.float64), turn, None, plain)


def box(half: tuple[float, float, float], at: ArrayLike = (0, 0, 0), rotation: ArrayLike | None = None) -> Piece:
    """A box from its half edges."""
    return _piece("box", half, at, rotation, False)


def cylinder(radius: float, half_height: float, at: ArrayLike = (0, 0, 0)) -> Piece:
    """An upright cylinder."""
    return _piece("cylinder", (radius, half_height), at, None, False)


def ellipsoid(half: tuple[float, float, float], at: ArrayLike = (0, 0, 0)) -> Piece:
    """An ellipsoid from its half axes."""
    return _piece("ellipsoid", half, at, None, False)


def capsule(start: ArrayLike, end: ArrayLike, radius: float, plain: bool = False) -> Piece:
    """All points within `radius` of the segment from `start` to `end`."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    axis = end - start
    length = float(np.linalg.norm(axis))
    z = axis / length
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    return _piece("capsule", (radius, length / 2), (start + end) / 2, rotation, plain)


def hull(vertices: ArrayLike) -> Piece:
    """The convex hull of points (n, 3) of the body's frame."""
    vertices = np.asarray(vertices, dtype=np.float64)
    # An own frame near the centre keeps MuJoCo's re-centring of meshes well conditioned.
    centre = vertices.mean(axis=0)
    return Piece("hull", (), centre, np.eye(3), vertices - centre)


def frustum(lower: tuple[float, float], upper: tuple[float, float], sides: int = 32) -> Piece:
    """A cone's slice: (radius, z) below and above, as a prism of many sides."""
    angle = np.arange(sides) * (2.0 * np.pi / sides)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = [np.column_stack([r * circle, np.full(sides, z)]) for r, z in (lower, upper)]
    return hull(np.concatenate(rings))


def ring(profile: list[tuple[float, float, float]], sides: int = 20) -> list[Piece]:
    """A lathed wall as convex wedges.

    Parameters
    ----------
    profile : list of (inner radius, outer radius, z)
        Upwards; neighbouring entries bound one layer.
    sides : int
        Wedges around.
    """
    angle = np.arange(sides + 1) * (2.0 * np.pi / sides)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    wedges = []
    for low, high in pairwise(profile):
        for a, b in pairwise(circle):
            corners = [(*(r * c), z) for inner, outer, z in (low, high) for r in (inner, outer) for c in (a, b)]
            wedges.append(hull(corners))
    return wedges


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

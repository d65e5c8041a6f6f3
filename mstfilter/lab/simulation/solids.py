"""Convex pieces of objects.

A rigid object is a union of convex pieces. MuJoCo uses the pieces for collisions and ray casting. `Piece.inside`
tests points against the same pieces, so images and true volumes agree.

>>> from mstfilter.lab.simulation.solids import box
>>> box((0.02, 0.03, 0.04)).inside([[0.0, 0.0, 0.039], [0.0, 0.0, 0.041]]).tolist()
[True, False]
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

_TOLERANCE = 1e-9  # so that a voxel centre on the face that two pieces share lies in one of them


@dataclass(frozen=True, eq=False)
class Piece:
    """A convex solid in the frame of its body."""

    kind: str  #: {"box", "cylinder", "ellipsoid", "capsule", "hull"}: type of solid
    #: Metres, in MuJoCo's convention: half edges; radius and half height; half axes; radius and half length of the
    #: axis. Empty for a hull.
    size: tuple[float, ...]
    centre: np.ndarray  #: (3,) metres: origin of the piece's frame in the body
    rotation: np.ndarray  #: (3, 3) columns are the axes of the piece's frame in the body
    vertices: np.ndarray | None = None  #: (n, 3) metres: of a hull, in the piece's frame
    plain: bool = False  #: whether the piece has one colour (a handle) instead of the body's texture

    @cached_property
    def _hull(self) -> Any:
        from scipy.spatial import ConvexHull

        return ConvexHull(self.vertices)

    def inside(self, points: ArrayLike) -> np.ndarray:
        """(...) bool: whether points (..., 3) in body axes are in the solid or on the surface of the solid."""
        p = (np.asarray(points, dtype=np.float64) - self.centre) @ self.rotation
        if self.kind == "box":
            return (np.abs(p) <= np.array(self.size) + _TOLERANCE).all(axis=-1)
        if self.kind == "cylinder":
            radius, half = self.size
            return (np.hypot(p[..., 0], p[..., 1]) <= radius + _TOLERANCE) & (np.abs(p[..., 2]) <= half + _TOLERANCE)
        if self.kind == "ellipsoid":
            return ((p / np.array(self.size)) ** 2).sum(axis=-1) <= 1.0 + _TOLERANCE
        if self.kind == "capsule":
            radius, half = self.size
            p = p.copy()
            p[..., 2] -= np.clip(p[..., 2], -half, half)
            return (p**2).sum(axis=-1) <= radius**2 + _TOLERANCE
        planes = self._hull.equations
        return (p @ planes[:, :3].T + planes[:, 3] <= _TOLERANCE).all(axis=-1)

    @property
    def volume(self) -> float:
        """Volume in cubic metres."""
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
        """Minimum and maximum corner of a box in the body's frame that contains the piece.

        The box is the smallest, except for turned cylinders and ellipsoids.
        """
        if self.kind == "hull":
            corners = np.asarray(self.vertices) @ self.rotation.T + self.centre
            return corners.min(axis=0), corners.max(axis=0)
        if self.kind == "capsule":
            reach = self.size[0] + np.abs(self.rotation[:, 2]) * self.size[1]
        elif self.kind == "cylinder":
            reach = np.abs(self.rotation) @ np.array([self.size[0], *self.size])
        else:
            reach = np.abs(self.rotation) @ np.array(self.size)
        return self.centre - reach, self.centre + reach


def placed(piece: Piece, rotation: np.ndarray, position: np.ndarray, scale: float = 1.0) -> Piece:
    """The piece in a larger body, turned by `rotation` (3, 3) and shifted by `position` (3,)."""
    vertices = None if piece.vertices is None else piece.vertices * scale
    size, centre = tuple(scale * s for s in piece.size), rotation @ (scale * piece.centre) + position
    return Piece(piece.kind, size, centre, rotation @ piece.rotation, vertices, piece.plain)


def _upright(kind: str, size: tuple[float, ...], at: ArrayLike) -> Piece:
    return Piece(kind, tuple(float(s) for s in size), np.asarray(at, dtype=np.float64), np.eye(3))


def box(half: tuple[float, float, float], at: ArrayLike = (0, 0, 0)) -> Piece:
    """A box from its half edges."""
    return _upright("box", half, at)


def cylinder(radius: float, half_height: float, at: ArrayLike = (0, 0, 0)) -> Piece:
    """An upright cylinder."""
    return _upright("cylinder", (radius, half_height), at)


def perpendicular(z: np.ndarray) -> np.ndarray:
    """A unit vector (3,) at a right angle to a unit vector (3,)."""
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    return np.asarray(x / np.linalg.norm(x))


def ellipsoid(half: tuple[float, float, float]) -> Piece:
    """An ellipsoid from its half axes."""
    return _upright("ellipsoid", half, (0, 0, 0))


def capsule(start: ArrayLike, end: ArrayLike, radius: float, plain: bool = False) -> Piece:
    """All points within `radius` of the segment from `start` to `end`."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    axis = end - start
    length = float(np.linalg.norm(axis))
    z = axis / length
    x = perpendicular(z)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    return Piece("capsule", (float(radius), float(length / 2)), (start + end) / 2, rotation, None, plain)


def hull(vertices: ArrayLike) -> Piece:
    """The convex hull of points (n, 3) in the body's frame."""
    vertices = np.asarray(vertices, dtype=np.float64)
    # A frame near the centre keeps MuJoCo's re-centring of meshes well conditioned.
    centre = vertices.mean(axis=0)
    return Piece("hull", (), centre, np.eye(3), vertices - centre)


def _circle(sides: int) -> np.ndarray:
    """Points (sides + 1, 2) of the unit circle. The last point repeats the first point."""
    angle = np.arange(sides + 1) * (2.0 * np.pi / sides)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def frustum(lower: tuple[float, float], upper: tuple[float, float], sides: int = 32) -> Piece:
    """A frustum of a cone between two circles (radius, z), as a hull with `sides` side faces."""
    circle = _circle(sides)[:-1]
    rings = [np.column_stack([r * circle, np.full(sides, z)]) for r, z in (lower, upper)]
    return hull(np.concatenate(rings))


def ring(profile: list[tuple[float, float, float]], sides: int = 20) -> list[Piece]:
    """The wall of a solid of revolution as convex wedges, with `sides` wedges in each layer.

    The profile has (inner radius, outer radius, z) from bottom to top. Two neighbouring entries bound one layer.
    """
    circle = _circle(sides)
    wedges = []
    for low, high in pairwise(profile):
        for a, b in pairwise(circle):
            corners = [(*(r * c), z) for inner, outer, z in (low, high) for r in (inner, outer) for c in (a, b)]
            wedges.append(hull(corners))
    return wedges

"""Kinds of whole shapes, for the completer `posterior`.

A `ShapeKind` is a family of shapes in a bounding box: given the half edges of the box and a few numbers that say how
the shape fills it, it returns signed distances. The completer takes care of pose and size, so a kind of your own is
a class with one method:

>>> @dataclass(frozen=True)
... class Pyramid(ShapeKind):
...     def distance(self, half, shape, x):
...         share = 0.5 - 0.5 * x[2] / half[2]                 # 1 at the bottom, 0 at the top
...         sides = np.maximum(abs(x[0]) - half[0] * share, abs(x[1]) - half[1] * share)
...         return np.maximum(sides, abs(x[2]) - half[2])
>>> half, x = np.full((3, 1), 0.05), np.array([0.0, 0.0, -0.06])[:, None, None]
>>> float(Pyramid().distance(half, np.zeros((0, 1)), x)[0, 0])  # a point 1 cm below the bottom
0.01...

All arrays have one column for each candidate: `half` (3, n) in metres, `shape` (k, n) with values 0 .. 1, and the
points `x` (3, m, n) in the axes of the box, relative to its centre. The result is (m, n).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mstfilter.base.fields import Bounded, PositiveFloat

_LEAST_WALL, _WALLS = 0.002, 0.008  # metres: thinnest wall of a vessel, and how much thicker walls can be


@dataclass(frozen=True)
class ShapeKind(Bounded, ABC):
    """A family of shapes.

    Parameters
    ----------
    share : float
        Prior weight of the kind, relative to those of the others.
    """

    share: PositiveFloat = 1.0

    n_shape: ClassVar[int] = 0  #: numbers that say how a shape fills its box; a priori uniform on 0 .. 1
    #: Whether cross-sections are circles about the third axis. The third axis can then point anywhere; the shapes of
    #: other kinds stand on any side.
    round: ClassVar[bool] = False
    foot: ClassVar[float] = 1.0  #: width of what the shape stands on, as a share of the width of its box
    lies: ClassVar[float] = 1.0  #: how readily the shape lies on its side or leans, compared with a solid

    @abstractmethod
    def distance(self, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Signed distance (m, n) of points from the surface in metres, negative inside; exact near the surface."""

    def thickness(self, half: np.ndarray, shape: np.ndarray) -> np.ndarray:
        """Thickness (n,) of the thinnest wall or of the shape, metres."""
        return 2 * half.min(axis=0)

    def log_weight(self, half: np.ndarray, shape: np.ndarray) -> np.ndarray:
        """What you know of sizes and shapes besides what is seen: nats (n,) that a candidate gains. None by default.

        If all boxes on the table have edges of 8, 6 and 4 cm:

        >>> class MyBoxes(BoxKind):
        ...     def log_weight(self, half, shape):
        ...         off = np.sort(half, axis=0) - np.array([[0.02], [0.03], [0.04]])
        ...         return -0.5 * ((off / 0.002) ** 2).sum(axis=0)  # known to 2 mm
        """
        return np.zeros(half.shape[1], np.float32)


@dataclass(frozen=True)
class BoxKind(ShapeKind):
    """Boxes with rounded edges."""

    n_shape: ClassVar[int] = 1

    def distance(self, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        radius = np.maximum(shape[0] - 0.5, 0) * half.min(axis=0)  # half of the boxes have sharp edges
        a, b, c = (np.abs(x[k]) - (half[k] - radius) for k in range(3))
        inner = np.minimum(np.maximum(np.maximum(a, b), c), 0)
        for one in (a, b, c):
            np.maximum(one, 0, out=one)
        return np.asarray(np.sqrt(a * a + b * b + c * c) + inner - radius)


@dataclass(frozen=True)
class CylinderKind(ShapeKind):
    """Cylinders, standing, lying or leaning."""

    round: ClassVar[bool] = True

    def distance(self, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        return np.maximum(_radius(x) - half[0], np.abs(x[2]) - half[2])


@dataclass(frozen=True)
class ConeKind(ShapeKind):
    """Cones and frusta: one end has the full radius, the other one any smaller one."""

    round: ClassVar[bool] = True
    n_shape: ClassVar[int] = 1

    def distance(self, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        low, high = np.minimum(2 * shape[0], 1), np.minimum(2 - 2 * shape[0], 1)  # radii of the ends
        slope = half[0] * (high - low) / (2 * half[2])
        side = (_radius(x) - half[0] * (low + high) / 2 - slope * x[2]) / np.sqrt(1 + slope**2)
        return np.maximum(side, np.abs(x[2]) - half[2])


@dataclass(frozen=True)
class TurnedKind(ShapeKind):
    """Solids of revolution with four radii, such as bottles: linear between heights 0, 1/3, 2/3 and 1."""

    round: ClassVar[bool] = True
    n_shape: ClassVar[int] = 4

    def distance(self, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        radii = 0.25 + 0.75 * shape
        radii = half[0] * radii / radii.max(axis=0)
        height = (x[2] / half[2] + 1) * 1.5
        outline = sum(radii[k] * np.maximum(1 - np.abs(height - k), 0) for k in range(4))
        slope = np.abs(np.diff(radii, axis=0)).mean(axis=0) * 1.5 / half[2]
        side = (_radius(x) - outline) / np.sqrt(1 + slope**2)
        return np.maximum(side, np.abs(x[2]) - half[2])


@dataclass(frozen=True)
class EllipsoidKind(ShapeKind):
    """Ellipsoids."""

    foot: ClassVar[float] = 0.25

    def distance(self, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        first = second = 0.0
        for k in range(3):
            square = (x[k] / half[k]) ** 2
            first, second = first + square, second + square / half[k] ** 2
        length = np.sqrt(first)
        return np.asarray(length * (length - 1) / np.maximum(np.sqrt(second), 1e-6))


@dataclass(frozen=True)
class SuperquadricKind(ShapeKind):
    """Superquadrics with exponents of 2 to 8: from ellipsoids over cushions and discs to nearly boxes.

    The distance is that of first order, (F - 1) / |grad F| of a function F of degree 1 that is 1 on the surface. So
    points are scaled to a largest coordinate of 1, for which no power overflows, and F is scaled back.
    """

    n_shape: ClassVar[int] = 2

    def distance(self, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        p, q = (2 * 4 ** shape[k] for k in range(2))
        q = np.where(x[2] < 0, 8.0, q)  # what stands has a flat bottom
        scaled = [np.abs(x[k]) / half[k] for k in range(3)]
        largest = np.maximum(np.maximum.reduce(scaled), 1e-3)
        scaled = [np.maximum(one / largest, 1e-3) for one in scaled]
        a, b = _power(scaled[0], p), _power(scaled[1], p)
        across = a + b
        flat, tall = _power(across, q / p), _power(scaled[2], q)
        total = flat + tall
        f = _power(total, 1 / q)
        flat /= across
        slopes = (flat * a / (scaled[0] * half[0]), flat * b / (scaled[1] * half[1]), tall / (scaled[2] * half[2]))
        steep = np.sqrt(sum(one * one for one in slopes)) * f / total
        return np.asarray((largest * f - 1) / steep)


@dataclass(frozen=True)
class VesselKind(ShapeKind):
    """Open vessels with a wall of 2 to 10 mm: cups, bowls, plates and dishes; a tenth of them upside down.

    The radius grows from the bottom to the rim as height to a power of 1/3 to 1.
    """

    round: ClassVar[bool] = True
    n_shape: ClassVar[int] = 4
    lies: ClassVar[float] = 0.2

    def distance(self, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        wall, bottom = self.thickness(half, shape), 0.3 + 0.75 * shape[0]
        z = np.where(shape[3] > 0.9, -x[2], x[2])
        height = np.clip(0.5 + 0.5 * z / half[2], 0.02, 1)
        outline = half[0] * (bottom + (1 - bottom) * _power(height, 3 ** -shape[1]))
        slope = half[0] * (1 - bottom) / (2 * half[2])
        side = (_radius(x) - outline) / np.sqrt(1 + slope**2)
        cavity = np.maximum(side + wall, wall - half[2] - z)
        return np.maximum(np.maximum(side, np.abs(z) - half[2]), -cavity)

    def thickness(self, half: np.ndarray, shape: np.ndarray) -> np.ndarray:
        return np.minimum(_LEAST_WALL + _WALLS * shape[2], 0.9 * half.min(axis=0))


@dataclass(frozen=True)
class TrayKind(ShapeKind):
    """Rectangular open boxes with walls of 2 to 10 mm: trays, crates and baskets."""

    n_shape: ClassVar[int] = 1
    lies: ClassVar[float] = 0.0

    def distance(self, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        wall = self.thickness(half, shape)
        side = np.maximum(np.abs(x[0]) - half[0], np.abs(x[1]) - half[1])
        cavity = np.maximum(side + wall, wall - half[2] - x[2])
        return np.maximum(np.maximum(side, np.abs(x[2]) - half[2]), -cavity)

    def thickness(self, half: np.ndarray, shape: np.ndarray) -> np.ndarray:
        return np.minimum(_LEAST_WALL + _WALLS * shape[0], 0.9 * half.min(axis=0))


def _radius(x: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(x[0] * x[0] + x[1] * x[1]))


def _power(base: np.ndarray, exponent: np.ndarray) -> np.ndarray:
    return np.asarray(np.exp(exponent * np.log(base)))  # twice as fast as a power of float32

"""Similarities of particles in [0, 1], and classes of particles that count as equal.

>>> import numpy as np
>>> Gaussian(scale=1.0).matrix(np.array([0.0, 0.0, 3.0])).round(3)
array([[1.   , 1.   , 0.011],
       [1.   , 1.   , 0.011],
       [0.011, 0.011, 1.   ]])
>>> Bins(width=0.5).classes(np.array([0.1, 0.4, 0.6, -0.1]))
array([0, 0, 1, 2])

Diverse resamplers take a `Similarity`; `Coalesced` and `Kld` take an `Equivalence`. Subclass either for your own
particles; `mstfilter.fusion` has those of label grids.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.errors import InputError, check_number


class Similarity(ABC):
    """Similarity of particles."""

    @abstractmethod
    def matrix(self, particles: Any) -> np.ndarray:
        """(n, n) symmetric similarities in [0, 1], 1 on the diagonal. It need not be positive semidefinite."""


class Equivalence(ABC):
    """Classes of particles that count as equal."""

    @abstractmethod
    def classes(self, particles: Any) -> np.ndarray:
        """(n,) int: the class of each particle, numbered from 0 in the order of first occurrence."""


def first_seen(keys: Iterable[Hashable]) -> np.ndarray:
    """(n,) int: equal keys get equal numbers, counted from 0 in the order of first occurrence."""
    numbers: dict[Hashable, int] = {}
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.int64)


def as_matrix(particles: Any) -> np.ndarray:
    """(n, d) float64 rows of particles that are an array or a mapping of arrays; InputError for objects."""
    if isinstance(particles, np.ndarray) and particles.dtype != object:
        return np.asarray(particles, dtype=np.float64).reshape(len(particles), -1)
    if isinstance(particles, Mapping):
        return np.concatenate([as_matrix(np.asarray(a)) for _, a in sorted(particles.items())], axis=1)
    raise InputError(
        f"particles are {type(particles[0]).__name__} objects, expected an array or a mapping of arrays",
        "choose a similarity or equivalence for these objects, or write your own",
    )


@dataclass(frozen=True)
class Gaussian(Similarity):
    """exp(-d^2 / (2 scale^2)) with the Euclidean distance d of array particles; positive semidefinite.

    Parameters
    ----------
    scale : float
        Standard deviation of the kernel, in the units of the particles.
    """

    scale: float = 1.0

    def __post_init__(self) -> None:
        check_number("scale", self.scale, above=0, unit="distance")

    def matrix(self, particles: Any) -> np.ndarray:
        x = as_matrix(particles) / self.scale
        small = len(x) ** 2 * x.shape[1] < 1e7
        squares = ((x[:, None, :] - x[None, :, :]) ** 2).sum(axis=2) if small else _squared_distances(x)
        return np.exp(-0.5 * squares)


def _squared_distances(x: np.ndarray) -> np.ndarray:
    """(n, n) |x_i|^2 + |x_j|^2 - 2 x_i x_j, without an (n, n, d) array; centred to keep rounding errors small."""
    x = x - x.mean(axis=0)
    norms = (x * x).sum(axis=1)
    squares = np.maximum(norms[:, None] + norms[None, :] - 2 * (x @ x.T), 0.0)
    np.fill_diagonal(squares, 0.0)
    return (squares + squares.T) / 2


@dataclass(frozen=True)
class ExactEquality(Equivalence):
    """Equal values: rows of arrays bit for bit, objects by their ``==`` and hash."""

    def classes(self, particles: Any) -> np.ndarray:
        if isinstance(particles, np.ndarray) and particles.dtype != object:
            return first_seen(np.ascontiguousarray(row).tobytes() for row in particles)
        if isinstance(particles, Mapping):
            columns = [self.classes(np.asarray(a)) for a in particles.values()]
            return first_seen(zip(*(c.tolist() for c in columns), strict=True))
        return first_seen(particles)


@dataclass(frozen=True)
class Bins(Equivalence):
    """Array particles in the same cell of a regular grid.

    Parameters
    ----------
    width : float
        Side of a cell, in the units of the particles.
    """

    width: float = 1.0

    def __post_init__(self) -> None:
        check_number("width", self.width, above=0, unit="side of a cell")

    def classes(self, particles: Any) -> np.ndarray:
        cells = np.floor(as_matrix(particles) / self.width)
        _, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        rank = np.empty(len(first), np.int64)
        rank[np.argsort(first)] = np.arange(len(first))
        return rank[inverse.ravel()]

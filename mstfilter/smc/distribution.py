"""What a distribution over the values of particles is: `Distribution`, and how values are laid out in rows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from mstfilter.errors import InputError

__all__ = ["Distribution", "positive", "sum_rows", "value_shape"]


class Distribution(ABC):
    """A distribution over the values of particles."""

    #: Whether the values are whole numbers: a lookahead then stands on the mode, a move draws anew.
    discrete: ClassVar[bool] = False

    @abstractmethod
    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Values of `size` particles: (size,) or (size, d)."""

    @abstractmethod
    def log_prob(self, value: Any) -> np.ndarray:
        """(n,) log density (or probability) of each row; -inf outside of the support."""

    @property
    @abstractmethod
    def mean(self) -> np.ndarray:
        """Expected value, of the shape of the parameters."""

    @property
    @abstractmethod
    def sd(self) -> np.ndarray:
        """Standard deviation of each entry, of the shape of the parameters."""

    @property
    def centre(self) -> np.ndarray:
        """One value in place of a draw: the mean, or the mode of a discrete distribution."""
        return self.mean


def positive(what: str, value: Any) -> None:
    """A parameter that is one number must be positive; wrong rows of an array make weights NaN, which is an error."""
    if isinstance(value, (int, float)) and not 0 < value < np.inf:
        raise InputError(f"{what} is {value}, expected a positive number")


def value_shape(size: int, *parameters: Any) -> tuple[int, ...]:
    """Shape of `size` rows of values with these parameters."""
    plain = (size,)
    if all(np.shape(p) in ((), plain) for p in parameters):  # nearly always
        return plain
    inner: tuple[int, ...] = np.broadcast_shapes(*(np.shape(p) for p in parameters))
    rows = (size,) + (1,) * (len(inner) - 1)
    try:
        shape = np.broadcast_shapes(rows, inner)
    except ValueError:
        shape = (-1,)
    if shape[0] != size:
        raise InputError(
            f"parameters of shape {inner} do not fit {size} particles",
            f"give one row a particle, ({size}, ...), or write a vector that all share as (1, d)",
        )
    return shape


def sum_rows(log_prob: Any) -> np.ndarray:
    """Sum over all axes but the first: the entries of a row are independent."""
    out = np.asarray(log_prob)
    return out if out.ndim <= 1 else out.reshape(len(out), -1).sum(axis=1)

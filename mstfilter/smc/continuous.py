"""Continuous distributions: Normal, Student, Uniform, Gamma, MultivariateNormal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.distribution import Distribution, positive, sum_rows, value_shape

__all__ = ["Gamma", "MultivariateNormal", "Normal", "Student", "Uniform"]

_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


def _standardised(value: Any, loc: Any, scale: Any) -> np.ndarray:
    """(value - loc) / scale with one temporary array."""
    z = np.asarray(np.subtract(value, loc), dtype=np.float64)
    if z.ndim and isinstance(scale, float):
        z /= scale
        return z
    if z.ndim and np.ndim(scale) <= z.ndim and np.broadcast_shapes(z.shape, np.shape(scale)) == z.shape:
        np.divide(z, scale, out=z)
        return z
    return z / scale


@dataclass(frozen=True, eq=False)
class Normal(Distribution):
    """Gaussian.

    Parameters
    ----------
    loc, scale : array_like
        Mean and standard deviation (> 0).
    """

    loc: Any = 0.0
    scale: Any = 1.0

    def __post_init__(self) -> None:
        positive("scale of a Normal", self.scale)

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw."""
        z = rng.standard_normal(value_shape(size, self.loc, self.scale))
        z *= self.scale
        z += self.loc
        return z

    def log_prob(self, value: Any) -> np.ndarray:
        """Log density."""
        z = _standardised(value, self.loc, self.scale)
        if isinstance(self.scale, float) and z.ndim:
            z *= z
            z *= -0.5
            z -= math.log(self.scale) + _HALF_LOG_2PI
            return sum_rows(z)
        return sum_rows(-0.5 * (z * z) - (np.log(self.scale) + _HALF_LOG_2PI))

    @property
    def mean(self) -> np.ndarray:
        """Mean."""
        return np.broadcast_arrays(np.asarray(self.loc, np.float64), self.scale)[0]

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation."""
        return np.broadcast_arrays(np.asarray(self.scale, np.float64), self.loc)[0]


@dataclass(frozen=True, eq=False)
class Student(Distribution):
    """Student's t, shifted and scaled.

    Parameters
    ----------
    df : array_like
        Degrees of freedom (> 0).
    loc, scale : array_like
        Centre and scale (> 0); the standard deviation is larger, and infinite for df <= 2.
    """

    df: Any
    loc: Any = 0.0
    scale: Any = 1.0

    def __post_init__(self) -> None:
        positive("df of a Student", self.df)
        positive("scale of a Student", self.scale)

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw."""
        return self.loc + self.scale * rng.standard_t(self.df, value_shape(size, self.df, self.loc, self.scale))

    def log_prob(self, value: Any) -> np.ndarray:
        """Log density."""
        from scipy.special import gammaln

        z, df = _standardised(value, self.loc, self.scale), np.asarray(self.df, dtype=np.float64)
        constant = gammaln((df + 1) / 2) - gammaln(df / 2) - 0.5 * np.log(df * np.pi) - np.log(self.scale)
        return sum_rows(constant - (df + 1) / 2 * np.log1p(z * z / df))

    @property
    def mean(self) -> np.ndarray:
        """Centre (the mean where df > 1)."""
        return np.broadcast_arrays(np.asarray(self.loc, np.float64), self.scale, self.df)[0]

    @property
    def sd(self) -> np.ndarray:
        """Scale: what a step of a move is measured by (the standard deviation may be infinite)."""
        return np.broadcast_arrays(np.asarray(self.scale, np.float64), self.loc, self.df)[0]


@dataclass(frozen=True, eq=False)
class Uniform(Distribution):
    """Uniform on [low, high).

    Parameters
    ----------
    low, high : array_like
        Ends, low < high.
    """

    low: Any = 0.0
    high: Any = 1.0

    def __post_init__(self) -> None:
        if isinstance(self.low, (int, float)) and isinstance(self.high, (int, float)):
            positive(f"width of a Uniform from {self.low} to {self.high}", self.high - self.low)

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw."""
        u = rng.random(value_shape(size, self.low, self.high))
        return self.low + (np.asarray(self.high) - self.low) * u

    def log_prob(self, value: Any) -> np.ndarray:
        """Log density."""
        x = np.asarray(value)
        inside = (x >= self.low) & (x < self.high)
        return sum_rows(np.where(inside, -np.log(np.asarray(self.high) - self.low), -np.inf))

    @property
    def mean(self) -> np.ndarray:
        """Midpoint."""
        return (np.asarray(self.low, np.float64) + self.high) / 2

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation."""
        return (np.asarray(self.high, np.float64) - self.low) / math.sqrt(12)


@dataclass(frozen=True, eq=False)
class Gamma(Distribution):
    """Gamma by shape and rate.

    Parameters
    ----------
    shape, rate : array_like
        Both > 0; the mean is shape / rate.
    """

    shape: Any
    rate: Any = 1.0

    def __post_init__(self) -> None:
        positive("shape of a Gamma", self.shape)
        positive("rate of a Gamma", self.rate)

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw."""
        return rng.standard_gamma(self.shape, value_shape(size, self.shape, self.rate)) / self.rate

    def log_prob(self, value: Any) -> np.ndarray:
        """Log density."""
        from scipy.special import gammaln, xlogy

        x, a = np.asarray(value, dtype=np.float64), np.asarray(self.shape, dtype=np.float64)
        safe = np.where(x >= 0, x, 1.0)
        inside = xlogy(a, self.rate) + xlogy(a - 1, safe) - self.rate * safe - gammaln(a)
        return sum_rows(np.where(x >= 0, inside, -np.inf))

    @property
    def mean(self) -> np.ndarray:
        """Mean."""
        return np.asarray(self.shape, np.float64) / self.rate

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation."""
        return np.sqrt(np.asarray(self.shape, np.float64)) / self.rate


@dataclass(frozen=True, eq=False)
class MultivariateNormal(Distribution):
    """Gaussian vectors.

    Parameters
    ----------
    loc : (d,) or (n, d) array_like
        Mean, one for all particles or one each.
    cov : (d, d) or (n, d, d) array_like
        Covariance, positive definite.
    """

    loc: Any
    cov: Any

    def __post_init__(self) -> None:
        try:
            root = np.linalg.cholesky(np.asarray(self.cov, dtype=np.float64))
        except np.linalg.LinAlgError:
            raise InputError(f"covariance is not positive definite: {np.asarray(self.cov).tolist()}"[:300]) from None
        object.__setattr__(self, "_root", root)

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw (size, d)."""
        root = self.__dict__["_root"]
        z = rng.standard_normal((size, root.shape[-1]))
        return self.loc + (z @ root.T if root.ndim == 2 else np.einsum("nij,nj->ni", root, z))

    def log_prob(self, value: Any) -> np.ndarray:
        """Log density."""
        root = self.__dict__["_root"]
        d = root.shape[-1]
        r = np.asarray(value, dtype=np.float64) - self.loc
        log_det = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
        if root.ndim == 2:
            from scipy.linalg import solve_triangular

            z = solve_triangular(root, r.T if r.ndim == 2 else r, lower=True, check_finite=False)
            return -0.5 * (z * z).sum(axis=0) - log_det - d * _HALF_LOG_2PI
        z = np.linalg.solve(root, np.broadcast_to(r, root.shape[:-1])[..., None])[..., 0]
        return -0.5 * (z * z).sum(axis=-1) - log_det - d * _HALF_LOG_2PI

    @property
    def mean(self) -> np.ndarray:
        """Mean."""
        return np.asarray(self.loc, np.float64)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of each entry."""
        root = self.__dict__["_root"]
        return np.broadcast_arrays(np.sqrt((root * root).sum(axis=-1)), self.mean)[0]

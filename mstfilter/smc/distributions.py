"""Distributions for models, drawn and evaluated for all particles together.

>>> import numpy as np
>>> rng = np.random.default_rng(0)
>>> x = Normal(np.zeros(5), 2.0).sample(rng, 5)          # one row per particle
>>> Normal(x, 1.0).log_prob(0.3).shape
(5,)

The first axis is that of the particles. Parameters of shape () or (n,) give values (n,); parameters (1, d) or (n, d)
give values (n, d), whose entries are independent and whose log densities are summed. `log_prob` is always (n,), or a
number if nothing has rows. Frozen distributions of scipy.stats and objects of torch.distributions can be used in
place of these (`as_distribution`); these take a third to a sixth of their time.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mstfilter.errors import InputError

_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


class Distribution(ABC):
    """A distribution over the values of particles."""

    @property
    def discrete(self) -> bool:
        """Whether the values are integers: a lookahead then uses the mode, a move draws new values."""
        return False

    @abstractmethod
    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Values of `size` particles: (size,) or (size, d)."""

    @abstractmethod
    def log_prob(self, value: Any) -> np.ndarray:
        """(n,) log density or probability of each row; -inf outside the support."""

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
        """The mean, or the mode of a discrete distribution; a lookahead uses it instead of a draw."""
        return self.mean


def _check_positive(what: str, value: Any) -> None:
    """Check a parameter that is one number; invalid rows of an array make weights NaN, which is an error later."""
    if isinstance(value, (int, float)) and not 0 < value < np.inf:
        raise InputError(f"{what} is {value}, expected a positive number")


def _value_shape(size: int, *parameters: Any) -> tuple[int, ...]:
    """Shape of `size` rows of values with these parameters."""
    plain = (size,)
    if all(np.shape(p) in ((), plain) for p in parameters):  # the usual case
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
            f"give one row per particle, ({size}, ...), or write a vector shared by all as (1, d)",
        )
    return shape


def sum_rows(log_prob: Any) -> np.ndarray:
    """Sum over all axes but the first: the entries of a row are independent."""
    out = np.asarray(log_prob)
    return out if out.ndim <= 1 else out.reshape(len(out), -1).sum(axis=1)


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
    """Gaussian with mean `loc` and standard deviation `scale` > 0."""

    loc: Any = 0.0
    scale: Any = 1.0

    def __post_init__(self) -> None:
        _check_positive("scale of a Normal", self.scale)

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        z = rng.standard_normal(_value_shape(size, self.loc, self.scale))
        z *= self.scale
        z += self.loc
        return z

    def log_prob(self, value: Any) -> np.ndarray:
        z = _standardised(value, self.loc, self.scale)
        if isinstance(self.scale, float) and z.ndim:
            z *= z
            z *= -0.5
            z -= math.log(self.scale) + _HALF_LOG_2PI
            return sum_rows(z)
        return sum_rows(-0.5 * (z * z) - (np.log(self.scale) + _HALF_LOG_2PI))

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_arrays(np.asarray(self.loc, np.float64), self.scale)[0]

    @property
    def sd(self) -> np.ndarray:
        return np.broadcast_arrays(np.asarray(self.scale, np.float64), self.loc)[0]


@dataclass(frozen=True, eq=False)
class Student(Distribution):
    """Student's t with `df` > 0 degrees of freedom, centre `loc` and scale `scale` > 0.

    The standard deviation is larger than the scale, and infinite for df <= 2.
    """

    df: Any
    loc: Any = 0.0
    scale: Any = 1.0

    def __post_init__(self) -> None:
        _check_positive("df of a Student", self.df)
        _check_positive("scale of a Student", self.scale)

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        return self.loc + self.scale * rng.standard_t(self.df, _value_shape(size, self.df, self.loc, self.scale))

    def log_prob(self, value: Any) -> np.ndarray:
        from scipy.special import gammaln

        z, df = _standardised(value, self.loc, self.scale), np.asarray(self.df, dtype=np.float64)
        constant = gammaln((df + 1) / 2) - gammaln(df / 2) - 0.5 * np.log(df * np.pi) - np.log(self.scale)
        return sum_rows(constant - (df + 1) / 2 * np.log1p(z * z / df))

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_arrays(np.asarray(self.loc, np.float64), self.scale, self.df)[0]

    @property
    def sd(self) -> np.ndarray:
        """Scale, as unit of the steps of moves (the standard deviation may be infinite)."""
        return np.broadcast_arrays(np.asarray(self.scale, np.float64), self.loc, self.df)[0]


@dataclass(frozen=True, eq=False)
class Uniform(Distribution):
    """Uniform on [low, high)."""

    low: Any = 0.0
    high: Any = 1.0

    def __post_init__(self) -> None:
        if isinstance(self.low, (int, float)) and isinstance(self.high, (int, float)):
            _check_positive(f"width of a Uniform from {self.low} to {self.high}", self.high - self.low)

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        u = rng.random(_value_shape(size, self.low, self.high))
        return self.low + (np.asarray(self.high) - self.low) * u

    def log_prob(self, value: Any) -> np.ndarray:
        x = np.asarray(value)
        inside = (x >= self.low) & (x < self.high)
        return sum_rows(np.where(inside, -np.log(np.asarray(self.high) - self.low), -np.inf))

    @property
    def mean(self) -> np.ndarray:
        return (np.asarray(self.low, np.float64) + self.high) / 2

    @property
    def sd(self) -> np.ndarray:
        return (np.asarray(self.high, np.float64) - self.low) / math.sqrt(12)


@dataclass(frozen=True, eq=False)
class Gamma(Distribution):
    """Gamma with `shape` > 0 and `rate` > 0; the mean is shape / rate."""

    shape: Any
    rate: Any = 1.0

    def __post_init__(self) -> None:
        _check_positive("shape of a Gamma", self.shape)
        _check_positive("rate of a Gamma", self.rate)

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        return rng.standard_gamma(self.shape, _value_shape(size, self.shape, self.rate)) / self.rate

    def log_prob(self, value: Any) -> np.ndarray:
        from scipy.special import gammaln, xlogy

        x, a = np.asarray(value, dtype=np.float64), np.asarray(self.shape, dtype=np.float64)
        safe = np.where(x >= 0, x, 1.0)
        inside = xlogy(a, self.rate) + xlogy(a - 1, safe) - self.rate * safe - gammaln(a)
        return sum_rows(np.where(x >= 0, inside, -np.inf))

    @property
    def mean(self) -> np.ndarray:
        return np.asarray(self.shape, np.float64) / self.rate

    @property
    def sd(self) -> np.ndarray:
        return np.sqrt(np.asarray(self.shape, np.float64)) / self.rate


@dataclass(frozen=True, eq=False)
class MultivariateNormal(Distribution):
    """Gaussian vectors.

    Parameters
    ----------
    loc : (d,) or (n, d) array_like
        Mean, one for all particles or one for each.
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
        root = self.__dict__["_root"]
        z = rng.standard_normal((size, root.shape[-1]))
        return self.loc + (z @ root.T if root.ndim == 2 else np.einsum("nij,nj->ni", root, z))

    def log_prob(self, value: Any) -> np.ndarray:
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
        return np.asarray(self.loc, np.float64)

    @property
    def sd(self) -> np.ndarray:
        root = self.__dict__["_root"]
        return np.broadcast_arrays(np.sqrt((root * root).sum(axis=-1)), self.mean)[0]


@dataclass(frozen=True, eq=False)
class Poisson(Distribution):
    """Poisson counts with mean `rate` >= 0."""

    rate: Any
    discrete: ClassVar[bool] = True

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        return rng.poisson(self.rate, _value_shape(size, self.rate))

    def log_prob(self, value: Any) -> np.ndarray:
        from scipy.special import gammaln, xlogy

        k = np.asarray(value, dtype=np.float64)
        valid = (k >= 0) & (k == np.floor(k))
        safe = np.where(valid, k, 0.0)
        return sum_rows(np.where(valid, xlogy(safe, self.rate) - gammaln(safe + 1) - self.rate, -np.inf))

    @property
    def mean(self) -> np.ndarray:
        return np.asarray(self.rate, np.float64)

    @property
    def sd(self) -> np.ndarray:
        return np.sqrt(self.mean)

    @property
    def centre(self) -> np.ndarray:
        return np.floor(self.mean).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Bernoulli(Distribution):
    """Booleans, True with probability `p`."""

    p: Any
    discrete: ClassVar[bool] = True

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        return rng.random(_value_shape(size, self.p)) < self.p

    def log_prob(self, value: Any) -> np.ndarray:
        x = np.asarray(value)
        with np.errstate(divide="ignore"):
            log_p = np.where(x.astype(bool), np.log(self.p), np.log1p(-np.asarray(self.p)))
        return sum_rows(np.where((x == 0) | (x == 1), log_p, -np.inf))

    @property
    def mean(self) -> np.ndarray:
        return np.asarray(self.p, np.float64)

    @property
    def sd(self) -> np.ndarray:
        return np.sqrt(self.mean * (1 - self.mean))

    @property
    def centre(self) -> np.ndarray:
        return np.asarray(self.p) > 0.5


@dataclass(frozen=True, eq=False)
class Categorical(Distribution):
    """One of k categories, numbered from 0.

    Parameters
    ----------
    probs : (k,) or (n, k) array_like
        Non-negative; rows are scaled to sum to one.
    """

    probs: Any
    discrete: ClassVar[bool] = True

    def __post_init__(self) -> None:
        p = np.asarray(self.probs, dtype=np.float64)
        total = p.sum(axis=-1, keepdims=True) if p.ndim else np.zeros(1)
        if p.ndim not in (1, 2) or not (total > 0).all() or not (p >= 0).all() or not np.isfinite(total).all():
            raise InputError(
                f"probabilities of a categorical have shape {p.shape} and totals {np.unique(total)[:3].tolist()}, "
                "expected (k,) or (n, k), none negative, none all zero"
            )
        object.__setattr__(self, "probs", p / total)

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw; a category of probability zero is never drawn."""
        u = rng.random(size)
        cumulative = np.cumsum(self.probs, axis=-1)
        if self.probs.ndim == 1:
            index = np.searchsorted(cumulative, u * cumulative[-1], side="right")
            last = np.flatnonzero(self.probs)[-1]
            return np.minimum(index, last)
        if len(self.probs) not in (1, size):
            raise InputError(f"{len(self.probs)} rows of probabilities do not fit {size} particles")
        index = (cumulative <= (u * cumulative[:, -1])[:, None]).sum(axis=1)
        last = self.probs.shape[1] - 1 - np.argmax(self.probs[:, ::-1] > 0, axis=1)
        return np.minimum(index, last)

    def log_prob(self, value: Any) -> np.ndarray:
        k = np.asarray(value)
        index = np.clip(k, 0, self.probs.shape[-1] - 1).astype(np.int64)
        with np.errstate(divide="ignore"):
            log_p = np.log(self.probs)
        if self.probs.ndim == 1:
            picked = log_p[index]
        else:
            picked = log_p[np.arange(len(log_p)) if len(log_p) > 1 or index.ndim == 0 else 0, index]
        return np.where(index == k, picked, -np.inf)

    @property
    def mean(self) -> np.ndarray:
        return self.probs @ np.arange(self.probs.shape[-1], dtype=np.float64)

    @property
    def sd(self) -> np.ndarray:
        numbers = np.arange(self.probs.shape[-1], dtype=np.float64)
        return np.sqrt(np.maximum(self.probs @ numbers**2 - self.mean**2, 0.0))

    @property
    def centre(self) -> np.ndarray:
        return np.argmax(self.probs, axis=-1)

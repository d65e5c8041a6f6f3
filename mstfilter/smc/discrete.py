"""Discrete distributions: Poisson, Bernoulli, Categorical."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.distribution import Distribution, sum_rows, value_shape

__all__ = ["Bernoulli", "Categorical", "Poisson"]


@dataclass(frozen=True, eq=False)
class Poisson(Distribution):
    """Counts.

    Parameters
    ----------
    rate : array_like
        Mean (>= 0).
    """

    rate: Any
    discrete: ClassVar[bool] = True

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw."""
        return rng.poisson(self.rate, value_shape(size, self.rate))

    def log_prob(self, value: Any) -> np.ndarray:
        """Log probability."""
        from scipy.special import gammaln, xlogy

        k = np.asarray(value, dtype=np.float64)
        whole = (k >= 0) & (k == np.floor(k))
        safe = np.where(whole, k, 0.0)
        return sum_rows(np.where(whole, xlogy(safe, self.rate) - gammaln(safe + 1) - self.rate, -np.inf))

    @property
    def mean(self) -> np.ndarray:
        """Mean."""
        return np.asarray(self.rate, np.float64)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation."""
        return np.sqrt(self.mean)

    @property
    def centre(self) -> np.ndarray:
        """The mode."""
        return np.floor(self.mean).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Bernoulli(Distribution):
    """True with probability `p`; values are booleans.

    Parameters
    ----------
    p : array_like
        In [0, 1].
    """

    p: Any
    discrete: ClassVar[bool] = True

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw."""
        return rng.random(value_shape(size, self.p)) < self.p

    def log_prob(self, value: Any) -> np.ndarray:
        """Log probability."""
        x = np.asarray(value)
        with np.errstate(divide="ignore"):
            log_p = np.where(x.astype(bool), np.log(self.p), np.log1p(-np.asarray(self.p)))
        return sum_rows(np.where((x == 0) | (x == 1), log_p, -np.inf))

    @property
    def mean(self) -> np.ndarray:
        """Probability of True."""
        return np.asarray(self.p, np.float64)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation."""
        return np.sqrt(self.mean * (1 - self.mean))

    @property
    def centre(self) -> np.ndarray:
        """The mode."""
        return np.asarray(self.p) > 0.5


@dataclass(frozen=True, eq=False)
class Categorical(Distribution):
    """One of k categories, numbered from 0.

    Parameters
    ----------
    probs : (k,) or (n, k) array_like
        Probabilities; not negative, rows are scaled to sum to one.
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
        """Draw; a category of probability zero is never chosen."""
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
        """Log probability."""
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
        """Mean category number (rarely of use: see `centre`)."""
        return self.probs @ np.arange(self.probs.shape[-1], dtype=np.float64)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of the category number."""
        numbers = np.arange(self.probs.shape[-1], dtype=np.float64)
        return np.sqrt(np.maximum(self.probs @ numbers**2 - self.mean**2, 0.0))

    @property
    def centre(self) -> np.ndarray:
        """The most probable category."""
        return np.argmax(self.probs, axis=-1)

"""Distributions of scipy.stats and torch.distributions as distributions of this package.

>>> from scipy import stats
>>> as_distribution(stats.norm(0.0, 2.0)).sample(np.random.default_rng(0), 3).shape
(3,)

Neither library is imported here: an object is recognised by the module of its class. torch draws from a global
generator, so torch distributions are drawn by their inverse distribution function at uniforms of our generator, and
categorical and Bernoulli ones, which have no inverse, from their probabilities.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.distributions import Bernoulli, Categorical, Distribution, Poisson, sum_rows


def as_distribution(value: Any) -> Distribution:
    """Convert a distribution of this package, of scipy.stats (frozen or new style) or of torch.

    Raises
    ------
    InputError
        If `value` is not a distribution.
    """
    if isinstance(value, Distribution):
        return value
    module = type(value).__module__
    if module.startswith("scipy.stats"):
        return FromScipy(value)
    if module.startswith("torch.distributions"):
        return _from_torch(value)
    raise InputError(
        f"expected a distribution, found a {type(value).__module__}.{type(value).__qualname__}",
        "use one of mstfilter.smc, a frozen one of scipy.stats, or one of torch.distributions",
        "or subclass mstfilter.smc.Distribution",
    )


@dataclass(frozen=True, eq=False)
class FromScipy(Distribution):
    """A frozen distribution of scipy.stats, uni- or multivariate, or one of its new style (``stats.Normal``).

    Parameters
    ----------
    wrapped : object
        The distribution; array parameters have one row per particle.
    """

    wrapped: Any

    @cached_property
    def discrete(self) -> bool:
        """Whether it has probabilities instead of a density."""
        return "pmf" in dir(self.wrapped) and "discrete" in type(self.wrapped).__name__

    @cached_property
    def _is_multivariate(self) -> bool:
        return type(self.wrapped).__module__.endswith("_multivariate")

    @cached_property
    def _new_style(self) -> bool:
        return not type(self.wrapped).__module__.endswith(("_multivariate", "_distn_infrastructure"))

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        wrapped = self.wrapped
        if self._is_multivariate:
            return np.reshape(wrapped.rvs(size=size, random_state=rng), (size, -1))
        inner = np.shape(wrapped.mean())
        _check_rows(inner, size)
        if self._new_style:  # its shape is added to that of the parameters
            has_rows = bool(inner) and inner[0] == size
            drawn = np.asarray(wrapped.sample(() if has_rows else (size,), rng=rng))
            return drawn if has_rows or not inner else drawn[:, 0]
        return np.asarray(wrapped.rvs(size=(size, *inner[1:]), random_state=rng))

    def log_prob(self, value: Any) -> np.ndarray:
        wrapped = self.wrapped
        if self._is_multivariate:
            return np.asarray(wrapped.logpdf(value))
        return sum_rows(wrapped.logpmf(value) if self.discrete else wrapped.logpdf(value))

    @property
    def mean(self) -> np.ndarray:
        mean = self.wrapped.mean
        return np.asarray(mean() if callable(mean) else mean)

    @property
    def sd(self) -> np.ndarray:
        wrapped = self.wrapped
        if self._is_multivariate:
            return np.sqrt(np.diagonal(wrapped.cov))
        return np.asarray(wrapped.standard_deviation() if self._new_style else wrapped.std())

    @property
    def centre(self) -> np.ndarray:
        """Mean, or the median of a discrete one."""
        return np.asarray(self.wrapped.median()) if self.discrete else self.mean


def _check_rows(inner: tuple[int, ...], size: int) -> None:
    if inner and inner[0] not in (1, size):
        raise InputError(f"parameters of shape {inner} do not fit {size} particles")


def _from_torch(value: Any) -> Distribution:
    name = type(value).__name__
    if name == "Categorical":
        return Categorical(value.probs.detach().numpy())
    if name == "Bernoulli":
        return Bernoulli(value.probs.detach().numpy())
    if name == "Poisson":
        return Poisson(value.rate.detach().numpy())
    return FromTorch(value)


@dataclass(frozen=True, eq=False)
class FromTorch(Distribution):
    """A continuous distribution of torch, drawn as ``icdf(u)`` in double precision.

    Parameters
    ----------
    wrapped : torch.distributions.Distribution
        Parameters have one row per particle, or no rows.
    """

    wrapped: Any

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        import torch

        inner = tuple(self.wrapped.batch_shape)
        _check_rows(inner, size)
        u = rng.random((size, *inner[1:]))
        np.clip(u, 2.0**-54, None, out=u)  # 0 would be -inf
        try:
            return self.wrapped.icdf(torch.from_numpy(u)).numpy()
        except NotImplementedError:
            raise InputError(
                f"torch's {type(self.wrapped).__name__} has no icdf, so it cannot be drawn reproducibly",
                "use the one of mstfilter.smc or of scipy.stats",
            ) from None

    def log_prob(self, value: Any) -> np.ndarray:
        import torch

        found = self.wrapped.log_prob(torch.as_tensor(np.ascontiguousarray(value)))
        return sum_rows(found.detach().numpy().astype(np.float64))

    @property
    def mean(self) -> np.ndarray:
        return np.asarray(self.wrapped.mean)

    @property
    def sd(self) -> np.ndarray:
        return np.asarray(self.wrapped.stddev)

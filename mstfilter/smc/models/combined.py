"""Distributions made of others: mixtures, truncated ones, and products of independent ones.

A mixture draws from one of its components, chosen by weight, and has the density sum_k w_k p_k(x). A truncated
distribution is the base, given that the value lies between two bounds: p(x) / (F(high) - F(low)). A product is a
vector of independent entries, whose log densities add up:

>>> import numpy as np
>>> from mstfilter.smc import Gamma, Mixture, Normal, Product, Truncated
>>> heavy = Mixture([0.95, 0.05], [Normal(0.0, 1.0), Normal(0.0, 10.0)])        # one reading in twenty is an outlier
>>> positive = Truncated(Normal(0.0, 1.0), low=0.0)
>>> float(np.exp(positive.log_prob(0.5) - Normal(0.0, 1.0).log_prob(0.5)).round(6))       # half of the mass is left
2.0
>>> vectors = Product([Normal(0.0, 1.0), Gamma(2.0, 0.5)])                      # of two independent entries
>>> vectors.sample(np.random.default_rng(0), 3).shape, round(float(vectors.log_prob([0.5, 1.0])), 3)
((3, 2), -1.658)

The parts are distributions of this package or frozen ones of scipy.stats. Their parameters may have one row per
particle, as may the weights of a mixture and the bounds of a truncated distribution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.smc.interfaces import Distribution
from mstfilter.smc.models.distributions import (
    Categorical,
    FromScipy,
    Normal,
    Student,
    Uniform,
    _broadcast_shape,
    as_distribution,
)
from mstfilter.smc.models.families import Beta, Binomial, Gamma, LogNormal, Poisson


@dataclass(frozen=True, eq=False)
class Mixture(Distribution):
    """One of k distributions, chosen with probabilities `weights` (k,) or (n, k), which are scaled to sum to 1.

    The `components` have one event shape. Whether they are discrete or continuous must agree.
    """

    weights: Any
    components: Any

    def __post_init__(self) -> None:
        components = tuple(map(as_distribution, self.components))
        object.__setattr__(self, "components", components)
        object.__setattr__(self, "_choice", Categorical(self.weights))
        kinds, events = ({getattr(c, name) for c in components} for name in ("discrete", "event_shape"))
        if len(components) != np.shape(self.weights)[-1] or len(kinds) != 1 or len(events) != 1:
            raise InputError(
                f"{np.shape(self.weights)[-1]} weights and {len(components)} components with event shapes "
                f"{sorted(events)}, discrete {sorted(kinds)}: expected as many weights, and components of one kind"
            )
        object.__setattr__(self, "discrete", kinds.pop())
        object.__setattr__(self, "draws_numbers", all(c.draws_numbers for c in components))

    @property
    def parameter_shape(self) -> tuple[int, ...]:
        rows = self.__dict__["_choice"].parameter_shape
        event = self.components[0].event_shape
        shapes = [c.parameter_shape for c in self.components]
        return _broadcast_shape(*(np.empty(s) for s in (*shapes, (*rows, *(1,) * len(event)) if rows else ())))

    def check_parameters(self) -> None:
        for part in (self.__dict__["_choice"], *self.components):
            part.check_parameters()

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        chosen = self.__dict__["_choice"].sample(rng, size)
        drawn = np.stack([c.sample(rng, size) for c in self.components])
        return drawn[chosen, np.arange(size)]

    def log_prob(self, value: Any) -> np.ndarray:
        found = [c.log_prob(value) for c in self.components]
        with np.errstate(divide="ignore"):
            logs = np.log(np.moveaxis(self.__dict__["_choice"].probs, -1, 0))
        return reduce(np.logaddexp, [log_w + log_p for log_w, log_p in zip(logs, found, strict=True)])

    @property
    def mean(self) -> np.ndarray:
        choice, shape = self.__dict__["_choice"], self.parameter_shape
        weights = choice.probs.reshape(*choice.parameter_shape, *(1,) * (len(shape) - 1), -1)
        means = np.stack([np.broadcast_to(c.mean, shape) for c in self.components], axis=-1)
        return (weights * means).sum(axis=-1)


#: The family of scipy.stats that has the distribution functions of a class, and its parameters.
_IN_SCIPY: dict[type, Callable[[Any], tuple[str, tuple[Any, ...]]]] = {
    Normal: lambda d: ("norm", (d.loc, d.scale)),
    Student: lambda d: ("t", (d.df, d.loc, d.scale)),
    Uniform: lambda d: ("uniform", (d.low, np.subtract(d.high, d.low))),
    Gamma: lambda d: ("gamma", (d.shape, 0.0, d.scale)),
    LogNormal: lambda d: ("lognorm", (d.scale, 0.0, np.exp(d.loc))),
    Beta: lambda d: ("beta", (d.a, d.b, 0.0, 1.0)),
    Poisson: lambda d: ("poisson", (d.rate, 0.0)),
    Binomial: lambda d: ("binom", (d.n, d.p, 0.0)),
}


@dataclass(frozen=True, eq=False)
class Truncated(Distribution):
    """A distribution of numbers, given that the value lies between `low` and `high`, both included.

    `base` is a Normal, Student, Uniform, Gamma, LogNormal, Beta, Poisson or Binomial, or a frozen univariate
    distribution of scipy.stats. Draws are exact: they invert the distribution function, from the side on which it is
    accurate. Bounds that leave a probability of 0 raise InputError when values are drawn, and give a log density of
    NaN.
    """

    base: Any
    low: Any = -np.inf
    high: Any = np.inf

    def __post_init__(self) -> None:
        import scipy.stats

        base = as_distribution(self.base)
        if isinstance(base, FromScipy) and hasattr(base.wrapped, "dist"):
            family, given = base.wrapped.dist, (base.wrapped.args, base.wrapped.kwds)
        elif type(base) in _IN_SCIPY:
            name, given_values = _IN_SCIPY[type(base)](base)
            family, given = getattr(scipy.stats, name), (given_values, {})
        else:
            raise InputError(
                f"a {type(base).__name__} cannot be truncated: its distribution function is not known",
                "truncate a distribution of numbers, such as Normal, or the parts of a mixture",
            )
        for name, value in {"base": base, "discrete": base.discrete, "_family": family, "_given": given}.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "draws_numbers", True)

    @property
    def parameter_shape(self) -> tuple[int, ...]:
        return _broadcast_shape(np.empty(self.base.parameter_shape), self.low, self.high)

    def check_parameters(self) -> None:
        self.base.check_parameters()
        wrong = np.atleast_1d(~(self._tails()[2] > 0))
        if wrong.any():
            low, high = (np.broadcast_to(b, wrong.shape)[wrong][0] for b in (self.low, self.high))
            raise InputError(
                f"the {type(self.base).__name__} of a Truncated has no probability between {low} and {high} in row "
                f"{np.argwhere(wrong)[0, 0]} ({int(wrong.sum())} of {wrong.size})"
            )

    def _of(self, function: str, value: Any) -> np.ndarray:
        """A distribution function of the base: cdf, sf, ppf or isf."""
        arguments, named = self.__dict__["_given"]
        return np.asarray(getattr(self.__dict__["_family"], function)(value, *arguments, **named))

    def _tails(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Probabilities beyond each bound on the accurate side, between the bounds, and whether it is the upper side.

        If most of the probability lies below `low`, these are the probabilities above `high` and above `low`.
        """
        low = np.ceil(self.low) - 1 if self.discrete else self.low  # the largest value that is too low
        start, end = self._of("cdf", low), self._of("cdf", self.high)
        start, end = np.broadcast_arrays(start, end)
        upper = start > 0.5
        if upper.any():
            start = np.where(upper, self._of("sf", self.high), start)
            end = np.where(upper, self._of("sf", low), end)
        return start, end, end - start, upper

    def _quantile(self, u: Any) -> np.ndarray:
        """Values from numbers u in [0, 1): the inverse of the distribution function, or of its complement."""
        start, _, mass, upper = self._tails()
        x = self._of("ppf", start + mass * (1.0 - u))
        if upper.any():
            x = np.where(upper, self._of("isf", start + mass * u), x)
        return np.clip(x, self.low, self.high)  # rounding

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        shape = self.value_shape(size)
        self.check_parameters()
        x = self._quantile(rng.random(shape))
        return x.astype(np.int64) if self.discrete else x

    def log_prob(self, value: Any) -> np.ndarray:
        x, mass = np.asarray(value), self._tails()[2]
        with np.errstate(all="ignore"):
            log_mass = np.where(mass > 0, np.log(mass), np.nan)
        shape = np.broadcast_shapes(x.shape, self.parameter_shape)
        inside = np.broadcast_to((x >= self.low) & (x <= self.high), shape)
        rows = tuple(range(1, len(shape)))  # axes of the entries of one value, which are independent
        found = self.base.log_prob(value) - np.broadcast_to(log_mass, shape).sum(axis=rows)
        return np.where(inside.all(axis=rows) | np.isnan(found), found, -np.inf)

    @property
    def mean(self) -> np.ndarray:
        """Means by numerical integration of the quantiles, or by sums over all counts."""
        from scipy.integrate import quad_vec

        if self.discrete:
            ends = self._quantile(1.0 - 1e-15), self._quantile(1e-15)
            counts = np.arange(np.min(ends), np.max(ends) + 1.0)
            return np.sum([k * np.exp(self.log_prob(k)) for k in counts], axis=0)
        return quad_vec(self._quantile, 0.0, 1.0, epsrel=1e-10)[0]


@dataclass(frozen=True, eq=False)
class Product(Distribution):
    """Vectors (n, d) whose d entries are independent. Named variables are a `Joint`."""

    parts: Any

    def __post_init__(self) -> None:
        parts = tuple(map(as_distribution, self.parts))
        if not parts or any(part.event_shape for part in parts):
            raise InputError(
                f"the parts of a Product have event shapes {[part.event_shape for part in parts]}, expected one or "
                "more distributions of numbers",
                "give vectors a name: Joint({'x': ..., 'v': ...})",
            )
        object.__setattr__(self, "parts", parts)
        object.__setattr__(self, "discrete", all(part.discrete for part in parts))
        object.__setattr__(self, "draws_numbers", all(part.draws_numbers for part in parts))

    @property
    def parameter_shape(self) -> tuple[int, ...]:
        return (
            *(_broadcast_shape(*(np.empty(part.parameter_shape) for part in self.parts)) or (1,)),
            len(self.parts),
        )

    def check_parameters(self) -> None:
        for part in self.parts:
            part.check_parameters()

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        return np.stack([part.sample(rng, size) for part in self.parts], axis=-1)

    def log_prob(self, value: Any) -> np.ndarray:
        entries = np.moveaxis(np.asarray(value), -1, 0)
        return sum(part.log_prob(entry) for part, entry in zip(self.parts, entries, strict=True))

    @property
    def mean(self) -> np.ndarray:
        rows = self.parameter_shape[:1]
        return np.stack([np.broadcast_to(part.mean, rows) for part in self.parts], axis=-1)

"""Distributions for models, drawn and evaluated for all particles together.

A model says how x_t and y_t are distributed given a particle. A filter has many particles, so a distribution has one
row of parameters for each of them, and draws or evaluates all rows in one call:

>>> import numpy as np
>>> from mstfilter.smc import Normal
>>> rng = np.random.default_rng(0)
>>> x = Normal(np.zeros(5), 2.0).sample(rng, 5)          # x_0, one row per particle
>>> Normal(x, 1.0).log_prob(0.3).shape                   # log p(y | x) of one observation for each particle
(5,)

Parameters of shape () or (n,) give values of shape (n,); the event shape is then (). Parameters (1, d) or (n, d) give
values (n, d) with the event shape (d,), as in Pyro or TensorFlow Probability. The entries of an event are
independent, and their log densities are summed.

A parameter that is one number is checked when the distribution is made. Rows are checked when values are drawn. The
log density of a row that is out of range is NaN: an update refuses it, and a Metropolis move, which may propose such
parameters, rejects it.

More families are in `mstfilter.smc.models.families`, and mixtures, truncated distributions and products in
`mstfilter.smc.models.combined`. Frozen distributions of scipy.stats, such as ``stats.cauchy(x)``, can be used in
their place (`as_distribution`), but are slower. For a distribution of another library, write a `Distribution` whose
`sample` draws from the given generator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.smc.interfaces import Distribution
from mstfilter.smc.resampling import draw_rows, search

_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
_FLOAT64 = np.dtype(np.float64)


class Range(NamedTuple):
    """The numbers that a parameter may take."""

    expected: str
    low: float = -math.inf
    high: float = math.inf
    open: bool = True  #: whether the ends are out of range

    def contains(self, value: np.ndarray) -> np.ndarray:
        """Whether each number is in the range; False for NaN."""
        return (value > self.low) & (value < self.high) if self.open else (value >= self.low) & (value <= self.high)

    def surely_contains(self, value: Any) -> bool:
        """Whether a fast test (sum, minimum) shows that all entries of a float or float64 array are in the range."""
        if type(value) is float:
            return self.low < value < self.high
        if self.high < math.inf or not _is_finite(value):
            return False
        return self.low == -math.inf or np.minimum.reduce(value, axis=None, initial=math.inf) > self.low


FINITE = Range("a finite number")
POSITIVE = Range("a positive number", 0.0)


class _Checked(Distribution):
    """A distribution whose fields are parameters with the given `ranges`."""

    draws_numbers = True
    ranges: ClassVar[Mapping[str, Range]] = {}

    def __post_init__(self) -> None:
        for name in self.ranges:
            value = getattr(self, name)
            if _may_wrap(value):
                object.__setattr__(self, name, value.astype(np.float64))
            if not np.ndim(value):
                self._check(name)

    def check_parameters(self) -> None:
        for name in self.ranges:
            self._check(name)

    def _check(self, name: str) -> None:
        value, allowed = getattr(self, name), self.ranges[name]
        if allowed.surely_contains(value):  # a third of the time of the rest
            return
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            raise InputError(
                f"{name} of a {type(self).__name__} is {value!r}"[:200] + f", expected {allowed.expected}",
                *(["None stands for a missing observation, or for previous at the first step"] * (value is None)),
            )
        self._refuse(name, array, ~allowed.contains(array))

    def _refuse(self, name: str, array: np.ndarray, wrong: np.ndarray) -> None:
        """Raise InputError if an entry of a parameter is `wrong`."""
        if not wrong.any():
            return
        array = np.broadcast_to(array, wrong.shape)
        first = tuple(int(i) for i in np.argwhere(wrong)[0])
        row = f" in row {first[0]} ({int(wrong.sum())} of {array.size})" if first else ""
        expected = self.ranges[name].expected
        raise InputError(f"{name} of a {type(self).__name__} is {array[first]}{row}, expected {expected}")


class _Independent(_Checked):
    """A distribution with independent entries. The fields are parameters of shape (), (n,), (1, d) or (n, d)."""

    @property
    def parameter_shape(self) -> tuple[int, ...]:
        return _broadcast_shape(*vars(self).values())

    def _mean(self) -> Any:
        """Means of the independent entries."""
        return self.loc  # type: ignore[attr-defined]

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_to(np.asarray(self._mean(), np.float64), self.parameter_shape)


def _is_finite(value: Any) -> bool:
    """Whether the sum of a float or a float64 array is finite, which implies that all entries are finite."""
    if isinstance(value, np.ndarray) and value.dtype is _FLOAT64:
        return math.isfinite(np.add.reduce(value, axis=None))
    return type(value) is float and math.isfinite(value)


def _impossible(value: np.ndarray) -> Any:
    """Log density of a value outside the support: -inf, or NaN if the value is NaN."""
    return np.where(np.isnan(value), np.nan, -np.inf) if value.dtype.kind == "f" else -np.inf


def _where(valid: np.ndarray, log_prob: np.ndarray) -> np.ndarray:
    """The log densities; NaN where a parameter is out of range."""
    return log_prob if valid.all() else np.where(valid, log_prob, np.nan)


def _broadcast_shape(*parameters: Any) -> tuple[int, ...]:
    shape: tuple[int, ...] = ()
    for parameter in parameters:
        if type(parameter) is float:
            continue
        other = parameter.shape if isinstance(parameter, np.ndarray) else np.shape(parameter)
        if not shape or not other or other == shape:  # the usual case
            shape = shape or other
            continue
        try:
            if shape[0] > 1 and (shape == (*other, 1) or other == (*shape, 1)):
                raise ValueError("numpy would make (n, n) of (n,) and (n, 1)")
            shape = np.broadcast_shapes(shape, other)
        except ValueError:
            raise InputError(
                f"parameters of shapes {' and '.join(str(np.shape(p)) for p in parameters)} do not fit together",
                "with one row per particle they are all (n,), or all (n, d) or (n, 1)",
            ) from None
    return shape


def _sum_rows(log_prob: Any) -> np.ndarray:
    """Sum over all axes except the first, since the entries of a row are independent."""
    out = np.asarray(log_prob)
    return out if out.ndim <= 1 else out.reshape(len(out), math.prod(out.shape[1:])).sum(axis=1)


def _may_wrap(value: Any) -> bool:
    """Whether a value is an array or number of a NumPy integer type, whose arithmetic may wrap."""
    return isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in "iub"


def _standardised(value: Any, loc: Any, scale: Any) -> np.ndarray:
    """(value - loc) / scale with one temporary array."""
    z = np.asarray(np.subtract(value, loc, dtype=np.float64 if _may_wrap(value) else None), dtype=np.float64)
    fits = (
        isinstance(scale, float)
        or np.shape(scale) == z.shape
        or np.broadcast_shapes(z.shape, np.shape(scale)) == z.shape
    )
    return np.divide(z, scale, out=z if z.ndim and fits else None)


@dataclass(frozen=True, eq=False)
class Normal(_Independent):
    """Gaussian with mean `loc` and standard deviation `scale` > 0."""

    loc: Any = 0.0
    scale: Any = 1.0

    ranges: ClassVar = {"loc": FINITE, "scale": POSITIVE}

    def __post_init__(self) -> None:
        rows = self._rows
        number = self.scale if rows is self.loc else self.loc
        usual = rows is not None and rows.dtype.kind == "f" and -math.inf < number < math.inf
        if not (usual and (rows is self.scale or number > 0.0)):
            super().__post_init__()

    @property
    def _rows(self) -> np.ndarray | None:
        """The parameter with a row for each particle, if the other one is a float: the usual cases."""
        if type(self.scale) is float and type(self.loc) is np.ndarray:
            return self.loc
        return self.scale if type(self.loc) is float and type(self.scale) is np.ndarray else None

    @property
    def parameter_shape(self) -> tuple[int, ...]:
        rows = self._rows
        return super().parameter_shape if rows is None else rows.shape

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        loc, scale = self.loc, self.scale
        if not (type(scale) is float and _is_finite(loc)):  # the usual case, whose scale was checked
            self.check_parameters()
        z = rng.standard_normal(self.value_shape(size))
        z *= scale
        z += loc
        return z

    def log_prob(self, value: Any) -> np.ndarray:
        z = _standardised(value, self.loc, self.scale)
        z *= z
        z *= -0.5
        if isinstance(self.scale, float):
            z -= math.log(self.scale) + _HALF_LOG_2PI
        else:
            z -= np.log(self.scale)
            z -= _HALF_LOG_2PI
        return _sum_rows(z)


@dataclass(frozen=True, eq=False)
class Student(_Independent):
    """Student's t with `df` > 0 degrees of freedom, centre `loc` and scale `scale` > 0."""

    df: Any
    loc: Any = 0.0
    scale: Any = 1.0

    ranges: ClassVar = {"df": POSITIVE, "loc": FINITE, "scale": POSITIVE}

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        self.check_parameters()
        return self.loc + self.scale * rng.standard_t(self.df, self.value_shape(size))

    def log_prob(self, value: Any) -> np.ndarray:
        from scipy.special import gammaln

        z = _standardised(value, self.loc, self.scale)
        df = self.df if type(self.df) is float else np.asarray(self.df, dtype=np.float64)  # a float is faster
        constant = gammaln((df + 1) / 2) - gammaln(df / 2) - 0.5 * np.log(df * np.pi) - np.log(self.scale)
        return _sum_rows(constant - (df + 1) / 2 * np.log1p(z * z / df))


@dataclass(frozen=True, eq=False)
class Uniform(_Independent):
    """Uniform distribution on [low, high)."""

    low: Any = 0.0
    high: Any = 1.0

    ranges: ClassVar = {"low": FINITE, "high": Range("a finite number above low")}

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _broadcast_shape(self.low, self.high):
            self.check_parameters()

    def check_parameters(self) -> None:
        super().check_parameters()
        self._refuse("high", np.asarray(self.high), np.logical_not(np.less(self.low, self.high)))

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        self.check_parameters()
        u = rng.random(self.value_shape(size))
        return self.low + (np.asarray(self.high) - self.low) * u

    def log_prob(self, value: Any) -> np.ndarray:
        x, width = np.asarray(value), np.asarray(self.high) - self.low
        inside = (x >= self.low) & (x < self.high)
        return _sum_rows(_where(width > 0, np.where(inside, -np.log(width), _impossible(x))))

    def _mean(self) -> Any:
        return (np.asarray(self.low) + self.high) / 2


def _symmetric(cov: np.ndarray) -> np.ndarray:
    """Whether each covariance is symmetric and finite."""
    asymmetry = abs(cov - np.swapaxes(cov, -1, -2)).max(axis=(-1, -2), initial=0.0)
    return asymmetry <= 1e-6 * abs(cov).max(axis=(-1, -2), initial=0.0)


def _cholesky(cov: np.ndarray) -> np.ndarray:
    """Lower triangular root of each covariance; NaN for one that is not symmetric and positive definite."""
    if cov.ndim not in (2, 3) or cov.shape[-1] != cov.shape[-2]:
        raise InputError(f"covariance has shape {cov.shape}, expected (d, d) or (n, d, d)")
    symmetric = _symmetric(cov)
    if symmetric.all():
        try:
            return np.linalg.cholesky(cov)
        except np.linalg.LinAlgError:
            pass
    valid = symmetric & np.isfinite(cov).all(axis=(-1, -2)) & (np.linalg.eigvalsh(np.nan_to_num(cov))[..., 0] > 0)
    valid = valid[..., None, None]
    return np.where(valid, np.linalg.cholesky(np.where(valid, cov, np.eye(cov.shape[-1]))), np.nan)


@dataclass(frozen=True, eq=False)
class MultivariateNormal(_Checked):
    """Distribution of Gaussian vectors.

    The mean `loc` has shape (d,) or (n, d). The covariance `cov`, of shape (d, d) or (n, d, d), is positive definite.
    """

    loc: Any
    cov: Any

    ranges: ClassVar = {"loc": FINITE}

    def __post_init__(self) -> None:
        super().__post_init__()
        root = _cholesky(np.asarray(self.cov, dtype=np.float64))
        loc = np.shape(self.loc)
        if loc and loc[-1] != root.shape[-1] and (len(loc), loc[-1]) != (2, 1):
            raise InputError(
                f"mean of shape {loc} does not fit a covariance of shape {root.shape}",
                "the mean is (d,), or (n, d) with one row per particle; x[:, None] makes (n, 1) of (n,)",
            )
        object.__setattr__(self, "_root", root)
        if root.ndim == 2:
            self._check_covariance()

    def check_parameters(self) -> None:
        super().check_parameters()
        self._check_covariance()

    def _check_covariance(self) -> None:
        wrong = np.isnan(self.__dict__["_root"][..., :1, 0]).ravel()
        if wrong.any():
            row, cov = int(np.argmax(wrong)), np.asarray(self.cov, np.float64)
            where = f" in row {row}" if cov.ndim == 3 else ""
            cov = cov.reshape(-1, *cov.shape[-2:])[row]
            what = "positive definite" if _symmetric(cov) else "symmetric"
            raise InputError(f"covariance is not {what}{where}: {cov.tolist()}"[:300])

    @property
    def parameter_shape(self) -> tuple[int, ...]:
        return _broadcast_shape(np.zeros((1, 1)), self.loc, self.__dict__["_root"][..., 0])

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        self.check_parameters()
        root = self.__dict__["_root"]
        z = rng.standard_normal(self.value_shape(size))
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
        z = np.linalg.solve(root, np.atleast_2d(r)[..., None])[..., 0]
        return -0.5 * (z * z).sum(axis=-1) - log_det - d * _HALF_LOG_2PI

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_to(np.asarray(self.loc, np.float64), self.parameter_shape)


@dataclass(frozen=True, eq=False)
class Bernoulli(_Independent):
    """Booleans that are True with probability `p`."""

    p: Any
    discrete = True
    ranges: ClassVar = {"p": Range("a probability from 0 to 1", 0.0, 1.0, open=False)}

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        self.check_parameters()
        return rng.random(self.value_shape(size)) < self.p

    def log_prob(self, value: Any) -> np.ndarray:
        x, p = np.asarray(value), np.asarray(self.p, np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            log_p = np.where(x.astype(bool), np.log(p), np.log1p(-p))
        possible = np.where((x == 0) | (x == 1), log_p, _impossible(x))
        return _sum_rows(_where(self.ranges["p"].contains(p), possible))

    def _mean(self) -> Any:
        return self.p


@dataclass(frozen=True, eq=False)
class Categorical(Distribution):
    """A distribution over k categories, 0 to k - 1. Rows of `probs` (k,) or (n, k) are scaled to sum to one."""

    probs: Any
    discrete = True
    draws_numbers = True

    def __post_init__(self) -> None:
        p = np.asarray(self.probs, dtype=np.float64)
        if p.ndim not in (1, 2) or not p.shape[-1]:
            raise InputError(f"probabilities of a categorical have shape {p.shape}, expected (k,) or (n, k)")
        total = p.sum(axis=-1, keepdims=True)
        if p.size and not (p.min() >= 0 and total.min() > 0 and total.max() < np.inf):
            total[~((p >= 0).all(axis=-1) & (total[..., 0] > 0) & (total[..., 0] < np.inf))] = np.nan
        object.__setattr__(self, "_given", p)
        object.__setattr__(self, "probs", p / total)
        if p.ndim == 1:
            self.check_parameters()

    def check_parameters(self) -> None:
        wrong = np.isnan(self.probs[..., 0])
        if wrong.any():
            given, row = np.atleast_2d(self.__dict__["_given"]), int(np.argmax(wrong))
            where = f" in row {row} ({int(wrong.sum())} of {len(given)})" if wrong.ndim else ""
            raise InputError(
                f"probabilities of a categorical are {given[row].tolist()}{where}"[:300]
                + ", expected finite numbers, none negative, not all zero"
            )

    @property
    def parameter_shape(self) -> tuple[int, ...]:
        return self.probs.shape[:-1]

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw categories. A category of probability zero is never drawn."""
        self.check_parameters()
        u = rng.random(self.value_shape(size))
        return search(self.probs, u) if self.probs.ndim == 1 else draw_rows(self.probs, u)

    def log_prob(self, value: Any) -> np.ndarray:
        k = np.asarray(value)
        k = k.astype(np.int64) if _may_wrap(k) else k  # numpy clips to the range of its type
        index = np.nan_to_num(np.clip(k, 0, self.probs.shape[-1] - 1)).astype(np.int64)
        with np.errstate(divide="ignore"):
            log_p = np.log(self.probs)
        if self.probs.ndim == 1:
            picked = log_p[index]
        else:
            picked = log_p[0 if len(log_p) == 1 and index.ndim else np.arange(len(log_p)), index]
        return np.where(index == k, picked, _impossible(k))

    @property
    def mean(self) -> np.ndarray:
        return self.probs @ np.arange(self.probs.shape[-1], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Joint(Distribution):
    """Several named variables, drawn in the order of the mapping `parts`; values are mappings of arrays.

    A part is a distribution, or a function of the variables before it that returns one: ``{"k": Categorical(p), "x":
    lambda drawn: Normal(mean[drawn["k"]], 1.0)}``. A value None, of an observation that is missing, adds nothing to
    the log density.
    """

    parts: Mapping[str, Any]

    def _chain(self, value: Callable[[str, Distribution], Any]) -> Iterator[tuple[str, Distribution, Any]]:
        """Each variable with its distribution given those before it, and its value."""
        found: dict[str, Any] = {}
        for name, part in self.parts.items():
            plain = isinstance(part, Distribution) or hasattr(part, "rvs") or not callable(part)
            distribution = as_distribution(part if plain else part(found))
            found[name] = value(name, distribution)
            yield name, distribution, found[name]

    def check_parameters(self) -> None:
        for part in self.parts.values():
            if isinstance(part, Distribution):
                part.check_parameters()

    def sample(self, rng: np.random.Generator, size: int) -> Any:
        return {name: x for name, _, x in self._chain(lambda name, part: part.sample(rng, size))}

    def log_prob(self, value: Any) -> np.ndarray:
        if not isinstance(value, Mapping) or not value.keys() >= self.parts.keys():
            found = sorted(value) if isinstance(value, Mapping) else f"a {type(value).__name__}"
            raise InputError(f"the values have the variables {found}, expected {sorted(self.parts)}")
        total: Any = 0.0
        for name, part, x in self._chain(lambda name, part: value[name]):
            if x is None:
                continue
            shape, event = np.shape(x), part.event_shape
            if shape not in (event, (1, *event)) and shape[1:] != event:
                raise InputError(f"variable {name!r} has shape {shape}, expected rows of shape {event}")
            total = total + part.log_prob(x)
        return np.asarray(total, np.float64)

    @property
    def parameter_shape(self) -> tuple[int, ...]:
        raise InputError("the values of a Joint are mappings, which have no shape")

    @property
    def mean(self) -> Any:
        """Means by name: of a part that depends on others, at the means of these."""
        return {name: m for name, _, m in self._chain(lambda name, part: part.mean)}


def as_distribution(value: Any) -> Distribution:
    """The distribution that a value describes: itself, one of scipy.stats, or a mapping of names (`Joint`).

    Raises InputError for other types.
    """
    if isinstance(value, Distribution):
        return value
    if isinstance(value, Mapping):
        return Joint(value)
    if type(value).__module__.startswith("scipy.stats") and hasattr(value, "rvs"):
        return FromScipy(value)
    raise InputError(
        f"expected a distribution, found a {type(value).__module__}.{type(value).__qualname__}",
        "use one of mstfilter.smc, a frozen one of scipy.stats, or subclass mstfilter.smc.Distribution",
    )


@dataclass(frozen=True, eq=False)
class FromScipy(Distribution):
    """A univariate or multivariate frozen distribution of scipy.stats."""

    wrapped: Any

    def __post_init__(self) -> None:
        kind = type(self.wrapped)
        discrete = any("discrete" in base.__name__.lower() for base in kind.__mro__)
        object.__setattr__(self, "discrete", discrete or not hasattr(kind, "logpdf"))
        object.__setattr__(self, "_vector", kind.__module__.endswith("_multivariate"))

    @property
    def parameter_shape(self) -> tuple[int, ...]:
        if hasattr(self.wrapped, "args"):  # the mean would be slow
            return _broadcast_shape(*self.wrapped.args, *self.wrapped.kwds.values())
        if self.__dict__["_vector"] and not hasattr(self.wrapped, "mean"):
            return (1, *(np.shape(self.wrapped.rvs(2, random_state=0))[1:] or (1,)))
        return np.shape(self.mean)

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        wrapped, shape = self.wrapped, self.value_shape(size)
        if self.__dict__["_vector"]:
            return np.reshape(wrapped.rvs(size=size, random_state=rng), shape)
        return np.asarray(wrapped.rvs(size=shape, random_state=rng))

    def log_prob(self, value: Any) -> np.ndarray:
        vector = self.__dict__["_vector"]
        rows = np.shape(value)[:1] if vector and np.ndim(value) > len(self.event_shape) else ()
        if type(self.wrapped).__name__ in _PARTICLES_LAST and rows:
            value = np.moveaxis(value, 0, -1)
        log_prob = self.wrapped.logpmf(value) if self.discrete else self.wrapped.logpdf(value)
        return np.reshape(log_prob, rows or np.shape(log_prob)) if vector else _sum_rows(log_prob)

    @property
    def mean(self) -> np.ndarray:
        mean = self.wrapped.mean
        mean = np.asarray(mean() if callable(mean) else mean)
        return mean[None] if self.__dict__["_vector"] else mean


_PARTICLES_LAST = ("dirichlet_frozen", "wishart_frozen", "invwishart_frozen")

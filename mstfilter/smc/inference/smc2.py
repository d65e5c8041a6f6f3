"""SMC^2: parameters and states together, observation by observation.

`ibis` needs the likelihood p(y_t | y_0 .. y_{t-1}, theta), which a model of hidden states does not have. Here each
parameter vector carries a particle filter that estimates it without bias, which leaves the posterior exact for any
number of particles in the filters (Chopin, Jacob, Papaspiliopoulos 2013). A move proposes new parameters, runs a new
filter over all observations so far, and accepts both as `pmmh` does.

>>> from mstfilter.smc import Normal, StateSpaceModel, Uniform, bootstrap, smc2
>>> def filter_of(theta):
...     rho = theta["rho"]
...     model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(rho * x, 0.5), lambda x: Normal(x, 1.0))
...     return bootstrap(model, n=50)
>>> found = smc2(filter_of, [0.3, -0.1, 0.8, 0.9], {"rho": Uniform(-1.0, 1.0)}, n=100, steps=4)
>>> found.population.particles["rho"].shape, len(found.states)
((100,), 5000)
>>> mean = found.states.weights @ found.states.particles                    # E[x_3 | y_0 .. y_3], over all parameters

The evidence is that of the model, with the prior integrated out. If few proposals are accepted, the estimates of the
filters are too noisy: then each filter is replaced by one with twice as many particles.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, LostRunError, check_component, check_integer, check_number
from mstfilter.smc.components import EssBelow
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.first_steps import unexamined
from mstfilter.smc.inference.samplers import LOG_LIKELIHOOD, Rows, Sampled, Sampler, Target
from mstfilter.smc.inputs import check_observations
from mstfilter.smc.interfaces import Distribution, Resampler, Trigger
from mstfilter.smc.models.distributions import as_distribution
from mstfilter.smc.population import Particles, Population, log_mean_exp, take
from mstfilter.smc.resampling import Systematic
from mstfilter.smc.streams import Key
from mstfilter.smc.sweep import DIFFERENT_WEIGHTS, advance_runs, can_sweep, sweep_difference

#: Variables of a parameter vector: of a sweep, the log weights (n, m) and particles (n, m, ...) of m particles of its
#: filter, where an array has the name `_X`; otherwise the filter with its state, as an object.
_WEIGHTS, _X, _RUN = "log weights of the filter", "particle of the filter", "run of the filter"


def smc2(
    filter_of: Callable[[Any], ParticleFilter],
    observations: Iterable[Any],
    prior: Any,
    n: int = 500,
    seed: int = 0,
    *,
    batched: bool | None = None,
    function: Callable[[Particles], np.ndarray] | None = None,
    steps: int = 4,
    waste_free: bool = True,
    scale: Any = None,
    grow_below: float = 0.1,
    most_particles: int = 5000,
    resampler: Resampler = Systematic(),  # noqa: B008 (frozen)
    trigger: Trigger = EssBelow(0.5),  # noqa: B008 (frozen)
    lag: int | None = None,
) -> Sampled:
    """Draw from the posterior of parameters, and of states, after each observation.

    Parameters
    ----------
    filter_of : callable
        ``(theta) -> ParticleFilter``, as in `pmmh`: any properly weighted filter. `theta` is a vector (d,), a number,
        or a mapping from names to these, as the prior draws it.
    n : int
        Number of parameter vectors.
    batched : bool, optional
        Whether the filters of all parameter vectors run in one sweep, which is much faster. ``filter_of`` then also
        gets the parameters of all particles of all filters: arrays (m,), or (d, m) for a vector. By default they do
        if the filter of two parameter vectors together agrees with the filter of each.
    function : callable, optional
        ``(particles) -> (m, ...)`` of states x_t, whose means given y_0 .. y_t are estimated at every step
        (`Sampled.state_mean`).
    grow_below : float
        If a smaller share of the proposals is accepted, the particles of each filter are doubled, up to
        `most_particles`. 0 keeps their number.
    prior, steps, waste_free, scale, trigger, lag
        As in `ibis`.
    """
    check_number("grow_below", grow_below, at_least=0, at_most=1)
    check_integer("most_particles", most_particles)
    ys = list(check_observations(observations))
    chosen = batched is None
    if batched is None:
        batched = _agree(filter_of, as_distribution(prior), ys)
    kind = _Swept if batched else _Single
    target = kind(filter_of, grow_below, most_particles)
    means = None if function is None else lambda rows: target.means(rows, function)
    sampler = Sampler(prior, target, n, steps, waste_free, scale, resampler, trigger)
    try:
        found = sampler.sample((ys[: t + 1] for t in range(len(ys))), seed, lag, extra=means)
    except Exception as error:
        if chosen and batched:
            error.add_note("the filters of all parameters ran as one; batched=False runs them one by one")
        raise
    assert found.run.state.population is not None
    return replace(found, states=target.states(found.run.state.population))


@dataclass(frozen=True)
class _Filters(Target):
    """The likelihood estimated by a filter for each parameter vector. `data` is a list of observations."""

    filter_of: Callable[[Any], ParticleFilter]
    grow_below: float
    most_particles: int

    @abstractmethod
    def size(self, rows: Mapping[str, np.ndarray]) -> int | None:
        """Number of particles of each filter; None before they are made."""

    @abstractmethod
    def stepper(self, theta: Any, n: int, size: int | None) -> Callable[..., Rows]:
        """``(rng, rows, t, y) -> rows``: moves the filters of n parameter vectors by observation y_t."""

    @abstractmethod
    def states(self, population: Population) -> Population:
        """The particles of all filters, weighted."""

    @abstractmethod
    def means(self, rows: Rows, function: Callable[[Any], np.ndarray]) -> np.ndarray:
        """(n, k) the estimate of each filter for the mean of a function of the states."""

    def evaluate(self, rng: np.random.Generator, theta: Any, n: int, data: Any, like: Rows) -> Rows:
        return self._run(rng, theta, n, data, self.size(like))

    def _run(self, rng: np.random.Generator, theta: Any, n: int, data: Any, size: int | None) -> Rows:
        """New filters of this size, over all data."""
        rows, step = self.first(theta, n), self.stepper(theta, n, size)
        for t, y in enumerate(data):
            rows = {**rows, **step(rng, rows, t, y)}
        return rows

    def extend(
        self, rng: np.random.Generator, theta: Any, population: Population, data: Any
    ) -> tuple[Rows, np.ndarray]:
        rows = population.particles
        new = self.stepper(theta, len(population), self.size(rows))(rng, rows, len(data) - 1, data[-1])
        with np.errstate(invalid="ignore"):
            gain = new[LOG_LIKELIHOOD] - rows[LOG_LIKELIHOOD]
        return new, np.where(np.isnan(gain), -np.inf, gain)

    def after_move(self, rng: np.random.Generator, theta: Any, rows: Rows, accepted: float, data: Any) -> Rows:
        size = self.size(rows)
        if accepted >= self.grow_below or size is None or 2 * size > self.most_particles:
            return {}
        return self._run(rng, theta, len(rows[LOG_LIKELIHOOD]), data, 2 * size)

    def made(self, theta: Any, size: int | None) -> ParticleFilter:
        """The filter of some parameters, with `size` particles if it is given."""
        filter = self.filter_of(theta)
        check_component("the result of filter_of", filter, ParticleFilter)
        if not filter.properly_weighted:
            raise InputError("a component of the filter is not properly weighted: it has no unbiased evidence")
        return filter if size is None else replace(filter, n=size)


@dataclass(frozen=True)
class _Single(_Filters):
    """Filters that run one by one."""

    def size(self, rows: Mapping[str, np.ndarray]) -> int | None:
        return rows[_RUN][0][0].n if _RUN in rows else None

    def stepper(self, theta: Any, n: int, size: int | None) -> Callable[..., Rows]:
        def step(rng: np.random.Generator, rows: Mapping[str, np.ndarray], t: int, y: Any) -> Rows:
            runs, found = np.empty(n, object), np.full(n, -np.inf)
            for i in range(n):
                if _RUN in rows:
                    filter, state = rows[_RUN][i]
                else:
                    filter = self.made(_one(theta, i), size)
                    state = filter.start(int(rng.integers(2**63)))
                runs[i] = filter, state
                if rows[LOG_LIKELIHOOD][i] == -np.inf:
                    continue
                with suppress(LostRunError), unexamined(i > 0):
                    runs[i] = filter, filter.step(state, y)[0]
                    found[i] = runs[i][1].log_evidence
            return {_RUN: runs, LOG_LIKELIHOOD: found}

        return step

    def states(self, population: Population) -> Population:
        runs = [state.population for _, state in population.particles[_RUN]]
        lw = [a + p.log_weights - p.log_mean_weight for a, p in zip(population.log_weights, runs, strict=True)]
        return Population(_joined([p.particles for p in runs]), np.concatenate(lw))

    def means(self, rows: Rows, function: Callable[[Any], np.ndarray]) -> np.ndarray:
        runs = [state.population for _, state in rows[_RUN]]
        return np.stack([p.weights @ np.reshape(function(p.particles), (len(p), -1)) for p in runs])


@dataclass(frozen=True)
class _Swept(_Filters):
    """Filters that run as one: the particles of all of them are one population."""

    def size(self, rows: Mapping[str, np.ndarray]) -> int | None:
        return rows[_WEIGHTS].shape[1] if _WEIGHTS in rows else None

    def extend(
        self, rng: np.random.Generator, theta: Any, population: Population, data: Any
    ) -> tuple[Rows, np.ndarray]:
        if len(data) == 1 and len(population) > 1:
            with suppress(LostRunError):
                if _difference(self.made, theta, data) == "weights":
                    raise InputError(*DIFFERENT_WEIGHTS)
        return super().extend(rng, theta, population, data)

    def stepper(self, theta: Any, n: int, size: int | None) -> Callable[..., Rows]:
        first = self.made(_one(theta, 0), size)
        if not can_sweep(first):
            raise InputError(
                "a component of the filter looks at several particles, so the filters cannot run as one",
                "batched=False",
            )

        @lru_cache(maxsize=1)
        def of_runs(runs: bytes) -> ParticleFilter:
            return self.made(_repeated(theta, np.frombuffer(runs, np.int64), first.n), first.n)

        def step(rng: np.random.Generator, rows: Mapping[str, np.ndarray], t: int, y: Any) -> Rows:
            key, past = Key(int(rng.integers(2**63))), None
            if _WEIGHTS in rows:
                past = Population.unchecked(_particles(rows), rows[_WEIGHTS].ravel())
            alive, population, log_mean = advance_runs(
                first, lambda runs: of_runs(np.ascontiguousarray(runs, np.int64).tobytes()), past, n, t, y, key
            )
            found = np.full(n, -np.inf)
            if not len(alive):
                return {LOG_LIKELIHOOD: found}
            assert population is not None
            found[alive] = log_mean
            found[rows[LOG_LIKELIHOOD] == -np.inf] = -np.inf
            # A lost filter gets the particles of another one, and keeps its weight of 0.
            source = np.zeros(n, np.int64)
            source[alive] = np.arange(len(alive))
            arrays = {_X: population.particles}
            if isinstance(population.particles, Mapping):
                arrays = {f"{_X}: {name}": a for name, a in population.particles.items()}
            arrays[_WEIGHTS] = population.log_weights
            shaped = {name: a.reshape(len(alive), first.n, *a.shape[1:]) for name, a in arrays.items()}
            return {LOG_LIKELIHOOD: found} | (shaped if len(alive) == n else take(shaped, source))

        return step

    def states(self, population: Population) -> Population:
        rows = population.particles
        inner = rows[_WEIGHTS] - np.array([[log_mean_exp(lw)] for lw in rows[_WEIGHTS]])
        return Population(_particles(rows), (population.log_weights[:, None] + inner).ravel())

    def means(self, rows: Rows, function: Callable[[Any], np.ndarray]) -> np.ndarray:
        lw = rows[_WEIGHTS]
        weights = np.exp(lw - lw.max(axis=1, keepdims=True))
        values = np.asarray(function(_particles(rows)), np.float64).reshape(*lw.shape, -1)
        return np.einsum("nm,nmk->nk", weights / weights.sum(axis=1, keepdims=True), values)


def _agree(filter_of: Callable[[Any], ParticleFilter], prior: Distribution, observations: list[Any]) -> bool:
    """Whether filters of several parameter vectors can run as one: two agree with single ones in the first steps."""
    for seed in range(5):  # the likelihood of some parameters may be 0
        theta = prior.sample(np.random.default_rng(seed), 2)
        with suppress(LostRunError):
            single = filter_of(_one(theta, 0))
            if not isinstance(single, ParticleFilter) or not can_sweep(single):
                return False
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    return not _difference(lambda theta, size: filter_of(theta), theta, observations)
                except LostRunError:
                    raise
                except Exception:  # what a function of the user may do with arrays
                    return False
    return False


def _difference(made: Callable[..., ParticleFilter], theta: Any, observations: list[Any]) -> str:
    """How the filter of the first two parameter vectors together differs from those of each (`sweep_difference`)."""
    alone = [made(_one(theta, i), None) for i in range(2)]
    return sweep_difference(alone, made(_repeated(theta, np.arange(2), alone[0].n), None), observations)


def _particles(rows: Mapping[str, np.ndarray]) -> Particles:
    """The particles of all filters of a sweep, in one population."""
    flat = {name: a.reshape(-1, *a.shape[2:]) for name, a in rows.items() if name.startswith(_X)}
    return flat[_X] if _X in flat else {name.removeprefix(f"{_X}: "): a for name, a in flat.items()}


def _one(theta: Any, i: int) -> Any:
    """One parameter vector, as `filter_of` gets it."""
    if isinstance(theta, Mapping):
        return {name: _one(a, i) for name, a in theta.items()}
    return float(theta[i]) if theta.ndim == 1 else theta[i]


def _repeated(theta: Any, runs: np.ndarray, n: int) -> Any:
    """The parameters of some runs, for each of their n particles: (m,), or (d, m) for vectors."""
    if isinstance(theta, Mapping):
        return {name: _repeated(a, runs, n) for name, a in theta.items()}
    return np.repeat(theta[runs], n, axis=0).T


def _joined(parts: list[Particles]) -> Particles:
    """Particles of several populations in one."""
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    if isinstance(parts[0], Mapping):
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return tuple(particle for part in parts for particle in part)

"""SMC samplers: a posterior of parameters by particles that start in the prior.

Importance sampling from the prior fails if the posterior is much narrower. An SMC sampler goes there in small steps,
through distributions pi_0, pi_1, .. that lie between: it weights the particles by pi_t / pi_{t-1}, resamples them if
the weights are uneven, and moves them by Metropolis steps that leave pi_t invariant, so that copies differ again. The
mean weight estimates the evidence, the integral of prior times likelihood (Del Moral, Doucet, Jasra 2006).

>>> import numpy as np
>>> from mstfilter.smc import Normal, ibis, tempering
>>> data = np.array([0.8, 1.9, 1.1])
>>> def log_likelihood(theta):
...     return Normal(theta[:, None], np.ones((1, 3))).log_prob(data)
>>> found = tempering(Normal(0.0, 2.0), log_likelihood, n=1000)
>>> bool(abs(found.mean - 1.169) < 0.1), abs(found.log_evidence + 4.548) < 0.2        # from the exact answers
(True, True)
>>> 0.02 < found.log_evidence_error < 0.1
True

- `tempering` goes through the powers L(theta)^e of the likelihood, from e = 0 to 1. Each next power is the one at
  which the effective sample size falls to a share of n (Jasra, Stephens, Doucet, Tsagaris 2011).
- `ibis` takes the observations one by one (Chopin 2002). `smc2` does this for models of states, whose likelihood is
  estimated by particle filters.

With ``waste_free=True``, n / (steps + 1) particles are resampled, and all states of the chains that start there are
the next n particles (Dau and Chopin 2022). A move then costs n evaluations whatever the number of steps.

A sampler is a `ParticleFilter` like others: the transition makes the moves, and the update extends the target. So the
standard error of the log evidence comes from the ancestors of the same run, by `run_variance`. Reference: Chopin and
Papaspiliopoulos (2020), chapter 17.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import repeat
from math import prod
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, check_integer, check_number
from mstfilter.smc.components import Always, EssBelow
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.inference.diagnostics import RunVariance, run_variance
from mstfilter.smc.inference.metropolis import metropolis
from mstfilter.smc.inference.parameters import _step_root
from mstfilter.smc.inputs import bind_step, check_observations, check_signature, split_input, step_parameters
from mstfilter.smc.interfaces import Distribution, Proposal, Resampler, Size, State, Transition, Trigger, Update
from mstfilter.smc.models.distributions import as_distribution
from mstfilter.smc.population import Population, take
from mstfilter.smc.resampling import Systematic
from mstfilter.smc.wrapped_resampling import Sized

Rows = dict[str, np.ndarray]

#: Variables of particles beside the parameters, whose names may not be the same.
LOG_LIKELIHOOD = "log likelihood"
_PRIOR, _POWER, _ROOT = "log prior", "power of the likelihood", "root of the covariance of a step"
_ONE, _UNUSED = np.ones(1), np.random.default_rng(0)


@dataclass(frozen=True, eq=False)
class Sampled:
    """The result of an SMC sampler."""

    population: Population  #: weighted draws of the posterior: an array, or a mapping as the prior has names
    log_evidence: float  #: of all observations
    log_evidence_error: float  #: its standard error over seeds, estimated from this run; NaN if it cannot be told
    mean: Any  #: posterior mean: an array, or a mapping of arrays
    mean_error: Any  #: standard errors of the mean over seeds
    powers: np.ndarray  #: (T,) power of the likelihood after each step, 1 if it is not tempered
    accepted: np.ndarray  #: (T,) share of accepted proposals of the moves in each step; NaN without moves
    run: RunVariance  #: the estimates after each step, and the last state
    states: Population | None = None  #: of `smc2`: the last states of all filters, weighted
    state_mean: np.ndarray | None = None  #: (T, k) of `smc2`: means of the function of the states
    state_mean_error: np.ndarray | None = None  #: (T, k) their standard errors over seeds

    def __repr__(self) -> str:
        moved = np.isfinite(self.accepted)
        lines = [f"Sampled: {len(self.population)} particles, {len(self.powers)} steps, {moved.sum()} with moves"]
        lines.append(f"log evidence {self.log_evidence:.4f}, standard error {self.log_evidence_error:.2g}")
        return "\n  ".join(lines)


def tempering(
    prior: Any,
    log_likelihood: Callable[[Any], np.ndarray],
    n: int = 1000,
    seed: int = 0,
    *,
    share: float = 0.5,
    powers: Sequence[float] | None = None,
    steps: int = 9,
    waste_free: bool = True,
    scale: Any = None,
    resampler: Resampler = Systematic(),  # noqa: B008 (frozen)
    lag: int | None = 5,
) -> Sampled:
    """Draw from a posterior by powers of the likelihood that increase from 0 to 1.

    Parameters
    ----------
    prior : Distribution or mapping
        Distribution of the parameters theta, (n,) or (n, d) floats. A mapping of names to distributions gives a
        mapping of arrays.
    log_likelihood : callable
        ``(theta) -> (n,)``.
    share : float
        The next power is the largest one at which the effective sample size is at least this share of `n`.
    powers : sequence of float, optional
        Fixed powers: increasing numbers above 0 that end with 1. With these and a fixed `scale`, the estimate of the
        evidence is unbiased. What is chosen from the particles adds a bias of order 1 / n (Beskos, Jasra, Kantas,
        Thiery 2016).
    steps : int
        Number of Metropolis steps of a move.
    waste_free : bool
        Whether all states of a chain are kept. `n` must then be a multiple of ``steps + 1``.
    scale : float, (d,) or (d, d) array_like, optional
        Standard deviations or covariance of a step, with parameters in the order of the prior. By default,
        2.38^2 / d times the covariance of the particles (Roberts, Gelman, Gilks 1997).
    lag : int, optional
        Number of steps whose ancestors the standard errors use (`run_variance`): None for all, which has no bias from
        the lag and more noise.

    Raises
    ------
    InputError
        If the draws of the prior are not floats, or a log likelihood has another shape, is NaN or +inf.
    """
    check_number("share", share, above=0, below=1)
    planned = None if powers is None else [float(v) for v in powers]
    if planned is not None and (not planned or planned[-1] != 1 or (np.diff([0.0, *planned]) <= 0).any()):
        raise InputError(f"powers are {planned}, expected increasing numbers above 0 that end with 1")
    target = _Tempered(log_likelihood, share if planned is None else 0.0)
    sampler = Sampler(prior, target, n, steps, waste_free, scale, resampler, Always())
    return sampler.sample(planned or repeat(1.0), seed, lag, until=_is_full)


def _is_full(state: State) -> bool:
    """Whether the power of the likelihood is 1."""
    return state.population is not None and state.population.particles[_POWER][0] >= 1


def ibis(
    prior: Any,
    log_likelihood: Callable[..., np.ndarray],
    observations: Iterable[Any],
    n: int = 1000,
    seed: int = 0,
    *,
    steps: int = 9,
    waste_free: bool = True,
    scale: Any = None,
    resampler: Resampler = Systematic(),  # noqa: B008 (frozen)
    trigger: Trigger = EssBelow(0.5),  # noqa: B008 (frozen)
    lag: int | None = None,
) -> Sampled:
    """Draw from a posterior by taking the observations one by one (iterated batch importance sampling, Chopin 2002).

    Particles are resampled and moved when the trigger says so. A move evaluates the likelihood of all observations
    so far. ``run.log_evidence`` has the log evidence after each observation.

    Parameters
    ----------
    log_likelihood : callable
        ``(theta, y) -> (n,)`` log p(y_t | y_0 .. y_{t-1}, theta). A parameter ``t`` gets the index of the
        observation, and ``u`` its input. A missing observation is None, and is left out.
    prior, steps, waste_free, scale, lag
        As in `tempering`.
    """
    check_signature("log_likelihood", log_likelihood, 2)
    ys = list(check_observations(observations))
    sampler = Sampler(prior, _Sequential(log_likelihood), n, steps, waste_free, scale, resampler, trigger)
    return sampler.sample((ys[: t + 1] for t in range(len(ys))), seed, lag)


# --- targets --------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Target(ABC):
    """A sequence of distributions: the prior times a likelihood of what has been observed, `data`, up to a step.

    A particle has the variables of its parameters, `LOG_LIKELIHOOD`, and others that the target adds. `theta` are
    parameters as the functions of users get them.
    """

    @abstractmethod
    def evaluate(self, rng: np.random.Generator, theta: Any, n: int, data: Any, like: Rows) -> Rows:
        """`LOG_LIKELIHOOD` (n,), and further variables as those of the particles `like`, of n particles."""

    @abstractmethod
    def extend(
        self, rng: np.random.Generator, theta: Any, population: Population, data: Any
    ) -> tuple[Rows, np.ndarray]:
        """The variables that the newest datum changes, and (n,) what it adds to the log weights."""

    def first(self, theta: Any, n: int) -> Rows:
        """Variables of n particles before the first datum."""
        return {LOG_LIKELIHOOD: np.zeros(n)}

    def before(self, data: Any) -> Any:
        """What had been observed one step earlier."""
        return data[:-1]

    def after_move(self, rng: np.random.Generator, theta: Any, rows: Rows, accepted: float, data: Any) -> Rows:
        """Variables to replace after a move. A change of `LOG_LIKELIHOOD` is added to the log weights."""
        return {}


@dataclass(frozen=True)
class _Tempered(Target):
    """Powers of a likelihood. A datum is the largest power that the step may reach."""

    log_likelihood: Callable[[Any], np.ndarray]
    share: float

    def first(self, theta: Any, n: int) -> Rows:
        return {**self.evaluate(_UNUSED, theta, n, None, {}), _POWER: np.zeros(n)}

    def before(self, data: Any) -> Any:
        return None

    def evaluate(self, rng: np.random.Generator, theta: Any, n: int, data: Any, like: Rows) -> Rows:
        return {LOG_LIKELIHOOD: checked_densities("log likelihood", self.log_likelihood(theta), n)}

    def extend(
        self, rng: np.random.Generator, theta: Any, population: Population, data: Any
    ) -> tuple[Rows, np.ndarray]:
        from scipy.optimize import brentq

        now, least = float(population.particles[_POWER][0]), self.share * len(population)

        def gain(power: float) -> np.ndarray:
            return (power - now) * population.particles[LOG_LIKELIHOOD]

        def excess(power: float) -> float:
            return population.reweighted(gain(power)).ess - least

        power = float(data)
        if least and excess(power) < 0:
            smallest = now + 1e-9 * (power - now)
            power = smallest if excess(smallest) <= 0 else float(brentq(excess, smallest, power, xtol=1e-12))
        return {_POWER: np.broadcast_to(power, len(population))}, gain(power)


@dataclass(frozen=True)
class _Sequential(Target):
    """The likelihood of the observations so far. `data` is a list of them."""

    log_likelihood: Callable[..., np.ndarray]

    @cached_property
    def names(self) -> dict[str, bool]:
        """Which of ``t`` and ``u`` the function takes."""
        return step_parameters(self.log_likelihood, 2)

    def evaluate(self, rng: np.random.Generator, theta: Any, n: int, data: Any, like: Rows) -> Rows:
        return {LOG_LIKELIHOOD: sum((self._of_step(theta, n, t, y) for t, y in enumerate(data)), np.zeros(n))}

    def extend(
        self, rng: np.random.Generator, theta: Any, population: Population, data: Any
    ) -> tuple[Rows, np.ndarray]:
        gain = self._of_step(theta, len(population), len(data) - 1, data[-1])
        return {LOG_LIKELIHOOD: population.particles[LOG_LIKELIHOOD] + gain}, gain

    def _of_step(self, theta: Any, n: int, t: int, observation: Any) -> np.ndarray:
        y, u = split_input(observation)
        if y is None:
            return np.zeros(n)
        bound = bind_step(self.log_likelihood, self.names, t, u) if self.names else self.log_likelihood
        return checked_densities("log likelihood", bound(theta, y), n)


def checked_densities(what: str, found: Any, n: int) -> np.ndarray:
    """(n,) float64 log densities. Raises InputError for another shape, NaN or +inf."""
    array = np.asarray(found, np.float64)
    if array.shape != (n,) or not (array < np.inf).all():
        largest = array.max() if array.size else "-"
        raise InputError(f"the {what} has shape {array.shape} and maximum {largest}, expected ({n},) finite or -inf")
    return array


# --- the sampler as a filter ----------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Sampler:
    """An SMC sampler for a sequence of targets. The other fields are arguments of `tempering`.

    In the filter, the observation of a step is all data up to this step.
    """

    prior: Any
    target: Target
    n: int
    steps: int
    waste_free: bool
    scale: Any
    resampler: Resampler
    trigger: Trigger

    def __post_init__(self) -> None:
        check_integer("n", self.n, at_least=2)
        check_integer("steps", self.steps)
        if self.waste_free and self.n % (self.steps + 1):
            raise InputError(
                f"n is {self.n}, expected a multiple of steps + 1 = {self.steps + 1} to keep all states of a chain",
                "choose another n or steps, or waste_free=False",
            )

    def sample(
        self,
        data: Iterable[Any],
        seed: int,
        lag: int | None,
        until: Callable[[State], bool] | None = None,
        extra: Callable[[Mapping[str, np.ndarray]], np.ndarray] | None = None,
    ) -> Sampled:
        """Run the sampler over the data, or until a state fulfils a condition.

        ``extra(particles)`` (n, k) are further values to average at every step.
        """
        theta = _Parameters(as_distribution(self.prior))
        d = theta.d
        resampler = Sized(self.resampler, _Part(self.steps + 1)) if self.waste_free else self.resampler
        filter = ParticleFilter(
            initial=_FromPrior(theta, self.target),
            transition=_Moves(theta, self.target, self.steps, self.waste_free),
            update=_Extend(theta, self.target, None if self.scale is None else _step_root(self.scale, d)),
            resampler=resampler,
            trigger=self.trigger,
            n=self.n,
        )

        def averaged(rows: Mapping[str, np.ndarray]) -> np.ndarray:
            return np.hstack([theta.matrix(rows), *([] if extra is None else [extra(rows)])])

        run = run_variance(filter, data, seed, lag, averaged, until)
        mean, error = run.mean, np.sqrt(run.mean_variance)
        population, variance = run.state.population, run.log_evidence_variance[-1:]
        if population is None:
            raise InputError("there are no observations")
        notes = [info.notes for info in run.infos]
        return Sampled(
            population.moved(theta.given(population.particles)),
            float(run.log_evidence[-1]),
            float(np.sqrt(variance[0])) if variance[0] >= 0 else np.nan,
            theta.by_name(mean[-1, :d]),
            theta.by_name(error[-1, :d]),
            np.array([found["update"]["power"] for found in notes]),
            np.array([found.get("transition", {}).get("accepted", np.nan) for found in notes]),
            run,
            state_mean=None if extra is None else mean[:, d:],
            state_mean_error=None if extra is None else error[:, d:],
        )


@dataclass(frozen=True)
class _Part(Size):
    """One of `length` particles: the starts of the chains of a waste-free move."""

    length: int

    def choose(self, population: Population) -> int:
        return max(1, len(population) // self.length)


@dataclass(frozen=True)
class _Parameters:
    """Parameters as the prior draws them, as variables of particles, and as a matrix (n, d)."""

    prior: Distribution

    @cached_property
    def example(self) -> Any:
        """One draw, which shows names, shapes and types."""
        drawn = self.prior.sample(np.random.default_rng(0), 1)
        for name, a in drawn.items() if isinstance(drawn, Mapping) else [("theta", drawn)]:
            if name in (LOG_LIKELIHOOD, _PRIOR, _POWER, _ROOT):
                raise InputError(f"a parameter cannot have the name {name!r}, which the sampler uses", "rename it")
            if a.dtype.kind != "f":
                raise InputError(
                    f"parameter {name!r} is of type {a.dtype}, expected floats",
                    "a random walk moves continuous parameters: sum over discrete ones in the likelihood",
                )
        return drawn

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each parameter by name, in the order of the prior."""
        return {name: a.shape[1:] for name, a in self.rows(self.example).items()}

    @cached_property
    def d(self) -> int:
        """Number of entries of all parameters."""
        return sum(map(prod, self.shapes.values()))

    def rows(self, theta: Any) -> Rows:
        """Variables of particles."""
        return dict(theta) if isinstance(theta, Mapping) else {"theta": theta}

    def given(self, particles: Mapping[str, np.ndarray]) -> Any:
        """The parameters as functions of users get them: an array, or a mapping."""
        named = {name: particles[name] for name in self.shapes}
        return named if isinstance(self.example, Mapping) else named["theta"]

    def matrix(self, particles: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, d) all parameters as columns."""
        return np.concatenate([particles[name].reshape(len(particles[name]), -1) for name in self.shapes], axis=1)

    def by_name(self, columns: np.ndarray) -> Any:
        """Parameters (..., d) as `given`."""
        ends = np.cumsum([prod(shape) for shape in self.shapes.values()])[:-1]
        parts = np.split(columns, ends, axis=-1)
        return self.given(
            {k: a.reshape((*a.shape[:-1], *s))[()] for (k, s), a in zip(self.shapes.items(), parts, strict=True)}
        )


@dataclass(frozen=True)
class _FromPrior(Proposal):
    """Draws parameters from the prior."""

    theta: _Parameters
    target: Target

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        drawn = self.theta.prior.sample(rng, n)
        rows = self.theta.rows(drawn)
        return Population(rows | self.target.first(drawn, n) | {_PRIOR: self.theta.prior.log_prob(drawn)})


@dataclass(frozen=True)
class _Extend(Update):
    """Weights the particles by the newest datum, and measures their spread for the steps of the next move."""

    theta: _Parameters
    target: Target
    root: np.ndarray | None

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Any
    ) -> Population:
        assert predicted is not None
        theta = self.theta.given(predicted.particles)
        changed, gain = self.target.extend(rng, theta, predicted, observation)
        population = predicted.reweighted(gain)
        root = self._spread(population) if self.root is None else self.root
        changed |= {_ROOT: np.broadcast_to(root, (len(population), *root.shape))}
        new = population.moved({**population.particles, **changed})
        return new.labelled(new.parents, {"power": float(new.particles.get(_POWER, _ONE)[0])})

    def _spread(self, population: Population) -> np.ndarray:
        """(d, d) root of 2.38^2 / d times the covariance of the particles (Roberts, Gelman, Gilks 1997)."""
        d, columns = self.theta.d, self.theta.matrix(population.particles)
        covariance = np.atleast_2d(np.cov(columns, rowvar=False, aweights=population.weights, ddof=0))
        # A small diagonal, for a covariance of fewer distinct particles than dimensions.
        covariance += np.diag(1e-10 * np.diag(covariance) + 1e-300)
        return 2.38 / np.sqrt(d) * np.linalg.cholesky(covariance)


@dataclass(frozen=True)
class _Moves(Transition):
    """Metropolis steps that leave the target before the newest datum invariant, if the particles were resampled."""

    theta: _Parameters
    target: Target
    steps: int
    keep_all: bool

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        if "ancestor" not in population.parents:
            return population
        rows, data = dict(population.particles), self.target.before(observation)
        root, powers = rows.pop(_ROOT)[0], {_POWER: rows.pop(_POWER)} if _POWER in rows else {}
        power = powers[_POWER][0] if powers else 1.0

        def propose(rng: np.random.Generator, now: Rows) -> tuple[Rows, np.ndarray]:
            columns = self.theta.matrix(now)
            theta = self.theta.by_name(columns + rng.standard_normal(columns.shape) @ root.T)
            log_prior = np.asarray(self.theta.prior.log_prob(theta), np.float64)
            new = {**now, **self.theta.rows(theta), _PRIOR: log_prior}
            inside = np.flatnonzero(log_prior > -np.inf)  # the likelihood may not be defined elsewhere
            if len(inside):
                some = theta if len(inside) == len(columns) else take(theta, inside)
                found = self.target.evaluate(rng, some, len(inside), data, now)
                new |= {name: _placed(now[name], inside, a) for name, a in found.items()}
            gain = power * (new[LOG_LIKELIHOOD] - now[LOG_LIKELIHOOD])
            return new, np.where(log_prior > -np.inf, log_prior - now[_PRIOR] + gain, -np.inf)

        chain = [(rows, np.zeros(0)), *metropolis(rng, rows, propose, self.steps)]
        kept = [state for state, _ in (chain if self.keep_all else chain[-1:])]
        moved = {name: np.concatenate([state[name] for state in kept]) for name in rows}
        accepted = float(np.mean([one for _, one in chain[1:]]))
        index = np.tile(np.arange(len(population)), len(kept))
        replaced = self.target.after_move(rng, self.theta.given(moved), moved, accepted, data)
        gain = replaced.get(LOG_LIKELIHOOD, moved[LOG_LIKELIHOOD]) - moved[LOG_LIKELIHOOD]
        powers = {name: np.broadcast_to(power, len(index)) for name in powers}
        return Population(
            {**moved, **replaced, **powers},
            population.log_weights[index] + gain,
            {"previous": index},
            {"accepted": accepted},
        )


def _placed(old: np.ndarray, rows: np.ndarray, new: np.ndarray) -> np.ndarray:
    """The old values with new ones in some rows."""
    if len(rows) == len(old):
        return new
    placed = old.copy()
    placed[rows] = new
    return placed

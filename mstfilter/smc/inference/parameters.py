"""Inference of model parameters by particle Markov chain Monte Carlo.

The posterior of parameters is p(theta) p(y | theta) up to a factor. A filter estimates the evidence p(y | theta)
without bias, and an unbiased estimate in place of the exact value leaves the posterior of a Metropolis chain exact,
if the estimate of the present parameters is kept until a proposal is accepted (Andrieu, Doucet, Holenstein 2010). So
a model with parameters is a function that returns a filter, and the prior is a distribution for each parameter:

>>> from mstfilter.smc import Gamma, Normal, StateSpaceModel, Uniform, bootstrap, pmmh
>>> def model_of(rho, sigma):
...     return StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(rho * x, sigma), lambda x: Normal(x, 0.5))
>>> def filter_of(theta):
...     return bootstrap(model_of(theta["rho"], theta["sigma"]), n=50)
>>> states, observations = model_of(0.8, 0.5).simulate(20, seed=1)
>>> prior = {"rho": Uniform(-1.0, 1.0), "sigma": Gamma(2.0, 0.5)}
>>> chains = pmmh(filter_of, observations, prior, scale={"rho": 0.3, "sigma": 0.2}, n_iterations=50, n_chains=4)
>>> chains["rho"].shape                                              # (iterations, chains)
(50, 4)
>>> mean, accepted = chains["rho"][20:].mean(), chains.accepted

Without names, parameters are a number or an array (d,): then the prior is a distribution of these, or a function of
arrays that returns the log density, and `start` and `scale` are arrays.

- `pmmh` is such a Metropolis chain.
- `ensemble` runs the ensemble sampler emcee with the same estimates. It needs no scale of the steps.
- `particle_gibbs` draws the parameters given the path of states, and then the path by `conditional_path`. Without
  ancestor sampling the early states of the path hardly change.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import islice
from typing import Any, Literal

import numpy as np

from mstfilter.base.errors import InputError, LostRunError, check_choice, check_integer, naming, warn_user
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.first_steps import unexamined
from mstfilter.smc.history import log_evidence
from mstfilter.smc.inference.conditional import conditional_path
from mstfilter.smc.inference.metropolis import metropolis
from mstfilter.smc.inputs import check_observations
from mstfilter.smc.interfaces import Distribution
from mstfilter.smc.models.distributions import Joint, as_distribution
from mstfilter.smc.population import Particles
from mstfilter.smc.streams import Key
from mstfilter.smc.summaries import data_frame, flat_columns, inference_data
from mstfilter.smc.sweep import DIFFERENT_WEIGHTS, can_sweep, sweep_difference, sweep_runs

FilterOf = Callable[[np.ndarray], ParticleFilter]


@dataclass(frozen=True, eq=False)
class Chains:
    """Markov chains of parameters."""

    theta: np.ndarray  #: (n_iterations, n_chains, d) parameters after each iteration
    #: (n_iterations, n_chains) the estimate that belongs to these parameters; NaN in a chain of `particle_gibbs`.
    log_evidence: np.ndarray
    log_density: np.ndarray  #: (n_iterations, n_chains) log prior plus `log_evidence`
    accepted: np.ndarray  #: (n_chains,) share of accepted proposals
    paths: tuple[Particles, ...] = ()  #: of `particle_gibbs`: the path of states after each iteration
    #: Shape of each parameter by name: () for a number, (k,) for a vector of k of the d entries. Empty without names.
    shapes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters; () if they have none."""
        return tuple(self.shapes)

    def __getitem__(self, name: str) -> np.ndarray:
        """(n_iterations, n_chains, ...) values of the parameter with a name."""
        if name not in self.shapes:
            raise KeyError(
                f"there is no parameter {name!r}; there are: {', '.join(self.names) or 'none with a name'}"
            )
        return np.moveaxis(_by_name(np.moveaxis(self.theta, -1, 0), self.shapes)[name], (-2, -1), (0, 1))

    def __repr__(self) -> str:
        n_iterations, n_chains, d = self.theta.shape
        size = f"{n_iterations} iterations of {n_chains} chains, {', '.join(self.names) or f'{d} parameters'}"
        return f"Chains: {size}, accepted {self.accepted.min():.2f} to {self.accepted.max():.2f}"

    def columns(self) -> dict[str, np.ndarray]:
        """Columns of a table: chain, draw, parameters, log evidence and log density. Rows are sorted by chain."""
        numbers = np.indices(self.log_density.shape)
        arrays = {"chain": numbers[1], "draw": numbers[0], **self._parameters()}
        arrays |= {"log_evidence": self.log_evidence, "log_density": self.log_density}
        return flat_columns({name: np.swapaxes(a, 0, 1) for name, a in arrays.items()}, axes=2)

    def _parameters(self) -> dict[str, np.ndarray]:
        return {name: self[name] for name in self.names} if self.names else {"theta": self.theta}

    def to_pandas(self) -> Any:
        """A ``pandas.DataFrame`` of `columns`; MissingLibraryError if pandas is not installed."""
        return data_frame(self.columns())

    def to_arviz(self, discard: int = 0) -> Any:
        """ArviZ's container of the draws without the first `discard` iterations.

        ``sample_stats`` holds the log density (``lp``) and the log evidence.
        """
        stats = {"lp": self.log_density, "log_evidence": self.log_evidence}
        posterior, stats = (
            {name: np.swapaxes(a[discard:], 0, 1) for name, a in group.items()}
            for group in (self._parameters(), stats)
        )
        return inference_data(posterior, stats)

    def autocorrelation_times(self, discard: int = 0) -> np.ndarray:
        """(d,) integrated autocorrelation times in iterations, without the first `discard` iterations.

        emcee logs a warning if the chains are shorter than 50 times the result, because the result is then too low.
        """
        from emcee.autocorr import integrated_time

        return integrated_time(self.theta[discard:], quiet=True)

    def effective_sizes(self, discard: int = 0) -> np.ndarray:
        """(d,) effective sample sizes of the chains without the first `discard` iterations."""
        n_iterations, n_chains, _ = self.theta[discard:].shape
        return n_iterations * n_chains / self.autocorrelation_times(discard)


#: Number of estimates of the evidence at the start of a chain before `pmmh` raises an error.
_N_STARTS = 20


class _Parameters:
    """Log prior, names and forms of parameters, which are vectors (d,) inside of the chains."""

    def __init__(self, prior: Any, start: Any) -> None:
        self.shapes: dict[str, tuple[int, ...]] = {}  #: by name; empty if the parameters have no names
        self.number = False  #: whether the only parameter is a number, as the prior draws it
        self.prior: Distribution | None = None
        if not callable(prior):
            self.prior = as_distribution(prior)
            if isinstance(self.prior, Joint):
                drawn = self.prior.sample(np.random.default_rng(0), 1)
                self.shapes = {name: np.shape(a)[1:] for name, a in drawn.items()}
            self.number = not self.shapes and self.prior.event_shape == ()
            prior = self.prior.log_prob
        if isinstance(start, Mapping) and self.prior is None:
            self.shapes = {str(name): () for name in start}
        self.function = prior

    def log_prior(self, theta: np.ndarray) -> float:
        """Log prior density of a vector (d,)."""
        found = np.asarray(self.function(self.form(theta)), np.float64)
        if found.size != 1:
            raise InputError(f"the log prior has shape {found.shape}, expected one number")
        return found.item()

    def form(self, theta: np.ndarray) -> Any:
        """What `filter_of` and the prior get: entries of ``theta`` by name, the only entry, or the array itself."""
        if self.shapes:
            return _by_name(theta, self.shapes)
        return theta[0] if self.number else theta

    def start(self, given: Any, n: int | None, rng: np.random.Generator) -> np.ndarray:
        """(R, d) first parameters. Without any, `n` draws from the prior; None stands for 4 d."""
        if given is not None:
            return np.atleast_2d(self.vector("start", given))
        if self.prior is None:
            raise InputError("start is missing", "only a prior that is a distribution can be drawn from")
        if n is None:
            n = 4 * np.shape(self.vector("the prior", self.prior.sample(rng, 1)))[-1]
        drawn = self.vector("the prior", self.prior.sample(rng, n))
        return drawn if drawn.ndim == 2 else drawn[:, None]

    def vector(self, what: str, given: Any) -> np.ndarray:
        """Numbers (..., d), from an array, or from a mapping from the names to numbers or arrays (..., *shape)."""
        if not isinstance(given, Mapping) or not self.shapes:
            return _numbers(what, given)
        if set(given) != set(self.shapes):
            raise InputError(f"{what} has the names {sorted(map(str, given))}, expected {sorted(self.shapes)}")
        columns = []
        for name, shape in self.shapes.items():
            a = _numbers(f"{what} of {name}", given[name])
            a = np.broadcast_to(a, shape) if not a.ndim else a  # one number stands for all entries
            chains = a.shape[: a.ndim - len(shape)]
            if a.shape[len(chains) :] != shape or len(chains) > 1:
                each = f"{shape} or (chains, {', '.join(map(str, shape))})" if shape else "one number per chain"
                raise InputError(f"{what} of {name} has shape {a.shape}, expected {each}")
            columns.append(a.reshape(*chains, math.prod(shape)))
        try:
            chains = np.broadcast_shapes(*(a.shape[:-1] for a in columns))
        except ValueError as error:
            shapes = {name: np.shape(given[name]) for name in self.shapes}
            raise InputError(f"{what} has arrays of different lengths: {shapes}") from error
        return np.concatenate([np.broadcast_to(a, (*chains, a.shape[-1])) for a in columns], axis=-1)


def _by_name(theta: np.ndarray, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    """Parameters of the given shapes, from their entries (d, ...): arrays (*shape, ...), or numbers."""
    found, end = {}, 0
    for name, shape in shapes.items():
        begin, end = end, end + math.prod(shape)
        found[name] = theta[begin:end].reshape(*shape, *theta.shape[1:]) if shape else theta[begin]
    return found


@dataclass
class _Posterior:
    """Log prior and estimated log evidence of several parameter vectors, one per row."""

    given_filter_of: Callable[[Any], ParticleFilter]
    observations: list[Any]
    parameters: _Parameters
    batched: bool = False
    reject: bool = False  #: whether parameters for which the model is invalid have no evidence, instead of an error
    n_runs: int = 0  #: so far: the model is examined once
    n_invalid: int = 0  #: of these, for parameters for which the model is invalid

    def filter_of(self, theta: np.ndarray) -> ParticleFilter:
        """The filter of parameters (d,), or (d, m) for a batch."""
        return self.given_filter_of(self.parameters.form(theta))

    def log_prior(self, theta: np.ndarray) -> float:
        return self.parameters.log_prior(theta)

    def __call__(self, rng: np.random.Generator, theta: np.ndarray) -> dict[str, np.ndarray]:
        """Mapping with the given ``theta`` (R, d), ``log_density`` (R,) and ``log_evidence`` (R,)."""
        seeds = rng.integers(2**63, size=len(theta))
        log_prior = np.array([self.log_prior(row) for row in theta])
        if np.isnan(log_prior).any():
            raise InputError(f"the log prior of {theta[np.isnan(log_prior)][0].tolist()} is NaN")
        evidence, possible = np.full(len(theta), -np.inf), log_prior > -np.inf
        if possible.any():
            evidence[possible] = self._estimates(theta[possible], seeds[possible].tolist())
        return {"theta": theta, "log_density": log_prior + evidence, "log_evidence": evidence}

    def _estimates(self, thetas: np.ndarray, seeds: list[int]) -> np.ndarray:
        """Log evidences of filters that run in one sweep, or one by one if they cannot be swept."""
        if self.batched and self.observations:
            if not self.n_runs and not can_sweep(self._filter(thetas[0])):
                self.batched = False
                warnings.warn("the filters are run one by one: a component looks at several particles", stacklevel=5)
            else:
                if not self.n_runs:
                    self._examine(thetas)
                with suppress(InputError):  # the parameters at fault are then found one by one
                    return self._in_one_sweep(thetas, seeds)
        found = np.full(len(thetas), -np.inf)
        for r, (theta, seed) in enumerate(zip(thetas, seeds, strict=True)):
            self.n_runs += 1
            try:
                with suppress(LostRunError), unexamined(self.n_runs > 1), naming(f"parameters {theta.tolist()}"):
                    state, _ = self._filter(theta).run(self.observations, seed)
                    found[r] = state.log_evidence
            except InputError:
                if not self.reject:
                    raise
                self.n_invalid += 1
        return found

    def _filter(self, theta: np.ndarray) -> ParticleFilter:
        filter = self.filter_of(theta)
        if not filter.properly_weighted:
            raise InputError("a component of the filter is not properly weighted: it has no unbiased evidence")
        return filter

    def _in_one_sweep(self, thetas: np.ndarray, seeds: list[int]) -> np.ndarray:
        """Log evidences of filters in one sweep. The components hold one parameter vector for each particle."""
        first = self._filter(thetas[0])

        @lru_cache(maxsize=4)
        def made(runs: tuple[int, ...]) -> ParticleFilter:
            return self.filter_of(np.repeat(thetas[list(runs)], first.n, axis=0).T)

        key = Key(int(seeds[0])).child("sweep", *map(int, seeds[1:3]))
        runs = sweep_runs(
            first, self.observations, seeds, key, {"z": log_evidence}, lambda runs: made(tuple(runs.tolist()))
        )
        found = np.array([-np.inf if run.lost else run.rows["z"][-1] for run in runs])
        self.n_runs += len(thetas)
        return found

    def _examine(self, thetas: np.ndarray) -> None:
        """Examine the model, and compare the weights of two parameter vectors together with those of each."""
        first, different = self._filter(thetas[0]), False
        with suppress(LostRunError), naming(f"parameters {thetas[0].tolist()}"):
            list(islice(first.iterate(self.observations, 0), 3))
        with suppress(LostRunError):
            alone = [self.filter_of(theta) for theta in thetas[:2]]
            both = self.filter_of(np.repeat(thetas[:2], first.n, axis=0).T)
            different = len(alone) == 2 and sweep_difference(alone, both, self.observations) == "weights"
        if different:
            raise InputError(*DIFFERENT_WEIGHTS)


def pmmh(
    filter_of: Callable[[Any], ParticleFilter],
    observations: Sequence[Any],
    prior: Any,
    start: Any = None,
    scale: Any = None,
    n_iterations: int = 1000,
    seed: int = 0,
    *,
    n_chains: int = 1,
    batched: bool = False,
    invalid: Literal["raise", "reject"] = "raise",
) -> Chains:
    """Particle marginal Metropolis-Hastings: a random walk on the parameters.

    Choose n so that the log evidence has a standard deviation of about 1 at the posterior mean (Doucet, Pitt,
    Deligiannidis, Kohn 2015).

    Parameters
    ----------
    filter_of : callable
        ``(theta) -> ParticleFilter``. The components of the filter must be properly weighted. ``theta`` is what the
        prior draws, as in `smc2`: a mapping from names to numbers or vectors, an array (d,), or a number if the prior
        is a distribution of numbers. It is an array (d,) if the prior is a function.
    prior : mapping, Distribution or callable
        A distribution for each name; a joint distribution, such as `Product`, `MultivariateNormal` or one of
        scipy.stats; or a function ``(theta) -> float``, the log density, -inf outside of the support.
    start : mapping, (d,) or (R, d) array_like, optional
        First parameters of one chain or of R chains: numbers or arrays (R,) by name, vectors (k,) or (R, k) where the
        prior of a name draws vectors, or an array in the order in which `filter_of` takes them. By default,
        `n_chains` chains start at draws from the prior.
    scale : mapping, (d,) or (d, d) array_like
        Standard deviations, by name as in `start`, or covariance of a step. A good choice is 2.4 / sqrt(d) posterior
        standard deviations.
    batched : bool
        Whether ``filter_of`` also accepts arrays (m,) in place of numbers, or (d, m) in place of (d,): parameters for
        each of the m particles.
        The filters of all chains then run as one batch. To combine a parameter with particles (n, k), use
        ``theta[0][..., None]``. If a component looks at several particles, the filters run one by one, with a
        warning.
    invalid : "raise" or "reject"
        What happens at parameters for which the model is invalid, such as a standard deviation that underflows to 0
        or weights that are NaN: an error that names them, or a rejection of the proposal. Rejections end with one
        warning that counts them; the posterior is then that of the prior restricted to valid parameters. At the start
        of a chain the model must be valid, so a mistake in the set-up is an error.

    Raises
    ------
    InputError
        If the prior is zero at the start of a chain, or if 20 estimates of the evidence at the start are zero.
    """
    check_choice("invalid", invalid, ("raise", "reject"))
    parameters, key = _Parameters(prior, start), Key(seed).child("pmmh")
    check_integer("n_chains", n_chains)
    theta = parameters.start(start, n_chains, key.child("prior").generator())
    if theta.ndim > 2:
        raise InputError(f"start has shape {theta.shape}, expected (d,) or (chains, d)")
    if scale is None:
        raise InputError("scale is missing", "give the standard deviation of a step for each parameter")
    root = _step_root(parameters.vector("scale", scale), theta.shape[1])
    check_integer("n_iterations", n_iterations)
    posterior = _Posterior(filter_of, list(check_observations(observations)), parameters, batched)

    def propose(rng: np.random.Generator, now: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        new = posterior(rng, now["theta"] + rng.standard_normal(theta.shape) @ root.T)
        return new, new["log_density"] - now["log_density"]

    state, steps = _start(posterior, key.child("start"), theta), []
    posterior.reject = invalid == "reject"  # from now on: a model that is invalid everywhere is a mistake
    for i in range(n_iterations):
        [(state, accepted)] = metropolis(key.child(i).generator(), state, propose)
        steps.append({**state, "accepted": accepted})
    if posterior.n_invalid:
        n = posterior.n_invalid
        warn_user(
            f"pmmh: {n} proposals were rejected because the model is invalid at their parameters", "see `invalid`"
        )
    found = {name: np.stack([step[name] for step in steps]) for name in steps[0]}
    accepted = found["accepted"].mean(axis=0)
    return Chains(found["theta"], found["log_evidence"], found["log_density"], accepted, shapes=parameters.shapes)


def _start(posterior: _Posterior, key: Key, theta: np.ndarray) -> dict[str, np.ndarray]:
    """The first parameters with their log densities. Estimates of the evidence that are zero are drawn again."""
    state = posterior(key.generator(), theta)
    for attempt in range(1, _N_STARTS + 1):
        lost = np.flatnonzero(~np.isfinite(state["log_density"]))
        if not len(lost):
            break
        impossible = [r for r in lost if posterior.log_prior(theta[r]) == -np.inf]
        if impossible or attempt == _N_STARTS:
            r = (impossible or lost)[0]
            what = "the log prior is -inf" if impossible else f"{_N_STARTS} estimates of the evidence are 0"
            raise InputError(
                f"the start {theta[r].tolist()} of chain {r} has log density {state['log_density'][r]}: {what}",
                "start where the prior and the likelihood are positive, or take more particles",
            )
        for name, values in posterior(key.child(attempt).generator(), theta[lost]).items():
            state[name][lost] = values
    return state


def _numbers(name: str, value: Any) -> np.ndarray:
    """A new float64 array of the values of parameters. Raises InputError if they are not finite numbers."""
    if isinstance(value, Mapping):
        raise InputError(
            f"{name} is a mapping with the keys {', '.join(map(str, value))}, expected an array of numbers",
            f"parameters have an order and no names: {name}={[*value.values()]}",
            "a prior with names gives them names: prior={'rho': Uniform(-1.0, 1.0), ...}",
        )
    try:
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is {value!r}, expected an array of numbers") from error
    if not np.isfinite(numbers).all():
        raise InputError(f"{name} is {numbers.tolist()}, expected finite numbers")
    return numbers


def _step_root(scale: Any, d: int) -> np.ndarray:
    """(d, d) square root of the covariance of a step, from standard deviations or a covariance."""
    scale = _numbers("scale", scale)
    if scale.ndim < 2 and scale.shape in ((), (1,), (d,)) and np.isfinite(scale).all() and (scale > 0).all():
        return np.diag(np.broadcast_to(scale, d))
    try:
        if scale.shape == (d, d):
            return np.linalg.cholesky(scale)
    except np.linalg.LinAlgError:
        pass
    raise InputError(
        f"scale is {scale.tolist()}, expected {d} positive standard deviations or a ({d}, {d}) covariance"
    )


def ensemble(
    filter_of: Callable[[Any], ParticleFilter],
    observations: Sequence[Any],
    prior: Any,
    start: Any = None,
    n_iterations: int = 1000,
    seed: int = 0,
    *,
    n_walkers: int | None = None,
    batched: bool = False,
) -> Chains:
    """Ensemble MCMC (Goodman and Weare 2010) by emcee, with the estimated evidence as the likelihood.

    emcee keeps the log density and the estimated evidence (as a blob) of a walker until the walker moves. No estimate
    is drawn again for unchanged parameters, so the chain converges to the exact posterior.

    Parameters
    ----------
    filter_of, observations, prior, batched
        As in `pmmh`. If `batched` is True, the filters of half of the walkers run as one batch.
    start : mapping of (n_walkers,) arrays or (n_walkers, d) array_like, optional
        First parameters of the walkers. At least 2 d walkers are needed, with different parameters. By default,
        `n_walkers` (or 4 d) walkers start at draws from the prior.
    """
    import emcee

    parameters, key = _Parameters(prior, start), Key(seed).child("ensemble")
    theta = parameters.start(start, n_walkers, key.child("prior").generator())
    if theta.ndim != 2 or len(theta) < 2 * theta.shape[1]:
        raise InputError(f"start has shape {theta.shape}, expected (walkers, d) with at least 2 d walkers")
    check_integer("n_iterations", n_iterations)
    posterior = _Posterior(filter_of, list(check_observations(observations)), parameters, batched)
    rng = key.generator()

    def log_density(thetas: np.ndarray) -> np.ndarray:
        found = posterior(rng, thetas)
        return np.stack([found["log_density"], found["log_evidence"]], axis=1)

    sampler = emcee.EnsembleSampler(*theta.shape, log_density, vectorize=True)
    own = np.random.RandomState(np.random.MT19937(rng.integers(2**63)))  # emcee draws from the legacy generator
    sampler.run_mcmc(emcee.State(theta, random_state=own.get_state()), n_iterations)
    evidence = sampler.get_blobs().reshape(n_iterations, len(theta))
    accepted = sampler.acceptance_fraction
    return Chains(sampler.get_chain(), evidence, sampler.get_log_prob(), accepted, shapes=parameters.shapes)


def particle_gibbs(
    filter_of: FilterOf,
    observations: Sequence[Any],
    draw: Callable[[np.random.Generator, np.ndarray, Particles], Any],
    start: Any,
    n_iterations: int,
    seed: int = 0,
) -> Chains:
    """Particle Gibbs: draws the parameters given a path of states, then the path given the parameters.

    Parameters
    ----------
    filter_of : callable
        ``(theta) -> ParticleFilter``. The filter must be supported by `conditional_path`.
    draw : callable
        ``(rng, theta, path) -> theta`` (d,), a kernel that leaves p(theta | path, y) invariant. Examples are an exact
        draw if the prior is conjugate, and a Metropolis step with `path_log_prob`.
    start : (d,) array_like
        First parameters.
    """
    check_integer("n_iterations", n_iterations)
    key = Key(seed).child("particle gibbs")
    theta = _numbers("start", start)
    if theta.ndim != 1:
        raise InputError(f"start has shape {theta.shape}, expected (d,)")
    path = conditional_path(filter_of(theta), observations, key.child("start"))
    thetas, paths, moved = np.empty((n_iterations, 1, len(theta))), [], 0
    for i in range(n_iterations):
        streams, old = key.child(i), theta
        theta = np.array(draw(streams.child("theta").generator(), theta.copy(), path), np.float64)
        if theta.shape != old.shape:
            raise InputError(f"draw returned parameters of shape {theta.shape}, expected {old.shape}")
        path = conditional_path(filter_of(theta), observations, streams, path)
        moved += not np.array_equal(theta, old)
        thetas[i] = theta
        paths.append(path)
    unknown = np.full((n_iterations, 1), np.nan)
    return Chains(thetas, unknown, unknown, np.array([moved / n_iterations]), tuple(paths))

"""Estimation of the parameters of a model by particle Markov chain Monte Carlo or by a sequential sampler.

A model with parameters is a function that returns a filter:

>>> def filter_of(theta):
...     rho, sigma = theta
...     return bootstrap(StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(rho * x, sigma), observation), n=200)
>>> chains = pmmh(filter_of, observations, log_prior, start=[0.5, 1.0], scale=[0.1, 0.1], n_iterations=5000)
>>> chains.theta[1000:].mean(axis=(0, 1)), chains.autocorrelation_times()

- `pmmh` is a Metropolis chain whose likelihood is the filter's unbiased estimate. The estimate for the current
  parameters is kept until a proposal is accepted. So the chain has the exact posterior, for any number of particles
  (Andrieu, Doucet, Holenstein 2010).
- `ensemble` does the same with the walkers of emcee, which need no scale.
- `particle_gibbs` draws the parameters given the path of states, and then the path given the parameters.
  `conditional_path` draws the path by a filter in which one particle follows the present path (conditional SMC). If
  the transition has a density, that particle also draws its ancestors (Lindsten, Jordan, Schön 2014). Without a
  density, the early states hardly change.
- `smc_sampler` moves particles from the prior to the posterior by tempering (Del Moral, Doucet, Jasra 2006). The
  likelihood must be computable. `smc_sampler` estimates the evidence, and can find several modes. ``waste_free=True``
  uses all moved states.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from mstfilter.errors import InputError, LostRunError, check_integer, check_number
from mstfilter.smc.batching import NotTogether, RunFilters, run_together
from mstfilter.smc.conditional import conditional_path
from mstfilter.smc.distributions import as_distribution
from mstfilter.smc.export import Table, draws_tree, flat_columns
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.history import log_evidence
from mstfilter.smc.interfaces import Distribution, Resampler
from mstfilter.smc.population import Particles, Population, take
from mstfilter.smc.resampling import Systematic
from mstfilter.smc.state_space import metropolis
from mstfilter.smc.streams import Key, rows_of

FilterOf = Callable[[np.ndarray], ParticleFilter]


@dataclass(frozen=True, eq=False)
class Chains(Table):
    """Markov chains of parameters."""

    theta: np.ndarray  #: (n_iterations, n_chains, d) parameters after each iteration
    #: (n_iterations, n_chains) the estimate that belongs to these parameters; NaN in a chain of `particle_gibbs`.
    log_evidence: np.ndarray
    log_density: np.ndarray  #: (n_iterations, n_chains) log prior plus `log_evidence`
    accepted: np.ndarray  #: (n_chains,) share of accepted proposals
    paths: tuple[Particles, ...] = ()  #: of `particle_gibbs`: the path of states after each iteration

    def __repr__(self) -> str:
        n_iterations, n_chains, d = self.theta.shape
        size = f"{n_iterations} iterations of {n_chains} chains, {d} parameters"
        return f"Chains: {size}, accepted {self.accepted.min():.2f} to {self.accepted.max():.2f}"

    def columns(self) -> dict[str, np.ndarray]:
        """Columns of `to_pandas`: chain, draw, parameters, log evidence and log density, chain after chain."""
        numbers = np.indices(self.log_density.shape)
        arrays = {"chain": numbers[1], "draw": numbers[0], "theta": self.theta, **self._stats()}
        return flat_columns({name: np.swapaxes(a, 0, 1) for name, a in arrays.items()}, axes=2)

    def _stats(self) -> dict[str, np.ndarray]:
        return {"log_evidence": self.log_evidence, "log_density": self.log_density}

    def to_arviz(self, names: Sequence[str] = (), discard: int = 0) -> Any:
        """The chains as an ``xarray.DataTree`` for ArviZ (see `mstfilter.smc.export`).

        Parameters
        ----------
        names : sequence of str
            One name per parameter. Default: one variable ``theta`` (chain, draw, d).
        discard : int
            Number of iterations to discard at the beginning.

        Returns
        -------
        xarray.DataTree
            Groups ``posterior`` and ``sample_stats``. The group ``sample_stats`` has ``log_evidence``, and ``lp`` for
            the log density, except for `particle_gibbs`, where they are unknown. Draws are equally weighted.
        """
        theta = self.theta[discard:].swapaxes(0, 1)
        if names and len(names) != theta.shape[2]:
            raise InputError(f"there are {len(names)} names for {theta.shape[2]} parameters")
        posterior = {name: theta[..., k] for k, name in enumerate(names)} or {"theta": theta}
        stats = {name.replace("log_density", "lp"): a[discard:].T for name, a in self._stats().items()}
        return draws_tree(posterior, {} if np.isnan(self.log_density).all() else stats)

    def autocorrelation_times(self, discard: int = 0) -> np.ndarray:
        """(d,) integrated autocorrelation times in iterations, by emcee, without the first `discard` iterations.

        emcee logs a warning if the chains are shorter than 50 times the result, since the result is then too low.
        """
        from emcee.autocorr import integrated_time

        return integrated_time(self.theta[discard:], quiet=True)

    def effective_sizes(self, discard: int = 0) -> np.ndarray:
        """(d,) numbers of independent draws that estimate a mean equally well, after `discard` iterations."""
        n_iterations, n_chains, _ = self.theta[discard:].shape
        return n_iterations * n_chains / self.autocorrelation_times(discard)


#: Estimates of the evidence of the start of a chain before `pmmh` gives up.
_N_STARTS = 20


@dataclass
class _Posterior:
    """Log prior and estimated log evidence of rows of parameters."""

    filter_of: FilterOf
    data: list[list[Any]]  #: one sequence of observations for all chains, or one for each
    log_prior: Callable[[np.ndarray], float]
    batched: bool = False
    n_sweeps: int = 0

    def __call__(
        self, rng: np.random.Generator, theta: np.ndarray, chains: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        """``theta`` (R, d) of some chains (by default all), with ``log_density`` and ``log_evidence`` (R,)."""
        seeds = rng.integers(2**63, size=len(theta))
        log_prior = np.array([float(self.log_prior(row)) for row in theta])
        if np.isnan(log_prior).any():
            raise InputError(f"the log prior of {theta[np.isnan(log_prior)][0].tolist()} is NaN")
        evidence, possible = np.full(len(theta), -np.inf), log_prior > -np.inf
        if possible.any():
            rows = (np.arange(len(theta)) if chains is None else chains)[possible]
            data = self.data if len(self.data) == 1 else [self.data[r] for r in rows]
            evidence[possible] = self._estimates(theta[possible], data, seeds[possible].tolist())
        return {"theta": theta, "log_density": log_prior + evidence, "log_evidence": evidence}

    def _estimates(self, thetas: np.ndarray, data: list[list[Any]], seeds: list[int]) -> np.ndarray:
        """Log evidences of filters in one batch, or one by one if a batch is impossible."""
        if self.batched:
            try:
                return self._in_one_sweep(thetas, data, seeds)
            except NotTogether as why:
                self.batched = False
                warnings.warn(f"the filters are run one by one: {why.slot}: {why.reason}", stacklevel=5)
        return self._one_by_one(thetas, data, seeds)

    def _filter(self, theta: np.ndarray) -> ParticleFilter:
        filter = self.filter_of(theta)
        if not filter.properly_weighted:
            raise InputError("a component of the filter is not properly weighted: it has no unbiased evidence")
        return filter

    def _one_by_one(self, thetas: np.ndarray, data: list[list[Any]], seeds: list[int]) -> np.ndarray:
        found = np.full(len(thetas), -np.inf)
        for r, (theta, seed) in enumerate(zip(thetas, seeds, strict=True)):
            with suppress(LostRunError):
                state, _ = self._filter(theta).run(data[r % len(data)], seed)
                found[r] = state.log_evidence
        return found

    def _in_one_sweep(self, thetas: np.ndarray, data: list[list[Any]], seeds: list[int]) -> np.ndarray:
        """The estimates of a batch whose components hold the parameters of each row.

        Batches 0, 1, 2, 4, 8, ... are compared with single runs.
        """
        first = self._filter(thetas[0])
        for slot in ("initial", "transition", "update"):
            if getattr(first, slot) is not None and getattr(first, slot).batched is False:
                raise InputError(
                    f"with batched=True the {slot} of the filter must be batched",
                    "see mstfilter.smc.batching; StateSpaceModel(..., batched=True) makes it so",
                )

        @lru_cache(maxsize=4)
        def made(runs: tuple[int, ...]) -> ParticleFilter:
            return self.filter_of(np.repeat(thetas[list(runs)], first.n, axis=0).T.view(rows_of(first.n)))

        filters = RunFilters(lambda run: self.filter_of(thetas[run]), lambda runs: made(tuple(runs.tolist())))
        check = not self.n_sweeps & (self.n_sweeps - 1)
        self.n_sweeps += 1
        runs = run_together(filters, data, seeds, {"z": log_evidence}, check=check, rounding=True)
        return np.array([-np.inf if run.lost else run.rows["z"][-1] for run in runs])


def pmmh(
    filter_of: FilterOf,
    observations: Sequence[Any],
    log_prior: Callable[[np.ndarray], float],
    start: Any,
    scale: Any,
    n_iterations: int,
    seed: int = 0,
    *,
    batched: bool = False,
    paired: bool = False,
) -> Chains:
    """Particle marginal Metropolis-Hastings: a random walk on the parameters.

    The number of particles determines how well the chain mixes. The log evidence should have a standard deviation of
    about 1 at the posterior mean (Doucet, Pitt, Deligiannidis, Kohn 2015).

    Parameters
    ----------
    filter_of : callable
        ``(theta) -> ParticleFilter`` for parameters (d,). The components of the filter must be properly weighted.
    log_prior : callable
        ``(theta) -> float``; -inf outside of the support.
    start : (d,) or (R, d) array_like
        First parameters of one chain or of R chains.
    scale : (d,) or (d, d) array_like
        Standard deviations, or covariance, of a step. 2.4 / sqrt(d) posterior standard deviations are a good choice.
    batched : bool
        Whether ``filter_of`` also accepts parameters (d, m), with a column for each of m particles of several chains.
        All chains then move in one batch of filters, see `mstfilter.smc.batching`. A parameter that is combined with
        particles (n, k) is ``theta[0][..., None]``. The estimates equal those of single runs up to rounding of the
        parameters. Some estimates are compared. If the estimates differ, InputError is raised, or single runs are
        made with a warning.
    paired : bool
        If True, `observations` are sequences of observations, one for each chain.

    Raises
    ------
    InputError
        If a chain starts where the prior is zero, or 20 estimates of the evidence there are zero.
    """
    theta = np.array(start, np.float64, ndmin=2)
    root = _step_root(scale, theta.shape[1])
    check_integer("n_iterations", n_iterations)
    data = [list(ys) for ys in observations] if paired else [list(observations)]
    if paired and len(data) != len(theta):
        raise InputError(f"there are {len(data)} sequences of observations for {len(theta)} chains")
    posterior = _Posterior(filter_of, data, log_prior, batched)
    key = Key(seed).child("pmmh")

    def propose(rng: np.random.Generator, now: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        new = posterior(rng, now["theta"] + rng.standard_normal(theta.shape) @ root.T)
        return new, new["log_density"] - now["log_density"]

    state, steps = _start(posterior, key.child("start"), theta), []
    for i in range(n_iterations):
        [(state, accepted)] = metropolis(key.child(i).generator(), state, propose)
        steps.append({**state, "accepted": accepted})
    found = {name: np.stack([step[name] for step in steps]) for name in steps[0]}
    return Chains(found["theta"], found["log_evidence"], found["log_density"], found["accepted"].mean(axis=0))


def _start(posterior: _Posterior, key: Key, theta: np.ndarray) -> dict[str, np.ndarray]:
    """The first parameters with their estimates. Lost estimates are drawn again."""
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
        for name, values in posterior(key.child(attempt).generator(), theta[lost], lost).items():
            state[name][lost] = values
    return state


def _step_root(scale: Any, d: int) -> np.ndarray:
    """(d, d) square root of the covariance of a step, from standard deviations or a covariance."""
    scale = np.asarray(scale, np.float64)
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
    filter_of: FilterOf,
    observations: Sequence[Any],
    log_prior: Callable[[np.ndarray], float],
    start: Any,
    n_iterations: int,
    seed: int = 0,
    *,
    moves: Any = None,
    batched: bool = False,
) -> Chains:
    """Ensemble MCMC by emcee over the estimated evidence (Goodman and Weare 2010).

    emcee keeps the log density of a walker until the walker moves, together with the estimated evidence (as a blob).
    For parameters that do not change, no estimate is drawn again. So the chain has the exact posterior.

    Parameters
    ----------
    filter_of, observations, log_prior, batched
        As in `pmmh`; with `batched`, half of the walkers are evaluated in one sweep.
    start : (n_walkers, d) array_like
        First parameters. At least 2 d different parameters are needed.
    moves : optional
        Moves of emcee; the default is its stretch move.
    """
    import emcee

    theta = np.array(start, np.float64)
    if theta.ndim != 2 or len(theta) < 2 * theta.shape[1]:
        raise InputError(f"start has shape {theta.shape}, expected (walkers, d) with at least 2 d walkers")
    check_integer("n_iterations", n_iterations)
    posterior = _Posterior(filter_of, [list(observations)], log_prior, batched)
    rng = Key(seed).child("ensemble").generator()

    def log_density(thetas: np.ndarray) -> np.ndarray:
        found = posterior(rng, thetas)
        return np.stack([found["log_density"], found["log_evidence"]], axis=1)

    sampler = emcee.EnsembleSampler(*theta.shape, log_density, moves=moves, vectorize=True)
    own = np.random.RandomState(np.random.MT19937(rng.integers(2**63)))  # emcee draws from the legacy generator
    sampler.run_mcmc(emcee.State(theta, random_state=own.get_state()), n_iterations)
    evidence = sampler.get_blobs().reshape(n_iterations, len(theta))
    return Chains(sampler.get_chain(), evidence, sampler.get_log_prob(), sampler.acceptance_fraction)


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
        ``(theta) -> ParticleFilter`` that `conditional_path` accepts.
    draw : callable
        ``(rng, theta, path) -> theta`` (d,), a kernel that leaves p(theta | path, y) invariant. The draw is an exact
        draw if the prior is conjugate, or a Metropolis step with `path_log_prob`.
    start : (d,) array_like
        First parameters.
    """
    check_integer("n_iterations", n_iterations)
    key = Key(seed).child("particle gibbs")
    theta = np.array(start, np.float64)
    path = conditional_path(filter_of(theta), observations, key.child("start"))
    thetas, paths, moved = np.empty((n_iterations, 1, len(theta))), [], 0
    for i in range(n_iterations):
        streams, old = key.child(i), theta
        theta = np.asarray(draw(streams.child("theta").generator(), theta, path), np.float64)
        if theta.shape != old.shape:
            raise InputError(f"draw returned parameters of shape {theta.shape}, expected {old.shape}")
        path = conditional_path(filter_of(theta), observations, streams, path)
        moved += not np.array_equal(theta, old)
        thetas[i] = theta
        paths.append(path)
    unknown = np.full((n_iterations, 1), np.nan)
    return Chains(thetas, unknown, unknown, np.array([moved / n_iterations]), tuple(paths))


@dataclass(frozen=True, eq=False)
class TemperedSample:
    """Result of `smc_sampler`."""

    population: Population  #: weighted draws of the posterior, particles (n,) or (n, d)
    temperatures: np.ndarray  #: (k,) powers of the likelihood, from 0 to 1
    accepted: np.ndarray  #: (k - 1,) share of accepted moves at each temperature above 0

    @property
    def log_evidence(self) -> float:
        """Log of the estimated integral of prior times likelihood."""
        return self.population.log_mean_weight


def smc_sampler(
    prior: Any,
    log_likelihood: Callable[[np.ndarray], np.ndarray],
    n: int,
    seed: int = 0,
    *,
    share: float = 0.5,
    steps: int = 5,
    waste_free: bool = False,
    temperatures: Sequence[float] | None = None,
    scale: Any = None,
    resampler: Resampler = Systematic(),  # noqa: B008 (frozen)
) -> TemperedSample:
    """Sequential Monte Carlo from the prior to the posterior, by powers of the likelihood.

    At each temperature the particles are weighted, resampled, and moved by Metropolis steps that leave prior *
    likelihood^temperature invariant. With fixed `temperatures` and `scale`, the estimate of the evidence is unbiased.
    Values that are chosen from the particles add a bias of order 1 / n (Beskos, Jasra, Kantas, Thiery 2016).

    Parameters
    ----------
    prior : Distribution
        Prior of floating-point parameters.
    log_likelihood : callable
        ``(theta) -> (n,)`` of parameters (n,) or (n, d).
    share : float
        At the next temperature, the effective sample size falls to this share of `n`.
    steps : int
        Number of Metropolis steps per temperature.
    waste_free : bool
        If True, keep all states of the moves (waste-free SMC; Dau and Chopin 2022). n / (`steps` + 1) of n particles
        are resampled. The next `n` particles are these and their states after each step. A temperature then takes
        about `n` evaluations of the likelihood instead of `steps` times `n`. So `n` and `steps` can be larger, for
        example n = 5000 and steps = 99. `n` must be a multiple of `steps` + 1.
    temperatures : sequence of float, optional
        Increasing numbers above 0 that end with 1.
    scale : float, (d,) or (d, d) array_like, optional
        Standard deviations or covariance of a step. Default: 2.38 / sqrt(d) times the root of the particles'
        covariance.
    """
    check_integer("n", n, at_least=2)
    check_integer("steps", steps)
    check_number("share", share, above=0, below=1)
    planned = None if temperatures is None else [float(v) for v in temperatures]
    if planned is not None and (not planned or planned[-1] != 1 or (np.diff([0.0, *planned]) <= 0).any()):
        raise InputError(f"temperatures are {planned}, expected increasing numbers above 0 that end with 1")
    if waste_free and n % (steps + 1):
        raise InputError(f"n is {n}, expected a multiple of steps + 1 = {steps + 1}, as waste_free is True")
    target, key = _Target(as_distribution(prior), log_likelihood), Key(seed).child("tempering")
    state = target.scored(target.prior.sample(key.child("initial").generator(), n))
    population, reached, accepted = Population(state["theta"]), [0.0], []
    while reached[-1] < 1:
        streams, log_l = key.child(len(reached)), state["log_likelihood"]
        now = planned[len(reached) - 1] if planned else _next_temperature(population, log_l, reached[-1], share * n)
        population = population.reweighted((now - reached[-1]) * log_l)
        root = _spread(population) if scale is None else _step_root(scale, state["theta"][0].size)
        rng = streams.child("resampler").generator()
        chosen = resampler.resample(rng, population, n // (steps + 1) if waste_free else n)
        start = take(state, chosen.parents["ancestor"])
        states, share_of_moves = target.moved(streams.child("move").generator(), start, now, root, steps)
        kept = states if waste_free else states[-1:]
        state = {name: np.concatenate([values[name] for values in kept]) for name in start}
        population = Population(state["theta"], np.tile(chosen.log_weights, len(kept)))
        reached.append(now)
        accepted.append(share_of_moves)
    return TemperedSample(population, np.array(reached), np.array(accepted))


@dataclass(frozen=True)
class _Target:
    """Prior times powers of a likelihood."""

    prior: Distribution
    log_likelihood: Callable[[np.ndarray], np.ndarray]

    def scored(self, theta: np.ndarray) -> dict[str, np.ndarray]:
        """`theta` with its log prior and log likelihood. The likelihood is not evaluated where the prior is zero."""
        log_prior, log_l = np.asarray(self.prior.log_prob(theta), np.float64), np.full(len(theta), -np.inf)
        inside = log_prior > -np.inf
        if inside.any():
            log_l[inside] = self._checked_log_likelihood(theta[inside])
        return {"theta": theta, "log_prior": log_prior, "log_likelihood": log_l}

    def _checked_log_likelihood(self, theta: np.ndarray) -> np.ndarray:
        found = np.asarray(self.log_likelihood(theta), np.float64)
        if found.shape != (len(theta),) or not (found < np.inf).all():
            raise InputError(
                f"log likelihood has shape {found.shape} and maximum {found.max()}, expected ({len(theta)},) numbers "
                "below infinity"
            )
        return found

    def moved(
        self, rng: np.random.Generator, start: dict[str, np.ndarray], temperature: float, root: np.ndarray, steps: int
    ) -> tuple[list[dict[str, np.ndarray]], float]:
        """The states after 0 to `steps` Metropolis steps, and the share of accepted moves."""

        def propose(rng: np.random.Generator, now: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], np.ndarray]:
            step = rng.standard_normal((len(now["theta"]), len(root))) @ root.T
            new = self.scored(now["theta"] + step.reshape(now["theta"].shape))
            gain = new["log_likelihood"] - now["log_likelihood"]
            return new, new["log_prior"] - now["log_prior"] + temperature * gain

        chain = list(metropolis(rng, start, propose, steps))
        return [start, *(state for state, _ in chain)], float(np.mean([accepted for _, accepted in chain]))


def _next_temperature(population: Population, log_l: np.ndarray, now: float, target: float) -> float:
    """The temperature at which the effective sample size is `target`; 1 if the size stays above."""
    from scipy.optimize import brentq

    def excess(temperature: float) -> float:
        return population.reweighted((temperature - now) * log_l).ess - target

    if excess(1.0) >= 0:
        return 1.0
    smallest = now + 1e-9 * (1 - now)
    return smallest if excess(smallest) <= 0 else float(brentq(excess, smallest, 1.0, xtol=1e-12))


def _spread(population: Population) -> np.ndarray:
    """Square root of 2.38^2 / d times the covariance of the particles (Roberts, Gelman, Gilks 1997)."""
    theta = population.particles.reshape(len(population), -1)
    d = theta.shape[1]
    covariance = np.atleast_2d(np.cov(theta, rowvar=False, aweights=population.weights))
    # A small multiple of the identity, for a covariance of fewer distinct particles than dimensions.
    covariance += 1e-10 * (np.trace(covariance) + 1e-300) * np.eye(d)
    return 2.38 / np.sqrt(d) * np.linalg.cholesky(covariance)

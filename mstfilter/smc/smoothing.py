"""Smoothing: the states given all observations, from the populations of a filter.

>>> record = keep(bootstrap(model, n=500), observations, seed=0)
>>> paths = backward_paths(np.random.default_rng(1), record, Dynamics(model), n=200)
>>> [population.weights @ population.particles for population in paths]        # E[x_t | y_0 .. y_T], t = 0 .. T

Three smoothers of a record return a tuple with one population per time:

- `genealogy` follows the ancestors of the last particles (Kitagawa 1996). `genealogy` needs only the record. After
  many resamplings all paths have the same beginning.
- `fixed_lag` follows the ancestors of the particles `lag` steps later (Kitagawa and Sato 2001). `fixed_lag` has more
  distinct particles. The result has a bias if the state depends on observations more than `lag` steps later.
- `backward_paths` draws paths backwards by the density of the transition (Godsill, Doucet, West 2004, FFBSi), without
  path degeneracy. A step takes N densities per path, or a few with ``method="mcmc"`` or ``"rejection"``.

The paths are valid for any filter with proper weights: guided, auxiliary, with moves, resampled before or after.

`paris` yields smoothed means of sums over the path while observations arrive, in constant memory.

`mstfilter.smc.conditional` draws single paths, also of programs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from mstfilter.errors import InputError, check_integer, check_number
from mstfilter.fields import Bounded, PositiveInt
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.inputs import check_observations, split_input
from mstfilter.smc.interfaces import DensityTransition, State
from mstfilter.smc.population import Particles, Population, count_particles, take
from mstfilter.smc.resampling import draw_rows, independent_draws
from mstfilter.smc.state_space import metropolis
from mstfilter.smc.streams import Key

BackwardMethod = Literal["exact", "mcmc", "rejection"]
#: Pairs of particles per call of `log_prob`.
_PAIRS = 1_000_000


@dataclass(frozen=True, eq=False)
class Record:
    """The populations of a run, with the observations."""

    #: After each observation; ``parents["previous"]`` are indices into the one before.
    populations: tuple[Population, ...]
    observations: tuple[Any, ...]  #: none if missing

    def __len__(self) -> int:
        return len(self.populations)

    def parents(self, t: int) -> np.ndarray:
        """(n,) indices in population t - 1 of the parents of the particles at time t."""
        return known_parents(self.populations[t], t)


def known_parents(population: Population, t: int) -> np.ndarray:
    """(n,) indices of the parents in the previous population; InputError if a particle has no known parent."""
    index = population.parents.get("previous")
    if index is None or (index < 0).any():
        raise InputError(
            f"step {t}: {'no' if index is None else 'not every'} particle has a known parent",
            "a filter with a proposal of new particles has no paths",
        )
    return index


def keep(filter: ParticleFilter, observations: Iterable[Any], seed: int | State = 0) -> Record:
    """Run a filter and store every population. Memory grows with n times the number of steps."""
    ys = tuple(check_observations(observations))
    if not ys:
        raise InputError("there are no observations to smooth over")
    populations = []
    for state, _ in filter.iterate(ys, seed):
        assert state.population is not None
        populations.append(state.population)
    return Record(tuple(populations), ys)


def genealogy(record: Record) -> tuple[Population, ...]:
    """Paths of the last particles. Row k of all populations is one path, weighted by the last particle."""
    return _traced(record, len(record) - 1, 0)


def fixed_lag(record: Record, lag: int) -> tuple[Population, ...]:
    """At each time t, the ancestors of the particles at t + `lag` (or the end), with the weights of these particles.

    A lag of 0 steps returns the filter's populations.
    """
    check_integer("lag", lag, at_least=0)
    last = len(record) - 1
    return tuple(_traced(record, min(t + lag, last), t)[0] for t in range(len(record)))


def _traced(record: Record, end: int, begin: int) -> tuple[Population, ...]:
    """Ancestors from `begin` to `end` of the particles at `end`."""
    weights = record.populations[end].log_weights
    index = np.arange(len(weights))
    path = []
    for t in range(end, begin - 1, -1):
        path.append(Population(take(record.populations[t].realised().particles, index), weights))
        if t > begin:
            index = record.parents(t)[index]
    return tuple(reversed(path))


def backward_paths(
    rng: np.random.Generator,
    record: Record,
    transition: DensityTransition,
    n: int,
    method: BackwardMethod = "exact",
    *,
    steps: int = 1,
    log_bound: float | None = None,
) -> tuple[Population, ...]:
    """Draw `n` equally weighted paths from the smoothing distribution. Row k of all populations is a path.

    The predecessor of a state x_{t+1} is particle i at time t with probability proportional to w_i f(x_{t+1} | x_i).

    Parameters
    ----------
    transition : DensityTransition
        The transition of the model, ``Dynamics(model)``. A transition with a proposal cannot be used, since its
        density is that of the proposal.
    method : "exact", "mcmc" or "rejection"
        "exact" (Godsill, Doucet, West 2004) evaluates the densities of all N particles for each path: n N per step.

        "rejection" (Douc, Garivier, Moulines, Olsson 2011) draws particles by weight and accepts them with
        probability f / max f. The law is that of "exact". A path that has accepted none of N particles is drawn as by
        "exact" (Dau and Chopin 2023). So a step takes at most about 2 n N densities, on average n times the mean of
        max f / p(x_{t+1} | y_0 .. y_t).

        "mcmc" (Bunch and Godsill 2013) starts at the parent of x_{t+1} in the record and makes independent Metropolis
        steps, which leave the law of "exact" invariant: (1 + `steps`) n densities. The method needs a record with
        parents. The chain need not converge. Given x_{t+1}, a parent already has the distribution of "exact" after
        independent selections of a bootstrap filter, and up to order 1 / N after other selections. So a small number
        of steps causes no additional bias (Dau and Chopin 2023). Steps reduce the variance. Without accepted steps,
        the paths are those of `genealogy`.
    steps : int
        Number of Metropolis steps of "mcmc".
    log_bound : float
        For "rejection": an upper bound of ``transition.log_prob``. InputError if a density exceeds it.
    """
    check_integer("n", n)
    kernel = _Backward(transition, method, steps, log_bound)
    last = record.populations[-1].realised()
    index = _by_weight(rng, last, n)
    path = [Population(take(last.particles, index))]
    for t in range(len(record) - 2, -1, -1):
        population = record.populations[t].realised()
        parents = record.parents(t + 1)[index] if method == "mcmc" else None
        move = kernel.move(population, path[-1].particles, record.observations[t + 1], t)
        index = kernel.draw(rng, move, parents, 1)[:, 0]
        path.append(Population(take(population.particles, index)))
    return tuple(reversed(path))


@dataclass(frozen=True)
class _Move:
    """All moves from a population at time t to n later particles."""

    population: Population
    later: Particles
    transition: DensityTransition
    y: Any
    t: int

    def log_density(self, index: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """(k,) log density of the moves from particles `index` to the later ones at `rows` (default: all)."""
        later = self.later if rows is None else take(self.later, rows)
        found = self.transition.log_prob(take(self.population.particles, index), later, self.y)
        density = np.asarray(found, dtype=np.float64)
        if density.shape != index.shape:
            raise InputError(f"log_prob returned shape {density.shape}, expected {index.shape}")
        if not (density < np.inf).all():
            raise _impossible(self.t)
        return density

    def exact(self, rng: np.random.Generator, rows: np.ndarray, n_draws: int) -> np.ndarray:
        """(k, n_draws) indices of predecessors of the later particles at `rows`."""
        m = len(self.population)
        index, block = np.empty((len(rows), n_draws), np.int64), max(1, _PAIRS // m)
        for begin in range(0, len(rows), block):
            some = rows[begin : begin + block]
            density = self.log_density(np.tile(np.arange(m), len(some)), np.repeat(some, m))
            log_weights = self.population.log_weights + density.reshape(-1, m)
            for k in range(n_draws):
                index[begin : begin + block, k] = draw_log(rng, log_weights, self.t)
        return index

    def metropolis(self, rng: np.random.Generator, parents: np.ndarray, steps: int, n_draws: int) -> np.ndarray:
        """(n, n_draws) states of chains that start at the parents, taken every `steps` steps."""
        density = self.log_density(parents)
        if not (density > -np.inf).all():
            raise _impossible(self.t)

        def propose(rng: np.random.Generator, now: dict[str, Any]) -> tuple[dict[str, Any], np.ndarray]:
            index = _by_weight(rng, self.population, len(parents))
            density = self.log_density(index)
            return {"index": index, "density": density}, density - now["density"]

        chain = metropolis(rng, {"index": parents, "density": density}, propose, steps * n_draws)
        draws = [state["index"] for k, (state, _) in enumerate(chain, 1) if k % steps == 0]
        return np.stack(draws, axis=1)

    def rejected(self, rng: np.random.Generator, n: int, log_bound: float) -> np.ndarray:
        """(n,) indices of predecessors of the n later particles, by rejection."""
        index, left, trials = np.empty(n, np.int64), np.arange(n), 0
        while len(left) and trials < len(self.population):
            each = max(1, n // len(left))  # a round evaluates at most n densities
            new = _by_weight(rng, self.population, each * len(left)).reshape(len(left), each)
            density = self.log_density(new.ravel(), np.repeat(left, each))
            if density.max() > log_bound + 1e-9 * (1 + abs(log_bound)):
                raise InputError(
                    f"step {self.t}: the log density of a move is {density.max()}, more than log_bound = {log_bound}"
                )
            accepted = (density - log_bound > -rng.standard_exponential(len(density))).reshape(new.shape)
            first, some = accepted.argmax(axis=1), accepted.any(axis=1)
            index[left[some]] = new[some, first[some]]
            left, trials = left[~some], trials + each
        if len(left):
            index[left] = self.exact(rng, left, 1)[:, 0]
        return index


@dataclass(frozen=True)
class _Backward(Bounded):
    """Draws predecessors of later particles. The fields are arguments of `backward_paths`."""

    transition: DensityTransition
    method: BackwardMethod
    steps: PositiveInt
    log_bound: float | None

    def __post_init__(self) -> None:
        if self.method == "rejection":
            check_number("log_bound", self.log_bound)

    def move(self, population: Population, later: Particles, observation: Any, t: int) -> _Move:
        """The moves from a population at time `t` to the particles after `observation`."""
        y, u = split_input(observation)
        return _Move(population, later, self.transition.at_step(t + 1, u), y, t)

    def draw(self, rng: np.random.Generator, move: _Move, parents: np.ndarray | None, n_draws: int) -> np.ndarray:
        """(n, n_draws) indices. `parents` (n,) of the later particles are for "mcmc"."""
        if parents is not None:
            return move.metropolis(rng, parents, self.steps, n_draws)
        n = count_particles(move.later)
        if self.log_bound is not None and self.method == "rejection":
            return np.stack([move.rejected(rng, n, self.log_bound) for _ in range(n_draws)], axis=1)
        return move.exact(rng, np.arange(n), n_draws)


def paris(
    filter: ParticleFilter,
    observations: Iterable[Any],
    functional: Callable[[int, Particles | None, Particles], np.ndarray],
    transition: DensityTransition,
    seed: int = 0,
    n_draws: int = 2,
    method: BackwardMethod = "exact",
    *,
    steps: int = 1,
    log_bound: float | None = None,
) -> Iterator[np.ndarray]:
    """Smoothed means of an additive functional, online (PaRIS; Olsson and Westerborn 2017, algorithm 2).

    After each observation `paris` yields E[h_0(x_0) + h_1(x_0, x_1) + .. + h_t(x_{t-1}, x_t) | y_0 .. y_t]. Only the
    last population is stored, with one statistic per particle: the mean over `n_draws` predecessors drawn backwards.
    A step takes n^2 densities, or (1 + `steps` `n_draws`) n with "mcmc".

    Parameters
    ----------
    filter : ParticleFilter
        A filter with proper weights.
    functional : callable
        ``(t, previous, particles) -> (n,) or (n, k)`` is h_t of paired rows. `previous` is None at t = 0.
    transition : DensityTransition
        The transition of the model, ``Dynamics(model)``.
    n_draws : int
        At least 2, since with one draw the variance grows as that of `genealogy`.
    method, steps, log_bound
        As in `backward_paths`.

    Yields
    ------
    float64 scalar or (k,)
    """
    check_integer("n_draws", n_draws)
    if not filter.properly_weighted:
        raise InputError("a component of the filter is not properly weighted: its smoothed means have another limit")
    kernel = _Backward(transition, method, steps, log_bound)
    past: Population | None = None
    statistic = np.zeros(0)
    state = filter.start(seed)
    for t, observation in enumerate(observations):
        state, _ = filter.step(state, observation)
        assert state.population is not None
        now = state.population.realised()
        if past is None:
            statistic = np.asarray(functional(t, None, now.particles), np.float64)
        else:
            rng = Key(seed).child("paris", t).generator()
            parents = known_parents(now, t) if method == "mcmc" else None
            move = kernel.move(past, now.particles, observation, t - 1)
            index = kernel.draw(rng, move, parents, n_draws).ravel()
            later = take(now.particles, np.repeat(np.arange(len(now)), n_draws))
            statistic = statistic[index] + functional(t, take(past.particles, index), later)
            statistic = statistic.reshape(len(now), n_draws, *statistic.shape[1:]).mean(axis=1)
        past = now
        yield np.tensordot(now.weights, statistic, axes=1)


def _by_weight(rng: np.random.Generator, population: Population, n: int) -> np.ndarray:
    """(n,) indices drawn independently by weight, in random order."""
    index = independent_draws(rng, population.weights, n)
    rng.shuffle(index)
    return index


def draw_log(rng: np.random.Generator, log_weights: np.ndarray, t: int | None = None) -> np.ndarray:
    """Draw one index per row of (n, m) log weights."""
    top = log_weights.max(axis=1, keepdims=True)
    if not np.isfinite(top).all():
        raise _impossible(t)
    return draw_rows(np.exp(log_weights - top), rng.random(len(log_weights)))


def _impossible(t: int | None) -> InputError:
    where = "" if t is None else f"from step {t} to {t + 1}: "
    return InputError(
        f"{where}a particle has no possible predecessor, or a density is NaN or +inf",
        "backward paths need the density of the transition that moved the particles",
    )

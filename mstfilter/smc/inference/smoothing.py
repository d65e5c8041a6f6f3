"""Smoothers, which use the populations of a run to estimate the states given all observations.

A filter says what is known about x_t after y_0 .. y_t. Later observations say more about x_t. The ancestors of the
last particles are draws of x_t given all observations, but after many resamplings few distinct ones are left.
Backward sampling draws new paths instead: from the end, it chooses particle i at time t as the predecessor of
x_{t+1} with probability proportional to w_i f(x_{t+1} | x_i).

>>> import numpy as np
>>> from mstfilter.smc import Dynamics, Normal, StateSpaceModel, backward_paths, bootstrap, keep
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> record = keep(bootstrap(model, n=500), [0.3, -0.1, 0.8], seed=0)
>>> paths = backward_paths(np.random.default_rng(1), record, Dynamics(model), n=200)
>>> means = [population.weights @ population.particles for population in paths]        # E[x_t | y_0 .. y_2]

`genealogy`, `fixed_lag` and `backward_paths` take a `Record` of any properly weighted filter and return a tuple with
one population per time. The page "Smoothing" of the documentation compares them with `two_filter`, and with
`additive`, which needs no record. `conditional_path` draws single paths of models and of programs. Reference:
Godsill, Doucet, West (2004).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from mstfilter.base.errors import InputError, check_choice, check_component, check_integer, naming
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.inference.metropolis import metropolis
from mstfilter.smc.inputs import check_observations, split_input
from mstfilter.smc.interfaces import DensityTransition, State
from mstfilter.smc.population import Particles, Population, count_particles, take
from mstfilter.smc.resampling import draw_log, search

BackwardMethod = Literal["exact", "mcmc", "rejection"]
#: Largest number of pairs of particles in a call of `log_prob`.
_PAIRS = 1_000_000


@dataclass(frozen=True, eq=False)
class Record:
    """The populations of a run, with the observations."""

    #: One after each observation; ``parents["previous"]`` are indices into the population before it.
    populations: tuple[Population, ...]
    observations: tuple[Any, ...]  #: None for a missing observation
    first: int = 0  #: step of the first population

    def __len__(self) -> int:
        return len(self.populations)

    def parents(self, t: int) -> np.ndarray:
        """(n,) indices in population t - 1 of the parents of the particles at time t."""
        with naming(f"step {t}"):
            return self.populations[t].known_parents()


def keep(filter: ParticleFilter, observations: Iterable[Any], seed: int | State = 0) -> Record:
    """Run a filter and store every population. Memory grows with n times the number of steps.

    If `seed` is a state, the run continues from this state, and the record begins with the next step.
    """
    ys = tuple(check_observations(observations))
    if not ys:
        raise InputError("there are no observations to smooth over")
    populations = []
    for state, _ in filter.iterate(ys, seed):
        assert state.population is not None
        populations.append(state.population)
    return Record(tuple(populations), ys, state.t - len(ys))


def genealogy(record: Record) -> tuple[Population, ...]:
    """Paths of the last particles. The rows k of all populations form a path with the weight of its last state."""
    return _traced(record, len(record) - 1, 0)


def fixed_lag(record: Record, lag: int) -> tuple[Population, ...]:
    """For each time t, the ancestors at t of the particles at t + `lag` (or the end), with the weights of the latter.

    A lag of 0 returns the populations of the filter.
    """
    check_integer("lag", lag, at_least=0)
    last = len(record) - 1
    return tuple(_traced(record, min(t + lag, last), t)[0] for t in range(len(record)))


def _traced(record: Record, end: int, begin: int) -> tuple[Population, ...]:
    """Ancestors, at the times from `begin` to `end`, of the particles at time `end`."""
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
    """Draw `n` equally weighted paths from the smoothing distribution. The rows k of all populations form a path.

    The predecessor of a state x_{t+1} is particle i at time t with probability proportional to w_i f(x_{t+1} | x_i).

    Parameters
    ----------
    transition : DensityTransition
        The transition of the model, ``Dynamics(model)``. A transition with a proposal must not be used.
    method : "exact", "mcmc" or "rejection"
        "exact" (FFBSi: Godsill, Doucet, West 2004) evaluates n N densities per step: all N particles for each path.

        "mcmc" (Bunch and Godsill 2013) starts at the parent of x_{t+1} in the record and makes Metropolis steps that
        leave the distribution of "exact" invariant. The method evaluates (1 + `steps`) n densities per time, and the
        record must have parents. Few steps suffice (Dau and Chopin 2023): the parent of x_{t+1} has the distribution
        of "exact" up to an error of order 1 / N. Without accepted steps, the paths are those of `genealogy`.

        "rejection" (Douc, Garivier, Moulines, Olsson 2011) has the law of "exact", and needs `log_bound`. It draws by
        w_i and accepts with probability f / bound. Rows that are hardly ever accepted are drawn as by "exact" (Dau
        and Chopin 2023).
    steps : int
        Number of Metropolis steps of "mcmc".
    log_bound : float, optional
        Upper bound of log f, for "rejection": -log(sd sqrt(2 pi)) for Gaussian noise.
    """
    check_integer("n", n)
    kernel = Backward(transition, method, steps, log_bound)
    last = record.populations[-1].realised()
    index = _by_weight(rng, last, n)
    path = [Population(take(last.particles, index))]
    for t in range(len(record) - 2, -1, -1):
        population = record.populations[t].realised()
        move = kernel.moves(population, path[-1].particles, record.observations[t + 1], record.first + t)
        index = move.draw(rng, record.parents(t + 1)[index] if method == "mcmc" else None)[0]
        path.append(Population(take(population.particles, index)))
    return tuple(reversed(path))


@dataclass(frozen=True)
class Backward:
    """The backward kernel, as the arguments of `backward_paths` define it."""

    transition: DensityTransition
    method: BackwardMethod = "exact"
    steps: int = 1
    log_bound: float | None = None

    def __post_init__(self) -> None:
        check_component("transition", self.transition, DensityTransition)
        check_choice("method", self.method, get_args(BackwardMethod))
        check_integer("steps", self.steps)
        if self.method == "rejection" and self.log_bound is None:
            raise InputError(
                "the method rejection needs log_bound, an upper bound of the log density of the transition"
            )

    def moves(self, population: Population, later: Particles, observation: Any, t: int) -> Moves:
        """The possible moves from a population at time t to particles at time t + 1, which saw `observation`."""
        y, u = split_input(observation)
        return Moves(self, population, later, self.transition.at_step(t + 1, u), y, t)


@dataclass(frozen=True)
class Moves:
    """The possible moves from a population at time t to n particles at time t + 1."""

    kernel: Backward
    population: Population
    later: Particles
    transition: DensityTransition
    y: Any
    t: int

    def __len__(self) -> int:
        return count_particles(self.later)

    def draw(self, rng: np.random.Generator, parents: np.ndarray | None, draws: int = 1) -> np.ndarray:
        """(draws, n) indices of predecessors at time t. "mcmc" starts at the `parents` (n,)."""
        n = len(self)
        if self.kernel.method == "exact":
            return np.concatenate([self._by_log(rng, log_w, draws) for _, log_w in self.blocks(np.arange(n))], axis=1)
        if self.kernel.method == "rejection":
            return self._rejection(rng, np.tile(np.arange(n), draws)).reshape(draws, n)
        assert parents is not None
        return self._metropolis(rng, parents, draws)

    def log_density(self, index: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """(k,) log density of the moves from particles `index` to the later particles `rows` (default: all)."""
        later = self.later if rows is None else take(self.later, rows)
        found = self.transition.log_prob(take(self.population.particles, index), later, self.y)
        density = np.asarray(found, dtype=np.float64)
        if density.shape != index.shape:
            raise InputError(f"log_prob returned shape {density.shape}, expected {index.shape}")
        if not (density < np.inf).all():
            raise _impossible(self.t)
        return density

    def blocks(self, rows: np.ndarray, strict: bool = True) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Some of the later particles at a time, with the log weights (k, m) of their predecessors.

        If `strict`, raises InputError if all are impossible.
        """
        m, size = len(self.population), max(1, _PAIRS // len(self.population))
        for some in np.split(rows, range(size, len(rows), size)):
            density = self.log_density(np.tile(np.arange(m), len(some)), np.repeat(some, m))
            log_weights = density.reshape(-1, m)
            log_weights += self.population.log_weights
            if strict and (log_weights.max(axis=1) == -np.inf).any():
                raise _impossible(self.t)
            yield some, log_weights

    def _by_log(self, rng: np.random.Generator, log_weights: np.ndarray, draws: int) -> np.ndarray:
        return np.stack([draw_log(rng, log_weights) for _ in range(draws)])

    def _rejection(self, rng: np.random.Generator, rows: np.ndarray) -> np.ndarray:
        """(k,) indices of predecessors of the later particles `rows`."""
        index, left, bound = np.empty(len(rows), np.int64), np.arange(len(rows)), self.kernel.log_bound
        assert bound is not None
        while len(left):
            proposed = _by_weight(rng, self.population, len(left))
            density = self.log_density(proposed, rows[left])
            if (density > bound + 1e-9).any():
                raise InputError(f"log_bound is {bound}, and a log density from step {self.t} is {density.max()}")
            accepted = -rng.standard_exponential(len(left)) < density - bound
            index[left[accepted]] = proposed[accepted]
            left, share = left[~accepted], np.mean(accepted)
            if share < 20 / len(self.population):  # the exact draw takes less time than the expected trials
                break
        if len(left):
            rest = [draw_log(rng, log_weights) for _, log_weights in self.blocks(rows[left])]
            index[left] = np.concatenate(rest)
        return index

    def _metropolis(self, rng: np.random.Generator, parents: np.ndarray, draws: int) -> np.ndarray:
        """States of chains that start at the parents, after every `steps` Metropolis steps."""
        density = self.log_density(parents)
        if not (density > -np.inf).all():
            raise _impossible(self.t)

        def propose(rng: np.random.Generator, now: dict[str, Any]) -> tuple[dict[str, Any], np.ndarray]:
            index = _by_weight(rng, self.population, len(parents))
            density = self.log_density(index)
            return {"index": index, "density": density}, density - now["density"]

        steps, found = self.kernel.steps, np.empty((draws, len(parents)), np.int64)
        chain = metropolis(rng, {"index": parents, "density": density}, propose, steps * draws)
        for k, (state, _) in enumerate(chain):
            found[k // steps] = state["index"]  # the last of each `steps` stays
        return found


def _by_weight(rng: np.random.Generator, population: Population, n: int) -> np.ndarray:
    """(n,) indices drawn independently by weight, in random order."""
    weights = population.log_weights - population.log_weights.max()
    return search(np.exp(weights, out=weights), rng.random(n))


def _impossible(t: int) -> InputError:
    return InputError(
        f"from step {t} to {t + 1}: a particle has no possible predecessor, or a density is NaN or +inf",
        "backward paths need the density of the transition that moved the particles",
    )

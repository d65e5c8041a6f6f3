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
one population per time. The page "Smoothing" of the documentation compares them. `conditional_path` draws single
paths of models and of programs. Reference: Godsill, Doucet, West (2004).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from mstfilter.base.errors import InputError, check_choice, check_component, check_integer, naming
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.inference.metropolis import moved
from mstfilter.smc.inputs import check_observations, split_input
from mstfilter.smc.interfaces import DensityTransition, State
from mstfilter.smc.population import Particles, Population, take
from mstfilter.smc.resampling import draw_log, independent_draws

BackwardMethod = Literal["exact", "mcmc"]
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
) -> tuple[Population, ...]:
    """Draw `n` equally weighted paths from the smoothing distribution. The rows k of all populations form a path.

    The predecessor of a state x_{t+1} is particle i at time t with probability proportional to w_i f(x_{t+1} | x_i).

    Parameters
    ----------
    transition : DensityTransition
        The transition of the model, ``Dynamics(model)``. A transition with a proposal must not be used.
    method : "exact" or "mcmc"
        "exact" (FFBSi: Godsill, Doucet, West 2004) evaluates n N densities per step: all N particles for each path.

        "mcmc" (Bunch and Godsill 2013) starts at the parent of x_{t+1} in the record and makes Metropolis steps that
        leave the distribution of "exact" invariant. The method evaluates (1 + `steps`) n densities per time, and the
        record must have parents. Few steps suffice (Dau and Chopin 2023): the parent of x_{t+1} has the distribution
        of "exact" up to an error of order 1 / N. Without accepted steps, the paths are those of `genealogy`.
    steps : int
        Number of Metropolis steps of "mcmc".
    """
    check_integer("n", n)
    check_component("transition", transition, DensityTransition)
    check_choice("method", method, get_args(BackwardMethod))
    check_integer("steps", steps)
    last = record.populations[-1].realised()
    index = _by_weight(rng, last, n)
    path = [Population(take(last.particles, index))]
    for t in range(len(record) - 2, -1, -1):
        population = record.populations[t].realised()
        y, u = split_input(record.observations[t + 1])
        step = record.first + t
        move = _Move(population, path[-1].particles, transition.at_step(step + 1, u), y, step)
        index = move.metropolis(rng, record.parents(t + 1)[index], steps) if method == "mcmc" else move.exact(rng, n)
        path.append(Population(take(population.particles, index)))
    return tuple(reversed(path))


@dataclass(frozen=True)
class _Move:
    """The possible moves from a population at time t to n particles at time t + 1."""

    population: Population
    later: Particles
    transition: DensityTransition
    y: Any
    t: int

    def _log_density(self, index: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """(k,) log density of the moves from particles `index` to the later particles `rows` (default: all)."""
        later = self.later if rows is None else take(self.later, rows)
        found = self.transition.log_prob(take(self.population.particles, index), later, self.y)
        density = np.asarray(found, dtype=np.float64)
        if density.shape != index.shape:
            raise InputError(f"log_prob returned shape {density.shape}, expected {index.shape}")
        if not (density < np.inf).all():
            raise _impossible(self.t)
        return density

    def exact(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n,) indices of predecessors at time t, drawn from the exact distribution."""
        m, drawn = len(self.population), []
        for rows in np.split(np.arange(n), range(max(1, _PAIRS // m), n, max(1, _PAIRS // m))):
            density = self._log_density(np.tile(np.arange(m), len(rows)), np.repeat(rows, m))
            log_weights = self.population.log_weights + density.reshape(-1, m)
            if (log_weights.max(axis=1) == -np.inf).any():
                raise _impossible(self.t)
            drawn.append(draw_log(rng, log_weights))
        return np.concatenate(drawn)

    def metropolis(self, rng: np.random.Generator, parents: np.ndarray, steps: int) -> np.ndarray:
        """(n,) indices of predecessors after Metropolis steps that start at the parents."""
        density = self._log_density(parents)
        if not (density > -np.inf).all():
            raise _impossible(self.t)

        def propose(rng: np.random.Generator, now: dict[str, Any]) -> tuple[dict[str, Any], np.ndarray]:
            index = _by_weight(rng, self.population, len(parents))
            density = self._log_density(index)
            return {"index": index, "density": density}, density - now["density"]

        last, _ = moved(rng, {"index": parents, "density": density}, propose, steps)
        return last["index"]


def _by_weight(rng: np.random.Generator, population: Population, n: int) -> np.ndarray:
    """(n,) indices drawn independently by weight, in random order."""
    index = independent_draws(rng, population.weights, n)
    rng.shuffle(index)
    return index


def _impossible(t: int) -> InputError:
    return InputError(
        f"from step {t} to {t + 1}: a particle has no possible predecessor, or a density is NaN or +inf",
        "backward paths need the density of the transition that moved the particles",
    )

"""Smoothing: the states given all observations, from the populations of a filter.

>>> record = keep(bootstrap(model, n=500), observations, seed=0)
>>> paths = backward_paths(np.random.default_rng(1), record, Dynamics(model), n=200)
>>> [population.weights @ population.particles for population in paths]        # E[x_t | y_0 .. y_T], t = 0 .. T

Three smoothers return a tuple with one population per time:

- `genealogy` follows the ancestors of the last particles (Kitagawa 1996). It needs only the record; after many
  resamplings all paths share their beginning.
- `fixed_lag` follows the ancestors of the particles `lag` steps later (Kitagawa and Sato 2001): more distinct
  particles, and a bias if the state depends on observations more than `lag` steps later.
- `backward_paths` draws paths backwards by the density of the transition (Godsill, Doucet, West 2004, FFBSi). No path
  degeneracy, at the cost of n densities per path and step.

They are valid for any filter with proper weights: guided, auxiliary, with moves, resampled before or after.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.errors import InputError, check_component, check_integer
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.interfaces import DensityTransition, State
from mstfilter.smc.population import Population, take

#: Pairs of particles per call of `log_prob`.
_PAIRS = 1_000_000


@dataclass(frozen=True, eq=False)
class Record:
    """The populations of a run, with the observations.

    Parameters
    ----------
    populations : tuple of Population
        After each observation; ``parents["previous"]`` are indices into the one before.
    observations : tuple
        None if missing.
    """

    populations: tuple[Population, ...]
    observations: tuple[Any, ...]

    def __len__(self) -> int:
        return len(self.populations)

    def parents(self, t: int) -> np.ndarray:
        """(n,) indices into population t - 1 of the particles at time t."""
        index = self.populations[t].parents.get("previous")
        if index is None or (index < 0).any():
            raise InputError(
                f"step {t}: {'no' if index is None else 'not every'} particle has a known parent",
                "a filter with a proposal of new particles has no paths",
            )
        return index


def keep(filter: ParticleFilter, observations: Iterable[Any], seed: int | State = 0) -> Record:
    """Run a filter and keep every population; memory grows with n times the number of steps."""
    ys = tuple(observations)
    if not ys:
        raise InputError("there are no observations to smooth over")
    populations = []
    for state, _ in filter.iterate(ys, seed):
        assert state.population is not None
        populations.append(state.population)
    return Record(tuple(populations), ys)


def genealogy(record: Record) -> tuple[Population, ...]:
    """Paths of the last particles: row k of all populations is one path, weighted by the last particle."""
    return _traced(record, len(record) - 1, 0)


def fixed_lag(record: Record, lag: int) -> tuple[Population, ...]:
    """At each time t the ancestors of the particles at t + `lag` (or the end), with their weights.

    Parameters
    ----------
    record : Record
    lag : int
        Steps; 0 returns the filter's populations.
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
    rng: np.random.Generator, record: Record, transition: DensityTransition, n: int
) -> tuple[Population, ...]:
    """Draw `n` equally weighted paths from the smoothing distribution: row k of all populations is a path.

    Parameters
    ----------
    rng : Generator
    record : Record
        Its parents are not needed.
    transition : DensityTransition
        The transition of the model, ``Dynamics(model)``. The density of a guided transition is that of its proposal,
        so it cannot be used.
    n : int
        Paths.
    """
    check_component("transition", transition, DensityTransition)
    check_integer("n", n)
    last = record.populations[-1].realised()
    index = _drawn(rng, np.broadcast_to(last.log_weights, (n, len(last))))
    path = [Population(take(last.particles, index))]
    for t in range(len(record) - 2, -1, -1):
        population, y = record.populations[t].realised(), record.observations[t + 1]
        later, m = path[-1].particles, len(population)
        index = np.empty(n, np.int64)
        block = max(1, _PAIRS // m)
        for begin in range(0, n, block):
            rows = np.arange(begin, min(begin + block, n))
            old = take(population.particles, np.tile(np.arange(m), len(rows)))
            density = np.asarray(transition.log_prob(old, take(later, np.repeat(rows, m)), y), dtype=np.float64)
            if density.shape != (len(rows) * m,):
                raise InputError(f"log_prob returned shape {density.shape}, expected ({len(rows) * m},)")
            index[rows] = _drawn(rng, population.log_weights + density.reshape(len(rows), m), t)
        path.append(Population(take(population.particles, index)))
    return tuple(reversed(path))


def _drawn(rng: np.random.Generator, log_weights: np.ndarray, t: int | None = None) -> np.ndarray:
    """Draw one index per row of (n, m) log weights."""
    top = log_weights.max(axis=1, keepdims=True)
    if not np.isfinite(top).all():
        where = "" if t is None else f"from step {t} to {t + 1}: "
        raise InputError(
            f"{where}a particle has no possible predecessor, or a density is NaN or +inf",
            "backward paths need the density of the transition that moved the particles",
        )
    cumulative = np.cumsum(np.exp(log_weights - top), axis=1)
    points = rng.random((len(cumulative), 1)) * cumulative[:, -1:]
    # The index is the number of entries at or below the point; "at" skips weights of zero.
    index = (cumulative <= points).sum(axis=1)
    return np.minimum(index, (cumulative < cumulative[:, -1:]).sum(axis=1))

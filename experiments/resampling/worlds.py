"""The four models with a known posterior: data, filter, and error of an estimate."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

sys.path.append(str(Path(__file__).resolve().parent.parent / "miniature"))
from miniature_filters import bootstrap_filter, exact_filter, state_weights
from miniature_world import Miniature

from mstfilter.mst.belief import SameSegmentation, WeightedCoverage
from mstfilter.smc import (
    Branching,
    Equivalence,
    EssBelow,
    ExactEquality,
    Gaussian,
    Never,
    Normal,
    ParticleFilter,
    Population,
    Resampler,
    Similarity,
    StateSpaceModel,
    Student,
    bootstrap,
)

BRANCHES = 4


@dataclass(frozen=True, eq=False)
class Data:
    """Observations, their log evidence log p(y), and exact (or reference) filtering results `answers` (T, ...)."""

    observations: Sequence[Any]
    log_evidence: float
    answers: np.ndarray


@dataclass(frozen=True, eq=False)
class World:
    """A model: its bootstrap filter, its data by seed, and the estimate () or (S,) that is compared with the answers.

    `sizes` are the numbers of particles of the plain and of the branching filter.
    """

    filter: Callable[[int], ParticleFilter]
    data: Callable[[int], Data]
    estimate: Callable[[Population], np.ndarray]
    similarity: Similarity
    equivalence: Equivalence
    sizes: tuple[int, int] = (100, 20)


def plain(world: World, resampler: Resampler, n: int) -> ParticleFilter:
    """Bootstrap filter that resamples n of n particles before a prediction if the ESS is below n / 2."""
    return replace(world.filter(n), resampler=resampler, trigger=EssBelow(0.5), resample="before")


def branching(world: World, resampler: Resampler, n: int) -> ParticleFilter:
    """Filter with n particles and BRANCHES * n candidates at every step, of which the resampler keeps n."""
    filter = world.filter(n)
    return replace(
        filter,
        transition=Branching(filter.transition, BRANCHES),
        resampler=resampler,
        trigger=Never(),
        resample="after",
    )


# --- AR(1) in noise, Kalman ----------------------------------------------------------------------------------------
R, S, Q, STEPS = 0.9, 0.6, 0.4, 25
S0 = S / np.sqrt(1 - R**2)


@cache
def kalman(seed: int) -> Data:
    """Data of a seed, with log evidence and filtered means by the Kalman filter."""
    rng = np.random.default_rng([seed, 21])
    x, ys = rng.normal(0, S0), []
    for _ in range(STEPS):
        ys.append(float(rng.normal(x, Q)))
        x = rng.normal(R * x, S)
    m, v, total, means = 0.0, S0**2, 0.0, []
    for t, y in enumerate(ys):
        if t:
            m, v = R * m, R**2 * v + S**2
        total += stats.norm.logpdf(y, m, np.sqrt(v + Q**2))
        gain = v / (v + Q**2)
        m, v = m + gain * (y - m), (1 - gain) * v
        means.append(m)
    return Data(ys, float(total), np.array(means))


AR1 = StateSpaceModel.of(Normal(0.0, S0), lambda x: Normal(R * x, S), lambda x: Normal(x, Q))

# --- stochastic volatility, reference by big runs ------------------------------------------------------------------
VOLATILITY = StateSpaceModel.of(
    Normal(-1.0, 0.5 / np.sqrt(1 - 0.9**2)),
    lambda h: Normal(-1.0 + 0.9 * (h + 1.0), 0.5),
    lambda h: Student(8.0, 0.0, np.exp(h / 2)),
)


def volatility_data(reference: int) -> Callable[[int], Data]:
    """Function seed -> data, equal for all seeds. Answers are means of four runs with `reference` particles."""

    @cache
    def known() -> Data:
        rng = np.random.default_rng(22)
        h, ys = rng.normal(-1.0, 0.5 / np.sqrt(1 - 0.9**2)), []
        for _ in range(STEPS):
            ys.append(float(np.exp(h / 2) * rng.standard_t(8)))
            h = -1.0 + 0.9 * (h + 1.0) + 0.5 * rng.normal()
        evidence, means = [], []
        for seed in range(4):
            steps = [
                (s.log_evidence, mean(s.population))
                for s, _ in bootstrap(VOLATILITY, reference).iterate(ys, 9000 + seed)
            ]
            evidence.append(steps[-1][0])
            means.append([m for _, m in steps])
        top = max(evidence)
        return Data(ys, top + float(np.log(np.mean(np.exp(np.array(evidence) - top)))), np.mean(means, axis=0))

    return lambda seed: known()


def mean(population: Population) -> np.ndarray:
    """Weighted mean of a scalar state."""
    return np.asarray(population.weights @ population.particles)


# --- shelves of boxes, forward algorithm ---------------------------------------------------------------------------
CHANGE, COLOURS, SEEN, ROOM = np.array([0.5, 0.3, 0.2]), np.array([0.5, 0.3, 0.2]), 0.8, 26


def change(rng: np.random.Generator, shelf: tuple[int, ...]) -> tuple[int, ...]:
    """One step of one shelf, a sorted tuple of colours."""
    u = rng.random()
    if u < CHANGE[1]:
        return tuple(sorted((*shelf, int(np.searchsorted(np.cumsum(COLOURS), rng.random())))))
    if u < CHANGE[1] + CHANGE[2] and shelf:
        gone = int(rng.integers(len(shelf)))
        return shelf[:gone] + shelf[gone + 1 :]
    return shelf


@cache
def shelf_data(seed: int) -> Data:
    """Observed counts of boxes. They depend only on the number of boxes, a birth-death chain with an exact filter."""
    rng = np.random.default_rng([seed, 23])
    shelf: tuple[int, ...] = ()
    counts = []
    for _ in range(STEPS):
        shelf = change(rng, shelf)
        counts.append(int(rng.binomial(len(shelf), SEEN)))
    moves = CHANGE[0] * np.eye(ROOM) + CHANGE[1] * np.eye(ROOM, k=1) + CHANGE[2] * np.eye(ROOM, k=-1)
    moves[0, 0] += CHANGE[2]
    p, total, means = np.eye(ROOM)[0], 0.0, []
    for count in counts:
        p = p @ moves * stats.binom.pmf(count, np.arange(ROOM), SEEN)
        total += np.log(p.sum())
        p = p / p.sum()
        means.append(p @ np.arange(ROOM))
    return Data(counts, float(total), np.array(means))


_LOG_SEEN = stats.binom.logpmf(np.arange(ROOM)[:, None], np.arange(ROOM)[None, :], SEEN)
SHELF = StateSpaceModel(
    lambda rng, n: tuple(change(rng, ()) for _ in range(n)),
    lambda rng, shelves: tuple(change(rng, shelf) for shelf in shelves),
    lambda shelves, count: _LOG_SEEN[count, [len(shelf) for shelf in shelves]],
)


@dataclass(frozen=True)
class SameBoxes(Similarity):
    """Number of common boxes divided by the size of the union, both by colour; 1 for two empty shelves."""

    def matrix(self, particles: Any) -> np.ndarray:
        """Similarities (n, n) of all pairs."""
        have = np.array([np.bincount(np.array(p, dtype=int), minlength=len(COLOURS)) for p in particles])
        both = np.minimum(have[:, None], have[None]).sum(axis=2)
        either = np.maximum(have[:, None], have[None]).sum(axis=2)
        return np.where(either == 0, 1.0, both / np.maximum(either, 1))


def n_boxes(population: Population) -> np.ndarray:
    """Expected number of boxes."""
    return np.asarray(population.weights @ np.array([len(p) for p in population.particles]))


# --- the miniature MST, enumerated ---------------------------------------------------------------------------------
TABLE = Miniature((3, 2))


@cache
def table_data(seed: int) -> Data:
    """Six observations of the miniature MST, with the exact posterior by enumeration."""
    _, observations = TABLE.simulate(np.random.default_rng([seed, 24]), 6)
    exact = exact_filter(TABLE, observations)
    return Data(observations, float(exact.log_evidence[-1]), exact.posterior)


def worlds(reference: int) -> dict[str, World]:
    """The four models by name."""
    return {
        "linear_gaussian": World(lambda n: bootstrap(AR1, n), kalman, mean, Gaussian(0.3), ExactEquality()),
        "stochastic_volatility": World(
            lambda n: bootstrap(VOLATILITY, n), volatility_data(reference), mean, Gaussian(0.3), ExactEquality()
        ),
        "object_hmm": World(lambda n: bootstrap(SHELF, n), shelf_data, n_boxes, SameBoxes(), ExactEquality()),
        "miniature_mst": World(
            lambda n: bootstrap_filter(TABLE, n),
            table_data,
            lambda population: state_weights(TABLE, population),
            WeightedCoverage(),
            SameSegmentation(),
            (200, 20),
        ),
    }

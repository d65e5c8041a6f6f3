"""Models with exact answers, which test_exact.py checks: an AR(1) process and a hidden Markov chain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mstfilter.smc import Normal, StateSpaceModel, kalman_filter, run_many


def filterpy_class(name: str):
    """A class of filterpy's Kalman filters; a test that needs one is skipped without filterpy."""
    return getattr(pytest.importorskip("filterpy.kalman"), name)


# --- scalar AR(1) observed in noise -------------------------------------------------------------------------------
RHO, SIGMA, TAU = 0.9, 0.6, 0.4
SD0 = SIGMA / np.sqrt(1 - RHO**2)
AR1 = StateSpaceModel.of(Normal(0.0, SD0), lambda x: Normal(RHO * x, SIGMA), lambda x: Normal(x, TAU))
_GAIN = SIGMA**2 / (SIGMA**2 + TAU**2)
_GAIN0 = SD0**2 / (SD0**2 + TAU**2)


def ar1_observations(T: int, seed: int = 4) -> list[float]:
    rng = np.random.default_rng(seed)
    x, ys = rng.normal(0, SD0), []
    for _ in range(T):
        ys.append(float(rng.normal(x, TAU)))
        x = rng.normal(RHO * x, SIGMA)
    return ys


def optimal(x, y):
    """p(x_t | x_{t-1}, y_t)."""
    m = RHO * x
    return Normal(m + _GAIN * (y - m), float(np.sqrt(_GAIN) * TAU))


def optimal_initial(y):
    """p(x_0 | y_0)."""
    return Normal(_GAIN0 * y, float(np.sqrt(_GAIN0) * TAU))


def predictive(x, y):
    """log p(y_t | x_{t-1})."""
    return Normal(RHO * x, float(np.hypot(SIGMA, TAU))).log_prob(y)


def kalman_ar1(ys):
    """(T, 2) filtered means and variances, and the log evidence. None in `ys` is a missing observation."""
    found = kalman_filter([[RHO]], [[SIGMA**2]], [[1.0]], [[TAU**2]], [0.0], [[SD0**2]], ys)
    return np.stack([found.means[:, 0], found.covariances[:, 0, 0]], axis=1), float(found.log_evidence[-1])


# --- three-state chain with asymmetric emissions ------------------------------------------------------------------
START = np.array([0.6, 0.3, 0.1])
MOVES = np.array([[0.7, 0.2, 0.1], [0.05, 0.8, 0.15], [0.3, 0.1, 0.6]])
EMIT = np.array([[0.6, 0.3, 0.1, 0.0], [0.1, 0.2, 0.3, 0.4], [0.25, 0.05, 0.6, 0.1]])
SYMBOLS = [0, 2, 2, 1, 3, 1, 0, 2]


@dataclass(frozen=True)
class Box:
    """A state as an object: a small grid of labels that is all the same number."""

    grid: tuple[int, ...]

    @property
    def state(self) -> int:
        return self.grid[0]


BOXES = tuple(Box((k,) * 4) for k in range(3))


def _draw(rng, probs):
    u = rng.random(len(probs))
    return np.minimum((np.cumsum(probs, axis=1) <= u[:, None]).sum(axis=1), 2)


def _log_emit(states, y):
    with np.errstate(divide="ignore"):
        return np.log(EMIT[states, y])


def hmm(kind: str) -> StateSpaceModel:
    """The chain with particles as a vector, a mapping of arrays, or objects."""
    wrap, states = {
        "vector": (lambda k: k, lambda p: p),
        "mapping": (lambda k: {"k": k, "twice": np.stack([k, k], 1)}, lambda p: p["k"]),
        "objects": (lambda k: tuple(BOXES[int(i)] for i in k), lambda p: np.array([b.state for b in p])),
    }[kind]
    return StateSpaceModel(
        lambda rng, n: wrap(_draw(rng, np.tile(START, (n, 1)))),
        lambda rng, p: wrap(_draw(rng, MOVES[states(p)])),
        lambda p, y: _log_emit(states(p), y),
        lambda p: np.log(START[states(p)]),
        lambda old, new: np.log(MOVES[states(old), states(new)]),
    )


def states_of(particles) -> np.ndarray:
    if isinstance(particles, np.ndarray):
        return particles
    return particles["k"] if isinstance(particles, dict) else np.array([b.state for b in particles])


def mean_ratio(filter, ys, exact, seeds):
    """Mean of L_hat / L, its standard error, and the log evidences."""
    logs = run_many(filter, ys, seeds)["log_evidence"][:, -1]
    ratios = np.exp(logs - exact)
    return ratios.mean(), ratios.std(ddof=1) / np.sqrt(len(ratios)), logs

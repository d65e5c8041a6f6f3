"""How far a population is from the exact posterior.

>>> p = class_weights(world, state.population)                       # (S,), duplicates and names coalesced
>>> total_variation(p, exact.posterior[t])
>>> measure(world, p, exact.posterior[t], truth[t])
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mstfilter.oracles.miniature.world import Miniature
from mstfilter.smc import Population

__all__ = ["MEASURES", "class_weights", "iid_population", "measure", "total_variation"]

#: What `measure` returns.
MEASURES = ("tv", "same_object_error", "occupancy_error", "same_object_brier", "occupancy_brier", "p_truth")


def class_weights(world: Miniature, population: Population) -> np.ndarray:
    """(S,) weight of each configuration, whatever its objects are called."""
    return np.bincount(world.states.index(population.particles), population.weights, len(world.states))


def iid_population(rng: np.random.Generator, p: np.ndarray, n: int) -> np.ndarray:
    """(S,) shares of `n` independent draws of the law p itself: what `n` equal particles can reach."""
    return np.asarray(rng.multinomial(n, p / p.sum()) / n)


def total_variation(p: np.ndarray, q: np.ndarray) -> float:
    """Half the sum of absolute differences of two laws, in [0, 1]."""
    return 0.5 * float(np.abs(p - q).sum())


def measure(world: Miniature, p: np.ndarray, exact: np.ndarray, truth: int) -> dict[str, Any]:
    """Distances of a law p over the states from the exact one, and its scores against the true state.

    Returns
    -------
    dict
        ``tv``; mean absolute error of the probabilities that two cells are one object (over pairs) and that a cell
        is occupied (over cells); the Brier scores of both against the truth; the probability of the truth.
    """
    s = world.states
    same, occupied = p @ s.same_object, p @ s.occupied
    return {
        "tv": total_variation(p, exact),
        "same_object_error": float(np.abs(same - exact @ s.same_object).mean()),
        "occupancy_error": float(np.abs(occupied - exact @ s.occupied).mean()),
        "same_object_brier": float(((same - s.same_object[truth]) ** 2).mean()),
        "occupancy_brier": float(((occupied - s.occupied[truth]) ** 2).mean()),
        "p_truth": float(p[truth]),
    }

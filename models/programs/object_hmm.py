"""A hidden Markov model whose state is a set of objects, so that the number of sites changes.

    python models/programs/object_hmm.py

A shelf contains boxes. At each step a box of random colour is added, or one is removed, or nothing happens. A sensor
counts the boxes and misses each with probability 0.2. A particle is the shelf: a tuple of colours.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy import stats

from mstfilter.smc import Categorical, Program, observe, per_particle, sample

COLOURS = ("red", "green", "blue")
SEEN = 0.8


@cache
def counts_of(n):
    """The law of the count of `n` boxes; scipy.stats takes long to make one."""
    return stats.binom(n, SEEN)


@per_particle
def model(previous, count):
    """One step for one particle; particles have different sites."""
    shelf = () if previous is None else previous["shelf"]
    choice = int(sample("change", Categorical([0.5, 0.3, 0.2])))  # nothing, add, remove
    if choice == 1:
        colour = int(sample("colour", Categorical([0.5, 0.3, 0.2])))
        shelf = (*shelf, COLOURS[colour])
    elif choice == 2 and shelf:
        removed = int(sample("removed", Categorical(np.ones(len(shelf)))))
        shelf = shelf[:removed] + shelf[removed + 1 :]
    observe("count", counts_of(len(shelf)), count)
    return {"shelf": shelf}


def simulate(T: int, seed: int = 0) -> tuple[list[tuple], list[int]]:
    """Simulate T steps; returns the shelves and the counts."""
    rng, shelf, shelves, counts = np.random.default_rng(seed), (), [], []
    for _ in range(T):
        choice = rng.choice(3, p=[0.5, 0.3, 0.2])
        if choice == 1:
            shelf = (*shelf, COLOURS[rng.choice(3, p=[0.5, 0.3, 0.2])])
        elif choice == 2 and shelf:
            removed = rng.integers(len(shelf))
            shelf = shelf[:removed] + shelf[removed + 1 :]
        shelves.append(shelf)
        counts.append(int(rng.binomial(len(shelf), SEEN)))
    return shelves, counts


def filters(n: int) -> dict:
    """The filters of the program with `n` particles, by name."""
    return {"bootstrap": Program(model).bootstrap(n)}


if __name__ == "__main__":
    shelves, counts = simulate(20)
    state, infos = filters(300)["bootstrap"].run(counts, seed=1)
    sizes = np.array([len(p["shelf"]) for p in state.population.particles])
    print(f"log evidence {state.log_evidence:.3f}")
    print(f"boxes: {state.population.weights @ sizes:.2f} expected, {len(shelves[-1])} true, {counts[-1]} counted")

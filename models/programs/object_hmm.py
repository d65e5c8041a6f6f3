"""A hidden chain whose states are objects that come and go: particles of changing structure.

    python models/programs/object_hmm.py

A shelf holds some boxes. At each step a box may be added, with a colour, or one may be taken away; a sensor counts
the boxes, and misses each with probability 0.2. A particle is the shelf: an immutable tuple of colours.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from mstfilter.smc import Categorical, Program, observe, per_particle, sample

COLOURS = ("red", "green", "blue")
SEEN = 0.8


@per_particle
def model(previous, count):
    """One step for one particle; the sites differ from particle to particle."""
    shelf = () if previous is None else previous["shelf"]
    choice = int(sample("change", Categorical([0.5, 0.3, 0.2])))  # nothing, add, take away
    if choice == 1:
        colour = int(sample("colour", Categorical([0.5, 0.3, 0.2])))
        shelf = (*shelf, COLOURS[colour])
    elif choice == 2 and shelf:
        gone = int(sample("gone", Categorical(np.ones(len(shelf)))))
        shelf = shelf[:gone] + shelf[gone + 1 :]
    observe("count", stats.binom(len(shelf), SEEN), count)
    return {"shelf": shelf}


def simulate(T: int, seed: int = 0) -> tuple[list[tuple], list[int]]:
    """Shelves and counts."""
    rng, shelf, shelves, counts = np.random.default_rng(seed), (), [], []
    for _ in range(T):
        choice = rng.choice(3, p=[0.5, 0.3, 0.2])
        if choice == 1:
            shelf = (*shelf, COLOURS[rng.choice(3, p=[0.5, 0.3, 0.2])])
        elif choice == 2 and shelf:
            gone = rng.integers(len(shelf))
            shelf = shelf[:gone] + shelf[gone + 1 :]
        shelves.append(shelf)
        counts.append(int(rng.binomial(len(shelf), SEEN)))
    return shelves, counts


def filters(n: int) -> dict:
    """From the one program."""
    return {"bootstrap": Program(model).bootstrap(n)}


if __name__ == "__main__":
    shelves, counts = simulate(20)
    state, infos = filters(300)["bootstrap"].run(counts, seed=1)
    sizes = np.array([len(p["shelf"]) for p in state.population.particles])
    print(f"log evidence {state.log_evidence:.3f}")
    print(f"boxes: {state.population.weights @ sizes:.2f} expected, {len(shelves[-1])} there, {counts[-1]} counted")

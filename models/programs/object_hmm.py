"""A hidden Markov model whose state is a set of objects, so that the number of variables changes.

    python models/programs/object_hmm.py

A shelf contains boxes. At each step a box of random colour is added, or one is removed, or nothing happens. A sensor
counts the boxes and misses each with probability 0.2. A particle is the shelf: a tuple of colours. A model of objects
is a `StateSpaceModel` of functions.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from mstfilter.smc import StateSpaceModel, bootstrap

COLOURS = ("red", "green", "blue")
SEEN = 0.8


def changed(rng, shelf):
    """The shelf after a step."""
    choice = rng.choice(3, p=[0.5, 0.3, 0.2])  # nothing, add, remove
    if choice == 1:
        return (*shelf, COLOURS[rng.choice(3, p=[0.5, 0.3, 0.2])])
    if choice == 2 and shelf:
        removed = rng.integers(len(shelf))
        return shelf[:removed] + shelf[removed + 1 :]
    return shelf


def log_likelihood(shelves, count):
    """(n,) log probability of the count given each shelf."""
    return stats.binom.logpmf(count, [len(shelf) for shelf in shelves], SEEN)


model = StateSpaceModel(
    sample_initial=lambda rng, n: tuple(changed(rng, ()) for _ in range(n)),
    sample_transition=lambda rng, shelves: tuple(changed(rng, shelf) for shelf in shelves),
    log_likelihood=log_likelihood,
    sample_observation=lambda rng, shelves: rng.binomial([len(shelf) for shelf in shelves], SEEN),
)


def filters(n: int) -> dict:
    """The filters of the model with `n` particles, by name."""
    return {"bootstrap": bootstrap(model, n)}


if __name__ == "__main__":
    shelves, counts = model.simulate(20)
    state, infos = filters(300)["bootstrap"].run(counts, seed=1)
    boxes = state.population.mean(lambda shelves: np.array([len(shelf) for shelf in shelves]))
    print(f"log evidence {state.log_evidence:.3f}")
    print(f"boxes: {boxes:.2f} expected, {len(shelves[-1])} true, {counts[-1]} counted")

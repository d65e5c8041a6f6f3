"""The miniature world as a probabilistic program, with its exact posterior to compare with.

    python experiments/miniature/program.py

A particle is the number of a state (which cell belongs to which object). Each run ends with the distance from the
exact posterior.
"""

from __future__ import annotations

import numpy as np
from miniature_filters import exact_filter, total_variation
from miniature_world import Miniature, Observation

from mstfilter.smc import Bernoulli, Categorical, Program, observe, sample

WORLD = Miniature(shape=(3, 2))


def model(previous, y: Observation):
    """One step of all particles; `previous` is None at the first step."""
    fresh = sample("fresh", Categorical(WORLD.prior))
    if previous is None:
        state = fresh
    else:
        n, old = len(fresh), previous["state"]
        rearranged = sample("rearranged", Bernoulli(np.full(n, WORLD.rearranged)))
        slips = sample("slips", Bernoulli(np.full(n, WORLD.slip)))
        state = np.where(rearranged, fresh, np.where(slips, old, WORLD.pushed[y.action, old]))
    surface, same_surface = WORLD.surface[state], WORLD.same_surface[state].astype(int)
    for pixel, reading in enumerate(y.depth):
        observe(f"depth {pixel}", Categorical(WORLD.depth_probability[surface[:, pixel]]), reading)
    observe("segmentation", Bernoulli(WORLD.join_probability[same_surface]), y.joined)
    return {"state": state}


def guide(previous, y: Observation):
    """Draws the first state from the prior times the root of the likelihood."""
    first = previous is None
    fresh = sample(
        "fresh", Categorical(WORLD.prior * np.exp(0.5 * WORLD.log_likelihood(y)) if first else WORLD.prior)
    )
    if not first:
        sample("rearranged", Bernoulli(np.full(len(fresh), WORLD.rearranged)))
        sample("slips", Bernoulli(np.full(len(fresh), WORLD.slip)))


def simulate(T: int, seed: int = 0) -> tuple[np.ndarray, list[Observation]]:
    """True states and observations."""
    return WORLD.simulate(np.random.default_rng(seed), T)


def filters(n: int) -> dict:
    program = Program(model)
    return {"bootstrap": program.bootstrap(n), "guided at first": program.guided(guide, n)}


if __name__ == "__main__":
    truth, observations = simulate(6)
    exact = exact_filter(WORLD, observations)
    print("                           log evidence   total variation   p(truth)")
    for n in (100, 1000, 10_000, 100_000):
        for name, filter in filters(n).items():
            state, _ = filter.run(observations, seed=0)
            law = np.bincount(state.population.particles["state"], state.population.weights, len(WORLD.states))
            distance = total_variation(law, exact.posterior[-1])
            print(f"{name:16s} {n:7d}   {state.log_evidence:12.3f}   {distance:15.3f}   {law[truth[-1]]:8.3f}")
    print(f"{'exact':24s}   {exact.log_evidence[-1]:12.3f}   {0:15.3f}   {exact.posterior[-1][truth[-1]]:8.3f}")

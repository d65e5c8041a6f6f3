"""A target with two regimes of motion, which have different sites, and observations that are sometimes missing.

    python models/programs/regime_tracker.py

The state is a position and a velocity in the plane. In the regime "drift" the velocity changes slowly. In the regime
"manoeuvre" it changes by a thrust; its direction is a site of this regime only, and NaN in the other.
"""

from __future__ import annotations

import numpy as np

from mstfilter.smc import Normal, Program, Uniform, collect, mean, observe, sample, switch

STEP, NOISE = 1.0, 0.5
TO_MANOEUVRE = np.array([0.1, 0.6])  # probability of a manoeuvre after a drift, after a manoeuvre


def model(previous, y):
    """One step for all particles; y is (2,) or None."""
    if previous is None:
        velocity = sample("velocity", Normal(np.zeros((1, 2)), 1.0))
        position = sample("position", Normal(np.zeros((1, 2)), 5.0))
        observe("reading", Normal(position, NOISE), y)
        return {"regime": np.zeros(len(position), dtype=np.int64), "direction": np.full(len(position), np.nan)}

    def drift(velocity):
        return sample("velocity", Normal(velocity, 0.05))

    def manoeuvre(velocity):
        direction = sample("direction", Uniform(np.full(len(velocity), -np.pi), np.pi))
        thrust = 1.5 * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        return sample("velocity", Normal(velocity + thrust, 0.3))

    turning = TO_MANOEUVRE[previous["regime"]]
    probs = np.stack([1 - turning, turning], axis=1)
    velocity = switch("regime", probs, [drift, manoeuvre], previous["velocity"])
    position = sample("position", Normal(previous["position"] + STEP * velocity, 0.1))
    observe("reading", Normal(position, NOISE), y)
    return None


def filters(n: int) -> dict:
    """The filters of the program with `n` particles, by name."""
    return {"bootstrap": Program(model).bootstrap(n)}


if __name__ == "__main__":
    truth, readings = Program(model).simulate(60, seed=1)
    lost = np.random.default_rng(0).random(60) < 0.1  # a tenth of the readings is missing
    given = [None if t and lost[t] else reading for t, reading in enumerate(readings)]
    for name, filter in filters(3000).items():
        history = collect(filter.iterate(given, 1), mean=mean)
        error = np.linalg.norm(history["mean_position"] - truth["position"], axis=1).mean()
        right = ((history["mean_regime"] > 0.5) == truth["regime"]).mean()
        print(f"{name:14s} position error {error:.3f}  regime right {right:.2f}")
    print(f"{'readings':14s} position error {NOISE * np.sqrt(np.pi / 2):.3f} (if not missing)")

"""A target with two regimes of motion, which have different sites, and observations that are sometimes missing.

    python models/programs/regime_tracker.py

The state is a position and a velocity in the plane. In the regime "drift" the velocity changes slowly. In the regime
"manoeuvre" it changes by a thrust; its direction is a site of this regime only, and NaN in the other.
"""

from __future__ import annotations

import numpy as np

from mstfilter.smc import Normal, Program, Uniform, observe, sample, switch

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


def simulate(T: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, list]:
    """Simulate T steps; returns positions (T, 2), regimes (T,) and readings, of which a tenth are missing (None)."""
    rng = np.random.default_rng(seed)
    position, velocity, regime = rng.normal(0, 5, 2), rng.normal(0, 1, 2), 0
    positions, regimes, readings = [], [], []
    for t in range(T):
        if t:
            regime = int(rng.random() < TO_MANOEUVRE[regime])
            if regime:
                angle = rng.uniform(-np.pi, np.pi)
                velocity = velocity + 1.5 * np.array([np.cos(angle), np.sin(angle)]) + rng.normal(0, 0.3, 2)
            else:
                velocity = velocity + rng.normal(0, 0.05, 2)
            position = position + STEP * velocity + rng.normal(0, 0.1, 2)
        positions.append(position)
        regimes.append(regime)
        readings.append(None if t and rng.random() < 0.1 else position + NOISE * rng.normal(size=2))
    return np.array(positions), np.array(regimes), readings


def filters(n: int) -> dict:
    """The filters of the program with `n` particles, by name."""
    return {"bootstrap": Program(model).bootstrap(n)}


if __name__ == "__main__":
    truth, regimes, readings = simulate(60)
    for name, filter in filters(3000).items():
        errors, right = [], []
        for state, info in filter.iterate(readings, 1):
            w, p = state.population.weights, state.population.particles
            errors.append(np.linalg.norm(w @ p["position"] - truth[info.t]))
            right.append((w @ (p["regime"] == 1) > 0.5) == regimes[info.t])
        print(f"{name:14s} position error {np.mean(errors):.3f}  regime right {np.mean(right):.2f}")
    print(f"{'readings':14s} position error {NOISE * np.sqrt(np.pi / 2):.3f} (if not missing)")

"""A linear Gaussian AR(1) process observed in noise, with all filters of a program.

    python models/programs/ar1.py

x_0 ~ N(0, s^2 / (1 - r^2)),  x_t = r x_{t-1} + N(0, s^2),  y_t = x_t + N(0, q^2).
"""

from __future__ import annotations

import numpy as np

from mstfilter.smc import Normal, Program, observe, sample

R, S, Q = 0.9, 0.6, 0.4
GAIN = S**2 / (S**2 + Q**2)


def model(previous, y):
    """One step for all particles."""
    if previous is None:
        x = sample("x", Normal(0.0, S / np.sqrt(1 - R**2)))
    else:
        x = sample("x", Normal(R * previous["x"], S))
    observe("y", Normal(x, Q), y)


def guide(previous, y):
    """The optimal proposal p(x_t | x_{t-1}, y_t). A guide has the same sites as the model."""
    if previous is None:
        v = S**2 / (1 - R**2)
        sample("x", Normal(v / (v + Q**2) * y, np.sqrt(v * Q**2 / (v + Q**2))))
    else:
        m = R * previous["x"]
        sample("x", Normal(m + GAIN * (y - m), np.sqrt(GAIN) * Q))


def filters(n: int) -> dict:
    """The filters of the program with `n` particles, by name."""
    program = Program(model)
    return {
        "bootstrap": program.bootstrap(n),
        "guided": program.guided(guide, n),
    }


if __name__ == "__main__":
    truth, observations = Program(model).simulate(50)
    for name, filter in filters(500).items():
        state, infos = filter.run(observations, seed=1)
        estimate = state.population.mean()["x"]
        smallest = min(info.ess for info in infos)
        print(f"{name:14s} log evidence {state.log_evidence:8.3f}  smallest ESS {smallest:5.0f}  x {estimate:6.3f}")
    print(f"{'truth':14s} x {truth['x'][-1]:6.3f}")

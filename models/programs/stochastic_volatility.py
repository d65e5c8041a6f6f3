"""Stochastic volatility: heavy-tailed returns whose log variance is an AR(1) process.

    python models/programs/stochastic_volatility.py

h_t = m + r (h_{t-1} - m) + N(0, s^2),  y_t = exp(h_t / 2) e_t,  e_t is Student's t with 8 degrees of freedom.
"""

from __future__ import annotations

import numpy as np

from mstfilter.smc import Normal, Program, Student, collect, mean, observe, sample

M, R, S, DF = -1.0, 0.97, 0.2, 8.0


def model(previous, y):
    """One step for all particles."""
    if previous is None:
        h = sample("h", Normal(M, S / np.sqrt(1 - R**2)))
    else:
        h = sample("h", Normal(M + R * (previous["h"] - M), S))
    observe("y", Student(DF, 0.0, np.exp(h / 2)), y)
    return {"volatility": np.exp(h / 2)}  # stored in the particles beside the sites


def filters(n: int) -> dict:
    """The filters of the program with `n` particles, by name."""
    program = Program(model)
    return {
        "bootstrap": program.bootstrap(n),
    }


if __name__ == "__main__":
    truth, returns = Program(model).simulate(200)
    volatility = truth["volatility"]
    for name, filter in filters(1000).items():
        history = collect(filter.iterate(returns, 1), mean=mean)
        rmse = np.sqrt(np.mean((history["mean_volatility"] - volatility) ** 2))
        print(f"{name:14s} log evidence {history.state.log_evidence:9.3f}  volatility RMSE {rmse:.3f}")
    print(f"{'constant mean':14s} RMSE {volatility.std():.3f}")

"""Stochastic volatility: heavy-tailed returns whose log variance is an AR(1) process.

    python models/programs/stochastic_volatility.py

h_t = m + r (h_{t-1} - m) + N(0, s^2),  y_t = exp(h_t / 2) e_t,  e_t is Student's t with 8 degrees of freedom.
"""

from __future__ import annotations

import numpy as np

from mstfilter.smc import Normal, Program, Student, observe, sample

M, R, S, DF = -1.0, 0.97, 0.2, 8.0


def model(previous, y):
    """One step for all particles."""
    if previous is None:
        h = sample("h", Normal(M, S / np.sqrt(1 - R**2)))
    else:
        h = sample("h", Normal(M + R * (previous["h"] - M), S))
    observe("y", Student(DF, 0.0, np.exp(h / 2)), y)
    return {"volatility": np.exp(h / 2)}  # stored in the particles beside the sites


def simulate(T: int, seed: int = 0) -> tuple[np.ndarray, list[float]]:
    """Simulate T steps; returns the volatilities (T,) and the returns."""
    rng = np.random.default_rng(seed)
    h = [rng.normal(M, S / np.sqrt(1 - R**2))]
    for _ in range(T - 1):
        h.append(M + R * (h[-1] - M) + S * rng.normal())
    volatility = np.exp(np.array(h) / 2)
    return volatility, (volatility * rng.standard_t(DF, T)).tolist()


def filters(n: int) -> dict:
    """The filters of the program with `n` particles, by name."""
    program = Program(model)
    return {
        "bootstrap": program.bootstrap(n),
    }


if __name__ == "__main__":
    truth, returns = simulate(200)
    for name, filter in filters(1000).items():
        errors = []
        for state, info in filter.iterate(returns, 1):
            population = state.population
            errors.append(population.weights @ population.particles["volatility"] - truth[info.t])
        rmse = np.sqrt(np.mean(np.square(errors)))
        print(f"{name:14s} log evidence {state.log_evidence:9.3f}  volatility RMSE {rmse:.3f}")
    print(f"{'constant mean':14s} RMSE {truth.std():.3f}")

"""Error rate and power of a claim by `mstfilter.scoring.statistics.compare_arms`, by simulation.

    python experiments/comparison/run.py

The simulated differences of n units between arms and a reference have mean zero, so every claim of a difference is an
error. For a claim, the p value of sign flips must be below .05 after Holm. See README.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.stats import t as student

from mstfilter.base.files import write_csv

HERE = Path(__file__).parent
UNITS = (10, 20, 30, 60)
N_FLIPS = 1999
CHUNK = 1000  # differences at once
POWER = (2.5, 3.5)  # true mean over its standard error


def squared_errors(rng: np.random.Generator, n: int, shape: tuple[int, int]) -> np.ndarray:
    """Squared normal errors of arms minus squared errors of one reference with the same mean and less spread."""
    reference = (rng.normal(size=(n, shape[0], 4)) ** 2).mean(axis=-1)
    return rng.normal(size=(n, *shape)) ** 2 - reference[..., None]


Draw = Callable[[np.random.Generator, int, tuple[int, int]], np.ndarray]
CASES: dict[str, Draw] = {
    "normal": lambda rng, n, shape: rng.normal(size=(n, *shape)),
    "Laplace": lambda rng, n, shape: rng.laplace(size=(n, *shape)),
    "t, 3 degrees": lambda rng, n, shape: rng.standard_t(3, size=(n, *shape)),
    "squared errors": squared_errors,
    "exponential": lambda rng, n, shape: rng.exponential(size=(n, *shape)) - 1,
    "chi-square": lambda rng, n, shape: rng.chisquare(1, size=(n, *shape)) - 1,
    "lognormal, sd .5": lambda rng, n, shape: rng.lognormal(0, 0.5, (n, *shape)) - np.exp(0.125),
    "lognormal, sd 1": lambda rng, n, shape: rng.lognormal(0, 1, (n, *shape)) - np.exp(0.5),
}


def p_values(x: np.ndarray) -> dict[str, np.ndarray]:
    """p values of each column of differences (n, k): of the t test, and of sign flips as in `compare`, but faster."""
    n = len(x)
    mean, sd = x.mean(axis=0), x.std(axis=0, ddof=1)
    return {"t": 2 * student.sf(np.abs(mean / sd) * np.sqrt(n), n - 1), "flip": _by_flips(x)}


def _by_flips(x: np.ndarray) -> np.ndarray:
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (N_FLIPS, len(x)))
    larger = np.abs(signs @ x) >= np.abs(x.sum(axis=0)) - 1e-12
    return np.asarray((1 + larger.sum(axis=0)) / (1 + N_FLIPS))


def claims(x: np.ndarray, arms: int) -> dict[str, float]:
    """Share of the tables in x (n, table, arm) with a claim: by t tests, and by sign flips as in `conclusion`."""
    parts = [p_values(x[:, k : k + CHUNK].reshape(len(x), -1)) for k in range(0, x.shape[1], CHUNK)]
    p = {name: np.concatenate([part[name] for part in parts]).reshape(-1, x.shape[2]) for name in parts[0]}
    # Holm rejects something if and only if the smallest p value is at most the level over the number of arms.
    return {name: float((values.min(axis=1) < 0.05 / arms).mean()) for name, values in p.items()}


def main(tables: int, out: Path) -> None:
    rows = []
    for arms in (1, 4):
        for n in UNITS:
            for name, draw in CASES.items():
                x = draw(np.random.default_rng(n + arms), n, (tables, arms))
                rows.append({"case": name, "effect": 0, "arms": arms, "n": n, **claims(x, arms)})
            for effect in POWER:  # of one of the arms
                x = np.random.default_rng(n).normal(size=(n, tables, 1)) + effect / np.sqrt(n)
                rows.append({"case": "normal", "effect": effect, "arms": arms, "n": n, **claims(x, arms)})
    write_csv(out / "results.csv", rows, float_format=".3f")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--tables", type=int, default=4000)
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    main(given.tables, given.out)

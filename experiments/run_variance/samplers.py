"""Standard errors of the log evidence from one run of an SMC sampler, and the spread over runs; writes samplers.csv.

The model is a linear regression with Gaussian prior and noise, whose evidence is known. README.md has the command.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import stats

from mstfilter.base.files import write_csv
from mstfilter.smc import Normal, tempering

HERE = Path(__file__).parent
#: Number of parameters, observations, sd of the noise, particles, and Metropolis steps.
CASES = [(1, 5, 0.3, 500, 9), (2, 10, 0.3, 1000, 9), (5, 20, 0.5, 2000, 39), (10, 20, 0.5, 4000, 39)]
LAGS = (None, 2, 5)


def problem(d: int, m: int, sd: float) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """The log likelihood, and the exact log evidence."""
    rng = np.random.default_rng(10 * d + m)
    A = rng.normal(size=(m, d))
    y = A @ rng.normal(size=d) + sd * rng.normal(size=m)
    exact = stats.multivariate_normal(np.zeros(m), A @ A.T + sd**2 * np.eye(m)).logpdf(y)
    constant = m * np.log(sd * np.sqrt(2 * np.pi))
    return lambda theta: -0.5 * (((y - theta @ A.T) / sd) ** 2).sum(axis=1) - constant, exact


def main() -> None:
    """Run all cases, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--out", type=Path, default=HERE / "samplers.csv")
    options = parser.parse_args()
    rows = []
    for d, m, sd, n, steps in CASES:
        log_likelihood, exact = problem(d, m, sd)
        for waste_free in (True, False):
            for lag in LAGS:
                settings = {"steps": steps if waste_free else 5, "waste_free": waste_free, "lag": lag}
                runs = [
                    tempering(Normal(np.zeros((1, d)), 1.0), log_likelihood, n, seed, **settings)
                    for seed in range(options.runs)
                ]
                logs = np.array([run.log_evidence for run in runs])
                errors = np.array([run.log_evidence_error for run in runs])
                row = {"parameters": d, "n": n, **settings, "bias": (logs - exact).mean(), "sd": logs.std(ddof=1)}
                row |= {"error": np.sqrt(np.nanmean(errors**2)), "error_10": np.nanquantile(errors, 0.1)}
                row |= {"error_90": np.nanquantile(errors, 0.9), "no_error": int(np.isnan(errors).sum())}
                rows.append({key: f"{v:.3f}" if isinstance(v, float) else v for key, v in row.items()})
                print(*rows[-1].values(), sep="\t", flush=True)
                write_csv(options.out, rows, list(rows[0]))


if __name__ == "__main__":
    main()

"""SMC samplers of equal cost, with and without waste_free, for a known evidence; writes waste_free.csv."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy import stats

from mstfilter.files import write_csv
from mstfilter.smc import MultivariateNormal, smc_sampler

HERE = Path(__file__).parent
SETTINGS = (
    {"n": 1000, "steps": 5},
    {"n": 250, "steps": 20},
    {"n": 100, "steps": 50},
    {"n": 5000, "steps": 19, "waste_free": True},
    {"n": 5000, "steps": 99, "waste_free": True},
    {"n": 5000, "steps": 249, "waste_free": True},
)


def measure(settings: dict, d: int, seeds: int) -> dict[str, object]:
    """Errors of log evidence and posterior means over seeds, and evaluations of the likelihood per run."""
    sds, y = np.geomspace(0.1, 1.0, d), np.random.default_rng(1).normal(0.0, 2.0, d)
    variance, calls = 4 + sds**2, []

    def log_likelihood(theta: np.ndarray) -> np.ndarray:
        calls.append(len(theta))
        return stats.norm.logpdf(y, theta, sds).sum(axis=1)

    prior = MultivariateNormal(np.zeros(d), 4 * np.eye(d))
    runs = [smc_sampler(prior, log_likelihood, seed=seed, **settings) for seed in range(seeds)]
    error = np.array([r.log_evidence for r in runs]) - stats.norm.logpdf(y, 0, np.sqrt(variance)).sum()
    means = np.array([r.population.weights @ r.population.particles for r in runs]) - 4 * y / variance
    return {
        "d": d,
        **{"waste_free": False, **settings},
        "evaluations": sum(calls) // seeds,
        "bias_of_log_evidence": f"{error.mean():.3f}",
        "sd_of_log_evidence": f"{error.std(ddof=1):.3f}",
        "rms_error_of_means": f"{np.sqrt((means**2 * variance / (4 * sds**2)).mean()):.4f}",  # in posterior sds
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--out", type=Path, default=HERE / "waste_free.csv")
    parser.add_argument("--smoke", action="store_true", help="small runs; needs --out")
    options = parser.parse_args()
    if options.smoke and options.out == HERE / "waste_free.csv":
        parser.error("--smoke would overwrite the results: name another file with --out")
    settings = ({"n": 20, "steps": 1}, {"n": 20, "steps": 9, "waste_free": True}) if options.smoke else SETTINGS
    rows = []
    for d in (2,) if options.smoke else (10, 30):
        for one in settings:
            rows.append(measure(one, d, 2 if options.smoke else options.seeds))
            print(*rows[-1].values(), sep="\t", flush=True)
    write_csv(options.out, rows, list(rows[0]))

"""Variance of the log evidence and of a mean: estimates from one run, compared with the variance over many runs.

python experiments/run_variance/run.py [--smoke] [--sizes] [--out results.csv]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from mstfilter.base.files import write_csv
from mstfilter.smc import (
    Always,
    EssBelow,
    Killing,
    Multinomial,
    Residual,
    Ssp,
    StateSpaceModel,
    Stratified,
    Systematic,
    bootstrap,
    log_evidence,
    mean,
    run_many,
    run_variance,
)

HERE = Path(__file__).resolve().parent
LAG = 6
MOVES = np.array([[0.7, 0.2, 0.1], [0.05, 0.8, 0.15], [0.3, 0.1, 0.6]])
EMIT = np.array([[0.6, 0.3, 0.1, 0.0], [0.1, 0.2, 0.3, 0.4], [0.25, 0.05, 0.6, 0.1]])
with np.errstate(divide="ignore"):
    LOG_EMIT = np.log(EMIT)


def states(p: np.ndarray, u: np.ndarray) -> np.ndarray:
    """States drawn with probabilities (..., 3) by uniform numbers (...)."""
    return np.minimum((np.cumsum(p, axis=-1) <= u[..., None]).sum(axis=-1), 2)


def ar1_data() -> list[float]:
    rng = np.random.default_rng(4)
    x, ys = rng.normal(0, 1.4), []
    for _ in range(10):
        ys.append(float(rng.normal(x, 0.4)))
        x = rng.normal(0.9 * x, 0.6)
    return ys


MODELS = {
    "AR(1)": (
        StateSpaceModel(
            lambda rng, n: 1.4 * rng.standard_normal(n),
            lambda rng, x: 0.9 * x + 0.6 * rng.standard_normal(x.shape),
            lambda x, y: -0.5 * ((y - x) / 0.4) ** 2,
        ),
        ar1_data(),
    ),
    "HMM": (
        StateSpaceModel(
            lambda rng, n: states(np.array([0.6, 0.3, 0.1]), rng.random(n)),
            lambda rng, x: states(MOVES[x], rng.random(x.shape)),
            lambda x, y: LOG_EMIT[x, y],
        ),
        [0, 2, 2, 1, 3, 1, 0, 2, 3, 0],
    ),
    "volatility": (
        StateSpaceModel(
            lambda rng, n: rng.standard_normal(n),
            lambda rng, x: 0.9 * x + 0.45 * rng.standard_normal(x.shape),
            lambda x, y: -0.5 * (x + y * y * np.exp(-x)),
        ),
        [0.3, -1.2, 2.5, 0.4, -0.1, 1.0, -3.0, 0.2, 0.5, -0.7],
    ),
}
ARMS = {
    "multinomial, always": (Multinomial(), Always()),
    "multinomial": (Multinomial(), EssBelow(0.5)),
    "systematic, always": (Systematic(), Always()),
    "systematic": (Systematic(), EssBelow(0.5)),
    "stratified": (Stratified(), EssBelow(0.5)),
    "residual": (Residual(), EssBelow(0.5)),
    "ssp": (Ssp(), EssBelow(0.5)),
    "killing": (Killing(), EssBelow(0.5)),
}


#: Arms of --sizes, and their numbers of particles.
FEW, SIZES = ("multinomial, always", "systematic"), (30, 100, 300)


def rows(n: int, many: int, single: int, arms: Iterable[str] = ARMS) -> Iterator[dict[str, object]]:
    """For each model and scheme: variance over seeds, and mean and spread of estimates divided by this variance."""
    for model_name, (model, ys) in MODELS.items():
        for arm in arms:
            scheme, trigger = ARMS[arm]
            filter = bootstrap(model, n, scheme, trigger)
            runs = run_many(filter, ys, range(many), z=log_evidence, mean=mean)
            true = {"log evidence": runs["z"][:, -1].var(ddof=1), "mean": runs["mean"][:, -1].var(ddof=1)}
            for lag in (None, LAG):
                found = [run_variance(filter, ys, many + k, lag) for k in range(single)]
                estimates = {
                    "log evidence": [f.log_evidence_variance[-1] for f in found],
                    "mean": [f.mean_variance[-1] for f in found],
                }
                for what, values in estimates.items():
                    ratio = np.array(values) / true[what]
                    yield {
                        "model": model_name,
                        "scheme": arm,
                        "n": n,
                        "lag": "all" if lag is None else lag,
                        "of": what,
                        "variance": true[what],
                        "ratio": ratio.mean(),
                        # of the mean over runs, and of the sample variance of normal values
                        "error": np.hypot(ratio.std(ddof=1) / np.sqrt(single), ratio.mean() * np.sqrt(2 / many)),
                        "spread": ratio.std(ddof=1),
                    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="few particles and runs")
    parser.add_argument("--out", type=Path, default=HERE / "results.csv")
    parser.add_argument("--sizes", action="store_true", help="two schemes with 30 to 300 particles: sizes.csv")
    options = parser.parse_args()
    if options.sizes and options.out == HERE / "results.csv":
        options.out = HERE / "sizes.csv"
    if options.smoke and options.out.resolve().parent == HERE:
        parser.error("--smoke would overwrite the results: name another file with --out")
    if options.sizes and not options.smoke:
        found = [row for n in SIZES for row in rows(n, 3000, 150, FEW)]
    else:
        found = list(rows(*((20, 10, 3) if options.smoke else (400, 3000, 150))))
    write_csv(options.out, found, list(found[0]))
    for row in found:
        print(*(f"{value:.3g}" if isinstance(value, float) else value for value in row.values()), sep="\t")

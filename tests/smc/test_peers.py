"""Spread of the log evidence against that of `particles` 0.4, whose figure is stored with the script that made it."""

from __future__ import annotations

import csv

import numpy as np

from mstfilter.smc import Normal, StateSpaceModel, bootstrap
from tests.conftest import REPOSITORY

RHO, SIGMA, TAU = 0.9, 0.6, 0.4
MODEL = StateSpaceModel.of(
    Normal(0.0, SIGMA / np.sqrt(1 - RHO**2)), lambda x: Normal(RHO * x, SIGMA), lambda x: Normal(x, TAU)
)


def observations(T):
    """Those of experiments/benchmarks/speed.py."""
    rng, ys = np.random.default_rng(4), []
    x = rng.normal(0, SIGMA / np.sqrt(1 - RHO**2))
    for _ in range(T):
        ys.append(float(rng.normal(x, TAU)))
        x = rng.normal(RHO * x, SIGMA)
    return ys


def test_the_spread_of_the_log_evidence_is_that_of_particles():
    """Within 25 %; the error of 500 seeds is 3 %."""
    with (REPOSITORY / "experiments" / "benchmarks" / "evidence.csv").open() as file:
        row = next(r for r in csv.DictReader(file) if r["filter"] == "particles 0.4")
    filter = bootstrap(MODEL, int(row["n"]))
    logs = [filter.run(observations(int(row["T"])), seed)[0].log_evidence for seed in range(500)]
    assert 0.75 < np.std(logs, ddof=1) / float(row["sd_log_evidence"]) < 1.25
    assert abs(np.mean(logs) - float(row["mean_log_evidence"])) < 0.1

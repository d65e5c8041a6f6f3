"""Time of the examination of models at the first steps of a run, in steps of the same filter.

    python experiments/benchmarks/examination.py

Runs with and without examination alternate; the medians of their difference are printed, in processor time.
"""

from __future__ import annotations

import statistics
import time

import numpy as np

from mstfilter.smc import Normal, Program, StateSpaceModel, bootstrap, guided, observe, sample
from mstfilter.smc.first_steps import unexamined

YS = np.random.default_rng(0).normal(size=23).tolist()


def ar1(previous, y):
    x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(0.9 * previous["x"], 0.5))
    observe("y", Normal(x, 1.0), y)


DENSITIES = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
FUNCTIONS = StateSpaceModel(
    lambda rng, n: rng.normal(size=n),
    lambda rng, x: 0.9 * x + 0.5 * rng.normal(size=len(x)),
    lambda x, y: -0.5 * (x - y) ** 2,
)
FILTERS = {
    "densities": lambda n: bootstrap(DENSITIES, n),
    "functions": lambda n: bootstrap(FUNCTIONS, n),
    "guided": lambda n: guided(DENSITIES, lambda x, y: Normal(0.5 * (0.9 * x + y), 0.6), n),
    "program": lambda n: Program(ar1).bootstrap(n),
}


def seconds(filter, observations, seed, skip):
    with unexamined(skip):
        began = time.process_time()
        filter.run(observations, seed)
        return time.process_time() - began


def main(repetitions: int = 150) -> None:
    print("model      particles   step, us   examination, us   in steps (% of 100 steps)")
    for name, make in FILTERS.items():
        for n in (10, 100, 1000, 10_000):
            filter, extra, steps = make(n), [], []
            for seed in range(repetitions):
                plain = seconds(filter, YS[:3], seed, True)
                extra.append(seconds(filter, YS[:3], seed, False) - plain)
                steps.append((seconds(filter, YS, seed, True) - plain) / 20)
            step, cost = statistics.median(steps), statistics.median(extra)
            print(
                f"{name:<10} {n:>9} {1e6 * step:>9.0f} {1e6 * cost:>16.0f} {cost / step:>6.2f} {cost / step:>12.1f}%"
            )


if __name__ == "__main__":
    main()

"""Time of a sweep of runs, relative to single runs and to a numpy program with arrays of shape (run, particle).

    python experiments/benchmarks/batch.py [--rounds 15] [--runs 200] [--particles 100] [--steps 100]

All programs filter one AR(1) series, with systematic resampling if the effective sample size is below half of the
particles. The programs run alternately; the figures are medians of ratios within a round. Further lines give the
processor time of a sweep of 200 seeds relative to single runs, for all resampling schemes, for a model made by
`StateSpaceModel.of` and for a program. The last lines give the time of PMMH in a sweep relative to single chains.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from mstfilter.smc import (
    Killing,
    Multinomial,
    Normal,
    Program,
    Residual,
    Ssp,
    StateSpaceModel,
    Stratified,
    Systematic,
    bootstrap,
    observe,
    pmmh,
    run_many,
    sample,
)

RHO, SIGMA, TAU = 0.9, 0.6, 0.4
MODEL = StateSpaceModel(
    lambda rng, n: rng.standard_normal(n),
    lambda rng, x: RHO * x + SIGMA * rng.standard_normal(x.shape),
    lambda x, y: -0.5 * ((y - x) / TAU) ** 2,
)


def plain(ys: np.ndarray, n_runs: int, n: int) -> np.ndarray:
    """Log evidence of every run, with one generator for all runs and without components."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((n_runs, n))
    lw = np.zeros((n_runs, n))
    for t, y in enumerate(ys):
        if t:
            top = lw.max(axis=1, keepdims=True)
            w = np.exp(lw - top)
            total = w.sum(axis=1)
            low = np.flatnonzero(total**2 / (w * w).sum(axis=1) < n / 2)
            if len(low):
                cumulative = np.cumsum(w[low], axis=1)
                points = np.ceil(cumulative * (n / cumulative[:, -1:]) - rng.random((len(low), 1)))
                ends = np.clip(points, 0, n).astype(np.int64)[:, :-1] + (n + 1) * np.arange(len(low))[:, None]
                counts = np.bincount(ends.ravel(), minlength=len(low) * (n + 1)).reshape(len(low), n + 1)
                x[low] = np.take_along_axis(x[low], counts[:, :n].cumsum(axis=1), axis=1)
                lw[low] = (top[low, 0] + np.log(total[low] / n))[:, None]
            x = RHO * x + SIGMA * rng.standard_normal(x.shape)
        lw = lw - 0.5 * ((y - x) / TAU) ** 2
    top = lw.max(axis=1)
    return top + np.log(np.exp(lw - top[:, None]).mean(axis=1))


OF = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(RHO * x, SIGMA), lambda x: Normal(x, TAU))


def walk(previous, y):
    x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(RHO * previous["x"], SIGMA))
    observe("y", Normal(x, TAU), y)


def with_coefficient(theta, n=50):
    """The AR(1) filter with the coefficient `theta`."""
    (rho,) = theta
    return bootstrap(
        StateSpaceModel(
            MODEL.sample_initial,
            lambda rng, x: rho * x + SIGMA * rng.standard_normal(x.shape),
            MODEL.log_likelihood,
        ),
        n,
    )


def seconds_of(program) -> float:
    begin = time.process_time()
    program()
    return time.process_time() - begin


def ratios(ys: np.ndarray, n_runs: int, n: int) -> None:
    """Print the time of sweeps and of PMMH in a sweep, relative to single runs that run alternately with them."""
    schemes = (Systematic(), Stratified(), Multinomial(), Residual(), Ssp(), Killing())
    families = {
        "StateSpaceModel.of": [bootstrap(OF, n, scheme) for scheme in schemes],
        "program": [Program(walk).bootstrap(n, resampler=scheme) for scheme in schemes],
    }
    for name, arms in families.items():
        found = [
            seconds_of(lambda arm=arm: run_many(arm, ys, range(n_runs)))
            / (10 * seconds_of(lambda arm=arm: [arm.run(ys, seed) for seed in range(n_runs // 10)]))
            for arm in arms
        ]
        print(f"{name:28} sweep / single runs {np.mean(found):.3f} ({', '.join(f'{r:.3f}' for r in found)})")

    def chains(n_chains, batched):
        start = np.full((n_chains, 1), 0.5)
        return lambda: pmmh(with_coefficient, ys, lambda theta: 0.0, start, 0.1, 15, batched=batched)

    for n_chains in (10, 20, 40):
        found = [seconds_of(chains(n_chains, True)) / seconds_of(chains(n_chains, False)) for _ in range(3)]
        print(f"PMMH, {n_chains} chains, n = 50      one sweep / single chains {np.median(found):.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--particles", type=int, default=100)
    parser.add_argument("--steps", type=int, default=100)
    options = parser.parse_args()
    ys = np.random.default_rng(1).standard_normal(options.steps)
    filter = bootstrap(MODEL, options.particles)
    programs = {
        "plain": lambda: plain(ys, options.runs, options.particles),
        "sweep": lambda: run_many(filter, ys, range(options.runs))["log_evidence"][:, -1],
        "single runs (a tenth)": lambda: [filter.run(ys, seed)[0] for seed in range(options.runs // 10)],
    }
    means = {name: np.mean(programs[name]()) for name in ("plain", "sweep")}
    print("mean log evidence:", {name: round(float(mean), 2) for name, mean in means.items()})
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(options.rounds):
        for name, program in programs.items():
            begin = time.process_time()
            program()
            seconds[name].append((time.process_time() - begin) * (10 if "tenth" in name else 1))
    base = np.array(seconds["plain"])
    for name, found in seconds.items():
        print(f"{name:24} {np.median(found) * 1e3:8.1f} ms   / plain {np.median(np.array(found) / base):.2f}")
    ratios(ys, options.runs, options.particles)


if __name__ == "__main__":
    main()

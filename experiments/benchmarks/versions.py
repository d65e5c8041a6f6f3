"""Compare the speed of two checkouts of mstfilter in one interleaved run.

    python experiments/benchmarks/versions.py OTHER_CHECKOUT --rounds 15 --out versions.csv
    python experiments/benchmarks/versions.py OTHER_CHECKOUT --only smc --rounds 60

In every round both checkouts run the same tasks in random order, each in a process that stays alive for all rounds.
Times are processor time. A ratio is the median over the rounds of (this checkout / other checkout) within a round.
`ratio_of_shortest` is the ratio of the shortest times, which other programs on the machine disturb least.

The names of tasks start with their area. Tasks of `smc` are single filters (a random walk, a model of
`StateSpaceModel.of`, a hidden Markov model, programs), batches of 200 seeds, and resampling of a million weights.
Another task is the first 200 steps of a program that is run for the first time. Tasks of `mst` are all steps of the
preset ``mst`` on the scene ``demo`` and on the full-size scene ``table`` (640 x 480 images, 100 x 100 x 50 voxels).
"""

from __future__ import annotations

import argparse
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np

import mstfilter
from mstfilter import smc
from mstfilter.smc.interfaces import Proposal, Transition, Update
from mstfilter.smc.population import Population

REPOSITORY = Path(__file__).resolve().parent.parent.parent
SCENES = {"demo": 3, "table": 7}


@dataclass(frozen=True)
class Prior(Proposal):
    """x_0 ~ N(0, 1)."""

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        return Population(rng.standard_normal(n))


@dataclass(frozen=True)
class Walk(Transition):
    """x_t ~ N(x_{t-1}, 1)."""

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        return population.moved(population.particles + rng.standard_normal(len(population)))


@dataclass(frozen=True)
class Noise(Update):
    """y_t ~ N(x_t, 0.5)."""

    def update(self, rng: np.random.Generator, predicted: Any, proposed: Any, observation: Any) -> Population:
        return predicted.reweighted(-2.0 * (predicted.particles - observation) ** 2)


def ar1(previous, y):
    """An AR(1) process as a program."""
    x = smc.sample("x", smc.Normal(0.0, 1.4) if previous is None else smc.Normal(0.9 * previous["x"], 0.6))
    smc.observe("y", smc.Normal(x, 0.4), y)


def volatility(previous, y):
    """A stochastic volatility model with Student noise as a program."""
    mean = -1.0 if previous is None else -1.0 + 0.97 * (previous["h"] + 1.0)
    h = smc.sample("h", smc.Normal(mean, 0.8 if previous is None else 0.2))
    smc.observe("y", smc.Student(8.0, 0.0, np.exp(h / 2)), y)


def renewed(program: Any) -> Any:
    """The same function with a new code object, so that the package checks the program again."""
    return FunctionType(program.__code__.replace(), program.__globals__)


MARKOV = smc.StateSpaceModel(
    lambda rng, n: rng.integers(0, 3, n),
    lambda rng, x: (x + (rng.random(x.shape) < 0.2)) % 3,
    lambda x, y: -0.5 * (y - x) ** 2,
)
AR1 = smc.StateSpaceModel(
    lambda rng, n: rng.standard_normal(n),
    lambda rng, x: 0.9 * x + 0.6 * rng.standard_normal(x.shape),
    lambda x, y: -0.5 * ((y - x) / 0.4) ** 2,
)
LINEAR = smc.linear_gaussian([[0.9]], [[0.36]], [[1.0]], [[0.16]], [0.0], [[1.0]])
OF = smc.StateSpaceModel.of(smc.Normal(0.0, 1.4), lambda x: smc.Normal(0.9 * x, 0.6), lambda x: smc.Normal(x, 0.4))


def smc_tasks() -> dict[str, Callable[[], Any]]:
    """The tasks `smc: ...` by name: filters with particles in arrays, and resampling."""
    walk, ys = np.random.default_rng(0).normal(size=1000).cumsum(), np.random.default_rng(1).normal(size=200).tolist()
    vectors = [np.array([y]) for y in ys]
    log_weights, rng = np.log(np.random.default_rng(1).random(1_000_000)), np.random.default_rng(2)

    def single(filter: Any, observations: Any = ys) -> Callable[[], Any]:
        return lambda: [None for _ in filter.iterate(observations, 1)]

    def of_parts(n: int) -> Any:
        return mstfilter.ParticleFilter(n=n, initial=Prior(), transition=Walk(), update=Noise())

    def first_steps(program: Any) -> Callable[[], Any]:
        return lambda: single(smc.Program(renewed(program)).bootstrap(1000))()

    def sweep(model: Any, observations: Any) -> Callable[[], Any]:
        filter = smc.bootstrap(model, 100)
        many = getattr(smc, "batch", smc.run_many)  # the name in versions before run_many took a single filter
        return lambda: many(filter, observations[:100], range(200))

    def resample(scheme: Any) -> Callable[[], Any]:
        return lambda: scheme.select(rng, log_weights, len(log_weights))

    schemes = (smc.Systematic(), smc.Stratified(), smc.Multinomial(), smc.Residual(), smc.Killing(), smc.Ssp())
    return {
        "random walk, n = 10,000": single(of_parts(10_000), walk[:100]),
        "random walk, n = 5": single(of_parts(5), walk),
        "linear_gaussian, n = 100": single(smc.bootstrap(LINEAR, 100), vectors),
        "linear_gaussian, n = 10,000": single(smc.bootstrap(LINEAR, 10_000), vectors[:50]),
        "StateSpaceModel.of, n = 1,000": single(smc.bootstrap(OF, 1000)),
        "hidden Markov model, n = 1,000": single(smc.bootstrap(MARKOV, 1000)),
        "program ar1, n = 1,000": single(smc.Program(ar1).bootstrap(1000)),
        "program volatility, n = 1,000": single(smc.Program(volatility).bootstrap(1000)),
        "program ar1, first 200 steps": first_steps(ar1),
        "program volatility, first 200 steps": first_steps(volatility),
        "batch of linear_gaussian": sweep(LINEAR, vectors),
        "batch of StateSpaceModel": sweep(AR1, ys),
        **{f"{type(scheme).__name__}, 1e6 weights": resample(scheme) for scheme in schemes},
    }


def tasks(recordings: Path) -> dict[str, Callable[[], Any]]:
    """All timed tasks by name."""

    def mst(scene: str) -> Callable[[], Any]:
        def steps() -> None:
            opened = getattr(mstfilter, "open_recording", None) or mstfilter.Recording.open
            clips = opened(recordings / scene).clips()
            clear_cache()
            for _ in mstfilter.preset("mst").iterate(clips, 0):
                pass

        return steps

    found = {f"smc: {name}": task for name, task in smc_tasks().items()}
    return {**found, "mst: demo": mst("demo"), "mst: full size": mst("table")}


def clear_cache() -> None:
    """Clear the cache of intermediate results, so that every round computes all of them."""
    from mstfilter import scene

    if hasattr(scene, "scene_cache"):
        scene.scene_cache.clear()
    else:  # version 0.1
        from mstfilter.scene.memo import clear

        clear()


def worker(recordings: Path) -> None:
    """Read task names from standard input, write processor seconds to standard output."""
    known = tasks(recordings)
    for line in sys.stdin:
        task = known[line.strip()]
        start = time.process_time()
        task()
        print(json.dumps(time.process_time() - start), flush=True)


def start(checkout: Path, recordings: Path) -> subprocess.Popen[str]:
    """A worker that imports mstfilter from a checkout."""
    command = [sys.executable, __file__, "--worker", str(recordings)]
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)


def timed(process: subprocess.Popen[str], task: str) -> float:
    """Processor seconds of a task in a worker."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(task + "\n")
    process.stdin.flush()
    return float(json.loads(process.stdout.readline()))


def main() -> None:
    """Time both checkouts and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, nargs="?", help="root folder of the other checkout")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--out", type=Path, help="CSV file")
    parser.add_argument("--only", default="", help="tasks whose name contains this text")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker is not None:
        worker(options.worker)
        return
    names = [name for name in tasks(Path()) if options.only in name]
    if not names:
        parser.error(f"no task has {options.only!r} in its name: {', '.join(tasks(Path()))}")
    with tempfile.TemporaryDirectory() as folder:
        recordings = Path(folder)
        for scene, seed in SCENES.items() if any(name.startswith("mst") for name in names) else ():
            target = [str(recordings / scene), "--seed", str(seed)]
            command = [sys.executable, "-m", "mstfilter", "simulate", scene, *target]
            subprocess.run(command, check=True, capture_output=True)
        workers = {"this": start(REPOSITORY, recordings), "other": start(options.other.resolve(), recordings)}
        seconds: dict[tuple[str, str], list[float]] = {(task, side): [] for task in names for side in workers}
        for number in range(options.rounds + 1):
            pairs = list(seconds)
            random.Random(number).shuffle(pairs)
            for task, side in pairs:
                took = timed(workers[side], task)
                if number > 0:  # the first round fills caches of imports
                    seconds[task, side].append(took)
        rows = []
        for task in names:
            this, other = seconds[task, "this"], seconds[task, "other"]
            ratios = [a / b for a, b in zip(this, other, strict=True)]
            rows.append(
                {
                    "task": task,
                    "this_s": round(statistics.median(this), 4),
                    "other_s": round(statistics.median(other), 4),
                    "ratio": round(statistics.median(ratios), 3),
                    "ratio_of_shortest": round(min(this) / min(other), 3),
                }
            )
            print(f"{task:42} {rows[-1]['ratio']:6.3f} {rows[-1]['ratio_of_shortest']:6.3f}")
        for process in workers.values():
            process.terminate()
    if options.out is not None:
        from mstfilter.base.files import (
            write_csv,  # not in the other checkout's workers: older ones have no such module
        )

        write_csv(options.out, rows)


if __name__ == "__main__":
    main()

"""Compare the speed of two checkouts of mstfilter in one interleaved run.

    python experiments/benchmarks/versions.py OTHER_CHECKOUT --rounds 15 --out versions.csv

In every round both checkouts run the same tasks in random order, each in a process that stays alive for all rounds.
Times are processor time. A ratio is the median over the rounds of (this checkout / other checkout) within a round.
Tasks: a bootstrap filter of a random walk (10,000 particles, 100 steps), a filter of five particles (1,000 steps),
systematic and multinomial resampling of a million weights, and all steps of the preset ``mst`` on the scene ``demo``
and on the full-size scene ``table`` (640 x 480 images, 100 x 100 x 50 voxels).
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
from typing import Any

import numpy as np

import mstfilter
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


def tasks(recordings: Path) -> dict[str, Callable[[], Any]]:
    """What is timed, by name."""
    walk = np.random.default_rng(0).normal(size=1000).cumsum()
    log_weights = np.log(np.random.default_rng(1).random(1_000_000))
    parts = {"initial": Prior(), "transition": Walk(), "update": Noise()}

    def filter_walk(n: int, steps: int) -> Callable[[], Any]:
        filter = mstfilter.ParticleFilter(n=n, **parts)
        return lambda: [None for _ in filter.iterate(walk[:steps], 1)]

    def resample(name: str) -> Callable[[], Any]:
        scheme, rng = mstfilter.preset("mst", f"resampler={name}").resampler, np.random.default_rng(2)
        return lambda: scheme.select(rng, log_weights, len(log_weights))

    def mst(scene: str) -> Callable[[], Any]:
        opened = getattr(mstfilter, "open_recording", None) or mstfilter.Recording.open
        clips, filter = opened(recordings / scene).clips(), mstfilter.preset("mst")
        return lambda: clear_cache() or [None for _ in filter.iterate(clips, 0)]

    return {
        "bootstrap filter, 10,000 particles": filter_walk(10_000, 100),
        "filter of 5 particles, 1,000 steps": filter_walk(5, 1000),
        "systematic, 1e6 weights": resample("systematic"),
        "multinomial, 1e6 weights": resample("multinomial"),
        "mst, demo": mst("demo"),
        "mst, full size": mst("table"),
    }


def clear_cache() -> None:
    """Drop shared work, so that every round does all of it."""
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
    with tempfile.TemporaryDirectory() as folder:
        recordings = Path(folder)
        for scene, seed in SCENES.items():
            command = [
                sys.executable,
                "-m",
                "mstfilter",
                "simulate",
                scene,
                str(recordings / scene),
                "--seed",
                str(seed),
            ]
            subprocess.run(command, check=True, capture_output=True)
        names = [name for name in tasks(recordings) if options.only in name]
        if not names:
            parser.error(f"no task has {options.only!r} in its name: {', '.join(tasks(recordings))}")
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
            print(rows[-1])
        for process in workers.values():
            process.terminate()
    if options.out is not None:
        from mstfilter.files import write_csv  # not in the other checkout's workers: older ones have no such module

        write_csv(options.out, rows)


if __name__ == "__main__":
    main()

"""How time and memory of a step of `mst` grow: voxels, hypotheses, frames per clip, objects, one at a time.

    python experiments/scaling/run.py                     # finished cases are not measured again
    python experiments/scaling/run.py --smoke --out DIR   # two factors, two values each, at a small size, seconds

Simulated recordings, made once and kept (`mstfilter.simulation.recorder`). Every measurement is a separate process
with one thread: processor seconds by component of the first step that has a past (objects: mean of two), and
the peak of resident memory. Writes measured.csv, slopes.csv and figure.png.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.files import read_csv, write_csv

HERE = Path(__file__).resolve().parent
#: Factor -> what it is drawn over, and the name of that.
FACTORS = {
    "voxels": ("voxels", "voxels"),
    "n": ("n", "hypotheses, and samples"),
    "frames": ("frames", "frames a clip"),
    "objects": ("objects_found", "objects found a hypothesis (5 - 17 on the table)"),
}
STAGES = ("transition", "proposal", "update", "resampler", "build")
FRAMES = 28  # between two pauses: divisible by 1, 2, 4, 7, 14, 28
NOTHING = 0.01  # seconds; stages below have no slope
THREADS = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}


@dataclass(frozen=True)
class Case:
    """One measurement.

    Parameters
    ----------
    family, seed : str, int
        Of the recording; tuning seeds.
    set : mapping
        Fields of the family that differ.
    side : int
        Voxels along x and y; half as many along z. The workspace stays 1 x 1 x 0.5 m.
    n : int
        Hypotheses, and samples.
    stride : int
        Every `stride`-th frame of a clip is used.
    steps : int
        Number of steps with a past that are averaged.
    """

    family: str
    seed: int
    set: dict[str, Any]
    side: int = 100
    n: int = 5
    stride: int = 2
    steps: int = 1

    @property
    def name(self) -> str:
        """A name that identifies the case."""
        changes = "".join(f" {k}={v:g}" for k, v in self.set.items())
        return f"{self.family}-{self.seed}{changes} side={self.side} n={self.n} stride={self.stride}"


# 9 objects, 15 of 29 frames per clip, 1 cm voxels, 5 hypotheses.
LONG = {"frames_per_clip": FRAMES + 1, "fps": 10.0, "n_actions": 1}
BASE = Case("s2", 0, LONG)
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}
SMOKE = Case("s1", 0, SMALL, side=50, n=2, stride=7)


def cases(smoke: bool) -> dict[str, list[Case]]:
    """Factor -> cases."""
    if smoke:
        return {
            "voxels": [replace(SMOKE, side=25), SMOKE],
            "n": [replace(SMOKE, n=1), SMOKE],
            "frames": [SMOKE],
            "objects": [SMOKE],
        }
    return {
        "voxels": [replace(BASE, side=side) for side in (50, 71, 100, 141, 200)],
        "n": [replace(BASE, n=n) for n in (1, 2, 5, 10, 30, 100)],
        "frames": [replace(BASE, stride=stride) for stride in (28, 7, 4, 2, 1)],
        # The unchanged families with 15 frames per clip: the recordings of the other studies.
        "objects": [Case(family, seed, {}, stride=1, steps=2) for family in ("s1", "s2", "s3") for seed in (0, 1)],
    }


class StageSeconds:
    """Processor seconds of the stages of a step; an observer of `ParticleFilter.step`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._began = 0.0

    def __call__(self, stage: str, begins: bool) -> None:
        now = time.process_time()
        if begins:
            self._began = now
        else:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._began


def measure(case: Case) -> dict[str, Any]:
    """One row: run the filter in this process, which must be new."""
    import cv2

    import mstfilter
    from mstfilter.formats import open_recording
    from mstfilter.scene import VoxelGrid
    from mstfilter.simulation import cached_recording
    from mstfilter.study import peak_megabytes, reset_peak

    cv2.setNumThreads(1)
    recording = open_recording(cached_recording(case.family, case.seed, **case.set))
    grid = VoxelGrid(recording.grid.origin, 1.0 / case.side, (case.side, case.side, case.side // 2))
    recording = replace(
        recording,
        grid=grid,
        frames=recording.frames[:: case.stride],
        pauses=tuple(p // case.stride for p in recording.pauses),
        times=recording.times[:: case.stride],
    )
    filter = mstfilter.preset("mst", f"n={case.n}", f"n_proposed={case.n}")
    state = filter.start(0)
    reset_peak()
    before, steps, found = peak_megabytes(), [], []
    for clip in recording.clips()[: 1 + case.steps]:
        began, stages = time.process_time(), StageSeconds()
        state, _ = filter.step(state, clip, observer=stages)
        # The first step has no previous particles and contains late imports.
        if clip.index:
            steps.append({"step": time.process_time() - began, **stages.seconds})
            found.append(np.mean([h.n_objects for h in state.population.particles]))
    return {
        "voxels": int(np.prod(grid.shape)),
        "n": case.n,
        "frames": len(clip),
        "objects": len(recording.manifest["objects"]),
        "objects_found": round(float(np.mean(found)), 2),
        **{f"{s}_s": round(float(np.mean([step.get(s, 0.0) for step in steps])), 4) for s in (*STAGES, "step")},
        "peak_mb": round(peak_megabytes()),
        "before_mb": round(before),
    }


def slope(x: np.ndarray, y: np.ndarray) -> float:
    """Slope of log y over log x, least squares; NaN if a value is 0 or the values of x are nearly equal."""
    if x.max() < 1.3 * x.min() or (y <= 0).any():
        return float("nan")
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def slopes(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """One row per factor and figure: slope over all values, and from the second largest value to the largest.

    There are two rows of objects: the number of true objects, and the number in the hypotheses. The scenes differ in
    other properties too, so these rows have no slope at the end.
    """
    lines = []
    for factor, over in [(f, f) for f in FACTORS] + [("objects", "objects_found")]:
        own = [r for r in rows if r["factor"] == factor]
        if len(own) < 2:
            continue
        x = np.array([float(r[over]) for r in own])
        for what in ("step_s", *(f"{s}_s" for s in STAGES), "peak_mb"):
            y = np.array([float(r[what]) for r in own])
            top = np.isin(x, np.unique(x)[-2:])
            figures = [slope(x, y), slope(x[top], y[top]) if factor != "objects" else np.nan]
            if what.endswith("_s") and y.max() < NOTHING:
                figures = [np.nan, np.nan]
            lines.append(
                {
                    "factor": over,
                    "figure": what,
                    "from": f"{x.min():g}",
                    "to": f"{x.max():g}",
                    "at_first": f"{y[x.argmin()]:g}",
                    "at_last": f"{y[x.argmax()]:g}",
                    "slope": "" if np.isnan(figures[0]) else f"{figures[0]:.2f}",
                    "slope_at_the_end": "" if np.isnan(figures[1]) else f"{figures[1]:.2f}",
                }
            )
    return lines


def main() -> None:
    """Measure the missing cases, fit the slopes, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="tiny, seconds; needs --out")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    parser.add_argument("--only", choices=list(FACTORS), help="measure this factor alone")
    parser.add_argument("--measure", help=argparse.SUPPRESS)  # a case as JSON; used by the processes of this study
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measure(Case(**json.loads(options.measure)))))
        return
    if options.smoke and options.out == HERE / "results":
        parser.error("--smoke would overwrite the results: name another folder with --out")
    options.out.mkdir(parents=True, exist_ok=True)
    target, known = options.out / "measured.csv", {}
    if target.exists():
        known = {r["case"]: r for r in read_csv(target)}
    wanted = cases(options.smoke)
    from mstfilter.simulation import cached_recording

    for factor, chosen in wanted.items():
        for case in chosen:
            if case.name in known or options.only not in (None, factor):
                continue
            cached_recording(case.family, case.seed, **case.set)  # simulated in another process than the measurement
            command = [sys.executable, str(Path(__file__).resolve()), "--measure", json.dumps(asdict(case))]
            done = subprocess.run(
                command, check=True, stdout=subprocess.PIPE, text=True, env={**os.environ, **THREADS}
            )
            row = json.loads(done.stdout.splitlines()[-1])
            known[case.name] = {"case": case.name, **{k: str(v) for k, v in row.items()}}
            print(factor, *(f"{k} {v}" for k, v in row.items()), flush=True)
            write_csv(target, known.values())
    rows = [{"factor": f, **known[c.name]} for f, chosen in wanted.items() for c in chosen if c.name in known]
    fitted = slopes(rows)
    write_csv(options.out / "slopes.csv", fitted)
    for line in fitted:
        print("  ".join(f"{v:>12}" for v in line.values()))
    from figure import draw

    draw(rows, fitted, options.out)


if __name__ == "__main__":
    main()

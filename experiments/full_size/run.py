"""Time and memory of `mst` and of `mst_rules` at full size: 640 x 480, 15 frames per clip, 100 x 100 x 50 voxels.

    python experiments/full_size/run.py [--seed 1] [--rounds 3]
    python experiments/full_size/run.py --smoke --out DIR    # a small recording: shows only that it works

Filters a simulated recording of the scene `table` with both presets alternately, in separate processes with one
thread. Writes results/full_size.csv: the seconds of every step by component (medians over the rounds), and the peak
memory. Prints the ratios of `mst` to `mst_rules`.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.files import write_csv
from mstfilter.lab.simulation import scene_family, simulate_recording
from mstfilter.runs import RunFolder

HERE = Path(__file__).resolve().parent
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}
PRESETS = ("mst", "mst_rules")
SLOTS = ("transition", "proposal", "update", "resampler", "build")


def filter_in_process(recording: Path, out: Path, preset: str, smoke: bool) -> list[dict[str, Any]]:
    """Filter a recording in a separate process; returns one row per step."""
    command = [sys.executable, "-m", "mstfilter", "run", str(recording), *(["n=2"] if smoke else [])]
    threads = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    process = subprocess.Popen(
        [*command, "--preset", preset, "--out", str(out), "--no-report"],
        env={**os.environ, **threads},
        stdout=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{preset} ended with exit status {process.returncode}")
    done, rows = RunFolder.open(out), []
    for t in range(done.n_pauses):
        seconds, info = done.seconds(t), done.info(t)
        row = {"preset": preset, "pause": t, "frames": info["n_frames"], "candidates": info["n_candidates"]}
        row |= {f"{slot}_s": seconds.get(slot, 0.0) for slot in SLOTS}
        quality = sum(info["quality"]["objects"]) / info["n"]
        rows.append(
            {**row, "step_s": sum(seconds.values()), "quality_mean": quality, "peak_GiB": usage.ru_maxrss / 2**20}
        )
    return rows


def main(seed: int, rounds: int, out: Path, smoke: bool) -> None:
    """Simulate a recording, filter it, write and print the table."""
    found: dict[tuple[str, int], list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording"
        family = replace(scene_family("demo"), **SMALL) if smoke else scene_family("table")
        simulate_recording(family, seed, recording)
        for k in range(rounds):
            for preset in PRESETS:
                for row in filter_in_process(recording, Path(folder) / f"{preset}-{k}", preset, smoke):
                    found.setdefault((preset, row["pause"]), []).append(row)
    rows = []
    for same in found.values():
        medians = {
            k: round(float(np.median([row[k] for row in same])), 3) for k in same[0] if k.endswith(("_s", "_GiB"))
        }
        rows.append({**same[0], "quality_mean": round(same[0]["quality_mean"], 3), **medians})
    rows.sort(key=lambda row: (row["preset"], row["pause"]))
    write_csv(out / "full_size.csv", rows)
    print("  ".join(f"{name:>12}" for name in rows[0]))
    for row in rows:
        print("  ".join(f"{value:>12}" for value in row.values()))
    for name in ("step_s", "peak_GiB"):  # of the steps with a past
        values = {p: [v[name] for (q, t), same in found.items() for v in same if q == p and t] for p in PRESETS}
        a, b = (float(np.median(values[p])) for p in PRESETS)
        print(f"{name}: {PRESETS[0]} {a:.2f}, {PRESETS[1]} {b:.2f}, ratio {a / b:.2f}")
    print(f"{rounds} rounds; {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    options = parser.parse_args()
    if options.smoke and options.out == HERE / "results":
        parser.error("--smoke would overwrite the results: name another folder with --out")
    main(options.seed, 1 if options.smoke else options.rounds, options.out, options.smoke)

"""Time and memory of `mst` at full size: 640 x 480, 15 frames per clip, 100 x 100 x 50 voxels.

    python experiments/full_size/run.py [--seed 1]
    python experiments/full_size/run.py --smoke --out DIR    # a small recording: shows only that it works

Filters a simulated recording of the scene `table` in a separate process with one thread, prints the seconds of every
step by component and the peak memory, and writes results/full_size.csv (the peak is that of the whole run).
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from mstfilter.files import write_csv
from mstfilter.runs import RunFolder
from mstfilter.simulation import scene_family, simulate_recording

HERE = Path(__file__).resolve().parent
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}


def main(seed: int, out: Path, smoke: bool) -> None:
    """Simulate a recording, filter it, write and print the table."""
    with tempfile.TemporaryDirectory() as folder:
        recording, run = Path(folder) / "recording", Path(folder) / "run"
        family = replace(scene_family("demo"), **SMALL) if smoke else scene_family("table")
        simulate_recording(family, seed, recording)
        command = [sys.executable, "-m", "mstfilter", "run", str(recording), *(["n=2"] if smoke else [])]
        threads = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
        subprocess.run(
            [*command, "--out", str(run), "--no-report"],
            check=True,
            env={**os.environ, **threads},
            stdout=subprocess.DEVNULL,
        )
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
        done = RunFolder.open(run)
        rows = []
        for t in range(done.n_pauses):
            seconds = done.seconds(t)
            info = done.info(t)
            rows.append(
                {
                    "pause": t,
                    "frames": info["n_frames"],
                    "candidates": info["n_candidates"],
                    **{f"{slot}_s": round(seconds.get(slot, 0.0), 3) for slot in SLOTS},
                    "step_s": round(sum(seconds.values()), 3),
                    "quality_mean": round(sum(info["quality"]["objects"]) / info["n"], 3),
                    "peak_GiB": round(peak, 2),
                }
            )
    write_csv(out / "full_size.csv", rows)
    print("  ".join(f"{name:>12}" for name in rows[0]))
    for row in rows:
        print("  ".join(f"{value:>12}" for value in row.values()))
    print(
        f"peak memory {peak:.2f} GiB; {platform.machine()}, {os.cpu_count()} cores, "
        f"Python {platform.python_version()}"
    )


SLOTS = ("transition", "proposal", "update", "resampler", "build")

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    options = parser.parse_args()
    if options.smoke and options.out == HERE / "results":
        parser.error("--smoke would overwrite the results: name another folder with --out")
    main(options.seed, options.out, options.smoke)

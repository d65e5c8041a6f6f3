"""Kill a run at random times and resume it; the result must be that of an uninterrupted run."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from mstfilter.files import write_csv

HERE = Path(__file__).resolve().parent

FIELDS = ("trial", "killed_after_s", "had_ended", "steps_stored_at_kill", "identical")


def same(a: Path, b: Path) -> bool:
    """Whether two checkpoints hold the same arrays, bit for bit."""
    with np.load(a) as x, np.load(b) as y:
        return x.files == y.files and all(x[n].tobytes() == y[n].tobytes() for n in x.files)


def main() -> None:
    """Run the trials."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--out", type=Path, default=HERE)
    options = parser.parse_args()
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(HERE / "victim.py")]
    rng, rows = np.random.default_rng(0), []
    with tempfile.TemporaryDirectory() as folder:
        uninterrupted = Path(folder) / "uninterrupted.npz"
        start = time.perf_counter()
        subprocess.run([*command, str(uninterrupted)], check=True, env=environment, stdout=subprocess.DEVNULL)
        for trial in range(options.trials):
            path = Path(folder) / f"run{trial}.npz"
            process = subprocess.Popen([*command, str(path)], env=environment, stdout=subprocess.PIPE)
            process.stdout.readline()
            delay = rng.uniform(0, 0.25)
            time.sleep(delay)
            process.send_signal(signal.SIGKILL)
            ended = process.wait() == 0
            process.stdout.close()
            t = -1
            if path.exists():
                with np.load(path) as data:
                    t = str(data["head"]).split('"t": ')[1].split(",")[0]
            subprocess.run([*command, str(path)], check=True, env=environment, stdout=subprocess.DEVNULL)
            rows.append(
                dict(zip(FIELDS, (trial, f"{delay:.4f}", int(ended), t, int(same(uninterrupted, path))), strict=True))
            )
    write_csv(options.out / "trials.csv", rows)
    killed, identical = sum(not r["had_ended"] for r in rows), sum(r["identical"] for r in rows)
    print(f"{len(rows)} trials, {killed} killed while running, {identical} ended identically")
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()

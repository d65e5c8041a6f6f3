"""Kill a run at random times and resume it; the result must be that of an uninterrupted run."""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from mstfilter.files import write_csv

HERE = Path(__file__).resolve().parent

KINDS = ("checkpoint", "run_many", "batch")
FIELDS = ("kind", "trial", "killed_after_s", "had_ended", "stored_at_kill", "identical")


def arrays(path: Path) -> dict[str, tuple[str, bytes]]:
    """The arrays of a file, or of all files in a folder, bit for bit."""
    found = {}
    for file in [path] if path.is_file() else sorted(path.rglob("*.npz")):
        with np.load(file) as data:
            for name in data.files:
                found[f"{file.relative_to(path)}/{name}"] = (data[name].dtype.str, data[name].tobytes())
    return found


def stored(path: Path) -> int:
    """Steps in a checkpoint, or finished runs in a folder."""
    if path.is_file():
        with np.load(path) as data:
            return int(str(data["head"]).split('"t": ')[1].split(",")[0])
    return sum(file.name != "history.npz" for file in path.rglob("*.npz"))


def trials(kind: str, n: int, folder: Path) -> list[dict[str, object]]:
    """Rows of `n` trials of one kind of run."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    suffix = ".npz" if kind == "checkpoint" else ""

    def start(path: Path) -> subprocess.Popen[bytes]:
        command = [sys.executable, str(HERE / "victim.py"), kind, str(path)]
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE)
        process.stdout.readline()
        return process

    def finish(path: Path) -> None:
        with start(path) as process:
            process.stdout.read()
        if process.returncode:
            raise RuntimeError(f"{path} could not be resumed")

    rng, rows = np.random.default_rng(KINDS.index(kind)), []
    whole = folder / f"whole{suffix}"
    process = start(whole)
    began = time.perf_counter()
    process.communicate()
    duration = time.perf_counter() - began
    expected = arrays(whole)
    for trial in range(n):
        path = folder / f"trial{trial}{suffix}"
        process = start(path)
        delay = rng.uniform(0, duration)
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        ended = process.wait() == 0
        process.stdout.close()
        at_kill = stored(path)
        finish(path)
        identical = arrays(path) == expected
        rows.append(dict(zip(FIELDS, (kind, trial, f"{delay:.3f}", +ended, at_kill, +identical), strict=True)))
        if path.is_file():
            path.unlink()
        else:
            shutil.rmtree(path)
    return rows


def main() -> None:
    """Run the trials."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=100, help="of each kind")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--out", type=Path, default=HERE)
    options = parser.parse_args()
    rows = []
    for kind in options.kinds:
        with tempfile.TemporaryDirectory() as folder:
            found = trials(kind, options.trials, Path(folder))
        killed, identical = sum(not r["had_ended"] for r in found), sum(bool(r["identical"]) for r in found)
        print(f"{kind}: {killed} of {len(found)} killed while running, {identical} ended identically", flush=True)
        rows += found
    write_csv(options.out / "trials.csv", rows)


if __name__ == "__main__":
    main()

"""Hostile inputs of all kinds: each must be read, or refused by one clear error, in time and memory.

    python experiments/reliability/fuzz_inputs.py --trials 60    # for each kind; writes fuzz_inputs.csv

A trial copies a valid input, modifies the copy (`tests/hostile.py`) and reads it in another process, with a limit of
time. The table has the outcome, the seconds, the peak of memory above the start, and whether a file outside the
input was changed or code of the input ran.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import io
import os
import sys
import tempfile
import time
from concurrent.futures import TimeoutError
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))  # for the package `tests`

LIMIT_S, LIMIT_MB = 60.0, 1024.0


def resident() -> float:
    """Resident memory in MB."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def trial(name: str, seed: int, example: str, folder: str) -> dict[str, object]:
    """Modify a copy of an example in one or two ways, and read it."""
    from mstfilter.runs.study import peak_megabytes, reset_peak
    from tests.hostile import KINDS, copy, outcome, spoil

    rng = np.random.default_rng([seed, *name.encode()])
    path = copy(Path(example), Path(folder) / "trial" / "it")
    ways = [spoil(rng, path) for _ in range(1 if rng.random() < 0.8 else 2)]
    os.chdir(path)
    reset_peak()
    start, began = resident(), time.perf_counter()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        found = outcome(KINDS[name], path)
    seconds, peak = time.perf_counter() - began, peak_megabytes() - start
    os.chdir(folder)
    canary = Path(folder) / "trial" / "canary"
    touched = not canary.exists() or canary.read_text(encoding="utf-8") != "untouched"
    ran = any(Path(folder).rglob("pwned"))
    return {"kind": name, "seed": seed, "ways": "; ".join(ways), "outcome": found, "seconds": round(seconds, 2)} | {
        "peak_mb": round(peak, 1),
        "touched": touched or ran,
    }


def main() -> None:
    from pebble import ProcessExpired, ProcessPool

    from mstfilter.base.files import write_csv
    from tests.hostile import KINDS

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=60, help="for each kind")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".csv"))
    given = parser.parse_args()
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder, ProcessPool(1) as pool:
        for name in given.kinds:
            example = Path(folder) / "examples" / name.replace(" ", "-")
            example.parent.mkdir(exist_ok=True)
            KINDS[name].write(example)
            for seed in range(given.first, given.first + given.trials):
                try:
                    rows.append(pool.schedule(trial, [name, seed, str(example), folder], timeout=LIMIT_S).result())
                except TimeoutError:
                    rows.append({"kind": name, "seed": seed, "outcome": f"took longer than {LIMIT_S:g} s"})
                except ProcessExpired as error:
                    rows.append({"kind": name, "seed": seed, "outcome": f"the process died: {error}"})
            mine = [row for row in rows if row["kind"] == name]
            counts = collections.Counter(str(row["outcome"]) for row in mine)
            bad = len(mine) - counts["read"] - counts["refused"]
            peak = max(float(str(row.get("peak_mb", 0))) for row in mine)
            print(f"{name:14s}{len(mine):5d} trials, {counts['refused']} refused, {bad} wrong, {peak:.0f} MB")
    write_csv(given.out, rows)
    wrong = [row for row in rows if row["outcome"] not in ("read", "refused") or row.get("touched")]
    wrong += [row for row in rows if float(str(row.get("peak_mb", 0))) > LIMIT_MB]
    for row in wrong:
        print(row)
    print(f"{len(rows)} trials, {len(wrong)} wrong")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()

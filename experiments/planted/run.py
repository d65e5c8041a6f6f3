"""Does `mstfilter check` name planted faults, and does it accept right components?

    python experiments/planted/run.py [--smoke] [--only NAME ...] [--budget SECONDS] [--out FOLDER]

Every component of faults.py and right.py, and every model of models.py, is checked as `mstfilter check` does. The
script writes results.csv (one row for each) into FOLDER (default: results/), and exits with 1 if a right one is
rejected.
"""

from __future__ import annotations

import argparse
import csv
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from entries import Entry
from faults import FAULTS
from right import RIGHT

import models
from mstfilter.mst.testing import run_contract

RESULTS = Path(__file__).parent / "results"
LISTS = {
    "faults": [*FAULTS, *(Entry(name, "model", name, make) for name, make in models.FAULTY.items())],
    "right": [*RIGHT, *(Entry(name, "model", name, make) for name, make in models.RIGHT.items())],
}


def checked(which: str, k: int, budget: float) -> dict[str, object]:
    """The row of one component: which properties are broken, and the message of the first."""
    entry, start = LISTS[which][k], time.perf_counter()
    warnings.simplefilter("ignore")
    results = run_contract(entry.make(), entry.example, entry.exact, budget)
    broken = [result for result in results if result.failure]
    return {
        "list": which,
        "kind": entry.kind,
        "name": entry.name,
        "what": entry.what,
        "broken": len(broken),
        "untested": sum(result.out_of_time for result in results),
        "property": broken[0].name if broken else "",
        "message": broken[0].failure if broken else "",
        "seconds": round(time.perf_counter() - start, 1),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="every twentieth component")
    parser.add_argument("--only", nargs="*", default=[], help="names of components")
    parser.add_argument("--budget", type=float, default=120, help="seconds of each component")
    parser.add_argument("--out", type=Path, default=RESULTS)
    given = parser.parse_args()
    if (given.smoke or given.only) and given.out == RESULTS:
        parser.error("--smoke would overwrite the results: name another folder with --out")
    chosen = [(which, k) for which, entries in LISTS.items() for k in range(len(entries))]
    chosen = chosen[::20] if given.smoke else chosen
    if given.only:
        chosen = [(which, k) for which, k in chosen if LISTS[which][k].name in given.only]
    with ProcessPoolExecutor(2) as pool:
        rows = []
        for row in pool.map(checked, *zip(*chosen, strict=True), [given.budget] * len(chosen)):
            rows.append(row)
            print(*(row[key] for key in ("list", "kind", "name", "seconds", "property", "message")), flush=True)
    given.out.mkdir(parents=True, exist_ok=True)
    with open(given.out / "results.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    faults, right = ([row for row in rows if row["list"] == which] for which in LISTS)
    named, rejected = sum(bool(row["broken"]) for row in faults), sum(bool(row["broken"]) for row in right)
    print(f"named {named} of {len(faults)} faults, rejected {rejected} of {len(right)} right ones")
    return 1 if rejected else 0


if __name__ == "__main__":
    raise SystemExit(main())

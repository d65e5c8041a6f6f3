"""The present `mst` beside the methods of an earlier study on the same scenes.

    python experiments/information/present.py experiments/information/results/present/present_scenes.csv

Writes present.csv beside its argument: of each method of `results/update` the mean over scenes of quality and
information, and the present `mst` minus it, paired by scene, with 95 % t intervals.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mstfilter.files import read_csv, write_csv
from mstfilter.statistics import compare

EARLIER = Path(__file__).parent / "results" / "update" / "update_scenes.csv"


def by_arm(path: Path, score: str) -> dict[str, dict[str, float]]:
    """Arm -> scene -> value."""
    found: dict[str, dict[str, float]] = {}
    for row in read_csv(path):
        if row[score]:
            found.setdefault(row["arm"], {})[row["scene"]] = float(row[score])
    return found


def main() -> None:
    """Compare and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("present", type=Path)
    path, rows = parser.parse_args().present, []
    for score in ("quality", "information"):
        present, earlier = by_arm(path, score), by_arm(EARLIER, score)
        if any(abs(v - earlier["samples_only"].get(k, v)) > 1e-4 for k, v in present["samples_only"].items()):
            parser.error(f"{path} and {EARLIER}: {score} of samples_only differs, so these are not the same scenes")
        for arm, values in earlier.items():
            d = compare(present["mst"], values)
            row = {"score": score, "arm": arm, "n": d.n, "mean": float(np.mean(list(values.values())))}
            rows.append({**row, "present_mst_minus_it": d.mean, "low": d.low, "high": d.high})
    write_csv(path.parent / "present.csv", rows, float_format=".4f")
    print(*rows, sep="\n")


if __name__ == "__main__":
    main()

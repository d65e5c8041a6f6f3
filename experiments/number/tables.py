"""Table and figure of a study of the number of hypotheses.

    python experiments/number/tables.py STUDY [--out experiments/number/results]

number.csv has one row per number of hypotheses, with means over the scenes that were run with all numbers. The
columns have the recalibrated log loss (nats, lower is better) and its difference from the row above, paired by scene
with a 95 % interval. Further columns have the calibration error of the forecasts without recalibration, the quality
of the estimate (`Belief.estimate`), the mean quality, and the processor seconds of a step.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mstfilter.base.files import read_csv, write_csv
from mstfilter.scoring import LOG_LOSS
from mstfilter.scoring.statistics import compare_arms

COLUMNS = (LOG_LOSS, "calibration_error", "quality_estimate", "quality", "core_seconds")


def by_scene(path: Path, column: str) -> dict[int, dict[str, float]]:
    """Mean of a column over the pauses t >= 1, by number of hypotheses and scene."""
    found: dict[int, dict[str, list[float]]] = {}
    for row in read_csv(path):
        if int(row["pause"]) >= 1 and row.get(column):
            n = int(row["arm"].rsplit("=", 1)[1])
            found.setdefault(n, {}).setdefault(f"{row['family']} {row['scene']}", []).append(float(row[column]))
    return {n: {scene: float(np.mean(v)) for scene, v in found[n].items()} for n in sorted(found)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    values = {column: by_scene(chosen.study / "runs.csv", column) for column in COLUMNS}
    numbers = list(values[LOG_LOSS])
    scenes = set.intersection(*(set(values[LOG_LOSS][n]) for n in numbers))
    rows = []
    for k, n in enumerate(numbers):
        row = {"n": n, "scenes": len(scenes)}
        row |= {c: float(np.mean([v for s, v in values[c].get(n, {}).items() if s in scenes])) for c in COLUMNS}
        if k:
            pair = {str(m): {s: values[LOG_LOSS][m][s] for s in scenes} for m in (n, numbers[k - 1])}
            d = compare_arms(pair, str(numbers[k - 1]))[str(n)]
            row |= {"minus_smaller": d.mean, "low": d.low, "high": d.high}
        rows.append(row)
        print({name: round(value, 4) for name, value in row.items()})
    columns = dict.fromkeys(name for row in reversed(rows) for name in row)
    write_csv(chosen.out / "number.csv", rows, columns, float_format=".4g")
    draw(rows, chosen.out / "number.png")


def draw(rows: list[dict[str, float]], path: Path) -> None:
    """Log loss and quality against the number of hypotheses."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    plt.style.use("mstfilter.app.report.figures")
    figure, axes = plt.subplots(1, 2, figsize=(7, 3.2))
    n = [row["n"] for row in rows]
    panels = ((LOG_LOSS,), ("quality_estimate", "quality"))
    titles = "log loss (recalibrated), nats (lower is better)", "quality (higher is better)"
    for axis, names, title in zip(axes, panels, titles, strict=True):
        for name in names:
            axis.plot(n, [row[name] for row in rows], "o-", label=name.replace("_", " "))
        axis.set(xscale="log", xlabel="hypotheses", title=title, xticks=n, xticklabels=[str(k) for k in n])
        axis.minorticks_off()
        axis.legend()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()

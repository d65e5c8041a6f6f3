"""How often do forecasts come true? A reliability diagram of a study.

    python experiments/information/figure.py STUDY [--out FOLDER]

Writes reliability.csv and reliability.png: the share of true answers by forecast, for forecasts of some methods that
"these two voxels belong to one object". The forecasts are pooled over families, scenes and pauses t >= 1. Intervals
are 95 % bootstrap intervals over scenes. Forecasts strictly between 0 and 1 are in bins of width .2. Prints the
calibration error of each method, computed from its pooled forecasts with ten bins.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mstfilter.files import read_csv, write_csv
from mstfilter.forecasts import ForecastTable
from mstfilter.scoring import forecast_table
from mstfilter.study import FORECASTS, StudyFolder

ARMS = ("mst", "single_frame", "true completion")
EDGES = (-0.01, 0.0005, 0.2, 0.4, 0.6, 0.8, 0.9995, 1.01)


def forecasts_of(folder: StudyFolder, arm: str) -> list[ForecastTable]:
    """The forecasts of each scene."""
    found = []
    for run in folder.description["runs"]:
        path = folder.run(run["folder"]) / FORECASTS
        if run["arm"] == arm and path.exists():
            with np.load(path) as data:
                found.append(forecast_table(data["counts"][1:, 0].sum(axis=0)))
    return found


def binned(table: ForecastTable) -> np.ndarray:
    """One row per bin of forecasts: number of forecasts, their sum, and number of true answers."""
    which = np.searchsorted(EDGES, table.p) - 1
    columns = (table.count, table.count * table.p, table.yes)
    return np.stack([np.bincount(which, c, len(EDGES) - 1) for c in columns], axis=1)


def main(study: Path, out: Path) -> None:
    """Write the table and the figure."""
    folder, rng, rows = StudyFolder.open(study), np.random.default_rng(0), []
    for arm in (arm for arm in ARMS if any(run["arm"] == arm for run in folder.description["runs"])):
        tables = forecasts_of(folder, arm)
        print(f"{arm}: calibration error {ForecastTable.pooled(tables).reliability().error:.3f}")
        scenes = np.array([binned(table) for table in tables])
        drawn = scenes[rng.integers(len(scenes), size=(1000, len(scenes)))].sum(axis=1)
        total = scenes.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            low, high = np.nanquantile(drawn[..., 2] / drawn[..., 0], (0.025, 0.975), axis=0)
            forecast, true = total[:, 1] / total[:, 0], total[:, 2] / total[:, 0]
        for k in np.flatnonzero(total[:, 0]):
            row = {"arm": arm, "forecast": forecast[k], "true": true[k], "low": low[k], "high": high[k]}
            rows.append(row | {"share": total[k, 0] / total[:, 0].sum()})
    write_csv(out / "reliability.csv", rows, float_format=".3f")
    draw(out)


def draw(out: Path) -> None:
    """Draw reliability.png from reliability.csv."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.style.use("mstfilter.report.figures")
    rows = read_csv(out / "reliability.csv")
    figure, axes = plt.subplots(figsize=(6, 4.4))
    axes.plot([0, 1], [0, 1], color="0.5", lw=1, ls="--")
    for arm in dict.fromkeys(row["arm"] for row in rows):
        own = [row for row in rows if row["arm"] == arm]
        x, y, low, high = (np.array([float(row[c]) for row in own]) for c in ("forecast", "true", "low", "high"))
        axes.errorbar(x, y, yerr=np.abs([y - low, high - y]), marker="o", ms=5, lw=1.4, capsize=3, label=arm)
    axes.set(xlabel="forecast that two voxels belong to one object", ylabel="share for which it is true")
    axes.legend()
    figure.savefig(out / "reliability.png", dpi=110, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    main(given.study, given.out)

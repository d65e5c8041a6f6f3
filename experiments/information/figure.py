"""How often do forecasts come true? A reliability diagram of a study.

    python experiments/information/figure.py STUDY [--out FOLDER]

Writes reliability.csv, the share of true answers by forecast, and reliability.png: the forecasts of some methods that
"these two voxels belong to one object", pooled over families, scenes and pauses t >= 1, with 95 % bootstrap intervals
over scenes. Forecasts between 0 and 1 are in bins of .2.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mstfilter.files import write_csv
from mstfilter.scoring import forecast_table
from mstfilter.study import FORECASTS, StudyFolder

ARMS = ("mst", "single_frame", "true completion")
EDGES = (-0.01, 0.0005, 0.2, 0.4, 0.6, 0.8, 0.9995, 1.01)


def counts_of(folder: StudyFolder, arm: str) -> list[np.ndarray]:
    """For each scene: forecasts by bin, columns count, sum of forecasts, true answers."""
    found = []
    for run in folder.description["runs"]:
        path = folder.run(run["folder"]) / FORECASTS
        if run["arm"] == arm and path.exists():
            with np.load(path) as data:
                table = forecast_table(data["counts"][1:, 0].sum(axis=0))
            which = np.searchsorted(EDGES, table.p) - 1
            columns = (table.count, table.count * table.p, table.yes)
            found.append(np.stack([np.bincount(which, c, len(EDGES) - 1) for c in columns], axis=1))
    return found


def main(study: Path, out: Path) -> None:
    """Write the table and the figure."""
    import matplotlib.pyplot as plt

    folder, rng, rows = StudyFolder.open(study), np.random.default_rng(0), []
    figure, axes = plt.subplots(figsize=(5, 4.2), layout="constrained")
    axes.plot([0, 1], [0, 1], color="0.5", lw=1, ls="--")
    for arm in (arm for arm in ARMS if any(run["arm"] == arm for run in folder.description["runs"])):
        scenes = np.array(counts_of(folder, arm))
        drawn = scenes[rng.integers(len(scenes), size=(1000, len(scenes)))].sum(axis=1)
        total = scenes.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            low, high = np.nanquantile(drawn[..., 2] / drawn[..., 0], (0.025, 0.975), axis=0)
            forecast, true = total[:, 1] / total[:, 0], total[:, 2] / total[:, 0]
        for k in np.flatnonzero(total[:, 0]):
            row = {"arm": arm, "forecast": forecast[k], "true": true[k], "low": low[k], "high": high[k]}
            rows.append(row | {"share": total[k, 0] / total[:, 0].sum()})
        kept = total[:, 0] > 0
        error = np.abs(np.stack([true - low, high - true])[:, kept])
        axes.errorbar(forecast[kept], true[kept], yerr=error, marker="o", ms=5, lw=1.4, capsize=3, label=arm)
    axes.set(xlabel="forecast that two voxels belong to one object", ylabel="share for which it is true")
    axes.legend(frameon=False)
    figure.savefig(out / "reliability.png", dpi=110, metadata={"Software": None})
    write_csv(out / "reliability.csv", rows, float_format=".3f")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    main(given.study, given.out)

"""The forest plot of the README: differences between `mst_rules` and other methods, from tables of other studies.

    python experiments/readme_picture/differences.py [--out docs/images/differences.png]

Quality is of scenes that were not used for tuning: 30 of `experiments/fusion`, or 15 of `experiments/main` for
methods that only that study has. Information is of the 30 tuning scenes of `experiments/information`. Differences are
paired by scene over all families, with t intervals that are not adjusted for multiple comparisons.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mstfilter.files import read_csv
from mstfilter.report import draw_forest
from mstfilter.statistics import Difference, compare

EXPERIMENTS = Path(__file__).parents[1]
TABLES = {
    "quality": ("fusion/results/fusion_reported_scenes.csv", "main/results/main_scenes.csv"),
    "information": ("information/results/information_scenes.csv",),
}
METHODS = {
    "paper": "the published method",
    "authors": "the authors' program",
    "tracking_only": "the first image, tracked",
    "union": "predictions and samples, not combined",
    "samples_only": "samples of the latest image",
    "single_frame": "the best cut of the latest image",
    "object_fusion": "one map of all images",
    "mst n = 1": "one hypothesis",
    "never merge": "objects are never merged",
}
SIGN = {"quality": 1, "information": -1}  # so that it is better on the right
LABELS = {"quality": "mst_rules minus the method", "information": "the method minus mst_rules, nats"}
BLUE, GREEN = "#336fb9", "#2ca281"


def differences(measure: str) -> dict[str, Difference]:
    """The difference of each method in a measure, from the first table that has the method."""
    found: dict[str, Difference] = {}
    for table in TABLES[measure]:
        values: dict[str, dict[str, float]] = {}
        for row in read_csv(EXPERIMENTS / table):
            values.setdefault(row["arm"], {})[row["scene"]] = SIGN[measure] * float(row[measure])
        for arm in METHODS:
            if arm in values:
                found.setdefault(arm, compare(values["mst"], values[arm]))
    return found


def main(out: Path) -> None:
    """Draw both measures beside each other."""
    import matplotlib.style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.style.context("mstfilter.report.figures"):
        figure = Figure((8.75, 3.6), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(1, 2)
        for axes, measure, mark in zip(panels, TABLES, (BLUE, GREEN), strict=True):
            known = differences(measure)
            rows = [("", name, (d.mean, d.low, d.high), mark) for a, name in METHODS.items() for d in [known[a]]]
            draw_forest(axes, rows)
            for y, arm in enumerate(METHODS):
                place = {"xycoords": ("axes fraction", "data"), "va": "center", "ha": "right", "fontsize": 9}
                axes.annotate(f"{known[arm].n} scenes", (1.0, y), color="#646b74", **place)
            low, high = min(d.low for d in known.values()), max(d.high for d in known.values())
            axes.set_xlim(low - 0.1 * (high - low), high + 0.42 * (high - low))
            axes.tick_params(labelleft=axes is panels[0])
            axes.set_title(f"{measure.capitalize()}: right is better")
            axes.set_xlabel(LABELS[measure])
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, dpi=150, metadata={"Software": None})
    print(out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images/differences.png"))
    main(parser.parse_args().out)

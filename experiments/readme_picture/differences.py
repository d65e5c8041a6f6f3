"""The forest plot of the README: other methods minus `mst`, from a table of another study.

    python experiments/readme_picture/differences.py [--out docs/images/differences.png]

The scenes are the ninety scenes of `experiments/main/study.toml`, which were not used for tuning. Differences are
paired by scene over all families, with intervals that are not adjusted for multiple comparisons.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mstfilter.app.report import draw_forest
from mstfilter.base.files import read_csv
from mstfilter.scoring.statistics import Difference, compare

EXPERIMENTS = Path(__file__).parents[1]
TABLE = EXPERIMENTS / "main/results/main_scenes.csv"
METHODS = {
    "paper": "the published method",
    "authors": "the authors' program",
    "tracking_only": "the first image, tracked",
    "union": "predictions and samples, not combined",
    "samples_only": "samples of the latest image",
    "single_frame": "the best cut of the latest image",
    "object_fusion": "one map of all images",
    "mst n = 1": "one hypothesis",
    "crossover": "the crossover of mst_rules",
}
#: Column of the table -> title.
MEASURES = {
    "quality": "Quality (higher is better)",
    "recalibrated_log_loss": "Log loss, nats (lower is better)",
}
BLUE, GREEN = "#336fb9", "#2ca281"


def differences(measure: str) -> dict[str, Difference]:
    """The difference of each method in a measure."""
    values: dict[str, dict[str, float]] = {}
    for row in read_csv(TABLE):
        values.setdefault(row["arm"], {})[row["scene"]] = float(row[measure])
    return {arm: compare(values[arm], values["mst"]) for arm in METHODS}


def main(out: Path) -> None:
    """Draw both measures beside each other."""
    import matplotlib.style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.style.context("mstfilter.app.report.figures"):
        figure = Figure((8.75, 3.6), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(1, 2)
        for axes, measure, mark in zip(panels, MEASURES, (BLUE, GREEN), strict=True):
            known = differences(measure)
            rows = [("", name, (d.mean, d.low, d.high), mark) for a, name in METHODS.items() for d in [known[a]]]
            draw_forest(axes, rows)
            axes.tick_params(labelleft=axes is panels[0])
            axes.set_title(MEASURES[measure])
            axes.set_xlabel("the method minus mst")
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, dpi=150, metadata={"Software": None})
    print(out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images/differences.png"))
    main(parser.parse_args().out)

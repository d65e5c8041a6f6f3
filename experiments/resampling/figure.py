"""The figure of the resampling study, from summary.csv."""

from __future__ import annotations

import csv
from pathlib import Path

PANELS = (
    ("stochastic_volatility", "branching", "state_error"),
    ("miniature_mst", "branching", "state_error"),
    ("select: real", "125", "diversity"),
    ("select: real", "125", "mass_error"),
)


def draw(out: Path) -> None:
    """Four measures by scheme with their 95 % intervals; figure.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with (out / "summary.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    fig, axes = plt.subplots(1, 4, figsize=(15, 4.5), layout="constrained")
    for ax, (part, setting, measure) in zip(axes, PANELS, strict=True):
        found = [
            r for r in lines if r["part"] == part and r["setting"].startswith(setting) and r["measure"] == measure
        ]
        for k, r in enumerate(found):
            ax.plot([float(r["low"]), float(r["high"])], [k, k], color="0.6")
            ax.plot(float(r["mean"]), k, "o", color="#1b6ca8", ms=4)
        ax.set_yticks(range(len(found)), [r["scheme"] for r in found], fontsize=8)
        ax.invert_yaxis()
        ax.set_title(f"{part}, {measure.replace('_', ' ')}", fontsize=9)
    fig.savefig(out / "figure.png", dpi=90)
    plt.close(fig)

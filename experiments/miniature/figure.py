"""The figure of the miniature study, from its CSV files."""

from __future__ import annotations

import sys
from pathlib import Path

from mstfilter.base.files import read_csv

COLOURS = {
    "n exact draws": "0.6",
    "guided": "#1b6ca8",
    "balanced": "#3fa7d6",
    "bootstrap": "#9ec9e2",
    "paper": "#d1495b",
    "authors": "#edae49",
    "mst_rules": "#b08fd8",
    "mst": "#5b3a8c",
}
NAMES = {"n exact draws": "n draws of the exact posterior"}
RANKED = ("exact", "bootstrap", "guided", "balanced", "paper", "authors", "mst_rules", "mst")


def draw(out: Path) -> None:
    """Distance against the number of particles, over time, and histograms of ranks; figure.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.style.use("mstfilter.app.report.figures")
    distances, steps, ranks = (read_csv(out / f"{f}.csv") for f in ("distances", "over_time", "calibration"))
    fig = plt.figure(figsize=(10, 8.6))
    top, bottom = fig.subfigures(2, 1, height_ratios=[1.15, 1])
    axes = top.subplots(1, 3)
    for ax, world in zip(axes, ("shelf", "row"), strict=False):
        for name, colour in COLOURS.items():
            rows = [r for r in distances if r["world"] == world and r["arm"] == name]
            x, y = [int(r["n"]) for r in rows], [float(r["tv"]) for r in rows]
            ax.errorbar(x, y, [float(r["tv_pm"]) for r in rows], color=colour, marker="o", ms=3, capsize=2, lw=1.5)
        ax.set(xscale="log", ylim=(0, 1), xlabel="particles n", title=f"{world}: mean over steps")
        ax.set_xticks([5, 20, 100, 500], ["5", "20", "100", "500"])
        ax.minorticks_off()
    axes[0].set_ylabel("total variation from the exact posterior")
    sizes = sorted({int(r["n"]) for r in steps})
    n = 100 if 100 in sizes else sizes[-1]
    for name, colour in COLOURS.items():
        rows = [r for r in steps if r["world"] == "shelf" and int(r["n"]) == n and r["arm"] == name]
        x, y = [int(r["t"]) for r in rows], [float(r["tv"]) for r in rows]
        axes[2].plot(x, y, color=colour, marker="o", ms=3, lw=1.5, label=NAMES.get(name, name))
    axes[2].set(ylim=(0, 1), xlabel="step t", title=f"shelf, n = {n}")
    top.legend(*axes[2].get_legend_handles_labels(), loc="outside lower center", ncols=4)

    arms = [a for a in RANKED if any(r["arm"] == a for r in ranks)]
    boxes = bottom.subplots(2, (len(arms) + 1) // 2, sharex=True, sharey=True, squeeze=False).ravel()
    bottom.suptitle(
        'ranks of the true number of pairs of cells in one object ("joined_pairs") among 9 draws', fontsize=11
    )
    for ax, name in zip(boxes, arms, strict=False):
        row = next(r for r in ranks if r["arm"] == name and r["statistic"] == "joined_pairs")
        counts = [int(row[f"rank_{k}"]) for k in range(10)]
        ax.bar(range(10), counts, width=0.9, color=COLOURS.get(name, "0.4"))
        ax.axhline(int(row["worlds"]) / 10, color="black", lw=0.8, ls=":")
        size = f", n = {row['n']}" if row["n"] != "0" else ""
        ax.set_title(f"{NAMES.get(name, name)}{size}: p = {row['p_value']}", fontsize=9)
        ax.set_xticks([0, 9])
    for ax in boxes[len(arms) :]:
        ax.set_visible(False)
    fig.savefig(out / "figure.png", dpi=110)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))

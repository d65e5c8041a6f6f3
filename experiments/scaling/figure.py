"""The figure of the scaling study: seconds of a step by stage, and peak memory, over each factor; log-log."""

from __future__ import annotations

from pathlib import Path

import numpy as np

COLOURS = {"transition": "#1b6ca8", "proposal": "#3a8f4d", "update": "#b3432b", "build": "#8a5aa8", "step": "0.2"}


def draw(rows: list[dict[str, str]], slopes: list[dict[str, str]], out: Path) -> None:
    """Draw figure.png from the rows of measured.csv and slopes.csv."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FuncFormatter, NullFormatter
    from run import FACTORS, NOTHING

    plt.style.use("mstfilter.report.figures")
    fitted = {(r["factor"], r["figure"]): r["slope"] for r in slopes}
    fig, axes = plt.subplots(4, 2, figsize=(9, 13), sharey="col")
    for column, (factor, (over, name)) in enumerate(FACTORS.items()):
        own = sorted((r for r in rows if r["factor"] == factor), key=lambda r: float(r[over]))
        x = np.array([float(r[over]) for r in own])
        style = "o" if factor == "objects" else "o-"  # scenes are not values of one variable
        top, bottom = axes[column]
        for part, colour in COLOURS.items():
            y = np.array([float(r[f"{part}_s"]) for r in own])
            if len(x) and y.max() >= NOTHING:
                label = f"{part}: {fitted.get((over, f'{part}_s')) or 'none'}"
                top.plot(x, y, style, color=colour, ms=4, lw=2 if part == "step" else 1, label=label)
        bottom.plot(x, [float(r["peak_mb"]) for r in own], style, color="0.2", ms=4, lw=2)
        bottom.set_title(f"slope over all values {fitted.get((over, 'peak_mb'), '')}")
        if len(x):
            top.legend(loc="upper left", ncols=2, title="slope over all values", title_fontsize=9)
        top.set(xlabel=name, ylabel="processor seconds of a step")
        bottom.set(xlabel=name, ylabel="peak memory, MB")
        for ax in (top, bottom):
            ax.set_xscale("log")
            ax.set_yscale("log")
            ticks = [5, 10, 15] if factor == "objects" else sorted(set(x))
            ax.set_xticks(ticks)
            names = {v: f"{v:g}" if v < 1e4 else f"{v / 1e6:.2g} M" for v in ticks}
            ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _, names=names: names.get(v, "")))
            ax.xaxis.set_minor_formatter(NullFormatter())
    for ax, ticks in zip(axes[0], ([0.5, 1, 2, 5, 10, 20, 50], [400, 600, 1000, 1600]), strict=True):
        ax.set_yticks(ticks, [f"{v:g}" for v in ticks])
        ax.yaxis.set_minor_formatter(NullFormatter())
    axes[0, 0].set_ylim(0.2, 100)
    fig.savefig(out / "figure.png", dpi=110)
    plt.close(fig)

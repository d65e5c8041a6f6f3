"""The figure of the resampling study, from summary.csv."""

from __future__ import annotations

from pathlib import Path

from mstfilter.files import read_csv

#: Part, beginning of the setting, measure, title; errors above, what is selected below.
PANELS = (
    ("linear_gaussian", "branching", "state_error", "AR(1), 20 of 80:\nstate error"),
    ("stochastic_volatility", "branching", "state_error", "volatility, 20 of 80:\nstate error"),
    ("object_hmm", "branching", "state_error", "shelves, 20 of 80:\nstate error"),
    ("miniature_mst", "plain", "state_error", "miniature MST, 200 of 200:\ndistance from the posterior"),
    ("select: simulated", "candidates of mst", "diversity", "simulated scenes, mst, 5 of 125:\ndiversity"),
    ("select: simulated", "candidates of mst", "best_of_n", "simulated scenes, mst, 5 of 125:\nbest quality of 5"),
    (
        "select: simulated",
        "candidates of scored",
        "best_of_n",
        "simulated scenes, scored, 5 of 60:\nbest quality of 5",
    ),
    ("select: real", "", "best_of_n", "real particles, 5 of 125:\nbest quality of 5"),
)
COLOURS = {"higher": "#b3432b", "lower": "#1b6ca8"}


def draw(out: Path) -> None:
    """Differences from systematic with their 95 % intervals; figure.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    lines = read_csv(out / "summary.csv")
    fig, axes = plt.subplots(2, 4, figsize=(15, 9), layout="constrained")
    for ax, (part, setting, measure, title) in zip(axes.ravel(), PANELS, strict=True):
        panel = [
            r for r in lines if r["part"] == part and r["setting"].startswith(setting) and r["measure"] == measure
        ]
        found = [r for r in panel if r["minus_systematic"]]
        for k, r in enumerate(found):
            colour = COLOURS.get(r["claim"], "0.5")
            ax.plot([float(r["diff_low"]), float(r["diff_high"])], [k, k], color=colour)
            ax.plot(float(r["minus_systematic"]), k, "o", color=colour, ms=4)
        ax.axvline(0, color="0.3", lw=0.8)
        ax.set_yticks(range(len(found)), [r["scheme"] for r in found], fontsize=8)
        ax.invert_yaxis()
        base = next((r["mean"] for r in panel if r["scheme"] == "systematic"), "absent")
        ax.set_title(title, fontsize=9)
        ax.set_xlabel(f"minus that of systematic ({base})", fontsize=8)
    fig.suptitle(
        "red: higher, blue: lower than systematic (Holm over the schemes, 5 %); grey: nothing can be claimed"
    )
    fig.savefig(out / "figure.png", dpi=90)
    plt.close(fig)

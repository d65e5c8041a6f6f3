"""The figure of the resampling study, from summary.csv."""

from __future__ import annotations

from pathlib import Path

from mstfilter.base.files import read_csv

#: Part, beginning of the setting, measure, title.
PANELS = (
    ("linear_gaussian", "plain", "state_error", "AR(1), 100 of 100:\nstate error"),
    (
        "stochastic_volatility",
        "plain",
        "log_evidence_variance",
        "volatility, 100 of 100:\nvariance of the log evidence",
    ),
    ("select: linear_gaussian", "n to n", "energy_distance", "AR(1), 100 of 100:\nenergy distance of a selection"),
    ("select: object_hmm", "n to n", "energy_distance", "shelves, 100 of 100:\nenergy distance of a selection"),
    ("linear_gaussian", "branching", "state_error", "AR(1), 20 of 80:\nstate error"),
    (
        "stochastic_volatility",
        "branching",
        "log_evidence_variance",
        "volatility, 20 of 80:\nvariance of the log evidence",
    ),
    ("object_hmm", "branching", "state_error", "shelves, 20 of 80:\nstate error"),
    ("select: real", "", "best_of_n", "real particles, 5 of 125:\nbest quality of 5"),
)
WIDEST = 100  # per cent


def draw(out: Path) -> None:
    """Draw figure.png: differences from `systematic` in per cent of its mean, with 95 % intervals."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.style.use("mstfilter.app.report.figures")

    lines = read_csv(out / "summary.csv")
    fig, axes = plt.subplots(4, 2, figsize=(9, 16))
    for ax, (part, setting, measure, title) in zip(axes.ravel(), PANELS, strict=True):
        panel = [
            r for r in lines if r["part"] == part and r["setting"].startswith(setting) and r["measure"] == measure
        ]
        base = next((float(r["mean"]) for r in panel if r["scheme"] == "systematic"), 1.0)
        found = [r for r in panel if r["minus_systematic"]]
        for k, r in enumerate(found):
            middle, low, high = (
                100 * float(r[name]) / base for name in ("minus_systematic", "diff_low", "diff_high")
            )
            colour = "0.5"
            if float(r["p_holm"]) < 0.05:
                colour = "#b3432b" if middle > 0 else "#1b6ca8"
            ax.plot([low, high], [k, k], color=colour)
            ax.plot(min(middle, WIDEST), k, "o" if middle <= WIDEST else ">", color=colour, ms=4)
        ax.axvline(0, color="0.3", lw=0.8)
        left, right = ax.get_xlim()
        ax.set_xlim(max(left, -WIDEST), min(right, 1.05 * WIDEST))
        ax.set_yticks(range(len(found)), [r["scheme"] for r in found])
        ax.invert_yaxis()
        ax.set_title(title)
        ax.grid(axis="x")
        ax.grid(axis="y", visible=False)
        ax.set_xlabel(f"per cent of systematic ({base:.3g})")
    fig.suptitle(
        "red: higher, blue: lower than systematic (Holm over the schemes, 5 %)\ngrey: no difference can be claimed",
        fontsize=11,
    )
    fig.savefig(out / "figure.png", dpi=110)
    plt.close(fig)

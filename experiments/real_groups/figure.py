"""The figure of the study of real groups: differences from `mst` by group, and change of depth between two frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

COLOURS = {"mst": "#1b6ca8", "tracking_only": "#b3432b", "union": "0.55"}


def draw(lines: Sequence[dict[str, str]], out: Path) -> None:
    """Draw figure.png from the rows of pauses.csv."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from run import differences, group_means

    plt.style.use("mstfilter.report.figures")
    means = group_means(lines)
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4.4))
    for row, (method, d) in enumerate(differences(means).items()):
        dots = [means["mst"][g] - means[method][g] for g in means["mst"]]
        left.plot(dots, [row] * len(dots), "o", color="0.7", ms=4)
        left.plot([d.low, d.high], [row, row], color="#1b6ca8")
        left.plot(d.mean, row, "o", color="#1b6ca8", ms=6)
    left.set_yticks(range(len(means) - 1), [m for m in means if m != "mst"])
    left.invert_yaxis()
    left.grid(axis="x")
    left.grid(axis="y", visible=False)
    left.axvline(0, color="0.3", lw=0.8)
    left.set_xlabel(
        "quality of mst minus that of the method\n(a grey dot a group; mean and 95 % t interval, unadjusted)"
    )

    quality = {(r["frame"], r["method"]): float(r["quality"]) for r in lines if int(r["pause"])}
    share = {r["frame"]: float(r["changed"]) for r in lines if int(r["pause"])}
    for method, colour in COLOURS.items():
        gained = [quality[f, method] - quality[f, "samples_only"] for f in share]
        right.plot(list(share.values()), gained, "o", color=colour, ms=4, label=method)
    right.axhline(0, color="0.3", lw=0.8)
    right.set_xlim(-0.03, 1.03)
    right.set_xlabel("share of object pixels whose depth\nchanged by more than 1 cm (a dot a clip)")
    right.set_ylabel("quality minus that of samples_only")
    right.set_title(f"{len(share)} clips, mean {np.mean(list(share.values())):.2f} changed")
    left.set_title(f"{len(means['mst'])} groups")
    fig.legend(loc="outside lower right", ncols=3)
    fig.savefig(out / "figure.png", dpi=120)
    plt.close(fig)

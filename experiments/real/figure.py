"""The figure of the page on real images: quality of each method's one answer, by sequence (results/sequences.csv).

    python experiments/real/figure.py [--out docs/images/real.png]

Needs no images. Methods and colours are in `METHODS`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np

from mstfilter.base.files import read_csv

matplotlib.use("agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
METHODS = {  #: method -> label, marker, colour
    "mst": ("mst", "o", "#336fb9"),
    "mst, no past": ("mst, no earlier images", "s", "#7fb2e5"),
    "single_frame": ("best cut of the latest image", "^", "#2ca281"),
    "floor_image": ("floor: components in the image", "x", "#b0413e"),
    "floor_components": ("floor: components of space", "+", "#b0413e"),
}


def main(out: Path) -> None:
    """Draw a row for each labelled sequence."""
    rows = [row for row in read_csv(HERE / "results" / "sequences.csv") if row["source"] in ("hots", "osd")]
    names = list(dict.fromkeys(row["sequence"] for row in rows))
    figure, axes = plt.subplots(figsize=(6.4, 0.32 * len(names) + 1.9), layout="constrained")
    for method, (label, marker, colour) in METHODS.items():
        found = {row["sequence"]: float(row["quality_answer"]) for row in rows if row["method"] == method}
        axes.scatter(
            [found.get(name, np.nan) for name in names], range(len(names)), s=36, c=colour, marker=marker, label=label
        )
    sizes = {row["sequence"]: row["pauses"] for row in rows}
    sources = {row["sequence"]: row["source"].upper() for row in rows}
    axes.set_yticks(range(len(names)), [f"{sources[n]} {n.removeprefix('learn')} ({sizes[n]})" for n in names])
    axes.invert_yaxis()
    axes.set_xlabel("quality in the image (higher is better)")
    axes.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=2, fontsize="small")
    figure.savefig(out, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=HERE.parents[1] / "docs" / "images" / "real.png")
    main(parser.parse_args().out)

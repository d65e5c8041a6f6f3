"""What fusing over time gains when masks get better: from the folder that `mstfilter study` wrote.

    python experiments/error_budget/mask_quality.py STUDY experiments/error_budget/results

Writes mask_quality.csv (a line a quality of the masks and method: primary endpoint over all scenes, and `mst` minus
the method, paired by scene, unadjusted t interval) and mask_quality.png.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import numpy as np

from mstfilter.report.palette import colour
from mstfilter.study.results import StudyFolder, write_table
from mstfilter.study.statistics import compare
from mstfilter.study.summary import Summary

COLUMNS = ("masks", "method", "n", "quality", "mst_minus", "low", "high", "p")
REFERENCE = "mst"


def by_masks(found: Summary) -> dict[float, dict[str, dict[str, float]]]:
    """Quality of the masks -> method -> scene -> primary endpoint."""
    scenes: dict[float, dict[str, dict[str, float]]] = {}
    for arm in found.arms:
        method, masks = arm.split()[0], float(re.findall(r"quality=([\d.]+)", arm)[0])
        for family in found.families:
            if figure := found.figure(family, arm):
                scenes.setdefault(masks, {}).setdefault(method, {}).update(figure.by_scene)
    return scenes


def table(scenes: dict[float, dict[str, dict[str, float]]]) -> list[dict[str, object]]:
    """A line a quality of the masks and method."""
    lines: list[dict[str, object]] = []
    for masks, methods in sorted(scenes.items()):
        for method, by_scene in methods.items():
            line: dict[str, object] = {"masks": masks, "method": method, "n": len(by_scene)}
            line["quality"] = f"{np.mean(list(by_scene.values())):.4f}"
            if method != REFERENCE:
                d = compare(methods[REFERENCE], by_scene)
                line |= {"mst_minus": f"{d.mean:.4f}", "low": f"{d.low:.4f}", "high": f"{d.high:.4f}"}
                line["p"] = f"{d.p:.4g}"
            lines.append(line)
    return lines


def draw(lines: list[dict[str, object]], path: Path) -> None:
    """Quality of every method, and the gain of `mst` over the others, against the quality of the masks."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    methods = list(dict.fromkeys(str(line["method"]) for line in lines))
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for k, method in enumerate(methods):
        mine = [line for line in lines if line["method"] == method]
        x = np.array([float(str(line["masks"])) for line in mine])
        shade = np.array(colour(k)) / 255
        left.plot(x, [float(str(line["quality"])) for line in mine], "o-", color=shade, ms=4, label=method)
        if method != REFERENCE:
            gain, low, high = (np.array([float(str(line[c])) for line in mine]) for c in ("mst_minus", "low", "high"))
            x = x + 0.008 * (k - len(methods) / 2)  # so that bars do not hide one another
            right.errorbar(x, gain, (gain - low, high - gain), fmt="o-", color=shade, ms=4, capsize=2, lw=1.2)
    right.axhline(0, color="black", lw=0.8)
    left.set(xlabel="quality of the masks", ylabel="3-D quality, pauses t >= 1")
    right.set(xlabel="quality of the masks", ylabel="mst minus the method")
    left.legend(frameon=False)
    for axis in (left, right):
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(study: Path, out: Path) -> None:
    """Read, write, print."""
    lines = table(by_masks(StudyFolder.open(study).summary()))
    out.mkdir(parents=True, exist_ok=True)
    write_table(out / "mask_quality.csv", COLUMNS, lines)
    draw(lines, out / "mask_quality.png")
    for line in lines:
        print(*(str(line.get(c, "")).rjust(14) for c in COLUMNS))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    main(given.study, given.out)

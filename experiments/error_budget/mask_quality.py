"""The gain from fusion over time, by the quality of the masks: from the folder that `mstfilter study` wrote.

    python experiments/error_budget/mask_quality.py STUDY experiments/error_budget/results

Writes mask_quality.csv (one row per quality of the masks and method: primary endpoint over all scenes, unweighted and
weighted over the hypotheses, and `mst` minus the method, paired by scene, unadjusted t interval) and
mask_quality.png. `source` is the source of the masks: degraded true masks with `lasting` or
`independent` errors, or `own`, the cuts that `mst` samples. The quality of the latter in the image is measured here
(own_masks.csv, with the agreement of the samples of a pause).
"""

from __future__ import annotations

import argparse
import re
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import mstfilter
from mstfilter.files import write_csv
from mstfilter.formats import open_recording
from mstfilter.oracles import TrueMasks, bind_truth
from mstfilter.report import colour
from mstfilter.scene import Recording
from mstfilter.scoring import weighted_coverage
from mstfilter.segmentation import TreeCutProposal
from mstfilter.simulation import cached_recording
from mstfilter.statistics import compare
from mstfilter.study import StudyFolder, Summary

FIGURES = {"quality": "", "quality_weighted": "_weighted"}  # of a study, and what its columns end in
COLUMNS = (
    "source",
    "masks",
    "method",
    "n",
    *(f"{c}{e}" for e in FIGURES.values() for c in ("quality", "mst_minus", "low", "high")),
)
REFERENCE = "mst"
SOURCES = ("lasting", "independent", "own")


class Masks(NamedTuple):
    """Source of masks and their quality in the image."""

    source: str
    quality: float


def own_quality(recording: Recording) -> tuple[float, float]:
    """Quality in the image of the cuts that `mst` samples, and their agreement; means over pauses t >= 1."""
    filter = mstfilter.preset("mst")
    proposal = filter.proposal
    assert isinstance(proposal, TreeCutProposal)
    true = bind_truth(TrueMasks(), recording)
    rng = np.random.default_rng(0)
    found, agree = [], []
    for clip in recording.clips()[1:]:
        tree, values = proposal.tree_of(clip.after)
        drawn = proposal.sampler.sample(rng, tree, values, filter.n)
        images = [proposal.objects.label_image(tree, cut, clip.after, clip.grid) for cut in drawn.cuts]
        masks = true.masks(clip.after, clip)
        found.append(np.mean([weighted_coverage(image, masks) for image in images]))
        agree.append(np.mean([weighted_coverage(a, b) for a, b in permutations(images, 2)]))
    return float(np.mean(found)), float(np.mean(agree))


def by_masks(found: Summary, name: str, own: float) -> dict[Masks, dict[str, dict[str, float]]]:
    """Masks -> method -> scene -> a metric of the study."""
    scenes: dict[Masks, dict[str, dict[str, float]]] = {}
    for arm in found.arms:
        source, method, _, quality = re.fullmatch(r"(\w+) (.+?)( proposal\.quality=([\d.]+))?", arm).groups()
        masks = Masks(source, float(quality) if quality else own)
        for family in found.families:
            if metric := found.metric(family, arm, name):
                scenes.setdefault(masks, {}).setdefault(method, {}).update(metric.by_scene)
    return scenes


def table(found: Summary, own: float) -> list[dict[str, Any]]:
    """One row per quality of the masks and method."""
    lines: dict[tuple[Masks, str], dict[str, Any]] = {}
    for name, ending in FIGURES.items():
        for masks, methods in by_masks(found, name, own).items():
            for method, by_scene in methods.items():
                new = {"source": masks.source, "masks": round(masks.quality, 3), "method": method, "n": len(by_scene)}
                line = lines.setdefault((masks, method), new)
                line[f"quality{ending}"] = f"{np.mean(list(by_scene.values())):.4f}"
                if method != REFERENCE:
                    d = compare(methods[REFERENCE], by_scene)
                    differences = {"mst_minus": d.mean, "low": d.low, "high": d.high}
                    line |= {f"{k}{ending}": f"{v:.4f}" for k, v in differences.items()}
    order = sorted(lines, key=lambda key: (SOURCES.index(key[0].source), key[0].quality))
    return [lines[key] for key in order]


def draw(lines: list[dict[str, Any]], path: Path) -> None:
    """Quality of every method, and the gain of `mst` over the others, against the quality of the masks."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.style.use("mstfilter.report.figures")
    methods = list(dict.fromkeys(line["method"] for line in lines))
    figure, axes = plt.subplots(1, 3, figsize=(10, 4.3), width_ratios=(1, 1, 0.8))
    axes[2].sharey(axes[1])
    for k, method in enumerate(methods):
        shade = np.array(colour(k)) / 255
        aside = 0.007 * (k - len(methods) / 2)  # so that bars do not hide one another
        for source in SOURCES:
            mine = [line for line in lines if line["method"] == method and line["source"] == source]
            if not mine:
                continue
            x = np.array([line["masks"] for line in mine])
            style = {"color": shade, "mfc": "white" if source == "own" else shade, "ms": 4.5}
            marker = "D" if source == "own" else "o-"
            if source != "independent":
                q = [float(line["quality"]) for line in mine]
                axes[0].plot(x, q, marker, **style, label=method if source == "lasting" else None)
            if method != REFERENCE:
                gain, low, high = (np.array([float(line[c]) for line in mine]) for c in ("mst_minus", "low", "high"))
                axis = axes[2 if source == "independent" else 1]
                axis.errorbar(x + aside, gain, (gain - low, high - gain), fmt=marker, capsize=2, lw=1.1, **style)
    axes[0].plot([], [], "D", color="grey", mfc="white", ms=4.5, label="masks of mst itself")
    figure.legend(loc="outside lower center", ncols=4)
    axes[0].set(title="errors that last", ylabel="3-D quality, pauses t >= 1")
    axes[1].set(title="errors that last", ylabel="mst minus the method")
    axes[2].set(title="errors drawn anew", ylabel="mst minus the method")
    for axis in axes:
        axis.set_xlabel("quality of the masks")
    for axis in axes[1:]:
        axis.axhline(0, color="black", lw=0.8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(study: Path, out: Path) -> None:
    """Read the study, measure the quality of own masks, write the tables, print them."""
    folder = StudyFolder.open(study)
    own: list[dict[str, Any]] = []
    for scene in folder.description["scenes"]:
        made = scene["source"]
        found = own_quality(open_recording(cached_recording(made["family"], made["seed"], **made["set"])))
        own.append({"scene": scene["name"], "quality": f"{found[0]:.4f}", "agreement": f"{found[1]:.4f}"})
    lines = table(folder.summary(), float(np.mean([float(line["quality"]) for line in own])))
    write_csv(out / "own_masks.csv", own)
    write_csv(out / "mask_quality.csv", [line | {"masks": f"{line['masks']:g}"} for line in lines], COLUMNS)
    draw(lines, out / "mask_quality.png")
    for line in lines:
        print(*(str(line.get(c, "")).rjust(14) for c in COLUMNS))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    main(given.study, given.out)

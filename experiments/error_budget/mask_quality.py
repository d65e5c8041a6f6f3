"""What fusing over time gains when masks get better: from the folder that `mstfilter study` wrote.

    python experiments/error_budget/mask_quality.py STUDY experiments/error_budget/results

Writes mask_quality.csv (a line a quality of the masks and method: primary endpoint over all scenes, and `mst` minus
the method, paired by scene, unadjusted t interval) and mask_quality.png. Lines whose `source` is `own` have the masks
of `mst` itself, at their quality in the image, which is measured here.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import mstfilter
from mstfilter.oracles.masks import TrueMasks
from mstfilter.oracles.truth import bind_truth
from mstfilter.report.palette import colour
from mstfilter.scene.quality import weighted_coverage
from mstfilter.scene.recording import Recording
from mstfilter.segmentation.proposal import TreeCutProposal
from mstfilter.simulation.cache import cached_recording
from mstfilter.study.results import StudyFolder, write_table
from mstfilter.study.statistics import compare
from mstfilter.study.summary import Summary

COLUMNS = ("source", "masks", "method", "n", "quality", "mst_minus", "low", "high", "p")
REFERENCE = "mst"
OWN = "own masks "


class Masks(NamedTuple):
    """Where masks come from (`set` or `own`) and how good they are in the image."""

    source: str
    quality: float


def own_quality(recording: Recording) -> float:
    """Quality in the image of the cuts that `mst` draws, mean over pauses t >= 1."""
    filter = mstfilter.preset("mst")
    proposal = filter.proposal
    assert isinstance(proposal, TreeCutProposal)
    true = bind_truth(TrueMasks(), recording)
    rng = np.random.default_rng(0)
    found = []
    for clip in recording.clips()[1:]:
        tree, values = proposal.tree_of(clip.after)
        drawn = proposal.sampler.sample(rng, tree, values, filter.n)
        images = [proposal.objects.label_image(tree, cut, clip.after, clip.grid) for cut in drawn.cuts]
        found.append(np.mean([weighted_coverage(image, true.masks(clip.after, clip)) for image in images]))
    return float(np.mean(found))


def by_masks(found: Summary, own: float) -> dict[Masks, dict[str, dict[str, float]]]:
    """Masks -> method -> scene -> primary endpoint."""
    scenes: dict[Masks, dict[str, dict[str, float]]] = {}
    for arm in found.arms:
        method = re.split(r" proposal[.=]", arm.removeprefix(OWN))[0]
        masks = Masks("own", own) if arm.startswith(OWN) else Masks("set", float(re.findall(r"y=([\d.]+)", arm)[0]))
        for family in found.families:
            if figure := found.figure(family, arm):
                scenes.setdefault(masks, {}).setdefault(method, {}).update(figure.by_scene)
    return scenes


def table(scenes: dict[Masks, dict[str, dict[str, float]]]) -> list[dict[str, Any]]:
    """A line a quality of the masks and method."""
    lines: list[dict[str, Any]] = []
    for (source, masks), methods in sorted(scenes.items(), key=lambda item: (item[0].source != "set", item[0])):
        for method, by_scene in methods.items():
            line: dict[str, Any] = {"source": source, "masks": round(masks, 3), "method": method, "n": len(by_scene)}
            line["quality"] = f"{np.mean(list(by_scene.values())):.4f}"
            if method != REFERENCE:
                d = compare(methods[REFERENCE], by_scene)
                line |= {"mst_minus": f"{d.mean:.4f}", "low": f"{d.low:.4f}", "high": f"{d.high:.4f}"}
                line["p"] = f"{d.p:.4g}"
            lines.append(line)
    return lines


def draw(lines: list[dict[str, Any]], path: Path) -> None:
    """Quality of every method, and the gain of `mst` over the others, against the quality of the masks."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    methods = list(dict.fromkeys(line["method"] for line in lines))
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for k, method in enumerate(methods):
        shade = np.array(colour(k)) / 255
        aside = 0.007 * (k - len(methods) / 2)  # so that bars do not hide one another
        for source, style, face in (("set", "o-", shade), ("own", "D", "white")):
            mine = [line for line in lines if line["method"] == method and line["source"] == source]
            x = np.array([line["masks"] for line in mine])
            label = method if source == "set" else None
            left.plot(x, [float(v["quality"]) for v in mine], style, color=shade, mfc=face, ms=4.5, label=label)
            if method == REFERENCE:
                continue
            gain, low, high = (np.array([float(v[c]) for v in mine]) for c in ("mst_minus", "low", "high"))
            bars = {"color": shade, "mfc": face, "ms": 4.5, "capsize": 2, "lw": 1.1}
            right.errorbar(x + aside, gain, (gain - low, high - gain), fmt=style, **bars)
    right.axhline(0, color="black", lw=0.8)
    left.set(xlabel="quality of the masks in the image", ylabel="3-D quality, pauses t >= 1")
    right.set(xlabel="quality of the masks in the image", ylabel="mst minus the method")
    left.plot([], [], "D", color="grey", mfc="white", ms=4.5, label="masks of mst itself")
    left.legend(frameon=False)
    for axis in (left, right):
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(study: Path, out: Path) -> None:
    """Read, measure the own masks, write, print."""
    folder = StudyFolder.open(study)
    sources = [scene["source"] for scene in folder.description["scenes"]]
    own = [own_quality(Recording.open(cached_recording(s["family"], s["seed"], **s["set"]))) for s in sources]
    lines = table(by_masks(folder.summary(), float(np.mean(own))))
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

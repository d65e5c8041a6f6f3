"""How much do segments on both sides of something nearer disagree, if they are one object and if they are two?

    python experiments/segmentation_fit/hidden.py                       # 160 scenes, 6 s of one core each
    python experiments/segmentation_fit/hidden.py --pairs FOLDER        # keeps the measured pairs; resumable
    python experiments/segmentation_fit/hidden.py --smoke --out FOLDER  # few images: a quick test

Fits slope and even of `mstfilter.mst.segmentation.hidden`: the log odds of different objects are slope times
(disagreement - even). A pair is labelled by the objects that most pixels of its segments have. Simulated scenes have
weight 1; real frames, the label images of HOTS and OSD in MSTFILTER_SHARED (default ../shared), have weight 6. The
scores in results/hidden.csv are those of scenes and sequences that a fold was not fitted to.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scenes import Pause, pauses, small
from scipy.optimize import minimize
from scipy.special import expit

from mstfilter.base.files import read_csv, write_csv
from mstfilter.lab.simulation import SCENE_FAMILIES
from mstfilter.mst.segmentation import BorderTree, ColourDepthBoundary, ObjectRule
from mstfilter.mst.segmentation.hidden import DISAGREEMENT, hidden_pairs, likely_segments
from mstfilter.scene import scene_cache

HERE = Path(__file__).resolve().parent
REAL = HERE.parent / "real"
sys.path.append(str(REAL))
from folds import border_model  # noqa: E402
from sequences import SHARED, sequences  # noqa: E402

FAMILIES, SEEDS = ("s2", "s3", "row", "occlusion"), range(20, 60)
KNOWN = 0.7  # least share of a segment's pixels that have its object
WEIGHT = 6.0  # of a real pair
FOLDS = 10  # of scenes and real sequences
COLUMNS = ("source", "scene", "different", *DISAGREEMENT)
REAL_SOURCES = ("osd", "hots")
Rows = list[dict[str, object]]


def pairs_of(pause: Pause, tree: BorderTree) -> Iterator[tuple[float, ...]]:
    """Whether each pair of an image is different objects, and how it disagrees."""
    found = ObjectRule().foreground(pause.frame, pause.grid)
    regions = tree.regions(ColourDepthBoundary().boundary(found.frame), found.frame, found.pixels)
    _, image, sums, _ = likely_segments(tree.merges(regions), regions)
    known = pause.image >= 0
    votes = np.zeros((len(sums), int(pause.image.max()) + 1))
    np.add.at(votes, (image[known], pause.image[known]), 1)
    main, share = votes.argmax(axis=1), votes.max(axis=1) / np.maximum(votes.sum(axis=1), 1)
    for (a, b), row in zip(*hidden_pairs(image, sums, found.frame), strict=True):
        if min(main[a], main[b]) > 0 and min(share[a], share[b]) > KNOWN:
            yield int(main[a] != main[b]), *row.round(5).tolist()


def images(source: str, smoke: bool) -> Iterator[tuple[Pause, BorderTree, str]]:
    """The labelled images of a scene, or of a real source, each with the tree and the name of the scene."""
    if source in REAL_SOURCES:
        for sequence in sequences(SHARED):
            if sequence.source == source:
                tree = BorderTree(weights=border_model(sequence.name), joins=False)
                for clip in sequence.recording.clips():
                    yield Pause(clip.after, sequence.truth(clip.index).labels, clip.grid), tree, sequence.name
        return
    name, seed = source.split()
    family = SCENE_FAMILIES[name] if not smoke else small(SCENE_FAMILIES[name])
    for pause in pauses(family, int(seed)):
        yield pause, BorderTree(joins=False), source


def collected(folder: Path | None, smoke: bool) -> Rows:
    """The pairs of all images: source, scene, whether they are different objects, disagreement."""
    rows: Rows = []
    scenes = [f"{name} {seed}" for seed in SEEDS for name in FAMILIES] if not smoke else ["s2 20", "s2 21"]
    for source in [*(() if smoke else REAL_SOURCES), *scenes]:
        file = None if folder is None else folder / f"{source.replace(' ', '-')}.csv"
        if file is None or not file.exists():
            name = "simulated" if source in scenes else source
            own = [
                dict(zip(COLUMNS, (name, scene, *row), strict=True))
                for pause, tree, scene in images(source, smoke)
                for row in pairs_of(pause, tree)
            ]
            scene_cache.clear()
            if file is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                write_csv(file, own, COLUMNS)
        else:
            own = [dict(row) for row in read_csv(file)]
        rows += own
        print(time.strftime("%H:%M:%S"), source, len(own), "pairs", flush=True)
    return rows


def fitted(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Slope and even of the log odds of y (n,) bool, from the disagreement x (n,) and the weights (n,) of pairs."""

    def loss(values: np.ndarray) -> float:
        odds = values[0] * (x - values[1])
        return float(weight @ (np.logaddexp(0, odds) - odds * y))

    slope, even = minimize(loss, (3.0, 1.0), method="Nelder-Mead").x
    return float(slope), float(even)


def scores(odds: np.ndarray, different: np.ndarray) -> dict[str, float]:
    """Counts, log loss, and the joins at even odds."""
    joined = odds < 0
    p = np.clip(expit(odds), 1e-3, 1 - 1e-3)
    share = np.clip(different.mean(), 1e-3, 1 - 1e-3)
    return {
        "pairs": len(odds),
        "one object": int((1 - different).sum()),
        "joined": int(joined.sum()),
        "joined rightly": int((joined & (different == 0)).sum()),
        "log loss": round(float(-np.log(np.where(different == 1, p, 1 - p)).mean()), 4),
        "log loss of the share": round(float(-(share * np.log(share) + (1 - share) * np.log(1 - share))), 4),
    }


def main(options: argparse.Namespace) -> None:
    """Collect, fit, score and write."""
    rows = collected(options.pairs, options.smoke)
    source, scene = (np.array([row[name] for row in rows]) for name in COLUMNS[:2])
    y, *columns = (np.array([row[name] for row in rows], float) for name in COLUMNS[2:])
    x = np.column_stack(columns).max(axis=1)
    weight = np.where(source == "simulated", 1.0, WEIGHT)
    slope, even = fitted(x, y, weight)
    print(f"slope {slope:.2f}, even {even:.2f}")
    names, number = np.unique(scene, return_inverse=True)
    fold = np.random.default_rng(0).permutation(len(names))[number] % FOLDS
    odds = np.zeros(len(y))
    for k in range(FOLDS):
        slope, even = fitted(x[fold != k], y[fold != k], weight[fold != k])
        odds[fold == k] = slope * (x[fold == k] - even)
    table = []
    for name in ("simulated", "hots", "osd"):
        if (of := source == name).any():
            table.append({"images": name} | scores(odds[of], y[of]))
    options.out.mkdir(parents=True, exist_ok=True)
    write_csv(options.out / "hidden.csv", table)
    for row in table:
        print(row)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=Path, help="folder for the measured pairs")
    parser.add_argument("--smoke", action="store_true", help="two small scenes; needs --out")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    chosen = parser.parse_args()
    if chosen.smoke and chosen.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    main(chosen)

"""Segmentation quality on 45 real frames: optimal cut, sampled cuts and floors; constants from other set-ups.

    python experiments/osd_frames/run.py
    python experiments/osd_frames/run.py --smoke --out DIR    # two frames: shows only that it works
    python experiments/osd_frames/run.py --border FOLDER --out DIR    # another border model than that of the package

Needs the frames in MSTFILTER_SHARED (default ../shared) under real/osd_learn. Writes results/*.csv beside this file.
The learned tree was fitted on simulated scenes only. For each frame, SceneCut's constants (colour weight, centre and
slope of the calibration) are chosen on the frames of the other camera set-ups. The same holds for the colour weight
of the first row. differences.csv has the tree with a border model minus the tree without, paired by frame.
"""

from __future__ import annotations

import argparse
import itertools
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from measures import segment_f

from mstfilter.base.files import write_csv
from mstfilter.mst.segmentation import (
    BorderTree,
    ColourDepthBoundary,
    CutSampler,
    ExactCuts,
    LearnedTree,
    MergeLogOdds,
    MetropolisHastingsCuts,
    ObjectRule,
    SceneCutObjectness,
    Segments,
    Tree,
    TreeBuilder,
    UcmTree,
    connected_pixels,
    optimal_cut,
)
from mstfilter.mst.segmentation.tree import merge_tree, prune
from mstfilter.scene import Camera, Frame, foreground, readings_above_table
from mstfilter.scoring import weighted_coverage
from mstfilter.scoring.forecasts import ForecastTable, Recalibration
from mstfilter.scoring.statistics import compare

HERE = Path(__file__).resolve().parent
SHARED = Path(os.environ.get("MSTFILTER_SHARED", HERE.parents[2] / "shared"))

# First and last frame of each camera set-up.
GROUPS = [(0, 1), (2, 4), (5, 5), (6, 16), (17, 24), (25, 26), (27, 29), (30, 30), (31, 32), (33, 44)]
COLOUR_WEIGHTS: tuple[float, ...] = (0.0, 0.2, 0.4, 0.6)
CENTRES: tuple[float, ...] = (0.4, 0.45, 0.5, 0.55, 0.6)
SLOPES: tuple[float, ...] = (8.0, 12.0, 20.0)
# Constants chosen without labels: the colour weight; a logistic curve with values .15 and .8 at the .9 and .995
# quantiles of the merge heights of each tree.
UNFITTED_COLOUR = 0.6
N_QUESTIONS = 8000

# Samplers under the learned tree's log odds, and under SceneCut's value on the contour tree.
LEARNED_SAMPLERS = {
    "mst": MetropolisHastingsCuts(temperature=1.0),
    "mst, temperature 0.5": MetropolisHastingsCuts(temperature=0.5),
    "mst, temperature 2": MetropolisHastingsCuts(temperature=2.0),
    "exact, same law as mst": ExactCuts(temperature=1.0),
}
PAPER = MetropolisHastingsCuts(0.25, burn_in=0, thinning=20, redraw_share=0.0)
AUTHORS = MetropolisHastingsCuts(0.25, 0, 20, "authors", 0.0, True, True, True)
SCENECUT_SAMPLERS = {
    "scenecut, s2 = 1e-3 v*^2": (MetropolisHastingsCuts(), SceneCutObjectness()),
    "paper": (PAPER, SceneCutObjectness()),
    "paper, table at full weight": (PAPER, SceneCutObjectness(background_weight=1.0)),
    "authors": (AUTHORS, SceneCutObjectness()),
    "authors, table at full weight": (AUTHORS, SceneCutObjectness(background_weight=1.0)),
}

RULE = ObjectRule()
VALUE = SceneCutObjectness()
ODDS = MergeLogOdds()


@dataclass
class Case:
    """A frame with its true labels, and the trees of all colour weights before calibration."""

    name: str
    frame: Frame
    truth: np.ndarray
    ignored: np.ndarray
    touching: bool
    trees: dict[float, tuple[Tree, Segments]]
    learned: dict[float, tuple[Tree, Segments]]
    border: dict[float, tuple[Tree, Segments]]  #: with the evidence of a border model

    def score(self, labels: np.ndarray) -> float:
        """`objects` quality; pixels without a label are ignored in prediction and truth."""
        return weighted_coverage(np.where(self.ignored, 0, labels), self.truth, form="objects")

    def score_cut(self, tree: Tree, found: Segments, cut: np.ndarray) -> float:
        """Quality of a cut without its background."""
        return self.score(objects_of(tree, found, cut))

    def asked(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Flat indices (m,) and (m,) of pairs of near pixels above the table, and whether one object has both."""
        rng = np.random.default_rng(int(self.name[5:]))
        asked = readings_above_table(self.frame) & ~self.ignored
        v, u = np.nonzero(asked)
        k = rng.integers(0, len(v), N_QUESTIONS)
        row, column = v[k] + rng.integers(-40, 41, N_QUESTIONS), u[k] + rng.integers(-40, 41, N_QUESTIONS)
        inside = (row >= 0) & (row < asked.shape[0]) & (column >= 0) & (column < asked.shape[1])
        inside[inside] = asked[row[inside], column[inside]]
        first = (v[k] * asked.shape[1] + u[k])[inside]
        second = (row * asked.shape[1] + column)[inside]
        true = self.truth.ravel()
        return first, second, (true[first] == true[second]) & (true[first] > 0)

    def forecasts(self, tree: Tree, found: Segments, cuts: Sequence[np.ndarray]) -> ForecastTable:
        """The share of the cuts in which both pixels of a pair belong to one object, and the answer."""
        first, second, same = self.asked()
        rows = [objects_of(tree, found, cut).ravel() for cut in cuts]
        return ForecastTable.of(np.mean([(r[first] == r[second]) & (r[first] > 0) for r in rows], axis=0), same)

    def f(self, labels: np.ndarray) -> tuple[float, float]:
        """Overlap F and boundary F."""
        return segment_f(np.where(self.ignored, 0, labels), self.truth)


def objects_of(tree: Tree, found: Segments, cut: np.ndarray) -> np.ndarray:
    """Labels (H, W) of a cut without its background."""
    numbers = np.where(found.is_object[cut], np.arange(1, len(cut) + 1), 0)
    return np.where(found.object_pixels, numbers[tree.label_image(cut)], 0)


@dataclass(frozen=True)
class _Given(TreeBuilder):
    """Returns a given tree, so that both front ends start from the same leaves."""

    tree: Tree

    def build(self, boundary: np.ndarray, frame: Frame | None = None, pixels: np.ndarray | None = None) -> Tree:
        return self.tree


def touching(label: np.ndarray) -> bool:
    """Whether pixels of two objects (labels >= 2) are within 3 px of each other."""
    objects = label >= 2
    square = np.ones((7, 7), np.uint8)
    return any(
        (cv2.dilate((label == k).astype(np.uint8), square).astype(bool) & objects & (label != k)).any()
        for k in np.unique(label[objects])
    )


def load(number: int, border: str) -> Case:
    stem = str(SHARED / "real" / "osd_learn" / f"learn{number}")
    rgb = np.ascontiguousarray(cv2.imread(f"{stem}_rgb.png")[..., ::-1])
    depth = cv2.imread(f"{stem}_depth.png", cv2.IMREAD_UNCHANGED) * np.float32(0.001)
    label = cv2.imread(f"{stem}_label.png", cv2.IMREAD_UNCHANGED).astype(np.int64)
    frame = Frame(rgb, depth, Camera.from_intrinsics(525, 525, 319.5, 239.5, 640, 480))
    trees: dict[float, tuple[Tree, Segments]] = {}
    learned, seen = dict(trees), dict(trees)
    found = foreground(frame)
    for weight in COLOUR_WEIGHTS:
        boundary = ColourDepthBoundary(colour_weight=weight).boundary(found.frame)
        tree = tree_of_heights(boundary)
        trees[weight] = (tree, RULE.segments(tree, frame))
        leaves = _Given(tree)
        tree = LearnedTree(leaves).build(boundary, found.frame, found.pixels)
        learned[weight] = (tree, RULE.segments(tree, frame))
        tree = BorderTree(leaves, border).build(boundary, found.frame, found.pixels)
        seen[weight] = (tree, RULE.segments(tree, frame))
    truth = np.where(label >= 2, label - 1, 0)
    return Case(f"learn{number}", frame, truth, label == 0, touching(label), trees, learned, seen)


def tree_of_heights(boundary: np.ndarray) -> Tree:
    """The tree of `UcmTree` with merge heights as `start`, which `calibrated` maps to probabilities."""
    parent, height, leaves = prune(*merge_tree(boundary), UcmTree().max_leaves)
    return Tree(parent, leaves, height)  # the height of leaves is 0


def calibrated(tree: Tree, centre: float, slope: float) -> Tree:
    start = tree.start.copy()
    start[tree.n_leaves :] = UcmTree(centre=centre, slope=slope).probability(start[tree.n_leaves :])
    return Tree(tree.parent, tree.leaves, start)


def without_labels(tree: Tree) -> Tree:
    """Tree calibrated by quantiles of the merge heights, without labels."""
    low, high = np.quantile(tree.start[tree.n_leaves :], (0.9, 0.995))
    slope = (np.log(0.8 / 0.2) - np.log(0.15 / 0.85)) / (high - low)
    return calibrated(tree, low - np.log(0.15 / 0.85) / slope, slope)


def components(case: Case, step: float = np.inf) -> np.ndarray:
    """Floor: 4-connected components above the table; a depth step of `step` m or more separates pixels."""
    own = readings_above_table(case.frame)
    depth = np.where(own, case.frame.depth, 0)

    def joined(a: tuple[slice, ...] | slice, b: tuple[slice, ...] | slice) -> np.ndarray:
        return own[a] & own[b] & (np.abs(depth[a] - depth[b]) < step)

    label = connected_pixels(joined(np.s_[:, :-1], np.s_[:, 1:]), joined(np.s_[:-1], np.s_[1:])) + 1
    label[~own] = 0
    sizes = np.bincount(label.ravel())
    label[sizes[label] < RULE.min_points] = 0
    return np.unique(label, return_inverse=True)[1].reshape(label.shape)


def write_rows(target: Path, header: list[str], rows: Iterable[Iterable]) -> None:
    """Write rows to a CSV file in the order of the header."""
    write_csv(target, [dict(zip(header, row, strict=True)) for row in rows], header)


def main(numbers: Sequence[int], out: Path, border: str) -> None:
    """Score every arm on the given frames."""
    began = time.time()
    cases = [load(number, border) for number in numbers]
    setup = np.array([next(g for g, (a, b) in enumerate(GROUPS) if a <= i <= b) for i in numbers])
    groups = [(g, a, b) for g, (a, b) in enumerate(GROUPS) if g in setup]
    near = np.array([case.touching for case in cases])
    print(
        f"{len(cases)} frames, {len(groups)} set-ups, {near.sum()} with touching objects, {time.time() - began:.0f} s"
    )

    grid = list(itertools.product(COLOUR_WEIGHTS, CENTRES, SLOPES))
    scores = np.zeros((len(grid), len(cases)))
    for k, (weight, centre, slope) in enumerate(grid):
        for i, case in enumerate(cases):
            tree, found = case.trees[weight]
            tree = calibrated(tree, centre, slope)
            scores[k, i] = case.score_cut(tree, found, optimal_cut(tree, VALUE.values(tree, case.frame)))

    chosen = {g: int(scores[:, setup != g].mean(axis=1).argmax()) for g, _, _ in groups}

    def judge(parts: Callable[[Case, float], tuple[Tree, Segments]]) -> tuple[np.ndarray, dict[int, int], np.ndarray]:
        """Scores (weights, frames), index of the best weight on the other set-ups, and scores at that weight."""
        judged = np.zeros((len(COLOUR_WEIGHTS), len(cases)))
        for k, weight in enumerate(COLOUR_WEIGHTS):
            for i, case in enumerate(cases):
                tree, found = parts(case, weight)
                judged[k, i] = case.score_cut(tree, found, optimal_cut(tree, ODDS.values(tree, case.frame)))
        picked = {g: int(judged[:, setup != g].mean(axis=1).argmax()) for g, _, _ in groups}
        return judged, picked, np.array([judged[picked[g], i] for i, g in enumerate(setup)])

    judged, picked, held_out = judge(lambda case, weight: case.learned[weight])
    default = COLOUR_WEIGHTS.index(0.4)
    arms: dict[str, np.ndarray] = {
        "learned tree, optimal cut, colour weight held out": held_out,
        "learned tree, optimal cut, colour 0.4 (default)": judged[default],
        "learned tree, optimal cut, colour 0.6 (no labels used)": judged[COLOUR_WEIGHTS.index(UNFITTED_COLOUR)],
        "scenecut, optimal cut, constants held out": np.array([scores[chosen[g], i] for i, g in enumerate(setup)]),
        "scenecut, optimal cut, constants of all frames": scores[scores.mean(axis=1).argmax()],
    }
    judged, _, held_out = judge(lambda case, weight: case.border[weight])
    arms["border tree, optimal cut, colour weight held out"] = held_out
    arms["border tree, optimal cut, colour 0.4 (default)"] = judged[default]
    for name in ("learned", "border"):
        f = []
        for case in cases:
            tree, found = getattr(case, name)[COLOUR_WEIGHTS[default]]
            f.append(case.f(objects_of(tree, found, optimal_cut(tree, ODDS.values(tree, case.frame)))))
        for measure, values in zip(("overlap F", "boundary F"), np.array(f).T, strict=True):
            arms[f"{name} tree, optimal cut, default: {measure}"] = values
    unlabelled, unlabelled_best = [], []
    best_node: dict[str, list[float]] = {"learned": [], "contour": [], "border": []}
    for case in cases:
        for weight, sink in ((UNFITTED_COLOUR, unlabelled), (0.4, unlabelled_best)):
            tree, found = case.trees[weight]
            tree = without_labels(tree)
            sink.append(case.score_cut(tree, found, optimal_cut(tree, VALUE.values(tree, case.frame))))
        for name, trees in (("learned", case.learned), ("contour", case.trees), ("border", case.border)):
            tree, found = trees[0.4]
            pixels = tree.accumulate_pixels(found.object_pixels & ~case.ignored)
            recall = []
            for k in range(1, case.truth.max() + 1):
                inside = tree.accumulate_pixels((case.truth == k) & found.object_pixels)
                recall.append((inside / (pixels + (case.truth == k).sum() - inside)).max())
            best_node[name].append(float(np.mean(recall)))
    arms["scenecut, optimal cut, no labels used (colour 0.6)"] = np.array(unlabelled)
    arms["scenecut, optimal cut, no labels used (colour 0.4)"] = np.array(unlabelled_best)
    arms["floor: plane + components"] = np.array([c.score(components(c)) for c in cases])
    arms["floor: plane + components cut at 1 cm steps"] = np.array([c.score(components(c, 0.01)) for c in cases])
    for measure, values in zip(
        ("overlap F", "boundary F"), np.array([c.f(components(c)) for c in cases]).T, strict=True
    ):
        arms[f"floor: plane + components: {measure}"] = values
    arms["floor: one blob"] = np.array([c.score(components(c) > 0) for c in cases])
    for name, values in best_node.items():
        arms[f"IoU of the best node of the {name} tree, mean over objects"] = np.array(values)

    sampled = []

    def sample(name: str, sampler: CutSampler, parts: Callable[[int], tuple[Tree, Segments, np.ndarray]]) -> None:
        rows = []
        for i, case in enumerate(cases):
            tree, found, w = parts(i)
            drawn = sampler.sample(np.random.default_rng((1, i)), tree, w, 10)
            objects = [cut[found.is_object[cut]] for cut in drawn.cuts]
            q = [case.score_cut(tree, found, cut) for cut in drawn.cuts]
            rows.append(
                (np.mean(q), np.max(q), np.mean([len(o) for o in objects]), len({o.tobytes() for o in objects}))
            )
        table = np.array(rows)
        arms[f"samples, {name}: mean of 10"] = table[:, 0]
        arms[f"samples, {name}: best of 10"] = table[:, 1]
        sampled.append([name, *np.round(table[:, 2:].mean(axis=0), 2)])

    def learned_parts(i: int) -> tuple[Tree, Segments, np.ndarray]:
        tree, found = cases[i].learned[0.4]
        return tree, found, ODDS.values(tree, cases[i].frame)

    for name, sampler in LEARNED_SAMPLERS.items():
        sample(name, sampler, learned_parts)
    for name, (sampler, value) in SCENECUT_SAMPLERS.items():

        def scenecut_parts(i: int, value: SceneCutObjectness = value) -> tuple[Tree, Segments, np.ndarray]:
            weight, centre, slope = grid[chosen[setup[i]]]
            tree, found = cases[i].trees[weight]
            tree = calibrated(tree, centre, slope)
            return tree, found, value.values(tree, cases[i].frame)

        sample(name, sampler, scenecut_parts)

    # What the samples know: log loss of "one object?" in nats, recalibrated on the other set-ups.
    for name in ("learned", "border"):
        tables: dict[str, list[ForecastTable]] = {"10 samples": [], "optimal cut": []}
        for i, case in enumerate(cases):
            tree, found = getattr(case, name)[COLOUR_WEIGHTS[default]]
            w = ODDS.values(tree, case.frame)
            drawn = MetropolisHastingsCuts(temperature=1.0).sample(np.random.default_rng((1, i)), tree, w, 10)
            tables["10 samples"].append(case.forecasts(tree, found, drawn.cuts))
            tables["optimal cut"].append(case.forecasts(tree, found, [optimal_cut(tree, w)]))
        for what, of_frame in tables.items():
            fitted = {
                g: Recalibration.fit(
                    ForecastTable.pooled([t for t, k in zip(of_frame, setup, strict=True) if k != g])
                )
                for g, _, _ in groups
            }
            losses = [fitted[g].log_loss(t) for t, g in zip(of_frame, setup, strict=True)]
            arms[f"{name} tree, {what}: log loss"] = np.array(losses)

    print(f"\n{'objects quality, mean':66s} all   touching  apart")
    summary = [[n, *(f"{x:.3f}" for x in (v.mean(), v[near].mean(), v[~near].mean()))] for n, v in arms.items()]
    for name, a, b, c in summary:
        print(f"{name:66s} {a}  {b}     {c}")
    print(
        "\nsampler                    objects a sample, distinct sets of objects in 10 (truth: "
        f"{np.mean([c.truth.max() for c in cases]):.2f} objects)"
    )
    for name, objects, distinct in sampled:
        print(f"{name:32s} {objects:5.2f} {distinct:5.2f}")
    print("\ncolour weight of the learned tree without each set-up:", [COLOUR_WEIGHTS[k] for k in picked.values()])
    print("\nconstants (colour weight, centre, slope) fitted without each set-up:")
    for g, a, b in groups:
        print(f"  learn{a}-{b}: {grid[chosen[g]]}")
    print(f"  on all frames: {grid[int(scores.mean(axis=1).argmax())]}")
    print(f"{time.time() - began:.0f} s")

    rows = []

    def row(first: str, second: str, where: str, frames: np.ndarray) -> None:
        d = compare(arms[first][frames], arms[second][frames])
        rows.append([first, second, where, d.n, *(f"{x:.3f}" for x in (d.mean, d.low, d.high))])
        print(*rows[-1])

    row("learned tree, 10 samples: log loss", "learned tree, optimal cut: log loss", "all", near | ~near)
    row("border tree, 10 samples: log loss", "border tree, optimal cut: log loss", "all", near | ~near)
    for name in arms:
        other = name.replace("border", "learned")
        if other != name:
            for where, frames in (("all", near | ~near), ("touching", near), ("apart", ~near)):
                row(name, other, where, frames)
    row("border tree, optimal cut, colour weight held out", "floor: plane + components", "apart", ~near)
    write_rows(out / "differences.csv", ["first", "second", "frames", "n", "mean", "low", "high"], rows)
    write_rows(out / "summary.csv", ["arm", "all", "touching", "apart"], summary)
    write_rows(out / "samplers.csv", ["sampler", "objects", "distinct_of_10"], sampled)
    names = list(arms)
    write_rows(
        out / "frames.csv",
        ["frame", "set_up", "touching", "objects", *names],
        (
            [c.name, int(setup[i]), int(near[i]), int(c.truth.max()), *(f"{arms[n][i]:.3f}" for n in names)]
            for i, c in enumerate(cases)
        ),
    )
    write_rows(
        out / "constants.csv",
        ["set_up", "frames", "colour_weight", "centre", "slope", "colour_weight_learned"],
        ([g, f"learn{a}-{b}", *grid[chosen[g]], COLOUR_WEIGHTS[picked[g]]] for g, a, b in groups),
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="two frames of two set-ups; needs --out")
    parser.add_argument("--border", default="border", help="a border model with fitted evidence")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    options = parser.parse_args()
    if (options.smoke or options.border != "border") and options.out == HERE / "results":
        parser.error("this would overwrite the results: name another folder with --out")
    if options.smoke:
        COLOUR_WEIGHTS, CENTRES, SLOPES = (0.4, 0.6), (0.5,), (8.0, 12.0)
    main((0, 2) if options.smoke else range(45), options.out, options.border)

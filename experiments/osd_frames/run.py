"""Segmentation quality on 45 real frames: optimal cuts, sampled cuts and floors; constants from other set-ups.

    python experiments/osd_frames/run.py
    python experiments/osd_frames/run.py --smoke --out DIR    # two frames: shows only that it works
    python experiments/osd_frames/run.py --border FOLDER --out DIR    # another border model than that of the package

Needs the frames in MSTFILTER_SHARED (default ../shared) under real/osd_learn. Writes results/*.csv beside this file.
The learned tree was fitted on simulated scenes only. For each frame, the colour weight of the boundary map is chosen
on the frames of the other camera set-ups; for SceneCut, the centre and the slope of the calibration too.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from measures import segment_f

from mstfilter.base.files import write_csv
from mstfilter.mst.segmentation import (
    BorderTree,
    ColourDepthBoundary,
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

HERE = Path(__file__).resolve().parent
SHARED = Path(os.environ.get("MSTFILTER_SHARED", HERE.parents[2] / "shared"))

# First and last frame of each camera set-up.
GROUPS = [(0, 1), (2, 4), (5, 5), (6, 16), (17, 24), (25, 26), (27, 29), (30, 30), (31, 32), (33, 44)]
COLOUR_WEIGHTS: tuple[float, ...] = (0.0, 0.2, 0.4, 0.6)
DEFAULT_COLOUR = 0.4
CENTRES: tuple[float, ...] = (0.4, 0.45, 0.5, 0.55, 0.6)
SLOPES: tuple[float, ...] = (8.0, 12.0, 20.0)
N_SAMPLES = 10

RULE, VALUE, ODDS = ObjectRule(), SceneCutObjectness(), MergeLogOdds()
Parts = tuple[Tree, Segments]


@dataclass
class Case:
    """A frame with its true labels, and its trees: by kind ("contour", "learned", "border") and colour weight."""

    name: str
    frame: Frame
    truth: np.ndarray
    ignored: np.ndarray  #: pixels without a label, in prediction and truth
    touching: bool
    trees: dict[tuple[str, float], Parts]

    def quality(self, labels: np.ndarray) -> float:
        """`objects` quality."""
        return weighted_coverage(np.where(self.ignored, 0, labels), self.truth, form="objects")

    def f(self, labels: np.ndarray) -> tuple[float, float]:
        """Overlap F and boundary F."""
        return segment_f(np.where(self.ignored, 0, labels), self.truth)

    def best(self, parts: Parts, value: SceneCutObjectness | MergeLogOdds) -> np.ndarray:
        """Labels of the optimal cut, without its background."""
        return objects_of(*parts, optimal_cut(parts[0], value.values(parts[0], self.frame)))


def objects_of(tree: Tree, found: Segments, cut: np.ndarray) -> np.ndarray:
    """Labels (H, W) of a cut without its background."""
    numbers = np.where(found.is_object[cut], np.arange(1, len(cut) + 1), 0)
    return np.where(found.object_pixels, numbers[tree.label_image(cut)], 0)


@dataclass(frozen=True)
class _Given(TreeBuilder):
    """Returns a given tree, so that all front ends start from the same leaves."""

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
    """A frame and its trees."""
    stem = str(SHARED / "real" / "osd_learn" / f"learn{number}")
    rgb = np.ascontiguousarray(cv2.imread(f"{stem}_rgb.png")[..., ::-1])
    depth = cv2.imread(f"{stem}_depth.png", cv2.IMREAD_UNCHANGED) * np.float32(0.001)
    label = cv2.imread(f"{stem}_label.png", cv2.IMREAD_UNCHANGED).astype(np.int64)
    frame = Frame(rgb, depth, Camera.from_intrinsics(525, 525, 319.5, 239.5, 640, 480))
    found, trees = foreground(frame), {}
    for weight in COLOUR_WEIGHTS:
        boundary = ColourDepthBoundary(colour_weight=weight).boundary(found.frame)
        # Merge heights as `start`, which `calibrated` maps to probabilities; the height of leaves is 0.
        parent, height, leaves = prune(*merge_tree(boundary), UcmTree().max_leaves)
        contour = Tree(parent, leaves, height)
        trees["contour", weight] = contour
        for kind, builder in (
            ("learned", LearnedTree(_Given(contour))),
            ("border", BorderTree(_Given(contour), border)),
        ):
            trees[kind, weight] = builder.build(boundary, found.frame, found.pixels)
    parts = {key: (tree, RULE.segments(tree, frame)) for key, tree in trees.items()}
    truth = np.where(label >= 2, label - 1, 0)
    return Case(f"learn{number}", frame, truth, label == 0, touching(label), parts)


def calibrated(tree: Tree, centre: float, slope: float) -> Tree:
    """The tree with merge probabilities."""
    start = tree.start.copy()
    start[tree.n_leaves :] = UcmTree(centre=centre, slope=slope).probability(start[tree.n_leaves :])
    return Tree(tree.parent, tree.leaves, start)


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


def main(numbers: Sequence[int], out: Path, border: str) -> None:
    """Score every arm on the given frames."""
    cases = [load(number, border) for number in numbers]
    setup = np.array([next(g for g, (a, b) in enumerate(GROUPS) if a <= i <= b) for i in numbers])
    near = np.array([case.touching for case in cases])
    arms: dict[str, np.ndarray] = {}

    def held_out(quality: Callable[[Case, int], float], n: int) -> tuple[np.ndarray, dict[int, int]]:
        """Scores of the frames, each with the best of `n` choices on the other set-ups, and these choices."""
        scores = np.array([[quality(case, k) for case in cases] for k in range(n)])
        chosen = {g: int(scores[:, setup != g].mean(axis=1).argmax()) for g in sorted(set(setup.tolist()))}
        return np.array([scores[chosen[g], i] for i, g in enumerate(setup.tolist())]), chosen

    weights: dict[str, dict[int, int]] = {}
    for kind in ("learned", "border"):
        arms[f"{kind} tree, optimal cut, colour weight held out"], weights[kind] = held_out(
            lambda case, k, kind=kind: case.quality(case.best(case.trees[kind, COLOUR_WEIGHTS[k]], ODDS)),
            len(COLOUR_WEIGHTS),
        )
        labels = [case.best(case.trees[kind, DEFAULT_COLOUR], ODDS) for case in cases]
        name = f"{kind} tree, optimal cut, colour {DEFAULT_COLOUR} (default)"
        arms[name] = np.array([case.quality(one) for case, one in zip(cases, labels, strict=True)])
        f = np.array([case.f(one) for case, one in zip(cases, labels, strict=True)])
        arms[f"{name}: overlap F"], arms[f"{name}: boundary F"] = f.T
        drawn = []
        for i, case in enumerate(cases):
            tree, found = case.trees[kind, DEFAULT_COLOUR]
            sampler, rng = MetropolisHastingsCuts(temperature=1.0), np.random.default_rng((1, i))
            cuts = sampler.sample(rng, tree, ODDS.values(tree, case.frame), N_SAMPLES).cuts
            drawn.append([case.quality(objects_of(tree, found, cut)) for cut in cuts])
        arms[f"{kind} tree, samples: mean of {N_SAMPLES}"] = np.mean(drawn, axis=1)
        arms[f"{kind} tree, samples: best of {N_SAMPLES}"] = np.max(drawn, axis=1)

    grid = list(itertools.product(COLOUR_WEIGHTS, CENTRES, SLOPES))

    def scenecut(case: Case, k: int) -> float:
        weight, centre, slope = grid[k]
        tree, found = case.trees["contour", weight]
        return case.quality(case.best((calibrated(tree, centre, slope), found), VALUE))

    arms["scenecut, optimal cut, constants held out"], constants = held_out(scenecut, len(grid))
    for name, step in (("components", np.inf), ("components cut at 1 cm steps", 0.01)):
        arms[f"floor: plane + {name}"] = np.array([case.quality(components(case, step)) for case in cases])
    arms["floor: one blob"] = np.array([case.quality(components(case) > 0) for case in cases])

    columns = {"all": near | ~near, "touching": near, "apart": ~near}
    table = [
        {"arm": name, **{column: f"{values[rows].mean():.3f}" for column, rows in columns.items()}}
        for name, values in arms.items()
    ]
    for row in table:
        print(*row.values(), sep="  ")
    write_csv(out / "summary.csv", table)
    frames = [
        {"frame": case.name, "set_up": int(setup[i]), "touching": int(near[i]), "objects": int(case.truth.max())}
        | {name: f"{values[i]:.3f}" for name, values in arms.items()}
        for i, case in enumerate(cases)
    ]
    write_csv(out / "frames.csv", frames)
    header = ("set_up", "frames", "colour_weight", "centre", "slope", "colour_weight_learned")
    rows = [
        (g, "learn{}-{}".format(*GROUPS[g]), *grid[k], COLOUR_WEIGHTS[weights["learned"][g]])
        for g, k in constants.items()
    ]
    write_csv(out / "constants.csv", [dict(zip(header, row, strict=True)) for row in rows])


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

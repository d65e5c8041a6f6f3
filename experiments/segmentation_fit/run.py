"""Fit the weights of the learned trees, `models/tree/weights.json`, on simulated scenes; no real image is used.

    python experiments/segmentation_fit/run.py
    python experiments/segmentation_fit/run.py --border FOLDER       # fit the weights of a border model
    python experiments/segmentation_fit/run.py --smoke --out FILE    # few scenes, one round: a quick test

With ``--border`` the features include the evidence of the border network, and the weights are written into its model.
In each of three rounds, the regions of each scene are merged in the order of their odds under the present weights.
Each evaluated pair is recorded, and merged only if both regions belong to one object. So the recorded pairs are those
that the tree evaluates. Each round fits a logistic regression to the pairs of all rounds so far.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from scenes import FITTED, FITTED_SEEDS, Pause, pauses, small
from scipy.optimize import minimize

from mstfilter.base.resources import models_folder
from mstfilter.base.trained import open_model, write_model
from mstfilter.lab.simulation import SceneFamily
from mstfilter.mst.segmentation import (
    FEATURES,
    PAIR_FEATURES,
    REGION,
    Agglomeration,
    BorderTree,
    ColourDepthBoundary,
    LearnedTree,
    MergedTree,
    PairNetwork,
    Regions,
    pair_features,
    pair_log_odds,
)
from mstfilter.scene import foreground

ROUNDS = 3
PURE = 0.8  # smallest share of one object in a region that is used
RIDGE = 1.0
PACKAGED = models_folder() / "tree" / "weights.json"

Pairs = tuple[list[np.ndarray], list[bool], list[float]]


def measured(
    families: Iterable[SceneFamily], seeds: Iterable[int], builder: MergedTree
) -> list[tuple[Regions, np.ndarray, float]]:
    """`measured_image` of the first pause of every scene."""
    found = []
    for family in families:
        for seed in seeds:
            try:
                [pause] = pauses(family, seed)
            except RuntimeError as error:  # no room for that many objects
                print(family.name, seed, error)
                continue
            found.append(measured_image(pause, builder))
    return found


def measured_image(pause: Pause, builder: MergedTree) -> tuple[Regions, np.ndarray, float]:
    """Regions of an image, numbers of pixels (R, K) of each region in each true object, and image scale."""
    seen = foreground(pause.frame, pause.grid)
    regions = builder.regions(ColourDepthBoundary().boundary(seen.frame), seen.frame, seen.pixels)
    pixels = np.zeros((len(regions.sums), int(pause.image.max()) + 1))
    known = pause.image >= 0
    np.add.at(pixels, (regions.image[known], pause.image[known]), 1)
    pixels[:, 0] += 0.1  # no region is empty
    return regions, pixels, pause.frame.camera.width / 640


def episode(
    regions: Regions,
    pixels: np.ndarray,
    scale: float,
    weights: Mapping[str, float],
    pairs: Pairs,
    correction: PairNetwork | None = None,
) -> None:
    """Merge the regions of one scene by the ground truth, and append the evaluated pairs to `pairs`."""
    growing = Agglomeration(regions, pair_log_odds(weights, correction, scale))
    true = np.zeros((2 * len(pixels), pixels.shape[1]))
    true[: len(pixels)] = pixels
    while (pair := growing.pop()) is not None:
        odds, i, j = pair
        rows = growing.sums[[i]], growing.sums[[j]], growing.borders[i][j][None]
        x = pair_features(*rows, growing.table[i][None], growing.table[j][None], scale, weights)[0]
        first, second = (int(true[r].argmax()) for r in (i, j))
        if (first or second) and all(true[r].max() >= PURE * true[r].sum() for r in (i, j)):
            size = growing.sums[[i, j], REGION["pixels"].start].min() / scale**2
            # Large regions have more weight; pairs with a region of no object have less.
            weight = min(size / 200, 5) ** 0.5 * (1.0 if first and second else 0.3)
            for sink, value in zip(pairs, (x, first != second, weight), strict=True):
                sink.append(value)
        if first != second:
            del growing.borders[i][j], growing.borders[j][i]
        else:
            new = growing.merge(i, j, odds)
            true[new] = true[i] + true[j]


def logistic(pairs: Pairs) -> np.ndarray:
    """Weights of the ridge logistic regression; the penalty is on standardised features."""
    X, different, weight = (np.array(part) for part in pairs)
    mean, scale = X.mean(axis=0), X.std(axis=0) + 1e-9
    mean[0], scale[0] = 0.0, 1.0
    Z, sign = (X - mean) / scale, np.where(different, 1.0, -1.0)

    def loss(b: np.ndarray) -> tuple[float, np.ndarray]:
        margin = -sign * (Z @ b)
        penalty = np.append(0.0, b[1:])
        value = (weight * np.logaddexp(0, margin)).sum() + RIDGE / 2 * (penalty**2).sum()
        return value, Z.T @ (-sign * weight / (1 + np.exp(-margin))) + RIDGE * penalty

    b = minimize(loss, np.zeros(X.shape[1]), jac=True, method="L-BFGS-B", options={"maxiter": 500}).x / scale
    b[0] -= (b[1:] * mean[1:]).sum()
    return b


def write(weights: dict[str, float], path: Path, border: str) -> None:
    """Write the weights into a file, or into the description of a border model."""
    rounded = {name: float(f"{value:.4g}") for name, value in weights.items()}
    if not border:
        path.write_text(json.dumps(rounded, indent=2) + "\n", encoding="utf-8")
        return
    model = open_model(border)
    evidence = {"features": list(rounded), "weights": list(rounded.values())}
    write_model(border, {**model.description, "evidence": evidence}, model.tensors)


def main(path: Path, smoke: bool, border: str = "", n_scenes: int = len(FITTED_SEEDS)) -> None:
    """Fit the weights and write them."""
    began = time.time()
    families = [small(family) for family in FITTED.values()] if smoke else FITTED.values()
    builder = BorderTree(weights=border) if border else LearnedTree()
    scenes = measured(families, FITTED_SEEDS[: 2 if smoke else n_scenes], builder)
    print(f"{len(scenes)} scenes measured, {time.time() - began:.0f} s")
    weights = dict.fromkeys(FEATURES if border else PAIR_FEATURES, 0.0) | {"bias": -6.0, "strength": 12.0}
    pairs: Pairs = ([], [], [])
    for _ in range(1 if smoke else ROUNDS):
        before = len(pairs[0])
        for regions, pixels, scale in scenes:
            episode(regions, pixels, scale, weights, pairs)
        fitted = logistic(pairs)
        weights = dict(zip(weights, fitted.tolist(), strict=True))
        X, different = np.array(pairs[0][before:]), np.array(pairs[1][before:])
        wrong = ((X @ fitted > 0) != different).mean()
        print(
            f"{len(X)} pairs, {different.mean():.3f} different, {wrong:.4f} misclassified, "
            f"{time.time() - began:.0f} s"
        )
    write(weights, path, border)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="a few scenes, one round; needs --out")
    parser.add_argument("--out", type=Path, default=PACKAGED, help="the file to write")
    parser.add_argument("--border", default="", help="folder of a border model: fit with its evidence, write into it")
    parser.add_argument("--scenes", type=int, default=len(FITTED_SEEDS), help="scenes of each family")
    options = parser.parse_args()
    if options.smoke and options.out == PACKAGED and not options.border:
        parser.error("--smoke would overwrite the weights of the package: name another file with --out")
    main(options.out, options.smoke, options.border, options.scenes)

"""Fit the network that corrects the log odds of a border model, on simulated images and on real frames.

    python experiments/segmentation_fit/correction.py --border models/border
    python experiments/segmentation_fit/correction.py --linear FOLDER    # copy without the correction
    python experiments/segmentation_fit/correction.py --smoke --border FOLDER --out DIR    # few images: a quick test

The linear weights of the border model stay as they are. The pairs of regions are those of two rounds of merging
(`run.episode`): with the linear log odds, and with the correction that was fitted to the simulated pairs of the first
round. Real frames are the label images of HOTS and OSD in MSTFILTER_SHARED (default ../shared). For the scores on
these frames, the fit is repeated without some of them. Each repetition is a fold. The folds, and the log loss of the
pairs that a fold has not seen, are written to ../real/folds.safetensors and results/folds.csv.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from run import episode, measured_image
from safetensors.numpy import save
from scenes import FITTED, FITTED_SEEDS, Pause, PlainSamples, pauses, small, training_images

from mst_training.border_data import BorderSamples
from mstfilter.base.files import atomic_path, write_csv
from mstfilter.base.trained import open_model, write_model
from mstfilter.lab.simulation import SCENE_FAMILIES
from mstfilter.mst.segmentation import BorderTree, PairNetwork, Regions
from mstfilter.mst.segmentation.border_network import PAIR_TENSORS

HERE = Path(__file__).resolve().parent
RESULTS, REAL = HERE / "results", HERE.parent / "real"
sys.path.append(str(REAL))
from sequences import FOLDS, SHARED, sequences  # noqa: E402

SHARE = 0.5  # of the fitted correction that is used
HIDDEN = (24, 12)  # units of the hidden layers
DECAY = 3e-4  # weight of the squared weights in the loss
STEPS, BATCH, RATE = 2000, 8192, 5e-3
LATER_SEEDS, TRAINING_SCENES = range(20, 58), range(60)
LATER = (0, 1, 3)  # numbers of pushes after which a simulated image is taken
#: Samples and seed of the images of training scenes by kind; the seeds are of no training.
TRAINING: dict[str, tuple[type[BorderSamples], int]] = {"patterned": (BorderSamples, 77), "plain": (PlainSamples, 78)}
#: Weight of a pair by kind of image. The simulated families have weight 1.
WEIGHTS = {"patterned": 2.0, "plain": 2.0, "real": 3.0}


class Pairs(NamedTuple):
    """Evaluated pairs of regions."""

    features: np.ndarray  #: (k, f)
    different: np.ndarray  #: (k,) bool
    weight: np.ndarray  #: (k,)
    group: np.ndarray  #: (k,) str, sequence of real frames or kind of simulated images


@dataclass(frozen=True)
class Image:
    """Regions of an image with what `run.episode` needs."""

    group: str
    regions: Regions
    pixels: np.ndarray
    scale: float


def simulated(job: tuple[str, int], smoke: bool) -> list[tuple[str, Pause]]:
    """The images of one simulated scene: (kind of images, seed)."""
    kind, seed = job
    if kind in SCENE_FAMILIES:
        family = SCENE_FAMILIES[kind]
        return [("later", pause) for pause in pauses(small(family) if smoke else family, seed, LATER)]
    if kind in FITTED:
        return [("first", pause) for pause in pauses(small(FITTED[kind]) if smoke else FITTED[kind], seed)]
    samples, training_seed = TRAINING[kind]
    return [(kind, pause) for pause in training_images(samples, training_seed, seed)]


def real() -> Iterator[tuple[str, Pause]]:
    """The real frames with label images."""
    for sequence in sequences(SHARED):
        if sequence.source in ("hots", "osd"):
            for clip in sequence.recording.clips():
                yield sequence.name, Pause(clip.after, sequence.truth(clip.index).labels, clip.grid)


def images_of(job: tuple[str, int], border: str, smoke: bool) -> list[Image]:
    """The measured images of a job."""
    builder = BorderTree(weights=border)
    try:
        pauses = list(real()) if job[0] == "real" else simulated(job, smoke)
    except RuntimeError as error:  # no room for that many objects
        print(*job, error)
        return []
    return [Image(group, *measured_image(pause, builder)) for group, pause in pauses]


def pairs_of(images: list[Image], border: str, correction: PairNetwork | None) -> Pairs:
    """The pairs that are evaluated while the regions of the images are merged."""
    weights, _ = BorderTree(weights=border).model()
    found: tuple[list[np.ndarray], list[bool], list[float]] = ([], [], [])
    groups: list[str] = []
    for image in images:
        episode(image.regions, image.pixels, image.scale, weights, found, correction)
        groups += [image.group] * (len(found[0]) - len(groups))
    return Pairs(*(np.array(part) for part in (*found, groups)))


def joined(*parts: Pairs) -> Pairs:
    """All pairs."""
    return Pairs(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def fit(pairs: Pairs, linear: np.ndarray, steps: int = STEPS) -> PairNetwork:
    """Fit a network that is added to the log odds `linear` (k,) of the pairs."""
    import torch
    from torch.nn import functional

    torch.manual_seed(0)
    torch.set_num_threads(1)
    mean, scale = pairs.features.mean(axis=0), pairs.features.std(axis=0) + 1e-6
    mean[0], scale[0] = 0.0, 1.0  # of the constant feature
    empty = PairNetwork(mean, scale, (), ())
    x, base = (torch.tensor(a, dtype=torch.float32) for a in (empty.standardised(pairs.features), linear))
    sign = torch.tensor(np.where(pairs.different, 1.0, -1.0), dtype=torch.float32)
    weight = torch.tensor(pairs.weight / pairs.weight.mean(), dtype=torch.float32)
    sizes = (x.shape[1], *HIDDEN, 1)
    layers = [torch.nn.Linear(i, o) for i, o in pairwise(sizes)]
    torch.nn.init.zeros_(layers[-1].weight)
    torch.nn.init.zeros_(layers[-1].bias)
    parameters = [p for layer in layers for p in layer.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    for _ in range(steps):
        drawn = torch.randint(len(x), (BATCH,))
        y = x[drawn]
        for layer in layers[:-1]:
            y = torch.relu(layer(y))
        odds = base[drawn] + layers[-1](y)[:, 0]
        loss = (weight[drawn] * functional.softplus(-sign[drawn] * odds)).mean()
        loss = loss + DECAY * sum((layer.weight**2).sum() for layer in layers)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    made = [(layer.weight.detach().numpy().T, layer.bias.detach().numpy()) for layer in layers]
    made[-1] = (SHARE * made[-1][0], SHARE * made[-1][1])
    return PairNetwork(mean, scale, *(tuple(part) for part in zip(*made, strict=True)))


def log_loss(pairs: Pairs, odds: np.ndarray) -> float:
    """Weighted mean log loss of the pairs, in nats."""
    sign = np.where(pairs.different, 1.0, -1.0)
    return float((pairs.weight * np.logaddexp(0, -sign * odds)).sum() / pairs.weight.sum())


def main(border: str, out: Path, smoke: bool, workers: int) -> None:
    """Fit the correction, with and without some of the real frames, and write it."""
    began = time.time()
    jobs = [(name, seed) for name in ("s3", "s2", "s1") for seed in LATER_SEEDS]
    jobs += [(name, seed) for name in FITTED for seed in FITTED_SEEDS[:30]]
    jobs += [(name, seed) for name in ("patterned", "plain") for seed in TRAINING_SCENES] + [("real", 0)]
    if smoke:
        jobs = [("s1", 20), ("small", 20), ("plain", 0)]
    measure: Callable[[tuple[str, int]], list[Image]] = partial(images_of, border=border, smoke=smoke)
    with ProcessPoolExecutor(workers) as pool:
        images = [image for found in pool.map(measure, jobs) for image in found]
    print(f"{len(images)} images measured, {time.time() - began:.0f} s")
    of_real = set().union(*FOLDS.values())
    linear_weights = np.array(list(BorderTree(weights=border).model()[0].values()))

    def weighted(pairs: Pairs) -> Pairs:
        kinds = ("real" if group in of_real else group for group in pairs.group.tolist())
        return pairs._replace(weight=pairs.weight * np.array([WEIGHTS.get(kind, 1.0) for kind in kinds]))

    def fitted(pairs: Pairs) -> PairNetwork:
        return fit(pairs, pairs.features @ linear_weights, 50 if smoke else STEPS)

    first = weighted(pairs_of(images, border, None))
    on_real = np.isin(first.group, list(of_real))
    policy = fitted(Pairs(*(part[~on_real] for part in first)))
    pairs = joined(first, weighted(pairs_of(images, border, policy)))
    print(f"{len(pairs.weight)} pairs, {pairs.different.mean():.3f} different, {time.time() - began:.0f} s")
    folds, rows = {}, []
    for fold, left_out in FOLDS.items() if on_real.any() else ():
        unseen = np.isin(pairs.group, left_out)
        folds[fold] = fitted(Pairs(*(part[~unseen] for part in pairs)))
        for name in left_out:
            own = Pairs(*(part[pairs.group == name] for part in pairs))
            odds = own.features @ linear_weights
            losses = {"linear": log_loss(own, odds), "corrected": log_loss(own, odds + folds[fold](own.features))}
            rows.append({"fold": fold, "sequence": name} | {key: f"{value:.4f}" for key, value in losses.items()})
            print(*rows[-1].values())
    model = open_model(border)
    write_model(model.folder, model.description, {**model.tensors, **fitted(pairs).tensors()})
    if rows:
        write_csv(out / "folds.csv", rows)
        arrays = {f"{fold}/{name}": t for fold, network in folds.items() for name, t in network.tensors().items()}
        with atomic_path((REAL if out == RESULTS else out) / "folds.safetensors") as path:
            path.write_bytes(save({name: np.ascontiguousarray(t, np.float16) for name, t in arrays.items()}))
    print(f"done, {time.time() - began:.0f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="a few images; needs --out and --border")
    parser.add_argument("--border", default="border", help="folder of the border model to write into")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results of the folds")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--linear", type=Path, help="copy the border model without its correction into this folder")
    options = parser.parse_args()
    if options.linear:
        model = open_model(options.border)
        write_model(options.linear, model.description, model.split(PAIR_TENSORS)[0].tensors)
        parser.exit()
    if options.smoke and (options.out == RESULTS or options.border == "border"):
        parser.error("--smoke would overwrite the results: name other folders with --out and --border")
    main(options.border, options.out, options.smoke, options.workers)

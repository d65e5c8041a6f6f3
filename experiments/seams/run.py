"""How well does the tree with seams tell one object from two, in simulated and in real images?

    python experiments/seams/run.py --samples FOLDER      # training samples of the labelled real images
    python experiments/seams/run.py [--judge MODEL] [--priors .85:3.5,.5:1000]
        [--scenes s1,s2,s3] [--seeds 0-9] [--no-real] [--out FOLDER]
    python experiments/seams/run.py --smoke --out FOLDER

Real images are those in MSTFILTER_SHARED (default ../shared) under real/; without them, simulated ones alone.

The script compares the trees `border` and `seams` on label images: the first pauses of simulated scenes, and all
labelled pauses of HOTS and OSD. On real images the border model and the judge are those of a fold, so neither was
fitted to frames of that camera set-up (the border model, for OSD: of that group). With 30 exact draws for each image:

- `quality`: weighted coverage in the image, of the optimal cut and mean of the draws.
- `merged`: of pairs of true objects that touch in the image, the mean share of draws in which they have one segment.
- `split`: of true objects, the mean share of draws in which a second segment has a tenth of their pixels.
- `log_loss`: of the question whether two pixels of objects show one, as in ../real/scores.py.

scores.csv has a row for each image, tree and prior; summary.csv the means by family or data set.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mst_training.seam_data import SeamSamples
from mstfilter.base.errors import InputError
from mstfilter.base.files import write_csv
from mstfilter.lab.simulation import SCENE_FAMILIES, SimulatedScene
from mstfilter.mst.segmentation import BorderTree, ExactCuts, ObjectRule, SeamTree, TreeCutProposal, optimal_cut
from mstfilter.scene import Frame, VoxelGrid, scene_cache
from mstfilter.scoring import weighted_coverage
from mstfilter.scoring.forecasts import ForecastTable

REAL = Path(__file__).resolve().parent.parent / "real"
sys.path.append(str(REAL))
from folds import JUDGES, border_model  # noqa: E402
from scores import SOFTENING, PixelPairs  # noqa: E402
from sequences import SHARED, sequences  # noqa: E402

DRAWS, PIECE = 30, 0.1  # draws for each image; share of the pixels of a true object in a piece of it
Rows = list[dict[str, object]]


class Labelled(NamedTuple):
    """An image with the true object of each pixel; 0 is none, -1 is unknown."""

    group: str
    name: str
    frame: Frame
    grid: VoxelGrid
    labels: np.ndarray


def real_images() -> Iterator[Labelled]:
    """Every labelled pause of HOTS and OSD."""
    for sequence in sequences(SHARED):
        if sequence.source in ("hots", "osd"):
            for clip in sequence.recording.clips():
                labels = sequence.truth(clip.index).labels
                yield Labelled(sequence.source, sequence.name, clip.after, clip.grid, labels)


def simulated_images(families: list[str], seeds: range) -> Iterator[Labelled]:
    """The first pauses of scenes."""
    for name in families:
        for seed in seeds:
            try:
                scene = SimulatedScene(replace(SCENE_FAMILIES[name], n_actions=0), seed)
            except InputError as error:  # the objects do not fit
                print(name, seed, error, flush=True)
                continue
            seen = scene.frame_images(0)
            frame = Frame(seen["rgb"], seen["depth"], scene.camera)
            yield Labelled(name, f"{name} {seed}", frame, scene.grid, seen["instance"].astype(np.int64))


def write_samples(folder: Path) -> None:
    """A file of samples for each sequence."""
    found: dict[str, list[SeamSamples]] = {}
    for k, image in enumerate(real_images()):
        tree = BorderTree(weights=border_model(image.name))
        try:
            samples = SeamSamples.of_frame(image.frame, image.grid, image.labels, k, tree)
        except InputError as error:
            print(image.name, k, error, flush=True)
            continue
        found.setdefault(image.name, []).append(samples)
        scene_cache.clear()
    folder.mkdir(parents=True, exist_ok=True)
    for name, parts in found.items():
        SeamSamples.join(parts).save(folder / f"{name}.npz")
        print(name, sum(len(np.unique(part.region)) for part in parts), "regions", flush=True)


def scored(image: Labelled, proposal: TreeCutProposal) -> dict[str, float]:
    """The scores of a proposal in an image."""
    began = time.process_time()
    tree, w = proposal.tree_of(image.frame, image.grid)
    seconds = time.process_time() - began
    known = image.labels >= 0
    labels = np.where(known, image.labels, 0)
    cuts = [optimal_cut(tree, w), *ExactCuts().sample(np.random.default_rng(0), tree, w, DRAWS).cuts]
    images = [np.where(known, proposal.objects.label_image(tree, c, image.frame, image.grid), 0) for c in cuts]
    quality = [weighted_coverage(found, labels) for found in images]
    pairs = PixelPairs.of(labels)
    draws = np.stack([found.ravel() for found in images[1:]])
    main, split = {}, []
    for k, own in pairs.objects.items():
        counts = [np.bincount(row[own]) for row in draws]
        main[k] = np.array([int(n[1:].argmax()) + 1 if len(n) > 1 else 0 for n in counts])
        split.append(np.mean([(n[1:] > PIECE * len(own)).sum() > 1 for n in counts]))
    merged = [np.mean((main[a] == main[b]) & (main[a] > 0)) for a, b in pairs.touching]
    first, second = draws[:, pairs.a], draws[:, pairs.b]
    both = (first > 0) & (second > 0)
    asked = both.any(axis=0)
    forecast = ((first == second) & both).sum(axis=0)[asked] / both.sum(axis=0)[asked]
    same = pairs.same[asked]

    def loss(of: np.ndarray) -> float:
        return ForecastTable.of(forecast[of], same[of]).log_loss(SOFTENING) if of.any() else np.nan

    return {
        "objects": len(pairs.objects),
        "pairs": len(pairs.touching),
        "quality_optimal": quality[0],
        "quality": float(np.mean(quality[1:])),
        "merged": float(np.mean(merged)) if merged else np.nan,
        "split": float(np.mean(split)),
        "log_loss": loss(np.ones_like(same)),
        "log_loss_same": loss(same),
        "log_loss_different": loss(~same),
        "seconds": seconds,
    }


def main(options: argparse.Namespace) -> None:
    """Score the trees and write the tables."""
    priors = [tuple(float(n) for n in prior.split(":")) for prior in options.priors.split(",")]
    first, last = (int(n) for n in (options.seeds.split("-") * 2)[:2])
    rows: Rows = []
    simulated = simulated_images([n for n in options.scenes.split(",") if n], range(first, last + 1))
    real = () if options.no_real else islice(real_images(), 0, None, options.every)
    for image in chain(simulated, real):
        base = BorderTree(weights=border_model(image.name))
        trees: list[tuple[str, str, BorderTree | SeamTree]] = [] if options.no_base else [("border", "", base)]
        if options.judge:
            judge = JUDGES.get(image.group, options.judge)
            trees += [
                ("seams", f"{share}:{size}", SeamTree(base=base, weights=judge, one_share=share, prior_size=size))
                for share, size in priors
            ]
        for name, prior, tree in trees:
            found = scored(image, TreeCutProposal(tree=tree, objects=ObjectRule()))
            rounded = {key: round(value, 4) for key, value in found.items()}
            rows.append({"group": image.group, "image": image.name, "tree": name, "prior": prior} | rounded)
        scene_cache.clear()
    options.out.mkdir(parents=True, exist_ok=True)
    write_csv(options.out / "scores.csv", rows)
    summary = summaries(rows)
    write_csv(options.out / "summary.csv", summary)
    for row in summary:
        print(*row.values(), sep=", ")


def summaries(rows: Rows) -> Rows:
    """Means over the images of each group, and of each sequence of a real one."""
    found: Rows = []
    numbers = list(rows[0])[4:]
    keys = dict.fromkeys(
        (row["group"], name, row["tree"], row["prior"]) for row in rows for name in ("all", row["image"])
    )
    for group, name, tree, prior in keys:
        own = [
            row
            for row in rows
            if (row["group"], row["tree"], row["prior"]) == (group, tree, prior) and name in ("all", row["image"])
        ]
        if name == "all" or len(own) > 1:
            means = {n: round(float(np.nanmean([row[n] for row in own])), 4) for n in numbers}  # type: ignore[list-item]
            about = {"group": group, "image": name, "tree": tree, "prior": prior, "images": len(own)}
            found.append(about | means)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=Path, help="write training samples of the real images into this folder")
    parser.add_argument("--judge", default="seams", help="model of the judge for simulated images; empty for none")
    parser.add_argument("--priors", default="0.85:3.5", help="one_share:prior_size, separated by commas")
    parser.add_argument("--scenes", default="s1,s2,s3")
    parser.add_argument("--seeds", default="0-9")
    parser.add_argument("--no-real", action="store_true")
    parser.add_argument("--no-base", action="store_true")
    parser.add_argument("--every", type=int, default=1, help="use every so many of the real frames")
    parser.add_argument("--smoke", action="store_true", help="one scene, no real image; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    if chosen.smoke:
        if chosen.out == parser.get_default("out"):
            parser.error("--smoke would overwrite the results: name another folder with --out")
        chosen.scenes, chosen.seeds, chosen.no_real = "s1", "0", True
    if chosen.samples:
        write_samples(chosen.samples)
    else:
        main(chosen)

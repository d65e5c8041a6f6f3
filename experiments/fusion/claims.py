"""How often is a voxel right that only one parent claims?

    python experiments/fusion/claims.py [--smoke] [--out FOLDER]

On tuning scenes (seeds 0, 1 of s1, s2, s3) every pair of a sample and a moved hypothesis is compared with the true
volumes. A voxel is right if it belongs to the true object that contains most of the claiming object. Fractions are by
the claiming parent, by whether the last frame measures the voxel, and by the fraction of the predicted object that
free space has cleared. Writes results/claims.csv. `Claims` of the preset `mst_rules` is based on these fractions.

results/hidden.csv has the hidden voxels that only the prediction claims, in objects that free space hardly cleared:
by the overlap (IoU) of the predicted object with the object of the sample that overlaps it most, and by the
fraction of predictions that have the voxel occupied.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

import mstfilter
from mstfilter.crossover import Claims
from mstfilter.files import write_csv
from mstfilter.formats import open_recording
from mstfilter.simulation import cached_recording

CLEARED = (0.01, 0.03, 0.06, 1.0)
VOTES = (0.4, 0.8, 1.0)
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}


def count(found: dict[tuple[str, str, str], np.ndarray], clip, truth, sample, predicted, refined) -> None:
    """Add the voxels of one pair of parents."""
    near = Claims(surface="sample").exposed(clip)
    n_true = int(truth.max()) + 1
    before, after = predicted.volumes(), refined.volumes()
    for own, other, side in ((sample, refined, "sample"), (refined, sample, "prediction")):
        for label, volume in own.volumes().items():
            mine = own.labels == label
            if volume < 30:
                continue
            true = int(np.bincount(truth[mine], minlength=n_true)[1:].argmax()) + 1
            cleared = ""
            if side == "prediction":
                share = 1 - after[label] / before[label]
                cleared = f"<= {next(c for c in CLEARED if share <= c):g}"
            for where, place in (("surface", near), ("hidden", ~near)):
                for whose, rest in ((f"{side} alone", other.labels == 0), ("both", other.labels > 0)):
                    voxels = mine & place & rest
                    found[f"{side}: {whose}", where, cleared] += [voxels.sum(), (voxels & (truth == true)).sum()]


def count_hidden(
    found: dict[tuple[str, str, str], np.ndarray], family: str, clip, truth, sample, refined, doubtful, votes
) -> None:
    """Add the hidden voxels of a prediction that a sample has free; `votes` (X, Y, Z): fraction of predictions."""
    hidden = ~Claims(surface="sample").exposed(clip) & (sample.labels == 0)
    n_true, n_sample = int(truth.max()) + 1, int(sample.labels.max()) + 1
    sizes = np.bincount(sample.labels.ravel(), minlength=n_sample)
    if doubtful is not None:
        hidden &= ~doubtful
    for label, volume in refined.volumes().items():
        mine = refined.labels == label
        if volume < 30:
            continue
        true = int(np.bincount(truth[mine], minlength=n_true)[1:].argmax()) + 1
        common = np.bincount(sample.labels[mine], minlength=n_sample)
        iou = (common / (sizes + volume - common))[1:].max(initial=0)
        alike = "none" if iou == 0 else "<= 0.5" if iou <= 0.5 else "> 0.5"
        at = mine & hidden
        for low, high in zip((0.0, *VOTES[:-1]), VOTES, strict=True):
            voxels = at & (votes > low) & (votes <= high)
            found[family, alike, f"<= {high:g}"] += [voxels.sum(), (voxels & (truth == true)).sum()]


def write(path: Path, header: list[str], found: dict) -> None:
    """Write one row per class: number of voxels, and the fraction of right ones."""
    rows = []
    for key, (n, right) in sorted(found.items()):
        rows.append(
            {**dict(zip(header, key, strict=True)), "voxels": n, "share right": round(right / n, 3) if n else ""}
        )
        print(*(f"{k:24}" for k in key), f"{n:9d}  {right / max(n, 1):.3f}")
    write_csv(path, rows)


def main(out: Path, smoke: bool) -> None:
    """Count over all scenes and write both tables."""
    found: dict[tuple[str, str, str], np.ndarray] = defaultdict(lambda: np.zeros(2, np.int64))
    found_hidden: dict[tuple[str, str, str], np.ndarray] = defaultdict(lambda: np.zeros(2, np.int64))
    # What the parents claim without limits, along the path of the preset.
    rules = mstfilter.preset("mst_rules")
    for family in ("s1",) if smoke else ("s1", "s2", "s3"):
        for seed in (0,) if smoke else (0, 1):
            recording = open_recording(cached_recording(family, seed, **(SMALL if smoke else {})))
            state = rules.start(0)
            for clip in recording.clips():
                if clip.index:
                    before = replace(state.population, parents={"previous": np.arange(len(state.population))})
                    predicted = rules.transition.predict(np.random.default_rng(0), before, clip)
                    samples = rules.proposal.sample(np.random.default_rng(1), clip, 3)
                    truth = recording.truth(clip.index).astype(np.int64)
                    refined, _ = rules.update.free_space.refine(predicted.particles, clip)
                    votes = np.mean([h.labels > 0 for h in refined], axis=0).round(6)
                    for sample in samples.particles:
                        for h, r in list(zip(predicted.particles, refined, strict=True))[:3]:
                            count(found, clip, truth, sample, h, r)
                            doubtful = rules.update.claims.doubtful(h, r)
                            count_hidden(found_hidden, family, clip, truth, sample, r, doubtful, votes)
                state, _ = rules.step(state, clip)
    write(out / "claims.csv", ["claimed by", "where", "cleared"], found)
    write(out / "hidden.csv", ["family", "overlap", "predictions"], found_hidden)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    if arguments.smoke and arguments.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    main(arguments.out, arguments.smoke)

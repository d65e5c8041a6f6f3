"""Completion of single masks: all completers on the test samples that a training of a network set aside.

    python experiments/completion/compare.py TRAINED_FOLDER [--out experiments/completion/results] [--part validation]

No network was trained on the objects of these samples, and two of their kinds of shapes are not in the training data.
The table has the mean IoU by completer and group of samples, after voxels in free space are removed, at a threshold
of .5 and at the best one; and the mean log loss with forecasts of .01 to .99, over voxels on or behind the surface or
with a probability of .02 or more from some completer. For all samples together, the IoU has a 95 % interval over
scenes. `volume` is the median ratio of estimated to true volume.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from hilbert_map import HilbertMap

from mstfilter.base.files import write_csv
from mstfilter.base.resources import training_program
from mstfilter.mst.completion import Completer, Extrude, Hull, NetworkCompleter, Pooled, Posterior, SurfaceOnly
from mstfilter.scene import Seen
from mstfilter.scoring.statistics import interval

CLIPPED, ASKED = 0.01, 0.02  # as in meshes.py
THRESHOLDS = (0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6)
TRAINING = training_program("completion")
HELD_OUT = training_program("shapes").HELD_OUT
CompletionSamples = training_program("completion_data").CompletionSamples


def complete(completer: Completer, samples: CompletionSamples) -> np.ndarray:
    """Probabilities (n, 32, 32, 32) float16, 0 in free space."""
    found = np.zeros(samples.truth.shape, np.float16)
    rngs = [np.random.default_rng([0, k]) for k in range(len(samples))]
    for start in range(0, len(samples), 64):
        part = range(start, min(start + 64, len(samples)))
        boxes = [samples.box(k) for k in part]
        for k, box, p in zip(part, boxes, completer.fill_many([rngs[k] for k in part], boxes), strict=True):
            found[k] = np.where(box.free, 0, p)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trained", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--part", choices=("test", "validation"), default="test")
    parser.add_argument("--most", type=int, default=0, help="at most so many samples; 0 for all")
    chosen = parser.parse_args()
    samples = CompletionSamples.read(sorted((chosen.trained / "samples" / chosen.part).glob("*.npz")))
    samples = samples.take(np.arange(len(samples))[: chosen.most or None])
    completers = {
        "surface": SurfaceOnly(),
        "extrude": Extrude(),
        "hull": Hull(),
        "hilbert_map": HilbertMap(),
        "trained": NetworkCompleter(weights=str(chosen.trained)),
        "network": NetworkCompleter(),
        "prior": NetworkCompleter(weights="completion_prior"),
        "posterior": Posterior(),
        "pooled": Pooled(),
    }
    everything = np.ones(len(samples), bool)
    groups = {"all": everything}
    groups |= {name: samples.mask == k for k, name in enumerate(("whole masks", "parts", "several objects"))}
    groups |= {
        "visible over 90 %": samples.visible >= 0.9,
        "visible 50 - 90 %": (samples.visible >= 0.5) & (samples.visible < 0.9),
        "visible below 50 %": samples.visible < 0.5,
        "shapes not trained on": np.isin(samples.kind, HELD_OUT),
        "hollow shapes": np.isin(samples.kind, ("bowl", "mug", "tube")),
    }
    found, ms = {}, {}
    for name, completer in completers.items():
        began = time.process_time()
        found[name] = complete(completer, samples)
        ms[name] = 1000 * (time.process_time() - began) / len(samples)
    own, free = (Seen.SURFACE | Seen.BEHIND).among(samples.bits), Seen.FREE.among(samples.bits)
    asked = ~free & (own | np.any([p > ASKED for p in found.values()], axis=0))
    rows = []
    for name, p in found.items():
        at = {threshold: TRAINING.shape_iou(p >= threshold, samples.truth) for threshold in THRESHOLDS}
        q = np.clip(p.astype(np.float32), CLIPPED, 1 - CLIPPED)
        iou, loss = at[0.5], TRAINING.shape_log_loss(q, samples.truth, asked)
        best = max(THRESHOLDS, key=lambda threshold: at[threshold].mean())
        of_scene = np.array([iou[samples.scene == k].mean() for k in np.unique(samples.scene)])
        low, high = interval(of_scene)
        half = (high - low) / 2
        volume = (p >= 0.5).sum(axis=(1, 2, 3)) / np.maximum(samples.truth.sum(axis=(1, 2, 3)), 1)
        for group, of in groups.items():
            if of.any():
                row = {"completer": name, "group": group, "n": int(of.sum()), "iou": float(iou[of].mean())}
                row |= {
                    "threshold": best,
                    "iou_there": float(at[best][of].mean()),
                    "log_loss": float(loss[of].mean()),
                }
                rows.append(
                    {
                        **row,
                        "half_width": float(half) if group == "all" else None,
                        "volume": float(np.median(volume[of])),
                        "ms": ms[name],
                    }
                )
        text = f"IoU {iou.mean():.3f} +- {half:.3f}, {at[best].mean():.3f} at {best:g}; {loss.mean():.3f} nats"
        print(f"{name:20s} {text}  {ms[name]:.1f} ms", flush=True)
    write_csv(chosen.out / "completion.csv", rows, float_format=".4g")


if __name__ == "__main__":
    main()

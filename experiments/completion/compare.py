"""Completion of single masks: all completers on the test samples that a training of a network set aside.

    python experiments/completion/compare.py TRAINED_FOLDER [--out experiments/completion/results]

No network was trained on the objects of these samples, and two of their kinds of shapes are not in the training data.
The table has the mean IoU by completer and group of samples, after voxels in free space are removed. For all
samples together, the IoU has a 95 % interval over scenes. `volume` is the median ratio of estimated to true volume.
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
from mstfilter.scoring.statistics import interval

HELD_OUT = training_program("shapes").HELD_OUT
CompletionSamples = training_program("completion_data").CompletionSamples


def complete(completer: Completer, samples: CompletionSamples) -> np.ndarray:
    """Filled voxels (n, 32, 32, 32) bool, without voxels in free space."""
    filled = np.zeros(samples.truth.shape, bool)
    rngs = [np.random.default_rng([0, k]) for k in range(len(samples))]
    for start in range(0, len(samples), 64):
        part = range(start, min(start + 64, len(samples)))
        boxes = [samples.box(k) for k in part]
        for k, box, p in zip(part, boxes, completer.fill_many([rngs[k] for k in part], boxes), strict=True):
            filled[k] = (p >= 0.5) & ~box.free
    return filled


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trained", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--most", type=int, default=0, help="at most so many samples; 0 for all")
    chosen = parser.parse_args()
    samples = CompletionSamples.read(sorted((chosen.trained / "samples/test").glob("*.npz")))
    samples = samples.take(np.arange(len(samples))[: chosen.most or None])
    completers = {
        "surface": SurfaceOnly(),
        "extrude": Extrude(),
        "hull": Hull(),
        "hilbert_map": HilbertMap(),
        "network": (network := NetworkCompleter(weights=str(chosen.trained), log_odds=0.0)),
        "posterior": Posterior(),
        "pooled": Pooled(completers=(network, Posterior())),
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
    rows = []
    for name, completer in completers.items():
        began = time.process_time()
        filled = complete(completer, samples)
        seconds = (time.process_time() - began) / len(samples)
        axes = (1, 2, 3)
        both, either = (filled & samples.truth).sum(axis=axes), (filled | samples.truth).sum(axis=axes)
        iou = both / np.maximum(either, 1)
        of_scene = np.array([iou[samples.scene == k].mean() for k in np.unique(samples.scene)])
        low, high = interval(of_scene)
        half = (high - low) / 2
        volume = filled.sum(axis=axes) / np.maximum(samples.truth.sum(axis=axes), 1)
        for group, of in groups.items():
            if of.any():
                row = {"completer": name, "group": group, "n": int(of.sum()), "iou": float(iou[of].mean())}
                rows.append(
                    {
                        **row,
                        "half_width": float(half) if group == "all" else None,
                        "volume": float(np.median(volume[of])),
                        "ms": 1000 * seconds,
                    }
                )
        print(f"{name:20s} IoU {iou.mean():.3f} +- {half:.3f}  {1000 * seconds:.1f} ms", flush=True)
    write_csv(chosen.out / "completion.csv", rows, float_format=".4g")


if __name__ == "__main__":
    main()

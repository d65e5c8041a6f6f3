"""Does the completion network depend on the size of its crop?

    python experiments/completion/crop_sizes.py [--smoke] [--out FOLDER]

Visible objects of tuning scenes (`s1`, `s2`, `s3`, seeds 0-3, three pauses each), true masks, each completed in crops
of 32, 48 and 64 voxels at the same place. Writes crop_sizes.csv: means over objects of volume over true volume, IoU,
and log loss of the crop's voxels over the number of true voxels.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mstfilter.completion import NetworkCompleter
from mstfilter.completion.crops import EDGE, LARGER
from mstfilter.files import write_csv
from mstfilter.formats import open_recording
from mstfilter.scene import Recording, VoxelGrid
from mstfilter.simulation import cached_recording

SMALL = {"width": 160, "height": 120, "n_actions": 1, "voxel_size": 0.02}
LEAST = 300  # pixels of a visible object, of 640 x 480


@dataclass(frozen=True)
class OneCrop(NetworkCompleter):
    """The network with crops of one size."""

    edge: int = EDGE

    def box(self, voxels: np.ndarray, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
        low, high = np.percentile(voxels, (2, 98), axis=0)
        start = np.floor((low + high + 1) / 2).astype(np.int64) - self.edge // 2
        start[2] = 0
        return np.maximum(start, 0), np.minimum(start + self.edge, grid.shape)


def measured(recording: Recording, pause: int, edge: int) -> Iterator[tuple[float, float, float]]:
    """Volume over true volume, IoU and log loss of each visible object."""
    frame, grid, rng = recording.frames[recording.pauses[pause]], recording.grid, np.random.default_rng(0)
    image, truth = recording.instance(recording.pauses[pause]), recording.truth(pause)
    least = LEAST * image.size / 307200
    chosen = [k for k in np.unique(truth[truth > 0]).tolist() if (image == k).sum() > least]
    for k, one in zip(
        chosen, OneCrop(edge=edge).complete(rng, frame, [image == k for k in chosen], grid), strict=True
    ):
        p, true = np.zeros(grid.shape), truth == k
        p[one.box] = one.probability
        filled = p >= 0.5
        loss = -np.log(np.clip(np.where(true, p, 1 - p), 1e-4, 1)).sum() / true.sum()
        yield filled.sum() / true.sum(), (filled & true).sum() / (filled | true).sum(), float(loss)


def main() -> None:
    """Measure all objects in crops of each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="one small scene; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    if chosen.smoke and chosen.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    change, n = (SMALL, 1) if chosen.smoke else ({}, 4)
    scenes = [("s1", 0)] if chosen.smoke else [(family, seed) for family in ("s1", "s2", "s3") for seed in range(n)]
    recordings = [open_recording(cached_recording(family, seed, **change)) for family, seed in scenes]
    rows = []
    for edge in (EDGE, *LARGER):
        found = [
            m for one in recordings for pause in range(0, len(one.pauses), 2) for m in measured(one, pause, edge)
        ]
        means = dict(zip(("volume", "iou", "log_loss"), np.mean(found, axis=0).tolist(), strict=True))
        rows.append({"edge": edge, "n": len(found), **means})
    write_csv(chosen.out / "crop_sizes.csv", rows, float_format=".3f")
    print(*rows, sep="\n")


if __name__ == "__main__":
    main()

"""How much does a memory of free space know that the last image does not, and how much of it is wrong?

    python experiments/fusion/memory.py [--smoke] [--out FOLDER]

On tuning scenes (seeds 0 - 2 of s1, s2, s3), after every clip: voxels that are hidden now, those of them that a
memory without decay takes for free, and how many of these are truly occupied, by the reach within which what moved
takes memory away. Writes results/memory.csv. The default of `SceneMemory.reach` stands on it.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

from mstfilter.formats import open_recording
from mstfilter.fusion import FreeSpace, SceneMemory
from mstfilter.simulation import cached_recording

REACHES = (0.0, 0.03, 0.05, 0.1, 0.2)
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}


def main(out: Path, smoke: bool) -> None:
    """All scenes; one row a family and reach."""
    rows: dict[tuple[str, float], np.ndarray] = {}
    for family in ("s1",) if smoke else ("s1", "s2", "s3"):
        for seed in (0,) if smoke else (0, 1, 2):
            recording = open_recording(cached_recording(family, seed, **(SMALL if smoke else {})))
            for clip in recording.clips()[1:]:
                occupied = recording.truth(clip.index) > 0
                now = FreeSpace().known_free(clip.after, clip.grid)
                hidden = int(FreeSpace().hidden(clip.after, clip.grid).sum())
                for reach in REACHES:
                    remembered = FreeSpace(memory=SceneMemory(1.0, reach)).known_free_after(clip) & ~now
                    counts = np.array([1, hidden, remembered.sum(), (remembered & occupied).sum()])
                    rows[family, reach] = rows.get((family, reach), 0) + counts
    out.mkdir(parents=True, exist_ok=True)
    with (out / "memory.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["family", "reach_m", "clips", "hidden", "remembered", "truly_occupied"])
        for (family, reach), counts in sorted(rows.items()):
            writer.writerow([family, reach, *counts.tolist()])
            print(
                f"{family}, reach {reach:g} m: {counts[2]} of {counts[1]} hidden voxels remembered, {counts[3]} wrong"
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    if arguments.smoke and arguments.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    main(**vars(arguments))

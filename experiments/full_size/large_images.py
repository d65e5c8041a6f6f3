"""Quality and processor time of `mst` on images of 1440 x 1080 pixels, at full size and reduced to 410,000 pixels.

    python experiments/full_size/large_images.py            # 20 minutes of one core; prints a line per run
    python experiments/full_size/large_images.py --small    # one small scene: shows only that it works

The script filters two simulated scenes with three seeds of the filter.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import mstfilter
from mstfilter.lab.simulation import scene_family, simulate_recording
from mstfilter.scene import WORKING_PIXELS, Clip, Recording


def filtered(recording: Recording, seed: int, max_pixels: int) -> tuple[float, float]:
    """Mean quality over the pauses, and processor seconds of all steps together."""
    filter = mstfilter.preset("mst")
    state, quality, seconds = filter.start(seed), [], 0.0
    for clip in recording.clips():
        frames = [frame.resized(frame.camera.limited(max_pixels)) for frame in clip.frames]
        start = time.process_time()
        state, _ = filter.step(state, Clip(frames, clip.grid, clip.index, clip.times))
        seconds += time.process_time() - start
        truth = recording.truth(clip.index)
        quality.append(np.mean([mstfilter.weighted_coverage(h.labels, truth) for h in state.population.particles]))
    return float(np.mean(quality)), seconds


def main(small: bool) -> None:
    size = {"width": 200, "height": 150, "n_actions": 1} if small else {"width": 1440, "height": 1080, "n_actions": 3}
    for family in ("demo",) if small else ("s1", "s2"):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / family
            simulate_recording(replace(scene_family(family), **size), 44, path)
            recording = mstfilter.open_recording(path)
            for seed in range(1 if small else 3):
                full, reduced = (filtered(recording, seed, n) for n in (0, 20_000 if small else WORKING_PIXELS))
                print(
                    f"{family} seed {seed}: quality {full[0]:.3f} full, {reduced[0]:.3f} reduced; "
                    f"{full[1]:.0f} s full, {reduced[1]:.0f} s reduced",
                    flush=True,
                )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true")
    main(parser.parse_args().small)

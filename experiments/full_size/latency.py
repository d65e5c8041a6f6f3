"""Latency of `Stream` with `mst`: seconds from the last frame of a clip to the hypotheses, on all cores.

    python experiments/full_size/latency.py                      # three scenes, about three minutes
    python experiments/full_size/latency.py --smoke --out DIR    # a small scene: shows only that it works

Simulates one scene of each family at 640 x 480 pixels, and pushes the frames to a stream at 5 Hz. The end of each
clip is announced. Writes results/latency.csv. The latency contains the time for the work that is left when the last
frame arrives, so run the script on a machine without other work.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

import mstfilter
from mstfilter.base.files import write_csv
from mstfilter.lab.simulation import cached_recording
from mstfilter.scene import Recording

SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}
SEED = 41


def latencies(recording: Recording, period: float) -> list[float]:
    """Seconds from the last frame of each clip to its hypotheses; a frame is pushed every `period` seconds."""
    found: list[float] = []
    first = recording.frames[0]
    with mstfilter.Stream(
        first.camera, "mst", pauses=None, grid=recording.grid, on_pause=lambda p: found.append(p.latency_s)
    ) as stream:
        for i, f in enumerate(recording.frames):
            began = time.monotonic()
            pose = f.camera.T_world_camera
            stream.push(
                f.rgb, f.depth, float(recording.times[i]), pose, robot_mask=f.robot_mask, pause=i in recording.pauses
            )
            if i == recording.pauses[0]:
                stream.wait()  # the robot starts when the first result is there
            time.sleep(max(0.0, period - (time.monotonic() - began)))
        stream.wait()
    return found[1:]


def main(out: Path, smoke: bool) -> None:
    """Measure each family, print, write."""
    torch.set_num_threads(1)
    rows = []
    for family in ("demo",) if smoke else ("s1", "s2", "s3"):
        recording = mstfilter.open_recording(cached_recording(family, SEED, **(SMALL if smoke else {})))
        found = latencies(recording, 0.05 if smoke else 0.2)
        rows += [{"family": family, "pause": t, "latency_s": s} for t, s in enumerate(found, start=1)]
        print(
            f"{family}: {sum(found) / len(found):.2f} s after the last frame, largest {max(found):.2f} s", flush=True
        )
    out.mkdir(parents=True, exist_ok=True)
    write_csv(out / "latency.csv", rows, float_format=".2f")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent / "results")
    parser.add_argument("--smoke", action="store_true", help="a small scene; needs --out")
    arguments = parser.parse_args()
    if arguments.smoke and arguments.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    main(arguments.out, arguments.smoke)

"""Time of the renderer per frame, with and without reuse of unchanged parts; the images are compared.

    OMP_NUM_THREADS=1 python experiments/families/speed.py            # two minutes on one core
    python experiments/families/speed.py --smoke --out DIR            # some seconds

Both forms render the same states of the same scenes in turns, so that other programs on the machine affect both.
The ratio is more reliable than the seconds. Writes speed.csv.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from mstfilter.files import write_csv
from mstfilter.simulation import (
    POSE_TOLERANCE,
    DepthSensor,
    Renderer,
    SimulatedScene,
    advance_push,
    colour_reading,
    finish_push,
    scene_family,
)

HEADER = ("family", "seed", "frames", "kept_s", "full_s", "ratio", "sensor_s", "kept_cpu_s", "full_cpu_s")


def states(scene: SimulatedScene, actions: int) -> Iterator[None]:
    """Advance the world through the frames of a recording."""
    family = scene.family
    yield
    for action in range(actions):
        push = scene.choose_push(action)
        for step in range(1, family.frames_per_clip):
            advance_push(scene.world, push, (step - 1) / family.fps, step / family.fps)
            if step == family.frames_per_clip - 1:
                finish_push(scene.world)
            yield


def measure(name: str, seed: int, actions: int, small: dict[str, int]) -> list[str]:
    scene = SimulatedScene(replace(scene_family(name), **small), seed)
    arguments = (scene.world, scene.objects.skins, scene.room, scene.camera, scene.family.supersample, POSE_TOLERANCE)
    renderers = Renderer(*arguments), Renderer(*arguments)
    spent, cpu, sensor, frames = np.zeros(2), np.zeros(2), 0.0, 0
    for _ in states(scene, actions):
        renderers[1].forget()
        views = []
        for k, renderer in enumerate(renderers):
            wall, busy = time.perf_counter(), time.process_time()
            views.append(renderer.render())
            spent[k] += time.perf_counter() - wall
            cpu[k] += time.process_time() - busy
        for part in ("colour", "depth", "instance", "slant"):
            np.testing.assert_array_equal(*(getattr(view, part) for view in views))
        wall = time.perf_counter()
        colour_reading(np.random.default_rng(0), views[0].colour)
        DepthSensor().read(np.random.default_rng(0), views[0].depth, views[0].slant)
        sensor += time.perf_counter() - wall
        frames += 1
    ratio = cpu[1] / cpu[0]
    figures = (*spent / frames, ratio, sensor / frames, *cpu / frames)
    return [name, str(seed), str(frames), *(f"{x:.3f}" for x in figures)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent / "results")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    small = {"width": 160, "height": 120} if options.smoke else {}
    jobs = [("s1", 0)] if options.smoke else [("s1", 0), ("s2", 0), ("s3", 0), ("s3", 3)]
    rows = []
    for name, seed in jobs:
        rows.append(measure(name, seed, 1, small))
        print(*(f"{k} {v}" for k, v in zip(HEADER, rows[-1], strict=True)), flush=True)
    write_csv(options.out / "speed.csv", [dict(zip(HEADER, row, strict=True)) for row in rows])


if __name__ == "__main__":
    main()

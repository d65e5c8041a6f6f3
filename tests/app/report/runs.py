"""Small runs on an exact scene with components that need no image."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from mstfilter.runs import RunFolder
from mstfilter.scene import Camera, Hypothesis, Recording, VoxelGrid, look_at, render
from mstfilter.scoring import ask
from mstfilter.smc import Always, ParticleFilter, Population, Proposal, Transition, Update

GRID = VoxelGrid((-0.2, -0.2, 0.0), 0.02, (20, 20, 10))
CAMERA = Camera.from_intrinsics(90, 90, 47.5, 35.5, 96, 72, look_at((0.0, -0.6, 0.5), (0, 0, 0.03)))


def labels_of(*boxes: tuple[int, int, int]) -> np.ndarray:
    """Boxes 4 voxels wide and deep at (x, y) with a height, labelled 1, 2, ..."""
    labels = np.zeros(GRID.shape, np.uint16)
    for k, (x, y, z) in enumerate(boxes, 1):
        labels[x : x + 4, y : y + 4, :z] = k
    return labels


def truth_at(t: int) -> np.ndarray:
    return labels_of((3 + 2 * t, 8, 5), (12, 8, 3))


@dataclass(frozen=True)
class Boxes(Proposal):
    """Draws the true boxes, or the two as one, or nothing at all."""

    empty: bool = False
    properly_weighted: ClassVar[bool] = False

    def sample(self, rng, observation, n):
        truth = truth_at(observation.index)
        kinds = [np.zeros_like(truth)] if self.empty else [truth, (truth > 0).astype(np.uint16), truth * (truth == 1)]
        hypotheses = [Hypothesis.from_labels(k, observation.grid, observation.index) for k in kinds]
        chosen = rng.integers(0, len(kinds), n)
        notes = {"kinds": chosen.tolist(), "sampler": {"acceptance": 0.25, "<b>odd & named</b>": "x</script>"}}
        return Population(tuple(hypotheses[i] for i in chosen), np.log(1.0 + np.arange(n)), notes=notes)


@dataclass(frozen=True)
class Stay(Transition):
    def predict(self, rng, population, observation):
        notes = {"motions": {"static": 3, "icp": 1}, "free text": "nothing moved"}
        return replace(population, notes=notes)


@dataclass(frozen=True)
class Either(Update):
    """Predicted and proposed particles side by side."""

    properly_weighted: ClassVar[bool] = False

    def update(self, rng, predicted, proposed, observation):
        if predicted is None:
            return proposed
        none_a, none_b = np.full(len(predicted), -1), np.full(len(proposed), -1)
        parents = {
            "previous": np.concatenate([predicted.parents["previous"], none_b]),
            "proposed": np.concatenate([none_a, proposed.parents["proposed"]]),
        }
        weights = np.concatenate([predicted.log_weights, proposed.log_weights])
        particles = (*predicted.particles, *proposed.particles)
        return Population(particles, weights, parents, {"quality": [0.9] * len(predicted)})


def recording(pauses: int = 3, truth: bool = True) -> Recording:
    rgb, depth = [], []
    for t in range(pauses):
        seen = render(truth_at(t), GRID, CAMERA)
        rays = CAMERA.rays() @ CAMERA.pose.rotation.as_matrix().T
        table = -CAMERA.position[2] / np.minimum(rays[..., 2], -1e-6)
        depth.append(np.where(seen.labels > 0, seen.depth, table).astype(np.float32))
        colours = np.array([[150, 130, 110], [190, 60, 50], [50, 90, 180]], np.uint8)
        rgb.append(colours[seen.labels])
    arrays = Recording.from_arrays(
        np.stack(rgb),
        np.stack(depth),
        CAMERA.K,
        pauses=range(pauses),
        T_world_camera=CAMERA.pose,
        grid=GRID,
        name="two boxes",
    )
    return replace(arrays, truth=truth_at) if truth else arrays


def make_run(
    path: Path,
    pauses: int = 3,
    truth: bool = True,
    empty: bool = False,
    done: bool = True,
    film: Recording | None = None,
) -> RunFolder:
    """A run folder of three hypotheses a pause."""
    filter = ParticleFilter(
        proposal=Boxes(empty), transition=Stay(), update=Either(), trigger=Always(), n=3, resample="after"
    )
    film = film or recording(pauses, truth)
    description = {
        "seed": 7,
        "description": "boxes & tests",
        "config": {"n": 3, "transition": {"component": "./own.py:Stay"}, "proposal": {"component": "boxes"}},
        "recording": {
            "name": film.name,
            "key": "00",
            "pauses": list(film.pauses),
            "times": list(film.times),
            "generator": None,
        },
        "uses_truth": [],
        "files": {},
        "versions": {"mstfilter": "0", "numpy": np.__version__},
        "machine": {"cpu": "any", "threads": 1},
    }
    run = RunFolder.create(path, description)
    state = filter.start(7)
    for clip in film.clips():
        state, info = filter.step(state, clip)
        volume = film.truth(clip.index)
        questions = None if volume is None else ask(film, clip.index)
        run.write_pause(clip, state, info, volume, questions, film.instance(film.pauses[clip.index]))
        (run.pause(clip.index) / "seconds.json").write_text(json.dumps({"transition": 0.5, "proposal": 1.5}))
    if done:
        run.write_metrics()
        run.set_status("done")
    return RunFolder.open(path)

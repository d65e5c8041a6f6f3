"""Measure the time of every belief query at 100 x 100 x 50 voxels; see README.md."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from mstfilter.belief import Belief
from mstfilter.files import write_csv
from mstfilter.scene import Camera, Hypothesis, VoxelGrid, look_at, scene_cache
from mstfilter.smc import Population

GRID = VoxelGrid((-0.5, -0.5, 0.0), 0.01, (100, 100, 50))
CAMERA = Camera.from_intrinsics(525, 525, 319.5, 239.5, 640, 480, look_at((0.0, -0.9, 0.8), (0, 0, 0.05)))


def boxes(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 2, 3) lower and upper corners of boxes on the table; where two overlap, the later one is kept."""
    size = rng.integers(6, 16, (n, 3))
    lower = np.stack([rng.integers(5, 80, n), rng.integers(5, 80, n), np.zeros(n, int)], axis=1)
    return np.stack([lower, lower + size], axis=1)


def hypothesis(rng: np.random.Generator, scene: np.ndarray, rough: bool) -> Hypothesis:
    """A variation of the scene: objects are missing (5 %), moved by a voxel (30 %), cut (20 %), joined (10 %).

    `rough` removes a fifth of the voxels that are adjacent to free space or another object.
    """
    labels, label = np.zeros(GRID.shape, np.uint16), 0
    for lower, upper in scene:
        if rng.random() < 0.05:
            continue
        shift = rng.integers(-1, 2, 3) * (rng.random() < 0.3) * [1, 1, 0]
        (a, b, c), (x, y, z) = lower + shift, upper + shift
        label = label + 1 if label == 0 or rng.random() > 0.1 else int(rng.integers(1, label + 1))
        labels[a:x, b:y, c:z] = label
        if rng.random() < 0.2:
            label += 1
            labels[a : int(rng.integers(a + 1, x)), b:y, c:z] = label
    if rough:
        surface = np.zeros(GRID.shape, bool)
        for axis in range(3):
            surface |= (labels != np.roll(labels, 1, axis)) | (labels != np.roll(labels, -1, axis))
        labels[surface & (rng.random(GRID.shape) < 0.2)] = 0
    return Hypothesis.from_labels(labels, GRID)


def queries(belief: Belief) -> dict:
    """The queries by name."""
    region = belief.box((-0.2, -0.2, 0.0), (0.2, 0.2, 0.2))
    voxel = np.unravel_index(int(belief.hypotheses[0].labels.argmax()), GRID.shape)
    pairs = np.random.default_rng(1).integers(0, 50, (2, 1000, 3))
    return {
        "occupancy": belief.occupancy,
        "occupancy_entropy": belief.occupancy_entropy,
        "same_object, 1000 pairs": lambda: belief.same_object(pairs[0], pairs[1]),
        "object_at": lambda: belief.object_at(voxel),
        "object_count": belief.object_count,
        "boundary_entropy": belief.boundary_entropy,
        "partition_entropy": belief.partition_entropy,
        "partition_entropy, tolerance": lambda: belief.partition_entropy(tolerance=50),
        "look_information, 40 x 40 x 20": lambda: belief.look_information(region),
        "look_information, 40 x 40 x 20, tolerance": lambda: belief.look_information(region, 50),
        "push_information": lambda: belief.push_information(voxel),
        "push_information, tolerance": lambda: belief.push_information(voxel, 50),
        "push_map": belief.push_map,
        "push_map, tolerance": lambda: belief.push_map(50),
        "rendering 640 x 480": lambda: belief._images(CAMERA),
        "object_at_pixel, rendered": lambda: belief.object_at_pixel(CAMERA, (320, 240)),
        "view_information, rendered": lambda: belief.view_information(CAMERA),
        "view_information, rendered, tolerance": lambda: belief.view_information(CAMERA, 200),
        "view_information, objects, rendered, tolerance": lambda: belief.view_information(CAMERA, 200, "objects"),
    }


def main() -> None:
    """Measure all queries; the shortest repetition is kept."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "speed.csv")
    parser.add_argument("--n", type=int, nargs="+", default=[5, 20, 100])
    parser.add_argument("--repeat", type=int, default=1)
    arguments = parser.parse_args()
    rows: dict[str, dict[str, float]] = {}
    cases = [(n, rough) for rough in (False, True) for n in arguments.n]
    names = [f"n={n}{' rough' * rough}" for n, rough in cases]
    for case, (n, rough) in zip(names, cases, strict=True):
        rng = np.random.default_rng(0)
        scene = boxes(rng, 20)
        population = Population(tuple(hypothesis(rng, scene, rough) for _ in range(n)), rng.normal(size=n))
        for _ in range(arguments.repeat):
            scene_cache.clear()
            belief = Belief(population)
            for h in population.particles:
                h.__dict__.pop("key", None)
            start = time.process_time()
            cells = len(belief._refined.sizes)
            done = {"first query (cells)": time.process_time() - start}
            for name, query in queries(belief).items():
                start = time.process_time()
                query()
                done[name] = time.process_time() - start
            for name, seconds in done.items():
                row = rows.setdefault(name, {})
                row[case] = min(seconds, row.get(case, np.inf))
        occupied = int((belief.occupancy() > 0).sum())
        print(f"{case}: {cells} cells in {occupied} voxels that any hypothesis fills, "
              f"{belief.mean_object_count():.1f} objects, entropy {belief.partition_entropy():.2f} nats")  # fmt: skip
    table = [{"seconds of processor time": name} | {c: f"{row[c]:.4f}" for c in names} for name, row in rows.items()]
    write_csv(arguments.out, table)
    for line in table:
        print(*line.values(), sep="  ")


if __name__ == "__main__":
    main()

"""Errors of motions in millimetres: each clip is predicted from the true labels of the previous pause.

python experiments/tracking/run.py RECORDING...               # folders of `mstfilter simulate`
python experiments/tracking/run.py --smoke --out DIR          # one small scene: shows only that it works
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass, field, fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from mstfilter import open_recording
from mstfilter.base.files import write_csv
from mstfilter.lab.simulation import SceneFamily, scene_family, simulate_recording
from mstfilter.lab.simulation.arrangement import draw_objects
from mstfilter.lab.simulation.recorder import stream
from mstfilter.lab.simulation.shapes import Shape
from mstfilter.mst.tracking import Candidate, MotionRule, MstRule, TrackingTransition
from mstfilter.mst.tracking.segments import Track, segments_of
from mstfilter.scene import Hypothesis
from mstfilter.smc import Population

HERE = Path(__file__).resolve().parent
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}
TURNED = {"ball", "bottle", "bowl", "can"}  # solids of revolution: the rotation about their axis is free
FEW, NEAR, WRONG = 300, 10.0, 20.0  # pixels, mm, mm
FAST = 25.0  # degrees from one frame to the next


@dataclass(frozen=True)
class Kept(MotionRule):
    """Wraps a rule, and keeps the candidates of every segment in `found`."""

    rule: MotionRule = field(default_factory=MstRule)
    found: dict = field(default_factory=dict)

    def candidates(self, rng: np.random.Generator, track: Track) -> tuple[Candidate, ...]:
        self.found[track.segment.key] = self.rule.candidates(rng, track)
        return self.found[track.segment.key]

    def choose(self, rng: np.random.Generator, candidates: tuple[Candidate, ...]) -> Candidate:
        return self.rule.choose(rng, candidates)


def surface_points(shape: Shape) -> np.ndarray:
    """Surface points (N, 3) in the body's frame: the cells of a 4 mm grid inside with a neighbour outside."""
    axes = [np.arange(-h - 0.006, h + 0.008, 0.004) for h in shape.half]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = shape.inside(cells.reshape(-1, 3)).reshape(cells.shape[:3])
    deep = inside.copy()
    for axis in range(3):
        deep &= np.roll(inside, 1, axis) & np.roll(inside, -1, axis)
    return cells[inside & ~deep]


def error_mm(shape: Shape, points: np.ndarray, pose: np.ndarray, after: np.ndarray, T: np.ndarray) -> float:
    """Mean distance of surface points under T from the true points, or the nearest ones on solids of revolution."""
    off = np.linalg.inv(after) @ T @ pose
    moved = points @ off[:3, :3].T + off[:3, 3]
    if shape.family in TURNED and not np.allclose(off, np.eye(4), atol=1e-4):
        return round(1000 * float(cKDTree(points).query(moved)[0].mean()), 2)
    return round(1000 * float(np.linalg.norm(moved - points, axis=1).mean()), 2)


def turned(T: np.ndarray) -> float:
    """The angle of rotation of a motion (4, 4), in degrees."""
    return round(float(np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))), 1)


def measure(path: Path, transition: TrackingTransition) -> list[dict]:
    """One row for each object and clip of a simulated recording."""
    recording, manifest = open_recording(path), json.loads((path / "manifest.json").read_text())
    family = SceneFamily(
        **{f.name: manifest["family"][f.name] for f in fields(SceneFamily) if f.name in manifest["family"]}
    )
    seed = manifest["seed"]
    shapes = draw_objects(stream(seed, "things"), family, family.pool(seed)).shapes
    surfaces = [surface_points(shape) for shape in shapes]
    rows = []
    for t, clip in enumerate(recording.clips()[1:], start=1):
        first, last = recording.pauses[t - 1], recording.pauses[t]
        before, after = recording.poses(first), recording.poses(last)
        seen = [np.bincount(recording.instance(k).ravel(), minlength=256) for k in (first, last)]
        hypothesis = Hypothesis.from_labels(recording.truth(t - 1), clip.grid)
        rule = Kept(transition.rule)
        began = time.process_time()
        population = Population((hypothesis,), np.zeros(1))
        moved = replace(transition, rule=rule).predict(np.random.default_rng(seed), population, clip).particles[0]
        seconds = time.process_time() - began
        segments = segments_of(hypothesis, clip.before)
        chosen = {record.label: record.motion.as_matrix() for record in moved.objects}
        for k in set(hypothesis.volumes()) & set(chosen):
            T_true = after[k] @ np.linalg.inv(before[k])
            candidates = rule.found.get(segments[k].key, ()) if k in segments else ()

            measured = partial(error_mm, shapes[k - 1], surfaces[k - 1], before[k], after[k])
            poses = [recording.poses(frame)[k] for frame in range(first, last + 1)]
            steps = [turned(b @ np.linalg.inv(a)) for a, b in pairwise(poses)]
            rows.append(
                {
                    "recording": path.name,
                    "pause": t,
                    "object": k,
                    "shape": shapes[k - 1].name,
                    "turned": turned(T_true),
                    "turned_in_a_frame": max(steps),
                    "moved": measured(np.eye(4)),
                    "pixels": int(min(seen[0][k], seen[1][k])),
                    "error": measured(chosen[k]),
                    "candidates": [(c.kind, round(c.score, 3), measured(c.T.as_matrix())) for c in candidates],
                    "seconds": round(seconds, 2),
                }
            )
    return rows


def group(row: dict) -> str:
    """The class of an object in a clip."""
    if row["moved"] < 1.0:
        return "still"
    if row["pixels"] < FEW:
        return "hidden" if row["pixels"] == 0 else "few pixels"
    return "turned < 20" if row["turned"] < 20 else "turned 20 - 60" if row["turned"] < 60 else "turned > 60"


def table(rows: list[dict]) -> list[dict]:
    """By class: numbers of objects within 10 mm of the truth, and of objects that turn fast between frames."""
    out = []
    for name in ("still", "turned < 20", "turned 20 - 60", "turned > 60", "few pixels", "hidden"):
        chosen = [row for row in rows if group(row) == name]
        errors = np.array([row["error"] for row in chosen])
        if len(errors):
            best = [min([row["error"], *(c[2] for c in row["candidates"])]) for row in chosen]
            out.append(
                {
                    "class": name,
                    "n": len(errors),
                    "within_10_mm": int((errors <= NEAR).sum()),
                    "candidate_within_10_mm": int((np.array(best) <= NEAR).sum()),
                    "wrong_by_20_mm": int((errors > WRONG).sum()),
                    "median_mm": f"{np.median(errors):.1f}",
                    "median_degrees_in_a_frame": f"{np.median([r['turned_in_a_frame'] for r in chosen]):.0f}",
                    "above_25_degrees_in_a_frame": sum(r["turned_in_a_frame"] > FAST for r in chosen),
                    "of_these_within_10_mm": sum(
                        r["turned_in_a_frame"] > FAST and r["error"] <= NEAR for r in chosen
                    ),
                }
            )
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--smoke", action="store_true", help="one small scene; needs --out")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    parser.add_argument("--objects", type=Path, help="write a line of JSON for each object and clip")
    options = parser.parse_args()
    if options.smoke and options.out == HERE / "results":
        parser.error("--smoke would overwrite the results: name another folder with --out")
    rows: list[dict] = []
    with tempfile.TemporaryDirectory() as folder:
        if options.smoke:
            options.recordings = [Path(folder) / "recording"]
            simulate_recording(replace(scene_family("demo"), **SMALL), seed=0, path=options.recordings[0])
        for path in options.recordings:
            rows.extend(measure(path, TrackingTransition()))
            print(path.name, len(rows), rows[-1]["seconds"], flush=True)
            if options.objects:
                options.objects.write_text("".join(json.dumps(row) + "\n" for row in rows))
    options.out.mkdir(parents=True, exist_ok=True)
    write_csv(options.out / "results.csv", table(rows))
    print((options.out / "results.csv").read_text())

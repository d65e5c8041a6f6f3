"""Controls: what must hold of a filter that gains by what it has seen, and by nothing else.

    python experiments/controls/run.py [--smoke] [--out FOLDER]

On tuning scenes, primary endpoint (objects quality against the true volumes, mean over pauses t >= 1):

- start: at t = 0 `mst` and samples of the latest image alone hold the same hypotheses;
- still: after each pause a clip of two frames in which no object moves (new sensor noise, the arm perhaps in view)
  must not lower quality;
- shuffled: with the inner frames of every clip in random order the gain over samples must shrink;
- stranger: with the hypotheses of another scene as its past, a step must lose the gain.

Writes results/scenes.csv, a line a scene, and results/summary.csv. Resumable: a scene that is there is not run again.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import mstfilter
from mstfilter.scene.clip import Clip
from mstfilter.scene.quality import weighted_coverage
from mstfilter.scene.recording import Recording
from mstfilter.simulation.cache import cached_recording
from mstfilter.smc.particle_filter import State
from mstfilter.study.results import write_table
from mstfilter.study.statistics import interval

SCENES = [(family, k) for family in ("s1", "s2") for k in range(6)]
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}
STILL = 0.0005  # metres
FIELDS = ["scene", "mst", "samples", "start", "still", "shuffled", "stranger"]


def quality(state: State, truth: np.ndarray) -> float:
    """Unweighted mean over the hypotheses."""
    return float(np.mean([weighted_coverage(h.labels, truth) for h in state.population.particles]))


def at_rest(recording: Recording, pause: int) -> int | None:
    """The next frame, or else the one before, if no object moves between it and the frame of a pause."""
    here = recording.poses(pause)
    for frame in (pause + 1, pause - 1):
        there = recording.poses(frame) if 0 <= frame < len(recording.frames) else None
        if here and there and all(np.linalg.norm(here[k][:3, 3] - there[k][:3, 3]) < STILL for k in here):
            return frame
    return None


def shuffled(clip: Clip, rng: np.random.Generator) -> Clip:
    """The clip with its inner frames in random order."""
    frames = list(clip.frames)
    inner = frames[1:-1]
    frames[1:-1] = [inner[k] for k in rng.permutation(len(inner))]
    return replace(clip, frames=tuple(frames))


def run(scene: tuple[str, int], stranger: Recording, recording: Recording) -> dict[str, object]:
    """Means over the pauses of a scene."""
    mst, samples = mstfilter.preset("mst"), mstfilter.preset("samples_only")
    rng = np.random.default_rng(scene[1])
    found: dict[str, list[float]] = {name: [] for name in FIELDS[1:]}
    state, alone, mixed, foreign = (f.start(0) for f in (mst, samples, mst, mst))
    for clip, other in zip(recording.clips(), stranger.clips(), strict=False):
        truth = recording.truth(clip.index)
        assert truth is not None
        past, (foreign, _) = foreign, mst.step(foreign, other)
        state, _ = mst.step(state, clip)
        alone, _ = samples.step(alone, clip)
        mixed, _ = mst.step(mixed, shuffled(clip, rng))
        if clip.index == 0:
            same = [
                a.key == b.key for a, b in zip(state.population.particles, alone.population.particles, strict=True)
            ]
            found["start"].append(float(all(same)))
            continue
        lost, _ = mst.step(past, clip)  # another scene's population at the pause before
        found["mst"].append(quality(state, truth))
        found["samples"].append(quality(alone, truth))
        found["shuffled"].append(quality(mixed, truth))
        found["stranger"].append(quality(lost, truth))
        beside = at_rest(recording, recording.pauses[clip.index])
        if beside is not None:
            frames = (clip.after, recording.frames[beside])
            again, _ = mst.step(state, Clip(frames, clip.grid, clip.index + 1))
            found["still"].append(quality(again, truth) - found["mst"][-1])
    means = {name: round(float(np.mean(v)), 4) if v else "" for name, v in found.items()}
    return {"scene": f"{scene[0]}-{scene[1]}", **means}


def summary(rows: list[dict[str, str]]) -> Iterator[dict[str, object]]:
    """Means over scenes with 95 % t intervals."""
    column = {name: np.array([float(r[name]) if r[name] != "" else np.nan for r in rows]) for name in FIELDS[1:]}
    for what, values in {
        "same hypotheses at the start": column["start"],
        "mst - samples": column["mst"] - column["samples"],
        "shuffled - samples": column["shuffled"] - column["samples"],
        "mst - shuffled": column["mst"] - column["shuffled"],
        "stranger - samples": column["stranger"] - column["samples"],
        "mst - stranger": column["mst"] - column["stranger"],
        "a still clip": column["still"],
    }.items():
        values = values[np.isfinite(values)]
        low, high = interval(values)
        yield {
            "what": what,
            "n": len(values),
            "mean": f"{values.mean():.4f}",
            "low": f"{low:.4f}",
            "high": f"{high:.4f}",
        }


def main() -> None:
    """Run what is missing, then summarise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="two small scenes; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "scenes.csv"
    rows = list(csv.DictReader(path.open(newline=""))) if path.exists() else []
    scenes = SCENES[:2] if options.smoke else SCENES
    for k, scene in enumerate(scenes):
        if f"{scene[0]}-{scene[1]}" in {r["scene"] for r in rows}:
            continue
        # A scene of the same family lends its past.
        family = [s for s in scenes if s[0] == scene[0]]
        other = family[(family.index(scene) + 1) % len(family)]
        change = SMALL if options.smoke else {}
        here, there = (Recording.open(cached_recording(f, s, **change)) for f, s in (scene, other))
        row = run(scene, there, here)
        rows.append({name: str(value) for name, value in row.items()})
        write_table(path, FIELDS, rows)
        print(k, row, flush=True)
    found = list(summary(rows))
    write_table(options.out / "summary.csv", list(found[0]), found)
    print(*found, sep="\n")


if __name__ == "__main__":
    main()

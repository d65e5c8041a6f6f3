"""Which part of the clips does the filter use?

    python experiments/controls/run.py [--smoke] [--out FOLDER]

The scenes are tuning scenes. The score is the objects quality against the true volumes, mean over pauses t >= 1.

- still: A clip of two frames in which no object moves is added after each pause (new sensor noise, the robot arm
  perhaps in view). The clip must not lower the quality.
- shuffled: If the inner frames of every clip are in random order, the gain over samples must be smaller. `ends` uses
  only the first and last frame of a clip, and `frozen` never finds a motion. `flow` finds motions only by optical
  flow. The columns `moved: ...` show tracking without segmentation. The true labels of the previous pause are tracked
  over one clip. The value is the mean IoU of the objects that moved.
- start: At t = 0, `mst` and samples of the latest image must have the same quality.

Samples are `samples_only` with as many samples as `mst` has.

Writes results/scenes.csv, one row per scene, and results/summary.csv. Finished scenes are not run again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import mstfilter
from mstfilter.base.files import read_csv, write_csv
from mstfilter.formats import open_recording
from mstfilter.lab.simulation import cached_recording
from mstfilter.scene import Clip, Hypothesis, Recording
from mstfilter.scoring import overlap, weighted_coverage
from mstfilter.scoring.statistics import interval
from mstfilter.smc import Population, State, Transition

SCENES = [(family, k) for family in ("s1", "s2") for k in range(6)]
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}
STILL = 0.0005  # metres
MOVED = 0.9  # an object whose own IoU before and after lies below has moved
FILTERS = {
    "mst": [],
    "flow": [f"transition.rule.{v}" for v in ("use_icp=false", "use_sift=false", "n_refine=0", "search_above=-1")],
    "frozen": ["transition=identity"],
}
ORDERS = ("in order", "shuffled", "ends")
CHAINS = [(name, order) for name in ("mst", "flow") for order in ORDERS] + [("frozen", "in order")]
FIELDS = [
    *("scene", "start", "still", "samples"),
    *(f"{name} {order}" for name, order in CHAINS),
    *(f"moved: {name} {order}" for name, order in CHAINS),
]


def quality(state: State, truth: np.ndarray) -> float:
    """Mean quality of the hypotheses, without weights."""
    return float(np.mean([weighted_coverage(h.labels, truth) for h in state.population.particles]))


def at_rest(recording: Recording, pause: int) -> int | None:
    """Index of a frame next to a pause (after or before) between which and the pause no object moves, or None."""
    here = recording.poses(pause)
    for frame in (pause + 1, pause - 1):
        there = recording.poses(frame) if 0 <= frame < len(recording.frames) else None
        if here and there and all(np.linalg.norm(here[k][:3, 3] - there[k][:3, 3]) < STILL for k in here):
            return frame
    return None


def in_orders(clip: Clip, rng: np.random.Generator) -> dict[str, Clip]:
    """The clip, the clip with its inner frames in random order, and the clip without them."""
    if len(clip) == 1:
        return dict.fromkeys(ORDERS, clip)
    first, *inner, last = clip.frames
    shuffled = (first, *(inner[k] for k in rng.permutation(len(inner))), last)
    return {
        "in order": clip,
        "shuffled": replace(clip, frames=shuffled, times=()),
        "ends": replace(clip, frames=(first, last), times=()),
    }


def ious(a: np.ndarray, b: np.ndarray) -> dict[int, float]:
    """IoU of the objects that both label images have, by label."""
    table = overlap(a, b)
    labels, i, j = np.intersect1d(table.labels_a, table.labels_b, return_indices=True)
    found = zip(labels.tolist(), table.jaccard()[i, j].tolist(), strict=True)
    return {k: value for k, value in found if k > 0}


def tracked(transition: Transition, labels: np.ndarray, truth: np.ndarray, clip: Clip) -> list[float]:
    """IoU of the objects that moved, tracked from their true labels."""
    start = Population((Hypothesis.from_labels(labels, clip.grid),), np.zeros(1))
    end = ious(transition.predict(np.random.default_rng(0), start, clip).particles[0].labels, truth)
    return [end.get(k, 0.0) for k, own in ious(labels, truth).items() if own < MOVED]


def run(scene: tuple[str, int], recording: Recording) -> dict[str, object]:
    """Scores of a scene, averaged over its pauses."""
    filters = {name: mstfilter.preset("mst", *changes) for name, changes in FILTERS.items()}
    mst = filters["mst"]
    samples = mstfilter.preset("samples_only", f"n_proposed={mst.n_proposed}")
    rng = np.random.default_rng(scene[1])
    found: dict[str, list[float]] = {name: [] for name in FIELDS[1:]}
    states = {chain: filters[chain[0]].start(0) for chain in CHAINS}
    alone, before = samples.start(0), None
    for clip in recording.clips():
        truth = recording.truth(clip.index)
        assert truth is not None
        clips = in_orders(clip, rng)
        alone, _ = samples.step(alone, clip)
        for name, order in CHAINS:
            states[name, order], _ = filters[name].step(states[name, order], clips[order])
        state = states["mst", "in order"]
        if before is None:
            found["start"].append(quality(state, truth) - quality(alone, truth))
        else:
            found["samples"].append(quality(alone, truth))
            for name, order in CHAINS:
                found[f"{name} {order}"].append(quality(states[name, order], truth))
                found[f"moved: {name} {order}"] += tracked(filters[name].transition, before, truth, clips[order])
            beside = at_rest(recording, recording.pauses[clip.index])
            if beside is not None:
                frames = (clip.after, recording.frames[beside])
                rested, _ = mst.step(state, Clip(frames, clip.grid, clip.index + 1))
                found["still"].append(quality(rested, truth) - quality(state, truth))
        before = truth
    means = {name: round(float(np.mean(v)), 4) if v else "" for name, v in found.items()}
    return {"scene": f"{scene[0]}-{scene[1]}", **means}


def summary(rows: list[dict[str, str]]) -> Iterator[dict[str, object]]:
    """Means over scenes with 95 % intervals."""
    column = {name: np.array([float(r[name]) if r[name] != "" else np.nan for r in rows]) for name in FIELDS[1:]}

    def minus(a: str, b: str) -> tuple[str, np.ndarray]:
        return f"{a} - {b}", column[a] - column[b]

    for what, values in (
        ("mst in order - samples at the start", column["start"]),
        ("a still clip", column["still"]),
        minus("mst in order", "samples"),
        minus("frozen in order", "samples"),
        minus("mst in order", "frozen in order"),
        *(minus(f"{f} {o}", "samples") for f, o in (("mst", "shuffled"), ("flow", "in order"), ("flow", "shuffled"))),
        *(
            minus(f"{m}{f} {a}", f"{m}{f} {b}")
            for m in ("", "moved: ")
            for f in ("mst", "flow")
            for a, b in (ORDERS[:2], ORDERS[::2], ORDERS[1:])
        ),
        *((name, column[name]) for name in FIELDS if name.startswith("moved: ")),
    ):
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
    """Run the missing scenes, then summarise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="two small scenes; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "scenes.csv"
    rows = read_csv(path) if path.exists() else []
    rows = [row for row in rows if list(row) == FIELDS]  # other rows come from an earlier version
    scenes = SCENES[:2] if options.smoke else SCENES
    for k, scene in enumerate(scenes):
        if f"{scene[0]}-{scene[1]}" in {r["scene"] for r in rows}:
            continue
        recording = open_recording(cached_recording(*scene, **(SMALL if options.smoke else {})))
        row = run(scene, recording)
        rows.append({name: str(value) for name, value in row.items()})
        write_csv(path, rows, FIELDS)
        print(k, row, flush=True)
    found = list(summary(rows))
    write_csv(options.out / "summary.csv", found)
    print(*found, sep="\n")


if __name__ == "__main__":
    main()

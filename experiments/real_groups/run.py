"""Real rearrangements: groups of frames of one fixed camera, filtered as clips of two frames, scored in the image.

    python experiments/real_groups/run.py                     # finished groups are not run again
    python experiments/real_groups/run.py --smoke --out DIR   # one group, a quarter of the size, seconds

Needs the frames in MSTFILTER_SHARED (default ../shared) under real/osd_learn. Writes pauses.csv (one row per pause
and method), summary.csv (`mst` minus each method, paired by group), past.csv (methods minus their samples alone)
and figure.png; the frames themselves are not stored. Constants of the segmentation were chosen without the camera
set-up of the group (experiments/osd_frames).
"""

from __future__ import annotations

import argparse
import os
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from mstfilter.files import read_csv, write_csv
from mstfilter.formats import PairedImages
from mstfilter.presets import preset
from mstfilter.scene import Recording, project, read_labels
from mstfilter.scoring import weighted_coverage
from mstfilter.smc import ParticleFilter, State
from mstfilter.statistics import Difference, adjusted, compare

HERE = Path(__file__).resolve().parent
SHARED = Path(os.environ.get("MSTFILTER_SHARED", HERE.parents[2] / "shared"))
CONSTANTS = HERE.parent / "osd_frames" / "results" / "constants.csv"

#: First and last frame of each group of two frames or more.
GROUPS = [(0, 1), (2, 4), (6, 16), (17, 24), (25, 26), (27, 29), (31, 32), (33, 44)]
SMOKE_GROUPS = [(27, 29)]
SEEDS = (0, 1, 2)
REFERENCE = "mst"
ALONE = ("transition=identity", "update=samples_only")

#: Name -> preset, changes, where the proposal stands that cuts trees ("" : none).
METHODS = {
    "mst": ("mst", (), "proposal"),
    "crossover": ("mst_rules", ("proposal.completer=network",), "proposal"),
    "paper": ("paper", (), "proposal"),
    "authors": ("authors", (), "proposal"),
    "union": ("union", (), "proposal"),
    "tracking_only": ("tracking_only", (), "proposal.proposal"),
    "samples_only": ("samples_only", (), "proposal"),
    "single_frame": ("single_frame", (), "proposal"),
    # The proposals of `paper` and `authors` without a past.
    "paper, samples only": ("paper", ALONE, "proposal"),
    "authors, samples only": ("authors", ALONE, "proposal"),
    "floor_one_blob": ("floor_one_blob", (), ""),
    "floor_components": ("floor_components", (), ""),
    "floor_image": ("floor_image", (), ""),
}
#: Nothing in them is drawn: one seed is all.
FIXED = ("single_frame", "floor_one_blob", "floor_components", "floor_image")
#: What a method's samples score alone: the same front end without a past.
OWN_SAMPLES = {
    "mst": "samples_only",
    "crossover": "samples_only",
    "union": "samples_only",
    "tracking_only": "samples_only",
    "paper": "paper, samples only",
    "authors": "authors, samples only",
}
FIELDS = ["group", "pause", "frame", "true_objects", "changed", "method", "seeds", "quality", "best", "objects"]
CHANGED = 0.01  # metres


def held_out(group: tuple[int, int]) -> dict[str, str]:
    """Constants of both segmentation methods, chosen on the frames of the other camera set-ups."""
    return next(r for r in read_csv(CONSTANTS) if r["frames"] == f"learn{group[0]}-{group[1]}")


def assemble(method: str, constants: dict[str, str]) -> ParticleFilter:
    """The filter of a method."""
    name, changes, proposal = METHODS[method]
    if not proposal:
        return preset(name, *changes)
    contour = method.startswith(("paper", "authors"))
    weight = constants["colour_weight" if contour else "colour_weight_learned"]
    fitted = [f"{proposal}.boundary.component=colour_depth", f"{proposal}.boundary.colour_weight={weight}"]
    if contour:
        fitted += [f"{proposal}.tree.{field}={constants[field]}" for field in ("centre", "slope")]
    return preset(name, *changes, *fitted)


def load(group: tuple[int, int], step: int = 1) -> tuple[Recording, list[np.ndarray]]:
    """A group as a recording in which every frame is a pause, and its label images; every `step`-th pixel."""
    folder, names = SHARED / "real" / "osd_learn", [f"learn{i}" for i in range(group[0], group[1] + 1)]
    recording = PairedImages(tuple(names)).open(folder)
    labels = [read_labels(folder / f"{name}_label.png").astype(np.int64)[::step, ::step] for name in names]
    if step > 1:
        frames, K = recording.frames, recording.frames[0].camera.K.copy()
        K[:2] /= step
        rgb, depth = (np.stack([getattr(f, what)[::step, ::step] for f in frames]) for what in ("rgb", "depth"))
        small = Recording.from_arrays(rgb, depth, K, pauses=range(len(frames)), name=recording.name)
        recording = replace(small, grid=replace(small.grid, voxel_size=0.02, shape=(50, 50, 25)))
    return recording, labels


def score(image: np.ndarray, label: np.ndarray) -> float:
    """Objects quality of an image (H, W), 0 no object, against labels (H, W): 1 table, 2.. objects, 0 ignored."""
    return weighted_coverage(np.where(label == 0, 0, image.astype(np.int64)), np.where(label >= 2, label - 1, 0))


def changed(before: np.ndarray, after: np.ndarray, objects: np.ndarray) -> float:
    """Fraction of the pixels `objects` with both readings whose depth (H, W) differs by more than a centimetre."""
    both = objects & np.isfinite(before) & np.isfinite(after)
    return float((np.abs(before - after)[both] > CHANGED).mean()) if both.any() else 0.0


def run(group: tuple[int, int], seeds: Sequence[int], step: int = 1) -> Iterator[dict[str, str]]:
    """One row per pause and method; means over filter seeds."""
    recording, labels = load(group, step)
    constants = held_out(group)
    filters = {method: assemble(method, constants) for method in METHODS}
    # All methods process a pause before the next one, so that they share cached work.
    states: dict[tuple[str, int], State] = {
        (m, s): f.start(s) for m, f in filters.items() for s in (seeds[:1] if m in FIXED else seeds)
    }
    for clip, label in zip(recording.clips(), labels, strict=True):
        found: dict[str, list[list[float]]] = defaultdict(list)
        for (method, seed), state in states.items():
            state, _ = filters[method].step(state, clip)
            states[method, seed] = state
            particles = state.population.particles
            q = [score(project(h, clip.after.camera), label) for h in particles]
            found[method].append([np.mean(q), np.max(q), np.mean([h.n_objects for h in particles])])
        shown = (label >= 2) | (labels[max(clip.index - 1, 0)] >= 2)
        moved = changed(clip.before.depth, clip.after.depth, shown)
        for method, values in found.items():
            quality, best, objects = np.mean(values, axis=0)
            yield dict(
                zip(
                    FIELDS,
                    (
                        f"learn{group[0]}-{group[1]}",
                        str(clip.index),
                        f"learn{group[0] + clip.index}",
                        str(len(np.unique(label[label >= 2]))),
                        f"{moved:.3f}",
                        method,
                        str(len(values)),
                        f"{quality:.4f}",
                        f"{best:.4f}",
                        f"{objects:.2f}",
                    ),
                    strict=True,
                )
            )


def group_means(lines: Sequence[dict[str, str]], what: str = "quality") -> dict[str, dict[str, float]]:
    """Method -> group -> mean over the pauses t >= 1, the endpoint."""
    values: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for line in lines:
        if int(line["pause"]) >= 1:
            values[line["method"]][line["group"]].append(float(line[what]))
    return {m: {g: float(np.mean(v)) for g, v in groups.items()} for m, groups in values.items()}


def differences(means: dict[str, dict[str, float]]) -> dict[str, Difference]:
    """`mst` minus each other method, paired by group; floors are adjusted separately."""
    found = {m: compare(means[REFERENCE], means[m]) for m in means if m != REFERENCE}
    for floor in (False, True):
        names = [m for m in found if m.startswith("floor") == floor]
        found |= dict(zip(names, adjusted([found[m] for m in names]), strict=True))
    return found


def columns(d: Difference | None) -> dict[str, str]:
    """A difference as columns; empty cells if there is none."""
    names = ("difference", "low", "high", "low_bootstrap", "high_bootstrap", "p", "p_holm")
    figures = (d.mean, d.low, d.high, d.low_bootstrap, d.high_bootstrap, d.p, d.p_holm) if d else (np.nan,) * 7
    return {name: "" if np.isnan(x) else f"{x:.3f}" for name, x in zip(names, figures, strict=True)}


def summarise(lines: Sequence[dict[str, str]], out: Path) -> None:
    """Print and write summary.csv (`mst` minus each method) and past.csv (methods minus their samples only)."""
    means, best, objects = (group_means(lines, what) for what in ("quality", "best", "objects"))
    against = differences(means)
    summary = [
        {
            "method": method,
            "groups": str(len(groups)),
            "quality": f"{np.mean(list(groups.values())):.3f}",
            "best_of_n": f"{np.mean(list(best[method].values())):.3f}",
            "objects": f"{np.mean(list(objects[method].values())):.2f}",
            **columns(against.get(method)),
        }
        for method, groups in means.items()
    ]
    pairs = {m: own for m, own in OWN_SAMPLES.items() if m in means}
    found = adjusted([compare(means[m], means[own]) for m, own in pairs.items()])
    past = [{"method": m, "minus": own, **columns(d)} for (m, own), d in zip(pairs.items(), found, strict=True)]
    for name, rows in (("summary", summary), ("past", past)):
        write_csv(out / f"{name}.csv", rows)
        print(
            *("  ".join(f"{v:>{21 if k in ('method', 'minus') else 9}}" for k, v in r.items()) for r in rows),
            sep="\n",
        )


def main() -> None:
    """Run the missing groups, then summarise and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="tiny, a few seconds; needs --out")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    parser.add_argument("--most", type=int, default=len(GROUPS), help="groups to run now, at most")
    options = parser.parse_args()
    if options.smoke and options.out == HERE / "results":
        parser.error("--smoke would overwrite the results: name another folder with --out")
    cv2.setNumThreads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / "pauses.csv"
    lines = read_csv(target) if target.exists() else []
    groups = SMOKE_GROUPS if options.smoke else GROUPS
    missing = [g for g in groups if f"learn{g[0]}-{g[1]}" not in {line["group"] for line in lines}]
    for group in missing[: options.most]:
        began = time.process_time()
        lines += run(group, SEEDS[:1] if options.smoke else SEEDS, 4 if options.smoke else 1)
        lines.sort(key=lambda r: (int(r["frame"].removeprefix("learn")), list(METHODS).index(r["method"])))
        write_csv(target, lines, FIELDS)
        print(f"learn{group[0]}-{group[1]}  {time.process_time() - began:.0f} s of the processor", flush=True)
    summarise(lines, options.out)
    from figure import draw

    draw(lines, options.out)


if __name__ == "__main__":
    main()

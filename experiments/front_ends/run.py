"""Masks of another front end, given as alternatives: what does the filter add to the best of them?

    python experiments/front_ends/run.py [--family demo] [--scenes 20] [--quality 0.7] [--smoke --out FOLDER]

The true masks of each pause are degraded to the same quality in the image in three ways: objects are split, touching
objects are merged, borders are displaced. The errors of an object last from pause to pause. The three label images
are the alternatives of a mask folder, with equal weights.

Arms: `mst` and its `samples` (no past) over the three alternatives; each alternative alone, without past (`split`,
`merged`, `displaced`) and filtered (`mst split`, ...). Columns of runs.csv, means over the pauses t >= 1 of a scene:
quality (form `objects`) of the estimate of least expected loss, mean quality by weight, and the log loss
of "do these two voxels belong to one object?" in nats after recalibration on the other scenes (lower is better).

Finished scenes are not run again. summary.csv has `mst` minus each other arm, paired by scene; `best alternative` is
the one of `split`, `merged`, `displaced` with the best mean over all scenes.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import mstfilter
from mstfilter.files import write_csv, write_text
from mstfilter.frontends import write_masks
from mstfilter.oracles import TrueMasks, bind_truth, degrade
from mstfilter.scene import Recording, scene_cache
from mstfilter.scoring import LOG_LOSS, ask, leave_one_out, pause_metrics, score_belief
from mstfilter.simulation import scene_family, simulate_recording
from mstfilter.smc import Key
from mstfilter.statistics import compare_arms, conclusion

WAYS = {"split": (1.0, 0.0), "merged": (0.0, 1.0), "displaced": (0.0, 0.0)}  # shares of splits and merges
SMALL = {"width": 96, "height": 72, "frames_per_clip": 6, "voxel_size": 0.02, "supersample": False, "n_actions": 1}
SCORES = ("quality", "mean_quality", LOG_LOSS)


def alternatives(recording: Recording, seed: int, quality: float) -> dict[str, list[np.ndarray]]:
    """Degraded true masks (H, W) of every pause, by the kind of their errors."""
    true = bind_truth(TrueMasks(), recording)
    masks = [true.masks(clip.after, clip) for clip in recording.clips()]
    return {
        way: [degrade(Key(seed).child(k).generator(), one, quality, *shares) for one in masks]
        for k, (way, shares) in enumerate(WAYS.items())
    }


def arms(folder: Path, masks: dict[str, list[np.ndarray]]) -> dict[str, tuple[str, Path]]:
    """Preset and folder of masks of each arm; writes the folders."""
    chosen = {"all": list(masks), **{way: [way] for way in masks}}
    for name, ways in chosen.items():
        for t in range(len(next(iter(masks.values())))):
            write_masks(folder / name, t, [masks[way][t] for way in ways])
    return {
        "mst": ("mst", folder / "all"),
        "samples": ("samples_only", folder / "all"),
        **{way: ("single_frame", folder / way) for way in masks},
        **{f"mst {way}": ("mst", folder / way) for way in masks},
    }


def run_scene(name: str, seed: int, quality: float, small: bool) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Rows of all arms on a scene of a family, and their counts of forecasts (arm, r, 1001, 7)."""
    family = replace(scene_family(name), **(SMALL if small else {}))
    rows, counts = [], []
    with tempfile.TemporaryDirectory() as work:
        recording = simulate_recording(family, seed, Path(work) / "recording")
        for arm, (preset, folder) in arms(Path(work), alternatives(recording, seed, quality)).items():
            completer = () if preset == "mst" else ("proposal.completer=network",)  # `mst` completes in its update
            filter = mstfilter.preset(preset, "proposal=mask_folder", f"proposal.folder={folder}", *completer)
            state, found, counted = filter.start(seed), [], []
            for clip in recording.clips():
                state, _ = filter.step(state, clip)
                if clip.index == 0:
                    continue
                labels = [h.labels for h in state.population.particles]
                weights, truth = state.population.weights, recording.truth(clip.index)
                estimate = mstfilter.Belief(state.population).estimate()
                found.append(
                    {
                        "quality": mstfilter.weighted_coverage(estimate.labels, truth),
                        "mean_quality": pause_metrics(labels, weights, truth, {})[0]["quality_weighted"],
                    }
                )
                hypotheses = state.population.particles
                counted.append(score_belief(ask(recording, clip.index), hypotheses, weights, truth).counts)
            means = {name: float(np.mean([one[name] for one in found])) for name in found[0]}
            rows.append({"scene": f"{name}-{seed}", "arm": arm, **means})
            counts.append(np.sum(counted, axis=0))
    scene_cache.clear()
    return rows, np.stack(counts)


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of all finished scenes, with the recalibrated log loss."""
    rows: list[dict[str, Any]] = []
    counts: dict[str, dict[str, np.ndarray]] = {}
    for path in sorted(folder.glob("*.json")):
        own = json.loads(path.read_text())
        for row, counted in zip(own, np.load(path.with_suffix(".npz"))["counts"], strict=True):
            counts.setdefault(row["arm"], {})[row["scene"]] = counted
        rows += own
    fits = {arm: leave_one_out(by_scene) for arm, by_scene in counts.items()}
    for row in rows:
        fit = fits[row["arm"]].get(row["scene"])
        row[LOG_LOSS] = float("nan") if fit is None else fit.log_loss(counts[row["arm"]][row["scene"]])
    return rows


def summarise(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each arm minus `mst`, for each score."""
    summary = []
    for score in SCORES:
        table: dict[str, dict[str, float]] = {}
        for row in rows:
            table.setdefault(row["arm"], {})[row["scene"]] = row[score]
        sign = -1 if score == LOG_LOSS else 1
        best = max(WAYS, key=lambda way: sign * np.mean(list(table[way].values())))
        table["best alternative"] = table[best]
        for arm, d in compare_arms(table, reference="mst").items():
            line = {"score": score, "arm": arm, "mst": np.mean(list(table["mst"].values()))}
            line |= {
                "value": np.mean(list(table[arm].values())),
                "minus_mst": d.mean,
                "low": d.low,
                "high": d.high,
            }
            summary.append({**line, "n": d.n, "p_holm": d.p_holm, "conclusion": conclusion(d, arm, "mst", score)})
    return summary


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--family", default="demo", help="one or several families of scenes, separated by commas")
    parser.add_argument("--scenes", type=int, default=20, help="scenes of each family")
    parser.add_argument("--quality", type=float, default=0.7)
    parser.add_argument("--smoke", action="store_true", help="two small scenes; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    scenes = range(2 if options.smoke else options.scenes)
    for family, seed in itertools.product(options.family.split(","), scenes):
        path = options.out / "scenes" / f"{family}-{seed}.json"
        if not path.exists():
            rows, counts = run_scene(family, seed, options.quality, options.smoke)
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(path.with_suffix(".npz"), counts=counts)
            write_text(path, json.dumps(rows))  # written last: a scene with this file is finished
        print(path.stem, flush=True)
    rows = read_rows(options.out / "scenes")
    write_csv(options.out / "runs.csv", rows, float_format=".4f")
    write_csv(options.out / "summary.csv", summarise(rows), float_format=".4f")


if __name__ == "__main__":
    main()

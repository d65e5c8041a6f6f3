"""Does the gain of the filter come from the past? Quality and log loss on 30 scenes.

    python experiments/controls/past.py [--workers 2] [--smoke --out FOLDER]

The arms are samples of the latest image (`samples`), `mst`, and four changes of `mst`:

- again: the image of pause t alone, processed t + 1 times: as many samples, no past;
- stranger: the hypotheses of another scene as the past of the step;
- shuffled: the inner frames of each clip in random order;
- frozen: a past that is never moved.

There are two scores, averaged over the pauses t >= 1. `quality` is the mean `objects` quality of the hypotheses.
`log_loss` is the log loss of forecasts of "these two voxels belong to one object" in nats, after recalibration on the
other scenes of the family. Mean quality rewards a filter that becomes certain by processing one image several times;
the log loss does not.

Writes past.csv: the mean of each score and arm, the arm minus `samples`, and `mst` minus the arm, with intervals.
Finished scenes are not run again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from run import FILTERS, SMALL, in_orders, quality

import mstfilter
from mstfilter.base.files import write_csv
from mstfilter.formats import open_recording
from mstfilter.lab.simulation import cached_recording
from mstfilter.scene import Clip
from mstfilter.scoring import ask, leave_one_out, score_belief
from mstfilter.scoring.statistics import compare
from mstfilter.smc import ParticleFilter, State

#: Families in turn, so that an unfinished study has all of them. Nothing was tuned or looked at on these seeds.
SCENES = [(family, seed) for seed in range(140, 150) for family in ("s1", "s2", "s3")]
ARMS = ("samples", "mst", "again", "stranger", "shuffled", "frozen")


def again(filter: ParticleFilter, clip: Clip) -> State:
    """State after processing only the last image of a clip, once for each pause so far."""
    state = filter.start(0)
    for k in range(clip.index + 1):
        frames = (clip.after,) * (1 if k == 0 else 2)
        state, _ = filter.step(state, Clip(frames, clip.grid, k))
    return state


def scores(scene: tuple[str, int], other: tuple[str, int], small: bool) -> dict[str, np.ndarray]:
    """Quality (arm, pause t >= 1), and numbers of forecasts (arm, pause, rate of noise, forecast, answer)."""
    change = SMALL if small else {}
    recording, elsewhere = (open_recording(cached_recording(f, s, **change)) for f, s in (scene, other))
    mst, frozen = mstfilter.preset("mst"), mstfilter.preset("mst", *FILTERS["frozen"])
    samples = mstfilter.preset("samples_only", f"n_proposed={mst.n_proposed}")
    chains = {"samples": samples, "mst": mst, "shuffled": mst, "frozen": frozen}
    states = {arm: filter.start(0) for arm, filter in chains.items()}
    foreign, rng, found = mst.start(0), np.random.default_rng(scene[1]), []
    for clip, clip_elsewhere in zip(recording.clips(), elsewhere.clips(), strict=False):
        past, (foreign, _) = foreign, mst.step(foreign, clip_elsewhere)
        shuffled = in_orders(clip, rng)["shuffled"]
        for arm, filter in chains.items():
            states[arm], _ = filter.step(states[arm], shuffled if arm == "shuffled" else clip)
        if clip.index == 0:
            continue
        truth, questions = recording.truth(clip.index), ask(recording, clip.index)
        assert truth is not None
        now = states | {"again": again(mst, clip), "stranger": mst.step(past, clip)[0]}
        beliefs = [now[arm].population for arm in ARMS]
        counts = [score_belief(questions, one.particles, one.weights, truth)[1] for one in beliefs]
        found.append(([quality(now[arm], truth) for arm in ARMS], counts))
    qualities, counts = (np.array(part).swapaxes(0, 1) for part in zip(*found, strict=True))
    return {"quality": qualities, "counts": counts}


def run(arguments: tuple[Path, tuple[str, int], tuple[str, int], bool]) -> str:
    """Filter a scene and store its scores, unless that has been done."""
    folder, scene, other, small = arguments
    path = folder / f"{scene[0]}-{scene[1]}.npz"
    if not path.exists():
        np.savez_compressed(path, **scores(scene, other, small))
    return path.name


def by_scene(folder: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Score -> arm -> scene -> mean over pauses."""
    stored = {path.stem: dict(np.load(path)) for path in sorted(folder.glob("*.npz"))}
    found = {
        "quality": {a: {n: float(one["quality"][k].mean()) for n, one in stored.items()} for k, a in enumerate(ARMS)}
    }
    losses: dict[str, dict[str, float]] = {arm: {} for arm in ARMS}
    for family in sorted({name.partition("-")[0] for name in stored}):
        own = {name: one["counts"] for name, one in stored.items() if name.startswith(f"{family}-")}
        for k, arm in enumerate(ARMS):
            for name, fit in leave_one_out({name: counts[k].sum(axis=0) for name, counts in own.items()}).items():
                losses[arm][name] = float(np.mean([fit.log_loss(of_pause) for of_pause in own[name][k]]))
    return found | {"log_loss": losses}


def table(found: dict[str, dict[str, dict[str, float]]]) -> Iterator[dict[str, object]]:
    """Means and paired differences, over all families together and in each."""
    for score, arms in found.items():
        for family in ("", *sorted({name.partition("-")[0] for name in arms["mst"]})):
            own = {arm: {n: v for n, v in values.items() if n.startswith(family)} for arm, values in arms.items()}
            for arm, values in own.items():
                over, under = compare(values, own["samples"]), compare(own["mst"], values)
                row = {"score": score, "family": family or "all", "arm": arm, "n": over.n}
                row |= {"mean": float(np.mean(list(values.values())))}
                row |= {"minus_samples": over.mean, "low": over.low, "high": over.high}
                yield row | {"mst_minus_it": under.mean, "mst_low": under.low, "mst_high": under.high}


def main() -> None:
    """Run the missing scenes, then write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="two small scenes; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--workers", type=int, default=1)
    chosen = parser.parse_args()
    if chosen.smoke and chosen.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    folder = chosen.out / "counts"
    folder.mkdir(parents=True, exist_ok=True)
    scenes, jobs = (SCENES[:6:3] if chosen.smoke else SCENES), []
    for scene in scenes:
        family = [one for one in scenes if one[0] == scene[0]]
        jobs.append((folder, scene, family[(family.index(scene) + 1) % len(family)], chosen.smoke))
    with ProcessPoolExecutor(chosen.workers) as pool:
        # In a process forked off one with threads of OpenCV, OpenCV waits for these threads for ever.
        for name in (map if chosen.workers == 1 else pool.map)(run, jobs):
            print(name, flush=True)
    rows = list(table(by_scene(folder)))
    write_csv(chosen.out / "past.csv", rows, float_format=".4f")
    print(*(row for row in rows if row["family"] == "all"), sep="\n")


if __name__ == "__main__":
    main()

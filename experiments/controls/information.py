"""What the filter knows without its past: the controls of `run.py` by the second endpoint.

    python experiments/controls/information.py [--workers 2] [--smoke --out FOLDER]

On the same scenes: the log loss of "do these two voxels belong to one object?" in nats, after recalibration on the
other scenes of the family, mean over the pauses t >= 1, of `mst`, of samples of the latest image, of the latest image
alone processed t + 1 times (`again`), and of a step with the hypotheses of another scene as its past (`stranger`).
Mean quality rewards a filter that becomes sure by seeing one image several times; this score does not.

Writes information.csv: means and paired differences from `samples` with 95 % t intervals. Finished scenes are not run
again.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from run import SCENES, SMALL, again

import mstfilter
from mstfilter.files import write_csv
from mstfilter.formats import open_recording
from mstfilter.scoring import ask, leave_one_out, score_belief
from mstfilter.simulation import cached_recording
from mstfilter.statistics import compare

ARMS = ("samples", "mst", "again", "stranger")


def counts(scene: tuple[str, int], other: tuple[str, int], small: bool) -> np.ndarray:
    """Counts of forecasts of the arms, (arm, pause t >= 1, rate of noise, forecast, answer)."""
    change = SMALL if small else {}
    recording, stranger = (open_recording(cached_recording(f, s, **change)) for f, s in (scene, other))
    mst = mstfilter.preset("mst")
    samples = mstfilter.preset("samples_only", f"n_proposed={mst.n_proposed}")
    state, foreign, alone, found = mst.start(0), mst.start(0), samples.start(0), []
    for clip, elsewhere in zip(recording.clips(), stranger.clips(), strict=False):
        past, (foreign, _) = foreign, mst.step(foreign, elsewhere)
        state, _ = mst.step(state, clip)
        alone, _ = samples.step(alone, clip)
        if clip.index == 0:
            continue
        truth, questions = recording.truth(clip.index), ask(recording, clip.index)
        states = (alone, state, again(mst, clip), mst.step(past, clip)[0])
        sets = [one.population for one in states]
        found.append([score_belief(questions, one.particles, one.weights, truth)[1] for one in sets])
    return np.array(found).swapaxes(0, 1)


def run(arguments: tuple[Path, tuple[str, int], tuple[str, int], bool]) -> str:
    """Filter a scene and store its counts, unless that has been done."""
    folder, scene, other, small = arguments
    path = folder / f"{scene[0]}-{scene[1]}.npz"
    if not path.exists():
        found = counts(scene, other, small)
        np.savez_compressed(path, counts=found)
    return path.name


def losses(folder: Path) -> dict[str, dict[str, float]]:
    """Information of each arm and scene."""
    found: dict[str, dict[str, float]] = {arm: {} for arm in ARMS}
    stored = {path.stem: np.load(path)["counts"] for path in sorted(folder.glob("*.npz"))}
    for family in {name.partition("-")[0] for name in stored}:
        own = {name: values for name, values in stored.items() if name.startswith(f"{family}-")}
        for k, arm in enumerate(ARMS):
            fits = leave_one_out({name: values[k].sum(axis=0) for name, values in own.items()})
            for name, fit in fits.items():
                found[arm][name] = float(np.mean([fit.log_loss(of_pause) for of_pause in own[name][k]]))
    return found


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
    scenes, jobs = (SCENES[:2] if chosen.smoke else SCENES), []
    for scene in scenes:
        family = [one for one in scenes if one[0] == scene[0]]
        jobs.append((folder, scene, family[(family.index(scene) + 1) % len(family)], chosen.smoke))
    with ProcessPoolExecutor(chosen.workers) as pool:
        for name in pool.map(run, jobs):
            print(name, flush=True)
    found, rows = losses(folder), []
    for arm, by_scene in found.items():
        over, under = compare(by_scene, found["samples"]), compare(found["mst"], by_scene)
        row = {"arm": arm, "n": over.n, "information": float(np.mean(list(by_scene.values())))}
        row |= {"minus_samples": over.mean, "low": over.low, "high": over.high}
        rows.append({**row, "mst_minus_it": under.mean, "mst_low": under.low, "mst_high": under.high})
    write_csv(chosen.out / "information.csv", rows, float_format=".4f")
    print(*rows, sep="\n")


if __name__ == "__main__":
    main()

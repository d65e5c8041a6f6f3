"""How much do samples and predictions say about two pixels? Fits `mstfilter.fusion.cells.PairEvidence`.

    python experiments/partition_fit/run.py [--seeds 3] [--smoke --out FOLDER]

`mst` runs on tuning scenes of `s1`, `s2`, `s3`, once with the video of the clips and once with their first and last
frames only. At each pause t >= 1, 4,000 pairs of readings of objects, up to 40 pixels apart, are drawn. Of each pair:
the share of 30 samples of the image, and the weighted share of the predictions that explain both readings, in which
they belong to one object; and whether they do in truth. A logistic regression gives the log odds of "one object".
Each scene is scored with the coefficients of the other scenes.

pairs/*.npz: the pairs of one scene (finished scenes are not run again). fit.csv: coefficients and log losses in nats.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import mstfilter
from mstfilter.files import write_csv
from mstfilter.fusion.cells import softened_logit
from mstfilter.fusion.partition import Readings
from mstfilter.oracles.truth import RecordingTruth
from mstfilter.scene import Clip
from mstfilter.simulation import cached_recording
from mstfilter.smc import Key

N_SAMPLES, N_PAIRS, REACH = 30, 4000, 40
SMALL = {"width": 160, "height": 120, "n_actions": 1}
#: Columns of the regression for each model.
MODELS = {"image": (0, 1), "past": (0, 2, 3), "both": (0, 1, 2, 3)}
NAMES = ("constant", "image", "past", "past_constant")


def without_video(clip: Clip) -> Clip:
    """The first and the last frame of a clip."""
    times = (clip.times[0], clip.times[-1]) if len(clip.times) else ()
    return replace(clip, frames=(clip.frames[0], clip.frames[-1]), times=times)


def pairs_of(family: str, seed: int, video: bool, small: bool) -> np.ndarray:
    """(m, 4): share of the samples, share and weight of the predictions that explain both readings, truth."""
    recording = mstfilter.open_recording(cached_recording(family, seed, **(SMALL if small else {})))
    truth, rows = RecordingTruth(recording), []
    filter = mstfilter.preset("mst")
    state = filter.start(0)
    for t, clip in enumerate(recording.clips()):
        clip = clip if video or len(clip.frames) < 3 else without_video(clip)
        before = state
        state, _ = filter.step(state, clip)
        if not t:
            continue
        rng = Key(seed).child(t).generator()
        predicted = filter.transition.predict(rng, before.population, clip)
        readings = Readings.of(clip.after, clip.grid)
        tree, values = filter.proposal.tree_of(clip.after)
        cuts = filter.proposal.sampler.sample(rng, tree, values, N_SAMPLES).cuts
        images = [filter.proposal.objects.label_image(tree, cut, clip.after, clip.grid) for cut in cuts]
        samples = np.stack([image.ravel()[readings.pixels] for image in images])
        past = np.stack([readings.labels(h.labels, filter.update.reach) for h in predicted.particles])
        a, b, same = _drawn(rng, readings, samples, truth.instance(t))
        if not len(a):
            continue
        explained = (past[:, a] > 0) & (past[:, b] > 0)
        weight = predicted.weights @ explained
        agreeing = predicted.weights @ (explained & (past[:, a] == past[:, b]))
        share = np.divide(agreeing, weight, out=np.full(len(a), 0.5), where=weight > 0)
        image = np.mean((samples[:, a] == samples[:, b]) & (samples[:, a] > 0), axis=0)
        rows.append(np.stack([image, share, weight, same], axis=1))
    return np.concatenate(rows) if rows else np.zeros((0, 4))


def _drawn(
    rng: np.random.Generator, readings: Readings, samples: np.ndarray, instance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of readings of objects (m,), (m,), and whether they show one object."""
    owner = instance.ravel()[readings.pixels]
    objects = np.flatnonzero((np.mean(samples > 0, axis=0) > 0.5) & (owner > 0))
    if len(objects) < 2:
        return objects[:0], objects[:0], owner[:0]
    size = np.array(instance.shape)
    place = np.full(instance.size, -1)
    place[readings.pixels[objects]] = objects
    first = rng.choice(objects, N_PAIRS)
    pixel = np.stack(np.divmod(readings.pixels[first], size[1]), axis=1) + rng.integers(
        -REACH, REACH + 1, (N_PAIRS, 2)
    )
    pixel = np.clip(pixel, 0, size - 1)
    second = place[pixel[:, 0] * size[1] + pixel[:, 1]]
    kept = second >= 0
    first, second = first[kept], second[kept]
    return first, second, owner[first] == owner[second]


def design(pairs: np.ndarray) -> np.ndarray:
    """Columns (m, 4) of the regression, in the order of the fields of `PairEvidence`."""
    image, share, weight, _ = pairs.T
    return np.stack([np.ones(len(pairs)), softened_logit(image), weight * softened_logit(share), weight], axis=1)


def fit(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Coefficients of the logistic regression of least log loss."""
    sign = 2 * y - 1
    found = minimize(lambda b: np.logaddexp(0, -sign * (x @ b)).mean(), np.zeros(x.shape[1]), method="BFGS")
    return np.asarray(found.x)


def table(scenes: dict[str, np.ndarray], clips: str) -> list[dict[str, str]]:
    """A row for each model: coefficients of all scenes, mean log loss of scenes that were left out."""
    rows = []
    for name, columns in MODELS.items():
        x = {scene: design(pairs)[:, columns] for scene, pairs in scenes.items()}
        y = {scene: pairs[:, 3] for scene, pairs in scenes.items()}
        losses = []
        for left in scenes:
            others = [scene for scene in scenes if scene != left] or [left]
            b = fit(np.concatenate([x[s] for s in others]), np.concatenate([y[s] for s in others]))
            losses.append(np.logaddexp(0, -(2 * y[left] - 1) * (x[left] @ b)).mean())
        b = fit(np.concatenate(list(x.values())), np.concatenate(list(y.values())))
        found = {NAMES[k]: f"{value:.2f}" for k, value in zip(columns, b, strict=True)}
        row = {"clips": clips, "evidence": name, "scenes": str(len(scenes)), "pairs": str(sum(map(len, y.values())))}
        rows.append({**row, **{k: found.get(k, "") for k in NAMES}, "log_loss": f"{np.mean(losses):.4f}"})
    return rows


def main() -> None:
    """Run the missing scenes, then fit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="scenes of each family, seeds 0, 1, ...")
    parser.add_argument("--smoke", action="store_true", help="two small scenes; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    if chosen.smoke and chosen.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    (chosen.out / "pairs").mkdir(parents=True, exist_ok=True)
    rows = []
    for video in (True, False):
        scenes = {}
        for seed in range(2 if chosen.smoke else chosen.seeds):
            for family in ("demo",) if chosen.smoke else ("s1", "s2", "s3"):
                path = chosen.out / "pairs" / f"{family}-{seed}{'' if video else '-two-frames'}.npz"
                if not path.exists():
                    np.savez_compressed(path, pairs=pairs_of(family, seed, video, chosen.smoke))
                    print(path.stem, flush=True)
                scenes[f"{family}-{seed}"] = np.load(path)["pairs"]
        rows += table(
            {scene: pairs for scene, pairs in scenes.items() if len(pairs)}, "video" if video else "two frames"
        )
    write_csv(chosen.out / "fit.csv", rows)
    for row in rows:
        print("  ".join(f"{value:>10}" for value in row.values()))


if __name__ == "__main__":
    main()

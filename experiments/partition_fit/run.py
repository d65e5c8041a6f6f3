"""How much do samples and predictions say about two pixels? Fits `mstfilter.fusion.cells.PairEvidence`.

    python experiments/partition_fit/run.py [--seeds 3] [--smoke --out FOLDER]

`mst` runs on tuning scenes of `s1`, `s2`, `s3`. At each pause t >= 1, 4,000 pairs of readings of objects, up to 40
pixels apart, are drawn. Of each pair: the share of 30 samples of the image, and the weighted share of the predictions
that explain both readings, in which they belong to one object; and whether they do in truth. There are three pasts of
a pause: the hypotheses of the pause before, moved along the video; the same, moved by the first and the last frame
only; and the hypotheses of another scene. A logistic regression gives the log odds of "one object". It is fitted with
the first past, and scored with all three. Each scene is scored with the coefficients of the other scenes.

pairs/*.npz: the pairs of one scene (finished scenes are not run again). fit.csv: coefficients and log losses in nats.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import mstfilter
from mstfilter.files import write_csv
from mstfilter.fusion.cells import softened_logit
from mstfilter.fusion.free_space import log_quality
from mstfilter.fusion.partition import Readings
from mstfilter.oracles.truth import RecordingTruth
from mstfilter.scene import Clip
from mstfilter.simulation import cached_recording
from mstfilter.smc import Key

N_SAMPLES, N_PAIRS, REACH = 30, 4000, 40
SMALL = {"width": 160, "height": 120, "n_actions": 1}
PASTS = ("video", "two frames", "stranger")
#: Columns of the regression that each model fits, and the probability that the past is right (None: as measured). The
#: last model has the coefficients of the first for a wrong past.
MODELS: dict[str, tuple[Sequence[int], float | None]] = {
    "image": ((0, 1), 0.0),
    "past": ((2, 4, 5), 1.0),
    "both, past right": ((2, 3, 4, 5), 1.0),
    "both": ((2, 3, 4, 5), None),
}
NAMES = ("alone_constant", "alone_image", "constant", "image", "past", "past_constant")


def without_video(clip: Clip) -> Clip:
    """The first and the last frame of a clip."""
    times = (clip.times[0], clip.times[-1]) if len(clip.times) else ()
    return replace(clip, frames=(clip.frames[0], clip.frames[-1]), times=times)


def pairs_of(family: str, seed: int, n_scenes: int, small: bool) -> dict[str, np.ndarray]:
    """(m, 5) for each past: shares of the samples and of the predictions, weight of the predictions that explain both
    readings, of all predictions, truth."""
    change = SMALL if small else {}
    recording, other = (
        mstfilter.open_recording(cached_recording(family, k, **change)) for k in (seed, (seed + 1) % n_scenes)
    )
    truth, filter = RecordingTruth(recording), mstfilter.preset("mst")
    rows: dict[str, list[np.ndarray]] = {past: [] for past in PASTS}
    state, foreign = filter.start(0), filter.start(0)
    for t, (clip, other_clip) in enumerate(zip(recording.clips(), other.clips(), strict=False)):
        before, before_foreign = state.population, foreign.population
        state, _ = filter.step(state, clip)
        foreign, _ = filter.step(foreign, other_clip)
        if not t:
            continue
        rng = Key(seed).child(t).generator()
        readings = Readings.of(clip.after, clip.grid)
        tree, values = filter.proposal.tree_of(clip.after)
        cuts = filter.proposal.sampler.sample(rng, tree, values, N_SAMPLES).cuts
        images = [filter.proposal.objects.label_image(tree, cut, clip.after, clip.grid) for cut in cuts]
        samples = np.stack([image.ravel()[readings.pixels] for image in images])
        a, b, same = _drawn(rng, readings, samples, truth.instance(t))
        if not len(a):
            continue
        image = np.mean((samples[:, a] == samples[:, b]) & (samples[:, a] > 0), axis=0)
        of_past = zip(PASTS, (before, before, before_foreign), (clip, without_video(clip), clip), strict=True)
        for name, population, seen in of_past:
            predicted = filter.transition.predict(rng, population, seen)
            quality = filter.update.free_space.refine(predicted.particles, seen)[1]
            weights = predicted.weights * np.exp(filter.update.quality_exponent * log_quality(quality))
            past = np.stack([readings.labels(h.labels, filter.update.reach) for h in predicted.particles])
            explained = (past[:, a] > 0) & (past[:, b] > 0)
            weight, agreeing = weights @ explained, weights @ (explained & (past[:, a] == past[:, b]))
            share = np.divide(agreeing, weight, out=np.full(len(a), 0.5), where=weight > 0)
            rows[name].append(np.stack([image, share, weight, np.full(len(a), weights.sum()), same], axis=1))
    return {name: np.concatenate(found) if found else np.zeros((0, 5)) for name, found in rows.items()}


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


def design(pairs: np.ndarray, right: float | None) -> np.ndarray:
    """Columns (m, 6) of the regression, in the order of the fields of `PairEvidence`."""
    image, share, explained, past, _ = pairs.T
    if right is not None:
        explained, past = right * explained / past, np.full(len(past), right)
    logit = softened_logit(image)
    return np.stack(
        [1 - past, (1 - past) * logit, past, past * logit, explained * softened_logit(share), explained], axis=1
    )


def fit(x: np.ndarray, y: np.ndarray, columns: Sequence[int], known: np.ndarray) -> np.ndarray:
    """`known` coefficients (6,), with those of some columns chosen by the least log loss."""
    coefficients, sign, chosen = known.copy(), 2 * y - 1, list(columns)
    offset = x @ known - x[:, chosen] @ known[chosen]

    def loss(b: np.ndarray) -> float:
        return float(np.logaddexp(0, -sign * (offset + x[:, chosen] @ b)).mean())

    coefficients[chosen] = minimize(loss, known[chosen], method="BFGS").x
    return coefficients


def fits(scenes: Iterable[np.ndarray]) -> dict[str, np.ndarray]:
    """The coefficients (6,) of every model."""
    pairs = np.concatenate(list(scenes))
    y, found = pairs[:, -1], {}
    for name, (columns, right) in MODELS.items():
        known = np.zeros(6) if right is not None else found["image"] + found["both, past right"]
        found[name] = fit(design(pairs, right), y, columns, known)
    return found


def loss(name: str, coefficients: np.ndarray, pairs: np.ndarray) -> float:
    """The mean log loss of a model, in nats."""
    x = design(pairs, MODELS[name][1])
    return float(np.logaddexp(0, -(2 * pairs[:, -1] - 1) * (x @ coefficients)).mean())


def table(scenes: dict[str, dict[str, np.ndarray]]) -> list[dict[str, str]]:
    """A row for each model: coefficients of all scenes, mean log loss of scenes that were left out, by past."""
    losses: dict[str, list[list[float]]] = {name: [] for name in MODELS}
    for left, of_past in scenes.items():
        others = [scene for scene in scenes if scene != left] or [left]
        for name, b in fits(scenes[scene]["video"] for scene in others).items():
            losses[name].append([loss(name, b, of_past[past]) for past in PASTS])
    rows = []
    for name, b in fits(found["video"] for found in scenes.values()).items():
        row = {"evidence": name, "scenes": str(len(scenes))}
        row |= {field: f"{value:.2f}" if value else "" for field, value in zip(NAMES, b, strict=True)}
        rows.append(row | {past: f"{x:.4f}" for past, x in zip(PASTS, np.mean(losses[name], axis=0), strict=True)})
    return rows


def main() -> None:
    """Run the missing scenes, then fit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="scenes of each family, seeds 0, 1, ...")
    parser.add_argument("--smoke", action="store_true", help="two small scenes; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    if chosen.smoke and chosen.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    (chosen.out / "pairs").mkdir(parents=True, exist_ok=True)
    scenes, seeds = {}, 2 if chosen.smoke else chosen.seeds
    for seed in range(seeds):
        for family in ("demo",) if chosen.smoke else ("s1", "s2", "s3"):
            path = chosen.out / "pairs" / f"{family}-{seed}.npz"
            if not path.exists():
                np.savez_compressed(path, **pairs_of(family, seed, seeds, chosen.smoke))
                print(path.stem, flush=True)
            found = np.load(path)
            scenes[path.stem] = {past: found[past] for past in PASTS}
    rows = table({scene: of_past for scene, of_past in scenes.items() if len(of_past["video"])})
    write_csv(chosen.out / "fit.csv", rows)
    for row in rows:
        print("  ".join(f"{value:>16}" for value in row.values()))


if __name__ == "__main__":
    main()

"""How much do samples and predictions say about two cells? Fits `mstfilter.mst.partition.PairEvidence`.

    python experiments/partition_fit/run.py [--seeds 3] [--smoke --out FOLDER]

`mst` runs on tuning scenes of `s1`, `s2`, `s3`. At each pause t >= 1, `PartitionUpdate` compares 30 samples of the
image with the predictions, and asks for the log odds that two cells belong to one object. Of each pair of cells that
it asks about, the terms of `PairEvidence.terms` are kept, the share of the pairs of readings of both cells that show
one object in truth, and the number of these pairs as its weight. There are three pasts of a pause: the hypotheses of
the pause before, moved along the video; the same, moved by the first and the last frame only; and the hypotheses of
another scene. A logistic regression is fitted with the first past, and scored with all three. All pauses count alike.
Each scene is scored with the coefficients of the other scenes.

pairs/*.npz: the pairs of one scene (finished scenes are not run again). fit.csv: coefficients and log losses in nats.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import mstfilter
from mstfilter.base.files import write_csv
from mstfilter.lab.oracles.truth import RecordingTruth
from mstfilter.lab.simulation import cached_recording
from mstfilter.mst.completion import SurfaceOnly
from mstfilter.mst.partition import Cells, PairEvidence, PairOdds, PairTerms
from mstfilter.scene import Clip
from mstfilter.smc import Key

SMALL = {"width": 160, "height": 120, "n_actions": 1}
PASTS = ("video", "two frames", "stranger")
NAMES = PairTerms._fields
#: Columns of the regression that each model fits, and the probability that the past is right (None: as measured). The
#: last model has the coefficients of the first for a wrong past.
MODELS: dict[str, tuple[Sequence[int], float | None]] = {
    "image": ((0, 1), 0.0),
    "past": ((2, 4, 5), 1.0),
    "both, past right": ((2, 3, 4, 5), 1.0),
    "both": ((2, 3, 4, 5), None),
}


@dataclass(frozen=True)
class Recorder(PairOdds):
    """Keeps the terms of all pairs, their weights, and the shares of their pairs of readings that show one object."""

    instance: np.ndarray  #: (H, W) true object of each pixel, 0 is none
    kept: list[np.ndarray] = field(default_factory=list)

    def log_odds(self, cells: Cells, weights: np.ndarray, clip: Clip) -> np.ndarray:
        terms = PairEvidence().terms(cells, weights)
        counts = cells.counts(cells.readings.of_image(self.instance))[:, 1:]
        a, b = cells.pairs.T
        of_pair = counts[a].sum(axis=1) * counts[b].sum(axis=1)
        same = np.divide((counts[a] * counts[b]).sum(axis=1), of_pair, out=np.zeros(len(a)), where=of_pair > 0)
        self.kept.append(np.column_stack([*terms, same, of_pair / max(of_pair.sum(), 1)]))
        return np.zeros(len(a))


def without_video(clip: Clip) -> Clip:
    """The first and the last frame of a clip."""
    times = (clip.times[0], clip.times[-1]) if len(clip.times) else ()
    return replace(clip, frames=(clip.frames[0], clip.frames[-1]), times=times)


def pairs_of(family: str, seed: int, n_scenes: int, small: bool) -> dict[str, np.ndarray]:
    """(m, 8) for each past: six terms, the share of "one object", the weight."""
    change = SMALL if small else {}
    recording, other = (
        mstfilter.open_recording(cached_recording(family, k, **change)) for k in (seed, (seed + 1) % n_scenes)
    )
    truth, filter = RecordingTruth(recording), mstfilter.preset("mst")
    rows: dict[str, list[np.ndarray]] = {past: [np.zeros((0, 8))] for past in PASTS}
    state, foreign = filter.start(0), filter.start(0)
    for t, (clip, other_clip) in enumerate(zip(recording.clips(), other.clips(), strict=False)):
        before, before_foreign = state.population, foreign.population
        state, _ = filter.step(state, clip)
        foreign, _ = filter.step(foreign, other_clip)
        if not t:
            continue
        rng = Key(seed).child(t).generator()
        proposed = filter.proposal.sample(rng, clip, filter.n_proposed)
        of_past = zip(PASTS, (before, before, before_foreign), (clip, without_video(clip), clip), strict=True)
        for name, population, seen in of_past:
            recorder = Recorder(truth.instance(t))
            predicted = filter.transition.predict(rng, population, seen)
            update = replace(filter.update, pairs=recorder, completer=SurfaceOnly())
            update.update(rng, predicted, proposed, seen)
            rows[name] += recorder.kept
    return {name: np.concatenate(found) for name, found in rows.items()}


def design(pairs: np.ndarray, right: float | None) -> np.ndarray:
    """Columns (m, 6) of the regression, in the order of the fields of `PairEvidence`."""
    terms = pairs[:, :6]
    if right is None:
        return terms
    logit, past = terms[:, 1] + terms[:, 3], terms[:, 2]
    of_past = right * terms[:, 4:] / np.maximum(past, 1e-9)[:, None]
    alone, both = np.full(len(pairs), 1 - right), np.full(len(pairs), right)
    return np.column_stack([alone, alone * logit, both, both * logit, of_past])


def fit(x: np.ndarray, pairs: np.ndarray, columns: Sequence[int], known: np.ndarray) -> np.ndarray:
    """`known` coefficients (6,), with those of some columns chosen by the least log loss."""
    coefficients, chosen = known.copy(), list(columns)

    def objective(b: np.ndarray) -> float:
        coefficients[chosen] = b
        return log_loss(x @ coefficients, pairs)

    coefficients[chosen] = minimize(objective, known[chosen], method="BFGS").x
    return coefficients


def log_loss(log_odds: np.ndarray, pairs: np.ndarray) -> float:
    """The weighted mean log loss in nats."""
    same, weight = pairs[:, 6:].T
    each = same * np.logaddexp(0, -log_odds) + (1 - same) * np.logaddexp(0, log_odds)
    return float(weight @ each / weight.sum())


def fits(scenes: Iterable[np.ndarray]) -> dict[str, np.ndarray]:
    """The coefficients (6,) of every model."""
    pairs, found = np.concatenate(list(scenes)), {}
    for name, (columns, right) in MODELS.items():
        known = np.zeros(6) if right is not None else found["image"] + found["both, past right"]
        found[name] = fit(design(pairs, right), pairs, columns, known)
    return found


def table(scenes: dict[str, dict[str, np.ndarray]]) -> list[dict[str, str]]:
    """A row for each model: coefficients of all scenes, mean log loss of scenes that were left out, by past."""
    losses: dict[str, list[list[float]]] = {name: [] for name in MODELS}
    for left, of_past in scenes.items():
        others = [scene for scene in scenes if scene != left] or [left]
        for name, b in fits(scenes[scene]["video"] for scene in others).items():
            right = MODELS[name][1]
            losses[name].append([log_loss(design(of_past[past], right) @ b, of_past[past]) for past in PASTS])
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

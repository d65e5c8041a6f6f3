"""Are the weights of the candidates probabilities? Also fits `PartitionUpdate.temperature`.

    python experiments/weights/reliability.py [--smoke --out FOLDER]

`mst` runs on short simulated recordings. At each pause, the script keeps the probability of each partition of a
component, given each prediction, and the disagreement of the partition with the true labels. The disagreement is the
number of pairs of depth readings that the partition joins or separates wrongly. The *right* partition of a component
is the alternative of least disagreement. The script also keeps the weights and true qualities of the selected
candidates. All probabilities for a temperature T are computed afterwards, from the probabilities at T = 1.

scenes/*.npz: what is kept of one recording (finished recordings are not run again). reliability.csv: calibration
errors and log losses for each question and T. bins.csv: the reliability diagrams. reliability.png: the diagrams.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.special import logsumexp

import mstfilter
from mstfilter.base.errors import InputError
from mstfilter.base.files import write_csv
from mstfilter.lab.oracles.truth import RecordingTruth
from mstfilter.lab.simulation import cached_recording
from mstfilter.mst.partition import Cells, PartitionUpdate
from mstfilter.mst.partition.candidates import Choices, largest_products, tempered
from mstfilter.mst.partition.cells import Readings
from mstfilter.mst.partition.update import Prediction
from mstfilter.scene import Clip, canonical
from mstfilter.scoring import pairwise_quality, weighted_coverage
from mstfilter.scoring.forecasts import SOFTENING, ForecastTable, Reliability
from mstfilter.smc import ParticleFilter, Population, Systematic

SHORT = {
    "width": 320,
    "height": 240,
    "workspace_x": 0.7,
    "workspace_y": 0.7,
    "workspace_z": 0.3,
    "n_objects_min": 4,
    "n_objects_max": 4,
    "min_moved": 1,
    "n_candidates": 2,
    "arm": False,
    "fps": 0.5,
    "frames_per_clip": 2,
}
#: Objects with a twin, on others, and hidden. `s3` has more twins than objects here, so it has fewer than in `s3`.
FAMILIES: dict[str, dict[str, int]] = {"s1": {}, "s2": {}, "s3": {"n_twins": 3, "n_stacked": 2, "n_hidden": 2}}
TEMPERATURES = (10.0, 6.0, 4.0, 3.0, 2.0, 1.4, 1.0, 0.7, 0.5, 0.3)
PER_BIN, MOST_BINS = 80, 5  # with all recordings, the bins of a reliability diagram have more than 400 questions
FOLDS = 10
#: Partitions that differ in a smaller share of the pairs of readings are one class. So are hypotheses whose quality
#: against each other is above 1 - ALIKE.
ALIKE = 0.02


class Kept(NamedTuple):
    """What the update chooses from at a pause."""

    cells: Cells
    log_weights: np.ndarray  #: (n,) log weights of the predictions, normalised
    p_valid: np.ndarray  #: (n,) probability that each prediction is valid
    log_odds: list[np.ndarray]  #: log odds (e,) of pairs of cells, given each prediction
    choices: Choices


@dataclass(frozen=True)
class Recorder(PartitionUpdate):
    """Keeps what `PartitionUpdate` chooses from."""

    kept: list[Kept] = field(default_factory=list)

    def _choices(
        self, cells: Cells, predictions: Sequence[Prediction], log_weights: np.ndarray, clip: Clip
    ) -> Choices:
        choices = super()._choices(cells, predictions, log_weights, clip)
        p_valid = np.array([one.p_valid for one in predictions])
        log_odds = [self.pairs.log_odds(cells, row, clip) for row in np.diag(p_valid)]
        self.kept.append(Kept(cells, log_weights - logsumexp(log_weights), p_valid, log_odds, choices))
        return choices


@dataclass(frozen=True)
class Selector(Systematic):
    """Keeps the indices of the selected candidates."""

    kept: list[np.ndarray] = field(default_factory=list)

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        ancestors, _ = super().select(rng, log_weights, n)
        self.kept.append(ancestors)
        return ancestors, None


def recorded(filter: ParticleFilter) -> tuple[ParticleFilter, list[Kept], list[np.ndarray]]:
    """The filter, what its update chooses from at each pause, and the indices of the selected candidates."""
    update = Recorder(**{f.name: getattr(filter.update, f.name) for f in fields(filter.update)})
    selector = Selector()
    return replace(filter, update=update, resampler=selector), update.kept, selector.kept


def disagreements(partitions: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Pairs of readings (p,) that partitions (p, k) of cells join or separate wrongly.

    `counts` (k, m) are the numbers of readings of each cell on each true object; column 0 is no object.
    """
    n = counts.sum(axis=1)
    same = counts[:, 1:] @ counts[:, 1:].T
    joined = partitions[:, :, None] == partitions[:, None, :]
    wrong = np.where(joined, np.outer(n, n) - same, same)
    return np.asarray(wrong.sum(axis=(1, 2)) / 2)


def classes(partitions: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Class (p,) of each partition (p, k) of cells. Partitions that differ in few pairs of readings are one class."""
    joined = partitions[:, :, None] == partitions[:, None, :]
    share = np.outer(sizes, sizes) / sizes.sum() ** 2
    differ = ((joined[:, None] != joined) * share).sum(axis=(2, 3))
    return np.asarray(connected_components(differ < ALIKE, directed=False)[1])


def of_pause(kept: Kept, instance: np.ndarray) -> dict[str, np.ndarray]:
    """Alternatives of each component given each prediction, and the log weights of the candidates.

    ``p`` (rows, 6): prediction j, component c, alternative a, P(a | j), disagreement, class of the alternative.
    ``prediction`` (n,): log weights. ``candidates`` (m, 2): prediction, log weight without the partition.
    ``chosen`` (m, C): alternative of each component.
    """
    cells, log_weights, _, log_odds, choices = kept
    counts = cells.counts(cells.readings.of_image(instance).astype(np.int64))
    components, rows = cells.alternatives(), []
    chosen = np.zeros((len(choices), len(components)), np.int64)
    log_partition = np.zeros(len(choices))
    for c, one in enumerate(components):
        wrong, alike = (
            disagreements(one.partitions, counts[one.cells]),
            classes(one.partitions, cells.sizes[one.cells]),
        )
        given = [cells.probabilities(odds, one) for odds in log_odds]
        for j, p in enumerate(given):
            a = np.arange(len(p))
            rows.append(np.column_stack([np.full((len(p), 2), (j, c)), a, p, wrong, alike]))
        named = [tuple(row) for row in one.partitions.tolist()]
        chosen[:, c] = [named.index(tuple(canonical(row).tolist())) for row in choices.partitions[:, one.cells]]
        log_partition += np.log([given[j][k] for j, k in zip(choices.prediction, chosen[:, c], strict=True)])
    return {
        "p": np.concatenate(rows) if rows else np.zeros((0, 6)),
        "prediction": log_weights,
        "candidates": np.column_stack([choices.prediction, choices.log_weights - log_partition]),
        "chosen": chosen,
    }


def cells_of(samples: Population, clip: Clip) -> Cells:
    """The cells of samples of an image."""
    readings = Readings.of(clip.after, clip.grid)
    return Cells.of(readings, [readings.labels(h.labels, 1.0) for h in samples.particles], [])


def first_pause(filter: ParticleFilter, clip: Clip, instance: np.ndarray) -> dict[str, np.ndarray]:
    """``first`` (s, 3): number of equal samples, log P of the cut, disagreement with the true labels."""
    proposal = replace(filter.proposal, weight_rule="p")  # type: ignore[type-var]
    samples = proposal.sample(np.random.default_rng(0), clip, filter.n_proposed)
    cells = cells_of(samples, clip)
    distinct, example, n = np.unique(cells.samples, axis=0, return_index=True, return_counts=True)
    counts = cells.counts(cells.readings.of_image(instance).astype(np.int64))
    # A cell without a segment is a part by itself.
    parts = np.where(distinct > 0, distinct, -1 - np.arange(distinct.shape[1]))
    return {"first": np.column_stack([n, samples.log_weights[example], disagreements(parts, counts)])}


def of_recording(family: str, seed: int, n_actions: int) -> dict[str, np.ndarray]:
    """The arrays of `of_pause` for every pause t >= 1, with names that end in the pause."""
    changes = {**SHORT, **FAMILIES[family], "n_actions": n_actions}
    recording = mstfilter.open_recording(cached_recording(family, seed, **changes))
    truth, found = RecordingTruth(recording), {}
    filter, chosen_from, selected = recorded(mstfilter.preset("mst"))
    state = filter.start(seed)
    for t, clip in enumerate(recording.clips()):
        if not t:
            found |= first_pause(filter, clip, truth.instance(0))
        selected.clear()
        state, _ = filter.step(state, clip)
        if not t:
            continue
        found |= {f"{name}_{t}": value for name, value in of_pause(chosen_from[-1], truth.instance(t)).items()}
        labels = truth.labels(t)
        ancestors = selected[-1] if selected else np.arange(len(state.population))
        index, example = np.unique(ancestors, return_index=True)
        hypotheses = [state.population.particles[k].labels for k in example]
        quality = [weighted_coverage(one, labels) for one in hypotheses]
        found[f"mutual_{t}"] = pairwise_quality(hypotheses)
        found[f"selected_{t}"] = np.column_stack([index, quality])
    return found


# Questions ------------------------------------------------------------------------------------------------------


class Question(NamedTuple):
    """Probabilities of alternatives, and which are right."""

    name: str
    p: np.ndarray  #: (k,) probabilities, sum 1
    right: np.ndarray  #: (k,) bool; at least one, and more if several are equally good


def questions(scene: dict[str, np.ndarray], temperature: float) -> Iterator[Question]:
    """The questions of one recording."""
    for t in sorted(int(name[11:]) for name in scene if name.startswith("prediction_")):
        yield from _of_pause({name: scene[f"{name}_{t}"] for name in _NAMES}, temperature)
    if len(scene["first"]) > 1:
        n, log_p, wrong = scene["first"].T
        yield Question("first", tempered(n / n.sum(), temperature), wrong == wrong.min())
        by_cut = np.exp(log_p - log_p.max())
        yield Question("first, by P(cut)", tempered(by_cut / by_cut.sum(), temperature), wrong == wrong.min())


_NAMES = ("p", "prediction", "candidates", "chosen", "selected", "mutual")


def _of_pause(kept: dict[str, np.ndarray], temperature: float) -> Iterator[Question]:
    j, c = kept["p"][:, 0].astype(int), kept["p"][:, 1].astype(int)
    w, given, best = np.exp(kept["prediction"]), [], []
    for component in range(c.max(initial=-1) + 1):
        inside = c == component
        p = np.stack([tempered(kept["p"][inside & (j == k), 3], temperature) for k in range(len(w))])
        wrong, alike = kept["p"][inside & (j == 0), 4:].T
        given.append(p)
        best.append((wrong == wrong.min(), alike.astype(int)))
        yield from _asked("component", w @ p, *best[-1])
    if any(p.shape[1] > 1 for p in given):
        rows = np.unique(np.concatenate([_most_probable([p[k] for p in given]) for k in range(len(w))]), axis=0)
        joint = np.ones((len(w), len(rows)))
        for p, chosen in zip(given, rows.T, strict=True):
            joint *= p[:, chosen]
        right = np.all([one[chosen] for (one, _), chosen in zip(best, rows.T, strict=True)], axis=0)
        classes_of = np.column_stack([alike[chosen] for (_, alike), chosen in zip(best, rows.T, strict=True)])
        right_class = np.all(
            [np.isin(alike, alike[one])[chosen] for (one, alike), chosen in zip(best, rows.T, strict=True)], axis=0
        )
        alike = np.unique(classes_of, axis=0, return_inverse=True)[1].ravel()
        p = w @ joint
        # The last alternative is all other partitions.
        p, alike = np.append(p, max(1 - p.sum(), 0)), np.append(alike, alike.max() + 1)
        yield Question("image", p, np.append(right, not right.any()))
        yield _merged("image, merged", p, np.append(right_class, not right_class.any()), alike)
    index, quality = kept["selected"][:, 0].astype(int), kept["selected"][:, 1]
    of, base = kept["candidates"][index].T
    with np.errstate(divide="ignore"):
        logs = [np.log(p[of.astype(int), kept["chosen"][index, k]]) for k, p in enumerate(given)]
    log_w = base + np.sum(logs, axis=0)
    same = connected_components(kept["mutual"] + kept["mutual"].T > 2 - 2e-9, directed=False)[1]
    near = connected_components(kept["mutual"] + kept["mutual"].T > 2 - 2 * ALIKE, directed=False)[1]
    p, best_one = np.exp(log_w - logsumexp(log_w)), quality == quality.max()
    for name, group in (("scene", same), ("scene, merged", near)):
        if group.max():
            yield _merged(name, p, best_one, group)


def _asked(name: str, p: np.ndarray, right: np.ndarray, alike: np.ndarray) -> Iterator[Question]:
    """A question about alternatives, and one about their classes."""
    if len(p) > 1:
        yield Question(name, p, right)
    if alike.max():
        yield _merged(f"{name}, merged", p, right, alike)


def _merged(name: str, p: np.ndarray, right: np.ndarray, alike: np.ndarray) -> Question:
    return Question(name, np.bincount(alike, p), np.bincount(alike, right) > 0)


def _most_probable(factors: Sequence[np.ndarray], n: int = 50) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return largest_products([np.log(p) for p in factors], n)[0]


def scores(asked: Sequence[Question]) -> dict[str, float]:
    """Mean probability of the most probable alternative, its frequency, and losses of the right alternative."""
    table = forecasts(asked)
    of_right = np.array([one.p[one.right].sum() for one in asked])
    softened = (1 - SOFTENING) * of_right + SOFTENING * np.array([one.right.mean() for one in asked])
    return {
        "n": len(asked),
        "forecast": float(table.p @ table.count / table.n),
        "frequency": float(table.yes.sum() / table.n),
        "calibration_error": diagram(table).error,
        "log_loss": float(-np.log(softened).mean()),
    }


def forecasts(asked: Sequence[Question]) -> ForecastTable:
    """The probability of the most probable alternative, and whether it is right."""
    top = [min(float(one.p.max()), 1.0) for one in asked]
    return ForecastTable.of(top, [float(one.right[one.p.argmax()]) for one in asked])


def diagram(table: ForecastTable) -> Reliability:
    """The reliability diagram on up to five bins. With one bin, the error is only the difference of the means."""
    return table.reliability(min(max(int(table.n) // PER_BIN, 1), MOST_BINS))


def held_out(losses: np.ndarray) -> tuple[float, list[float]]:
    """Mean loss of folds (f, T), each with the T of least loss on the other folds; and these T."""
    total = losses.sum(axis=0)
    best = [int(np.argmin(total - row)) for row in losses]
    return float(np.mean([row[k] for row, k in zip(losses, best, strict=True)])), [TEMPERATURES[k] for k in best]


def tables(scenes: Sequence[dict[str, np.ndarray]], out: Path) -> None:
    """reliability.csv, bins.csv and reliability.png."""
    asked = {t: [list(questions(scene, t)) for scene in scenes] for t in TEMPERATURES}
    names = sorted({one.name for scene in asked[1.0] for one in scene})
    rows, bins, diagrams = [], [], {}
    for name in names:
        losses = np.full((FOLDS, len(TEMPERATURES)), np.nan)
        for k, t in enumerate(TEMPERATURES):
            of = [[one for one in scene if one.name == name] for scene in asked[t]]
            found = scores([one for scene in of for one in scene])
            rows.append({"question": name, "temperature": t, **_rounded(found)})
            for fold in range(FOLDS):
                if of_fold := [one for scene in of[fold::FOLDS] for one in scene]:
                    losses[fold, k] = scores(of_fold)["log_loss"]
            table = diagram(forecasts([one for scene in of for one in scene]))
            diagrams[name, t] = table
            columns = zip(table.count, table.forecast, table.frequency, strict=True)
            bins += [
                {"question": name, "temperature": t, "n": int(n), **_rounded({"forecast": p, "frequency": y})}
                for n, p, y in columns
            ]
        loss, chosen = held_out(losses[np.isfinite(losses).all(axis=1)])
        rows.append(
            {"question": name, "temperature": f"held out: {min(chosen)} - {max(chosen)}", "log_loss": round(loss, 4)}
        )
    write_csv(out / "reliability.csv", rows)
    write_csv(out / "bins.csv", bins)
    draw(diagrams, out / "reliability.png")


def _rounded(row: dict[str, float]) -> dict[str, float]:
    return {name: round(float(value), 4) for name, value in row.items()}


def draw(diagrams: dict[tuple[str, float], Reliability], path: Path) -> None:
    """The reliability diagrams at two temperatures."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.style.use("mstfilter.app.report.figures")
    figure, places = plt.subplots(1, 2, figsize=(8, 4.1), sharey=True, layout="constrained")
    for place, temperature in zip(places, (1.0, 4.0), strict=True):
        place.plot([0, 1], [0, 1], color=".6", lw=1)
        for name in ("component, merged", "image, merged", "scene, merged", "first"):
            if found := diagrams.get((name, temperature)):
                label = f"{name.removesuffix(', merged')}: error {found.error:.3f}"
                place.plot(found.forecast, found.frequency, marker="o", ms=4, label=label)
        place.set(
            title=f"T = {temperature:g}", xlabel="largest probability", xlim=(0, 1), ylim=(0, 1), aspect="equal"
        )
        place.legend(loc="upper left", frameon=False, fontsize=9)
    places[0].set_ylabel("how often it is right")
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def finished(
    folder: Path, seeds: int, families: Sequence[str], compute: Callable[[str, int], dict[str, np.ndarray]]
) -> Iterator[dict[str, np.ndarray]]:
    """The arrays of each recording, which `compute` makes from family and seed and a file of the folder keeps."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(seeds):
        for family in families:
            path = folder / f"{family}-{seed}.npz"
            if not path.exists():
                try:
                    np.savez_compressed(path, **compute(family, seed))
                except InputError as error:  # the objects of some seeds cannot be arranged
                    print(path.stem, error, flush=True)
                    continue
                print(path.stem, flush=True)
            yield dict(np.load(path))


def main() -> None:
    """Run the missing recordings, then make the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=80, help="recordings of each family, seeds 0, 1, ...")
    parser.add_argument("--smoke", action="store_true", help="two recordings of two pauses; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args()
    if chosen.smoke and chosen.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    n_seeds, families, n_actions = (2, ("s1",), 2) if chosen.smoke else (chosen.seeds, FAMILIES, 9)
    compute = partial(of_recording, n_actions=n_actions)
    tables(list(finished(chosen.out / "scenes", n_seeds, families, compute)), chosen.out)


if __name__ == "__main__":
    main()

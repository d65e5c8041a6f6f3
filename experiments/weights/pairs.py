"""Which odds of pairs of cells give the right partition the largest probability?

    python experiments/weights/pairs.py [--smoke --out FOLDER]

The recordings and the definition of the right partition are those of reliability.py, the terms are those of
`PairEvidence`. `mst` runs with its own odds, so all odds are compared on the same predictions and samples. The first
eight recordings were used to choose B and C; all recordings were used to choose D and E.

terms/*.npz: probabilities of one recording (finished recordings are not run again). pairs.csv: the comparison.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from reliability import FAMILIES, SHORT, Question, classes, disagreements, finished, forecasts, recorded

import mstfilter
from mstfilter.base.files import write_csv
from mstfilter.lab.oracles.truth import RecordingTruth
from mstfilter.lab.simulation import cached_recording
from mstfilter.mst.partition import PairEvidence
from mstfilter.scoring.forecasts import SOFTENING

ODDS = {
    "A": PairEvidence(0, 1, 0, 1, 0.62, 0.96),
    "regression": PairEvidence(-0.78, 0.64, -0.87, 0.51, 0.62, 0.96),
    "B": PairEvidence(0, 1, 0, 0.51, 0.8, 0),
    "C": PairEvidence(0, 1, -0.5, 0.7, 0.8, 0),
    "D": PairEvidence(0, 1, -0.5, 0.7, 0.62, 0),
    "E": PairEvidence(0, 1, -0.5, 1, 0.62, 0),
}
N_CHOSEN, N_BINS = 8, 4


def of_recording(family: str, seed: int, n_actions: int) -> dict[str, np.ndarray]:
    """``p`` (rows, 4 + odds): component, alternative, disagreement, class, and the probability by all odds."""
    changes = {**SHORT, **FAMILIES[family], "n_actions": n_actions}
    recording = mstfilter.open_recording(cached_recording(family, seed, **changes))
    truth, rows, number = RecordingTruth(recording), [np.zeros((0, 4 + len(ODDS)))], 0
    filter, kept, _ = recorded(mstfilter.preset("mst"))
    state = filter.start(seed)
    for t, clip in enumerate(recording.clips()):
        state, _ = filter.step(state, clip)
        if not t:
            continue
        one = kept[-1]
        counts = one.cells.counts(one.cells.readings.of_image(truth.instance(t)).astype(np.int64))
        given = np.diag(one.p_valid)
        log_odds = [[odds.log_odds(one.cells, row, clip) for row in given] for odds in ODDS.values()]
        for component in one.cells.alternatives():
            partitions = component.partitions
            if len(partitions) > 1:
                p = [
                    np.exp(one.log_weights) @ np.stack([one.cells.probabilities(x, component) for x in of_odds])
                    for of_odds in log_odds
                ]
                wrong = disagreements(partitions, counts[component.cells])
                alike = classes(partitions, one.cells.sizes[component.cells])
                a = np.arange(len(wrong))
                rows.append(np.column_stack([np.full(len(a), number), a, wrong, alike, *p]))
                number += 1
    return {"p": np.concatenate(rows)}


def questions(p: np.ndarray, odds: int) -> list[tuple[Question, float]]:
    """Each component as a question about classes, and the expected excess of pairs of readings that are wrong."""
    asked = []
    for number in np.unique(p[:, 0]):
        rows = p[p[:, 0] == number]
        wrong, alike, chance = rows[:, 2], rows[:, 3].astype(int), rows[:, 4 + odds]
        if alike.max():
            right = np.bincount(alike, wrong == wrong.min()) > 0
            excess = float(chance @ (wrong - wrong.min()))
            asked.append((Question("component", np.bincount(alike, chance), right), excess))
    return asked


def table(scenes: list[np.ndarray]) -> list[dict[str, object]]:
    """A row for each of the odds, for the recordings of the choice and for the others."""
    rows = []
    for part, chosen in (("choice", scenes[:N_CHOSEN]), ("others", scenes[N_CHOSEN:]), ("all", scenes)):
        for k, name in enumerate(ODDS):
            pairs = [pair for p in chosen for pair in questions(p, k)]
            if pairs:
                asked = [one for one, _ in pairs]
                found = forecasts(asked)
                right = np.array([one.p[one.right].sum() for one in asked])
                share = np.array([one.right.mean() for one in asked])
                row = {
                    "forecast": found.p @ found.count / found.n,
                    "frequency": found.yes.sum() / found.n,
                    "calibration_error": found.reliability(N_BINS).error,
                    "log_loss": -np.log((1 - SOFTENING) * right + SOFTENING * share).mean(),
                    "wrong_pairs": np.mean([excess for _, excess in pairs]),
                }
                rounded = {key: round(float(value), 4) for key, value in row.items()}
                rows.append({"recordings": part, "odds": name, "n": len(asked), **rounded})
    return rows


def main() -> None:
    """Run the missing recordings, then compare the odds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=6, help="recordings of each family, seeds 0, 1, ...")
    parser.add_argument("--smoke", action="store_true", help="one recording of two pauses; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    n_seeds, families, n_actions = (1, ("s1",), 2) if options.smoke else (options.seeds, FAMILIES, 9)
    compute = partial(of_recording, n_actions=n_actions)
    scenes = [found["p"] for found in finished(options.out / "terms", n_seeds, families, compute)]
    write_csv(options.out / "pairs.csv", table(scenes))


if __name__ == "__main__":
    main()

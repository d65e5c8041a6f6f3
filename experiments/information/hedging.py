"""Does a forecaster gain by adding noise to its hypotheses?

    python experiments/information/hedging.py STUDY [--out FOLDER]

For every run of a study (`keep = "all"`), each hypothesis is replaced by `COPIES` copies with noise at the border: a
voxel takes the label of one of its six neighbours with probability `RATE`. Original and noisy sets are scored alike.
Writes hedging.csv, one row per arm: energy score and recalibrated log loss without and with noise, means over scenes
of all families, and the paired difference in log loss with its 95 % interval over scenes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mstfilter.files import write_csv
from mstfilter.runs import RunFolder
from mstfilter.scene import Recording
from mstfilter.scoring import LOG_LOSS, ask, leave_one_out, score_belief
from mstfilter.simulation import cache_folder
from mstfilter.statistics import compare
from mstfilter.study import RESULT, StudyFolder, open_scene

RATE, COPIES = 0.3, 2


def with_noise(labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One draw of noise at the border; beyond the grid is the voxel itself."""
    padded, inner = np.pad(labels, 1, mode="edge"), (slice(1, -1),) * 3
    border = np.zeros(labels.shape, bool)
    moved = []
    for axis in range(3):
        for step in (-1, 1):
            moved.append(np.roll(padded, step, axis)[inner])
            border |= moved[-1] != labels
    at = np.nonzero(border & (rng.random(labels.shape) < RATE))
    drawn = labels.copy()
    drawn[at] = np.stack([one[at] for one in moved])[rng.integers(6, size=len(at[0])), np.arange(len(at[0]))]
    return drawn


def main(study: Path, out: Path) -> None:
    """Score all runs and write the table."""
    folder = StudyFolder.open(study)
    sources = {scene["name"]: scene["source"] for scene in folder.description["scenes"]}
    counts: dict[tuple[str, str, bool], dict[str, np.ndarray]] = {}
    energies: dict[tuple[str, bool], dict[str, float]] = {}
    opened: dict[str, Recording] = {}
    for run in folder.description["runs"]:
        path = folder.run(run["folder"])
        if not (path / RESULT).exists() or not (path / "pauses").exists():
            continue
        name, arm = run["scene"], run["arm"]
        if name not in opened:
            opened = {name: open_scene(sources[name], str(cache_folder() / "recordings"))}
        done, rng = RunFolder.open(path), np.random.default_rng(0)
        for noisy in (False, True):
            total, energy = np.zeros(1, np.int64), []
            for t in range(1, done.n_pauses):
                hypotheses: list = list(done.hypotheses(t))
                weights = np.array(done.info(t)["weights"])
                if noisy:
                    hypotheses = [with_noise(one.labels, rng) for one in hypotheses for _ in range(COPIES)]
                    weights = np.repeat(weights, COPIES) / COPIES
                score = score_belief(ask(opened[name], t), hypotheses, weights, opened[name].truth(t))
                total, energy = total + score.counts, [*energy, score.row["energy"]]
            counts.setdefault((run["group"], arm, noisy), {})[name] = total
            energies.setdefault((arm, noisy), {})[name] = float(np.mean(energy))
    rows = []
    for arm in dict.fromkeys(arm for arm, _ in energies):
        losses: list[dict[str, float]] = []
        for noisy in (False, True):
            families = [found for (_, a, kind), found in counts.items() if (a, kind) == (arm, noisy)]
            losses.append(
                {s: fit.log_loss(found[s]) for found in families for s, fit in leave_one_out(found).items()}
            )
        d = compare(losses[1], losses[0])
        row = {"arm": arm, "n": d.n}
        for k, name in enumerate(("", "_noisy")):
            row[f"energy{name}"] = float(np.mean(list(energies[arm, bool(k)].values())))
            row[f"{LOG_LOSS}{name}"] = float(np.mean(list(losses[k].values())))
        rows.append(row | {"noisy_minus_plain": d.mean, "low": d.low, "high": d.high})
        print(rows[-1], flush=True)
    write_csv(out / "hedging.csv", rows, float_format=".4f")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    main(given.study, given.out)

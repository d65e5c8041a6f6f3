"""Candidates: after which first pushes is a scene known better, and could that have been foreseen?

    python experiments/decisions/candidates.py [--workers 2] [--smoke --out FOLDER]

At the first pause of a scene, all twelve candidate pushes are played, each from the same state, and `mst` filters
each clip with two filter seeds. candidates.csv has a row for each push: what the criteria say of it (those of
`policies.py`, and the volume of the objects that it touches in the estimate), and what it leads to: the gain of
coverage and of quality, and the fall of the log loss of the forecasts as they come and of the entropy of the belief,
both in nats.

criteria.csv has, for each criterion and each gain: `rank`, the mean over scenes of Spearman's rank correlation of the
twelve pushes; and `lead`, the gain after the push that the criterion prefers minus the mean over all twelve, which a
random choice has. The row `another seed` has the correlation of a gain with itself under the other filter seed:
more cannot be foreseen. `best` is the push with the largest gain under the first seed, scored by the second one, so
that it does not profit from chance. Intervals are 95 % t intervals over scenes.

Finished scenes are not run again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from policies import contact, doubt, expected_information, volume
from run import CHANGES, N_CANDIDATES, SMALL, measure
from scipy.stats import spearmanr

from mstfilter import Belief, preset
from mstfilter.files import write_csv, write_text
from mstfilter.simulation import FingerPush, PushLoop, scene_family
from mstfilter.smc import Key
from mstfilter.statistics import interval

CRITERIA: dict[str, Callable[[Belief, Sequence[FingerPush]], list[float]]] = {
    "information": expected_information,
    "one hypothesis": contact,
    "least sure": lambda belief, pushes: doubt(np.random.default_rng(0), belief, pushes),
    "volume": volume,
}
#: Gain -> its column of `measure`, and 1 if higher values are better.
GAINS = {"coverage": 1, "quality": 1, "log_loss": -1, "entropy": -1}


def play(family: str, seed: int, small: bool) -> list[dict[str, Any]]:
    """The rows of all candidates of a scene; gains have one value for each filter seed."""
    mst = preset("mst", *(["n=2"] if small else []))
    loop = PushLoop(replace(scene_family(family), **(SMALL if small else CHANGES)), seed)
    first, _ = mst.step(mst.start(0), loop.clip)
    before, saved = measure(loop, first)[0], loop.save()
    belief, pushes = Belief(first.population), loop.candidates(4 if small else N_CANDIDATES)
    rows: list[dict[str, Any]] = [{"scene": f"{family}-{seed}", "push": k} for k in range(len(pushes))]
    for name, criterion in CRITERIA.items():
        for row, value in zip(rows, criterion(belief, pushes), strict=True):
            row[name] = float(value)
    for row, push in zip(rows, pushes, strict=True):
        clip = loop.play(push)
        after = [measure(loop, mst.step(replace(first, key=Key(seed)), clip)[0])[0] for seed in (0, 1)]
        loop.restore(saved)
        row |= {f"gain {name}": [sign * (a[name] - before[name]) for a in after] for name, sign in GAINS.items()}
    return rows


def run(arguments: tuple[Path, str, int, bool]) -> str:
    """Play a scene and write its rows, unless that has been done."""
    folder, family, seed, small = arguments
    path = folder / "candidates" / f"{family}-{seed}.json"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(play(family, seed, small)))
    return path.name


def summarise(scenes: list[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Correlations and leads of all criteria and gains."""
    found = []
    for gain in GAINS:
        ranks: dict[str, list[float]] = {}
        leads: dict[str, list[float]] = {}
        for rows in scenes:
            gains = np.array([row[f"gain {gain}"] for row in rows])  # (push, filter seed)
            mean, (one, other) = gains.mean(axis=1), gains.T
            ranks.setdefault("another seed", []).append(_rank(one, other))
            leads.setdefault("best", []).append(float(other[one.argmax()] - other.mean()))
            for name in CRITERIA:
                values = np.array([row[name] for row in rows])
                ranks.setdefault(name, []).append(_rank(values, mean))
                leads.setdefault(name, []).append(float(mean[values == values.max()].mean() - mean.mean()))
        for score, table in (("rank", ranks), ("lead", leads)):
            for name, values in table.items():
                kept = np.array(values)[np.isfinite(values)]
                mean, (low, high) = kept.mean() if len(kept) else float("nan"), interval(kept)
                row = {"gain": gain, "score": score, "criterion": name, "n": len(kept)}
                found.append({**row, "mean": mean, "low": low, "high": high})
    return found


def _rank(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's rank correlation; NaN if all values of one are equal, as then nothing is preferred."""
    return float("nan") if np.ptp(a) == 0 or np.ptp(b) == 0 else float(spearmanr(a, b).statistic)


def main() -> None:
    """Run the study and write its tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="two small scenes; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--families", default="s1,s2,s3")
    parser.add_argument("--scenes", type=int, default=10, help="scenes of each family, seeds 0, 1, ...")
    parser.add_argument("--workers", type=int, default=1)
    chosen = parser.parse_args()
    if chosen.smoke and chosen.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    families, n_scenes = (["s1"], 2) if chosen.smoke else (chosen.families.split(","), chosen.scenes)
    jobs = [(chosen.out, family, seed, chosen.smoke) for seed in range(n_scenes) for family in families]
    with ProcessPoolExecutor(chosen.workers) as pool:
        # In a process forked off one with threads of OpenCV, OpenCV waits for these threads for ever.
        for name in (map if chosen.workers == 1 else pool.map)(run, jobs):
            print(name, flush=True)
    scenes = [json.loads(path.read_text()) for path in sorted((chosen.out / "candidates").glob("*.json"))]
    rows = [
        {k: np.mean(v) if isinstance(v, list) else v for k, v in row.items()}
        for of_scene in scenes
        for row in of_scene
    ]
    write_csv(chosen.out / "candidates.csv", rows, float_format=".4g")
    write_csv(chosen.out / "criteria.csv", summarise(scenes), float_format=".3g")


if __name__ == "__main__":
    main()

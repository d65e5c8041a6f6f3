"""How far the filters are from the exact posterior of the miniature world, and whether their ranks are uniform.

python experiments/miniature/run.py
python experiments/miniature/run.py --smoke --out DIR
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path

import numpy as np
from miniature_filters import (
    N_RANK_DRAWS,
    POSTERIOR_ERRORS,
    bootstrap_filter,
    exact_filter,
    guided_filter,
    iid_weights,
    posterior_errors,
    rank_of_truth,
    rank_uniformity,
    state_statistics,
    state_weights,
)
from miniature_mst import adapt_to_miniature, balanced_filter
from miniature_partition import fit, partition_filter
from miniature_world import Miniature
from scipy import stats

import mstfilter
from mstfilter.base.files import write_csv
from mstfilter.smc import ParticleFilter

HERE = Path(__file__).resolve().parent
WORLDS = {"shelf": Miniature((3, 2)), "row": Miniature((6, 1))}
PROPER = {"bootstrap": bootstrap_filter, "guided": guided_filter, "balanced": balanced_filter}
PRESETS = {"paper": ("p", False), "authors": ("p", True), "mst_rules": ("equal", False)}
ARMS = (*PROPER, *PRESETS, "mst")


@cache
def arm(name: str, world: Miniature, n: int, n_fit: int) -> ParticleFilter:
    """A filter by the name of its arm. Shape and pairs of `mst` are fitted to `n_fit` scenes."""
    if name in PROPER:
        return PROPER[name](world, n)
    if name in PRESETS:
        return adapt_to_miniature(mstfilter.preset(name), world, n, *PRESETS[name])
    return partition_filter(world, n, *fitted(world, n_fit))


fitted = cache(lambda world, n_scenes: fit(world, range(n_scenes)))

Errors = dict[tuple[str, str, int], list[dict[str, float]]]  # world, arm, n -> of each scene the means over steps


def distances(shape: str, plan: dict[int, int], n_steps: int, n_fit: int) -> Errors:
    """Errors of all arms in a world, with sizes n for so many scenes."""
    found, world = defaultdict(list), WORLDS[shape]
    for n, n_scenes in plan.items():
        for seed in range(n_scenes):
            truth, observations = world.simulate(np.random.default_rng([seed, 11]), n_steps)
            exact = exact_filter(world, observations).posterior
            answers = {
                "exact": exact,
                "n exact draws": [iid_weights(np.random.default_rng([seed, 12]), p, n) for p in exact],
            }
            for name in ARMS:
                steps = arm(name, world, n, n_fit).iterate(observations, seed)
                answers[name] = [state_weights(world, state.population) for state, _ in steps]
            for name, laws in answers.items():
                rows = [posterior_errors(world, p, exact[t], int(truth[t])) for t, p in enumerate(laws)]
                found[shape, name, n].append({m: float(np.mean([row[m] for row in rows])) for m in POSTERIOR_ERRORS})
        print(shape, n, n_scenes, "scenes", flush=True)
    return dict(found)


def interval(values: np.ndarray) -> tuple[float, float]:
    """Mean and half width of its 95 % t interval, of one value per scene."""
    half = stats.sem(values) * stats.t.ppf(0.975, len(values) - 1) if len(values) > 1 else np.nan
    return round(float(values.mean()), 4), round(float(half), 4)


def summarise(errors: Errors, out: Path) -> None:
    """distances.csv, and the differences of the arms by scene: paired.csv."""
    table, paired = [], []
    for (world, name, n), scenes in errors.items():
        row: dict[str, object] = {"world": world, "n": n, "arm": name, "worlds": len(scenes)}
        for m in POSTERIOR_ERRORS:
            row[m], row[f"{m}_pm"] = interval(np.array([one[m] for one in scenes]))
        table.append(row)
        for other in (*PRESETS, "mst"):
            if other != name and "exact" not in name:
                row = {"world": world, "n": n, "arm": name, "against": other}
                for m in ("tv", "same_object_error"):
                    of_other = errors[world, other, n]
                    difference = np.array([a[m] - b[m] for a, b in zip(scenes, of_other, strict=True)])
                    row[m], row[f"{m}_pm"] = interval(difference)
                paired.append(row)
    write_csv(out / "distances.csv", table)
    write_csv(out / "paired.csv", paired)


def calibrate(arms: dict[str, int], n_scenes: int, n_fit: int, out: Path, n_steps: int = 3) -> None:
    """Ranks of true scalars in the answers after some observations of the shelf."""
    world, rows = WORLDS["shelf"], []
    for name, n in arms.items():
        ranks = defaultdict(list)
        for seed in range(n_scenes):
            truth, observations = world.simulate(np.random.default_rng([seed, 13]), n_steps)
            if name == "exact":
                p = exact_filter(world, observations).posterior[-1]
            else:
                p = state_weights(world, arm(name, world, n, n_fit).run(observations, seed)[0].population)
            for statistic, scalar in state_statistics(world).items():
                rank = rank_of_truth(np.random.default_rng([seed, 14]), scalar, p, int(truth[-1]))
                ranks[statistic].append(rank)
        for statistic, found in ranks.items():
            counts = np.bincount(found, minlength=N_RANK_DRAWS + 1).tolist()
            row = {"arm": name, "n": n, "statistic": statistic, "worlds": n_scenes}
            row["p_value"] = f"{rank_uniformity(np.array(found)):.2g}"
            rows.append(row | {f"rank_{k}": c for k, c in enumerate(counts)})
        print("calibration", name, flush=True)
    write_csv(out / "calibration.csv", rows)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="two scenes, few particles: seconds; needs --out")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    options = parser.parse_args()
    if options.smoke and options.out == HERE / "results":
        parser.error("--smoke would overwrite the results: name another folder with --out")
    options.out.mkdir(parents=True, exist_ok=True)
    if options.smoke:
        plan, n_steps, n_fit, n_ranked = {5: 2, 20: 2}, 2, 2, 10
        ranked = {"exact": 0, "guided": 50, "mst": 5}
        parts = [distances(shape, plan, n_steps, n_fit) for shape in WORLDS]
    else:
        plan, n_steps, n_fit, n_ranked = {5: 100, 20: 100, 100: 50, 500: 24}, 6, 200, 400
        ranked = {"exact": 0, "bootstrap": 1000, "guided": 500, "balanced": 500}
        ranked |= dict.fromkeys((*PRESETS, "mst"), 20)
        with ProcessPoolExecutor(len(WORLDS)) as pool:
            parts = list(pool.map(partial(distances, plan=plan, n_steps=n_steps, n_fit=n_fit), WORLDS))
    summarise({key: scenes for part in parts for key, scenes in part.items()}, options.out)
    calibrate(ranked, n_ranked, n_fit, options.out)


if __name__ == "__main__":
    main()

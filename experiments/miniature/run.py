"""How far the filters are from the exact posterior of the miniature world.

python experiments/miniature/run.py [--presets]
python experiments/miniature/run.py --smoke --out DIR
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from itertools import repeat
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
from miniature_partition import (
    LoggedPairs,
    TableCompleter,
    components_apart,
    fit,
    partition_filter,
    with_likelihood,
)
from miniature_world import Miniature
from scipy import stats

import mstfilter
from mstfilter.base.files import write_csv
from mstfilter.mst.partition import PairEvidence
from mstfilter.smc import ParticleFilter

HERE = Path(__file__).resolve().parent
WORLDS = {"shelf": Miniature((3, 2)), "row": Miniature((6, 1))}
PROPER = {"bootstrap": bootstrap_filter, "guided": guided_filter, "balanced": balanced_filter}
PRESETS = {"paper": ("p", False), "authors": ("p", True), "mst_rules": ("equal", False)}
PARTITION = ("mst", "mst, likelihood")
T = 6
N_FIT = 200  # scenes to which the shapes and pairs of `mst` are fitted


@cache
def preset(name: str) -> ParticleFilter:
    """A preset, read once."""
    return mstfilter.preset(name)


@cache
def fitted(world: Miniature, n_scenes: int) -> tuple[TableCompleter, PairEvidence]:
    """Shape and pairs of `mst`, fitted once."""
    return fit(world, range(n_scenes))


def arm(name: str, world: Miniature, n: int, n_fit: int = N_FIT) -> ParticleFilter:
    """A filter by the name of its arm. What `mst` fits is fitted to `n_fit` scenes."""
    if name in PROPER:
        return PROPER[name](world, n)
    if name in PRESETS:
        return adapt_to_miniature(preset(name), world, n, *PRESETS[name])
    filter = partition_filter(world, n, *fitted(world, n_fit))
    return filter if name == "mst" else with_likelihood(world, filter)


Plan = list[tuple[tuple[str, ...], int, int]]  # arms, n, number of worlds


def distances(
    plan: Plan, steps: int = T, processes: int = len(WORLDS), n_fit: int = N_FIT
) -> list[dict[str, object]]:
    """One row per world, arm, size and step; by default one process per shape of world."""
    arguments = (list(WORLDS), repeat(plan), repeat(steps), repeat(n_fit))
    if processes == 1:
        parts = list(map(distances_of_shape, *arguments))
    else:
        with ProcessPoolExecutor(processes) as pool:
            parts = list(pool.map(distances_of_shape, *arguments))
    return [row for rows in parts for row in rows]


def distances_of_shape(shape: str, plan: Plan, n_steps: int, n_fit: int) -> list[dict[str, object]]:
    """Rows of one shape of world."""
    rows, world = [], WORLDS[shape]
    for arms, n, n_worlds in plan:
        for seed in range(n_worlds):
            truth, observations = world.simulate(np.random.default_rng([seed, 11]), n_steps)
            exact = exact_filter(world, observations).posterior
            answers: dict[str, list[np.ndarray]] = {
                "exact": list(exact),
                "n exact draws": [iid_weights(np.random.default_rng([seed, 12]), p, n) for p in exact],
            }
            for name in arms:
                steps = arm(name, world, n, n_fit).iterate(observations, seed)
                answers[name] = [state_weights(world, state.population) for state, _ in steps]
            for name, laws in answers.items():
                for t, p in enumerate(laws):
                    found = posterior_errors(world, p, exact[t], int(truth[t]))
                    rows.append({"world": shape, "arm": name, "n": n, "seed": seed, "t": t, **found})
        print(shape, n, n_worlds, "worlds", flush=True)
    return rows


def interval(values: np.ndarray) -> tuple[float, float]:
    """Mean and half width of its 95 % t interval, of one value per world."""
    if len(values) < 2:
        return float(values.mean()), float("nan")
    return float(values.mean()), float(stats.sem(values) * stats.t.ppf(0.975, len(values) - 1))


def by_world(rows: list[dict], key: Callable[[dict], tuple], measure: str) -> dict[tuple, np.ndarray]:
    """Means over steps, one per world, by key."""
    groups: dict[tuple, dict[int, list[float]]] = {}
    for row in rows:
        groups.setdefault(key(row), {}).setdefault(row["seed"], []).append(row[measure])
    return {k: np.array([np.mean(v[s]) for s in sorted(v)]) for k, v in groups.items()}


def summarise(rows: list[dict], out: Path) -> None:
    """distances.csv (over all steps), over_time.csv (tv by step), paired.csv (differences by world)."""
    table = {}
    for m in POSTERIOR_ERRORS:
        for key, values in by_world(rows, lambda r: (r["world"], r["n"], r["arm"]), m).items():
            mean, half = interval(values)
            entry = table.setdefault(key, {"world": key[0], "n": key[1], "arm": key[2], "worlds": len(values)})
            entry |= {m: round(mean, 4), f"{m}_pm": round(half, 4)}
    write_csv(out / "distances.csv", list(table.values()))

    steps = by_world(rows, lambda r: (r["world"], r["n"], r["arm"], r["t"]), "tv")
    write_csv(
        out / "over_time.csv",
        [
            {"world": w, "n": n, "arm": a, "t": t, "tv": round(interval(v)[0], 4), "tv_pm": round(interval(v)[1], 4)}
            for (w, n, a, t), v in steps.items()
        ],
    )
    paired = []
    means = {m: by_world(rows, lambda r: (r["world"], r["n"], r["arm"]), m) for m in ("tv", "same_object_error")}
    for (world, n, name), _ in means["tv"].items():
        for other in ("paper", "authors", "mst_rules", "mst"):
            if (world, n, other) not in means["tv"] or other == name or name in ("exact", "n exact draws"):
                continue
            row: dict[str, object] = {"world": world, "n": n, "arm": name, "against": other}
            for m, values in means.items():
                mean, half = interval(values[world, n, name] - values[world, n, other])
                row |= {m: round(mean, 4), f"{m}_pm": round(half, 4)}
            paired.append(row)
    write_csv(out / "paired.csv", paired)


def calibrate(arms: dict[str, int], n_worlds: int, steps: int, out: Path, n_fit: int = N_FIT) -> None:
    """Ranks of true scalars in the answers after `steps` observations of the shelf."""
    world = WORLDS["shelf"]
    scalars, rows = state_statistics(world), []
    for name, n in arms.items():
        ranks: dict[str, list[int]] = {s: [] for s in scalars}
        for seed in range(n_worlds):
            truth, observations = world.simulate(np.random.default_rng([seed, 13]), steps)
            if name == "exact":
                p = exact_filter(world, observations).posterior[-1]
            else:
                p = state_weights(world, arm(name, world, n, n_fit).run(observations, seed)[0].population)
            for s, scalar in scalars.items():
                ranks[s].append(rank_of_truth(np.random.default_rng([seed, 14]), scalar, p, int(truth[-1])))
        for s, found in ranks.items():
            counts = np.bincount(found, minlength=N_RANK_DRAWS + 1).tolist()
            row = {
                "arm": name,
                "n": n,
                "statistic": s,
                "worlds": n_worlds,
                "p_value": f"{rank_uniformity(np.array(found)):.2g}",
            }
            rows.append(row | {f"rank_{k}": c for k, c in enumerate(counts)})
        print("calibration", name, flush=True)
    write_csv(out / "calibration.csv", rows)


def resolve_apart(n_worlds: int, out: Path, n: int = 20, n_fit: int = N_FIT) -> None:
    """components.csv: the error of drawing the components of the readings apart, which `mst` does."""
    rows = []
    for shape, world in WORLDS.items():
        errors = []
        completer, pairs = fitted(world, n_fit)
        for seed in range(n_worlds):
            _, observations = world.simulate(np.random.default_rng([seed, 11]), T)
            exact = exact_filter(world, observations).posterior
            logged = LoggedPairs(pairs)
            partition_filter(world, n, completer, logged).run(observations, seed)
            of_steps = {id(cells): cells for cells, _ in logged.log}.values()  # asked for each prediction
            asked = enumerate(of_steps, start=1)  # at the first step there is no past
            errors.append(np.mean([components_apart(world, exact[t], cells, observations[t]) for t, cells in asked]))
        mean, half = interval(np.array(errors))
        rows.append({"world": shape, "n": n, "worlds": n_worlds, "tv": round(mean, 4), "tv_pm": round(half, 4)})
    write_csv(out / "components.csv", rows)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="two worlds, few particles: seconds; needs --out")
    parser.add_argument("--presets", action="store_true", help="the presets as they are: ten minutes on two cores")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    options = parser.parse_args()
    if options.smoke and options.out == HERE / "results":
        parser.error("--smoke would overwrite the results: name another folder with --out")
    options.out.mkdir(parents=True, exist_ok=True)
    every = (*PROPER, *PRESETS, *PARTITION)
    if options.presets:
        options.out = options.out / "presets"
        options.out.mkdir(exist_ok=True)
        presets = (*PRESETS, *PARTITION)
        summarise(distances([(presets, 5, 100), (presets, 20, 100), (presets, 100, 50)]), options.out)
        calibrate({"exact": 0, "mst_rules": 20, "mst": 20}, 400, 3, options.out)
        resolve_apart(100, options.out)
        return
    if options.smoke:
        plan, ranked, n_worlds = [(every, 5, 2), (tuple(PROPER), 20, 2)], {"exact": 0, "guided": 50, "mst": 5}, 10
        found = distances(plan, 2, processes=1, n_fit=2)
    else:
        plan = [(every, 5, 100), (every, 20, 100), (every, 100, 50), ((*PROPER, *PRESETS, "mst"), 500, 24)]
        ranked = {"exact": 0, "bootstrap": 1000, "guided": 500, "balanced": 500, "paper": 20, "authors": 20}
        ranked |= {"mst_rules": 20, "mst": 20}
        n_worlds = 400
        found = distances(plan)
    summarise(found, options.out)
    n_fit = 2 if options.smoke else N_FIT
    calibrate(ranked, n_worlds, 3, options.out, n_fit)
    resolve_apart(2 if options.smoke else 100, options.out, n_fit=n_fit)
    from figure import draw

    draw(options.out)


if __name__ == "__main__":
    main()

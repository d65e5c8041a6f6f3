"""All resampling schemes on models with known answers and on candidates of MST.

    python experiments/resampling/run.py [--smoke] [--out results]

Finished parts are stored in OUT/parts; the same command runs the missing ones.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from populations import Candidates, choose, of_world, real, simulated
from schemes import BASE, schemes
from scipy import stats
from worlds import World, branching, plain, worlds

from mstfilter.errors import InputError
from mstfilter.files import read_csv, write_csv
from mstfilter.smc import ExactEquality, Gaussian, ParticleFilter, Population

HERE = Path(__file__).resolve().parent
Row = dict[str, object]
FIELDS = ("part", "setting", "scheme", "measure", "unit", "value")
FULL = {"seeds": 500, "reference": 50_000, "populations": 30, "draws": 50, "scenes": 20, "eta": 5, "rounds": 8}
SMOKE = {"seeds": 2, "reference": 500, "populations": 2, "draws": 3, "scenes": 1, "eta": 1, "rounds": 1}


def filtered(name: str, world: World, setting: str, size: dict[str, int]) -> Iterator[Row]:
    """A filter of a model with every scheme; a unit is a seed, with the same data for all schemes."""
    arms = schemes(world.similarity, world.equivalence)
    make, full, small = {"plain": (plain, world.sizes[0], 12), "branching": (branching, world.sizes[1], 5)}[setting]
    n = full if size is FULL else small
    for scheme, resampler in arms.items():
        filter = make(world, resampler, n)
        for seed in range(size["seeds"]):
            found = one_run(world, filter, seed)
            yield from rows(name, f"{setting} n={n}", scheme, seed, found)


def one_run(world: World, filter: ParticleFilter, seed: int) -> dict[str, float]:
    """Measures of a run."""
    data, state = world.data(seed), None
    errors, unique, fallbacks = [], [], []
    try:
        for state, info in filter.iterate(data.observations, seed):
            errors.append(world.error(state.population, data.answers[info.t]))
            if info.resampled:
                before = filter.resample == "before"
                unique.append(info.unique_ancestors if before else len(np.unique(info.ancestors)))
                note = info.notes.get("resampler", {}).get("kdpp")
                fallbacks += [] if note is None else [note.endswith("fallback")]
    except InputError:  # no particle explains what is seen: the run is lost, its evidence is 0
        return {"lost": 1.0} | ({"evidence_ratio": 0.0} if filter.properly_weighted else {})
    found = {"lost": 0.0, "state_error": float(np.mean(errors))}
    if unique:
        found["unique_ancestors"] = float(np.mean(unique))
    if fallbacks:
        found["fallback"] = float(np.mean(fallbacks))
    if state is not None and state.log_evidence is not None:
        found["log_evidence_error"] = state.log_evidence - data.log_evidence
        found["evidence_ratio"] = float(np.exp(found["log_evidence_error"]))
    return found


def rows(part: str, setting: str, scheme: str, unit: int, found: dict[str, float]) -> Iterator[Row]:
    """One row per measure."""
    for measure, value in found.items():
        yield dict(zip(FIELDS, (part, setting, scheme, measure, unit, value), strict=True))


def chosen(part: str, setting: str, unit: int, candidates: Candidates, n: int, draws: int) -> Iterator[Row]:
    """Measures of one population."""
    for scheme, found in choose(candidates, n, draws, unit).items():
        yield from rows(part, setting, scheme, unit, found)


def from_worlds(all_worlds: dict[str, World], size: dict[str, int]) -> Iterator[Row]:
    """Candidates of the four models; a unit is a population."""
    for name, world in all_worlds.items():
        for seed in range(size["populations"]):
            n = world.sizes[1] if size is FULL else 5
            yield from chosen(f"select: {name}", "4 n to n", seed, of_world(world, n, 5000 + seed), n, size["draws"])


def from_real(size: dict[str, int]) -> Iterator[Row]:
    """The real candidates; a unit is a batch of draws, so intervals cover the draws only."""
    candidates = real(size["eta"])
    if candidates is None:
        print("real candidates left out: no folder r1 (MSTFILTER_SHARED names the folder that holds it)")
        return
    for batch in range(size["populations"]):
        m = len(candidates.log_weights)
        yield from chosen("select: real", f"{m} to 5", batch, candidates, 5, size["draws"])


def from_scene(seed: int, size: dict[str, int]) -> Iterator[Row]:
    """Candidates of a simulated scene, of each filter; a unit is a scene."""
    for name, candidates in simulated(seed, small=size is SMOKE).items():
        yield from chosen("select: simulated", f"candidates of {name} to 5", seed, candidates, 5, size["draws"])


def timed(size: dict[str, int]) -> Iterator[Row]:
    """Time per call relative to systematic in the same round; the schemes run in turns."""
    for m, n in ((100, 20), (1000, 250)):
        rng = np.random.default_rng(m)
        population = Population(rng.normal(size=m), rng.normal(size=m))
        arms = schemes(Gaussian(0.1), ExactEquality())
        for unit in range(size["rounds"]):
            seconds = {}
            for scheme, resampler in arms.items():
                best = np.inf  # the shortest of three: the machine has other work
                for _ in range(3 if m == 100 else 2):
                    start = time.perf_counter()
                    resampler.resample(np.random.default_rng(unit), population, n)
                    best = min(best, time.perf_counter() - start)
                seconds[scheme] = best
            for scheme, value in seconds.items():
                yield from rows("time", f"{m} to {n}", scheme, unit, {"relative_time": value / seconds[BASE]})


def interval(values: np.ndarray) -> tuple[float, float, float]:
    """Mean and its 95 % t interval."""
    mean = float(values.mean())
    if len(values) < 2:
        return mean, float("nan"), float("nan")
    half = float(stats.sem(values) * stats.t.ppf(0.975, len(values) - 1))
    return mean, mean - half, mean + half


def p_value(difference: np.ndarray) -> float:
    """p value of a paired t test that the mean difference is zero."""
    error = stats.sem(difference) if len(difference) > 1 else np.nan
    if not error > 0:  # one unit, or the same difference in all of them
        return 0.0 if error == 0 and difference[0] != 0 else 1.0
    return float(2 * stats.t.sf(abs(difference.mean()) / error, len(difference) - 1))


def holm(p: np.ndarray, level: float = 0.05) -> np.ndarray:
    """Which hypotheses of a family are rejected at a level for all of them together (Holm 1979)."""
    order = np.argsort(p, kind="stable")
    below = p[order] <= level / np.arange(len(p), 0, -1)
    rejected = np.zeros(len(p), bool)
    rejected[order] = np.cumprod(below).astype(bool)
    return rejected


def summarise(found: list[dict[str, str]], out: Path) -> None:
    """summary.csv: means with intervals, paired differences from systematic, and what can be claimed."""
    table: dict[tuple[str, str, str], dict[str, dict[int, float]]] = {}
    for r in found:
        key = (r["part"], r["setting"], r["measure"])
        table.setdefault(key, {}).setdefault(r["scheme"], {})[int(r["unit"])] = float(r["value"])
    for part, setting, measure in [k for k in table if k[2] == "log_evidence_error"]:
        errors = table[part, setting, measure]
        centre = {s: np.mean(list(v.values())) for s, v in errors.items()}
        table[part, setting, "log_evidence_variance"] = {
            s: {u: (e - centre[s]) ** 2 * len(v) / max(len(v) - 1, 1) for u, e in v.items()}
            for s, v in errors.items()
        }
    lines = []
    for (part, setting, measure), by_scheme in sorted(table.items()):
        base, group = by_scheme.get(BASE, {}), []
        for scheme, values in by_scheme.items():
            mean, low, high = interval(np.array(list(values.values())))
            both = [u for u in values if u in base] if scheme != BASE else []
            line = {"part": part, "setting": setting, "measure": measure, "scheme": scheme, "units": len(values)}
            line |= {"mean": f"{mean:.4g}", "low": f"{low:.4g}", "high": f"{high:.4g}", "paired_units": len(both)}
            line |= {"minus_systematic": "", "diff_low": "", "diff_high": "", "claim": ""}
            if both:
                difference = np.array([values[u] - base[u] for u in both])
                d, d_low, d_high = interval(difference)
                line |= {"minus_systematic": f"{d:.4g}", "diff_low": f"{d_low:.4g}", "diff_high": f"{d_high:.4g}"}
                group.append((line, d, p_value(difference)))
            lines.append(line)
        for (line, d, _), certain in zip(group, holm(np.array([p for _, _, p in group])), strict=True):
            line["claim"] = ("higher" if d > 0 else "lower") if certain else "no difference can be claimed"
    write_csv(out / "summary.csv", lines)


def main() -> None:
    """Run the missing parts, then summarise and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="tiny, a few seconds; needs --out")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    parser.add_argument("--only", default="", help="parts whose names begin so (to share work between processes)")
    options = parser.parse_args()
    size = SMOKE if options.smoke else FULL
    if options.smoke and options.out == HERE / "results":
        parser.error("--smoke would overwrite the results: name another folder with --out")
    everything = worlds(size["reference"])
    parts: dict[str, Callable[[], Iterator[Row]]] = {
        f"{setting}-{name}": lambda name=name, world=world, setting=setting: filtered(name, world, setting, size)
        for setting in ("plain", "branching")
        for name, world in everything.items()
    }
    parts |= {"select-worlds": lambda: from_worlds(everything, size), "select-real": lambda: from_real(size)}
    for seed in range(size["scenes"]):
        parts[f"select-demo-{seed}"] = lambda seed=seed: from_scene(seed, size)
    parts["time"] = lambda: timed(size)
    folder = options.out / "parts"
    folder.mkdir(parents=True, exist_ok=True)
    for name, part in parts.items():
        path = folder / f"{name}.csv"
        if name.startswith(options.only) and not path.exists():
            start = time.perf_counter()
            write_csv(path, part(), FIELDS)
            print(f"{name}  {time.perf_counter() - start:.0f} s", flush=True)
    missing = [name for name in parts if not (folder / f"{name}.csv").exists()]
    if missing:
        print("missing parts:", ", ".join(missing))
    summarise([row for name in parts if name not in missing for row in read_csv(folder / f"{name}.csv")], options.out)
    from figure import draw

    draw(options.out)


if __name__ == "__main__":
    main()

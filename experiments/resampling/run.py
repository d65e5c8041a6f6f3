"""All resampling schemes on models with known answers and on real candidates of MST.

    python experiments/resampling/run.py [--smoke] [--out results]

Finished parts are stored in OUT/parts; the same command runs the missing parts. Measures of every scheme are compared
with `systematic`, paired by unit.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import numpy as np
from populations import Candidates, choose, of_world, real
from schemes import BASE, schemes
from worlds import World, branching, plain, worlds

from mstfilter.base.files import read_csv, write_csv
from mstfilter.scoring.statistics import compare_arms, conclusion, interval
from mstfilter.smc import ExactEquality, Gaussian, Population, log_evidence, run_many

HERE = Path(__file__).resolve().parent
Row = dict[str, object]
FIELDS = ("part", "setting", "scheme", "measure", "unit", "value")
FULL = {"seeds": 500, "reference": 50_000, "populations": 20, "draws": 30, "eta": 5, "rounds": 8}
#: Measures that are compared with systematic.
COMPARED = (
    "state_error",
    "log_evidence_variance",
    "energy_distance",
    "offspring_variance",
    "mass_error",
    "diversity",
    "best_of_n",
    "mean_quality",
)
SMOKE = {"seeds": 2, "reference": 500, "populations": 2, "draws": 3, "eta": 1, "rounds": 1}


def filtered(name: str, world: World, setting: str, size: dict[str, int]) -> Iterator[Row]:
    """Errors of the filter of one model with every scheme. A unit is a seed, with the same data for all schemes.

    Errors are absolute errors of a mean, or total variation distances of a distribution, averaged over the steps.
    """
    left_out = ("kdpp",) if setting == "plain" else ()  # it keeps all, as fearnhead_clifford does
    make, full, small = {"plain": (plain, world.sizes[0], 12), "branching": (branching, world.sizes[1], 5)}[setting]
    n = full if size is FULL else small
    seeds = range(size["seeds"])
    data = [world.data(seed) for seed in seeds]
    answers, exact = np.array([d.answers for d in data]), np.array([d.log_evidence for d in data])
    arms = schemes(world.similarity, world.equivalence)
    for scheme, resampler in arms.items():
        if scheme in left_out:
            continue
        filter = make(world, resampler, n)
        collectors = {"z": log_evidence, "estimate": lambda state, info: world.estimate(state.population)}
        runs = [run_many(filter, d.observations, [seed], **collectors) for seed, d in zip(seeds, data, strict=True)]
        errors = np.abs(np.concatenate([run["estimate"] for run in runs]) - answers)
        errors = errors if errors.ndim == 2 else 0.5 * errors.sum(axis=2)
        found = {"lost": np.array([bool(run.lost) for run in runs]), "state_error": errors.mean(axis=1)}
        if filter.properly_weighted:
            found["log_evidence_error"] = np.array([run["z"][0, -1] for run in runs]) - exact
            found["evidence_ratio"] = np.exp(found["log_evidence_error"])
        for seed in seeds:
            mine = {measure: float(values[seed]) for measure, values in found.items()}
            yield from rows(name, f"{setting} n={n}", scheme, seed, mine)


def rows(part: str, setting: str, scheme: str, unit: int, found: dict[str, float]) -> Iterator[Row]:
    """One row per finite measure; a run whose weights all became zero has no errors."""
    for measure, value in ((m, v) for m, v in found.items() if np.isfinite(v)):
        yield dict(zip(FIELDS, (part, setting, scheme, measure, unit, value), strict=True))


def chosen(part: str, setting: str, unit: int, candidates: Candidates, n: int, draws: int) -> Iterator[Row]:
    """Measures of every scheme on one population."""
    for scheme, found in choose(candidates, n, draws, unit).items():
        yield from rows(part, setting, scheme, unit, found)


def from_worlds(all_worlds: dict[str, World], size: dict[str, int]) -> Iterator[Row]:
    """Measures on populations that filters of the four models resample; a unit is a population."""
    for (name, world), (k, make) in product(all_worlds.items(), enumerate((plain, branching))):
        for seed in range(size["populations"]):
            n = world.sizes[k] if size is FULL else (12, 5)[k]
            found = of_world(world, make, n, 5000 + seed)
            if found is not None:
                yield from chosen(f"select: {name}", ("n to n", "4 n to n")[k], seed, found, n, size["draws"])


def from_real(size: dict[str, int]) -> Iterator[Row]:
    """Measures on the real candidates; a unit is a batch of draws, so intervals show only the variation of draws."""
    candidates = real(size["eta"])
    if candidates is None:
        print("real candidates left out: no folder r1 (MSTFILTER_SHARED names the folder that holds it)")
        return
    for unit in range(size["populations"]):
        m = len(candidates.population)
        yield from chosen("select: real", f"{m} to 5", unit, candidates, 5, size["draws"])


def timed(size: dict[str, int]) -> Iterator[Row]:
    """Time per call relative to systematic in the same round; the schemes run alternately."""
    for m, n in ((100, 20), (1000, 250)) if size is FULL else ((100, 20),):
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


def summarise(found: list[dict[str, str]], out: Path) -> None:
    """Write summary.csv: means with intervals, paired differences from systematic, and conclusions."""
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
        compared = compare_arms(by_scheme, BASE) if measure in COMPARED and BASE in by_scheme else {}
        for scheme, values in by_scheme.items():
            line: Row = {"part": part, "setting": setting, "measure": measure, "scheme": scheme, "units": len(values)}
            array = np.array(list(values.values()))
            line |= dict(zip(("mean", "low", "high"), map(short, (array.mean(), *interval(array))), strict=True))
            line |= dict.fromkeys(("minus_systematic", "diff_low", "diff_high", "p_holm", "conclusion"), "")
            if scheme in compared:
                d = compared[scheme]
                line |= {"minus_systematic": short(d.mean), "diff_low": short(d.low), "diff_high": short(d.high)}
                line |= {"p_holm": short(d.p_holm), "conclusion": conclusion(d, scheme, BASE, unit="unit")}
            lines.append(line)
    write_csv(out / "summary.csv", lines)


def short(value: float) -> str:
    """A number as text with four significant digits."""
    return f"{value:.4g}"


def main() -> None:
    """Run the missing parts, then summarise and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="tiny, a few seconds; needs --out")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    parser.add_argument("--only", default="", help="run parts whose names begin so, without a summary")
    options = parser.parse_args()
    size = SMOKE if options.smoke else FULL
    if options.smoke and options.out == HERE / "results":
        parser.error("--smoke would overwrite the results: name another folder with --out")
    everything = worlds(size["reference"])
    parts: dict[str, Callable[[], Iterator[Row]]] = {
        f"{setting}-{name}": lambda name=name, world=world, setting=setting: filtered(name, world, setting, size)
        for setting in ("plain", "branching")
        for name, world in everything.items()
        if (setting, name) != ("branching", "miniature_mst")  # there the filter limits the result
    }
    parts |= {"select-worlds": lambda: from_worlds(everything, size), "select-real": lambda: from_real(size)}
    parts["time"] = lambda: timed(size)
    folder = options.out / "parts"
    folder.mkdir(parents=True, exist_ok=True)
    for name, part in parts.items():
        path = folder / f"{name}.csv"
        if name.startswith(options.only) and not path.exists():
            start = time.perf_counter()
            write_csv(path, part(), FIELDS)
            print(f"{name}  {time.perf_counter() - start:.0f} s", flush=True)
    if options.only:
        return
    missing = [name for name in parts if not (folder / f"{name}.csv").exists()]
    if missing:
        print("missing parts:", ", ".join(missing))
    summarise([row for name in parts if name not in missing for row in read_csv(folder / f"{name}.csv")], options.out)
    from figure import draw

    draw(options.out)


if __name__ == "__main__":
    main()

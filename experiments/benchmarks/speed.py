"""Compare the speed of the filter with that of other programs, interleaved; writes speed.csv and evidence.csv.

README.md has the command.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from loop import bootstrap_loop

from mstfilter.base.files import write_csv
from mstfilter.smc import (
    Always,
    Killing,
    Multinomial,
    Normal,
    ParticleFilter,
    Population,
    Program,
    Proposal,
    Residual,
    Reweight,
    Ssp,
    StateSpaceModel,
    Stratified,
    Systematic,
    Transition,
    bootstrap,
    observe,
    sample,
)

RHO, SIGMA, TAU = 0.9, 0.6, 0.4
SD0 = SIGMA / math.sqrt(1 - RHO**2)
HERE = Path(__file__).parent
MODEL = StateSpaceModel.of(Normal(0.0, SD0), lambda x: Normal(RHO * x, SIGMA), lambda x: Normal(x, TAU))
MU, RHO_SV, SIGMA_SV = -1.0, 0.95, 0.3
VOLATILITY = StateSpaceModel.of(
    Normal(MU, SIGMA_SV / math.sqrt(1 - RHO_SV**2)),
    lambda x: Normal(MU + RHO_SV * (x - MU), SIGMA_SV),
    lambda x: Normal(0.0, np.exp(0.5 * x)),
)
#: Models and numbers of particles that are compared with `particles`, with the ratio to reach.
SIZES = {("AR(1)", 10): "<= 1"} | {
    (name, n): f"<= {target}"
    for name in ("AR(1)", "SV")
    for n, target in ((1_000, 0.85), (10_000, 0.6), (100_000, 0.55))
}

SCHEMES = {
    "systematic": Systematic(),
    "stratified": Stratified(),
    "multinomial": Multinomial(),
    "residual": Residual(),
    "ssp": Ssp(),
    "killing": Killing(),
}
MILLION = 1_000_000


def program(previous, y):
    """The AR(1) model as a probabilistic program."""
    x = sample("x", Normal(0.0, SD0) if previous is None else Normal(RHO * previous["x"], SIGMA))
    observe("y", Normal(x, TAU), y)


def data(T: int, model: StateSpaceModel = MODEL) -> list[float]:
    """T observations simulated from a model."""
    return model.simulate(T, seed=4)[1].tolist()


@dataclass(frozen=True)
class Box:
    """A particle that is a Python object."""

    weight: int


class Boxes(Proposal):
    """Proposes new particles that are Python objects."""

    def sample(self, rng, observation, n):
        return Population(tuple(map(Box, range(n))))


class Stay(Transition):
    """Keeps every particle."""

    def predict(self, rng, population, observation):
        return Population(population.particles, population.log_weights, population.parents)


CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}


def timed(work, clock=time.perf_counter) -> float:
    """Seconds that a call takes."""
    start = clock()
    work()
    return clock() - start


def log_evidence_of(filter: ParticleFilter, ys: list[float], seed: int) -> float:
    """Log evidence of a run that keeps no history, like the loop and `particles`."""
    last = deque(filter.iterate(ys, seed), maxlen=1)
    return last[0][0].log_evidence


def main() -> None:
    """Run all programs in random order in every round and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peers", type=Path, help="python of the environment that has particles 0.4")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--clock", choices=CLOCKS, default="wall", help="cpu: processor time of the process")
    parser.add_argument("--smoke", action="store_true", help="one round without peers; needs --out")
    options = parser.parse_args()
    if options.smoke:
        if options.out == HERE:
            parser.error("--smoke would overwrite the results: name another folder with --out")
        options.rounds, options.peers = 1, None
    ys, n = data(100), 10_000
    time_of = partial(timed, clock=CLOCKS[options.clock])
    worker = None
    if options.peers:
        described = json.dumps(
            {"rho": RHO, "sigma": SIGMA, "tau": TAU, "ys": ys, "clock": options.clock}
            | {"volatility": {"mu": MU, "rho": RHO_SV, "sigma": SIGMA_SV}, "volatility_ys": data(100, VOLATILITY)}
        )
        worker = subprocess.Popen(
            [str(options.peers), str(HERE / "peers_worker.py"), described],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def peer(what: str, seed: int, size: int) -> dict:
        worker.stdin.write(f"{what} {seed} {size}\n")
        worker.stdin.flush()
        return json.loads(worker.stdout.readline())

    arrays, programs = bootstrap(MODEL, n), Program(program).bootstrap(n)
    volatilities = data(100, VOLATILITY)
    sized = {
        (name, size): (bootstrap(MODEL, size), ys) if name == "AR(1)" else (bootstrap(VOLATILITY, size), volatilities)
        for name, size in SIZES
    }
    objects = ParticleFilter(
        initial=Boxes(),
        transition=Stay(),
        update=Reweight(lambda particles, y: np.array([0.1 * box.weight for box in particles])),
        trigger=Always(),
        n=5,
    )
    even = np.log(np.random.default_rng(0).uniform(0.5, 1.5, MILLION))

    def resampling(name: str, seed: int) -> float:
        rng = np.random.default_rng(seed)
        return time_of(lambda: SCHEMES[name].select(rng, even, MILLION))

    order = np.random.default_rng(0)

    def one_round(seed: int) -> dict[str, float]:
        work = {
            "loop": lambda: time_of(lambda: bootstrap_loop(np.random.default_rng(seed), ys, n, RHO, SIGMA, TAU)),
            "arrays": lambda: time_of(lambda: log_evidence_of(arrays, ys, seed)),
            "arrays_kept": lambda: time_of(lambda: arrays.run(ys, seed)),
            "program": lambda: time_of(lambda: log_evidence_of(programs, ys, seed)),
            "step_of_5_objects": lambda: time_of(lambda: objects.run(range(200), seed)) / 200,
        }
        for (name, size), (filter, data) in sized.items():
            key = f"{name} n={size}"
            work[key] = lambda filter=filter, data=data: time_of(lambda: log_evidence_of(filter, data, seed))
            if worker:
                what = "filter" if name == "AR(1)" else "volatility"
                work[f"particles {key}"] = lambda what=what, size=size: peer(what, seed, size)["seconds"]
        names = list(work)
        order.shuffle(names)  # the memory state that one program leaves affects the next
        return {name: work[name]() for name in names}

    arrays.run(ys[:1])  # the first run of a filter sets what the allocator keeps
    big_rows: list[dict] = []
    for seed in range(options.rounds + 1):  # the first round compiles
        big_rows.append({})
        for name in SCHEMES:
            big_rows[-1][name] = resampling(name, seed)
            if worker:
                for peers_name in (name, f"log:{name}"):
                    big_rows[-1][f"particles {peers_name}"] = peer(peers_name, seed, MILLION)["seconds"]
    big_rows = big_rows[1:]
    rows = [one_round(seed) for seed in range(options.rounds + 2)][2:]  # two warm-up rounds
    for row, big_row in zip(rows, big_rows, strict=True):
        row.update(big_row)
    median = {name: float(np.median([r[name] for r in rows])) for name in rows[0]}

    def ratio(a: str, b: str) -> str:
        """Median over the rounds of the ratio a / b in one round."""
        if a not in rows[0] or b not in rows[0]:
            return "not measured"
        return f"{np.median([r[a] / r[b] for r in rows]):.2f}"

    def of_minima(a: str, b: str) -> str:
        """Ratio of the shortest times of a and b, which other programs on the machine disturb least."""
        if a not in rows[0] or b not in rows[0]:
            return "not measured"
        return f"{min(r[a] for r in rows) / min(r[b] for r in rows):.2f}"

    def ratios(what: str, a: str, b: str, target: str) -> tuple[str, str, str, str, str]:
        return what, "ratio", ratio(a, b), of_minima(a, b), target

    def milliseconds(what: str, a: str, target: str = "") -> tuple[str, str, str, str, str]:
        return what, "ms", f"{1e3 * median[a]:.3f}", f"{1e3 * min(r[a] for r in rows):.3f}", target

    table = [
        milliseconds("bootstrap AR(1) T=100 n=1e4: minimal numpy loop", "loop"),
        milliseconds("the same with array components", "arrays"),
        milliseconds("the same, infos of all steps kept (run)", "arrays_kept"),
        milliseconds("the same as a program", "program"),
        ratios("array components / minimal loop", "arrays", "loop", "<= 1.3"),
        ratios("program / array components", "program", "arrays", "<= 1.5"),
        *(
            ratios(
                f"bootstrap {name} T=100 n={n} / particles 0.4", f"{name} n={n}", f"particles {name} n={n}", target
            )
            for (name, n), target in SIZES.items()
        ),
        milliseconds("a step with 5 object particles", "step_of_5_objects", "<= 0.5"),
    ]
    for name in SCHEMES:
        table += [
            milliseconds(f"{name} n=1e6", name),
            ratios(f"{name} n=1e6 / particles, same log weights", name, f"particles log:{name}", "<= 1"),
            ratios(f"{name} n=1e6 / particles, given normalised weights", name, f"particles {name}", "<= 1"),
        ]
    columns = ("what", "unit", "median", "of_minima", "target", "clock")
    write_csv(options.out / "speed.csv", [dict(zip(columns, (*row, options.clock), strict=True)) for row in table])
    for row in table:
        print(f"{row[0]:56s} {row[2]:>12s} {row[3]:>12s} {row[1]:6s} {row[4]}")
    if worker:
        worker.stdin.close()
        worker.wait()
        compare_evidence(options, ys[:20])


def compare_evidence(options: argparse.Namespace, ys: list[float]) -> None:
    """Write the standard deviation of the log evidence of both libraries: T = 20, n = 200, 1000 seeds."""
    described = json.dumps({"rho": RHO, "sigma": SIGMA, "tau": TAU, "ys": ys})
    seeds, n = range(1000), 200
    answer = subprocess.run(
        [str(options.peers), str(HERE / "peers_worker.py"), described],
        input="".join(f"filter {s} {n}\n" for s in seeds),
        capture_output=True,
        text=True,
        check=True,
    )
    theirs = [json.loads(line)["log_evidence"] for line in answer.stdout.splitlines()]
    ours = [bootstrap(MODEL, n).run(ys, s)[0].log_evidence for s in seeds]
    rows = []
    for name, logs in (("mstfilter", ours), ("particles 0.4", theirs)):
        mean, sd = np.mean(logs), np.std(logs, ddof=1)
        row = {"filter": name, "T": len(ys), "n": n, "seeds": len(logs)}
        rows.append(row | {"mean_log_evidence": f"{mean:.6f}", "sd_log_evidence": f"{sd:.6f}"})
        print(f"{name:15s} mean {mean:.4f} sd {sd:.4f}")
    write_csv(options.out / "evidence.csv", rows)


if __name__ == "__main__":
    main()

"""Compare backward sampling of this package and of `particles` 0.4, interleaved; writes smoothing.csv.

README.md has the command.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from pathlib import Path

import numpy as np
from speed import HERE, MODEL, RHO, SD0, SIGMA, TAU, data

from mstfilter.base.files import write_csv
from mstfilter.smc import Dynamics, backward_paths, bootstrap, genealogy, keep
from mstfilter.smc.models.exact import kalman_filter

#: Ours by name, with the method of `particles` that does the same.
METHODS = {
    "exact": ({}, "ON2"),
    "mcmc": ({"method": "mcmc"}, "mcmc"),
    "mcmc, 3 steps": ({"method": "mcmc", "steps": 3}, None),
    "rejection": ({"method": "rejection", "log_bound": -float(np.log(SIGMA * np.sqrt(2 * np.pi)))}, "reject"),
}


def smoothed(ys: list[float]) -> np.ndarray:
    """Exact smoothed means (T,)."""
    return kalman_filter([[RHO]], [[SIGMA**2]], [[1.0]], [[TAU**2]], [0.0], [[SD0**2]], ys).smoothed_means[:, 0]


def main() -> None:
    """Time N paths of a filter of N particles, for each method, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peers", type=Path, help="python of the environment that has particles 0.4")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--out", type=Path, default=HERE / "smoothing.csv")
    parser.add_argument("--smoke", action="store_true", help="one small round without peers; needs --out")
    options = parser.parse_args()
    if options.smoke and options.out == HERE / "smoothing.csv":
        parser.error("--smoke would overwrite the results: name another file with --out")
    rounds, sizes, worker = (1, (20,), None) if options.smoke else (options.rounds, (500, 2_000), None)
    ys = data(50)
    if options.peers and not options.smoke:
        model = json.dumps({"rho": RHO, "sigma": SIGMA, "tau": TAU, "ys": ys, "clock": "cpu"})
        command = [str(options.peers), str(HERE / "peers_worker.py"), model]
        worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def peer(method: str, seed: int, n: int) -> dict:
        worker.stdin.write(f"backward:{method} {seed} {n}\n")
        worker.stdin.flush()
        return json.loads(worker.stdout.readline())

    rows = []
    for n in sizes:
        found: dict[str, list[tuple[float, np.ndarray, float, np.ndarray]]] = {name: [] for name in METHODS}
        traced = []
        for seed in range(rounds + 1):
            record = keep(bootstrap(MODEL, n), ys, seed)
            traced.append([p.weights @ p.particles for p in genealogy(record)])
            for name, (settings, theirs) in METHODS.items():
                rng = np.random.default_rng(seed)
                start = time.process_time()
                paths = backward_paths(rng, record, Dynamics(MODEL), n, **settings)
                seconds, means = time.process_time() - start, [p.particles.mean() for p in paths]
                # Theirs takes O(n^2) calls of Python with this method, so it runs in fewer rounds.
                answer = peer(theirs, seed, n) if worker and theirs and (theirs != "ON2" or seed < 2) else {}
                found[name].append((seconds, means, answer.get("seconds", np.nan), answer.get("means", np.nan)))
        exact = smoothed(ys)

        def error(means: list, exact: np.ndarray = exact) -> float:
            """Root mean square error of the smoothed means over times and rounds."""
            return float(np.sqrt(np.mean(np.square(np.array(means) - exact))))

        for name, runs in found.items():
            ours, means, theirs, their_means = zip(*(runs[1:] or runs), strict=True)  # the first round compiles
            theirs, kept = np.array(theirs), [m for m in their_means if not np.isscalar(m)]
            row = {
                "N": n,
                "method": name,
                "ms": 1e3 * np.median(ours),
                "particles_ms": 1e3 * np.nanmedian(theirs) if kept else "",
                "ratio": np.nanmedian(np.array(ours) / theirs) if kept else "",
                "rms_error": error(means),
                "particles_rms_error": error(kept) if kept else "",
            }
            rows.append({key: f"{v:.4g}" if isinstance(v, float) else v for key, v in row.items()})
        rows.append({"N": n, "method": "genealogy", "rms_error": f"{error(traced):.4g}"})
    write_csv(options.out, rows, list(rows[0]))
    for row in rows:
        print(*row.values(), sep="\t")


if __name__ == "__main__":
    main()

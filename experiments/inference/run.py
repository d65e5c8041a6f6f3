"""Do PMMH and particle Gibbs have the exact posterior of a linear-Gaussian model? Simulation-based calibration.

    python experiments/inference/run.py [--smoke] [--out FOLDER]

Parameters (rho, sigma) are drawn from the prior and T observations from the model

    x_0 ~ N(0, 1),  x_t = rho x_{t-1} + N(0, sigma^2),  y_t = x_t + N(0, 0.4^2),
    rho ~ N(0.5, 0.3^2),  1 / sigma^2 ~ Gamma(3, rate 1).

If a chain has the exact posterior, the rank of the true parameter among L independent posterior draws is uniform on
0 .. L (Talts, Betancourt, Simpson, Vehtari, Gelman 2018). Each chain starts at a new draw from the prior; the first
iterations are dropped and the rest is thinned. The filters have few particles, so that an error is visible. The
control is particle Gibbs in which an ordinary filter of the same size, instead of conditional SMC, draws the paths.

Writes results/ranks.csv, one row per data set and method, and results/summary.csv with chi-square tests of ten bins.
Finished data sets are not run again.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import stats

from mstfilter.base.files import read_csv, write_csv
from mstfilter.smc import ParticleFilter, StateSpaceModel, bootstrap, conditional_path, particle_gibbs, pmmh

T, TAU, DRAWS = 15, 0.4, 9
PMMH = {"n": 40, "discard": 100, "thin": 40}
GIBBS = {"n": 4, "discard": 20, "thin": 8}
FIELDS = ["method", "data_set", "rho", "sigma"]


def draw_prior(rng: np.random.Generator) -> np.ndarray:
    """A draw (rho, sigma) from the prior."""
    return np.array([rng.normal(0.5, 0.3), rng.gamma(3.0, 1.0) ** -0.5])


def log_prior(theta: np.ndarray) -> float:
    """Log density of (rho, log sigma) up to a constant; the density of log sigma is precision^3 exp(-precision)."""
    rho, log_sigma = theta
    return -0.5 * ((rho - 0.5) / 0.3) ** 2 - 6 * log_sigma - np.exp(-2 * log_sigma)


def simulate(seed: int) -> tuple[np.ndarray, list[float], np.ndarray]:
    """True parameters, observations, and parameters at which a chain starts."""
    rng = np.random.default_rng(seed)
    rho, sigma = theta = draw_prior(rng)
    x, ys = rng.normal(), []
    for _ in range(T):
        ys.append(float(rng.normal(x, TAU)))
        x = rho * x + sigma * rng.normal()
    return theta, ys, draw_prior(rng)


def filter_of(theta: np.ndarray, n: int) -> ParticleFilter:
    """Bootstrap filter. With parameters of shape (2, R, 1), the filter has R runs."""
    rho, sigma = theta
    model = StateSpaceModel(
        lambda rng, n: rng.standard_normal(n),
        lambda rng, x: rho * x + sigma * rng.standard_normal(x.shape),
        lambda x, y: -0.5 * ((y - x) / TAU) ** 2,
        log_transition=lambda old, new: -0.5 * ((new - rho * old) / sigma) ** 2,
    )
    return bootstrap(model, n)


def draw_parameters(rng: np.random.Generator, theta: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Gibbs draw: rho from a normal law given sigma and the path, then the precision from a gamma law given rho."""
    old, new = path[:-1], path[1:]
    precision = 1 / 0.3**2 + old @ old / theta[1] ** 2
    rho = rng.normal((0.5 / 0.3**2 + old @ new / theta[1] ** 2) / precision, precision**-0.5)
    rest = new - rho * old
    return np.array([rho, rng.gamma(3.0 + len(rest) / 2, 1 / (1.0 + rest @ rest / 2)) ** -0.5])


def thinned(chain: np.ndarray, discard: int, thin: int) -> np.ndarray:
    return chain[discard + thin - 1 :: thin][:DRAWS]


def pmmh_draws(seeds: list[int]) -> list[np.ndarray]:
    """Posterior draws (DRAWS, 2) of each data set."""

    def of_log(theta: np.ndarray) -> ParticleFilter:
        return filter_of((theta[0], np.exp(theta[1])), PMMH["n"])

    n_iterations, found = PMMH["discard"] + DRAWS * PMMH["thin"], []
    for seed in seeds:
        _, ys, (rho, sigma) = simulate(seed)
        chain = pmmh(of_log, ys, log_prior, [rho, np.log(sigma)], [0.35, 0.4], n_iterations, seed)
        draws = thinned(chain.theta[:, 0], PMMH["discard"], PMMH["thin"])
        found.append(np.stack([draws[:, 0], np.exp(draws[:, 1])], axis=1))
    return found


def gibbs_draws(seeds: list[int]) -> list[np.ndarray]:
    found = []
    for seed in seeds:
        _, ys, start = simulate(seed)
        n_iterations = GIBBS["discard"] + DRAWS * GIBBS["thin"]
        chain = particle_gibbs(
            lambda theta: filter_of(theta, GIBBS["n"]), ys, draw_parameters, start, n_iterations, seed
        )
        found.append(thinned(chain.theta[:, 0], GIBBS["discard"], GIBBS["thin"]))
    return found


def control_draws(seeds: list[int]) -> list[np.ndarray]:
    found = []
    for seed in seeds:
        _, ys, theta = simulate(seed)
        rng, chain = np.random.default_rng([seed, 1]), []
        for _ in range(GIBBS["discard"] + DRAWS * GIBBS["thin"]):
            path = conditional_path(filter_of(theta, GIBBS["n"]), ys, int(rng.integers(2**63)))
            theta = draw_parameters(rng, theta, path)
            chain.append(theta)
        found.append(thinned(np.array(chain), GIBBS["discard"], GIBBS["thin"]))
    return found


METHODS: dict[str, Callable[[list[int]], list[np.ndarray]]] = {
    "pmmh": pmmh_draws,
    "particle_gibbs": gibbs_draws,
    "control": control_draws,
}


def summary(rows: list[dict[str, str]]) -> list[dict[str, object]]:
    """Chi-square tests of the ranks, one row per method and parameter."""
    table = []
    for method in METHODS:
        own = [row for row in rows if row["method"] == method]
        for parameter in ("rho", "sigma"):
            if own:
                counts = np.bincount([int(row[parameter]) * 10 // (DRAWS + 1) for row in own], minlength=10)
                test = stats.chisquare(counts)
                table.append(
                    {
                        "method": method,
                        "parameter": parameter,
                        "data sets": len(own),
                        "chi-square (9)": round(float(test.statistic), 2),
                        "p": f"{test.pvalue:.3g}",
                        "ranks": " ".join(map(str, counts)),
                    }
                )
    return table


def main(n_data_sets: int, block: int, out: Path) -> None:
    """Run the missing data sets; write both tables after each block."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / "ranks.csv"
    rows = read_csv(path) if path.is_file() else []
    for method, draws_of in METHODS.items():
        done = {int(row["data_set"]) for row in rows if row["method"] == method}
        size = n_data_sets if method == "pmmh" else block  # the draws of PMMH depend on the chains of its sweep
        for begin in range(0, n_data_sets, size):
            seeds = list(range(begin, min(begin + size, n_data_sets)))
            if set(seeds) <= done:
                continue
            for seed, draws in zip(seeds, draws_of(seeds), strict=True):
                ranks = (draws < simulate(seed)[0]).sum(axis=0)
                rows.append({"method": method, "data_set": str(seed), "rho": str(ranks[0]), "sigma": str(ranks[1])})
            write_csv(path, rows, FIELDS)
            write_csv(out / "summary.csv", summary(rows))
            print(f"{method}: {seeds[-1] + 1} data sets", flush=True)
    for row in summary(rows):
        print("  ".join(f"{name} {value}" for name, value in row.items()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small and quick; needs --out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    if arguments.smoke and arguments.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    if arguments.smoke:
        PMMH.update(discard=5, thin=1)
        GIBBS.update(discard=2, thin=1)
    main(4 if arguments.smoke else 200, 2 if arguments.smoke else 20, arguments.out)

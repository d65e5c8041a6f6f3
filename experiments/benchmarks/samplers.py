"""Compare online smoothing and SMC samplers of this package and of `particles` 0.4, interleaved; writes samplers.csv.

Each task is an example of `particles`: smoothed sums of an AR(1) process, the normal model and the logistic
regression (Pima Indians) of its tutorials by tempering and IBIS, and stochastic volatility of exchange rates by
SMC^2. README.md has the command.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from contextlib import ExitStack
from functools import cache
from pathlib import Path

import numpy as np
from scipy import stats
from speed import HERE, MODEL, RHO, SIGMA, TAU, data

from mstfilter.base.files import write_csv
from mstfilter.smc import (
    Dynamics,
    MultivariateNormal,
    Normal,
    StateSpaceModel,
    Uniform,
    additive,
    bootstrap,
    ibis,
    smc2,
    tempering,
)

YS = data(50)
TOY = stats.norm.rvs(3.14, 1.0, 100, random_state=0)
BOUND = -float(np.log(SIGMA * np.sqrt(2 * np.pi)))
TOY_PRIOR = {"mu": Normal(0.0, 10.0), "sigma": stats.gamma(1.0)}
SV_PRIOR = {"mu": Normal(-1.0, 1.0), "rho": Uniform(0.0, 1.0), "sigma": stats.gamma(2.0, scale=0.25)}


def volatility(theta: dict) -> object:
    """The bootstrap filter of `particles.state_space_models.StochVol`."""
    mu, rho, sigma = theta["mu"], theta["rho"], theta["sigma"]
    model = StateSpaceModel.of(
        Normal(mu, sigma / np.sqrt(1 - rho**2)),
        lambda x: Normal(mu + rho * (x - mu), sigma),
        lambda x: Normal(0.0, np.exp(0.5 * x)),
    )
    return bootstrap(model, 50)


def sums(**settings):
    def run(seed: int, n: int, _: dict) -> tuple[float, float]:
        steps = additive(bootstrap(MODEL, n), YS, lambda previous, x: x, Dynamics(MODEL), seed, **settings)
        return float(list(steps)[-1]), np.nan

    return run


def toy_by_tempering(seed: int, n: int, _: dict) -> tuple[float, float]:
    def log_likelihood(theta: dict) -> np.ndarray:
        return stats.norm.logpdf(TOY, theta["mu"][:, None], theta["sigma"][:, None]).sum(axis=1)

    found = tempering(TOY_PRIOR, log_likelihood, n, seed)
    return found.log_evidence, float(found.mean["mu"])


def toy_by_ibis(seed: int, n: int, _: dict) -> tuple[float, float]:
    found = ibis(TOY_PRIOR, lambda theta, y: Normal(theta["mu"], theta["sigma"]).log_prob(y), TOY, n, seed)
    return found.log_evidence, float(found.mean["mu"])


def logistic(seed: int, n: int, given: dict) -> tuple[float, float]:
    X = np.array(given["logistic"])
    prior = MultivariateNormal(np.zeros(X.shape[1]), 25.0 * np.eye(X.shape[1]))
    found = tempering(prior, lambda beta: -np.logaddexp(0.0, -beta @ X.T).sum(axis=1), n, seed)
    return found.log_evidence, float(found.mean[0])


def volatilities(**settings):
    def run(seed: int, n: int, given: dict) -> tuple[float, float]:
        found = smc2(volatility, given["sv"], SV_PRIOR, n, seed, steps=4, grow_below=0.0, **settings)
        return found.log_evidence, float(found.mean["mu"])

    return run


#: Ours by name, the number of particles, and the command of theirs.
TASKS = {
    "tempering, normal": (toy_by_tempering, 1000, "sampler:tempering"),
    "IBIS, normal": (toy_by_ibis, 1000, "sampler:ibis"),
    "tempering, logistic": (logistic, 1000, "sampler:logistic"),
    "SMC^2": (volatilities(), 100, "sampler:smc2"),
    "SMC^2, one by one": (volatilities(batched=False), 100, "sampler:smc2"),
    "PaRIS, exact draws": (sums(), 100, "online:Paris"),
    "PaRIS, rejection": (sums(backward="rejection", log_bound=BOUND), 100, "online:Paris"),
    "PaRIS, mcmc": (sums(backward="mcmc"), 100, "online:Paris"),
    "forward smoothing": (sums(method="forward"), 100, "online:Online_smooth_ON2"),
}


def examples(package: Path | None) -> dict:
    """Data of the examples: standardised Pima Indians with signs, and 30 daily returns of GBP / USD in percent."""
    if package is None:
        rng = np.random.default_rng(0)
        return {"logistic": rng.normal(size=(20, 2)).tolist(), "sv": rng.normal(size=5).tolist()}
    pima = np.loadtxt(package / "datasets/pima-indians-diabetes.data", delimiter=",")
    X, signs = pima[:, :-1], 2 * pima[:, -1:] - 1
    X = np.hstack([np.ones((len(X), 1)), 0.5 * (X - X.mean(axis=0)) / X.std(axis=0)])
    rates = np.loadtxt(package / "datasets/GBP_vs_USD_9798.txt", skiprows=2, usecols=3, max_rows=31)
    return {"logistic": (X * signs).tolist(), "sv": (100 * np.diff(np.log(rates))).tolist()}


def main() -> None:
    """Run each task with both packages in turn, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peers", type=Path, help="python of the environment that has particles 0.4")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=HERE / "samplers.csv")
    parser.add_argument("--smoke", action="store_true", help="one small round without peers; needs --out")
    options = parser.parse_args()
    if options.smoke and options.out == HERE / "samplers.csv":
        parser.error("--smoke would overwrite the results: name another file with --out")
    with ExitStack() as stack:
        compare(options, stack)


def compare(options: argparse.Namespace, stack: ExitStack) -> None:
    """Run the tasks, and write the table."""
    worker, package = None, None
    if options.peers and not options.smoke:
        found = subprocess.check_output([options.peers, "-c", "import particles; print(particles.__path__[0])"])
        package = Path(found.decode().strip())
    given = examples(package) | {"toy": TOY.tolist()}
    if package is not None:
        model = {"rho": RHO, "sigma": SIGMA, "tau": TAU, "ys": YS, "clock": "cpu", **given}
        file = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "model.json"
        file.write_text(json.dumps(model))
        command = [str(options.peers), str(HERE / "peers_worker.py"), f"@{file}"]
        worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    @cache  # three of our methods are compared with one of theirs
    def peer(command: str, seed: int, n: int) -> dict:
        if worker is None:
            return {"seconds": np.nan, "value": np.nan}
        worker.stdin.write(f"{command} {seed} {n}\n")
        worker.stdin.flush()
        return json.loads(worker.stdout.readline())

    rows = []
    for name, (run, size, command) in TASKS.items():
        ours, theirs, n = [], [], 20 if options.smoke else size
        for seed in range(1 if options.smoke else options.rounds + 1):
            start = time.process_time()
            value, mean = run(seed, n, given)
            seconds = time.process_time() - start
            answer = peer(command, seed, n)
            if seed or options.smoke:  # the first round compiles
                ours.append((seconds, value, mean))
                theirs.append((answer["seconds"], answer["value"], answer.get("mean", np.nan)))
        a, b = np.array(ours), np.array(theirs)
        row = {"task": name, "n": n, "ms": 1e3 * np.median(a[:, 0]), "particles_ms": 1e3 * np.median(b[:, 0])}
        row["ratio"] = np.median(a[:, 0] / b[:, 0])
        for k, column in ((1, "log evidence or sum"), (2, "posterior mean")):
            row[column], row[f"particles: {column}"] = a[:, k].mean(), b[:, k].mean()
            error = np.sqrt((a[:, k].var() + b[:, k].var()) / max(len(a) - 1, 1))
            row[f"z: {column}"] = (a[:, k].mean() - b[:, k].mean()) / error if error else np.nan
        rows.append({key: f"{v:.4g}" if isinstance(v, float) else v for key, v in row.items()})
        print(*rows[-1].values(), sep="\t", flush=True)
    write_csv(options.out, rows, list(rows[0]))


if __name__ == "__main__":
    main()

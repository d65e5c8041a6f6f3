"""Measure `particles` 0.4 in a separate environment; run by speed.py, one command per line on standard input.

Commands: ``filter SEED N`` (bootstrap AR(1)), ``volatility SEED N`` (the same for stochastic volatility),
``backward:METHOD SEED N`` (N paths of a filter of N particles by the method ``backward_sampling_METHOD``),
``online:CLASS SEED N`` (a collector of smoothed sums), ``sampler:NAME SEED N`` (an SMC sampler of `samplers.py`),
``SCHEME SEED N`` (resampling N even normalised weights), and ``log:SCHEME SEED N`` (the same from log weights). The
answer is one line of JSON. First calls include compilation.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import particles
from particles import (
    collectors,
    distributions as dists,
    resampling,
    smc_samplers as samplers,
    state_space_models as ssm,
)
from scipy import stats

given = sys.argv[1]  # a mapping, or @ and the name of a file that holds it
model = json.loads(Path(given[1:]).read_text("utf-8") if given.startswith("@") else given)
clock = time.process_time if model.get("clock") == "cpu" else time.perf_counter


class AR1(ssm.StateSpaceModel):
    """x_t = rho x_{t-1} + N(0, sigma^2), y_t = x_t + N(0, tau^2)."""

    def PX0(self):
        return dists.Normal(scale=model["sigma"] / np.sqrt(1 - model["rho"] ** 2))

    def PX(self, t, xp):
        return dists.Normal(loc=model["rho"] * xp, scale=model["sigma"])

    def PY(self, t, xp, x):
        return dists.Normal(loc=x, scale=model["tau"])

    def upper_bound_log_pt(self, t):
        return -np.log(model["sigma"] * np.sqrt(2 * np.pi))

    def add_func(self, t, xp, x):
        return x


def bootstrap(seed: int, n: int, history: bool = False, volatility: bool = False) -> tuple[float, particles.SMC]:
    np.random.seed(seed)  # noqa: NPY002 (its only generator)
    if volatility:
        fk = ssm.Bootstrap(ssm=ssm.StochVol(**model["volatility"]), data=np.array(model["volatility_ys"]))
    else:
        fk = ssm.Bootstrap(ssm=AR1(), data=np.array(model["ys"]))
    start = clock()
    pf = particles.SMC(fk=fk, N=n, resampling="systematic", ESSrmin=0.5, store_history=history)
    pf.run()
    return clock() - start, pf


def backward(method: str, seed: int, n: int) -> dict:
    _, pf = bootstrap(seed, n, history=True)
    start = clock()
    paths = getattr(pf.hist, f"backward_sampling_{method}")(n)
    return {"seconds": clock() - start, "means": [float(x.mean()) for x in paths]}


def online(name: str, seed: int, n: int) -> dict:
    np.random.seed(seed)  # noqa: NPY002
    fk = ssm.Bootstrap(ssm=AR1(), data=np.array(model["ys"]))
    pf = particles.SMC(fk=fk, N=n, resampling="systematic", collect=[getattr(collectors, name)()])
    start = clock()
    pf.run()
    found = getattr(pf.summaries, name.lower() if name == "Paris" else name[0].lower() + name[1:])
    return {"seconds": clock() - start, "value": float(found[-1])}


class Toy(samplers.StaticModel):
    """The example of the documentation: y_t ~ N(mu, sigma^2)."""

    def logpyt(self, theta, t):
        return stats.norm.logpdf(self.data[t], loc=theta["mu"], scale=theta["sigma"])


class Logistic(samplers.StaticModel):
    """Logistic regression; rows of the data are multiplied by the signs of the response."""

    def logpyt(self, theta, t):
        return -np.logaddexp(0.0, -theta["beta"] @ self.data[t])


def sampler(name: str, seed: int, n: int) -> dict:
    np.random.seed(seed)  # noqa: NPY002
    toy = dists.StructDist({"mu": dists.Normal(scale=10.0), "sigma": dists.Gamma(1.0, 1.0)})
    if name == "smc2":
        prior = dists.StructDist(
            {"mu": dists.Normal(loc=-1.0), "rho": dists.Uniform(0.0, 1.0), "sigma": dists.Gamma(2.0, 4.0)}
        )
        fk = samplers.SMC2(ssm_cls=ssm.StochVol, prior=prior, data=np.array(model["sv"]), init_Nx=50, len_chain=5)
    elif name == "logistic":
        data = np.array(model["logistic"])
        prior = dists.StructDist({"beta": dists.MvNormal(scale=5.0, cov=np.eye(data.shape[1]))})
        fk = samplers.AdaptiveTempering(Logistic(data=data, prior=prior), len_chain=10)
    else:
        kind = {"tempering": samplers.AdaptiveTempering, "ibis": samplers.IBIS}[name]
        fk = kind(Toy(data=np.array(model["toy"]), prior=toy), len_chain=10)
    start = clock()
    pf = particles.SMC(fk=fk, N=n // fk.len_chain, ESSrmin=0.5)
    pf.run()
    theta = pf.X.theta["beta" if name == "logistic" else "mu"]
    theta = theta[:, 0] if theta.ndim > 1 else theta
    return {"seconds": clock() - start, "value": float(pf.logLt), "mean": float(pf.W @ theta)}


for line in sys.stdin:
    what, seed, n = line.split()
    if what in ("filter", "volatility"):
        seconds, pf = bootstrap(int(seed), int(n), volatility=what == "volatility")
        answer = {"seconds": seconds, "log_evidence": float(pf.logLt)}
    elif what.startswith("online:"):
        answer = online(what.removeprefix("online:"), int(seed), int(n))
    elif what.startswith("sampler:"):
        answer = sampler(what.removeprefix("sampler:"), int(seed), int(n))
    elif what.startswith("backward:"):
        answer = backward(what.removeprefix("backward:"), int(seed), int(n))
    else:
        np.random.seed(int(seed))  # noqa: NPY002
        w = np.random.uniform(0.5, 1.5, int(n))  # noqa: NPY002
        lw, w = np.log(w), w / w.sum()
        scheme = resampling.rs_funcs[what.removeprefix("log:")]
        start = clock()
        scheme(resampling.Weights(lw).W if what.startswith("log:") else w, M=int(n))
        answer = {"seconds": clock() - start}
    print(json.dumps(answer), flush=True)

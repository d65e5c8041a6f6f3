"""Measure `particles` 0.4 in a separate environment; run by speed.py, one command per line on standard input.

Commands: ``filter SEED N`` (bootstrap AR(1)), ``backward:METHOD SEED N`` (N paths of a filter of N particles by the
method ``backward_sampling_METHOD``), ``SCHEME SEED N`` (resampling N even normalised weights), and
``log:SCHEME SEED N`` (the same from log weights). The answer is one line of JSON. First calls include compilation.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import particles
from particles import distributions as dists, resampling, state_space_models as ssm

model = json.loads(sys.argv[1])
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


def bootstrap(seed: int, n: int, history: bool = False) -> tuple[float, particles.SMC]:
    np.random.seed(seed)  # noqa: NPY002 (its only generator)
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


for line in sys.stdin:
    what, seed, n = line.split()
    if what == "filter":
        seconds, pf = bootstrap(int(seed), int(n))
        answer = {"seconds": seconds, "log_evidence": float(pf.logLt)}
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

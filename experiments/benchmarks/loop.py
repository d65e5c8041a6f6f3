"""A minimal loop in numpy: bootstrap filter of an AR(1) model with systematic resampling at ESS < n / 2."""

from __future__ import annotations

import math

import numpy as np


def systematic(rng: np.random.Generator, w: np.ndarray) -> np.ndarray:
    n = len(w)
    c = np.cumsum(w)
    ends = np.ceil(c * (n / c[-1]) - rng.random())
    ends[-1] = n
    return np.repeat(np.arange(n), np.diff(ends, prepend=0).astype(np.int64))


def bootstrap_loop(rng: np.random.Generator, ys: list[float], n: int, rho: float, sigma: float, tau: float) -> float:
    """Log evidence of the observations `ys`."""
    x = rng.standard_normal(n) * (sigma / math.sqrt(1 - rho**2))
    lw, constant = np.zeros(n), math.log(tau) + 0.5 * math.log(2 * math.pi)
    for t, y in enumerate(ys):
        if t:
            w = np.exp(lw - lw.max())
            if w.sum() ** 2 < 0.5 * n * (w @ w):
                x = x[systematic(rng, w)]
                lw[:] = lw.max() + math.log(w.mean())
            x = rho * x + sigma * rng.standard_normal(n)
        z = (y - x) / tau
        lw = lw - 0.5 * z * z - constant
    top = lw.max()
    return float(top + math.log(np.exp(lw - top).mean()))

"""Fearnhead-Clifford resampling: n distinct particles, with unequal weights.

A duplicate is a wasted place where particles are whole hypotheses. This scheme keeps every heavy particle with
its own weight and chooses among the light ones, which then all weigh c. Of all unbiased random weights with at
most n different from zero it has the least expected squared error.

>>> import numpy as np
>>> log_weights = np.log([4.0, 3.0, 1.0, 1.0, 1.0])
>>> ancestors, log_weights = FearnheadClifford().select(np.random.default_rng(1), log_weights, 4)
>>> ancestors
array([0, 1, 2, 4])

Reference: Fearnhead and Clifford (2003), "On-line inference for hidden Markov models via particle filters",
Journal of the Royal Statistical Society B 65.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mstfilter.smc.interfaces import Resampler
from mstfilter.smc.resampling import _from_shifts, checked_weights

__all__ = ["FearnheadClifford", "threshold"]


def threshold(weights: np.ndarray, n: int) -> tuple[float, int]:
    """c with sum min(1, w_i / c) = n, and how many weights are kept for certain.

    Parameters
    ----------
    weights : (m,) float64
        Positive, m > n.
    n : int
        How many to choose.
    """
    ordered = np.sort(weights)[::-1]
    tails = np.cumsum(ordered[::-1])[::-1]  # summed from the smallest on
    candidates = tails[:n] / (n - np.arange(n))
    # A light weight is lighter than c by more than rounding, so that no interval of it can hold two points.
    light = np.flatnonzero(ordered[:n] < candidates * (1 - 1e-9))
    kept = int(light[0]) if len(light) else n - 1
    return float(candidates[kept]), kept


@dataclass(frozen=True)
class FearnheadClifford(Resampler):
    """Optimal resampling: particles with w_i >= c for certain, the others with probability w_i / c and weight c.

    c solves sum min(1, w_i / c) = n. The light ones are chosen systematically, in order, so there are no
    duplicates. The total weight is kept exactly. Where n or fewer particles have any weight, all of these
    are kept as they are, and fewer than n come out.
    """

    exact_size: ClassVar[bool] = False

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Choose; log weights are scaled so that their log mean is that of the input."""
        weights = checked_weights(log_weights, n)
        lw = np.asarray(log_weights, dtype=np.float64)
        positive = np.flatnonzero(weights > 0)
        if len(positive) <= n:
            return positive, lw[positive] + np.log(len(positive) / len(lw))
        w = weights[positive]
        c, kept = threshold(w, n)
        order = np.argsort(-w, kind="stable")
        light = np.sort(order[kept:])
        chosen = light[_from_shifts(np.cumsum(w[light]), n - kept, rng.random())]
        out = np.concatenate([order[:kept], chosen])
        log_out = np.concatenate([lw[positive[order[:kept]]], np.full(len(chosen), lw.max() + np.log(c))])
        ranks = np.argsort(out, kind="stable")
        return positive[out[ranks]], log_out[ranks] + np.log(n / len(lw))

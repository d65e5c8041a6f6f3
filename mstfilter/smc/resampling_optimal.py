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


def threshold(weights: np.ndarray, n: int) -> tuple[float, np.ndarray]:
    """c with sum min(1, w_i / c) = n, and which weights are kept for certain.

    Parameters
    ----------
    weights : (m,) float64
        Positive, m > n.
    n : int
        How many to choose.

    Returns
    -------
    c : float
        Weight of each light particle that is chosen.
    heavy : (m,) bool
        Fewer than n.
    """
    heavy, kept, c = np.zeros(len(weights), bool), 0, float(weights.sum()) / n
    while True:  # c falls and the heavy ones grow in number, until the light ones are all below c: a few rounds
        # Light is lighter than c by more than rounding, so that no interval of a light one can hold two points.
        heavy |= weights >= c * (1 - 1e-9)
        if int(heavy.sum()) == kept:
            return c, heavy
        kept = int(heavy.sum())
        if kept >= n:  # rounding only: the light ones together are nothing beside the n-th heaviest
            heavy = np.zeros(len(weights), bool)
            heavy[np.argsort(-weights, kind="stable")[: n - 1]] = True
            return float(weights[~heavy].sum()), heavy
        c = float(weights[~heavy].sum()) / (n - kept)


@dataclass(frozen=True)
class FearnheadClifford(Resampler):
    """Optimal resampling: particles with w_i >= c for certain, the others with probability w_i / c and weight c.

    c solves sum min(1, w_i / c) = n. The light ones are chosen systematically, in order, so there are no
    duplicates. The total weight is kept exactly. Where n or fewer particles have any weight, all of these
    are kept as they are, and fewer than n come out: a filter that selects n of n particles degenerates (give it more
    candidates than places, `mstfilter.smc.branching`).
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
        c, heavy = threshold(w, n)
        light = np.flatnonzero(~heavy)
        log_out = np.where(heavy, lw[positive], lw.max() + np.log(c))
        chosen = heavy
        scaled = w[light] / w[light].max()  # they may be as small as numbers get
        chosen[light[_from_shifts(np.cumsum(scaled), n - int(heavy.sum()), rng.random())]] = True
        return positive[chosen], log_out[chosen] + np.log(n / len(lw))

"""A resampler: selects particles by weight.

mstfilter check ./resampler.py:MyResampler
mstfilter run RECORDING resampler=./resampler.py:MyResampler
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.smc import WeightResampler, normalise


@dataclass(frozen=True)
class MyResampler(WeightResampler):
    """Independent draws by weight. Fields need an annotation and a default: add yours here."""

    # Set to False if the weights of the result are not those of an exact filter (for example: keep the n best).
    # The filter then reports no log evidence, and the contract does not test the weights.
    properly_weighted = True

    def select(
        self, rng: np.random.Generator, log_weights: np.ndarray, n: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Choose n ancestors: indices into log_weights (unnormalised, -inf is a weight of zero)."""
        # Random numbers come from rng only. The input is read-only.
        cumulative = np.cumsum(normalise(log_weights))
        points = np.sort(rng.random(n)) * cumulative[-1]
        ancestors = np.searchsorted(cumulative, points, side="right")  # "right" skips weights of zero
        # None: equal weights. Otherwise return (n,) log weights, log(w_i / expected number of copies).
        return ancestors, None

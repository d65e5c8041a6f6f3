"""A resampler of my own.

mstfilter check ./resampler.py:MyResampler              what holds and what does not, in words
mstfilter run RECORDING resampler=./resampler.py:MyResampler
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.smc import WeightResampler, normalise


@dataclass(frozen=True)
class MyResampler(WeightResampler):
    """Independent draws by weight. Fields, with annotation and default, are settings: add yours here."""

    # Say False where the weights afterwards are not those of an exact filter (for example: keep the n best).
    # The law of selection is then not tested, and the filter reports no evidence.
    properly_weighted = True

    def select(
        self, rng: np.random.Generator, log_weights: np.ndarray, n: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Choose n ancestors: indices into log_weights (unnormalised, -inf is a weight of zero)."""
        # All that is random comes from rng. The input is read-only.
        cumulative = np.cumsum(normalise(log_weights))
        points = np.sort(rng.random(n)) * cumulative[-1]
        ancestors = np.searchsorted(cumulative, points, side="right")  # "right" passes over weights of zero
        # None: all chosen particles weigh the same. Else return (n,) log weights, log(w_i / expected copies).
        return ancestors, None

"""What scenes for tuning and scenes for reporting draw from: disjoint sizes, hues and printed names.

Both pools cover the same range in alternate bands, so that one is not harder than the other.

>>> import numpy as np
>>> from mstfilter.simulation.pools import REPORTED, TUNING
>>> sizes = [[pool.factor(np.random.default_rng(k)) for k in range(99)] for pool in (TUNING, REPORTED)]
>>> len({int(s / 0.025) for s in sizes[0]} & {int(s / 0.025) for s in sizes[1]})
0
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["ANY", "REPORTED", "TUNING", "Pool"]

_SMALLEST, _BAND = 0.90, 0.025
# Bands of sizes from 0.9 to 1.1 of each pool; both have mean 1.
_SIZE_BANDS = ((0, 3, 4, 7), (1, 2, 5, 6))
_N_HUES = 12
_MARGIN = 0.04  # of a band is left free at either side


@dataclass(frozen=True)
class Pool:
    """A part of all sizes, hues and names.

    Parameters
    ----------
    half : {0, 1, None}
        Which of the two disjoint parts; None for everything.
    """

    half: int | None = None

    def factor(self, rng: np.random.Generator) -> float:
        """By what a measure is scaled, 0.9 .. 1.1."""
        u = float(rng.uniform())
        if self.half is None:
            return _SMALLEST + 8 * _BAND * u
        bands = _SIZE_BANDS[self.half]
        k = int(u * len(bands))
        return _SMALLEST + _BAND * (bands[k] + _within(u * len(bands) - k))

    def hue(self, rng: np.random.Generator) -> float:
        """A hue, 0 .. 1."""
        u = float(rng.uniform())
        if self.half is None:
            return u
        k = int(u * _N_HUES / 2)
        return (2 * k + self.half + _within(u * _N_HUES / 2 - k)) / _N_HUES

    def name(self, rng: np.random.Generator, names: Sequence[str]) -> str:
        """One of the pool's names."""
        own = names if self.half is None else names[self.half :: 2]
        return own[int(rng.integers(len(own)))]


def _within(share: float) -> float:
    return _MARGIN + (1 - 2 * _MARGIN) * share


ANY, TUNING, REPORTED = Pool(), Pool(0), Pool(1)

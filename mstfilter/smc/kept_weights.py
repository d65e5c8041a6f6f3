"""A resampler that lets drawn particles keep their weights: what the MST paper's program does.

Drawing by weight and keeping the weight counts the same evidence twice, so this is not properly weighted. It is
here to reproduce published behaviour.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mstfilter.smc.interfaces import Resampler
from mstfilter.smc.resampling import Multinomial

__all__ = ["KeepWeights"]


@dataclass(frozen=True)
class KeepWeights(Resampler):
    """Selects by another scheme; every drawn particle keeps its log weight.

    Parameters
    ----------
    scheme : Resampler
        Chooses the ancestors.
    """

    scheme: Resampler = Multinomial()  # noqa: RUF009 (frozen)

    properly_weighted: ClassVar[bool] = False

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Choose."""
        ancestors, _ = self.scheme.select(rng, log_weights, n)
        return ancestors, np.asarray(log_weights, dtype=np.float64)[ancestors]

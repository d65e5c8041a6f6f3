"""A resampler that lets drawn particles keep their weights: what the MST paper's program does.

Drawing by weight and keeping the weight counts the same evidence twice, so this is not properly weighted. It is
here to reproduce published behaviour.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from mstfilter.smc.fields import part
from mstfilter.smc.interfaces import Resampler
from mstfilter.smc.population import Population
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

    def __post_init__(self) -> None:
        part("scheme", self.scheme, Resampler)

    @property
    def exact_size(self) -> bool:  # type: ignore[override]
        """As the scheme inside."""
        return self.scheme.exact_size

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Choose."""
        ancestors, _ = self.scheme.select(rng, log_weights, n)
        return ancestors, np.asarray(log_weights, dtype=np.float64)[ancestors]

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Choose; also for schemes that see the particles."""
        chosen = self.scheme.resample(rng, population, n)
        return replace(chosen, log_weights=population.log_weights[chosen.parents["ancestor"]])

"""A trigger: when to resample.

mstfilter check ./trigger.py:MyTrigger
mstfilter run RECORDING trigger=./trigger.py:MyTrigger
"""

from __future__ import annotations

from dataclasses import dataclass

from mstfilter.errors import InputError
from mstfilter.smc import Population, Trigger


@dataclass(frozen=True)
class MyTrigger(Trigger):
    """Resamples if one particle has more than a given share of the weight. Fields need an annotation and a default.

    Parameters
    ----------
    share : float
        Share of the total weight, in (0, 1).
    """

    share: float = 0.5

    def __post_init__(self) -> None:
        if not 0 < self.share < 1:
            raise InputError(f"share is {self.share}, expected a number in (0, 1)")

    def wants(self, population: Population, t: int) -> bool:
        """True to resample; t counts observations from 0. Weights are normalised, log weights are not."""
        return bool(population.weights.max() > self.share)

"""A size: how many particles a resampling makes.

mstfilter check ./size.py:MySize
mstfilter run RECORDING size=./size.py:MySize
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc import Population, Size


@dataclass(frozen=True)
class MySize(Size):
    """More particles if the weights are spread over many. Fields need an annotation and a default.

    Parameters
    ----------
    factor : float
        Number of particles per unit of the perplexity, the exponential of the entropy of the weights.
    n_min, n_max : int
        Bounds of the answer.
    """

    factor: float = 2.0
    n_min: int = 10
    n_max: int = 1000

    def __post_init__(self) -> None:
        if not (self.factor > 0 and 1 <= self.n_min <= self.n_max):
            raise InputError(f"factor is {self.factor}, n_min {self.n_min} and n_max {self.n_max}")

    def choose(self, population: Population) -> int:
        """An integer of at least 1, from the weighted particles before the resampling."""
        weights = population.weights[population.weights > 0]
        perplexity = float(np.exp(-(weights @ np.log(weights))))
        # Rounded, since the last bits of a sum depend on the order of the particles.
        return int(np.clip(np.ceil(round(self.factor * perplexity, 6)), self.n_min, self.n_max))

"""A size of my own: how many particles a resampling makes.

mstfilter check ./size.py:MySize                        what holds and what does not, in words
mstfilter run RECORDING size=./size.py:MySize
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc import Population, Size


@dataclass(frozen=True)
class MySize(Size):
    """More particles where the weights are spread over many. Fields are settings.

    Parameters
    ----------
    factor : float
        Particles for each particle of the perplexity, which is the exponential of the entropy of the weights.
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
        """A whole number of at least 1, from the weighted particles that are about to be resampled."""
        weights = population.weights[population.weights > 0]
        perplexity = float(np.exp(-(weights @ np.log(weights))))
        # Rounded first: the order of the particles must not matter, not even in the last bit of a sum.
        return int(np.clip(np.ceil(round(self.factor * perplexity, 6)), self.n_min, self.n_max))

"""An update of my own: what an observation does to the particles.

mstfilter check ./update.py:MyUpdate                    what holds and what does not, in words
mstfilter run RECORDING update=./update.py:MyUpdate
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.smc import Population, Update, union


@dataclass(frozen=True)
class MyUpdate(Update):
    """Weighs particles by a Gaussian likelihood. Fields, with annotation and default, are settings.

    Parameters
    ----------
    noise : float
        Standard deviation of the observation, in its units.
    """

    noise: float = 0.5

    # Say False where the weights afterwards are not those of an exact filter.
    properly_weighted = True

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Any,
    ) -> Population:
        """Any number of particles may come out; `predicted` or `proposed` may be None, but not both."""
        population = union(predicted, proposed)
        distance = (population.particles - np.asarray(observation)) / self.noise
        return population.reweighted(-0.5 * (distance**2).reshape(len(population), -1).sum(axis=1))


def example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """What the checks let it work on: n particles, and an observation."""
    return Population(rng.standard_normal((n, 2)), rng.standard_normal(n)), np.array([0.3, -0.1])

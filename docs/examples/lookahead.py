"""A lookahead: which particles the next observation favours. With one, a filter is an auxiliary filter.

mstfilter check ./lookahead.py:MyLookahead
replace(bootstrap(model, n=100), lookahead=MyLookahead())
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.smc import Lookahead, Population


@dataclass(frozen=True)
class MyLookahead(Lookahead):
    """An approximation of log p(y_t | x_{t-1}) for particles that move little.

    Fields need an annotation and a default.

    Parameters
    ----------
    spread : float
        Standard deviation of observation minus particle, in its units: motion and noise together.
    """

    spread: float = 1.0

    def log_priority(self, population: Population, observation: Any) -> np.ndarray:
        """(n,) log priority of each x_{t-1} given y_t. The filter divides by it, so it is exact for any priority."""
        distance = (population.particles - np.asarray(observation)) / self.spread
        priority = -0.5 * (distance**2).reshape(len(population), -1).sum(axis=1)
        # Bounded from below: a particle with a tiny priority gets a huge weight if it is selected.
        return np.maximum(priority, priority.max() - 10.0)


def example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """Input for the contract: n particles, and the next observation."""
    return Population(rng.standard_normal((n, 2)), rng.standard_normal(n)), np.array([0.3, -0.1])

"""A lookahead of my own: which particles the next observation will favour. It makes an auxiliary filter.

mstfilter check ./lookahead.py:MyLookahead              what holds and what does not, in words
replace(bootstrap(model, n=100), lookahead=MyLookahead())
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.smc import Lookahead, Population


@dataclass(frozen=True)
class MyLookahead(Lookahead):
    """A guess at log p(y_t | x_{t-1}) for particles that hardly move. Fields are settings.

    Parameters
    ----------
    spread : float
        How far an observation may lie from a particle, in its units: motion and noise together.
    """

    spread: float = 1.0

    def log_priority(self, population: Population, observation: Any) -> np.ndarray:
        """(n,) log priority of each x_{t-1} given y_t. It changes no law, whatever it is: it is taken off again."""
        away = (population.particles - np.asarray(observation)) / self.spread
        priority = -0.5 * (away**2).reshape(len(population), -1).sum(axis=1)
        # Never -inf, nor nearly: who can hardly be selected weighs the more if he is.
        return np.maximum(priority, priority.max() - 10.0)


def example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """What the checks let it work on: n particles, and the next observation."""
    return Population(rng.standard_normal((n, 2)), rng.standard_normal(n)), np.array([0.3, -0.1])

"""A lookahead: which particles the next observation favours. With one, a filter is an auxiliary filter.

mstfilter check ./lookahead.py:MyLookahead
python lookahead.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mstfilter.smc import Lookahead, Population, bootstrap, linear_gaussian


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


if __name__ == "__main__":
    # x_0 ~ N(0, 1), x_t ~ N(0.9 x_{t-1}, 0.5), y_t ~ N(x_t, 1)
    model = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
    filter = replace(bootstrap(model, n=1000), lookahead=MyLookahead())
    state, infos = filter.run([[0.3], [-0.1], [0.8]], seed=0)
    print("mean", state.population.weights @ state.population.particles, "ESS", [round(info.ess) for info in infos])

"""A proposal: new particles from an observation alone.

mstfilter check ./proposal.py:MyProposal
python proposal.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mstfilter.smc import Population, Proposal, bootstrap, linear_gaussian


@dataclass(frozen=True)
class MyProposal(Proposal):
    """Particles around the observation. Fields need an annotation and a default.

    Parameters
    ----------
    spread : float
        Standard deviation around the observation, in its units.
    """

    spread: float = 1.0

    # Set to False if the weights are not those of draws from the model (for example heuristic scores).
    properly_weighted = False

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        """Draw exactly n particles; repeat some if there are fewer different ones."""
        # Random numbers come from rng only.
        centre = np.asarray(observation, dtype=np.float64)
        particles = centre + self.spread * rng.standard_normal((n, *centre.shape))
        # Log weights: 0 for draws from the prior; log prior - log density of the draw if that is known.
        return Population(particles, np.zeros(n))


def example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """Input for the contract: a population (not used here) and an observation."""
    return Population(rng.standard_normal((n, 2))), np.array([0.3, -0.1])


def exact(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """Exact draws of the distribution of the weighted particles, and y: the contract compares with them."""
    y = np.array([0.3, -0.1])
    return Population(rng.normal(y, 1.0, (n, 2))), y


if __name__ == "__main__":
    # x_0 ~ N(0, 1), x_t ~ N(0.9 x_{t-1}, 0.5), y_t ~ N(x_t, 1)
    model = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
    # At every step, the update weights 1000 predicted and 100 proposed particles.
    filter = replace(bootstrap(model, n=1000), proposal=MyProposal(), n_proposed=100)
    state, infos = filter.run([[0.3], [-0.1], [0.8]], seed=0)
    print("mean", state.population.weights @ state.population.particles, "ESS", [round(info.ess) for info in infos])

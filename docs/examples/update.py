"""An update: how an observation changes the particles.

mstfilter check ./update.py:MyUpdate
python update.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mstfilter.smc import Population, Update, bootstrap, linear_gaussian, union


@dataclass(frozen=True)
class MyUpdate(Update):
    """Weights particles by a Gaussian likelihood. Fields need an annotation and a default.

    Parameters
    ----------
    noise : float
        Standard deviation of the observation, in its units.
    """

    noise: float = 0.5

    # Set to False if the weights of the result are not those of an exact filter.
    properly_weighted = True

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Any,
    ) -> Population:
        """The result may have any number of particles; `predicted` or `proposed` may be None, but not both."""
        population = union(predicted, proposed)
        distance = (population.particles - np.asarray(observation)) / self.noise
        # Constant factors of the likelihood are part of the evidence.
        log_densities = -0.5 * distance**2 - np.log(np.sqrt(2 * np.pi) * self.noise)
        return population.reweighted(log_densities.reshape(len(population), -1).sum(axis=1))


def example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """Input for the contract: n particles, and an observation."""
    return Population(rng.standard_normal((n, 2)), rng.standard_normal(n)), np.array([0.3, -0.1])


def exact(rng: np.random.Generator, n: int) -> tuple[Population, Population, Any, float]:
    """Draws of p(x), exact draws of p(x | y), y and log p(y): the contract tests the weights with them."""
    y = np.array([0.3, -0.1])
    # x ~ N(0, 1) and y ~ N(x, 0.5^2) give x | y ~ N(0.8 y, 0.2) and y ~ N(0, 1.25), in each of two dimensions.
    posterior = rng.normal(0.8 * y, np.sqrt(0.2), (n, 2))
    log_evidence = float(-0.5 * (y**2).sum() / 1.25 - np.log(2 * np.pi * 1.25))
    return Population(rng.standard_normal((n, 2))), Population(posterior), y, log_evidence


if __name__ == "__main__":
    # x_0 ~ N(0, 1), x_t ~ N(0.9 x_{t-1}, 0.5), y_t ~ N(x_t, 1)
    model = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
    filter = replace(bootstrap(model, n=1000), update=MyUpdate())
    state, infos = filter.run([[0.3], [-0.1], [0.8]], seed=0)
    print("mean", state.population.weights @ state.population.particles, "ESS", [round(info.ess) for info in infos])

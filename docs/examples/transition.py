"""A transition: how particles move from one time to the next.

mstfilter check ./transition.py:MyTransition
python transition.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.smc import Population, Transition, bootstrap, linear_gaussian


@dataclass(frozen=True)
class MyTransition(Transition):
    """A random walk. Fields need an annotation and a default.

    Parameters
    ----------
    scale : float
        Standard deviation of a step, in the units of the particles.
    """

    scale: float = 1.0

    # Set to False if the weights of the result are not those of an exact filter.
    properly_weighted = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.scale >= 0:
            raise InputError(f"scale is {self.scale}, expected a number of at least 0")

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        """Move all particles; `observation` is the new one, or None if it is missing."""
        # Arrays are read-only: make new ones. Random numbers come from rng only.
        particles = population.particles + self.scale * rng.standard_normal(population.particles.shape)
        # A guided move, drawn from q(x | previous, observation), adds log f - log q to the log weights here.
        return Population(particles, population.log_weights, population.parents)


def example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """Input for the contract: n particles of the kind it moves, and an observation."""
    return Population(rng.standard_normal((n, 2)), rng.standard_normal(n)), np.array([0.3, -0.1])


def exact(rng: np.random.Generator, n: int) -> tuple[Population, Population, Any]:
    """x_{t-1}, draws of x_t by the model given them, and y_t: the contract tests the distribution with them."""
    previous = rng.standard_normal((n, 2))
    return Population(previous), Population(rng.normal(previous, 1.0)), np.array([0.3, -0.1])


if __name__ == "__main__":
    # x_0 ~ N(0, 1), x_t ~ N(0.9 x_{t-1}, 0.5), y_t ~ N(x_t, 1)
    model = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
    filter = replace(bootstrap(model, n=1000), transition=MyTransition())
    state, infos = filter.run([[0.3], [-0.1], [0.8]], seed=0)
    print("mean", state.population.weights @ state.population.particles, "ESS", [round(info.ess) for info in infos])

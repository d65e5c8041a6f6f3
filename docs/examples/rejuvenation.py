"""A rejuvenation: a move that leaves p(x_t | x_{t-1}, y_t) unchanged. With one, a filter is a resample-move filter.

mstfilter check ./rejuvenation.py:MyRejuvenation
python rejuvenation.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mstfilter.smc import Normal, Population, Rejuvenation, StateSpaceModel, bootstrap


@dataclass(frozen=True)
class MyRejuvenation(Rejuvenation):
    """A Metropolis step for x_0 ~ N(0, 1), x_t ~ N(0.9 x_{t-1}, 1), y_t ~ N(x_t, 1).

    Fields need an annotation and a default.

    Parameters
    ----------
    step : float
        Standard deviation of a step, in the units of the particles.
    """

    step: float = 1.0

    def move(
        self,
        rng: np.random.Generator,
        population: Population,
        previous: Population | None,
        observation: Any,
    ) -> Population:
        """As many particles in the same order; row i came from row i of `previous` (None at the first step)."""
        centre = 0.0 if previous is None else 0.9 * previous.particles

        def log_target(x: np.ndarray) -> np.ndarray:
            prior = -0.5 * (x - centre) ** 2
            return prior if observation is None else prior - 0.5 * (observation - x) ** 2

        x = population.particles
        new = x + self.step * rng.standard_normal(len(population))
        accepted = np.log1p(-rng.random(len(population))) < log_target(new) - log_target(x)
        # The weights do not change, since the kernel keeps the distribution.
        return replace(population, particles=np.where(accepted, new, x))


def example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """Input for the contract: n particles, and an observation."""
    return Population(rng.standard_normal(n), rng.standard_normal(n)), 0.5


def exact(rng: np.random.Generator, n: int) -> tuple[Population | None, Population, Any]:
    """x_{t-1}, exact draws of x_t given them and y_t, and y_t: the contract tests the distribution with them."""
    previous = rng.standard_normal(n)
    x = (0.9 * previous + 0.5) / 2 + np.sqrt(0.5) * rng.standard_normal(n)
    return Population(previous), Population(x), 0.5


if __name__ == "__main__":
    model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 1.0), lambda x: Normal(x, 1.0))
    filter = replace(bootstrap(model, n=1000), rejuvenation=MyRejuvenation())
    states, observations = model.simulate(20, seed=1)
    state, infos = filter.run(observations, seed=0)
    print("mean", state.population.mean(), "ESS", [round(info.ess) for info in infos])

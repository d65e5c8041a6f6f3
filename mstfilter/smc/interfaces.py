"""What a particle filter is made of. Subclass these to make it yours.

A component is a frozen dataclass: its fields are hyperparameters, its behaviour is one method. The generator
is the first argument of whatever draws. All work on whole populations, so a component can share work over
particles.

>>> from dataclasses import dataclass
>>> import numpy as np
>>> from mstfilter.smc.interfaces import Transition
>>> from mstfilter.smc.population import Population
>>> @dataclass(frozen=True)
... class RandomWalk(Transition):
...     scale: float = 1.0
...
...     def predict(self, rng, population, observation):
...         step = self.scale * rng.standard_normal(population.particles.shape)
...         return Population(population.particles + step, population.log_weights)

A guided move, which draws from q(x_t | x_{t-1}, y_t) instead of the model's f(x_t | x_{t-1}), is a Transition
too: it sees the observation, and it adds log f - log q to the log weights.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from mstfilter.smc.population import Population, log_mean_exp

__all__ = ["Component", "Proposal", "Resampler", "Transition", "Trigger", "Update"]


class Component(ABC):
    """Anything that takes part in a step."""

    #: Whether the weights that it leaves behind are those of an exact filter (in expectation). The log evidence
    #: is reported only where all components say so.
    properly_weighted: ClassVar[bool] = True


class Proposal(Component):
    """New particles from the observation alone."""

    @abstractmethod
    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        """Draw `n` particles; a proposal that has fewer distinct ones repeats them."""


class Transition(Component):
    """Moves particles from the previous time to this one (prediction)."""

    @abstractmethod
    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        """Move all particles. `observation` is None where it is missing."""


class Update(Component):
    """Brings in the observation: weights particles, projects them, or makes new ones out of two."""

    @abstractmethod
    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Any,
    ) -> Population:
        """Particles after the observation; any number of them.

        Parameters
        ----------
        rng : Generator
            For whatever is drawn.
        predicted : Population or None
            The moved particles; None at the first step of a filter that starts from its proposal.
        proposed : Population or None
            New particles; None where the filter has no proposal. At least one of the two is there.
        observation : Any
            The observation.
        """


class Resampler(Component):
    """Selects particles by weight. Three lines make one: override `select`.

    Override `resample` instead where the scheme looks at the particles.
    """

    @abstractmethod
    def select(
        self, rng: np.random.Generator, log_weights: np.ndarray, n: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Choose `n` ancestors.

        Parameters
        ----------
        rng : Generator
            For whatever is drawn.
        log_weights : (m,) float64
            Unnormalised; finite or -inf, at least one finite.
        n : int
            How many to choose.

        Returns
        -------
        ancestors : (n,) int
            Indices into the m particles.
        log_weights : (n,) float or None
            Log weights after selection. None says equal weights: each gets the log mean of the old ones, which
            keeps the evidence.
        """

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Select from a population; `parents["ancestor"]` (n,) says which particle each one was."""
        ancestors, log_weights = self.select(rng, population.log_weights, n)
        if log_weights is None:
            log_weights = np.full(len(ancestors), log_mean_exp(population.log_weights))
        chosen = population.take(ancestors, log_weights)
        return replace(chosen, parents={**chosen.parents, "ancestor": ancestors})


class Trigger(ABC):
    """Decides whether to resample at a step."""

    @abstractmethod
    def wants(self, population: Population, t: int) -> bool:
        """True to resample."""

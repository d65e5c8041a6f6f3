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
too: it sees the observation, and it adds log f - log q to the log weights
(`mstfilter.smc.state_space.GuidedTransition` does so for any model and proposal with densities).

Needed by every filter: Proposal (or an initial one), Transition, Update, Resampler, Trigger. Optional: `Size`
(how many particles to keep), `Lookahead` (auxiliary filter), `Rejuvenation` (resample-move), `Codec` (how
particles of your own are stored). A further ability is a further interface: `DensityTransition`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from mstfilter.smc.population import Population

__all__ = [
    "Codec",
    "Component",
    "DensityTransition",
    "Lookahead",
    "Proposal",
    "Rejuvenation",
    "Resampler",
    "Size",
    "Transition",
    "Trigger",
    "Update",
]


class Component(ABC):
    """Anything that takes part in a step."""

    #: Whether the weights that it leaves behind are those of an exact filter (in expectation). The log evidence
    #: is reported only where all components say so.
    properly_weighted: ClassVar[bool] = True
    #: Whether it draws at all. One that says False is given a generator of fixed seed, which it must not use.
    draws: ClassVar[bool] = True


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


class DensityTransition(Transition):
    """A transition whose density is known, for moves, smoothing and importance weights."""

    @abstractmethod
    def log_prob(self, previous: Any, new: Any, observation: Any) -> np.ndarray:
        """Log density of each move.

        Parameters
        ----------
        previous, new : n particles each
            Paired rows: row i of `new` was reached from row i of `previous`.
        observation : Any
            The observation that `predict` was given with the move; None where it is missing.

        Returns
        -------
        (n,) float64
            log f(new_i | previous_i); -inf where the move is impossible.
        """


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

    #: Whether `n` particles come out in any case. A scheme without duplicates returns fewer where fewer have weight.
    exact_size: ClassVar[bool] = True

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
            log_weights = np.full(len(ancestors), population.log_mean_weight)
        chosen = population.take(ancestors, log_weights)
        return chosen.labelled({**chosen.parents, "ancestor": np.asarray(ancestors, dtype=np.int64)}, chosen.notes)


class Trigger(ABC):
    """Decides whether to resample at a step."""

    @abstractmethod
    def wants(self, population: Population, t: int) -> bool:
        """True to resample."""


class Size(ABC):
    """Decides how many particles a resampling makes."""

    @abstractmethod
    def choose(self, population: Population) -> int:
        """Number of particles (at least 1), from the weighted particles that are about to be resampled.

        The filter's `n` is then only the number that it starts with.
        """


class Lookahead(Component):
    """A glance at the next observation before particles are selected: the auxiliary filter.

    The driver selects by log weight + priority and takes the priority off the selected weights again, so any
    priority leaves the filter exact; a good one is close to log p(y_t | x_{t-1}).
    """

    @abstractmethod
    def log_priority(self, population: Population, observation: Any) -> np.ndarray:
        """(n,) log priority of each particle x_{t-1} given y_t. Finite: -inf would bias the filter."""


class Rejuvenation(Component):
    """Moves particles at the end of a step that resampled, by a kernel that keeps their law: resample-move."""

    @abstractmethod
    def move(
        self,
        rng: np.random.Generator,
        population: Population,
        previous: Population | None,
        observation: Any,
    ) -> Population:
        """Move x_t without changing what it is distributed as.

        Parameters
        ----------
        rng : Generator
            For whatever is drawn.
        population : Population
            Weighted particles x_t after the observation.
        previous : Population or None
            Their x_{t-1}, row by row; None at the first step.
        observation : Any
            y_t; None where it is missing.

        Returns
        -------
        Population
            As many particles in the same order, moved by a kernel that leaves p(x_t | x_{t-1}, y_t) invariant;
            log weights unchanged.
        """


class Codec(ABC):
    """Stores particles as named arrays and makes them again, bit for bit. No pickle."""

    @abstractmethod
    def encode(self, particles: Any) -> Mapping[str, np.ndarray]:
        """Named arrays (no object arrays) of a population's particles."""

    @abstractmethod
    def decode(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """The particles of `encode`."""

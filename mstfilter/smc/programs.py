"""Probabilistic programs: a model is a Python function that calls `sample` and `observe`.

>>> from mstfilter.smc.distributions import Normal
>>> from mstfilter.smc.programs import Program, observe, sample
>>> def ar1(previous, y):
...     x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(0.9 * previous["x"], 0.5))
...     observe("y", Normal(x, 1.0), y)
>>> state, infos = Program(ar1).bootstrap(n=1000).run([0.3, -0.1, 0.8], seed=0)
>>> state.population.particles["x"].shape
(1000,)

The function runs once a step for all particles: `previous` is a mapping from names to arrays with one row a particle
(None at the first step), and so is what it makes: one array for each `sample`, and for each entry of a mapping that
it returns. `observe` adds log p(value) to the log weights, and nothing where the value is None (a missing
observation). What a program may contain besides:

- `switch(name, probs, branches, ...)` draws a branch for each particle and runs each branch on its particles;
- `per_particle` marks a function that runs once for every particle, so the set of names may differ between them.

The same function is a bootstrap filter, a guided one (with a guide program, whose sites match by name), an auxiliary
one (the lookahead puts the mean or mode in place of each draw) and a resample-move one (a Metropolis step on all
sites): see the methods of `Program`. `sample` and `observe` happen in one pass, so a program is a Transition that
weighs; the filter has no Update.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.fields import number, whole
from mstfilter.smc.interfaces import Lookahead, Proposal, Rejuvenation, Resampler, Transition, Trigger
from mstfilter.smc.particle_filter import ParticleFilter
from mstfilter.smc.population import Population
from mstfilter.smc.program_runs import Centre, Draw, Guide, Replay, execute, per_particle
from mstfilter.smc.program_sites import observe, sample, switch
from mstfilter.smc.resampling import EssBelow, Systematic

__all__ = [
    "Program",
    "ProgramInitial",
    "ProgramLookahead",
    "ProgramMove",
    "ProgramTransition",
    "observe",
    "per_particle",
    "sample",
    "switch",
]

Model = Callable[[Any, Any], Any]


@dataclass(frozen=True)
class Program:
    """A model as a function, and the filters that come from it.

    Parameters
    ----------
    model : callable
        ``model(previous, observation)`` with calls of `sample` and `observe`; returns None, or a mapping of further
        values to keep.
    """

    model: Model

    def __post_init__(self) -> None:
        if not callable(self.model):
            raise InputError(
                f"model is {self.model!r}, expected a function of the previous state and the observation"
            )

    def bootstrap(self, n: int, resampler: Resampler | None = None, trigger: Trigger | None = None) -> ParticleFilter:
        """Bootstrap filter: draws from the model, weighs by what is observed."""
        return self._filter(None, n, resampler, trigger)

    def guided(
        self, guide: Model, n: int, resampler: Resampler | None = None, trigger: Trigger | None = None
    ) -> ParticleFilter:
        """Guided filter.

        Parameters
        ----------
        guide : callable
            Program that draws every site of the model, by its name, knowing the observation. Where the observation
            is missing the model draws itself.
        n : int
            Particles.
        resampler, trigger : Resampler, Trigger, optional
            Systematic at an effective sample size below half where left out.
        """
        return self._filter(guide, n, resampler, trigger)

    def auxiliary(
        self,
        n: int,
        guide: Model | None = None,
        resampler: Resampler | None = None,
        trigger: Trigger | None = None,
        power: float = 1.0,
    ) -> ParticleFilter:
        """Auxiliary filter with the automatic lookahead: exact for every model.

        Parameters
        ----------
        n : int
            Particles.
        guide : callable, optional
            As in `guided`.
        resampler, trigger : Resampler, Trigger, optional
            Systematic at an effective sample size below half where left out.
        power : float
            Priority to this power: below 1 where the mean of a site says too much.
        """
        return replace(self._filter(guide, n, resampler, trigger), lookahead=ProgramLookahead(self.model, power))

    def resample_move(
        self,
        n: int,
        steps: int = 1,
        scale: float = 0.5,
        guide: Model | None = None,
        resampler: Resampler | None = None,
        trigger: Trigger | None = None,
    ) -> ParticleFilter:
        """Resample-move filter: `steps` Metropolis steps on all sites at the end of a step that resampled.

        `scale` is the step in standard deviations of each site's distribution.
        """
        return replace(self._filter(guide, n, resampler, trigger), rejuvenation=ProgramMove(self.model, scale, steps))

    def _filter(
        self, guide: Model | None, n: int, resampler: Resampler | None, trigger: Trigger | None
    ) -> ParticleFilter:
        return ParticleFilter(
            initial=ProgramInitial(self.model, guide),
            transition=ProgramTransition(self.model, guide),
            resampler=resampler if resampler is not None else Systematic(),
            trigger=trigger if trigger is not None else EssBelow(0.5),
            n=n,
        )


def _advance(
    rng: np.random.Generator, model: Model, guide: Model | None, previous: Any, observation: Any, n: int
) -> tuple[Any, np.ndarray]:
    """Particles after a step and what their log weights gain."""
    if guide is None or observation is None:
        return execute(model, Draw(rng), previous, observation, n)
    proposed = Guide(rng)
    execute(guide, proposed, previous, observation, n, structured_as=model)
    return execute(model, Replay(proposed), previous, observation, n)


@dataclass(frozen=True)
class ProgramInitial(Proposal):
    """First step of a program: draws and weighs.

    Parameters
    ----------
    model : callable
        The program.
    guide : callable, optional
        Draws in its place.
    """

    model: Model
    guide: Model | None = None

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        """Run it with ``previous=None``."""
        return Population(*_advance(rng, self.model, self.guide, None, observation, n))


@dataclass(frozen=True)
class ProgramTransition(Transition):
    """A step of a program: draws and weighs.

    Parameters
    ----------
    model : callable
        The program.
    guide : callable, optional
        Draws in its place.
    """

    model: Model
    guide: Model | None = None

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        """Run it."""
        n = len(population)
        particles, gain = _advance(rng, self.model, self.guide, population.particles, observation, n)
        return Population(particles, population.log_weights + gain, population.parents)


@dataclass(frozen=True)
class ProgramLookahead(Lookahead):
    """Priority from a run in which the mean (mode of a discrete site) stands in place of each draw.

    Parameters
    ----------
    model : callable
        The program.
    power : float
        Power of the priority.
    """

    model: Model
    power: float = 1.0

    def __post_init__(self) -> None:
        number("power", self.power, at_least=0)

    def log_priority(self, population: Population, observation: Any) -> np.ndarray:
        """(n,) log of what would be observed; bounded so that no particle is ruled out."""
        _, priority = execute(self.model, Centre(), population.particles, observation, len(population))
        # What a mean rules out a draw may allow: the priority is kept within 50 of the best (e^-50).
        top = priority.max()
        if not np.isfinite(top):
            return np.zeros(len(priority))
        return self.power * np.maximum(np.nan_to_num(priority, nan=-np.inf), top - 50.0)


@dataclass(frozen=True)
class ProgramMove(Rejuvenation):
    """Metropolis-Hastings on all sites of a step at once.

    Continuous sites take a Gaussian step, `scale` standard deviations of the site's distribution long; discrete sites
    are drawn anew from theirs. Both distributions depend on earlier sites, so the way back is weighed by a second run
    at the proposed values. Sites of branches keep to the branch that was drawn.

    Parameters
    ----------
    model : callable
        The program.
    scale : float
        Length of a step.
    steps : int
        Steps a move.
    """

    model: Model
    scale: float = 0.5
    steps: int = 1

    def __post_init__(self) -> None:
        number("scale", self.scale, above=0)
        whole("steps", self.steps)

    def move(
        self,
        rng: np.random.Generator,
        population: Population,
        previous: Population | None,
        observation: Any,
    ) -> Population:
        """Move; `notes` hold the share of accepted steps."""
        from mstfilter.smc.program_moves import metropolis

        before = None if previous is None else previous.particles
        particles, accepted = metropolis(
            rng, self.model, population.particles, before, observation, len(population), self.scale, self.steps
        )
        return Population(particles, population.log_weights, population.parents, {"accepted": accepted})

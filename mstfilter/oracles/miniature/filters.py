"""Properly weighted filters of the miniature world, made of the ordinary components.

>>> state, infos = bootstrap_filter(world, n=500).run(glances, seed=0)
>>> state, infos = guided_filter(world, n=500).run(glances, seed=0)
>>> state.log_evidence

Their particles are hypotheses. `guided_filter` draws from p(x_t | x_{t-1}, y_t), so one observation is filtered
without any error in the evidence; `balanced_filter` is MST's own scheme (moved hypotheses and samples of the new
image side by side) with weights that make it exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.oracles.miniature.world import Glance, Miniature, draw
from mstfilter.smc import (
    DensityTransition,
    EssBelow,
    ParticleFilter,
    Population,
    Proposal,
    Resampler,
    Reweight,
    Systematic,
    Trigger,
)

__all__ = ["GuidedPrior", "GuidedPush", "Prior", "Push", "bootstrap_filter", "guided_filter", "likelihood"]


@dataclass(frozen=True)
class Prior(Proposal):
    """Hypotheses from the prior.

    Parameters
    ----------
    world : Miniature
    """

    world: Miniature

    def sample(self, rng: np.random.Generator, observation: Glance | None, n: int) -> Population:
        """Draw `n`."""
        return Population(self.world.states.take(self.world.draw_prior(rng, n)))


@dataclass(frozen=True)
class Push(DensityTransition):
    """The motion model.

    Parameters
    ----------
    world : Miniature
    rearranged : bool
        Whether the table may be laid anew. A tracker, which follows objects, does not know of that.
    """

    world: Miniature
    rearranged: bool = True

    def predict(self, rng: np.random.Generator, population: Population, observation: Glance | None) -> Population:
        """Move all hypotheses by the push that the observation names; by a random push where it is missing."""
        world = self.world
        old = world.states.index(population.particles)
        new = world.move(rng, old, _action(observation), self.rearranged)
        return Population(world.states.take(new), population.log_weights, population.parents)

    def log_prob(self, previous: Any, new: Any, observation: Glance | None) -> np.ndarray:
        """(n,) log f."""
        index = self.world.states.index
        return self.world.log_transition(index(previous), index(new), _action(observation), self.rearranged)


@dataclass(frozen=True)
class GuidedPrior(Proposal):
    """Hypotheses from p(x_0 | y_0), weighted so that the likelihood completes them to p(y_0).

    Parameters
    ----------
    world : Miniature
    """

    world: Miniature

    def sample(self, rng: np.random.Generator, observation: Glance | None, n: int) -> Population:
        """Draw `n`."""
        world = self.world
        log_g = world.log_likelihood(observation)
        q = world.prior * np.exp(log_g)
        x = draw(rng, q, n)
        return Population(world.states.take(x), np.log(q.sum()) - log_g[x])


@dataclass(frozen=True)
class GuidedPush(DensityTransition):
    """Moves by p(x_t | x_{t-1}, y_t), the best that a proposal can do, and adds log f - log q.

    The law of a move has three parts: the push, the slip, the table laid anew. Each is weighed by the likelihood
    of where it leads.

    Parameters
    ----------
    world : Miniature
    """

    world: Miniature

    def predict(self, rng: np.random.Generator, population: Population, observation: Glance | None) -> Population:
        """Draw; by the motion model where the observation is missing."""
        if observation is None:
            return Push(self.world).predict(rng, population, None)
        world, n = self.world, len(population)
        old = world.states.index(population.particles)
        log_g = world.log_likelihood(observation)
        parts, anew = self._parts(old, observation, log_g)
        total = parts.sum(axis=1)
        which = (np.cumsum(parts, axis=1) <= (rng.random(n) * total)[:, None]).sum(axis=1)
        fresh = draw(rng, anew, n)
        new = np.choose(np.minimum(which, 2), [world.pushed[observation.action][old], old, fresh])
        gain = np.log(total) - log_g[new]
        return Population(world.states.take(new), population.log_weights + gain, population.parents)

    def log_prob(self, previous: Any, new: Any, observation: Glance | None) -> np.ndarray:
        """(n,) log q."""
        if observation is None:
            return Push(self.world).log_prob(previous, new, None)
        old, x = self.world.states.index(previous), self.world.states.index(new)
        log_g = self.world.log_likelihood(observation)
        parts, _ = self._parts(old, observation, log_g)
        return self.world.log_transition(old, x, observation.action) + log_g[x] - np.log(parts.sum(axis=1))

    def _parts(self, old: np.ndarray, y: Glance, log_g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) probability of each part times the likelihood there, and (S,) the last part's law."""
        world, g = self.world, np.exp(log_g)
        anew = world.prior * g
        stays, moves = world.slip * g[old], (1 - world.slip) * g[world.pushed[y.action][old]]
        kept = 1 - world.rearranged
        return np.stack([kept * moves, kept * stays, np.full(len(old), world.rearranged * anew.sum())], axis=1), anew


def likelihood(world: Miniature) -> Reweight:
    """The update by log p(y | x)."""
    return Reweight(lambda particles, y: world.log_likelihood(y)[world.states.index(particles)])


def bootstrap_filter(
    world: Miniature, n: int, resampler: Resampler | None = None, trigger: Trigger | None = None
) -> ParticleFilter:
    """Draws from the prior and the motion model, weighted by the likelihood."""
    return ParticleFilter(
        initial=Prior(world),
        transition=Push(world),
        update=likelihood(world),
        resampler=resampler if resampler is not None else Systematic(),
        trigger=trigger if trigger is not None else EssBelow(0.5),
        n=n,
    )


def guided_filter(
    world: Miniature, n: int, resampler: Resampler | None = None, trigger: Trigger | None = None
) -> ParticleFilter:
    """Draws that know the observation: p(x_0 | y_0) and p(x_t | x_{t-1}, y_t)."""
    return ParticleFilter(
        initial=GuidedPrior(world),
        transition=GuidedPush(world),
        update=likelihood(world),
        resampler=resampler if resampler is not None else Systematic(),
        trigger=trigger if trigger is not None else EssBelow(0.5),
        n=n,
    )


def _action(observation: Glance | None) -> int | None:
    return None if observation is None else observation.action

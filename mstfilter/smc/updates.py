"""Updates that need no images: reweighting by a likelihood, and chains of updates.

>>> update = Reweight(lambda particles, y: norm.logpdf(y, loc=particles, scale=0.5))
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.fields import part
from mstfilter.smc.interfaces import Update
from mstfilter.smc.population import Population

__all__ = ["Chain", "Reweight", "n_of", "union"]


@dataclass(frozen=True)
class Reweight(Update):
    """Adds a log likelihood to the log weights: the bootstrap filter's update.

    Parameters
    ----------
    log_likelihood : callable
        ``(particles, observation) -> (n,)`` log p(y | x).
    """

    log_likelihood: Callable[[Any, Any], np.ndarray]

    draws: ClassVar[bool] = False

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Any,
    ) -> Population:
        """Weigh the predicted particles; proposed ones join them where there are any."""
        population = union(predicted, proposed)
        found = np.asarray(self.log_likelihood(population.particles, observation))
        if found.shape != (len(population),):
            raise InputError(
                f"log likelihood has shape {found.shape}, expected ({len(population)},): one number a particle"
            )
        return population.reweighted(found)


@dataclass(frozen=True)
class Chain(Update):
    """Several updates in order. The first takes the proposed particles, the others see none."""

    updates: tuple[Update, ...]

    def __post_init__(self) -> None:
        for k, update in enumerate(self.updates):
            part(f"updates[{k}]", update, Update)

    @property
    def properly_weighted(self) -> bool:  # type: ignore[override]
        """Whether all of them are."""
        return all(update.properly_weighted for update in self.updates)

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Any,
    ) -> Population:
        """Apply them."""
        for update in self.updates:
            predicted = update.update(rng, predicted, proposed, observation)
            proposed = None
        return union(predicted, proposed)


def n_of(particles: Any) -> int:
    """How many particles there are."""
    return len(next(iter(particles.values()))) if isinstance(particles, Mapping) else len(particles)


def union(predicted: Population | None, proposed: Population | None) -> Population:
    """Predicted and proposed particles side by side, weights and parents kept; either may be None."""
    if predicted is None or proposed is None:
        population = predicted if predicted is not None else proposed
        if population is None:
            raise InputError("an update got neither predicted nor proposed particles")
        return population
    a, b = predicted.particles, proposed.particles
    particles: Any
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        particles = np.concatenate([a, b])
    elif isinstance(a, Mapping) and isinstance(b, Mapping):
        particles = {name: np.concatenate([a[name], b[name]]) for name in a}
    else:
        particles = (*a, *b)
    none_a, none_b = np.full(len(predicted), -1), np.full(len(proposed), -1)
    parents = {
        name: np.concatenate([predicted.parents.get(name, none_a), proposed.parents.get(name, none_b)])
        for name in ("previous", "proposed")
    }
    return Population(particles, np.concatenate([predicted.log_weights, proposed.log_weights]), parents)

"""Updates of two published filters, which are special cases of `ParticleFilter`.

The manifold filter (Koval, Pollard, Srinivasa 2015, 2017) projects particles onto the states that a contact allows.
The evolutionary filter (Kwok, Fang, Zhou 2005) crosses vectors. Neither is properly weighted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mstfilter.smc import Population, Update, union


@dataclass(frozen=True)
class ProjectOnto(Update):
    """Moves every particle onto the set of states that the observation allows, then weights it.

    ``project(particles, y)`` moves row by row; ``log_likelihood(particles, y)`` (n,) is of the projected particles.
    """

    project: Callable[[Any, Any], Any]
    log_likelihood: Callable[[Any, Any], np.ndarray] | None = None

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False
    step_functions: ClassVar = {"project": 2, "log_likelihood": 2}

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Any
    ) -> Population:
        population = union(predicted, proposed)
        projected = self.project(population.particles, observation)
        population = Population(projected, population.log_weights, population.parents)
        if self.log_likelihood is None:
            return population
        return population.reweighted(np.asarray(self.log_likelihood(population.particles, observation)))


@dataclass(frozen=True)
class CrossVectors(Update):
    """Adds a child for every second predicted particle, and weights all by the likelihood.

    A child takes each entry from one of two parents: a predicted particle, drawn by weight, and a proposed one (or,
    with `among`, a second predicted one, ``parents["mate"]``). Its weight is the mean of the parents' weights.
    """

    log_likelihood: Callable[[Any, Any], np.ndarray]
    among: bool = False

    #: The density of children is not known.
    properly_weighted: ClassVar[bool] = False
    step_functions: ClassVar = {"log_likelihood": 2}

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Any
    ) -> Population:
        population = union(predicted, proposed)
        mates = predicted if self.among else proposed
        if predicted is not None and mates is not None:
            population = union(population, self._children(rng, predicted, mates))
        return population.reweighted(np.asarray(self.log_likelihood(population.particles, observation)))

    def _children(self, rng: np.random.Generator, predicted: Population, mates: Population) -> Population:
        a, b = predicted.particles, mates.particles
        n = len(predicted) // 2
        i = rng.choice(len(predicted), n, p=predicted.weights)
        j = rng.choice(len(mates), n, p=mates.weights)
        children = np.where(rng.random((n, a.shape[1])) < 0.5, a[i], b[j])
        log_weights = np.logaddexp(predicted.log_weights[i], mates.log_weights[j]) - np.log(2)
        parents = {"previous": predicted.parents.get("previous", np.full(len(predicted), -1))[i]}
        name, source = ("mate", "previous") if mates is predicted else ("proposed", "proposed")
        parents[name] = mates.parents.get(source, np.full(len(mates), -1))[j]
        return Population(children, log_weights, parents)

"""Updates for particles that are vectors: projection onto what was observed, and crossover.

>>> update = ProjectOnto(lambda particles, y: particles / np.linalg.norm(particles, axis=1, keepdims=True))
>>> update = CrossVectors(log_likelihood)

Both show that published filters are the same driver with another Update: the manifold filter (Koval, Pollard,
Srinivasa 2015, 2017), which projects particles onto the set of states that a contact allows, and the evolutionary
filter (Kwok, Fang, Zhou 2005), which crosses vectors. Neither leaves proper weights, and neither reports evidence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.fields import number
from mstfilter.smc.interfaces import Update
from mstfilter.smc.population import Population
from mstfilter.smc.updates import union

__all__ = ["CrossVectors", "ProjectOnto"]


@dataclass(frozen=True)
class ProjectOnto(Update):
    """Moves every particle onto the set that the observation allows, then weighs it.

    Where an observation leaves a set of no volume (a contact), no draw of the dynamics lies in it and every weight
    would be zero; a projection puts the particles there.

    Parameters
    ----------
    project : callable
        ``(particles, y) -> particles``, row by row.
    log_likelihood : callable, optional
        ``(particles, y) -> (n,)`` of the projected particles: what the projection does not say.
    """

    project: Callable[[Any, Any], Any]
    log_likelihood: Callable[[Any, Any], np.ndarray] | None = None

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Any,
    ) -> Population:
        """Project and weigh."""
        population = union(predicted, proposed)
        projected = Population(
            self.project(population.particles, observation), population.log_weights, population.parents
        )
        if self.log_likelihood is None:
            return projected
        return projected.reweighted(np.asarray(self.log_likelihood(projected.particles, observation)))


@dataclass(frozen=True)
class CrossVectors(Update):
    """Children of pairs of vectors join their parents; all are weighed by the likelihood.

    A child takes each entry from one of two parents: from a predicted particle, drawn by weight, and from a proposed
    one (or, with `among`, from a second predicted one). Its weight is the mean of its parents'. Without proposed
    particles and without `among` nothing is crossed, and this is `Reweight`, bit for bit.

    Parameters
    ----------
    log_likelihood : callable
        ``(particles, y) -> (n,)``.
    share : float
        Children per predicted particle.
    among : bool
        Cross predicted particles with one another (Kwok et al.).
    """

    log_likelihood: Callable[[Any, Any], np.ndarray]
    share: float = 0.5
    among: bool = False

    def __post_init__(self) -> None:
        number("share", self.share, above=0)

    #: Children have no known density. Evidence is not reported even where none were made.
    properly_weighted: ClassVar[bool] = False

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Any,
    ) -> Population:
        """Cross and weigh."""
        population = union(predicted, proposed)
        mates = predicted if self.among else proposed
        if predicted is not None and mates is not None:
            population = union(population, self._children(rng, predicted, mates))
        return population.reweighted(np.asarray(self.log_likelihood(population.particles, observation)))

    def _children(self, rng: np.random.Generator, predicted: Population, mates: Population) -> Population:
        a, b = predicted.particles, mates.particles
        if (
            not isinstance(a, np.ndarray)
            or not isinstance(b, np.ndarray)
            or a.ndim != 2
            or a.shape[1:] != b.shape[1:]
        ):
            raise InputError("crossover of vectors needs particles (n, d) of one dimension")
        n = max(1, round(self.share * len(predicted)))
        i = rng.choice(len(predicted), n, p=predicted.weights)
        j = rng.choice(len(mates), n, p=mates.weights)
        children = np.where(rng.random((n, a.shape[1])) < 0.5, a[i], b[j])
        log_weights = np.logaddexp(predicted.log_weights[i], mates.log_weights[j]) - np.log(2)
        none = np.full(len(mates), -1)
        parents = {"previous": predicted.parents.get("previous", np.full(len(predicted), -1))[i]}
        if mates is not predicted:
            parents["proposed"] = mates.parents.get("proposed", none)[j]
        return Population(children, log_weights, parents)

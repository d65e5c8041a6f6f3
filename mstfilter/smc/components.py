"""Components that need no model: updates by a likelihood, a projection or crossover, and branching transitions.

>>> update = Reweight(lambda particles, y: norm.logpdf(y, loc=particles, scale=0.5))
>>> update = ProjectOnto(lambda particles, y: particles / np.linalg.norm(particles, axis=1, keepdims=True))
>>> update = CrossVectors(log_likelihood)
>>> transition = Branching(Dynamics(model), branches=4)

`ProjectOnto` and `CrossVectors` make published filters from `ParticleFilter`: the manifold filter (Koval, Pollard,
Srinivasa 2015, 2017), which projects particles onto the states that a contact allows, and the evolutionary filter
(Kwok, Fang, Zhou 2005), which crosses vectors. Neither is properly weighted, so no evidence is reported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mstfilter.errors import InputError, check_component, check_integer, check_number
from mstfilter.smc.interfaces import Transition, Update
from mstfilter.smc.population import Population, union


@dataclass(frozen=True)
class Reweight(Update):
    """Adds a log likelihood to the log weights: the update of the bootstrap filter.

    Proposed particles, if any, join the predicted ones.

    Parameters
    ----------
    log_likelihood : callable
        ``(particles, observation) -> (n,)`` log p(y | x).
    batched : bool
        Whether the function also takes particles (R, n, ...) and returns (R, n).
    """

    log_likelihood: Callable[[Any, Any], np.ndarray]
    batched: bool = False

    draws: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Any
    ) -> Population:
        population = union(predicted, proposed)
        found = np.asarray(self.log_likelihood(population.particles, observation))
        if found.shape != population.log_weights.shape:
            raise InputError(
                f"log likelihood has shape {found.shape}, expected {population.log_weights.shape}: one number per "
                "particle"
            )
        return population.reweighted(found)


@dataclass(frozen=True)
class ProjectOnto(Update):
    """Moves every particle onto the set of states that the observation allows, then weights it.

    If that set has no volume (a contact), no draw of the dynamics lies in it and every weight would be zero.

    Parameters
    ----------
    project : callable
        ``(particles, y) -> particles``, row by row.
    log_likelihood : callable, optional
        ``(particles, y) -> (n,)`` of the projected particles: the information that the projection does not use.
    """

    project: Callable[[Any, Any], Any]
    log_likelihood: Callable[[Any, Any], np.ndarray] | None = None

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

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
    """Adds children of pairs of vectors to the particles, and weights all by the likelihood.

    A child takes each entry from one of two parents: a predicted particle, drawn by weight, and a proposed one (or,
    with `among`, a second predicted one). Its weight is the mean of the parents' weights. Without proposed particles
    and without `among` there are no children, and this is `Reweight`, bit for bit.

    Parameters
    ----------
    log_likelihood : callable
        ``(particles, y) -> (n,)``.
    share : float
        Children per predicted particle.
    among : bool
        Cross predicted particles with each other (Kwok et al.); ``parents["mate"]`` is the second parent.
    """

    log_likelihood: Callable[[Any, Any], np.ndarray]
    share: float = 0.5
    among: bool = False

    #: The density of children is not known.
    properly_weighted: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_number("share", self.share, above=0)

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
        vectors = isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and a.ndim == 2
        if not vectors or a.shape[1:] != b.shape[1:]:
            raise InputError("crossover of vectors needs particles (n, d) of one dimension")
        n = max(1, round(self.share * len(predicted)))
        i = rng.choice(len(predicted), n, p=predicted.weights)
        j = rng.choice(len(mates), n, p=mates.weights)
        children = np.where(rng.random((n, a.shape[1])) < 0.5, a[i], b[j])
        log_weights = np.logaddexp(predicted.log_weights[i], mates.log_weights[j]) - np.log(2)
        parents = {"previous": predicted.parents.get("previous", np.full(len(predicted), -1))[i]}
        name, source = ("mate", "previous") if mates is predicted else ("proposed", "proposed")
        parents[name] = mates.parents.get(source, np.full(len(mates), -1))[j]
        return Population(children, log_weights, parents)


@dataclass(frozen=True)
class Branching(Transition):
    """Moves `branches` copies of every particle independently; the mean weight, and so the evidence, is kept.

    Schemes without duplicates (Fearnhead-Clifford, k-DPP, coalescing) need more candidates than particles; from n of
    n particles they keep all, and the filter degenerates. With discrete states and all successors as branches this is
    the filter of Fearnhead and Clifford (2003):

    >>> filter = replace(
    ...     bootstrap(model, n=50),
    ...     transition=Branching(Dynamics(model), branches=4),
    ...     resampler=FearnheadClifford(),
    ...     trigger=Never(),           # 200 candidates are more than 50 particles: they are always resampled
    ...     resample="after",
    ... )

    Parameters
    ----------
    inner : Transition
        Moves the copies.
    branches : int
        Copies of each particle; they are adjacent in the result.
    """

    inner: Transition
    branches: int = 4

    def __post_init__(self) -> None:
        check_component("inner", self.inner, Transition)
        check_integer("branches", self.branches)

    @property
    def properly_weighted(self) -> bool:
        return self.inner.properly_weighted

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        index = np.repeat(np.arange(len(population)), self.branches)
        copies = population.realised().take(index)
        moved = self.inner.predict(rng, copies.labelled({**copies.parents, "previous": index}), observation)
        if "previous" in moved.parents or len(moved) != len(index):
            return moved
        return moved.labelled({**moved.parents, "previous": index}, moved.notes)

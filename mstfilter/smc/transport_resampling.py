"""Resampling by position: equal particles are merged.

>>> import numpy as np
>>> from mstfilter.smc import Coalesced, FearnheadClifford, Population
>>> doubled = Population(np.array([1.0, 2.0, 1.0, 3.0]), np.log([1.0, 1.0, 2.0, 4.0]))
>>> Coalesced(FearnheadClifford()).resample(np.random.default_rng(0), doubled, 3).particles
array([2., 1., 3.])
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.errors import check_component
from mstfilter.smc.diverse_resampling import FearnheadClifford
from mstfilter.smc.interfaces import Resampler
from mstfilter.smc.population import Population
from mstfilter.smc.resampling import ResamplerWrapper
from mstfilter.smc.similarity import Equivalence, ExactEquality


@dataclass(frozen=True)
class Coalesced(ResamplerWrapper):
    """Merges equal particles, with the sum of their weights, before the selection.

    The result represents the same distribution with fewer particles. The population grows again only if a transition
    or update makes more candidates. ``notes["distinct"]`` is the number of different particles of positive weight.

    Parameters
    ----------
    equivalence : Equivalence
        Decides which particles are equal. The heaviest particle of a class is kept, the first of several.
    """

    scheme: Resampler = FearnheadClifford()  # noqa: RUF009 (frozen)
    equivalence: Equivalence = ExactEquality()  # noqa: RUF009 (frozen)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_component("equivalence", self.equivalence, Equivalence)

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        population = population.realised()
        classes = self.equivalence.classes(population.particles)
        representatives, log_weights = coalesce(population.log_weights, classes)
        chosen = self.scheme.resample(rng, population.take(representatives, log_weights), n)
        ancestors = representatives[chosen.parents["ancestor"]]
        return chosen.with_ancestors(ancestors, distinct=len(representatives))


def coalesce(log_weights: np.ndarray, classes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Select one particle for each class: the heaviest, with the weight of the class.

    Returns
    -------
    representatives : (k,) int
        The heaviest particle of each class (the first, if several have equal weights), ascending. Classes of weight
        zero are left out.
    log_weights : (k,) float64
        Log of the summed weights times k / m, which keeps the log mean of the weights.
    """
    lw = np.asarray(log_weights, dtype=np.float64)
    classes = np.asarray(classes)
    mass = np.bincount(classes, np.exp(lw - lw.max()))
    heaviest = np.lexsort((np.arange(len(lw)), -lw, classes))
    first = np.concatenate([[True], np.diff(classes[heaviest]) > 0])
    representatives = heaviest[first]
    representatives = np.sort(representatives[mass[classes[representatives]] > 0])
    total = np.log(mass[classes[representatives]]) + lw.max()
    return representatives, total + np.log(len(representatives) / len(lw))

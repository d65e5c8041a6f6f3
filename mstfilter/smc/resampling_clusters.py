"""Selection by clusters: every group of similar particles gets places by its mass, then particles are drawn inside.

>>> import numpy as np
>>> from mstfilter.smc.population import Population
>>> from mstfilter.smc.similarity import Gaussian
>>> groups = Population(np.array([0.0, 0.1, 0.2, 9.0]), np.log([3.0, 3.0, 3.0, 1.0]))
>>> chosen = ClusterStratified(Gaussian(1.0)).resample(np.random.default_rng(0), groups, 2)
>>> float(chosen.particles[1]), chosen.weights
(9.0, array([0.9, 0.1]))

A light group that differs from all others keeps a particle where plain schemes would lose it most of the time, and
the weights stay those of an exact filter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.fields import number, part
from mstfilter.smc.interfaces import Resampler
from mstfilter.smc.population import Population, log_mean_exp
from mstfilter.smc.resampling import Systematic, checked_weights
from mstfilter.smc.resampling_dpp import checked_similarity
from mstfilter.smc.resampling_optimal import FearnheadClifford
from mstfilter.smc.similarity import Gaussian, Similarity

__all__ = ["ClusterStratified", "leader_clusters"]


def leader_clusters(weights: np.ndarray, similarity: np.ndarray, at_least: float) -> np.ndarray:
    """(m,) cluster of each particle; -1 where it has no weight.

    The heaviest free particle leads a cluster of all free ones that are similar enough to it; and so on.
    """
    cluster = np.full(len(weights), -1, np.int64)
    number = 0
    for i in np.argsort(-weights, kind="stable"):
        if weights[i] <= 0:
            break
        if cluster[i] >= 0:
            continue
        members = (cluster < 0) & (weights > 0) & (similarity[i] >= at_least)
        members[i] = True
        cluster[members] = number
        number += 1
    return cluster


@dataclass(frozen=True)
class ClusterStratified(Resampler):
    """Places go to clusters by mass, at least one to each where n allows it; inside, particles are drawn by weight.

    With fewer places than clusters, Fearnhead-Clifford chooses clusters and their weights. With more, cluster g
    gets max(1, W_g / c) places on average, sum max(1, W_g / c) = n, rounded systematically. The particles of a
    cluster share its mass, so any such allocation is unbiased. Clusters below `least_mass` have no claim to a place:
    each gets W_g / c places on average, and where that is below one and it gets one, it stands for mass c.

    Parameters
    ----------
    similarity : Similarity
        How alike particles are.
    at_least : float
        Similarity to the leader from which on a particle belongs to its cluster, in (0, 1].
    scheme : Resampler
        Draws inside a cluster; sees only weights.
    least_mass : float
        Share of all weight from which on a cluster is sure of a place, in [0, 1).
    """

    similarity: Similarity = Gaussian()  # noqa: RUF009 (frozen)
    at_least: float = 0.5
    scheme: Resampler = Systematic()  # noqa: RUF009 (frozen)
    least_mass: float = 0.0

    exact_size: ClassVar[bool] = False

    @property
    def properly_weighted(self) -> bool:  # type: ignore[override]
        """As the scheme inside."""
        return self.scheme.properly_weighted

    def __post_init__(self) -> None:
        part("similarity", self.similarity, Similarity)
        part("scheme", self.scheme, Resampler)
        number("at_least", self.at_least, above=0, at_most=1, unit="similarity")
        number("least_mass", self.least_mass, at_least=0, below=1, unit="share of the weight")

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Not possible without the particles."""
        raise InputError("clusters are made of particles, and select sees only weights", "call resample")

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Select; `notes["clusters"]` is their number."""
        weights = checked_weights(population.log_weights, n)
        population = population.realised()
        cluster = leader_clusters(weights, checked_similarity(self.similarity, population), self.at_least)
        mass = np.bincount(cluster[cluster >= 0], weights[cluster >= 0])
        places, masses = self._allocate(rng, mass, n)
        ancestors, log_weights = [], []
        for g in np.flatnonzero(places):
            members = np.flatnonzero(cluster == g)
            inner, log_inner = self.scheme.select(rng, np.log(weights[members]), int(places[g]))
            if log_inner is None:
                log_inner = np.full(len(inner), log_mean_exp(np.log(weights[members])))
            # The scheme keeps the mean; the total is wanted here, scaled to the mass the cluster was given.
            scale = np.log(len(members) / len(inner)) + np.log(masses[g] / mass[g])
            ancestors.append(members[inner])
            log_weights.append(log_inner + scale)
        chosen_ancestors = np.concatenate(ancestors)
        out = np.concatenate(log_weights) + population.log_weights.max()
        out += np.log(len(chosen_ancestors) / len(weights))
        chosen = population.take(chosen_ancestors, out)
        notes = {**population.notes, "clusters": len(mass)}
        return replace(chosen, parents={**chosen.parents, "ancestor": chosen_ancestors}, notes=notes)

    def _allocate(self, rng: np.random.Generator, mass: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Places of each cluster (0: none), and the mass that each one stands for."""
        sure = mass >= self.least_mass * mass.sum()
        n_sure = int(sure.sum())
        if n_sure > n or (n_sure == n and not sure.all()):
            places, masses = np.zeros(len(mass), np.int64), np.zeros(len(mass))
            kept, log_masses = FearnheadClifford().select(rng, np.log(mass), n)
            places[kept] = 1
            masses[kept] = np.exp(log_masses) * (len(mass) / len(kept))
            return places, masses
        share = _shares(mass, sure, n)
        whole = np.floor(share * (1 + 1e-13)).astype(np.int64)
        rest = n - int(whole.sum())
        if rest > 0:
            with np.errstate(divide="ignore"):
                extra, _ = Systematic().select(rng, np.log(np.clip(share - whole, 0.0, None)), rest)
            whole += np.bincount(extra, minlength=len(mass))
        return whole, np.where(share < 1, mass / share, mass)


def _shares(mass: np.ndarray, sure: np.ndarray, n: int) -> np.ndarray:
    """max(1, mass / c) where `sure`, mass / c elsewhere, with sum n: at most n are sure, fewer if not all are."""
    ordered = np.sort(mass[sure])[::-1]
    heavy = np.append(0.0, np.cumsum(ordered)) + mass[~sure].sum()
    # With the A heaviest of S sure ones above one place each, these and the others share n - (S - A) places by mass.
    left = n - len(ordered) + np.arange(len(heavy))
    with np.errstate(divide="ignore", invalid="ignore"):
        c = np.where(left > 0, heavy / left, np.inf)
    share = mass / c[np.flatnonzero(np.append(np.inf, ordered) >= c)[-1]]
    return np.where(sure, np.maximum(1.0, share), share)

"""Resampling schemes that keep more distinct particles. The output weights are unequal.

A copy of a particle says nothing that the particle does not say. If output weights may differ, a heavy particle can
be kept once, with its weight, and the places go to others. `FearnheadClifford` keeps particle i with probability
min(1, w_i / c) and gives it the weight max(w_i, c), where c is such that n particles are kept on average:

>>> import numpy as np
>>> from mstfilter.smc import ClusterStratified, FearnheadClifford, Gaussian, Population
>>> rng = np.random.default_rng(0)
>>> population = Population(np.array([0.0, 0.1, 0.2, 9.0]), np.log([3.0, 3.0, 3.0, 1.0]))
>>> kept = FearnheadClifford().resample(rng, population, 3)
>>> len(set(kept.particles)), float(np.exp(kept.log_weights).mean().round(6))     # the mean weight stays the same
(3, 2.5)

Among all unbiased schemes without duplicates, this one has the least expected squared error of the weights (Fearnhead
and Clifford 2003). `Chopthin` duplicates too, but bounds the ratio of two output weights (Gandy and Lau 2016). Both
need only the weights. `ClusterStratified` compares particles by a `Similarity`: it forms groups of similar particles,
and divides the n particles to select among the groups by weight, at least one per group if possible. A light group
thus keeps a particle, while schemes that use only weights usually drop it. It is unbiased if the scheme with which it
selects inside the groups is (its field `scheme`, by default `Systematic`):

>>> chosen = ClusterStratified(Gaussian(1.0)).resample(rng, population, 2)
>>> float(chosen.particles[1]), chosen.weights
(9.0, array([0.9, 0.1]))

The schemes of this module are unbiased: the expected mean of w f(x) over the selected particles is that over all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import Bounds
from mstfilter.smc.interfaces import Resampler, Similarity, WeightResampler
from mstfilter.smc.population import Population, as_matrix, log_mean_exp
from mstfilter.smc.resampling import Systematic, checked_weights, inverse_cdf, systematic_copies


@dataclass(frozen=True)
class FearnheadClifford(WeightResampler):
    """Optimal resampling. Keeps particles with w_i >= c, and others with probability w_i / c and new weight c.

    c is the solution of sum min(1, w_i / c) = n. The lighter particles are selected systematically, so there are no
    duplicates. The total weight does not change. Among all unbiased random weights with at most n positive weights,
    the output weights have the least expected squared error. If at most n particles have positive weight, all of them
    are kept, and fewer than n particles may be returned. A filter that selects n of n particles therefore
    degenerates. Use more candidates than particles (`Branching`).

    >>> log_weights = np.log([4.0, 3.0, 1.0, 1.0, 1.0])
    >>> ancestors, log_weights = FearnheadClifford().select(np.random.default_rng(1), log_weights, 4)
    >>> ancestors
    array([0, 1, 2, 4])

    Reference: Fearnhead and Clifford (2003), "On-line inference for hidden Markov models via particle filters",
    Journal of the Royal Statistical Society B 65.
    """

    exact_size: ClassVar[bool] = False

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        weights = checked_weights(log_weights, n)
        lw = np.asarray(log_weights, dtype=np.float64)
        positive = np.flatnonzero(weights > 0)
        if len(positive) <= n:
            return positive, lw[positive] + np.log(len(positive) / len(lw))
        w = weights[positive]
        c, heavy = optimal_threshold(w, n)
        light = np.flatnonzero(~heavy)
        log_out = np.where(heavy, lw[positive], lw.max() + np.log(c))
        chosen = heavy
        scaled = w[light] / w[light].max()  # avoids underflow
        chosen[light[inverse_cdf(scaled, rng.random(1), n - int(heavy.sum()))]] = True
        # Adding log(n / m) keeps the log mean of the weights.
        return positive[chosen], log_out[chosen] + np.log(n / len(lw))


def optimal_threshold(weights: np.ndarray, n: int) -> tuple[float, np.ndarray]:
    """c with sum min(1, w_i / c) = n, and the (m,) bool mask of the weights with w_i >= c (fewer than n).

    The weights (m,) must be positive, and m must exceed n.
    """
    heavy, kept, c = np.zeros(len(weights), bool), 0, float(weights.sum()) / n
    while True:  # c decreases until all light weights are below c; takes a few rounds
        # Light weights are below c by more than rounding errors, so no light interval contains two points.
        heavy |= weights >= c * (1 - 1e-9)
        if int(heavy.sum()) == kept:
            return c, heavy
        kept = int(heavy.sum())
        if kept >= n:  # only by rounding: the sum of the light weights is negligible
            heavy = np.zeros(len(weights), bool)
            heavy[np.argsort(-weights, kind="stable")[: n - 1]] = True
            return float(weights[~heavy].sum()), heavy
        c = float(weights[~heavy].sum()) / (n - kept)


@dataclass(frozen=True)
class Chopthin(WeightResampler):
    """Bounds the ratio of the output weights: light particles are thinned, heavy particles are split into copies.

    With a threshold a, a particle of weight w gets on average h(w) copies:

    - w / a if w < a, and the copy has weight a;
    - 1 if w is between a and ratio a / 2, and the copy has weight w;
    - 2 w / (ratio a) if w is larger, and the copies share w equally.

    The threshold a is the solution of sum h(w_i) = n. Systematic resampling rounds each h(w) up or down. Exactly n
    particles are returned, and all output weights lie in [a, ratio a]. If n of n particles are selected and the
    largest weight is at most ratio / 2 times the smallest, the result equals the input.

    `ratio`, at least 4, is the largest allowed ratio of two output weights. The effective sample size is then at
    least 4 ratio / (1 + ratio)^2 times n, which is n / 2 for the default ratio of 3 + sqrt(8).

    Reference: Gandy and Lau (2016), "The chopthin algorithm for resampling", IEEE Transactions on Signal Processing
    64.
    """

    ratio: Annotated[float, Bounds(at_least=4)] = 3 + 8**0.5

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        weights = checked_weights(log_weights, n)
        lw = np.asarray(log_weights, dtype=np.float64)
        positive = np.flatnonzero(weights > 0)
        a = chopthin_threshold(weights[positive], n, self.ratio)
        # Light particles first: the number of those that are kept is then floor or ceil of its mean.
        light = weights[positive] < a
        order = positive[np.argsort(~light, kind="stable")]
        light, w = np.sort(light)[::-1], weights[order]
        expected = np.where(light, w / a, np.maximum(1.0, w * (2 / (self.ratio * a))))
        copies = systematic_copies(rng, expected, n)
        log_out = np.where(light, lw.max() + np.log(a), lw[order] - np.log(np.maximum(copies, 1)))
        # Adding log(n / m) keeps the log mean of the weights.
        return np.repeat(order, copies), np.repeat(log_out, copies) + np.log(n / len(lw))


def chopthin_threshold(weights: np.ndarray, n: int, ratio: float) -> float:
    """A threshold a with sum h(w_i) = n for positive weights (m,) (see `Chopthin`). There may be several."""
    w = np.sort(weights)
    # For a between neighbours among all w and 2 w / ratio, sum h = share / a + middle: particles below the index
    # `thinned` have w < a, those from `unchopped` on have w > ratio a / 2.
    limits = np.concatenate([w, w * (2 / ratio), [np.inf]])
    by_limit = np.argsort(limits, kind="stable")
    is_w = by_limit < len(w)
    thinned = np.append(0, np.cumsum(is_w)[:-1])
    unchopped = np.arange(len(limits)) - thinned
    total = np.append(0.0, np.cumsum(w))
    share = total[thinned] + (total[-1] - total[unchopped]) * (2 / ratio)
    middle = unchopped - thinned
    k = int(np.argmax(share / limits[by_limit] + middle <= n))  # sum h decreases: the first interval that reaches n
    return float(share[k] / (n - middle[k])) if share[k] > 0 else float(limits[by_limit[k]])


@dataclass(frozen=True)
class Gaussian(Similarity):
    """exp(-d^2 / (2 scale^2)) with the Euclidean distance d of array particles; positive semidefinite."""

    scale: Annotated[float, Bounds(above=0, unit="distance")] = 1.0

    def matrix(self, particles: Any) -> np.ndarray:
        from scipy.spatial.distance import cdist

        x = as_matrix(particles) / self.scale
        return np.exp(-0.5 * cdist(x, x, "sqeuclidean"))


#: Similarities of more particles than this are not computed: the matrix alone would take gigabytes.
MAX_PARTICLES = 10_000


def checked_similarity(similarity: Similarity, population: Population) -> np.ndarray:
    """(m, m) float64 similarities, made symmetric. InputError if a shape is wrong or a value is not finite."""
    m = len(population)
    if m > MAX_PARTICLES:
        raise InputError(
            f"similarities of {m} particles take a matrix of {m} x {m}, at most {MAX_PARTICLES} are compared",
            "select fewer first, for example by fearnhead_clifford",
        )
    matrix = np.asarray(similarity.matrix(population.realised().particles), dtype=np.float64)
    if matrix.shape != (m, m):
        raise InputError(f"similarities of {m} particles have shape {matrix.shape}, expected ({m}, {m})")
    if not np.isfinite(matrix).all():
        raise InputError(f"{int((~np.isfinite(matrix)).sum())} similarities are not finite")
    return (matrix + matrix.T) / 2


@dataclass(frozen=True)
class ClusterStratified(Resampler):
    """Divides n particles among clusters by weight (at least one per cluster if possible), and draws in each cluster.

    If n is below the number of clusters, Fearnhead-Clifford selects clusters and their weights. Otherwise cluster g
    of weight W_g gets max(1, W_g / c) particles on average, and c is the solution of sum max(1, W_g / c) = n. The
    numbers are rounded by systematic resampling. The particles of a cluster share its weight, so the scheme is
    unbiased for any numbers. A cluster below `least_mass` gets W_g / c particles on average and may lose all of them.
    If W_g / c < 1, its kept particle has weight c. ``notes["clusters"]`` is the number of clusters.

    Parameters
    ----------
    at_least : float
        Smallest similarity of a particle to the leader of its cluster, in (0, 1].
    scheme : Resampler
        The scheme that selects inside a cluster.
    least_mass : float
        Least share of the total weight for which a cluster always keeps a particle, in [0, 1).
    """

    similarity: Similarity = Gaussian()
    at_least: Annotated[float, Bounds(above=0, at_most=1, unit="similarity")] = 0.5
    scheme: Resampler = Systematic()  # noqa: RUF009 (frozen)
    least_mass: Annotated[float, Bounds(at_least=0, below=1, unit="share of the weight")] = 0.0

    exact_size: ClassVar[bool] = False

    @property
    def properly_weighted(self) -> bool:
        return self.scheme.properly_weighted

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        weights = checked_weights(population.log_weights, n)
        population = population.realised()
        cluster = leader_clusters(weights, checked_similarity(self.similarity, population), self.at_least)
        mass = np.bincount(cluster[cluster >= 0], weights[cluster >= 0])
        counts, masses = self._allocate(rng, mass, n)
        ancestors, log_weights = [], []
        for g in np.flatnonzero(counts):
            members = np.flatnonzero(cluster == g)
            inside, k = np.log(weights[members]), int(counts[g])
            if isinstance(self.scheme, WeightResampler):  # saves the time to make populations
                index, out = self.scheme.select(rng, inside, k)
                out = np.full(len(index), log_mean_exp(inside)) if out is None else out
            else:
                inner = self.scheme.resample(rng, population.take(members, inside), k)
                index, out = inner.parents["ancestor"], inner.log_weights
            # The scheme keeps the mean of the weights; here their sum is needed, scaled to the mass of the cluster.
            scale = np.log(len(members) / len(index)) + np.log(masses[g] / mass[g])
            ancestors.append(members[index])
            log_weights.append(out + scale)
        selected = np.concatenate(ancestors)
        out = np.concatenate(log_weights) + population.log_weights.max()
        out += np.log(len(selected) / len(weights))
        return population.select(selected, out, clusters=len(mass))

    def _allocate(self, rng: np.random.Generator, mass: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Number of particles of each cluster, and the total weight of these particles."""
        sure = mass >= self.least_mass * mass.sum()
        n_sure = int(sure.sum())
        if n_sure > n or (n_sure == n and not sure.all()):
            counts, masses = np.zeros(len(mass), np.int64), np.zeros(len(mass))
            kept, log_masses = FearnheadClifford().select(rng, np.log(mass), n)
            counts[kept] = 1
            masses[kept] = np.exp(log_masses) * (len(mass) / len(kept))
            return counts, masses
        share = _shares(mass, sure, n)
        counts = systematic_copies(rng, share, n)
        return counts, np.where(share < 1, mass / share, mass)


def leader_clusters(weights: np.ndarray, similarity: np.ndarray, at_least: float) -> np.ndarray:
    """(m,) cluster of each particle; -1 if the weight of the particle is zero.

    The heaviest unassigned particle becomes the leader of a new cluster. All unassigned particles with a similarity
    to the leader of `at_least` or more join the cluster. The procedure ends when all particles are assigned. Of
    several particles with equal weights, the first becomes the leader.
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


def _shares(mass: np.ndarray, sure: np.ndarray, n: int) -> np.ndarray:
    """Mean numbers of particles of clusters, with sum n: mass / c, but at least 1 if `sure` (at most n are sure)."""
    ordered = np.sort(mass[sure])[::-1]
    heavy = np.append(0.0, np.cumsum(ordered)) + mass[~sure].sum()
    # If the A heaviest of S sure clusters exceed 1, they and the unsure ones share n - (S - A) particles by mass.
    left = n - len(ordered) + np.arange(len(heavy))
    with np.errstate(divide="ignore", invalid="ignore"):
        c = np.where(left > 0, heavy / left, np.inf)
    share = mass / c[np.flatnonzero(np.append(np.inf, ordered) >= c)[-1]]
    return np.where(sure, np.maximum(1.0, share), share)

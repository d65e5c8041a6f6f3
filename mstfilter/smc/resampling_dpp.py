"""Diverse selection by a k-determinantal point process.

A determinantal process prefers sets of particles that are heavy AND unlike each other: the probability of a set A
of n particles is proportional to det L_A, L_ij = sqrt(w_i w_j) S_ij, with S a similarity. Two equal particles are
never chosen together. Each chosen particle i gets the weight w_i / pi_i, pi_i its probability of being chosen,
which makes the selection unbiased.

>>> import numpy as np
>>> from mstfilter.smc.population import Population
>>> from mstfilter.smc.similarity import Gaussian
>>> twins = Population(np.array([0.0, 0.01, 5.0]), np.log([4.0, 4.0, 1.0]))
>>> KDpp(similarity=Gaussian(1.0)).resample(np.random.default_rng(0), twins, 2).particles
array([0., 5.])

Reference: Kulesza and Taskar (2011), "k-DPPs: fixed-size determinantal point processes"; (2012), "Determinantal
point processes for machine learning", sections 2.4 and 5.2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.fields import part
from mstfilter.smc.interfaces import Resampler
from mstfilter.smc.population import Population, log_mean_exp
from mstfilter.smc.resampling import checked_weights
from mstfilter.smc.resampling_optimal import FearnheadClifford
from mstfilter.smc.similarity import Gaussian, Similarity

__all__ = ["KDpp", "checked_similarity", "inclusion", "sample_kdpp"]

#: Similarities of more particles than this are not computed: the matrix alone would take gigabytes.
MAX_PARTICLES = 10_000


def checked_similarity(similarity: Similarity, population: Population) -> np.ndarray:
    """(m, m) float64 symmetric similarities of a population's particles; an error where they are none."""
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
class Spectrum:
    """Eigenvalues and eigenvectors of a likelihood matrix L, and its elementary symmetric polynomials.

    Parameters
    ----------
    values : (r,) float64
        Positive eigenvalues, the largest is 1.
    vectors : (m, r) float64
        Orthonormal columns.
    log_e : (r + 1, k + 1) float64
        log e_l of the first j values, in row j and column l.
    """

    values: np.ndarray
    vectors: np.ndarray
    log_e: np.ndarray

    @classmethod
    def of(cls, L: np.ndarray, k: int) -> Spectrum:
        """Decompose a symmetric matrix; eigenvalues that are zero up to rounding, or negative, are left out."""
        values, vectors = np.linalg.eigh(L)
        keep = values > values[-1] * len(values) * np.finfo(np.float64).eps
        values, vectors = values[keep] / values[-1], vectors[:, keep]
        return cls(values, vectors, _log_polynomials(values, k))

    @property
    def rank(self) -> int:
        """Number of eigenvalues."""
        return len(self.values)


def _log_polynomials(values: np.ndarray, k: int) -> np.ndarray:
    """Row j, column l: log of the l-th elementary symmetric polynomial of the first j values."""
    table = np.full((len(values) + 1, k + 1), -np.inf)
    table[:, 0] = 0.0
    for j, log_value in enumerate(np.log(values)):
        table[j + 1, 1:] = np.logaddexp(table[j, 1:], log_value + table[j, :-1])
    return table


def inclusion(spectrum: Spectrum, k: int) -> np.ndarray:
    """(m,) probability of each item to be in a set of k.

    pi_i = sum_j v_ij^2 P(eigenvector j is used), P = value_j e_{k-1}(all values but j) / e_k. Leaving a value out
    combines the polynomials of those before and of those after it, which only adds positive numbers.
    """
    before = spectrum.log_e[:-1, :k]
    after = _log_polynomials(spectrum.values[::-1], k)[::-1][1:, :k]
    terms = before + after[:, ::-1]
    top = terms.max(axis=1)
    # Fewer than k - 1 other values: the polynomial is zero.
    finite = np.where(np.isneginf(top), 0.0, top)
    log_without = finite + np.log(np.maximum(np.exp(terms - finite[:, None]).sum(axis=1), np.finfo(np.float64).tiny))
    log_without[np.isneginf(top)] = -np.inf
    used = np.exp(np.log(spectrum.values) + log_without - spectrum.log_e[-1, k])
    return np.minimum(spectrum.vectors**2 @ used, 1.0)


def sample_kdpp(rng: np.random.Generator, spectrum: Spectrum, k: int) -> np.ndarray:
    """(k,) ascending items: k eigenvectors by the polynomials, then one item after the other by projection."""
    log_values, left, used = np.log(spectrum.values), k, []
    uniforms = rng.random(spectrum.rank)
    for j in range(spectrum.rank, 0, -1):
        if left == 0:
            break
        log_take = log_values[j - 1] + spectrum.log_e[j - 1, left - 1] - spectrum.log_e[j, left]
        if left == j or uniforms[j - 1] < np.exp(log_take):
            used.append(j - 1)
            left -= 1
    V = spectrum.vectors[:, used]
    norms = (V * V).sum(axis=1)
    rows, items = np.zeros((len(V), k)), np.empty(k, np.int64)
    for step in range(k):
        cumulative = np.cumsum(norms)
        i = int(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right"))
        i = min(i, int(np.searchsorted(cumulative, cumulative[-1], side="left")))
        items[step] = i
        rows[:, step] = (V @ V[i] - rows[:, :step] @ rows[i, :step]) / np.sqrt(norms[i])
        norms = np.maximum(norms - rows[:, step] ** 2, 0.0)
        norms[items[: step + 1]] = 0.0
    return np.sort(items)


@dataclass(frozen=True)
class KDpp(Resampler):
    """n heavy and mutually unlike particles, with weights w_i / pi_i: diverse and unbiased. Wants more than n.

    Parameters
    ----------
    similarity : Similarity
        How alike particles are. It is made positive semidefinite by leaving out negative eigenvalues.
    scheme : Resampler
        Selects instead where fewer than n particles are different from each other (rank of L below n);
        ``notes["kdpp"]`` says ``"rank 3 of 5: fallback"`` then and the rank in any case.
    """

    similarity: Similarity = Gaussian()  # noqa: RUF009 (frozen)
    scheme: Resampler = FearnheadClifford()  # noqa: RUF009 (frozen)

    def __post_init__(self) -> None:
        part("similarity", self.similarity, Similarity)
        part("scheme", self.scheme, Resampler)

    @property
    def properly_weighted(self) -> bool:  # type: ignore[override]
        """As the fallback is."""
        return self.scheme.properly_weighted

    exact_size: ClassVar[bool] = False

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Not possible without the particles."""
        raise InputError("a k-DPP looks at the particles, and select sees only weights", "call resample")

    def likelihood(self, population: Population) -> np.ndarray:
        """(p, p) L of the particles that have any weight, in units of the largest weight."""
        weights = checked_weights(population.log_weights, 1)
        positive = weights > 0
        root = np.sqrt(weights[positive])
        S = checked_similarity(self.similarity, population)[np.ix_(positive, positive)]
        values, vectors = np.linalg.eigh(S)
        if values[0] < 0:
            S = (vectors * np.maximum(values, 0.0)) @ vectors.T
        return root[:, None] * S * root[None, :]

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Select; light particles that no set of n is likely to hold weigh much if they are chosen."""
        checked_weights(population.log_weights, n)
        population = population.realised()
        positive = np.flatnonzero(checked_weights(population.log_weights, n) > 0)
        spectrum = Spectrum.of(self.likelihood(population), min(n, len(positive)))
        if spectrum.rank < n:
            chosen = self.scheme.resample(rng, population, n)
            return replace(chosen, notes={**chosen.notes, "kdpp": f"rank {spectrum.rank} of {n}: fallback"})
        items = sample_kdpp(rng, spectrum, n)
        ancestors = positive[items]
        log_weights = population.log_weights[ancestors] - np.log(inclusion(spectrum, n)[items])
        chosen = population.take(ancestors, log_weights + np.log(n / len(population)))
        notes = {
            **population.notes,
            "kdpp": f"rank {spectrum.rank} of {n}",
            "log_mean_weight_change": log_mean_exp(chosen.log_weights) - log_mean_exp(population.log_weights),
        }
        return replace(chosen, parents={**chosen.parents, "ancestor": ancestors}, notes=notes)

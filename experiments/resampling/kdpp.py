"""A resampler that selects heavy particles that differ from each other: a determinantal point process of fixed size.

    mstfilter check ./experiments/resampling/kdpp.py:KDpp
    mstfilter run RECORDING resampler=./experiments/resampling/kdpp.py:KDpp

`KDpp` draws a set A of n particles with probability proportional to det L_A, where L_ij = sqrt(w_i w_j) S_ij and S is
the similarity. Equal particles are never selected together. A selected particle gets the weight w_i / pi_i, where
pi_i is its selection probability, so the selection is unbiased. `KDpp` needs more candidates than particles to
select. The eigenproblems take 3,500 times as long as `Systematic` to select 250 of 1000 particles (README.md).

References: Kulesza and Taskar (2011), "k-DPPs: fixed-size determinantal point processes"; (2012), "Determinantal
point processes for machine learning", sections 2.4 and 5.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mstfilter.base.errors import check_component
from mstfilter.smc import FearnheadClifford, Gaussian, Population, Resampler, Similarity, log_mean_exp
from mstfilter.smc.diverse_resampling import checked_similarity
from mstfilter.smc.resampling import checked_weights


@dataclass(frozen=True)
class KDpp(Resampler):
    """n heavy particles that differ from each other, with weights w_i / pi_i.

    ``notes["kdpp"]`` has the rank of L, followed by ``"fallback"`` if `scheme` was used.

    Parameters
    ----------
    similarity : Similarity
        Compares particles. It is made positive semidefinite by dropping negative eigenvalues.
    scheme : Resampler
        Fallback if fewer than n particles differ from each other (rank of L below n).
    """

    similarity: Similarity = Gaussian()  # noqa: RUF009 (frozen)
    scheme: Resampler = FearnheadClifford()  # noqa: RUF009 (frozen)

    exact_size: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_component("similarity", self.similarity, Similarity)

    @property
    def properly_weighted(self) -> bool:
        return self.scheme.properly_weighted

    def likelihood(self, population: Population) -> np.ndarray:
        """L (p, p) of the particles with positive weight, with weights divided by the largest weight."""
        weights = checked_weights(population.log_weights, 1)
        positive = weights > 0
        root = np.sqrt(weights[positive])
        S = checked_similarity(self.similarity, population)[np.ix_(positive, positive)]
        try:
            np.linalg.cholesky(S + 1e-12 * np.eye(len(S)))  # a fraction of the time of eigenvalues
        except np.linalg.LinAlgError:
            values, vectors = np.linalg.eigh(S)
            S = (vectors * np.maximum(values, 0.0)) @ vectors.T
        return root[:, None] * S * root[None, :]

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        positive = np.flatnonzero(checked_weights(population.log_weights, n) > 0)
        population = population.realised()
        spectrum = Spectrum.of(self.likelihood(population), min(n, len(positive)))
        if spectrum.rank < n:
            chosen = self.scheme.resample(rng, population, n)
            return chosen.labelled(chosen.parents, {**chosen.notes, "kdpp": f"rank {spectrum.rank} of {n}: fallback"})
        items = sample_kdpp(rng, spectrum, n)
        ancestors = positive[items]
        log_weights = population.log_weights[ancestors] - np.log(inclusion(spectrum, n)[items])
        log_weights += np.log(n / len(population))
        change = log_mean_exp(log_weights) - log_mean_exp(population.log_weights)
        return population.select(
            ancestors, log_weights, kdpp=f"rank {spectrum.rank} of {n}", log_mean_weight_change=change
        )


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues and eigenvectors of a likelihood matrix L, and its elementary symmetric polynomials."""

    values: np.ndarray  #: (r,) positive eigenvalues, scaled to maximum 1
    vectors: np.ndarray  #: (m, r) orthonormal columns
    log_e: np.ndarray  #: (r + 1, k + 1) row j, column l: log e_l of the first j values

    @classmethod
    def of(cls, L: np.ndarray, k: int) -> Spectrum:
        """Decompose a symmetric matrix; eigenvalues that are negative, or zero up to rounding, are dropped."""
        values, vectors = np.linalg.eigh(L)
        keep = values > values[-1] * len(values) * np.finfo(np.float64).eps
        values, vectors = values[keep] / values[-1], vectors[:, keep]
        return cls(values, vectors, _log_polynomials(values, k))

    @property
    def rank(self) -> int:
        """Number of eigenvalues."""
        return len(self.values)


def _log_polynomials(values: np.ndarray, k: int) -> np.ndarray:
    """Logs of elementary symmetric polynomials: element (j, l) is the log of e_l(v_1 .. v_j).

    e_l(v_1 .. v_{j+1}) = e_l(v_1 .. v_j) + v_{j+1} e_{l-1}(v_1 .. v_j).
    """
    table = np.full((len(values) + 1, k + 1), -np.inf)
    table[:, 0] = 0.0
    for j, log_value in enumerate(np.log(values)):
        table[j + 1, 1:] = np.logaddexp(table[j, 1:], log_value + table[j, :-1])
    return table


def inclusion(spectrum: Spectrum, k: int) -> np.ndarray:
    """Probability (m,) of each item to be in a set of k items.

    pi_i = sum_j v_ij^2 P_j, where P_j = value_j e_{k-1}(all values but j) / e_k is the probability that eigenvector j
    is used. The polynomial of all values but j is a sum of positive terms: the convolution of the polynomials of the
    values before j and of the values after j.
    """
    before = spectrum.log_e[:-1, :k]
    after = _log_polynomials(spectrum.values[::-1], k)[::-1][1:, :k]
    terms = before + after[:, ::-1]
    top = terms.max(axis=1)
    finite = np.where(np.isneginf(top), 0.0, top)
    log_without = finite + np.log(np.maximum(np.exp(terms - finite[:, None]).sum(axis=1), np.finfo(np.float64).tiny))
    log_without[np.isneginf(top)] = -np.inf  # fewer than k - 1 other values: the polynomial is zero
    used = np.exp(np.log(spectrum.values) + log_without - spectrum.log_e[-1, k])
    return np.minimum(spectrum.vectors**2 @ used, 1.0)


def sample_kdpp(rng: np.random.Generator, spectrum: Spectrum, k: int) -> np.ndarray:
    """Draw a set of k items (k,), ascending: first k eigenvectors by the polynomials, then items by projection."""
    log_values, log_e, left, used = np.log(spectrum.values).tolist(), spectrum.log_e.tolist(), k, []
    uniforms = rng.random(spectrum.rank).tolist()
    for j in range(spectrum.rank, 0, -1):
        if left == 0:
            break
        log_take = log_values[j - 1] + log_e[j - 1][left - 1] - log_e[j][left]
        if left == j or uniforms[j - 1] < math.exp(min(log_take, 0.0)):
            used.append(j - 1)
            left -= 1
    V = spectrum.vectors[:, used]
    norms = (V * V).sum(axis=1)
    rows, items = np.zeros((len(V), k)), np.empty(k, np.int64)
    for step in range(k):
        cumulative = norms.cumsum()
        i = int(cumulative.searchsorted(rng.random() * cumulative[-1], side="right"))
        items[step] = i = min(i, int(cumulative.searchsorted(cumulative[-1])))
        # Gram-Schmidt: subtract from all items their component along item i.
        rows[:, step] = (V @ V[i] - rows[:, :step] @ rows[i, :step]) / np.sqrt(norms[i])
        norms = np.maximum(norms - rows[:, step] ** 2, 0.0)
        norms[items[: step + 1]] = 0.0
    return np.sort(items)

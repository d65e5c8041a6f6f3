"""The k-DPP of experiments/resampling: its law by enumeration of all sets."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from mstfilter.smc import Population, Similarity, log_mean_exp
from tests.experiments.scripts import import_script

kdpp = import_script("resampling/kdpp.py")


def example(m, seed=3):
    rng = np.random.default_rng(seed)
    return Population(rng.standard_normal((m, 2)), np.log(rng.random(m)) - 700)


def sets_of(population, k):
    """All sets of k particles, and their probabilities by determinants."""
    L = kdpp.KDpp().likelihood(population)
    sets = list(combinations(range(len(L)), k))
    p = np.array([np.linalg.det(L[np.ix_(s, s)]) for s in sets])
    return sets, p / p.sum()


@pytest.mark.parametrize("k", [1, 2, 4, 5])
def test_output_weights_by_enumeration(k, monkeypatch):
    """Every set with its probability, with the weights that resample gives it."""
    population, found = example(5), np.zeros(5)
    for chosen_set, p in zip(*sets_of(population, k), strict=True):
        monkeypatch.setattr(kdpp, "sample_kdpp", lambda *_, s=chosen_set: np.array(s))
        chosen = kdpp.KDpp().resample(np.random.default_rng(0), population, k)
        assert chosen.notes["kdpp"] == f"rank 5 of {k}"
        found[list(chosen_set)] += p * np.exp(chosen.log_weights + 700) / k
    np.testing.assert_allclose(found, np.exp(population.log_weights + 700) / 5, rtol=1e-9)


@pytest.mark.nightly
def test_sets_by_enumeration():
    """Chi-square of all 35 sets of three; false alarm 1e-6."""
    population, rng = example(7), np.random.default_rng(1)
    sets, p = sets_of(population, 3)
    spectrum, number = kdpp.Spectrum.of(kdpp.KDpp().likelihood(population), 3), {s: i for i, s in enumerate(sets)}
    drawn = [number[tuple(kdpp.sample_kdpp(rng, spectrum, 3).tolist())] for _ in range(20_000)]
    found, expected = np.bincount(drawn, minlength=len(sets)), 20_000 * p
    often = expected > 5
    found, expected = np.append(found[often], found[~often].sum()), np.append(expected[often], expected[~often].sum())
    assert stats.chisquare(found, expected).pvalue > 1e-6


def test_it_falls_back_where_too_few_differ():
    population = Population(np.array([1.0, 1.0, 1.0, 2.0]))
    chosen = kdpp.KDpp().resample(np.random.default_rng(0), population, 3)
    assert chosen.notes["kdpp"] == "rank 2 of 3: fallback"
    assert len(chosen) == 3 and log_mean_exp(chosen.log_weights) == pytest.approx(0.0)


class Odd(Similarity):
    """Not positive semidefinite."""

    def matrix(self, particles):
        S = np.eye(len(particles))
        S[0, 1] = S[1, 0] = S[1, 2] = S[2, 1] = 0.9
        return S


def test_similarities_that_are_no_kernel_are_projected():
    population = Population(np.arange(4.0), np.log([1.0, 2.0, 1.0, 1.0]))
    assert np.linalg.eigvalsh(Odd().matrix(population.particles))[0] < -0.1
    assert np.linalg.eigvalsh(kdpp.KDpp(Odd()).likelihood(population))[0] > -1e-12
    chosen = kdpp.KDpp(Odd()).resample(np.random.default_rng(0), population, 2)
    assert len(set(chosen.particles.tolist())) == 2

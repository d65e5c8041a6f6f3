"""Laws of resampling schemes by enumeration of every outcome, for few particles: no sampling, only rounding.

Weights are small whole numbers, so that what the single uniforms decide changes at multiples of 1 / cells only.
"""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.smc import (
    Bins,
    Chopthin,
    ClusterStratified,
    Coalesced,
    FearnheadClifford,
    Gaussian,
    Killing,
    Multinomial,
    Population,
    Residual,
    Shuffled,
    Sorted,
    Ssp,
    Stratified,
    Systematic,
    Tempered,
    resampling,
)
from mstfilter.smc.diverse_resampling import optimal_threshold
from mstfilter.smc.resampling import inverse_cdf
from tests.smc.enumeration import ConstantGenerator as Uniform, outcomes


def log_of(weights):
    with np.errstate(divide="ignore"):
        return np.log(np.asarray(weights, dtype=np.float64))


def copies_law(scheme, weights, n, cells=1, coins=False):
    """Mean (m,) and covariance (m, m) of the numbers of copies, and all numbers that occur."""
    m = len(weights)
    found = list(
        outcomes(lambda rng: np.bincount(scheme.select(rng, log_of(weights), n)[0], minlength=m), cells, coins)
    )
    p, counts = np.array([q for q, _ in found]), np.array([c for _, c in found])
    mean = p @ counts
    return mean, (counts - mean).T @ (p[:, None] * (counts - mean)), counts[p > 0]


CASES = [
    ((1, 3, 2, 2), 4),
    ((1, 3, 2, 2), 3),
    ((1, 3, 2, 2), 6),
    ((5, 0, 1, 2), 1),
    ((1, 1, 1), 2),
    ((3, 1), 5),
    ((2,), 3),
]


def expected_of(weights, n):
    W = np.array(weights) / np.sum(weights)
    return W, n * W, n * W - np.floor(n * W + 1e-12)


@pytest.mark.parametrize(("weights", "n"), CASES)
def test_ssp(weights, n):
    """Mean n W, variance f (1 - f), floor or ceil, and no two numbers lean on each other: all exactly."""
    mean, cov, counts = copies_law(Ssp(), weights, n, coins=True)
    _, expected, f = expected_of(weights, n)
    np.testing.assert_allclose(mean, expected, atol=1e-12)
    np.testing.assert_allclose(np.diag(cov), f * (1 - f), atol=1e-12)
    assert (counts.sum(axis=1) == n).all()
    assert ((counts >= np.floor(expected + 1e-9)) & (counts <= np.ceil(expected - 1e-9))).all()
    assert (cov - np.diag(np.diag(cov)) <= 1e-12).all()


@pytest.fixture
def enumerated_uniforms(monkeypatch):
    """Sorted uniforms as the multiset of the particles that they fall to, with its probability."""

    def ordered(weights):
        W = np.array(weights) / np.sum(weights)
        middle = np.cumsum(W) - W / 2

        def draw(rng, k, runs=()):
            assert runs == ()
            return np.sort([middle[rng.digit(W)] for _ in range(k)])

        monkeypatch.setattr(resampling, "ordered_uniforms", draw)

    return ordered


@pytest.mark.parametrize(("weights", "n"), [case for case in CASES if case[1] * len(case[0]) < 21])
def test_killing(weights, n, enumerated_uniforms):
    """Mean n W for any n; for n = m the variance of its docstring."""
    enumerated_uniforms(weights)
    mean, cov, counts = copies_law(Killing(), weights, n, coins=True)
    W, expected, _ = expected_of(weights, n)
    np.testing.assert_allclose(mean, expected, atol=1e-12)
    assert (counts.sum(axis=1) == n).all()
    if n == len(W):
        p = W / W.max()
        alive = p * (1 - p)
        variance = alive * (1 - 2 * W) + W**2 * alive.sum() + (n - p.sum()) * W * (1 - W)
        np.testing.assert_allclose(np.diag(cov), variance, atol=1e-12)


@pytest.mark.parametrize(("weights", "n"), CASES)
def test_multinomial_and_residual(weights, n, enumerated_uniforms):
    enumerated_uniforms(weights)
    W, expected, f = expected_of(weights, n)
    mean, cov, _ = copies_law(Multinomial(), weights, min(n, 5))
    np.testing.assert_allclose(mean, min(n, 5) * W, atol=1e-12)
    np.testing.assert_allclose(cov, min(n, 5) * (np.diag(W) - np.outer(W, W)), atol=1e-12)
    if f.sum() > 1e-9:
        enumerated_uniforms(f)
    mean, cov, _ = copies_law(Residual(), weights, n)
    np.testing.assert_allclose(mean, expected, atol=1e-12)
    np.testing.assert_allclose(np.diag(cov), f * (1 - f / max(f.sum(), 1e-12)), atol=1e-9)


@pytest.mark.parametrize(("weights", "n"), CASES)
@pytest.mark.parametrize("scheme", [Systematic(), Stratified()], ids=["systematic", "stratified"])
def test_schemes_of_uniforms(scheme, weights, n):
    """One uniform, or one a stratum; jumps at multiples of one over the total weight."""
    by_strata = scheme == Stratified()
    n = min(n, 4) if by_strata else n
    mean, cov, counts = copies_law(scheme, weights, n, cells=int(np.sum(weights)))
    _, expected, f = expected_of(weights, n)
    np.testing.assert_allclose(mean, expected, atol=1e-12)
    assert (counts.sum(axis=1) == n).all()
    variance = f * (1 - f)
    if by_strata:  # the sum over the strata, of which a particle covers the share p
        ends = np.cumsum(expected)[:, None]
        begins, k = np.vstack([[0.0], ends[:-1]]), np.arange(n)
        p = np.clip(np.minimum(ends, k + 1) - np.maximum(begins, k), 0, None)
        variance = (p * (1 - p)).sum(axis=1)
    np.testing.assert_allclose(np.diag(cov), variance, atol=1e-12)


def carried(scheme, population, n, **how):
    """(m,) expectation of what each particle carries: the output weights of its copies, by the number of all."""
    m, total = len(population), np.zeros(len(population))

    def run(rng):
        chosen = scheme.resample(rng, population, n)
        return np.bincount(chosen.parents["ancestor"], np.exp(chosen.log_weights), minlength=m) / len(chosen)

    for p, found in outcomes(run, **how):
        total += p * found
    return total


def of(x, weights):
    return Population(np.array(x), log_of(weights))


GROUPS = of([0.0, 0.1, 5.0, 5.1, 9.0], [3.0, 1.0, 1.0, 1.0, 2.0])  # clusters of mass 4, 2 and 2: jumps at quarters


@pytest.mark.parametrize("least_mass", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8])
def test_clusters(n, least_mass):
    """Fewer places than clusters, as many, and more; all, one or none sure of a place: all carry their weight."""
    scheme = ClusterStratified(Gaussian(1.0), least_mass=least_mass)
    found = carried(scheme, GROUPS, n, cells=4)
    np.testing.assert_allclose(found, np.exp(GROUPS.log_weights) / 5, atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_shuffled_and_coalesced(n):
    """All orders of the particles; equal ones are merged, and each carries its weight on average."""
    population = of([1.0, 2.0, 1.0, 3.0], [1.0, 2.0, 3.0, 2.0])
    found = carried(Shuffled(), population, n, cells=8)
    np.testing.assert_allclose(found, np.exp(population.log_weights) / 4, atol=1e-12)
    for scheme in (Coalesced(Systematic()), Tempered(Coalesced(Systematic()), 0.0)):
        population = of([1.0, 2.0, 1.0, 3.0, 4.0], [1.0, 2.0, 3.0, 2.0, 0.0])
        found = carried(scheme, population, n, cells=8)
        np.testing.assert_allclose(found, np.exp(population.log_weights) / 5, atol=1e-12)


def test_distinct_particles_take_no_random_numbers():
    """Particles that all differ are merged by nothing, so the stream of the inner scheme is the same."""
    population = of([1.0, 2.0, 4.0, 3.0], [1.0, 2.0, 3.0, 2.0])
    chosen = [s.resample(np.random.default_rng(3), population, 3) for s in (Systematic(), Coalesced(Systematic()))]
    np.testing.assert_array_equal(*(c.parents["ancestor"] for c in chosen))


@pytest.mark.parametrize("weights", [(1.0, 3.0, 0.0, 4.0), (1.0, 3.0, 2.0, 2.0)])
def test_bins_do_not_bias_the_mean_of_a_function(weights):
    """A bin of unequal particles: the weighted mean does not change on average. The heaviest would bias it."""
    population = of([0.1, 0.9, 0.5, 1.5], weights)
    total = sum(
        p * np.exp(chosen.log_weights) @ chosen.particles / len(chosen)
        for p, chosen in outcomes(lambda r: Coalesced(Systematic(), Bins()).resample(r, population, 3), cells=24)
    )
    assert total == pytest.approx(np.array(weights) @ population.particles / 4, abs=1e-12)


CHOPPED = [(1.0, 4.0, 1.0, 2.0), (40.0, 1.0, 1.0, 2.0), (3.0, 3.0), (1.0,), (0.0, 1.0, 12.0)]


@pytest.mark.parametrize("weights", CHOPPED)
@pytest.mark.parametrize("n", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("ratio", [4.0, 3 + 8**0.5, 25.0])
def test_chopthin(weights, n, ratio):
    """The mean over the uniform, exactly: the result changes where cumulative fractions end."""
    population = of(np.arange(float(len(weights))), weights)
    fractions: list[np.ndarray] = []

    def spy(weights, shifts, rest):
        fractions.append(np.cumsum(weights) * (rest / weights.sum()))
        return inverse_cdf(weights, shifts, rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resampling, "inverse_cdf", spy)
        Chopthin(ratio).resample(Uniform(0.5), population, n)
    jumps = np.unique([0.0, 1.0, *np.mod(np.concatenate([[], *fractions]), 1.0)])
    total = np.zeros(len(weights))
    for a, b in pairwise(jumps):
        chosen = Chopthin(ratio).resample(Uniform((a + b) / 2), population, n)
        assert len(chosen) == n
        assert np.ptp(chosen.log_weights) <= np.log(ratio) + 1e-9
        carried = np.bincount(chosen.parents["ancestor"], np.exp(chosen.log_weights), minlength=len(weights)) / n
        total += (b - a) * carried
    np.testing.assert_allclose(total, np.array(weights) / len(weights), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 4, 5])
def test_sorted(n):
    """The law of copies of the scheme in the sorted order; chosen particles keep their ancestors."""
    population = of([2.0, -1.0, 0.5, 1.0], [1.0, 3.0, 2.0, 2.0])
    found = carried(Sorted(Systematic()), population, n, cells=8)
    np.testing.assert_allclose(found, np.exp(population.log_weights) / 4, atol=1e-12)
    chosen = Sorted(Stratified()).resample(np.random.default_rng(0), population, n)
    np.testing.assert_array_equal(chosen.particles, population.particles[chosen.parents["ancestor"]])


def test_enumeration_would_see_a_bias():
    """The harness on schemes that are wrong by little: it is exact, so every bias is seen."""

    class Off(Systematic):
        def select(self, rng, log_weights, n):
            return super().select(rng, log_weights + np.array([0.01, 0.0, 0.0, 0.0]), n)

    mean, _, _ = copies_law(Off(), (1, 3, 2, 2), 3, cells=800)
    assert np.abs(mean - 3 * np.array([1, 3, 2, 2]) / 8).max() > 1e-3
    pairs = list(product(range(2), repeat=2))
    assert [r for _, r in outcomes(lambda rng: (rng.digit([1, 1]), rng.digit([1, 1])))] == pairs


# --- unequal output weights: integrals over the one uniform, and invariants ---------------------------------------
positive_weights = st.lists(st.floats(0.01, 10.0), min_size=1, max_size=12)


def expectation(scheme, lw, n, breaks):
    """E of what each particle carries, by exact integration over the one uniform that a scheme draws."""
    edges = np.unique(np.concatenate([[0.0, 1.0], np.mod(breaks, 1.0)]))
    carried = np.zeros(len(lw))
    included = np.zeros(len(lw))
    for a, b in pairwise(edges):
        chosen = scheme.resample(Uniform((a + b) / 2), Population(np.arange(len(lw)), lw), n)
        ancestors = chosen.parents["ancestor"]
        carried += (b - a) * np.bincount(ancestors, np.exp(chosen.log_weights), minlength=len(lw)) / len(ancestors)
        included += (b - a) * (np.bincount(ancestors, minlength=len(lw)) > 0)
    return carried, included


@settings(max_examples=150, deadline=None)
@given(weights=positive_weights, n=st.integers(1, 14))
def test_fearnhead_clifford_by_quadrature(weights, n):
    w = np.array(weights)
    m = len(w)
    if n < m:
        c, heavy = optimal_threshold(w, n)
        assert np.minimum(1, w / c).sum() == pytest.approx(n, abs=1e-6)
        breaks, want = np.cumsum(w[~heavy]) / c, np.minimum(1, w / c)
    else:
        breaks, want = np.zeros(0), np.ones(m)
    carried, included = expectation(FearnheadClifford(), np.log(w) + 5, n, breaks)
    np.testing.assert_allclose(carried, np.exp(5.0) * w / m, rtol=1e-6)
    np.testing.assert_allclose(included, want, atol=1e-6)


@settings(max_examples=100, deadline=None)
@given(weights=positive_weights, n=st.integers(1, 14), power=st.floats(0, 1))
def test_tempered_systematic_by_quadrature(weights, n, power):
    lw = np.log(weights)
    alpha = np.exp(power * lw)
    carried, _ = expectation(Tempered(Systematic(), power), lw, n, n * np.cumsum(alpha) / alpha.sum())
    np.testing.assert_allclose(carried, np.array(weights) / len(lw), rtol=1e-6)


def test_shuffling_changes_neighbours():
    """Systematic draws of equal weights take every second particle; shuffled ones take any half."""
    population = of(np.arange(4.0), [1.0] * 4)
    found = {
        tuple(sorted(chosen.particles))
        for _, chosen in outcomes(lambda rng: Shuffled().resample(rng, population, 2), cells=2)
    }
    assert len(found) == 6


def test_light_clusters_have_no_sure_place():
    """Of four clusters two hold .1 % of the weight each: they come in .5 % of draws, and stand for one place."""
    population = of([0.0, 10.0, 20.0, 30.0], [0.698, 0.3, 0.001, 0.001])
    scheme, n_light = ClusterStratified(Gaussian(1.0), least_mass=0.05), 0
    for seed in range(1000):
        chosen = scheme.resample(np.random.default_rng(seed), population, 5)
        light = chosen.parents["ancestor"] >= 2
        n_light += light.sum()
        assert np.exp(chosen.log_weights[light]) == pytest.approx(0.25, rel=0.01)
    assert 0 < n_light < 30

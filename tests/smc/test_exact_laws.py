"""Laws of resampling schemes by enumeration of every outcome, for few particles: no sampling, only rounding.

Weights are small whole numbers, so that what the single uniforms decide changes at multiples of 1 / cells only.
"""

from __future__ import annotations

from itertools import combinations, pairwise, product

import numpy as np
import pytest

from mstfilter.smc import (
    Chopthin,
    ClusterStratified,
    Coalesced,
    FearnheadClifford,
    Gaussian,
    KDpp,
    Killing,
    Metropolis,
    Multinomial,
    Population,
    Rejection,
    Residual,
    Shuffled,
    Sorted,
    Ssp,
    Stratified,
    Systematic,
    Tempered,
    diverse_resampling,
    resampling,
)
from mstfilter.smc.resampling import systematic_ancestors
from tests.smc.enumeration import outcomes


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
@pytest.mark.parametrize(
    "scheme",
    [Systematic(), Residual("systematic"), Stratified(), Residual("stratified")],
    ids=["systematic", "residual-systematic", "stratified", "residual-stratified"],
)
def test_schemes_of_uniforms(scheme, weights, n):
    """One uniform, or one a stratum; jumps at multiples of one over the total weight."""
    if isinstance(scheme, Stratified) or scheme == Residual("stratified"):
        n = min(n, 4)
    mean, cov, counts = copies_law(scheme, weights, n, cells=int(np.sum(weights)))
    _, expected, f = expected_of(weights, n)
    np.testing.assert_allclose(mean, expected, atol=1e-12)
    assert (counts.sum(axis=1) == n).all()
    if not isinstance(scheme, Stratified) and scheme != Residual("stratified"):
        np.testing.assert_allclose(np.diag(cov), f * (1 - f), atol=1e-12)


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


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_fearnhead_clifford_and_tempered_optimal(n):
    population = of(np.arange(4.0), [1.0, 4.0, 1.0, 2.0])
    want = np.exp(population.log_weights) / 4
    np.testing.assert_allclose(carried(FearnheadClifford(), population, n, cells=24), want, atol=1e-12)
    flat = Tempered(FearnheadClifford(), 0.0)
    np.testing.assert_allclose(carried(flat, population, n, cells=24), want, atol=1e-12)
    # Square roots of these weights are whole numbers as well.
    squares = of(np.arange(4.0), [1.0, 4.0, 9.0, 4.0])
    root = Tempered(Systematic(), 0.5)
    np.testing.assert_allclose(carried(root, squares, n, cells=8), np.exp(squares.log_weights) / 4, atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_shuffled_and_coalesced(n):
    """All orders of the particles; equal ones merged, whose weight the heaviest carries."""
    population = of([1.0, 2.0, 1.0, 3.0], [1.0, 2.0, 3.0, 2.0])
    found = carried(Shuffled(), population, n, cells=8)
    np.testing.assert_allclose(found, np.exp(population.log_weights) / 4, atol=1e-12)
    found = carried(Coalesced(Systematic()), population, n, cells=8)
    np.testing.assert_allclose(found, np.array([0.0, 2.0, 4.0, 2.0]) / 4, atol=1e-12)


@pytest.mark.parametrize(("weights", "n"), [((1, 3, 2), 3), ((1, 3, 2), 2), ((3, 1), 3), ((2, 0, 1), 2)])
def test_rejection(weights, n, enumerated_uniforms):
    """Mean n W and the covariance of killing, also with the draws by weight after the second trial."""
    enumerated_uniforms(weights)
    mean, cov, _ = copies_law(Rejection(max_trials=2), weights, n, coins=True)
    np.testing.assert_allclose(mean, expected_of(weights, n)[1], atol=1e-12)
    np.testing.assert_allclose(cov, copies_law(Killing(), weights, n, coins=True)[1], atol=1e-12)


@pytest.mark.parametrize("weights", [(1, 3, 2), (2, 0, 1)])
def test_metropolis(weights):
    """Two steps of the chain, by powers of its transition matrix; its bound of the total variation holds."""
    mean, _, _ = copies_law(Metropolis(max_steps=2), weights, 2, coins=True)
    w = np.array(weights, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        P = np.where(w[:, None] > 0, np.minimum(1, w[None, :] / w[:, None]), 1.0) / 3
    P += np.diag(1 - P.sum(axis=1))
    start = np.where(w > 0, np.arange(3), np.argmax(w))  # weight zero starts at the heaviest
    start_law = np.bincount(start, minlength=3) / 3  # two positions belong to a random pair of particles
    np.testing.assert_allclose(mean / 2, start_law @ P @ P, atol=1e-12)
    steps = Metropolis(tolerance=0.05).steps(w / w.max())
    assert 0.5 * np.abs(np.linalg.matrix_power(P, steps)[w > 0] - w / w.sum()).sum(axis=1).max() <= 0.05
    assert steps > 1


CHOPPED = [(1.0, 4.0, 1.0, 2.0), (40.0, 1.0, 1.0, 2.0), (3.0, 3.0), (1.0,), (0.0, 1.0, 12.0)]


@pytest.mark.parametrize("weights", CHOPPED)
@pytest.mark.parametrize("n", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("ratio", [4.0, 3 + 8**0.5, 25.0])
def test_chopthin(weights, n, ratio):
    """The mean over the uniform, exactly: the result changes where cumulative fractions end."""
    population = of(np.arange(float(len(weights))), weights)
    uniforms: list[float] = []
    fractions: list[np.ndarray] = []

    class One(np.random.Generator):
        def random(self):
            return uniforms[0]

    def spy(cumulative, rest, shift):
        fractions.append(cumulative * (rest / cumulative[-1]))
        return systematic_ancestors(cumulative, rest, shift)

    uniforms[:] = [0.5]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diverse_resampling, "systematic_ancestors", spy)
        Chopthin(ratio).resample(One(np.random.PCG64(0)), population, n)
    jumps = np.unique([0.0, 1.0, *np.mod(np.concatenate([[], *fractions]), 1.0)])
    total = np.zeros(len(weights))
    for a, b in pairwise(jumps):
        uniforms[:] = [(a + b) / 2]
        chosen = Chopthin(ratio).resample(One(np.random.PCG64(0)), population, n)
        assert len(chosen) == n
        assert np.ptp(chosen.log_weights) <= np.log(ratio) + 1e-9
        carried = np.bincount(chosen.parents["ancestor"], np.exp(chosen.log_weights), minlength=len(weights)) / n
        total += (b - a) * carried
    np.testing.assert_allclose(total, np.array(weights) / len(weights), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("order", ["position", "mean_partition"])
@pytest.mark.parametrize("n", [1, 2, 4, 5])
def test_sorted(order, n):
    """The law of copies of the scheme in the sorted order; chosen particles keep their ancestors."""
    population = of([2.0, -1.0, 0.5, 1.0], [1.0, 3.0, 2.0, 2.0])
    found = carried(Sorted(Systematic(), order), population, n, cells=8)
    np.testing.assert_allclose(found, np.exp(population.log_weights) / 4, atol=1e-12)
    chosen = Sorted(Stratified(), order).resample(np.random.default_rng(0), population, n)
    np.testing.assert_array_equal(chosen.particles, population.particles[chosen.parents["ancestor"]])


@pytest.mark.parametrize("k", [1, 2, 3, 4])
def test_kdpp(k, monkeypatch):
    """Every set with its probability by determinants, with the weights that resample gives it."""
    rng = np.random.default_rng(2)
    population = Population(rng.standard_normal((5, 2)), np.log(rng.random(5)) - 700)
    scheme = KDpp(Gaussian(1.0))
    L = scheme.likelihood(population)
    total, found = 0.0, np.zeros(5)
    for chosen_set in combinations(range(5), k):
        determinant = np.linalg.det(L[np.ix_(chosen_set, chosen_set)])
        monkeypatch.setattr(diverse_resampling, "sample_kdpp", lambda *_, s=chosen_set: np.array(s))
        chosen = scheme.resample(rng, population, k)
        assert chosen.notes["kdpp"] == f"rank 5 of {k}"
        found[list(chosen_set)] += determinant * np.exp(chosen.log_weights + 700) / k
        total += determinant
    np.testing.assert_allclose(found / total, np.exp(population.log_weights + 700) / 5, rtol=1e-9)


def test_enumeration_would_see_a_bias():
    """The harness on schemes that are wrong by little: it is exact, so every bias is seen."""

    class Off(Systematic):
        def select(self, rng, log_weights, n):
            return super().select(rng, log_weights + np.array([0.01, 0.0, 0.0, 0.0]), n)

    mean, _, _ = copies_law(Off(), (1, 3, 2, 2), 3, cells=800)
    assert np.abs(mean - 3 * np.array([1, 3, 2, 2]) / 8).max() > 1e-3
    pairs = list(product(range(2), repeat=2))
    assert [r for _, r in outcomes(lambda rng: (rng.digit([1, 1]), rng.digit([1, 1])))] == pairs

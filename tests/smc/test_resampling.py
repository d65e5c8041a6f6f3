"""Resampling: the law of the number of copies, by theory and by exact quadrature; hostile weights."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from mstfilter.errors import InputError
from mstfilter.smc import (
    Always,
    EssBelow,
    EveryKth,
    KeepWeights,
    Killing,
    Multinomial,
    Never,
    Population,
    Residual,
    Ssp,
    Stratified,
    Systematic,
    log_mean_exp,
)
from mstfilter.smc.resampling import independent_draws, stratified_ancestors, systematic_ancestors

SCHEMES = [
    Multinomial(),
    Stratified(),
    Systematic(),
    Residual(),
    Residual("stratified"),
    Residual("systematic"),
    Ssp(),
    Killing(),
]
NAMES = [
    "multinomial",
    "stratified",
    "systematic",
    "residual",
    "residual-stratified",
    "residual-systematic",
    "ssp",
    "killing",
]
ROUNDING = (Systematic(), Residual("systematic"), Ssp())
each_scheme = pytest.mark.parametrize("scheme", SCHEMES, ids=NAMES)


def counts(scheme, weights, n, repeats, seed=0):
    rng = np.random.default_rng(seed)
    with np.errstate(divide="ignore"):
        lw = np.log(weights)
    return np.array([np.bincount(scheme.select(rng, lw, n)[0], minlength=len(weights)) for _ in range(repeats)])


def theory(name, W, n):
    """Variance of the number of copies by the formulas of the module."""
    expected = n * W
    fraction = expected - np.floor(expected + 1e-12)
    if name == "multinomial":
        return expected * (1 - W)
    if name in ("systematic", "residual-systematic", "ssp"):
        return fraction * (1 - fraction)
    if name == "residual":
        rest = fraction.sum()
        return fraction * (1 - fraction / rest) if rest > 0 else 0 * W
    if name == "killing":
        p = W / W.max()
        alive = p * (1 - p)
        if n != len(W):
            return None
        return alive * (1 - 2 * W) + W**2 * alive.sum() + (n - p.sum()) * W * (1 - W)
    edges = np.concatenate([[0], np.cumsum(fraction if name == "residual-stratified" else expected)])
    variance = np.zeros(len(W))
    for i in range(len(W)):
        for s in range(n):
            p = max(0.0, min(edges[i + 1], s + 1) - max(edges[i], s))
            variance[i] += p * (1 - p)
    return variance


@pytest.mark.parametrize(("scheme", "name"), list(zip(SCHEMES, NAMES, strict=True)), ids=NAMES)
@pytest.mark.parametrize("n", [3, 5, 12])
def test_mean_and_variance_of_copies(scheme, name, n):
    # 135 means and as many variances at 5 standard errors: false alarm below 2e-4 for the file.
    W = np.array([0.02, 0.31, 0.0, 0.17, 0.5])
    repeats = 20_000
    N = counts(scheme, W, n, repeats, seed=n)
    assert (N.sum(axis=1) == n).all()
    want = theory(name, W, n)
    if want is None:  # no formula: at least the mean, by its own spread
        assert (np.abs(N.mean(axis=0) - n * W) <= 5 * N.std(axis=0) / np.sqrt(repeats) + 1e-9).all()
        return
    if name in ("systematic", "residual-systematic", "ssp"):
        assert ((np.floor(n * W + 1e-9) <= N) & (np.ceil(n * W - 1e-9) >= N)).all()
    spread = np.sqrt(np.maximum(want, 1e-12) / repeats)
    assert (np.abs(N.mean(axis=0) - n * W) <= 5 * spread + 1e-9).all()
    found = N.var(axis=0)
    # Fourth moment bounded by that of a count in 0..n.
    kurtosis = np.maximum(((N - N.mean(axis=0)) ** 4).mean(axis=0) - found**2, 1e-12)
    assert (np.abs(found - want) <= 5 * np.sqrt(kurtosis / repeats) + 1e-3).all()


def test_systematic_by_exact_quadrature():
    """Integrating the copies over the one uniform gives n W exactly."""
    W = np.array([0.12, 0.0, 0.43, 0.05, 0.4])
    for n in (1, 2, 5, 7):
        edges = np.unique(np.concatenate([[0, 1], np.mod(n * np.cumsum(W), 1.0)]))
        mean = np.zeros(len(W))
        for a, b in pairwise(edges):
            copies = np.bincount(systematic_ancestors(np.cumsum(W), n, (a + b) / 2), minlength=len(W))
            assert ((copies == np.floor(n * W + 1e-9)) | (copies == np.ceil(n * W - 1e-9))).all()
            mean += (b - a) * copies
        np.testing.assert_allclose(mean, n * W, atol=1e-9)


def hostile_weights(kind, m):
    rng = np.random.default_rng(7)
    weights = rng.uniform(0.5, 1.5, m)
    if kind == "zeros":
        weights[rng.random(m) < 0.9] = 0.0
        weights[m // 2] = 1.0
    elif kind == "ends":
        weights[: m // 3] = weights[m - m // 3 :] = 0.0
    elif kind == "heavy":
        weights = np.exp(6 * rng.standard_normal(m))
    elif kind == "one":
        weights[m // 2] = 1e6
    elif kind == "equal":  # cumulative weights of a power of two of particles lie on the limits of strata
        weights[:] = 1.0
    return weights


@pytest.mark.parametrize("kind", ["even", "zeros", "ends", "heavy", "one", "equal"])
@pytest.mark.parametrize(
    ("m", "n"), [(5_000, 30_000), (30_000, 30_000), (200_000, 2_000), (7, 20_000), (4_096, 70_000)]
)
def test_many_independent_draws(kind, m, n):
    """Chi-square of 50 groups of particles, 30 cases: false alarm below 2e-5 for all. No draw has weight zero."""
    weights = hostile_weights(kind, m)
    drawn = independent_draws(np.random.default_rng(m + n), weights.copy(), n)
    assert drawn.shape == (n,) and (weights[drawn] > 0).all()
    # Consecutive particles whose weights add up to about a fiftieth of the total.
    group = np.minimum(50 * np.cumsum(weights) / weights.sum(), 49).astype(int)
    expected = n * np.bincount(group, weights, minlength=50) / weights.sum()
    found = np.bincount(group[drawn], minlength=50)
    some = expected > 5
    chi2 = ((found - expected)[some] ** 2 / expected[some]).sum()
    assert stats.chi2.sf(chi2, max(some.sum() - 1, 1)) > 1e-7
    # The neighbours of a particle are not taken for it: the share of odd indices, at 5 standard errors.
    odd = (weights[1::2].sum() / weights.sum(), (drawn % 2).mean())
    assert abs(odd[1] - odd[0]) <= 5 * np.sqrt(odd[0] * (1 - odd[0]) / n) + 1e-9


@pytest.mark.parametrize("kind", ["even", "zeros", "ends", "heavy", "one"])
@pytest.mark.parametrize(("m", "n"), [(5_000, 30_000), (30_000, 30_000), (200_000, 100), (7, 2_000), (1, 3)])
def test_stratified_equals_a_search(kind, m, n):
    weights = hostile_weights(kind, m) if m > 1 else np.ones(1)
    uniforms = np.random.default_rng(m + n).random(n)
    cumulative = np.cumsum(weights)
    points = (np.arange(n) + uniforms) * (cumulative[-1] / n)
    expected = np.searchsorted(cumulative, points, side="right")
    np.testing.assert_array_equal(stratified_ancestors(weights, uniforms), expected)


@each_scheme
def test_multinomial_law_of_pairs_is_not_position_dependent(scheme):
    """Permuting the weights permutes the mean: chi-square of total copies, false alarm 1e-6 a scheme."""
    W = np.array([0.5, 0.1, 0.25, 0.15])
    order = np.array([2, 0, 3, 1])
    N = counts(scheme, W[order], 2, 8000, seed=11).sum(axis=0)
    expected = W[order] * N.sum()
    # At most multinomial variance for every scheme, so the chi-square bound holds for all.
    assert stats.chi2.sf(((N - expected) ** 2 / expected).sum(), 3) > 1e-6


weights_space = st.lists(
    st.one_of(st.just(-np.inf), st.floats(-50, 50), st.floats(-1e4, 1e4)), min_size=1, max_size=60
).filter(lambda v: np.isfinite(v).any())


@each_scheme
@settings(max_examples=150, deadline=None)
@given(
    lw=weights_space,
    n=st.integers(1, 80),
    offset=st.sampled_from([0.0, -1e4, 1e4]),
    single=st.booleans(),
    seed=st.integers(0, 99),
)
def test_any_weights_give_valid_ancestors(scheme, lw, n, offset, single, seed):
    lw = np.array(lw) + offset
    if single:
        lw = lw.astype(np.float32)
    ancestors, out = scheme.select(np.random.default_rng(seed), lw, n)
    assert out is None
    assert ancestors.shape == (n,)
    assert ((ancestors >= 0) & (ancestors < len(lw))).all()
    W = np.exp(lw.astype(float) - lw.astype(float).max())
    assert (W[ancestors] > 0).all(), "a particle without weight was chosen"
    if isinstance(scheme, (Systematic, Residual, Ssp)):
        floor = np.floor(n * W / W.sum() - 1e-6)
        assert (np.bincount(ancestors, minlength=len(lw)) >= floor).all()
    if scheme in ROUNDING:
        ceil = np.ceil(n * W / W.sum() + 1e-6)
        assert (np.bincount(ancestors, minlength=len(lw)) <= ceil).all()


@each_scheme
@pytest.mark.parametrize("bad", [[np.nan, 0.0], [np.inf, 0.0], [-np.inf, -np.inf], []])
def test_useless_weights_are_one_named_error(scheme, bad):
    with pytest.raises(InputError, match="log weights"):
        scheme.select(np.random.default_rng(0), np.array(bad, dtype=float), 3)
    with pytest.raises(InputError, match="at least 1"):
        scheme.select(np.random.default_rng(0), np.zeros(3), 0)


class Edge(np.random.Generator):
    """A generator whose uniforms are all the same: 0, or the largest below 1."""

    def __init__(self, value):
        super().__init__(np.random.PCG64(0))
        self.value = value

    def random(self, size=None):
        return self.value if size is None else np.full(size, self.value)


@pytest.mark.parametrize("u", [0.0, np.nextafter(1.0, 0.0)])
@pytest.mark.parametrize("size", [1, 7, 100_000])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
@each_scheme
def test_extreme_uniforms_and_many_particles(scheme, u, size, kind):
    rng = np.random.default_rng(5)
    lw = np.log(rng.random(size)).astype(kind)
    lw[: size // 3] = -np.inf
    lw[size - size // 4 :] = -np.inf
    if not np.isfinite(lw).any():
        lw[0] = 0
    ancestors, _ = scheme.select(Edge(u), lw, size)
    assert ancestors.shape == (size,)
    assert np.isfinite(lw[ancestors]).all()


@settings(max_examples=100, deadline=None)
@given(
    weights=st.lists(st.floats(0.01, 1.0), min_size=1, max_size=30), n=st.integers(1, 50), u=st.floats(0.001, 0.999)
)
def test_three_ways_to_the_same_counts(weights, n, u):
    """Bolic's one pass, systematic, and residual with systematic remainder: the same counts from the same uniform."""
    W = np.array(weights) / np.sum(weights)
    # Away from the points where rounding decides.
    if np.abs(np.mod(n * np.cumsum(W)[:-1] - u + 0.5, 1) - 0.5).min(initial=1.0) < 1e-9:
        return
    loop, carried = [], u
    for w in W:  # the published recursion
        loop.append(int(np.floor(n * w - carried)) + 1)
        carried += loop[-1] - n * w
    loop[-1] += n - sum(loop)  # its last count is decided by rounding alone
    for scheme in (Systematic(), Residual("systematic")):
        found = np.bincount(scheme.select(Edge(u), np.log(weights), n)[0], minlength=len(W))
        np.testing.assert_array_equal(found, loop)


def test_residual_with_nearly_whole_copies_makes_exactly_n():
    """999 999 particles a millionth short of one copy each, and one that makes up for it."""
    weights = np.append(np.full(999_999, 1 - 1e-6), 1 + 0.999999)
    for scheme in (Residual(), Ssp()):
        assert len(scheme.select(np.random.default_rng(0), np.log(weights), 1_000_000)[0]) == 1_000_000


def test_killing_leaves_even_particles_in_their_place():
    ancestors, _ = Killing().select(np.random.default_rng(0), np.full(50, -3.0), 50)
    np.testing.assert_array_equal(ancestors, np.arange(50))


def test_ssp_has_no_positive_covariance():
    """Counts of two particles never lean on each other: 10 pairs at 5 standard errors, false alarm below 1e-5."""
    W = np.array([0.1, 0.25, 0.3, 0.15, 0.2])
    N = counts(Ssp(), W, 3, 20_000, seed=4)
    d = N - N.mean(axis=0)
    for i in range(5):
        for j in range(i):
            product = d[:, i] * d[:, j]
            assert product.mean() <= 5 * product.std() / np.sqrt(len(product))


def test_an_unknown_remainder_is_an_error():
    with pytest.raises(InputError, match="remainder is 'best'"):
        Residual("best")


def test_the_evidence_is_kept_and_ancestors_are_recorded():
    population = Population(np.arange(4.0), np.log([1.0, 2.0, 3.0, 4.0]), {"previous": np.array([3, 2, 1, 0])})
    out = Systematic().resample(np.random.default_rng(0), population, 9)
    assert log_mean_exp(out.log_weights) == pytest.approx(log_mean_exp(population.log_weights), abs=1e-14)
    np.testing.assert_array_equal(out.particles, population.particles[out.parents["ancestor"]])
    np.testing.assert_array_equal(out.parents["previous"], 3 - out.parents["ancestor"])


def test_keep_weights_keeps_them():
    population = Population(np.arange(3.0), np.log([1.0, 5.0, 2.0]))
    out = KeepWeights().resample(np.random.default_rng(0), population, 6)
    np.testing.assert_array_equal(out.log_weights, population.log_weights[out.parents["ancestor"]])
    assert not KeepWeights().properly_weighted


def test_triggers():
    even, peaked = Population(np.zeros(10)), Population(np.zeros(10), np.r_[0.0, np.full(9, -50.0)])
    assert not EssBelow(0.5).wants(even, 0)
    assert EssBelow(0.5).wants(peaked, 0)
    assert Always().wants(even, 0)
    assert not Never().wants(peaked, 0)
    assert [EveryKth(3).wants(even, t) for t in range(4)] == [True, False, False, True]

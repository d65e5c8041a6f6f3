"""Resampling: draws by weight, hostile weights for all schemes, and what single schemes promise.

The laws are enumerated in test_exact_laws.py; tests/mst/testing runs the contract on all schemes.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Always,
    Chopthin,
    ClusterStratified,
    Coalesced,
    EssBelow,
    Every,
    FearnheadClifford,
    Gaussian,
    KeepWeights,
    Killing,
    Multinomial,
    Never,
    Population,
    Resampler,
    Residual,
    Shuffled,
    Similarity,
    Sorted,
    Ssp,
    Stratified,
    Systematic,
    Tempered,
    WeightResampler,
    log_mean_exp,
)
from mstfilter.smc.diverse_resampling import leader_clusters
from mstfilter.smc.resampling import draw_rows, independent_draws, inverse_cdf, search
from mstfilter.smc.wrapped_resampling import hilbert_position
from tests.smc.enumeration import ConstantGenerator

EQUAL: list[WeightResampler] = [Multinomial(), Stratified(), Systematic(), Residual(), Ssp(), Killing()]
PLAIN: list[Resampler] = [
    *EQUAL,
    FearnheadClifford(),
    Tempered(),
    Tempered(Ssp(), 0.0),
    Shuffled(),
    Shuffled(FearnheadClifford()),
]
SEEING: list[Resampler] = [
    ClusterStratified(),
    ClusterStratified(Gaussian(0.2), 0.9, FearnheadClifford()),
    Coalesced(),
    Coalesced(Systematic()),
    Tempered(ClusterStratified()),
    Shuffled(ClusterStratified()),
]
each_plain = pytest.mark.parametrize("scheme", PLAIN, ids=repr)


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
    elif kind == "equal":
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
def test_one_point_per_stratum_equals_a_search(kind, m, n):
    weights = hostile_weights(kind, m) if m > 1 else np.ones(1)
    uniforms = np.random.default_rng(m + n).random(n)
    cumulative = np.cumsum(weights)
    for shifts in (uniforms, uniforms[:1]):  # stratified and systematic
        points = (np.arange(n) + shifts) * (cumulative[-1] / n)
        expected = np.searchsorted(cumulative, points, side="right")
        np.testing.assert_array_equal(inverse_cdf(weights, shifts, n), expected)


@pytest.mark.parametrize("kind", ["even", "zeros", "ends", "heavy", "one", "equal"])
@pytest.mark.parametrize(("m", "n"), [(5_000, 30_000), (100_000, 100_000), (300_000, 90_000), (7, 200_000)])
def test_ascending_points_are_searched_as_numpy_does(kind, m, n):
    """Points between the ends of intervals, at ends, several at one end, in a small part, and at the total."""
    weights, rng = hostile_weights(kind, m), np.random.default_rng(m + n)
    ends = np.cumsum(weights)
    last = np.searchsorted(ends, ends[-1])
    inside, near = rng.random(n // 4), 0.25 + 1e-4 * rng.random(n // 4)
    at_ends = rng.choice(ends / ends[-1], n - 2 * (n // 4))
    for points in (np.sort(rng.random(n)), np.sort(np.concatenate((inside, near, at_ends)))):
        expected = np.minimum(np.searchsorted(ends, points * ends[-1], side="right"), last)
        np.testing.assert_array_equal(search(weights, points, ascending=True), expected)
        np.testing.assert_array_equal(search(weights, points), expected)


def test_points_at_the_ends_of_intervals():
    """A point at an end belongs to the next particle of positive weight; one rounded up to the total, to the last."""
    weights, points = np.array([0.0, 0.25, 0.0, 0.75, 0.0]), np.array([0.0, 0.25, 1.0])
    assert search(weights, points).tolist() == [1, 3, 3]
    assert draw_rows(np.tile(weights, (3, 1)), points).tolist() == [1, 3, 3]
    assert inverse_cdf(weights, np.zeros(1), 4).tolist() == [1, 3, 3, 3]


# --- hostile weights, all schemes ---------------------------------------------------------------------------------
hostile = st.lists(
    st.one_of(st.just(-np.inf), st.floats(-50, 50), st.floats(-1e4, 1e4), st.sampled_from([0.0, -700.0, -745.0])),
    min_size=1,
    max_size=40,
).filter(lambda v: np.isfinite(v).any())
offsets = st.sampled_from([0.0, -1e4, 1e4, np.log(0.9), np.log(2.0)])


def checked(scheme, rng, lw, n, particles=None):
    """The numbers of copies of a selection that is valid: no particle of weight zero, finite weights."""
    population = Population(np.arange(len(lw)) if particles is None else particles, lw)
    chosen = scheme.resample(rng, population, n)
    ancestors = chosen.parents["ancestor"]
    assert len(chosen) == n or (not scheme.exact_size and 1 <= len(chosen) <= n)
    W = np.exp(lw.astype(np.float64) - lw.max())
    assert (W[ancestors] > 0).all(), "a particle without weight was chosen"
    assert np.isfinite(chosen.log_weights).all()
    np.testing.assert_array_equal(chosen.particles, population.particles[ancestors])
    return np.bincount(ancestors, minlength=len(lw))


@each_plain
@settings(max_examples=100, deadline=None)
@given(lw=hostile, n=st.integers(1, 80), offset=offsets, single=st.booleans(), seed=st.integers(0, 99))
def test_hostile_weights(scheme, lw, n, offset, single, seed):
    """Also: schemes that round make at least floor(n W) and at most ceil(n W) copies."""
    lw = (np.array(lw) + offset).astype(np.float32 if single else np.float64)
    copies = checked(scheme, np.random.default_rng(seed), lw, n)
    W = np.exp(lw.astype(float) - lw.astype(float).max())
    expected = n * W / W.sum()
    if isinstance(scheme, Systematic | Residual | Ssp):
        assert (copies >= np.floor(expected - 1e-6)).all()
    if scheme in (Systematic(), Ssp()):
        assert (copies <= np.ceil(expected + 1e-6)).all()


@pytest.mark.parametrize("scheme", SEEING, ids=repr)
@settings(max_examples=60, deadline=None)
@given(
    lw=hostile,
    n=st.integers(1, 40),
    offset=offsets,
    spread=st.sampled_from([0.0, 1e-9, 1.0, 100.0]),
    seed=st.integers(0, 99),
)
def test_hostile_populations(scheme, lw, n, offset, spread, seed):
    rng = np.random.default_rng(seed)
    checked(scheme, rng, np.array(lw) + offset, n, np.round(rng.standard_normal(len(lw)) * 2) * spread)


@pytest.mark.parametrize("scheme", [s for s in PLAIN if isinstance(s, WeightResampler)], ids=repr)
@pytest.mark.parametrize("bad", [[np.nan, 0.0], [0.0, np.inf], [-np.inf, -np.inf], []])
def test_useless_weights_are_one_named_error(scheme, bad):
    with pytest.raises(InputError, match="log weights"):
        scheme.select(np.random.default_rng(0), np.array(bad, dtype=float), 3)


@pytest.mark.parametrize("scheme", PLAIN + SEEING, ids=repr)
def test_no_particles_wanted_is_an_error(scheme):
    with pytest.raises(InputError, match="at least 1"):
        scheme.resample(np.random.default_rng(0), Population(np.arange(3.0)), 0)


@pytest.mark.parametrize("u", [0.0, np.nextafter(1.0, 0.0)])
@pytest.mark.parametrize(("m", "n"), [(1, 1), (7, 7), (100_000, 30_000)])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
@each_plain
def test_extreme_uniforms_and_many_particles(scheme, u, m, n, kind):
    rng = np.random.default_rng(5)
    lw = np.log(rng.random(m)).astype(kind)
    lw[: m // 3] = lw[m - m // 4 :] = -np.inf
    checked(scheme, ConstantGenerator(u), lw, n)


@pytest.mark.parametrize("scheme", PLAIN + SEEING, ids=repr)
def test_notes_come_along(scheme):
    population = Population(np.arange(6.0), np.log(np.arange(1.0, 7)), notes={"n_trees": 3})
    assert scheme.resample(np.random.default_rng(1), population, 4).notes["n_trees"] == 3


# --- single schemes -----------------------------------------------------------------------------------------------
def test_residual_with_nearly_whole_copies_makes_exactly_n():
    """999 999 particles a millionth short of one copy each, and one that makes up for it."""
    weights = np.append(np.full(999_999, 1 - 1e-6), 1 + 0.999999)
    for scheme in (Residual(), Ssp()):
        assert len(scheme.select(np.random.default_rng(0), np.log(weights), 1_000_000)[0]) == 1_000_000


def test_killing_leaves_even_particles_in_their_place():
    ancestors, _ = Killing().select(np.random.default_rng(0), np.full(50, -3.0), 50)
    np.testing.assert_array_equal(ancestors, np.arange(50))


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
    assert [Every(3).wants(even, t) for t in range(4)] == [True, False, False, True]


# --- schemes that compare particles ---
@pytest.mark.parametrize("bad", [np.ones((2, 3)), np.full((4, 4), np.nan)])
def test_a_similarity_that_is_none_is_an_error(bad):
    class Bad(Similarity):
        def matrix(self, particles):
            return bad

    with pytest.raises(InputError, match="similarities"):
        ClusterStratified(Bad()).resample(np.random.default_rng(0), Population(np.arange(4.0)), 2)
    with pytest.raises(InputError, match="at most"):
        ClusterStratified().resample(np.random.default_rng(0), Population(np.zeros(20_000)), 2)


def test_leader_clusters():
    x = np.array([0.0, 0.1, 5.0, 5.2, 9.0])
    w = np.array([1.0, 2.0, 3.0, 1.0, 0.0])
    assert leader_clusters(w, Gaussian(1.0).matrix(x), 0.5).tolist() == [1, 1, 0, 0, -1]


@pytest.mark.parametrize("scheme", [Systematic(), FearnheadClifford(), Multinomial()], ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("n", [1, 2, 3, 4, 9, 30])
def test_clusters_keep_their_mass_and_a_place(scheme, n):
    rng = np.random.default_rng(n)
    x = np.concatenate([rng.normal(c, 0.01, 6) for c in (0.0, 10.0, 20.0)])
    lw = np.log(rng.random(18) * np.repeat([100.0, 1.0, 0.01], 6))
    population = Population(x, lw)
    for _ in range(20):
        chosen = ClusterStratified(Gaussian(1.0), 0.5, scheme).resample(rng, population, n)
        assert chosen.notes["clusters"] == 3
        assert log_mean_exp(chosen.log_weights) == pytest.approx(log_mean_exp(lw), abs=1e-9)
        assert len(chosen) == n or not scheme.exact_size
        if n >= 3:
            for group in range(3):
                mine = chosen.parents["ancestor"] // 6 == group
                share = np.exp(chosen.log_weights[mine]).sum() / len(chosen)
                assert share == pytest.approx(np.exp(lw[6 * group : 6 * group + 6]).sum() / 18, rel=1e-9)


# --- sorted --------------------------------------------------------------------------------------------------------
def random_population(rng, m, shape=()):
    return Population(rng.standard_normal((m, *shape)), 2 * rng.standard_normal(m))


# --- sorted -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("d", "bits"), [(1, 4), (2, 1), (2, 5), (3, 3), (4, 2), (5, 2)])
def test_neighbours_on_the_hilbert_curve_are_neighbours_in_space(d, bits):
    cells = np.array(list(product(range(1 << bits), repeat=d)))
    position = hilbert_position(cells, bits)
    np.testing.assert_array_equal(np.sort(position), np.arange(len(cells)))
    steps = np.diff(cells[np.argsort(position)], axis=0)
    assert (np.abs(steps).sum(axis=1) == 1).all()


@pytest.mark.parametrize("scheme", [Systematic(), Stratified()], ids=["systematic", "stratified"])
@pytest.mark.parametrize("n", [10, 40, 130])
def test_distribution_function_of_sorted_particles(scheme, n):
    """It differs from the weighted one by less than 1 / n, for every draw; unsorted it does not."""
    rng, far = np.random.default_rng(n), 0.0
    for _ in range(20):
        population = random_population(rng, 40)
        order = np.argsort(population.particles)
        weighted = np.cumsum(population.weights[order])
        for chosen, sort in ((Sorted(scheme), True), (scheme, False)):
            out = np.sort(chosen.resample(rng, population, n).particles)
            found = np.searchsorted(out, population.particles[order], side="right") / n
            distance = np.abs(found - weighted).max()
            assert distance < 1 / n + 1e-12 or not sort
            far = max(far, distance if not sort else 0.0)
    assert far > 1 / n


def test_vectors_are_selected_closer_along_the_hilbert_curve():
    """Energy distance between the selected and the weighted particles, mean of 40: at most .7 of the unsorted one."""
    rng, distances = np.random.default_rng(3), {"sorted": 0.0, "plain": 0.0}
    for _ in range(40):
        population = random_population(rng, 300, (2,))
        x, w = population.particles, population.weights
        apart = np.sqrt(((x[:, None] - x[None]) ** 2).sum(axis=2))
        for name, scheme in (("sorted", Sorted(Systematic())), ("plain", Systematic())):
            found = np.bincount(scheme.resample(rng, population, 100).parents["ancestor"], minlength=300) / 100
            distances[name] -= (found - w) @ apart @ (found - w)
    assert 0 < distances["sorted"] < 0.7 * distances["plain"]


def test_sorted_orders_mappings_and_refuses_objects():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((20, 1))
    mapping = Population({"x": x, "fixed": np.zeros(20)}, x[:, 0])
    chosen = Sorted().resample(rng, mapping, 7)
    np.testing.assert_array_equal(chosen.particles["x"], x[chosen.parents["ancestor"]])
    with pytest.raises(InputError, match="objects"):
        Sorted().resample(rng, Population(("a", "b")), 2)
    with pytest.raises(InputError, match="63 dimensions"):
        Sorted().resample(rng, Population(rng.standard_normal((5, 63))), 2)


# --- chopthin -----------------------------------------------------------------------------------------------------
def test_chopthin_changes_nothing_if_the_weights_are_nearly_equal():
    population = Population(np.arange(6.0), np.log([1.0, 2.0, 1.5, 1.0, 1.9, 1.2]))
    chosen = Chopthin().resample(np.random.default_rng(0), population, 6)
    order = np.argsort(chosen.parents["ancestor"])
    np.testing.assert_array_equal(chosen.particles[order], population.particles)
    np.testing.assert_allclose(chosen.log_weights[order], population.log_weights)


@pytest.mark.parametrize("bits", [np.random.MT19937, np.random.PCG64, np.random.Philox, np.random.SFC64])
def test_many_draws_with_every_bit_generator(bits):
    """MT19937 has 32 raw bits, the others 64. Chi-square at 1e-6."""
    weights = np.array([0.1, 0.2, 0.3, 0.4])
    index, _ = Multinomial().select(np.random.Generator(bits(0)), np.log(weights), 5000)
    assert stats.chisquare(np.bincount(index, minlength=4), 5000 * weights).pvalue > 1e-6

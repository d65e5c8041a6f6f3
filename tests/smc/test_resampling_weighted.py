"""Schemes with unequal output weights, and wrappers: law by quadrature and enumeration; hostile weights for all."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from mstfilter.errors import InputError
from mstfilter.smc import (
    ClusterStratified,
    Coalesced,
    ExactEquality,
    FearnheadClifford,
    Gaussian,
    GreedyDiverse,
    KDpp,
    Killing,
    Multinomial,
    Population,
    Resampler,
    Residual,
    Shuffled,
    Similarity,
    Ssp,
    Stratified,
    Systematic,
    Tempered,
    WeightResampler,
    coalesce,
    log_mean_exp,
)
from mstfilter.smc.diverse_resampling import Spectrum, inclusion, leader_clusters, optimal_threshold, sample_kdpp

positive_weights = st.lists(st.floats(0.01, 10.0), min_size=1, max_size=12)


class Uniform(np.random.Generator):
    """A generator whose uniforms are all u."""

    def __init__(self, u):
        super().__init__(np.random.PCG64(0))
        self.u = u

    def random(self, size=None):
        return self.u if size is None else np.full(size, self.u)


def selected(scheme, rng, lw, n):
    """Ancestors and log weights of a scheme; wrappers need a population."""
    if isinstance(scheme, WeightResampler):
        return scheme.select(rng, lw, n)
    chosen = scheme.resample(rng, Population(np.arange(len(lw)), lw), n)
    return chosen.parents["ancestor"], chosen.log_weights


def expectation(scheme, lw, n, breaks):
    """E of what each particle carries, by exact integration over the one uniform that a scheme draws."""
    edges = np.unique(np.concatenate([[0.0, 1.0], np.mod(breaks, 1.0)]))
    carried = np.zeros(len(lw))
    included = np.zeros(len(lw))
    for a, b in pairwise(edges):
        ancestors, out = selected(scheme, Uniform((a + b) / 2), lw, n)
        out = np.full(len(ancestors), log_mean_exp(lw)) if out is None else out
        carried += (b - a) * np.bincount(ancestors, np.exp(out), minlength=len(lw)) / len(ancestors)
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


any_positive_weights = st.lists(
    st.one_of(st.floats(-2, 2), st.floats(-700, 0), st.sampled_from([0.0, 1.0, -744.0])), min_size=1, max_size=12
).map(lambda lw: np.array(lw) - max(lw))


@settings(max_examples=300, deadline=None)
@given(lw=any_positive_weights, n=st.integers(1, 14), u=st.floats(0, 1, exclude_max=True))
def test_fearnhead_clifford_invariants(lw, n, u):
    """No duplicates, the total kept exactly, heavy particles kept with their weight."""
    weights = np.exp(lw)
    ancestors, out = FearnheadClifford().select(Uniform(u), lw, n)
    assert len(ancestors) == min(n, (weights > 0).sum()) == len(set(ancestors.tolist()))
    assert log_mean_exp(out) == pytest.approx(log_mean_exp(lw), abs=1e-9)
    scaled = out - np.log(len(ancestors) / len(lw))
    c = np.exp(scaled).min() if n < len(lw) else 0.0
    heavy = np.flatnonzero(weights > c * (1 + 1e-6))
    for i in heavy:
        assert scaled[ancestors == i] == pytest.approx(lw[i], abs=1e-9)


@settings(max_examples=100, deadline=None)
@given(weights=positive_weights, n=st.integers(1, 14), power=st.floats(0, 1))
def test_tempered_systematic_by_quadrature(weights, n, power):
    lw = np.log(weights)
    alpha = np.exp(power * lw)
    carried, _ = expectation(Tempered(Systematic(), power), lw, n, n * np.cumsum(alpha) / alpha.sum())
    np.testing.assert_allclose(carried, np.array(weights) / len(lw), rtol=1e-6)


# -- k-DPP -----------------------------------------------------------------------------------------------------------


def dpp_example(m=7, seed=0):
    rng = np.random.default_rng(seed)
    w = rng.random(m) ** 3 + 0.01
    S = Gaussian(1.0).matrix(rng.standard_normal((m, 2)))
    return w, np.sqrt(w)[:, None] * S * np.sqrt(w)[None, :]


def enumerate_dpp(L, k):
    sets = list(combinations(range(len(L)), k))
    p = np.array([np.linalg.det(L[np.ix_(s, s)]) for s in sets])
    return sets, p / p.sum()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("k", [1, 2, 4, 6, 7])
def test_kdpp_inclusion_by_enumeration(k, seed):
    _, L = dpp_example(seed=seed)
    sets, p = enumerate_dpp(L, k)
    want = np.zeros(len(L))
    for s, q in zip(sets, p, strict=True):
        want[list(s)] += q
    found = inclusion(Spectrum.of(L, k), k)
    np.testing.assert_allclose(found, want, atol=1e-12)
    assert found.sum() == pytest.approx(k, abs=1e-10)


def test_kdpp_sets_by_enumeration():
    """Chi-square of all 35 sets of three; false alarm 1e-6."""
    _, L = dpp_example(seed=3)
    sets, p = enumerate_dpp(L, 3)
    spectrum, rng = Spectrum.of(L, 3), np.random.default_rng(1)
    number = {s: i for i, s in enumerate(sets)}
    found = np.zeros(len(sets))
    for _ in range(20_000):
        found[number[tuple(sample_kdpp(rng, spectrum, 3).tolist())]] += 1
    keep = p * 20_000 > 5
    found, want = np.append(found[keep], found[~keep].sum()), np.append(p[keep], p[~keep].sum()) * 20_000
    keep = want > 1
    chi = ((found[keep] - want[keep]) ** 2 / want[keep]).sum()
    assert stats.chi2.sf(chi, keep.sum() - 1) > 1e-6


def test_kdpp_output_weights_by_enumeration():
    """sum over sets of P(set) times the output weights, as resample gives them, is the input."""
    rng = np.random.default_rng(2)
    population = Population(rng.standard_normal((6, 2)), np.log(rng.random(6)) - 700)
    scheme = KDpp(Gaussian(1.0))
    sets, p = enumerate_dpp(scheme.likelihood(population), 3)
    seen = {}
    for _ in range(3000):
        chosen = scheme.resample(rng, population, 3)
        seen[tuple(chosen.parents["ancestor"].tolist())] = np.exp(chosen.log_weights + 700)
    carried = np.zeros(6)
    missed = 0.0
    for s, q in zip(sets, p, strict=True):
        if s in seen:
            carried[list(s)] += q * seen[s] / 3
        else:
            missed += q
    assert missed < 0.02
    np.testing.assert_allclose(carried, np.exp(population.log_weights + 700) / 6, rtol=0.1, atol=missed)
    assert chosen.notes["kdpp"] == "rank 6 of 3"


def test_kdpp_falls_back_where_too_few_differ():
    population = Population(np.array([1.0, 1.0, 1.0, 2.0]))
    chosen = KDpp().resample(np.random.default_rng(0), population, 3)
    assert chosen.notes["kdpp"] == "rank 2 of 3: fallback"
    assert len(chosen) == 3
    assert log_mean_exp(chosen.log_weights) == pytest.approx(0.0)
    assert not KDpp(scheme=GreedyDiverse()).properly_weighted


def test_similarities_that_are_no_kernel_are_projected():
    class Odd(Similarity):
        def matrix(self, particles):
            S = np.eye(len(particles))
            S[0, 1] = S[1, 0] = S[1, 2] = S[2, 1] = 0.9
            return S

    population = Population(np.arange(4.0), np.log([1.0, 2.0, 1.0, 1.0]))
    L = KDpp(Odd()).likelihood(population)
    assert np.linalg.eigvalsh(L)[0] > -1e-12
    assert np.linalg.eigvalsh(Odd().matrix(population.particles))[0] < -0.1
    chosen = KDpp(Odd()).resample(np.random.default_rng(0), population, 2)
    assert len(set(chosen.particles.tolist())) == 2


@pytest.mark.parametrize("bad", [np.ones((2, 3)), np.full((4, 4), np.nan)])
def test_a_similarity_that_is_none_is_an_error(bad):
    class Bad(Similarity):
        def matrix(self, particles):
            return bad

    with pytest.raises(InputError, match="similarities"):
        KDpp(Bad()).resample(np.random.default_rng(0), Population(np.arange(4.0)), 2)
    with pytest.raises(InputError, match="at most"):
        KDpp().resample(np.random.default_rng(0), Population(np.zeros(20_000)), 2)


# -- greedy, clusters, coalescing ------------------------------------------------------------------------------------


def test_greedy_takes_the_set_of_largest_determinant_so_far():
    """Each step by brute force over all candidates."""
    rng = np.random.default_rng(5)
    population = Population(rng.standard_normal((8, 2)), np.log(rng.random(8)))
    L = KDpp().likelihood(population)
    chosen: list[int] = []
    for _ in range(4):
        left = [i for i in range(8) if i not in chosen]
        gains = [np.linalg.det(L[np.ix_([*chosen, i], [*chosen, i])]) for i in left]
        chosen.append(left[int(np.argmax(gains))])
    out = GreedyDiverse().resample(rng, population, 4)
    assert sorted(chosen) == out.parents["ancestor"].tolist()
    assert log_mean_exp(out.log_weights) == pytest.approx(log_mean_exp(population.log_weights))


def test_greedy_fills_up_with_the_heaviest_where_nothing_differs():
    population = Population(np.zeros(5), np.log([1.0, 5.0, 2.0, 3.0, 4.0]))
    assert GreedyDiverse().resample(np.random.default_rng(0), population, 3).parents["ancestor"].tolist() == [1, 3, 4]


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


def test_only_clusters_of_some_mass_are_sure_of_a_place():
    """Of four clusters two hold .1 % of the weight each: they come in .5 % of draws, and stand for one place."""
    population = Population(np.array([0.0, 10.0, 20.0, 30.0]), np.log([0.698, 0.3, 0.001, 0.001]))
    scheme = ClusterStratified(Gaussian(1.0), least_mass=0.05)
    found = np.zeros(4)
    for seed in range(2000):
        chosen = scheme.resample(np.random.default_rng(seed), population, 5)
        ancestors = chosen.parents["ancestor"]
        found += np.bincount(ancestors, minlength=4)
        assert {0, 1} <= set(ancestors.tolist())
        for light in np.flatnonzero(ancestors >= 2):
            # A fifth of the total, as each of five places holds: the mean weight, which is kept.
            assert np.exp(chosen.log_weights[light]) == pytest.approx(0.25, rel=0.01)
    assert found[2:] / 2000 == pytest.approx([0.005, 0.005], abs=0.006)


@settings(max_examples=100, deadline=None)
@given(
    lw=st.lists(st.floats(-5, 5), min_size=1, max_size=20),
    labels=st.lists(st.integers(0, 4), min_size=20, max_size=20),
)
def test_coalescing_is_lossless(lw, labels):
    lw, labels = np.array(lw), np.array(labels[: len(lw)])
    classes = ExactEquality().classes(labels)
    representatives, merged = coalesce(lw, classes)
    assert log_mean_exp(merged) == pytest.approx(log_mean_exp(lw), abs=1e-9)
    for i, total in zip(representatives, merged, strict=True):
        mine = labels == labels[i]
        assert lw[i] == lw[mine].max()
        assert np.exp(total) / len(merged) == pytest.approx(np.exp(lw[mine]).sum() / len(lw))
    chosen = Coalesced().resample(np.random.default_rng(0), Population(labels, lw), 5)
    assert sorted(chosen.particles.tolist()) == sorted(set(labels.tolist()))


def test_shuffling_changes_the_order_only():
    """Systematic on sorted weights never takes two neighbours of weight 1/2 copy each; shuffled it does."""
    lw, rng = np.zeros(8), np.random.default_rng(0)
    population = Population(np.arange(8), lw)
    plain = {tuple(Systematic().resample(rng, population, 4).particles.tolist()) for _ in range(200)}
    mixed = {tuple(sorted(Shuffled().resample(rng, population, 4).particles.tolist())) for _ in range(200)}
    assert len(plain) == 2
    assert len(mixed) > 30


@pytest.mark.parametrize(
    "make", [lambda: Tempered(power=1.5), lambda: ClusterStratified(at_least=0.0), lambda: Gaussian(scale=-1.0)]
)
def test_fields_out_of_range(make):
    with pytest.raises(InputError):
        make()


# -- hostile weights, all schemes ------------------------------------------------------------------------------------

PLAIN: list[Resampler] = [
    Multinomial(),
    Stratified(),
    Systematic(),
    Residual(),
    Residual("stratified"),
    Residual("systematic"),
    Ssp(),
    Killing(),
    FearnheadClifford(),
    Tempered(),
    Tempered(Ssp(), 0.0),
    Shuffled(),
    Shuffled(FearnheadClifford()),
]
SEEING: list[Resampler] = [
    KDpp(),
    KDpp(Gaussian(0.1)),
    GreedyDiverse(),
    ClusterStratified(),
    ClusterStratified(Gaussian(0.2), 0.9, FearnheadClifford()),
    Coalesced(),
    Coalesced(Systematic()),
    Tempered(KDpp()),
    Shuffled(ClusterStratified()),
]
hostile = st.lists(
    st.one_of(st.just(-np.inf), st.floats(-50, 50), st.floats(-1e4, 1e4), st.sampled_from([0.0, -700.0, -745.0])),
    min_size=1,
    max_size=30,
).filter(lambda v: np.isfinite(v).any())


def check(scheme, lw, n, ancestors, out):
    lw = np.asarray(lw, dtype=np.float64)
    W = np.exp(lw - lw.max())
    assert ancestors.ndim == 1
    assert np.issubdtype(ancestors.dtype, np.integer)
    assert len(ancestors) == n or (not scheme.exact_size and 1 <= len(ancestors) <= n)
    assert ((ancestors >= 0) & (ancestors < len(lw))).all()
    assert (W[ancestors] > 0).all(), "a particle without weight was chosen"
    if out is not None:
        assert out.shape == ancestors.shape
        assert np.isfinite(out).all()


@pytest.mark.parametrize("scheme", PLAIN, ids=repr)
@settings(max_examples=60, deadline=None)
@given(
    lw=hostile,
    n=st.integers(1, 60),
    offset=st.sampled_from([0.0, -1e4, 1e4, np.log(0.9), np.log(2.0)]),
    single=st.booleans(),
    seed=st.integers(0, 99),
)
def test_hostile_weights(scheme, lw, n, offset, single, seed):
    given_lw = (np.array(lw) + offset).astype(np.float32 if single else np.float64)
    check(scheme, given_lw, n, *selected(scheme, np.random.default_rng(seed), given_lw, n))


@pytest.mark.parametrize("scheme", SEEING, ids=repr)
@settings(max_examples=60, deadline=None)
@given(
    lw=hostile,
    n=st.integers(1, 40),
    offset=st.sampled_from([0.0, -1e4, 1e4, np.log(2.0)]),
    spread=st.sampled_from([0.0, 1e-9, 1.0, 100.0]),
    seed=st.integers(0, 99),
)
def test_hostile_populations(scheme, lw, n, offset, spread, seed):
    rng = np.random.default_rng(seed)
    particles = np.round(rng.standard_normal(len(lw)) * 2) * spread
    population = Population(particles, np.array(lw) + offset)
    chosen = scheme.resample(rng, population, n)
    check(scheme, population.log_weights, n, chosen.parents["ancestor"], chosen.log_weights)
    np.testing.assert_array_equal(chosen.particles, particles[chosen.parents["ancestor"]])


@pytest.mark.parametrize("scheme", [s for s in PLAIN if isinstance(s, WeightResampler)], ids=repr)
@pytest.mark.parametrize("bad", [[np.nan, 0.0], [0.0, np.inf], [-np.inf, -np.inf], []])
def test_useless_weights_are_one_named_error(scheme, bad):
    with pytest.raises(InputError, match="log weights"):
        scheme.select(np.random.default_rng(0), np.array(bad, dtype=float), 3)


@pytest.mark.parametrize("scheme", PLAIN + SEEING, ids=repr)
def test_no_particles_wanted_is_an_error(scheme):
    with pytest.raises(InputError, match="at least 1"):
        scheme.resample(np.random.default_rng(0), Population(np.arange(3.0)), 0)


@pytest.mark.parametrize("scheme", PLAIN, ids=repr)
def test_many_particles_in_single_precision(scheme):
    rng = np.random.default_rng(5)
    lw = np.log(rng.random(100_000)).astype(np.float32)
    lw[::3] = -np.inf
    lw[:1000] = lw[-1000:] = -np.inf
    for n in (100_000, 30_000, 1):
        check(scheme, lw, n, *selected(scheme, rng, lw, n))


@pytest.mark.parametrize("scheme", PLAIN + SEEING, ids=repr)
def test_parents_notes_and_objects_come_along(scheme):
    population = Population(np.arange(6.0), np.log(np.arange(1.0, 7)), {"proposed": np.arange(6)}, {"n_trees": 3})
    chosen = scheme.resample(np.random.default_rng(1), population, 4)
    np.testing.assert_array_equal(chosen.parents["proposed"], chosen.parents["ancestor"])
    assert chosen.notes["n_trees"] == 3
    if not isinstance(scheme, (KDpp, GreedyDiverse, ClusterStratified)) and "KDpp" not in repr(scheme):
        things = replace(population, particles=("a", "b", "c", "d", "e", "f"))
        if "Cluster" not in repr(scheme):
            assert set(scheme.resample(np.random.default_rng(1), things, 4).particles) <= set("abcdef")

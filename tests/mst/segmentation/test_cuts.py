"""Cut samplers against enumeration."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.mst.segmentation import mh
from mstfilter.mst.segmentation.cuts import ExactCuts, OptimalCut, gibbs, optimal_cut
from mstfilter.mst.segmentation.mh import AuthorsMoves, MetropolisHastingsCuts, NodeMoves, SubtreeRedraw
from mstfilter.mst.segmentation.tree import Tree
from tests.mst.segmentation.trees import (
    all_cuts,
    is_cut,
    random_tree,
    random_values,
    stationary,
    target,
    transition_matrix,
)

SMALL = [(5, 2), (7, 2), (9, 2), (9, 4), (8, 3)]


def case(leaves: int, most: int, seed: int = 3):
    rng = np.random.default_rng((seed, leaves, most))
    tree = random_tree(rng, leaves, most)
    return tree, random_values(rng, tree)


@given(st.integers(0, 10**6), st.integers(1, 9), st.integers(2, 5))
def test_optimal_cut_is_the_best_of_all(seed, leaves, most):
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, leaves, most)
    w = random_values(rng, tree)
    cut = optimal_cut(tree, w)
    assert is_cut(tree, cut)
    assert w[cut].sum() == pytest.approx(max(w[list(c)].sum() for c in all_cuts(tree)))


def test_optimal_cut_keeps_the_parent_in_ties():
    tree = Tree(np.array([2, 2, 2]), np.array([[0, 1]]), np.zeros(3))
    assert optimal_cut(tree, np.array([1.0, 1.0, 2.0])).tolist() == [2]
    assert optimal_cut(tree, np.array([0.1, 0.2, 0.1 + 0.2])).tolist() == [2]


@pytest.mark.parametrize(("leaves", "most"), SMALL)
@pytest.mark.parametrize("sigma2", [0.25, 1e-2])
def test_exact_rules_are_stationary_and_reversible(leaves, most, sigma2):
    tree, w = case(leaves, most)
    _, p, best, s2 = target(tree, w, sigma2)
    for name, rule in (("node", NodeMoves()), ("redraw", SubtreeRedraw(gibbs(tree, w * 0.8 - 0.1, 0.3)))):
        T = transition_matrix(tree, w, best, s2, rule)
        assert np.allclose(T.sum(axis=1), 1, atol=1e-12), name
        assert 0.5 * np.abs(p @ T - p).sum() < 1e-12, name
        assert np.abs(p[:, None] * T - (p[:, None] * T).T).max() < 1e-12, name
        if sigma2 == 0.25:  # one law only: also irreducible, so the solved stationary law is p
            assert 0.5 * np.abs(stationary(T) - p).sum() < 1e-10, name


@pytest.mark.parametrize(("leaves", "most"), SMALL)
def test_the_authors_rule_is_not_stationary(leaves, most):
    """Its merges are over-accepted: the notes' trees gave total variations of .23 .28 .54 .35."""
    tree, w = case(leaves, most)
    cuts, p, best, s2 = target(tree, w, 0.25)
    T = transition_matrix(tree, w, best, s2, AuthorsMoves())
    law = stationary(T)
    sizes = np.array([len(c) for c in cuts])
    assert 0.1 < 0.5 * np.abs(law - p).sum() < 0.7
    assert law @ sizes < p @ sizes  # too coarse


def _chi_square(found, p):
    """p value; cells with fewer than 5 expected are pooled."""
    order = np.argsort(p)
    expected = p[order] * found.sum()
    k = int(np.searchsorted(np.cumsum(expected), 5.0)) + 1  # the least likely cuts are one cell
    f = np.append(found[order][:k].sum(), found[order][k:])
    e = np.append(expected[:k].sum(), expected[k:])
    assert len(f) > 1, "the target law is concentrated on one cut: the test has no power"
    return stats.chisquare(f, e).pvalue


@pytest.mark.parametrize(("leaves", "most"), SMALL)
def test_gibbs_law(leaves, most):
    tree, w = case(leaves, most)
    law = gibbs(tree, w, 0.7)
    cuts = all_cuts(tree)
    p = np.exp(0.7 * np.array([w[list(c)].sum() for c in cuts]))
    assert np.allclose([np.exp(law.log_prob(list(c), tree.root)) for c in cuts], p / p.sum(), atol=1e-12)


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.integers(1, 30), st.integers(2, 4), st.sampled_from([0.25, 1e-3, 1e-8]))
def test_every_sample_is_a_cut(seed, leaves, most, sigma2):
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, leaves, most)
    w = random_values(rng, tree)
    samplers = [
        MetropolisHastingsCuts(sigma2, burn_in=10, thinning=7),
        MetropolisHastingsCuts(burn_in=10, thinning=7, temperature=2.0),
        MetropolisHastingsCuts(sigma2, 0, 20, "authors", restart=True, include_optimal=True, redraw_repeated=True),
        ExactCuts(),
        OptimalCut(),
    ]
    for sampler in samplers:
        sample = sampler.sample(np.random.default_rng(seed), tree, w, 6)
        again = sampler.sample(np.random.default_rng(seed), tree, w, 6)
        assert len(sample.cuts) == 6
        assert all(is_cut(tree, c) for c in sample.cuts)
        assert all((a == b).all() for a, b in zip(sample.cuts, again.cuts, strict=True))


def test_authors_sampler_returns_the_optimal_cut_first():
    tree, w = case(9, 2)
    sampler = MetropolisHastingsCuts(0.25, 0, 20, "authors", restart=True, include_optimal=True)
    sample = sampler.sample(np.random.default_rng(0), tree, w, 5)
    assert (sample.cuts[0] == optimal_cut(tree, w)).all()
    assert sample.log_p[0] == 0
    assert "autocorrelation_steps" not in sample.diagnostics


def test_diagnostics():
    tree, w = case(9, 2)
    d = MetropolisHastingsCuts(0.25).sample(np.random.default_rng(0), tree, w, 10).diagnostics
    assert 0 < d["acceptance"] <= 1
    assert 0 < d["distinct"] <= 1
    assert 1 <= d["autocorrelation_steps"] < 100


def test_autocorrelation_time_needs_a_long_trace_that_varies():
    assert mh._autocorrelation(np.arange(99.0)) is None
    assert mh._autocorrelation(np.ones(200)) is None


def test_invalid_node_values_are_reported():
    tree, w = case(5, 2)
    with pytest.raises(InputError, match="node values have shape"):
        optimal_cut(tree, w[:-1])
    with pytest.raises(InputError, match="not finite"):
        optimal_cut(tree, w * np.nan)


@pytest.mark.parametrize(("leaves", "most"), SMALL)
def test_samplers_follow_their_law(leaves, most):
    """Chains and exact draws against enumeration, chi-square, false alarm 1e-4 each; the odds are not rescaled."""
    tree, w = case(leaves, most)
    cuts, paper, _, _ = target(tree, w, 0.25)
    v = np.array([w[list(c)].sum() for c in cuts])
    gibbs_law = np.exp((v - v.max()) / 2.0)
    samplers = [
        MetropolisHastingsCuts(0.25, burn_in=100, thinning=40),
        MetropolisHastingsCuts(burn_in=100, thinning=40, redraw_share=0.0, temperature=2.0),
        MetropolisHastingsCuts(burn_in=100, thinning=40, temperature=2.0),
        ExactCuts(temperature=2.0),
    ]
    for sampler in samplers:
        p = gibbs_law if sampler.temperature else paper
        sample = sampler.sample(np.random.default_rng(3), tree, w, 2000)
        which = np.array([cuts.index(tuple(cut.tolist())) for cut in sample.cuts])
        assert _chi_square(np.bincount(which, minlength=len(cuts)), p / p.sum()) > 1e-4
        assert np.allclose(np.exp(sample.log_p), (p / p.max())[which])

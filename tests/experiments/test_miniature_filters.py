"""Filters on the miniature world: the proper ones are exact in the limit, those of MST run on the same data.

A statistical bound of 4 standard errors fails a right filter with probability 6e-5.
"""

from __future__ import annotations

import numpy as np
import pytest
from miniature_filters import (
    N_RANK_DRAWS,
    GuidedPush,
    bootstrap_filter,
    exact_filter,
    guided_filter,
    posterior_errors,
    rank_of_truth,
    rank_uniformity,
    state_statistics,
    state_weights,
)
from miniature_mst import (
    CutProposal,
    DepthFreeSpace,
    adapt_to_miniature,
    balanced_filter,
    cut_distribution,
)
from miniature_world import Miniature, Observation

import mstfilter
from mstfilter.smc import Always, FearnheadClifford, Population
from tests.experiments.test_miniature_world import FALSE_ALARM, chi_square, ids, state_of

WORLD = Miniature((3, 2))
PROPER = {"bootstrap": bootstrap_filter, "guided": guided_filter, "balanced": balanced_filter}
RULES = {"paper": ("p", False), "authors": ("p", True), "mst_rules": ("equal", False)}


def preset(name, world, n):
    return adapt_to_miniature(mstfilter.preset(name), world, n, *RULES[name])


@pytest.mark.parametrize("name", RULES)
def test_the_rules_are_those_of_the_presets(name):
    proposal = mstfilter.preset(name).proposal
    assert (proposal.weight_rule, proposal.sampler.include_optimal) == RULES[name]


@ids
def test_one_step_of_the_guided_filter_has_the_exact_evidence(world):
    _, observations = world.simulate(np.random.default_rng(0), 1)
    exact = exact_filter(world, observations)
    for n in (1, 7):
        state, _ = guided_filter(world, n).run(observations, 1)
        assert state.log_evidence == pytest.approx(exact.log_evidence[0], abs=1e-10)


@pytest.mark.parametrize(
    "name", ["guided", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("bootstrap", "balanced"))]
)
@ids
def test_the_evidence_is_unbiased(name, world):
    """On data whose estimates are not skewed (spread below a half), so that few runs show their mean."""
    _, observations = world.simulate(np.random.default_rng(4), 4)
    exact = exact_filter(world, observations).log_evidence[-1]
    n = {"bootstrap": 4000, "guided": 60, "balanced": 300}[name]
    for extra in ({}, {"resampler": FearnheadClifford(), "trigger": Always()}):
        filter = PROPER[name](world, n, **extra)
        ratio = np.exp([filter.run(observations, seed)[0].log_evidence - exact for seed in range(50)])
        assert ratio.std() < 0.5
        assert abs(ratio.mean() - 1) < 4 * ratio.std(ddof=1) / np.sqrt(len(ratio))


def test_a_guided_move_is_an_importance_draw_of_the_motion_model():
    """q is proportional to f g, so the log weight is log f - log q = log sum f g - log g."""
    _, observations = WORLD.simulate(np.random.default_rng(4), 2)
    y, S = observations[1], len(WORLD.states)
    log_g = WORLD.log_likelihood(y)
    joint = WORLD.predict(np.eye(S)[321], y.action) * np.exp(log_g)
    old = Population((WORLD.states.hypotheses[321],) * S)
    moved = GuidedPush(WORLD).predict(np.random.default_rng(0), old, y)
    x = WORLD.states.index(moved.particles)
    np.testing.assert_allclose(moved.log_weights, np.log(joint.sum()) - log_g[x], atol=1e-10)
    assert chi_square(x, joint / joint.sum()) > FALSE_ALARM


@pytest.mark.nightly
def test_a_missing_observation_moves_the_particles_only():
    _, observations = WORLD.simulate(np.random.default_rng(5), 3)
    observations = [observations[0], None, observations[2]]
    exact = exact_filter(WORLD, observations)
    for make in (bootstrap_filter, guided_filter):
        ratio = np.exp(
            [make(WORLD, 500).run(observations, s)[0].log_evidence - exact.log_evidence[-1] for s in range(60)]
        )
        assert abs(ratio.mean() - 1) < 4 * ratio.std(ddof=1) / np.sqrt(60)


# --- MST on the same world ----------------------------------------------------------------------------------------
@ids
def test_cuts_follow_their_distribution(world):
    _, observations = world.simulate(np.random.default_rng(8), 1)
    law = cut_distribution(world, observations[0], 0.4)
    assert law.probability.sum() == pytest.approx(1)
    assert law.log_cut.max() == 0
    proposal = CutProposal(world, prior_share=0.2)
    drawn = proposal.sample(np.random.default_rng(0), observations[0], 4000)
    assert proposal.state_probability(observations[0]).sum() == pytest.approx(1)
    assert chi_square(world.states.index(drawn.particles), proposal.state_probability(observations[0])) > FALSE_ALARM


def test_cuts_of_a_known_observation():
    """Two pixels with a surface, sensed as joined: one object or two, in the proportion of the error rates."""
    world = Miniature((3, 2), split=0.2, merge=0.1)
    law = cut_distribution(world, Observation(np.array([1, 1, 2]), np.array([True, False])), 0.4)
    assert dict(zip(law.states.tolist(), law.probability.tolist(), strict=True)) == pytest.approx(
        {state_of(world, ["01", "01", "00"]): 8 / 9, state_of(world, ["01", "02", "00"]): 1 / 9}
    )
    deep = cut_distribution(world, Observation(np.array([0, 2, 2]), np.array([True, True])), 0.4)
    assert dict(zip(deep.states.tolist(), deep.probability.tolist(), strict=True)) == pytest.approx(
        {state_of(world, ["10", "00", "00"]): 0.6, state_of(world, ["11", "00", "00"]): 0.4}
    )


def test_cells_in_front_of_the_reading_are_cleared():
    hypothesis = WORLD.states.hypotheses[state_of(WORLD, ["11", "02", "30"])]
    refined, quality = DepthFreeSpace().project(
        hypothesis, Observation(np.array([1, 0, 2]), np.array([False, False]))
    )
    assert WORLD.states.index([refined])[0] == state_of(WORLD, ["01", "02", "00"])
    assert quality == pytest.approx(2 / 4)


@pytest.mark.parametrize("name", RULES)
def test_presets_run_and_report_no_evidence(name):
    _, observations = WORLD.simulate(np.random.default_rng(0), 3)
    filter = preset(name, WORLD, 5)
    a, _ = filter.run(observations, 3)
    b, _ = filter.run(observations, 3)
    assert len(a.population) == 5 and a.log_evidence is None
    np.testing.assert_array_equal(a.population.log_weights, b.population.log_weights)
    np.testing.assert_array_equal(
        [h.labels for h in a.population.particles], [h.labels for h in b.population.particles]
    )
    assert state_weights(WORLD, a.population).sum() == pytest.approx(1)


def test_errors_of_the_exact_posterior_are_zero():
    truth, observations = WORLD.simulate(np.random.default_rng(1), 1)
    p = exact_filter(WORLD, observations).posterior[0]
    found = posterior_errors(WORLD, p, p, truth[0])
    assert found["tv"] == found["same_object_error"] == found["occupancy_error"] == 0
    assert found["p_truth"] == p[truth[0]]
    sure = np.eye(len(p))[truth[0]]
    found = posterior_errors(WORLD, sure, p, truth[0])
    assert found["tv"] == pytest.approx(1 - p[truth[0]])
    assert found["same_object_brier"] == found["occupancy_brier"] == 0


# --- calibration ---------------------------------------------------------------------------------------------------
def ranks_of(filter, world, n_worlds):
    """{statistic: ranks}; one simulated world each."""
    scalars, out = state_statistics(world), {}
    for seed in range(n_worlds):
        truth, observations = world.simulate(np.random.default_rng([seed, 77]), 3)
        p = filter(observations, seed)
        for name, scalar in scalars.items():
            out.setdefault(name, []).append(rank_of_truth(np.random.default_rng([seed, 78]), scalar, p, truth[-1]))
    return {name: np.array(r) for name, r in out.items()}


@pytest.mark.parametrize(
    "name", ["exact", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("guided", "balanced"))]
)
def test_ranks_of_a_proper_filter_are_uniform(name):
    """Four statistics: together they reject a right filter with probability 4 FALSE_ALARM."""

    def answer(observations, seed):
        if name == "exact":
            return exact_filter(WORLD, observations).posterior[-1]
        state, _ = PROPER[name](WORLD, 400).run(observations, seed)
        return state_weights(WORLD, state.population)

    for ranks in ranks_of(answer, WORLD, 400).values():
        assert ranks.min() >= 0 and ranks.max() <= N_RANK_DRAWS
        assert rank_uniformity(ranks) > FALSE_ALARM


def test_ranks_detect_a_filter_that_uses_its_evidence_twice():
    def twice(observations, seed):
        p = exact_filter(WORLD, observations).posterior[-1] ** 3
        return p / p.sum()

    assert min(rank_uniformity(r) for r in ranks_of(twice, WORLD, 400).values()) < FALSE_ALARM

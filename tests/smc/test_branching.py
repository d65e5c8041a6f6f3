"""More candidates than places: evidence is unbiased, and schemes without duplicates have something to choose from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Always,
    Branching,
    ClusterStratified,
    Coalesced,
    Dynamics,
    FearnheadClifford,
    Never,
    bootstrap,
)
from mstfilter.smc.testing import TransitionContract
from tests.smc.models import AR1, ar1_observations, hmm, kalman_ar1, mean_ratio, optimal

YS = ar1_observations(8)


def branching(scheme, n, model=AR1, branches=4):
    return replace(
        bootstrap(model, n, scheme, Never()), transition=Branching(Dynamics(model), branches), resample="after"
    )


class TestBranching(TransitionContract):
    def make(self):
        return Branching(Dynamics(AR1), 3)


@pytest.mark.parametrize(
    "scheme",
    [FearnheadClifford(), pytest.param(ClusterStratified(), marks=pytest.mark.nightly)],
    ids=lambda s: type(s).__name__,
)
def test_selections_from_more_candidates_leave_the_evidence_unbiased(scheme):
    """Mean of L_hat / L within 4 standard errors of 1 (false alarm 6e-5 a case)."""
    mean, standard, _ = mean_ratio(branching(scheme, 100), YS[:4], kalman_ar1(YS[:4])[1], range(500))
    assert abs(mean - 1) < 4 * standard < 0.05


def test_candidates_know_where_they_come_from():
    filter = branching(FearnheadClifford(), 20)
    state, before = filter.run(YS[:3], 1)[0], None
    for state, info in filter.iterate(YS[:4], 1):
        assert (info.n, info.n_candidates) == (20, 80 if info.t else 20)
        assert len(set(state.population.particles.tolist())) == 20
        if before is not None:
            parents = state.population.parents
            expected = before[parents["previous"]]
            away = state.population.particles - 0.9 * expected
            assert np.abs(away).max() < 6 * 0.6, "steps of the model from the parent that is named"
            np.testing.assert_array_equal(parents["ancestor"] // 4, parents["previous"])
        before = state.population.particles
    objects = Branching(Dynamics(hmm("objects")), 2).predict(
        np.random.default_rng(0), bootstrap(hmm("objects"), 5).run([0], 0)[0].population, None
    )
    assert len(objects) == 10
    inner, population = Dynamics(AR1, optimal), state.population
    copies = inner.predict(np.random.default_rng(0), population.take(np.repeat(np.arange(20), 2)), 0.7)
    moved = Branching(inner, 2).predict(np.random.default_rng(0), population, 0.7)
    np.testing.assert_array_equal(moved.log_weights, copies.log_weights)
    with pytest.raises(InputError, match="branches is 0"):
        Branching(Dynamics(AR1), 0)


def test_n_of_n_without_duplicates_degenerates_and_branching_does_not():
    """What docs/resampling.md warns of: the effective sample size falls below 5 of 100; with branches it does not."""
    keeping = bootstrap(AR1, 100, FearnheadClifford(), Always()).run(ar1_observations(30), 0)[1]
    assert keeping[-1].ess < 5
    chosen = branching(FearnheadClifford(), 100).run(ar1_observations(30), 0)[1]
    assert min(info.ess for info in chosen) > 15
    few = bootstrap(hmm("objects"), 100, Coalesced(), Always()).run([0, 2, 2, 1], 0)[0]
    assert len(few.population) <= 3, "equal particles are merged, and nothing makes new ones"

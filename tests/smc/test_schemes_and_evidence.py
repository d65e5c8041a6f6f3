"""Schemes that see the particles, or make no duplicates, leave the evidence of a filter unbiased.

The contract tests the copies of all schemes. Here, the mean of L_hat / L is within 4 standard errors of 1 (false
alarm 6e-5 a case), and the standard error is below 0.8 %: a bias of 3.5 % would be seen. The numbers of particles and
seeds keep the standard error at least five of its own standard deviations below that limit (false alarm 3e-7 a case).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from mstfilter.smc import (
    Always,
    Branching,
    ClusterStratified,
    Coalesced,
    EssBelow,
    FearnheadClifford,
    Gaussian,
    Never,
    Normal,
    StateSpaceModel,
    Tempered,
    bootstrap,
)
from tests.smc.models import RHO, SD0, SIGMA, mean_ratio

# Schemes that see the particles, or do not duplicate: few particles, in worlds where few are enough.
SEEING = {
    "clusters": ClusterStratified(Gaussian(0.5)),
    "clusters, optimal": ClusterStratified(Gaussian(0.5), 0.5, FearnheadClifford()),
    "fearnhead_clifford": FearnheadClifford(),
    "tempered optimal": Tempered(FearnheadClifford(), 0.5),
    "coalesced": Coalesced(),
}


def is_unbiased(filter, ys, exact, seeds):
    mean, standard, _ = mean_ratio(filter, ys, exact, range(seeds))
    assert abs(mean - 1) < 4 * standard
    assert standard < 0.008


# --- schemes that see the particles, or do not duplicate ----------------------------------------------------------
NOISE = 2.0  # weak observations: few particles give little spread
MILD = StateSpaceModel.of(Normal(0.0, SD0), lambda x: Normal(RHO * x, SIGMA), lambda x: Normal(x, NOISE))
FAR = [1.5, -0.5, 1.0]


def exact_mild(ys):
    t = np.arange(len(ys))
    cov = SD0**2 * RHO ** np.abs(t[:, None] - t) + NOISE**2 * np.eye(len(ys))
    return float(stats.multivariate_normal(np.zeros(len(ys)), cov).logpdf(ys))


@pytest.mark.parametrize("name", SEEING)
def test_kalman_where_schemes_choose(name):
    """Three candidates a place: schemes that do not duplicate have something to choose from."""
    filter = replace(
        bootstrap(MILD, 10, SEEING[name], Never()),
        transition=Branching(bootstrap(MILD, 1).transition, 3),
        resample="after",
    )
    _, infos = filter.run(FAR, 0)
    assert [info.resampled for info in infos] == [False, True, True]
    is_unbiased(filter, FAR, exact_mild(FAR), 670)


@pytest.mark.parametrize("trigger", [Always(), EssBelow(0.95)], ids=lambda t: type(t).__name__)
def test_kalman_clusters_of_as_many(trigger):
    """n of n: clusters duplicate inside."""
    filter = bootstrap(MILD, 40, SEEING["clusters"], trigger)
    assert any(info.resampled for info in filter.run(FAR, 0)[1])
    is_unbiased(filter, FAR, exact_mild(FAR), 400)

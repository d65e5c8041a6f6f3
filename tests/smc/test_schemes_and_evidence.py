"""Every proper resampling scheme leaves the evidence unbiased, whatever triggers it."""

from __future__ import annotations

import pytest

from mstfilter.registry import COMPONENTS, build
from mstfilter.smc.filters import bootstrap
from mstfilter.smc.resampling import Always, EssBelow
from tests.smc.models import AR1, SYMBOLS, ar1_observations, forward, hmm, kalman_ar1, mean_ratio

YS = ar1_observations(8)
SCHEMES = sorted(COMPONENTS["resampler"])
# Schemes that compare particles pair by pair (O(n^3)): few particles, a short run and many seeds instead.
PAIRWISE = ("clusters", "kdpp")
# Schemes without duplicates keep all n of n particles, so the weights degenerate: a short run.
KEEPING = ("fearnhead_clifford", "coalesced")
TRIGGERS = pytest.mark.parametrize("trigger", [Always(), EssBelow(0.5)], ids=lambda t: type(t).__name__)


def proper(name):
    scheme = build("resampler", name)
    if not scheme.properly_weighted:
        pytest.skip("says that it is not properly weighted")
    return scheme


@TRIGGERS
@pytest.mark.parametrize("name", SCHEMES)
def test_kalman(name, trigger):
    """Mean of L_hat / L within 4 standard errors of 1 (false alarm 6e-5 a case); 2 % of bias would be seen."""
    ys, n, seeds = (YS[:2], 40, 3000) if name in PAIRWISE else (YS[:2] if name in KEEPING else YS, 1500, 400)
    filter = bootstrap(AR1, n, proper(name), trigger)
    mean, standard, _ = mean_ratio(filter, ys, kalman_ar1(ys)[1], range(seeds))
    assert abs(mean - 1) < 4 * standard
    assert standard < (0.01 if name in PAIRWISE else 0.005)


@TRIGGERS
@pytest.mark.parametrize("name", [name for name in SCHEMES if name not in PAIRWISE + KEEPING])
def test_hidden_chain_of_objects(name, trigger):
    """The same with particles that are objects."""
    filter = bootstrap(hmm("objects"), 150, proper(name), trigger)
    mean, standard, _ = mean_ratio(filter, SYMBOLS[:5], forward(SYMBOLS[:5])[1], range(900))
    assert abs(mean - 1) < 4 * standard
    assert standard < 0.005

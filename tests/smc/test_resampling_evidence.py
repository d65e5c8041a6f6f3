"""Every proper scheme inside a filter: the likelihood estimate is unbiased, against the exact Gaussian answer.

Mean of L-hat / L within 4 standard errors of 1: false alarm 6e-5 a case, below 3e-3 for the file; the standard errors
are below 2.5 %, so a bias of 10 % cannot pass.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from mstfilter import registry
from mstfilter.smc.resampling import Always, EssBelow, Residual
from mstfilter.smc.resampling_clusters import ClusterStratified
from mstfilter.smc.resampling_dpp import KDpp
from mstfilter.smc.resampling_optimal import FearnheadClifford
from mstfilter.smc.resampling_wrappers import Coalesced, Tempered
from mstfilter.smc.similarity import Gaussian
from mstfilter.smc.state_space import bootstrap, linear_gaussian

A, Q, R, P = 0.9, 0.5, 1.0, 1.0
Y = np.array([0.8, -0.6, 1.5, 0.9])

SCHEMES = {
    **{
        name: registry.build("resampler", name)
        for name in registry.COMPONENTS["resampler"]
        if registry.build("resampler", name).properly_weighted
    },
    "residual, stratified": Residual("stratified"),
    "residual, systematic": Residual("systematic"),
    "clusters, optimal": ClusterStratified(Gaussian(0.5), 0.5, FearnheadClifford()),
    "coalesced k-DPP": Coalesced(KDpp(Gaussian(0.3))),
    "tempered optimal": Tempered(FearnheadClifford(), 0.5),
}


def exact():
    """Log density of Y by the joint Gaussian of all observations."""
    T = len(Y)
    variance = [P]
    for _ in range(T - 1):
        variance.append(A * A * variance[-1] + Q)
    joint = np.array([[A ** abs(i - j) * variance[min(i, j)] for j in range(T)] for i in range(T)])
    return stats.multivariate_normal.logpdf(Y, np.zeros(T), joint + R * np.eye(T))


@pytest.mark.parametrize("trigger", [Always(), EssBelow(0.7)], ids=["always", "adaptive"])
@pytest.mark.parametrize("name", SCHEMES)
def test_likelihood_is_unbiased(name, trigger):
    model = linear_gaussian(F=[[A]], Q=[[Q]], H=[[1.0]], R=[[R]], m0=[0.0], P0=[[P]])
    filter = bootstrap(model, n=16, resampler=SCHEMES[name], trigger=trigger)
    ratios = np.array([np.exp(filter.run(Y, seed=s)[0].log_evidence - exact()) for s in range(500)])
    error = ratios.std() / np.sqrt(len(ratios))
    assert error < 0.025
    assert abs(ratios.mean() - 1) < 4 * error

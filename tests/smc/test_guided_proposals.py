"""UKF proposals: against filterpy's filters of a single state, and evidence against quadrature.

Means at 5 standard errors: false alarm below 1e-5 for the file.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import Normal, StateSpaceModel, bootstrap, guided, nonlinear_gaussian, ukf_proposal
from tests.smc.models import filterpy_class

Q, R = np.array([[0.4, 0.1], [0.1, 0.3]]), np.array([[0.2, 0.05], [0.05, 0.1]])
Y = np.array([1.3, 0.4])


def f(x):
    return np.stack([x[..., 0] + 0.3 * np.sin(x[..., 1]), 0.8 * x[..., 1]], axis=-1)


def h(x):
    return np.stack([np.hypot(x[..., 0], x[..., 1]), x[..., 0] * x[..., 1]], axis=-1)


PARTICLES = np.random.default_rng(0).normal(1.0, 0.7, (6, 2))


def test_ukf_proposal_is_the_update_of_filterpy():
    found = ukf_proposal(f, Q, h, R, alpha=0.9, beta=2.0, kappa=1.0)(PARTICLES, Y)
    for i, x in enumerate(PARTICLES):
        kf = filterpy_class("UnscentedKalmanFilter")(
            2, 2, 1.0, h, lambda x, dt: x, filterpy_class("MerweScaledSigmaPoints")(2, 0.9, 2.0, 1.0)
        )
        kf.x, kf.P, kf.R, kf.Q = f(x), Q.copy(), R, np.zeros((2, 2))
        kf.predict()
        # filterpy propagates the points of the previous state; here the state before the noise is known.
        kf.sigmas_f = kf.points_fn.sigma_points(f(x), Q)
        kf.update(Y)
        np.testing.assert_allclose(found.mean[i], kf.x, atol=1e-10)
        np.testing.assert_allclose(found.cov[i], kf.P, atol=1e-10)


# --- a scalar model with a curved observation ---------------------------------------------------------------------

CURVED = nonlinear_gaussian(
    lambda x: 0.5 * x + np.cos(x), [[0.5]], lambda x: x + 0.1 * x**2, [[0.05]], [0.0], [[1.0]]
)
PROPOSAL = ukf_proposal(lambda x: 0.5 * x + np.cos(x), [[0.5]], lambda x: x + 0.1 * x**2, [[0.05]])
YS = [1.5, -0.4, None, 2.2]


def evidence_by_quadrature():
    grid = np.linspace(-6, 7, 1500)
    width = grid[1] - grid[0]
    moves = stats.norm(0.5 * grid + np.cos(grid), np.sqrt(0.5)).pdf(grid[:, None])  # new, old
    density = stats.norm(0, 1).pdf(grid)
    for t, y in enumerate(YS):
        density = moves @ density * width if t else density
        density = density if y is None else density * stats.norm(grid + 0.1 * grid**2, np.sqrt(0.05)).pdf(y)
    return density.sum() * width


def test_the_evidence_of_a_guided_filter_is_unbiased():
    exact = evidence_by_quadrature()
    filters = {"guided": guided(CURVED, PROPOSAL, 40), "bootstrap": bootstrap(CURVED, 40)}
    spread = {}
    for form, filter in filters.items():
        ratio = np.exp([filter.run(YS, seed)[0].log_evidence for seed in range(120)]) / exact
        assert abs(ratio.mean() - 1) < 5 * ratio.std(ddof=1) / np.sqrt(120)
        spread[form] = ratio.std()
    assert spread["guided"] < 0.8 * spread["bootstrap"]


def test_what_a_gaussian_model_rejects():
    for matrices, message in (
        (([[1.0]], [[-1.0]]), "R is .*positive definite"),
        (([1.0], [[1.0]]), r"Q has shape \(1,\), expected \(1, 1\) as m0"),
        (([[1.0]], [1.0]), r"R has shape \(1,\), expected \(k, k\)"),
    ):
        with pytest.raises(InputError, match=message):
            nonlinear_gaussian(f, matrices[0], h, matrices[1], [0.0], [[1.0]])
    uneven, x = np.diag([1e8, 1e-8]), np.zeros((1, 2))
    model = nonlinear_gaussian(lambda x: x, uneven, lambda x: x, uneven, [0.0, 0.0], uneven)
    density = stats.norm([0.0, 0.0], [1e4, 1e-4]).logpdf([2e4, 1e-4]).sum()
    assert model.log_transition(x, x + [2e4, 1e-4]) == pytest.approx(density)
    assert model.log_likelihood(x, [2e4, 1e-4]) == pytest.approx(density)
    eye = np.eye(2)
    for f2, h2, message in (
        (lambda x: x[:, :1], lambda x: x, r"step 1, transition: f returned shape \(2, 1\), expected \(2, 2\)"),
        (lambda x: x[:, 0], lambda x: x, r"step 1, transition: f returned shape \(2,\), expected \(2, 2\)"),
        (lambda x: x, lambda x: x[:, :1], r"step 0, update: h returned shape \(2, 1\), expected \(2, 2\)"),
        (lambda x: x, lambda x: x[0], r"step 0, update: h returned shape \(2,\), expected \(2, 2\)"),
    ):
        with pytest.raises(InputError, match=message):
            bootstrap(nonlinear_gaussian(f2, eye, h2, eye, [0.0, 0.0], eye), 2).run([[0.1, 0.2]] * 2)


def test_functions_and_covariances_of_the_step():
    """Q of step 1 and a time-varying f give the proposal of the functions of this step."""
    Qs = np.stack([9 * np.eye(2), Q])
    found = ukf_proposal(lambda x, t: f(x) + t, Qs, h, R)
    expected = ukf_proposal(lambda x: f(x) + 1, Q, h, R)(PARTICLES, Y)
    np.testing.assert_allclose(found.at_step(1)(PARTICLES, Y).mean, expected.mean)
    np.testing.assert_allclose(found.at_step(1)(PARTICLES, Y).cov, expected.cov)
    model = nonlinear_gaussian(lambda x, t: f(x) + t, Qs, h, R, np.zeros(2), np.eye(2))
    assert np.isfinite(guided(model, found, 20).run([Y, Y], 0)[0].log_evidence)


def test_states_of_another_shape_are_refused():
    """numpy would broadcast states (n, 1) against means (n,)."""
    model = StateSpaceModel.of(
        Normal(np.zeros((1, 1)), 1.0), lambda x: Normal(0.9 * x[:, 0], 0.5), lambda x: Normal(x, 1.0)
    )
    with pytest.raises(InputError, match="event shape"):
        guided(model, lambda x, y: Normal(0.5 * x + 0.3 * y, 0.7), 20).run([np.array([0.3])] * 2, 0)

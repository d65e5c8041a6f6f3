"""Rao-Blackwellised filters: the same driver with other parts."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import Always, ConditionallyLinear, EssBelow, Linear, kalman_filter, rao_blackwellised
from tests.smc.test_particle_filter import M0, P0, F, H, Q, R, observations

YS = observations(6)
P_STAY = 0.8
TURN = np.array([[0.9, -0.4], [0.4, 0.9]])
FS, BS = np.stack([F, TURN]), np.array([[0.0, 0.0], [0.5, -0.5]])


def test_nothing_drawn_is_kalman_itself():
    """Where the matrices do not depend on the drawn part, any n gives Kalman's numbers."""
    model = ConditionallyLinear(
        lambda rng, n: rng.random(n), lambda rng, u: rng.random(len(u)), lambda u: Linear(F, Q, H, R), M0, P0
    )
    exact = kalman_filter(F, Q, H, R, M0, P0, YS)
    for n in (1, 3):
        state, _ = rao_blackwellised(model, n).run(YS, 0)
        assert state.log_evidence == pytest.approx(exact.log_evidence[-1], abs=1e-9)
        np.testing.assert_allclose(state.population.particles["mean"], np.tile(exact.means[-1], (n, 1)), atol=1e-9)
        np.testing.assert_allclose(state.population.particles["cov"][0], exact.covariances[-1], atol=1e-9)


def switching():
    def step(rng, u):
        return np.where(rng.random(len(u)) < P_STAY, u, 1 - u)

    return ConditionallyLinear(
        lambda rng, n: (rng.random(n) < 0.5).astype(np.int64), step, lambda u: Linear(FS[u], Q, H, R, BS[u]), M0, P0
    )


def enumerated(ys):
    total = []
    for path in product((0, 1), repeat=len(ys)):
        m, P, log_p = M0, P0, np.log(0.5)
        for t, y in enumerate(ys):
            if t:
                log_p += np.log(P_STAY if path[t] == path[t - 1] else 1 - P_STAY)
                m, P = FS[path[t]] @ m + BS[path[t]], FS[path[t]] @ P @ FS[path[t]].T + Q
            if y is None:
                continue
            S = H @ P @ H.T + R
            log_p += stats.multivariate_normal(H @ m, S).logpdf(y)
            K = P @ H.T @ np.linalg.inv(S)
            m, P = m + K @ (y - H @ m), P - K @ H @ P
        total.append(log_p)
    return np.logaddexp.reduce(total)


@pytest.mark.parametrize(
    ("changed", "y", "message"),
    [
        ({}, 0.3, r"update: the observation has shape \(\), expected \(2,\)"),
        ({"R": 0.5}, [0.3, 0.1], r"linear returned R of shape \(1, 1\), expected \(2, 2\)"),
        ({"Q": np.ones(2)}, [0.3, 0.1], r"transition: linear returned Q of shape \(1, 2\), expected \(2, 2\)"),
        ({"F": np.ones((3, 2))}, [0.3, 0.1], r"transition: linear returned F of shape \(3, 2\)"),
        ({"b": np.ones((3, 2))}, [0.3, 0.1], r"transition: linear returned b of shape \(3, 2\)"),
    ],
)
def test_shapes_that_numpy_would_broadcast(changed, y, message):
    matrices = Linear(**({"F": F, "Q": Q, "H": np.eye(2), "R": np.eye(2)} | changed))
    model = ConditionallyLinear(lambda rng, n: np.zeros(n), lambda rng, u: u, lambda u: matrices, M0, P0)
    with pytest.raises(InputError, match=message):
        rao_blackwellised(model, 1).run([None, y])


@pytest.mark.parametrize("trigger", [Always(), EssBelow(0.5)], ids=lambda t: type(t).__name__)
def test_a_switching_model_agrees_with_enumeration(trigger):
    """Mean of L_hat / L within 4 standard errors (false alarm 6e-5); far less noise than drawing everything."""
    ys = [*YS[:3], None, *YS[4:]]
    filter, exact = rao_blackwellised(switching(), 80, trigger=trigger), enumerated(ys)
    ratios = np.exp([filter.run(ys, s)[0].log_evidence - exact for s in range(150)])
    standard = ratios.std(ddof=1) / np.sqrt(len(ratios))
    assert abs(ratios.mean() - 1) < 4 * standard
    assert standard < 0.005

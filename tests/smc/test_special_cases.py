"""Rao-Blackwellised, manifold and evolutionary filters: the same driver with other parts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest
from scipy import stats

from mstfilter.smc import (
    Always,
    ConditionallyLinear,
    EssBelow,
    Linear,
    Population,
    Proposal,
    bootstrap,
    linear_gaussian,
    rao_blackwellised,
)
from tests.smc.published_updates import CrossVectors, ProjectOnto
from tests.smc.test_particle_filter import M0, P0, F, H, Q, R, kalman, observations

YS = observations(6)
P_STAY = 0.8
TURN = np.array([[0.9, -0.4], [0.4, 0.9]])
FS, BS = np.stack([F, TURN]), np.array([[0.0, 0.0], [0.5, -0.5]])


def test_nothing_drawn_is_kalman_itself():
    """Where the matrices do not depend on the drawn part, any n gives Kalman's numbers."""
    model = ConditionallyLinear(
        lambda rng, n: rng.random(n), lambda rng, u: rng.random(len(u)), lambda u: Linear(F, Q, H, R), M0, P0
    )
    means, cov, exact = kalman(YS)
    for n in (1, 3):
        state, _ = rao_blackwellised(model, n).run(YS, 0)
        assert state.log_evidence == pytest.approx(exact, abs=1e-9)
        np.testing.assert_allclose(state.population.particles["mean"], np.tile(means[-1], (n, 1)), atol=1e-9)
        np.testing.assert_allclose(state.population.particles["cov"][0], cov, atol=1e-9)


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


@pytest.mark.parametrize("trigger", [Always(), EssBelow(0.5)], ids=lambda t: type(t).__name__)
def test_a_switching_model_agrees_with_enumeration(trigger):
    """Mean of L_hat / L within 4 standard errors (false alarm 6e-5); far less noise than drawing everything."""
    ys = [*YS[:3], None, *YS[4:]]
    filter, exact = rao_blackwellised(switching(), 80, trigger=trigger), enumerated(ys)
    ratios = np.exp([filter.run(ys, s)[0].log_evidence - exact for s in range(150)])
    standard = ratios.std(ddof=1) / np.sqrt(len(ratios))
    assert abs(ratios.mean() - 1) < 4 * standard
    assert standard < 0.005


def test_projection_onto_an_exact_observation():
    """H x = y without noise: x + K (y - H x) is distributed as x given y (Matheron), so Kalman's moments hold."""
    K = P0 @ H.T @ np.linalg.inv(H @ P0 @ H.T)
    model = linear_gaussian(F, Q, H, R, M0, P0)
    update = ProjectOnto(lambda x, y: x + (y - x @ H.T) @ K.T)
    filter = replace(bootstrap(model, 20000), update=update)
    state, _ = filter.run([np.array([1.3])], 0)
    x = state.population.particles
    np.testing.assert_allclose(x @ H.T, 1.3, atol=1e-12)
    mean, cov = M0 + K @ (1.3 - H @ M0), P0 - K @ H @ P0
    assert np.abs(x.mean(axis=0) - mean).max() < 5 * np.sqrt(cov.max() / 20000)
    np.testing.assert_allclose(np.cov(x.T), cov, atol=0.02)
    assert state.log_evidence is None
    # The same weights where the likelihood of the projected particles is flat.
    flat = replace(filter, update=replace(update, log_likelihood=lambda x, y: np.full(len(x), -3.0)))
    np.testing.assert_array_equal(flat.run([np.array([1.3])], 0)[0].population.weights, state.population.weights)


def test_crossover_without_mates_is_the_bootstrap_filter_bit_for_bit():
    model = linear_gaussian(F, Q, H, R, M0, P0)
    plain = bootstrap(model, 40)
    crossed = replace(plain, update=CrossVectors(model.log_likelihood))
    a, b = plain.run(YS, 4)[0], crossed.run(YS, 4)[0]
    np.testing.assert_array_equal(a.population.particles, b.population.particles)
    np.testing.assert_array_equal(a.population.log_weights, b.population.log_weights)
    assert b.log_evidence is None


@dataclass(frozen=True)
class Around(Proposal):
    def sample(self, rng, observation, n):
        return Population(np.column_stack([rng.normal(observation[0], 0.5, n), rng.normal(0, 1, n)]))


def test_children_take_each_entry_from_a_parent():
    model = linear_gaussian(F, Q, H, R, M0, P0)
    rng = np.random.default_rng(0)
    predicted = Population(rng.normal(size=(20, 2)), parents={"previous": np.arange(20)})
    proposed = Population(rng.normal(10, 1, size=(30, 2)), parents={"proposed": np.arange(30)})
    fused = CrossVectors(model.log_likelihood).update(rng, predicted, proposed, YS[0])
    assert len(fused) == 20 + 30 + 10
    for k in range(50, 60):
        i, j = fused.parents["previous"][k], fused.parents["proposed"][k]
        child = fused.particles[k]
        assert all(child[d] in (predicted.particles[i, d], proposed.particles[j, d]) for d in range(2))
    filter = replace(
        bootstrap(model, 40),
        update=CrossVectors(model.log_likelihood, among=True),
        proposal=Around(),
        resample="after",
    )
    state, infos = filter.run(YS, 0)
    assert len(state.population) == 40 and infos[0].n_candidates == 40 + 40 + 20

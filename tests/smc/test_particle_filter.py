"""The driver: structure and order of operations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Always,
    ParticleFilter,
    Population,
    Proposal,
    Reweight,
    Transition,
    Update,
    bootstrap,
    linear_gaussian,
)

F, Q = np.array([[1.0, 0.5], [0.0, 0.9]]), np.array([[0.2, 0.05], [0.05, 0.3]])
H, R = np.array([[1.0, 0.0]]), np.array([[0.7]])
M0, P0 = np.array([0.5, -0.2]), np.array([[1.0, 0.2], [0.2, 0.5]])
MODEL = linear_gaussian(F, Q, H, R, M0, P0)


def observations(T=12, seed=8):
    rng = np.random.default_rng(seed)
    x = rng.multivariate_normal(M0, P0)
    out = []
    for t in range(T):
        if t:
            x = F @ x + rng.multivariate_normal(np.zeros(2), Q)
        out.append(H @ x + rng.normal(0, np.sqrt(R[0])))
    return out


def test_steps_run_and_resumed_runs_are_the_same():
    ys = observations()
    filter = bootstrap(MODEL, 30)
    whole, _ = filter.run(ys, 5)
    state = filter.start(5)
    for y in ys:
        state, _ = filter.step(state, y)
    half, _ = filter.run(ys[:4], 5)
    rest, _ = filter.run(ys[4:], half)
    *_, (last, _) = filter.iterate(ys, 5)
    for other in (state, rest, last):
        np.testing.assert_array_equal(other.population.particles, whole.population.particles)
        np.testing.assert_array_equal(other.population.log_weights, whole.population.log_weights)


@dataclass(frozen=True)
class Numbers(Proposal):
    """Proposes the observation itself and the numbers after it."""

    def sample(self, rng, observation, n):
        return Population(tuple(observation + k for k in range(n)))


@dataclass(frozen=True)
class Stay(Transition):
    def predict(self, rng, population, observation):
        return Population(population.particles, population.log_weights)


@dataclass(frozen=True)
class Pairs(Update):
    """Every pair of a proposed and a predicted number, as MST makes its candidates."""

    properly_weighted = False

    def update(self, rng, predicted, proposed, observation):
        if predicted is None:
            return proposed
        i, j = (a.ravel() for a in np.meshgrid(np.arange(len(proposed)), np.arange(len(predicted)), indexing="ij"))
        particles = tuple((proposed.particles[a], predicted.particles[b]) for a, b in zip(i, j, strict=True))
        parents = {"previous": predicted.parents["previous"][j], "proposed": proposed.parents["proposed"][i]}
        return Population(particles, np.zeros(len(i)), parents)


PAIRING = ParticleFilter(
    transition=Stay(), proposal=Numbers(), update=Pairs(), trigger=Always(), n=3, n_proposed=4, resample="after"
)


def test_a_filter_that_starts_from_its_proposal():
    state, info = PAIRING.step(PAIRING.start(0), 10)
    assert info.n_candidates == 4  # the proposed particles pass the first update alone
    assert len(state.population) == 3
    assert set(state.population.particles) <= {10, 11, 12, 13}
    state2, info2 = PAIRING.step(state, 20)
    assert info2.n_candidates == 12
    parents = state2.population.parents
    for particle, previous, proposed in zip(
        state2.population.particles, parents["previous"], parents["proposed"], strict=True
    ):
        assert particle == (20 + proposed, state.population.particles[previous])
    assert state2.log_evidence is None  # an improper component: no evidence


def test_wrong_filters_are_one_clear_error():
    with pytest.raises(InputError, match="neither"):
        ParticleFilter()
    with pytest.raises(InputError, match="n is 0"):
        ParticleFilter(initial=Numbers(), n=0)
    with pytest.raises(InputError, match="resample"):
        ParticleFilter(initial=Numbers(), resample="sometimes")
    with pytest.raises(InputError, match="first observation is missing"):
        PAIRING.step(PAIRING.start(0), None)


@dataclass(frozen=True)
class Around(Proposal):
    mean: np.ndarray

    def sample(self, rng, observation, n):
        return Population(self.mean + rng.normal(size=(n, 2)))


@pytest.mark.parametrize("log_likelihood", [-5.0, 0.0, 5.0])
def test_proposed_particles_weigh_as_much_as_predicted_ones(log_likelihood):
    """If all explain the observations equally well, a third of the particles is new in each step of a long run."""
    filter = ParticleFilter(
        initial=Around(np.ones(2)),
        proposal=Around(np.zeros(2)),
        update=Reweight(lambda x, y: np.full(len(x), log_likelihood)),
        n=10,
        n_proposed=5,
    )
    for state, info in filter.iterate(range(30)):
        new = (state.population.parents["proposed"] >= 0).sum()
        assert new in (3, 4), f"{new} of 10 in step {info.t}"


def test_proposals_may_have_arrays_as_fields():
    """A filter starts from its proposal if `initial` equals it; the comparison must not fail."""
    a, b = np.array([0.0, 1.0]), np.array([2.0, 1.0])
    found = {}
    for name, initial in (("same", Around(a)), ("equal", Around(a.copy())), ("other", Around(b))):
        proposal = initial if name == "same" else Around(a)
        filter = ParticleFilter(
            initial=initial, proposal=proposal, update=Reweight(lambda x, y: -(x[:, 0] ** 2)), n=10
        )
        found[name] = filter.run([1.0], 0)[1][0].n_candidates
    assert found == {"same": 10, "equal": 10, "other": 20}

"""Bootstrap, guided, auxiliary and resample-move filters against exact answers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Always,
    Dynamics,
    EssBelow,
    Normal,
    PriorityLookahead,
    RandomWalkMove,
    Size,
    Sized,
    StateSpaceModel,
    WeightResampler,
    auxiliary,
    bootstrap,
    guided,
    log_evidence,
    mean,
    resample_move,
    run_many,
)
from tests.smc.models import (
    AR1,
    RHO,
    SIGMA,
    SYMBOLS,
    ar1_observations,
    hmm,
    kalman_ar1,
    mean_ratio,
    optimal,
    optimal_initial,
    predictive,
    states_of,
)

YS = ar1_observations(8)
WIDE = lambda x, y: Normal(0.5 * (RHO * x + y), 0.7)  # noqa: E731  a poor but valid proposal

FILTERS = {
    "bootstrap": lambda trigger: bootstrap(AR1, 1500, trigger=trigger),
    "guided": lambda trigger: guided(AR1, WIDE, 2500, lambda y: Normal(0.4 * y, 1.5), trigger=trigger),
    "auxiliary": lambda trigger: auxiliary(AR1, lambda x, y: 0.7 * predictive(x, y), 1800, trigger=trigger),
    "auxiliary, wrong priority": lambda trigger: auxiliary(AR1, lambda x, y: np.sin(3 * x), 3000, trigger=trigger),
    "auxiliary, guided": lambda trigger: auxiliary(AR1, predictive, 400, optimal, trigger=trigger),
    "resample-move": lambda trigger: resample_move(AR1, RandomWalkMove(AR1, 0.6, 2), 1800, trigger=trigger),
}


@pytest.mark.parametrize(
    ("name", "trigger"),
    [(name, EssBelow(0.5)) for name in FILTERS]
    + [pytest.param(name, Always(), marks=[pytest.mark.nightly] * (name != "bootstrap")) for name in FILTERS],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_every_filter_agrees_with_kalman(name, trigger):
    """Mean of L_hat / L within 4 standard errors of 1 (false alarm 6e-5 a case), means and variances within 5."""
    filter = FILTERS[name](trigger)
    moments, exact = kalman_ar1(YS)

    def square(state, info):
        return state.population.weights @ (state.population.particles - moments[-1, 0]) ** 2

    runs = run_many(filter, YS, range(400), z=log_evidence, mean=mean, square=square)
    ratios = np.exp(runs["z"][:, -1] - exact)
    means, squares = runs["mean"][:, -1], runs["square"][:, -1]
    standard = ratios.std(ddof=1) / np.sqrt(len(ratios))
    assert abs(ratios.mean() - 1) < 4 * standard
    assert standard < 0.005, "noise could hide a bias of 2 %"
    for values, wanted in ((means, moments[-1, 0]), (squares, moments[-1, 1])):
        found = np.array(values)
        # Self-normalised estimates are biased by O(1 / n).
        assert abs(found.mean() - wanted) < 5 * found.std(ddof=1) / np.sqrt(len(found)) + 2.5 / filter.n


@pytest.mark.parametrize("n", [1, 2, 7])
def test_one_step_with_the_optimal_proposal_is_exact_for_any_n(n):
    for y in (-2.0, 0.3, 11.0):
        state, _ = guided(AR1, optimal, n, optimal_initial).run([y], seed=n)
        assert state.log_evidence == pytest.approx(kalman_ar1([y])[1], abs=1e-9)


def test_a_fully_adapted_filter_has_equal_weights():
    """With p(y | x_{t-1}) as priority and the optimal proposal, weights after a resampled step are equal."""
    filter = auxiliary(AR1, predictive, 40, optimal, optimal_initial, trigger=Always())
    for state, _ in filter.iterate(YS, 0):
        np.testing.assert_allclose(state.population.log_weights, state.population.log_weights[0], atol=1e-9)


@pytest.mark.parametrize("kind", ["mapping", "objects"])
def test_a_chain_is_the_same_with_any_kind_of_particle(kind):
    one, other = (bootstrap(hmm(k), 50).run(SYMBOLS, 2)[0].population for k in ("vector", kind))
    np.testing.assert_array_equal(one.particles, states_of(other.particles))
    np.testing.assert_array_equal(one.log_weights, other.log_weights)


def test_a_particle_that_cannot_be_is_never_kept():
    """Symbol 3 is impossible in state 0."""
    for seed in range(20):
        state, _ = bootstrap(hmm("objects"), 30).run([0, 3], seed)
        assert (states_of(state.population.particles)[state.population.weights > 0] != 0).all()


@pytest.mark.parametrize("name", FILTERS)
def test_missing_observations(name):
    ys = [YS[0], None, None, *YS[3:6], None]
    moments, exact = kalman_ar1(ys)
    filter = replace(FILTERS[name](EssBelow(0.5)), n=200)
    mean, standard, _ = mean_ratio(filter, ys, exact, range(150))
    assert abs(mean - 1) < 4 * standard
    assert "update" not in filter.run(ys[:2], 0)[1][-1].seconds
    state, _ = replace(filter, n=20000).run(ys, 0)
    w, x = state.population.weights, state.population.particles
    assert abs(w @ x - moments[-1, 0]) < 0.06
    assert abs(w @ (x - w @ x) ** 2 - moments[-1, 1]) < 0.08


def test_moves_follow_a_resampling_and_note_how_many_are_accepted():
    """The contract compares moves with exact draws."""
    _, infos = resample_move(AR1, RandomWalkMove(AR1, 0.5), 60, trigger=Always()).run(YS, 1)
    assert "rejuvenation" not in infos[0].seconds  # nothing was resampled in the first step
    assert all(0 < info.notes["rejuvenation"]["accepted"] <= 1 for info in infos[1:])


def test_moves_of_a_mapping_and_after_the_update():
    model = StateSpaceModel(
        lambda rng, n: {"x": AR1.sample_initial(rng, n)},
        lambda rng, p: {"x": AR1.sample_transition(rng, p["x"])},
        lambda p, y: AR1.log_likelihood(p["x"], y),
        lambda p: AR1.log_initial(p["x"]),
        lambda old, new: AR1.log_transition(old["x"], new["x"]),
    )
    filter = replace(resample_move(model, RandomWalkMove(model, 0.6), 150), resample="after")
    mean, standard, _ = mean_ratio(filter, YS, kalman_ar1(YS)[1], range(200))
    assert abs(mean - 1) < 4 * standard


def test_densities_of_transitions():
    old, new = np.array([0.0, 1.0]), np.array([0.5, -0.5])
    expected = stats.norm(RHO * old, SIGMA).logpdf(new)
    np.testing.assert_allclose(Dynamics(AR1).log_prob(old, new, 0.3), expected)
    np.testing.assert_allclose(Dynamics(AR1, optimal).log_prob(old, new, None), expected)
    np.testing.assert_allclose(Dynamics(AR1, optimal).log_prob(old, new, 0.3), optimal(old, 0.3).log_prob(new))
    bare = StateSpaceModel(AR1.sample_initial, AR1.sample_transition, AR1.log_likelihood)
    with pytest.raises(InputError, match="step 1, transition: the model has no log_transition"):
        guided(bare, optimal, 5).run(YS, 0)


def test_a_random_walk_refuses_integers():
    """A step of real numbers would leave the states of a chain."""
    for kind, message in (("vector", "particles are int64"), ("mapping", "particles are int64")):
        model = hmm(kind)
        with pytest.raises(InputError, match=f"step 1, rejuvenation: {message}, expected floats"):
            resample_move(model, RandomWalkMove(model, 0.5), 20, trigger=Always()).run([0, 2], 0)


@dataclass(frozen=True)
class Alternating(Size):
    """90 particles where the effective sample size is low, 30 where it is high."""

    def choose(self, population):
        return 90 if population.ess < 0.3 * len(population) else 30


@pytest.mark.parametrize("resample", ["before", "after"])
def test_a_size_that_changes_keeps_the_evidence(resample):
    filter = replace(bootstrap(AR1, 60, Sized(size=Alternating())), resample=resample)
    sizes = {info.n for info in filter.run(YS, 0)[1]}
    assert len(sizes) > 1
    mean, standard, _ = mean_ratio(filter, YS, kalman_ar1(YS)[1], range(500))
    assert abs(mean - 1) < 4 * standard


def test_evidence_of_improper_parts_is_not_reported():
    @dataclass(frozen=True)
    class Top(WeightResampler):
        properly_weighted = False

        def select(self, rng, log_weights, n):
            return np.argsort(-log_weights)[:n], None

    @dataclass(frozen=True)
    class Guess(PriorityLookahead):
        properly_weighted = False

    assert bootstrap(AR1, 5, Top()).run(YS)[0].log_evidence is None
    filter = replace(bootstrap(AR1, 5), lookahead=Guess(predictive))
    assert filter.run(YS)[0].log_evidence is None
    proper = bootstrap(AR1, 5)
    assert proper.run(YS)[0].log_evidence is not None
    for first, second in ((proper, bootstrap(AR1, 5, Top())), (bootstrap(AR1, 5, Top()), proper)):
        assert second.run(YS[4:], first.run(YS[:4])[0])[0].log_evidence is None


def test_wrong_parts_are_named_with_step_and_slot():
    bad = auxiliary(AR1, lambda x, y: np.full(len(x), -np.inf), 5)
    with pytest.raises(InputError, match="step 1, lookahead: log priority of particle 0 is -inf"):
        bad.run(YS)
    with pytest.raises(InputError, match=r"step 1, lookahead: log priorities have shape \(2,\)"):
        auxiliary(AR1, lambda x, y: np.zeros(2), 5).run(YS)
    nan = replace(bootstrap(AR1, 5), update=replace(bootstrap(AR1, 5).update, log_likelihood=lambda x, y: x * np.nan))
    with pytest.raises(InputError, match="step 0, update: log weight of particle 0 is nan"):
        nan.run(YS)
    with pytest.raises(InputError, match="needs the next observation"):
        replace(auxiliary(AR1, predictive, 5), resample="after")


def test_a_proposal_draws_the_shape_of_the_state():
    """numpy would broadcast (n, 1) against (n,), and sum over all pairs of particles."""
    scalar = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
    vector = StateSpaceModel.of(
        Normal(np.zeros((1, 2)), 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x[:, 0], 1.0)
    )
    own = replace(scalar, log_transition=lambda old, new: -np.square(new - old).reshape(len(new), -1).sum(axis=1))
    for model, proposal, initial, message in (
        (scalar, lambda x, y: Normal(x[:, None], 1.0), None, "1, transition: the proposal returned"),
        (own, lambda x, y: Normal(x[:, None], 1.0), None, "1, transition: the proposal returned"),
        (scalar, None, lambda y: Normal(np.full((1, 1), y), 1.0), "0, initial: particles have"),
        (vector, None, lambda y: Normal(np.full((1, 1), y), 1.0), "0, initial: particles have"),
        (vector, lambda x, y: Normal(x[:, 0], 1.0), None, "1, transition: the proposal returned"),
    ):
        with pytest.raises(InputError, match=f"step {message} .*shape"):
            guided(model, proposal, 6, initial).run([0.1, 0.2])
    growing = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(x[:, None], 0.5), lambda x: Normal(x.T[0].T, 1.0))
    with pytest.raises(
        InputError, match=r"step 1, transition: the transition returned shape \(6, 1\), expected \(6,\)"
    ):
        bootstrap(growing, 6).run([None, None])

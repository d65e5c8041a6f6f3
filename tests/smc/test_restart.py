"""Runs that start from given particles, and moves that do not depend on what a trigger has seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Always,
    EssBelow,
    Every,
    Key,
    Never,
    Normal,
    Population,
    RandomWalkMove,
    Rejuvenation,
    State,
    StateSpaceModel,
    bootstrap,
    resample_move,
)
from mstfilter.smc.first_steps import unexamined
from tests.smc.enumeration import outcomes
from tests.smc.models import AR1, ar1_observations, kalman_ar1

YS = ar1_observations(12)


def moves(filter, state, y):
    """What the particles of the next step differ by from their parents."""
    after, _ = filter.step(state, y)
    before = 0.0 if state.population is None else state.population.particles[after.population.parents["previous"]]
    return after.population.particles - 0.9 * before


def test_given_particles_move_with_new_random_numbers():
    filter = bootstrap(AR1, 100)
    state, _ = filter.run(YS[:5], seed=0)
    particles = np.zeros(100)  # the same for all runs, so that equal numbers would give equal moves
    ran = filter.start(0)
    seen = []
    for y in YS:
        noise = moves(filter, State(5, Population(particles), Key(0)), y)
        seen.append(noise)
        ran, _ = filter.step(ran, y)
    for t in range(12):
        given = filter.start(0, Population(particles), t=t)
        assert not np.isin(np.round(moves(filter, given, 0.1), 9), np.round(seen, 9)).any()
    assert filter.start(0, state.population).key == filter.start(0, state.population).key  # reproducible
    other = state.population.reweighted(np.linspace(0, 1, 100))
    keys = {filter.start(seed, p).key for seed in (0, 1) for p in (state.population, other)}
    assert len(keys) == 4


@pytest.mark.parametrize("kind", ["array", "mapping", "objects"])
def test_two_restarts_in_a_row_have_different_streams(kind):
    given = {
        "array": np.arange(3.0),
        "mapping": {"x": np.arange(3.0)},
        "objects": ("a", "b", "c"),
    }[kind]
    filter = bootstrap(AR1, 3)
    first = Population(given, parents={"previous": np.array([0, 0, 1])})
    second = Population(given, parents={"previous": np.array([0, 2, 1])})
    assert filter.start(0, first).key != filter.start(0, second).key


def test_a_run_goes_on_from_a_stored_posterior():
    """The log evidence of both parts is that of one run, within Monte Carlo error (|z| < 5, false alarm 6e-7)."""
    filter, ratios = bootstrap(AR1, 300), []
    _, exact = kalman_ar1(YS)
    for seed in range(60):
        posterior = filter.run(YS[:6], seed)[0].population
        stored = Population(posterior.particles.copy(), posterior.log_weights.copy())
        state, _ = filter.run(YS[6:], filter.start(seed, stored, t=6))
        assert state.t == 12
        ratios.append(np.exp(state.log_evidence - exact))
    z = (np.mean(ratios) - 1) / (np.std(ratios) / np.sqrt(len(ratios)))
    assert abs(z) < 5


def test_functions_of_the_time_go_on():
    seen = []

    def move(x, t):
        seen.append(t)
        return Normal(x, 1.0)

    filter = bootstrap(StateSpaceModel.of(Normal(0.0, 1.0), move, lambda x: Normal(x, 1.0)), 20)
    filter.run([0.1, 0.2], filter.start(0, Population(np.zeros(20)), t=7))
    assert set(seen) == {7, 8}


def test_a_restart_that_would_repeat_random_numbers_is_refused():
    with pytest.raises(InputError, match="would draw again the random numbers") as error:
        State(0, Population(np.zeros(3)), Key(0))
    assert "filter.start(seed, population)" in error.value.hints[0]
    filter = bootstrap(AR1, 3)
    for t in (-1, 1.5, True):
        with pytest.raises(InputError, match="t is"):
            filter.start(0, Population(np.zeros(3)), t=t)
    with pytest.raises(InputError, match="no particles after 3 observations"):
        filter.start(0, t=3)


@pytest.mark.parametrize("trigger", [EssBelow(0.5), Every(3)])
def test_moves_after_the_update_do_not_depend_on_the_trigger(trigger):
    """With resample="after" the trigger has seen the particles, so it must not decide which of them move.

    Else the evidence is biased: with n = 3, an exact kernel, y = 0, 2 and the trigger EssBelow by 1.65 % (standard
    error .27 %).
    """
    filter = replace(resample_move(AR1, RandomWalkMove(AR1, 0.5), 50), resample="after", trigger=trigger)
    _, infos = filter.run(YS, 0)
    assert not all(info.resampled for info in infos)
    assert all("rejuvenation" in info.notes for info in infos)
    before = replace(filter, resample="before")  # here the trigger has only seen their parents
    _, infos = before.run(YS, 0)
    assert [("rejuvenation" in info.notes) == info.resampled for info in infos] == [True] * len(YS)


class ScriptedKey(Key):
    """All streams of a run are one generator, whose outcomes are enumerated."""

    def child(self, *parts):
        return self

    def generator(self):
        return self.__dict__["rng"]


@dataclass(frozen=True)
class ExactMove(Rejuvenation):
    """Draws x_0 given y_0 anew: it is 1 with probability 3/4."""

    def move(self, rng, population, previous, observation):
        if previous is not None:
            return population
        return population.moved((rng.integers(0, 4, len(population)) > 0).astype(int))


@pytest.mark.parametrize("resample", ["after", "before"])
@pytest.mark.parametrize("trigger", [EssBelow(0.8), Every(2), Always(), Never()])
def test_moves_leave_the_evidence_of_few_particles_exact(resample, trigger):
    """By enumeration of all draws of three particles with two states, which do not change.

    The trigger `EssBelow` resamples if one particle of three has state 1, and not if two have.
    """
    likelihoods = np.array([[1.0, 3.0], [5.0, 1.0]])
    model = StateSpaceModel(
        lambda rng, n: rng.integers(0, 2, n),
        lambda rng, x: x,
        lambda x, y: np.log(likelihoods[y, x]),
    )
    filter = replace(bootstrap(model, 3, trigger=trigger), rejuvenation=ExactMove(), resample=resample)

    def run(rng):
        key = ScriptedKey(0)
        key.__dict__["rng"] = rng
        with unexamined():
            return np.exp(filter.run([0, 1], filter.start(key))[0].log_evidence)

    cells = (
        35 if resample == "before" else 1
    )  # weights are multiples of 1/5 or 1/7, or moves replace what is selected
    assert sum(p * evidence for p, evidence in outcomes(run, cells)) == pytest.approx(4.0, rel=1e-12)


def test_a_seed_has_one_name():
    filter = bootstrap(AR1, 10)
    *_, (last, _) = filter.iterate(YS, seed=3)
    assert last.log_evidence == filter.run(YS, seed=3)[0].log_evidence

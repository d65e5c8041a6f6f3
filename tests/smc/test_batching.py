"""Runs of a batch equal single runs bit for bit, whatever the components."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from mstfilter.errors import InputError
from mstfilter.smc import (
    Always,
    Branching,
    EssBelow,
    EveryKth,
    FearnheadClifford,
    Multinomial,
    Never,
    Normal,
    Program,
    RandomWalkMove,
    RunGenerators,
    Ssp,
    StateSpaceModel,
    Stratified,
    Systematic,
    Tempered,
    batch,
    batched_slots,
    bootstrap,
    guided,
    observe,
    resample_move,
    sample,
)
from mstfilter.smc.batching import summaries
from mstfilter.smc.population import Population
from mstfilter.smc.streams import Key, pcg64_states
from tests.smc.models import AR1, RHO, SD0, SIGMA, TAU, ar1_observations, hmm, optimal
from tests.smc.test_particle_filter import MODEL, observations
from tests.smc.test_streams import words_of

YS = ar1_observations(8)
SEEDS = [3, 1, 4, 1_000_003, 2**40 + 1]
BATCHED = StateSpaceModel(
    lambda rng, n: SD0 * rng.standard_normal(n),
    lambda rng, x: RHO * x + SIGMA * rng.standard_normal(x.shape),
    lambda x, y: -0.5 * ((y - x) / TAU) ** 2,
    batched=True,
)


def walk(previous, y):
    x = sample("x", Normal(0.0 if previous is None else previous["x"], 1.0))
    observe("y", Normal(x, 1.0), y)


def branching(filter):
    return replace(filter, transition=Branching(filter.transition, 2))


FILTERS = {
    "batched": bootstrap(BATCHED, 20),
    "always": bootstrap(BATCHED, 20, Stratified(), Always()),
    "after": replace(bootstrap(BATCHED, 20, Ssp(), EssBelow(0.9)), resample="after"),
    "every third": bootstrap(BATCHED, 20, Multinomial(), EveryKth(3)),
    "many draws": bootstrap(BATCHED, 2100, Multinomial(), Always()),
    "many strata": bootstrap(BATCHED, 1100, Stratified(), Always()),
    "never": bootstrap(BATCHED, 20, Systematic(), Never()),
    "rows": bootstrap(AR1, 20),
    "guided": guided(AR1, optimal, 20),
    "program": Program(walk).bootstrap(20),
    "objects": bootstrap(hmm("objects"), 20),
    "more candidates": branching(bootstrap(AR1, 20)),
    "without duplicates": branching(bootstrap(AR1, 20, FearnheadClifford())),
    "one by one": resample_move(AR1, RandomWalkMove(AR1, 0.5), 20),
}


def equal(a, b):
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[k], b[k]) for k in a)
    return all(x == y for x, y in zip(a, b, strict=True)) if isinstance(a, tuple) else np.array_equal(a, b)


def assert_equal_to_single_runs(filter, data, seeds, runs):
    for r, seed in enumerate(seeds):
        state = None
        for state, info in filter.iterate(data[r], seed):
            np.testing.assert_array_equal(runs.values["weights"][r, info.t], state.population.weights)
            assert runs.ess[r, info.t] == info.ess
            assert runs.log_evidence[r, info.t] == state.log_evidence
            assert runs.resampled[r, info.t] == info.resampled
        last = runs.state(r)
        assert (last.t, last.key) == (state.t, state.key)
        assert equal(last.population.particles, state.population.particles)
        np.testing.assert_array_equal(last.population.log_weights, state.population.log_weights)
        np.testing.assert_array_equal(last.population.parents["previous"], state.population.parents["previous"])


@pytest.mark.parametrize("name", FILTERS)
def test_every_run_equals_its_single_run(name):
    filter = FILTERS[name]
    ys = [0, 2, 1, 3, 0] if name == "objects" else [*YS[:4], None, *YS[5:]]
    runs = batch(filter, ys, SEEDS, weights=lambda p: p.weights)
    assert_equal_to_single_runs(filter, [ys] * len(SEEDS), SEEDS, runs)


def test_a_model_of_vectors_with_its_own_data_for_each_run():
    data = [observations(6, seed) for seed in range(5)]
    for filter in (bootstrap(MODEL, 50, Systematic(), Always()), guided(AR1, optimal, 10)):
        ys = data if filter.n == 50 else [[float(y[0]) for y in run] for run in data]
        assert_equal_to_single_runs(filter, ys, SEEDS, batch(filter, ys, SEEDS, True, weights=lambda p: p.weights))
    data[2][3] = None
    filter = bootstrap(MODEL, 50)
    assert_equal_to_single_runs(filter, data, SEEDS, batch(filter, data, SEEDS, True, weights=lambda p: p.weights))


def test_which_components_are_called_once_per_step():
    assert batched_slots(bootstrap(BATCHED, 5)) == ("initial", "transition", "update", "resampler")
    assert batched_slots(bootstrap(AR1, 5, Ssp())) == ("initial", "transition", "update")
    assert batched_slots(bootstrap(replace(AR1, batched=False), 5)) == ("resampler",)
    assert batched_slots(bootstrap(BATCHED, 5, Tempered())) is None
    assert batched_slots(resample_move(AR1, RandomWalkMove(AR1, 0.5), 5)) is None


def limited(model, bound):
    """The model, with likelihood 0 above a bound."""
    return replace(model, log_likelihood=lambda x, y: np.where(x < bound, model.log_likelihood(x, y), -np.inf))


@pytest.mark.parametrize("model", [BATCHED, AR1], ids=["batched", "rows"])
def test_lost_runs_are_recorded_and_the_others_continue(model):
    filter = bootstrap(limited(model, -0.2), 3)
    runs = batch(filter, YS, range(40))
    assert 0 < len(runs.lost) < 40
    for r in range(40):
        if r not in runs.lost:
            assert filter.run(YS, r)[0].log_evidence == runs.log_evidence[r, -1] == runs.state(r).log_evidence
            continue
        with pytest.raises(InputError) as error:
            filter.run(YS, r)
        assert error.value.message == runs.lost[r] and "all 3 log weights are -inf" in runs.lost[r]
        lost_at = int(runs.lost[r].split(":")[0].split()[1].rstrip(","))
        assert np.isneginf(runs.log_evidence[r, lost_at:]).all() and np.isfinite(runs.log_evidence[r, :lost_at]).all()
        assert np.isnan(runs.ess[r, lost_at:]).all() and runs.states[r] is None
        with pytest.raises(InputError, match=f"run {r} is lost"):
            runs.state(r)
    everything = batch(bootstrap(limited(model, -1e9), 3), YS, range(4))
    assert set(everything.lost) == {0, 1, 2, 3} and np.isneginf(everything.log_evidence).all()


def test_generators_of_runs_draw_what_their_streams_draw():
    seeds = list(range(6))
    ours = RunGenerators(pcg64_states(words_of(seeds, "a")))
    singles = [Key(seed).child("a").generator() for seed in seeds]
    means = np.arange(12.0).reshape(6, 2)
    for draw in (
        lambda rng, shape, mean: rng.standard_normal(size=(*shape, 3)),
        lambda rng, shape, mean: rng.random(size=(*shape, 4)),
        lambda rng, shape, mean: (
            rng.standard_exponential(size=shape) if shape else np.array(rng.standard_exponential())
        ),
        lambda rng, shape, mean: rng.normal(mean, 2.0, size=(*shape, 2)),
        lambda rng, shape, mean: rng.integers(0, 7, size=(*shape, 5)),
        lambda rng, shape, mean: rng.poisson(mean),
        lambda rng, shape, mean: rng.integers(0, 7, size=(*shape, 3)),
        lambda rng, shape, mean: rng.standard_normal(size=(*shape, 2, 2)),
    ):
        expected = np.stack([draw(rng, (), mean) for rng, mean in zip(singles, means, strict=True)])
        np.testing.assert_array_equal(draw(ours, (6,), means), expected)
    for wrong in (lambda: ours.standard_normal(3), lambda: ours.normal(0.0, 1.0), lambda: ours.random((5, 2))):
        with pytest.raises(InputError, match="for 6 runs"):
            wrong()


def test_summaries_are_those_of_populations():
    log_weights = 3 * np.random.default_rng(0).standard_normal((50, 37))
    ess, log_mean = summaries(log_weights)
    for row in range(50):
        population = Population(np.zeros(37), log_weights[row])
        assert (ess[row], log_mean[row]) == (population.ess, population.log_mean_weight)


def test_wrong_calls_are_named():
    with pytest.raises(InputError, match="2 sequences of observations for 3 seeds"):
        batch(bootstrap(AR1, 5), [YS, YS], range(3), paired=True)
    with pytest.raises(InputError, match="lengths"):
        batch(bootstrap(AR1, 5), [YS, YS[:2]], range(2), paired=True)
    with pytest.raises(InputError, match="no seeds"):
        batch(bootstrap(AR1, 5), YS, [])
    with pytest.raises(InputError, match=r"run 0, step 0, update: log likelihood has shape \(\)"):
        batch(bootstrap(replace(AR1, log_likelihood=lambda x, y: 0.0), 5), YS, range(2))


def test_threads_do_not_mix_their_streams():
    """Threads that draw at the same time draw what each of them draws alone."""

    def drawn(first):
        rng = RunGenerators(pcg64_states(words_of(range(first, first + 50), "a")))
        return np.stack([rng.standard_normal((50, 40)) for _ in range(40)])

    alone = [drawn(first) for first in (0, 100, 200, 300)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(drawn, (0, 100, 200, 300)))
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_array_equal(a, b)

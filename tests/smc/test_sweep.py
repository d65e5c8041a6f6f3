"""Runs that are made in a sweep have the law of single runs. False alarms: at most 1e-6 for each test."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Branching,
    Chopthin,
    Coalesced,
    EssBelow,
    Every,
    FearnheadClifford,
    Key,
    Killing,
    Multinomial,
    Never,
    Normal,
    Population,
    Program,
    RandomWalkMove,
    Residual,
    Shuffled,
    Sorted,
    Ssp,
    StateSpaceModel,
    Stratified,
    Systematic,
    WithInput,
    auxiliary,
    bootstrap,
    ess,
    guided,
    log_evidence,
    mean,
    observe,
    resample_move,
    resampled,
    run_many,
    sample,
    unique_ancestors,
)
from mstfilter.smc.first_steps import unexamined
from mstfilter.smc.sweep import can_sweep, independent_draws_of_runs, inverse_cdf_of_runs, summaries
from tests.smc.models import AR1, ar1_observations, kalman_ar1, optimal, predictive

YS = [*ar1_observations(5), None, 0.4]


def ar1(previous, y):
    x = sample("x", Normal(0.0, 1.4) if previous is None else Normal(0.9 * previous["x"], 0.6))
    observe("y", Normal(x, 0.4), y)


PAIRS = StateSpaceModel(
    lambda rng, n: {"x": rng.normal(size=n), "v": rng.normal(size=(n, 2))},
    lambda rng, p: {"x": 0.9 * p["x"] + rng.normal(size=len(p["x"])), "v": p["v"]},
    lambda p, y: -0.5 * (p["x"] + p["v"][:, 0] - y) ** 2,
)
WORDS = StateSpaceModel(
    lambda rng, n: tuple((rng.normal(),) for _ in range(n)),
    lambda rng, xs: tuple((x[0] + rng.normal(),) for x in xs),
    lambda xs, y: np.array([-0.5 * (x[0] - y) ** 2 for x in xs]),
)
FILTERS = {
    **{
        type(scheme).__name__: bootstrap(AR1, 12, scheme)
        for scheme in (Systematic(), Stratified(), Multinomial(), Residual(), Ssp(), Killing(), Sorted(), Chopthin())
    },
    "after": replace(bootstrap(AR1, 12), resample="after"),
    "rarely": bootstrap(AR1, 12, trigger=EssBelow(0.2)),
    "every third": bootstrap(AR1, 12, trigger=Every(3)),
    "never": bootstrap(AR1, 12, trigger=Never()),
    "guided": guided(AR1, optimal, 12),
    "auxiliary": auxiliary(AR1, predictive, 12),
    "program": Program(ar1).bootstrap(12),
    "mapping": bootstrap(PAIRS, 12),
    "objects": bootstrap(WORDS, 12),
    "shuffled": bootstrap(AR1, 12, Shuffled()),
}
KEPT = {"z": log_evidence, "ess": ess, "moved": resampled, "unique": unique_ancestors}


@pytest.mark.parametrize("name", FILTERS)
def test_runs_of_a_sweep_have_the_law_of_single_runs(name):
    filter, n = FILTERS[name], 300
    assert can_sweep(filter)
    together = run_many(filter, YS, range(n), **KEPT)
    with unexamined():
        single = run_many(filter, YS, range(n, 2 * n), together=False, **KEPT)
    for what, t in product(KEPT, range(len(YS))):
        a, b = together[what][:, t].astype(float), single[what][:, t].astype(float)
        assert stats.ks_2samp(a, b, method="asymp").pvalue > 1e-6 / (len(KEPT) * len(YS)), (what, t)
    lag = np.corrcoef(together["z"][:-1, -1], together["z"][1:, -1])[0, 1]
    assert abs(lag) < 5 / np.sqrt(n)  # neighbouring runs are independent


@pytest.mark.parametrize("name", ["Systematic", "Multinomial", "Ssp", "after", "auxiliary", "guided", "program"])
def test_the_evidence_of_a_sweep_is_unbiased(name):
    """|z| < 5: false alarm 6e-7."""
    ys = YS[:5]
    found = run_many(FILTERS[name], ys, range(2000))["log_evidence"][:, -1]
    ratios = np.exp(found - kalman_ar1(ys)[1])
    assert abs(ratios.mean() - 1) < 5 * ratios.std() / np.sqrt(len(ratios))


def test_what_is_not_swept_is_made_one_by_one():
    for filter in (
        resample_move(AR1, RandomWalkMove(AR1, 0.5), 12),
        replace(bootstrap(AR1, 12), transition=Branching(bootstrap(AR1, 12).transition, 2), resample="after"),
        bootstrap(AR1, 12, Coalesced(FearnheadClifford())),
    ):
        assert not can_sweep(filter)
        runs = run_many(filter, YS, range(3))
        assert runs["log_evidence"][1, -1] == filter.run(YS, 1)[0].log_evidence


def test_lost_runs_end_and_the_others_go_on():
    fragile = replace(AR1, log_likelihood=lambda x, y: np.where(abs(x - y) < 0.5, 0.0, -np.inf))
    filter = bootstrap(fragile, 4)
    together = run_many(filter, YS, range(400), z=log_evidence, n=lambda state, info: float(info.n))
    with unexamined():
        single = run_many(filter, YS, range(400, 800), together=False, z=log_evidence)
    shares = [np.isneginf(runs["z"]).mean(axis=0) for runs in (together, single)]
    assert 0.1 < shares[0][-1] < 1
    assert (abs(shares[0] - shares[1]) < 5 * np.sqrt(0.5 / 400)).all()
    for seed, reason in together.lost.items():
        assert "all 4 log weights are -inf" in reason
        last = int(reason.split(",")[0].removeprefix("step "))
        assert np.isneginf(together["z"][seed, last:]).all() and np.isfinite(together["z"][seed, :last]).all()
        assert np.isnan(together["n"][seed, last:]).all()
    impossible = replace(AR1, log_likelihood=lambda x, y: np.full(len(x), -np.inf))
    assert len(run_many(bootstrap(impossible, 4), YS, range(5)).lost) == 5


def test_populations_of_a_sweep_are_consistent():
    """What a collector sees: weights, ancestors, and particles that moved from their ancestors."""
    still = replace(AR1, sample_transition=lambda rng, x: x)
    seen = run_many(
        bootstrap(still, 20, Multinomial()),
        YS[:4],
        range(30),
        x=lambda state, info: state.population.particles,
        previous=lambda state, info: state.population.parents.get("previous", np.arange(20)),
        lw=lambda state, info: state.population.log_weights,
        mean=mean,
    )
    for run, t in product(range(30), range(1, 4)):
        np.testing.assert_array_equal(seen["x"][run, t], seen["x"][run, t - 1][seen["previous"][run, t]])
    w = np.exp(seen["lw"] - seen["lw"].max(axis=2, keepdims=True))
    np.testing.assert_allclose(seen["mean"], (w * seen["x"]).sum(axis=2) / w.sum(axis=2))


def test_inputs_and_times_reach_a_sweep():
    model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x, t, u: Normal(x + u, 0.1 * t), lambda x: Normal(x, 1.0))
    ys = [WithInput(0.1, None), WithInput(3.0, 3.0), WithInput(6.0, 3.0)]
    found = run_many(bootstrap(model, 50), ys, range(50), mean=mean)["mean"].mean(axis=0)
    assert found[1] == pytest.approx(3.0, abs=0.3) and found[2] == pytest.approx(6.0, abs=0.3)
    with pytest.raises(InputError, match="step 1 has no input"):
        run_many(bootstrap(model, 50), [0.1, 0.2], range(3))


@pytest.mark.parametrize("n", [1, 2, 7, 100])
def test_draws_of_runs_are_those_of_single_schemes(n):
    rng = np.random.default_rng(n)
    lw = 5 * rng.normal(size=(40, n))
    lw[:, rng.random(n) < 0.3] = -np.inf
    lw[:, n // 2] = 0.0
    weights = np.exp(lw - lw.max(axis=1, keepdims=True))
    shifts = rng.random((40, n))
    for shift in (shifts, shifts[:, :1]):
        found = inverse_cdf_of_runs(weights, shift)
        for row, w, s in zip(found, weights, shift, strict=True):
            points = (np.arange(n) + s) / n  # the definition, by search
            expected = np.searchsorted(np.cumsum(w) / w.sum(), points, side="left")
            assert (abs(row - np.minimum(expected, n - 1)) <= 0).mean() > 0.97  # up to rounding at a border
            assert (w[row] > 0).all()
    drawn = independent_draws_of_runs(rng, np.repeat(weights[:1], 20_000, axis=0))
    counts = np.bincount(drawn.ravel(), minlength=n) / drawn.size
    p = weights[0] / weights[0].sum()
    assert (abs(counts - p) < 6 * np.sqrt(p * (1 - p) / drawn.size) + 1e-12).all()
    spread, log_mean, scaled = summaries(lw)
    np.testing.assert_array_equal(scaled, weights)
    for row, (a, b) in enumerate(zip(spread, log_mean, strict=True)):
        population = Population(np.zeros(n), lw[row])
        assert (a, b) == (pytest.approx(population.ess), pytest.approx(population.log_mean_weight))
    assert Key(0).child("sweep").seed == 0

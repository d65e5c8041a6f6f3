"""Runs that are processed together equal single runs bit for bit, or raise InputError, or are made one by one."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from mstfilter import smc
from mstfilter.errors import InputError
from mstfilter.smc import (
    Always,
    Branching,
    EssBelow,
    Every,
    FearnheadClifford,
    Multinomial,
    Never,
    Normal,
    Program,
    RandomWalkMove,
    Reweight,
    RunGenerators,
    Ssp,
    StateSpaceModel,
    Stratified,
    Systematic,
    Trigger,
    Uniform,
    WeightResampler,
    bootstrap,
    collect,
    ess,
    guided,
    hidden_markov,
    linear_gaussian,
    log_evidence,
    nonlinear_gaussian,
    observe,
    pmmh,
    resample_move,
    resampled,
    run_many,
    sample,
    unique_ancestors,
)
from mstfilter.smc.population import Population
from mstfilter.smc.streams import Key, summaries
from tests.smc.models import AR1, ar1_observations, hmm
from tests.smc.test_particle_filter import MODEL, observations

T = 5
YS = [0.3, 1.1, -0.2, None, 0.4]


def vectors(d, k):
    rng = np.random.default_rng(d)
    F, H = 0.9 * np.linalg.qr(rng.standard_normal((d, d)))[0], rng.standard_normal((k, d))
    return F, 0.3 * np.eye(d), H, 0.5 * np.eye(k), np.zeros(d), np.eye(d)


def raw(d, batched=True):
    shape = (d,) if d > 1 else ()

    def log_likelihood(x, y):
        return -np.square(y - x) if d == 1 else -np.square(y - x).sum(axis=-1)

    return StateSpaceModel(
        lambda rng, n: rng.standard_normal((n, *shape)),
        lambda rng, x: 0.9 * x + rng.standard_normal(x.shape),
        log_likelihood,
        batched=batched,
    )


def of(d):
    if d == 1:
        return StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
    F = vectors(d, 1)[0]
    return StateSpaceModel.of(
        Normal(np.zeros((1, d)), 1.0), lambda x: Normal(x @ F.T, 0.5), lambda x: Normal(x[:, :1], 1.0)
    )


def walk(previous, y):
    x = sample("x", Normal(0.0 if previous is None else previous["x"], 1.0))
    observe("y", Normal(x, 1.0), y)


def counts(d):
    return StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: stats.poisson(np.exp(x)))


CHAIN = hidden_markov([0.5, 0.5], [[0.9, 0.1], [0.2, 0.8]], lambda y: -np.square(y - np.arange(2.0)))
#: name -> filter of (n, d, k), and whether an observation is a vector of k entries.
MODELS = {
    "linear": lambda n, d, k: (bootstrap(linear_gaussian(*vectors(d, k)), n), True),
    "linear scalar": lambda n, d, k: (bootstrap(linear_gaussian(*vectors(d, 1)), n), False),
    "nonlinear": lambda n, d, k: (
        bootstrap(nonlinear_gaussian(np.sin, np.eye(d), lambda x: x[:, :1], [[1.0]], np.zeros(d), np.eye(d)), n),
        False,
    ),
    "raw": lambda n, d, k: (bootstrap(raw(1), n), False),
    "raw vectors": lambda n, d, k: (bootstrap(raw(k), n), k > 1),
    "of": lambda n, d, k: (bootstrap(of(1), n), False),
    "of vectors": lambda n, d, k: (bootstrap(of(d), n), d > 1),
    "counts": lambda n, d, k: (bootstrap(counts(1), n), False),
    "guided": lambda n, d, k: (guided(of(1), lambda x, y: Normal(0.5 * (x + y), 1.0), n), False),
    "chain": lambda n, d, k: (bootstrap(CHAIN, n), False),
    "program": lambda n, d, k: (Program(walk).bootstrap(n), False),
}


def particles(state, info):
    """All that a step leaves, as one array."""
    p = state.population
    found = p.particles if isinstance(p.particles, np.ndarray) else list(p.particles.values())
    parents = [p.parents.get(name, np.full(len(p), -1)) for name in ("previous", "ancestor")]
    return np.concatenate([np.ravel(a) for a in (found, p.log_weights, *parents)])


ALL = {"z": log_evidence, "ess": ess, "resampled": resampled, "ancestors": unique_ancestors, "all": particles}
FEW = {"z": log_evidence, "ess": ess, "resampled": resampled}


def keeps_its_promise(filter, ys, seeds, kept=ALL):
    """Compare many runs with their single runs; whether they were made together."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            runs = run_many(filter, ys, seeds, **kept)
    except InputError:
        return "raised"
    for r, seed in enumerate(seeds):
        if seed in runs.lost:
            with pytest.raises(InputError) as error:
                filter.run(ys, seed)
            assert error.value.message == runs.lost[seed]
            continue
        single = collect(filter.iterate(ys, seed), **kept)
        for name in kept:
            np.testing.assert_array_equal(runs[name][r], single[name], err_msg=name)
    return "single" if runs.single else "together"


def series(rng, name, filter, vector, d, k, missing):
    size = {"of vectors": 1}.get(name, k)
    ys = rng.poisson(2, T).tolist() if name == "counts" else list(rng.standard_normal((T, size) if vector else T))
    return [None if t in missing else (y if vector else float(y)) for t, y in enumerate(ys)]


@settings(max_examples=120, deadline=None, derandomize=True)
@given(
    name=st.sampled_from(sorted(MODELS)),
    shape=st.sampled_from(
        [(3, 3, 1, 1), (2, 2, 2, 2), (4, 2, 4, 1), (3, 5, 3, 3), (5, 7, 5, 2), (6, 3, 2, 3), (1, 4, 1, 1)]
    ),
    missing=st.sets(st.integers(0, T - 1), max_size=3),
)
def test_correct_models_equal_single_runs(name, shape, missing):
    """Shapes are (runs, n, d, k): runs == n, runs == d, n == d, one run, and sizes that differ."""
    n_runs, n, d, k = shape
    filter, vector = MODELS[name](n, d, k)
    ys = series(np.random.default_rng(0), name, filter, vector, d, k, missing)
    assert keeps_its_promise(filter, ys, list(range(n_runs))) == "together"


SEEDS = [3, 1, 4, 1_000_003, 2**40 + 1]
FILTERS = {
    "always": bootstrap(raw(1), 20, Stratified(), Always()),
    "after": replace(bootstrap(raw(1), 20, Ssp(), EssBelow(0.9)), resample="after"),
    "every": bootstrap(raw(1), 20, Systematic(), Every(3)),
    "independent": bootstrap(raw(1), 20, Multinomial()),
    "many draws": bootstrap(raw(1), 2100, Multinomial(), Always()),
    "many strata": bootstrap(raw(1), 1100, Stratified(), Always()),
    "never": bootstrap(raw(1), 20, Systematic(), Never()),
    "rows": bootstrap(AR1, 20),
    "vectors": bootstrap(MODEL, 20, Systematic(), Always()),
    "not batched": bootstrap(raw(1, False), 20),
    "objects": bootstrap(hmm("objects"), 20),
    "more candidates": replace(bootstrap(AR1, 20), transition=Branching(bootstrap(AR1, 20).transition, 2)),
    "fewer particles": bootstrap(AR1, 20, FearnheadClifford()),
    "moves": resample_move(AR1, RandomWalkMove(AR1, 0.5), 20),
}
TOGETHER = ("always", "every", "after", "independent", "many draws", "many strata", "never", "rows", "vectors")


@pytest.mark.parametrize("name", sorted(smc.__components__["resampler"]))
def test_every_scheme_of_the_package_keeps_its_promise(name):
    scheme = getattr(smc, smc.__components__["resampler"][name])()
    found = [keeps_its_promise(bootstrap(raw(1), n, scheme, Always()), YS, range(r)) for n, r in ((5, 5), (4, 3))]
    together = isinstance(scheme, WeightResampler) and scheme.exact_size
    assert found == ["together" if together else "single"] * 2


@pytest.mark.parametrize("name", FILTERS)
def test_every_run_equals_its_single_run(name):
    ys = {"objects": [0, 2, 1, 3, 0], "vectors": observations(5, 1)}.get(name, [0.3, -0.2, 1.0, None, 0.1])
    for kept in (FEW,) if name == "objects" else (ALL, FEW):
        found = keeps_its_promise(FILTERS[name], ys, SEEDS, kept=kept)
        assert found == ("together" if name in TOGETHER else "single")


def first_particle(x):
    x = np.array(x)
    x[0] = x.mean()
    return x


def last_run(x):
    x = np.array(x)
    x[-1] += len(x)
    return x


GOOD = raw(1)
FAULTY = {
    "mean of all": replace(GOOD, sample_transition=lambda rng, x: x - x.mean() + rng.standard_normal(x.shape)),
    "first particle": replace(
        GOOD, sample_transition=lambda rng, x: first_particle(x) + rng.standard_normal(x.shape)
    ),
    "last run": replace(GOOD, sample_transition=lambda rng, x: last_run(x) + rng.standard_normal(x.shape)),
    "number of runs": replace(GOOD, sample_initial=lambda rng, n: n + rng.standard_normal(n)),
    "neighbours": replace(GOOD, sample_transition=lambda rng, x: np.roll(x, 1) + rng.standard_normal(x.shape)),
    "largest weight": replace(GOOD, log_likelihood=lambda x, y: -np.square(y - x) - np.square(y - x).max()),
    "one number for all": replace(GOOD, sample_transition=lambda rng, x: x + rng.standard_normal()),
    "other shape": replace(GOOD, sample_transition=lambda rng, x: x + rng.standard_normal(2 * len(x))[: len(x)]),
    "own generator": replace(GOOD, sample_initial=lambda rng, n: np.random.default_rng(1).standard_normal(n)),
}


@pytest.mark.parametrize("stated", [True, None], ids=["stated", "tried"])
@pytest.mark.parametrize("name", FAULTY)
@pytest.mark.parametrize("n_runs, n", [(4, 4), (7, 3)])
def test_faulty_models_are_never_wrong_in_silence(name, stated, n_runs, n):
    """A model that mixes runs raises InputError, or is run singly if it mixes runs but not particles."""
    filter = bootstrap(replace(FAULTY[name], batched=stated), n)
    found = keeps_its_promise(filter, np.random.default_rng(0).standard_normal(T).tolist(), list(range(n_runs)))
    assert found == "raised" or (found == "single" and not stated)


def test_an_error_names_slot_step_run_values_and_what_to_do():
    with pytest.raises(
        InputError, match=r"step 1, transition: the particles of run \d are .* in the batch, .* alone"
    ) as error:
        run_many(bootstrap(FAULTY["first particle"], 4), [0.1] * 4, range(5))
    assert any("batched" in hint for hint in error.value.hints)
    good, scalar = bootstrap(GOOD, 4), MODELS["linear scalar"](5, 1, 1)[0]
    with pytest.raises(
        InputError, match=r"seed 0: step 0, update: the observation has shape \(2,\), expected \(1,\)"
    ):
        run_many(scalar, [np.zeros(2)], range(2))
    for seeds, message in (([], "no seeds"), ([1, 2, 1], "occurs twice")):
        with pytest.raises(InputError, match=message):
            run_many(good, YS, seeds)


@pytest.mark.parametrize(("differs", "found"), [(lambda t: t >= 3, 5), (lambda t: t % 3 == 0, 12)])
def test_a_model_that_differs_at_some_steps_only_is_found(differs, found):
    def move(rng, x, t):
        return x + rng.standard_normal(x.shape) + (x.mean() if differs(t) else 0.0)

    stated = replace(GOOD, sample_transition=move)
    with pytest.raises(InputError, match=f"step {found}, transition"):
        run_many(bootstrap(stated, 4), [0.1] * 14, range(5))
    assert keeps_its_promise(bootstrap(replace(stated, batched=None), 4), [0.1] * 14, range(5)) == "single"


def test_a_program_that_mixes_particles_is_named_by_its_first_batch():
    def program(previous, y):
        x = sample("x", Normal(0.0, 1.0))
        observe("y", Normal(x - x.mean(), 1.0), y)

    with pytest.raises(InputError, match="seed 0: step 0, initial: observation 'y': particle .* alone"):
        run_many(Program(program).bootstrap(30), [0.5, -0.3], range(5))


def test_a_batch_says_and_warns_that_components_are_called_for_each_run():
    def rounds(x, y):  # in another order for another number of rows, as matrix products of BLAS
        return -np.square(y - x) * (1 + 1e-15 * len(x))

    filter = bootstrap(replace(GOOD, log_likelihood=rounds), 4)
    with pytest.warns(UserWarning, match="the runs of 'filter' are made one by one: update: .* by rounding"):
        runs = run_many(filter, [0.5] * 3, range(5))
    assert runs.single["filter"].startswith("update: ")
    assert run_many(Program(walk).bootstrap(4), [0.5, None], range(3)).single == {}
    assert run_many(bootstrap(GOOD, 4), [0.5] * 3, range(5), ess=ess).single == {}
    tried = bootstrap(replace(GOOD, batched=None), 4)
    reads = run_many(tried, [0.5] * 3, range(5), slots=lambda state, info: len(info.seconds))
    assert reads.single == {"filter": "collector: it reads the seconds of the components"}
    assert (reads["slots"] > 0).all()


def limited(model, bound):
    """The model, with likelihood 0 above a bound."""
    return replace(model, log_likelihood=lambda x, y: np.where(x < bound, model.log_likelihood(x, y), -np.inf))


@pytest.mark.parametrize("model", [GOOD, replace(GOOD, batched=False)], ids=["together", "single"])
def test_lost_runs_are_recorded_and_the_others_continue(model):
    """Also if all runs are lost at a step."""
    ys, filter = ar1_observations(8), bootstrap(limited(model, -0.2), 3)
    runs = run_many(filter, ys, range(40), **ALL)
    assert 0 < len(runs.lost) < 40
    assert keeps_its_promise(filter, ys, range(40)) == ("single" if model.batched is False else "together")
    for seed, reason in runs.lost.items():
        lost_at = int(reason.split(":")[0].split()[1].rstrip(","))
        assert np.isneginf(runs["z"][seed, lost_at:]).all() and np.isfinite(runs["z"][seed, :lost_at]).all()
        assert np.isnan(runs["ess"][seed, lost_at:]).all() and np.isnan(runs["all"][seed, lost_at:]).all()
    everything = run_many(bootstrap(limited(model, -1e9), 3), ys, range(4))
    assert set(everything.lost) == {0, 1, 2, 3} and np.isneginf(everything["log_evidence"]).all()


def test_all_runs_are_lost_at_the_first_step():
    def program(previous, y):
        x = sample("x", Normal(0.0, 1.0))
        observe("y", Uniform(x, x + 1.0), y)

    runs = run_many(Program(program).bootstrap(5), [100.0, 0.0], range(3), **ALL)
    assert runs.single == {} and runs["all"].shape[:2] == (3, 2) and np.isneginf(runs["z"]).all()
    assert runs.lost[1].startswith("step 0, initial: ")


# --- generators ---------------------------------------------------------------------------------------------------
def test_generators_of_runs_draw_what_their_streams_draw():
    seeds = list(range(6))
    ours = RunGenerators([Key(seed).child("a").generator() for seed in seeds])
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


# --- chains -------------------------------------------------------------------------------------------------------
def chain_model(kind, theta, n):
    """A filter of a coefficient, with particles (n,) or (n, 2)."""
    (rho,) = theta
    if kind == "of":
        model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(rho * x, 0.5), lambda x: Normal(x, 1.0))
        return bootstrap(model, n)
    factor = rho if kind in ("scalar", "vectors without axis") else rho[..., None]
    size = () if kind == "scalar" else (2,)
    model = StateSpaceModel(
        lambda rng, n: rng.standard_normal((n, *size)),
        lambda rng, x: factor * x + rng.standard_normal(x.shape),
        lambda x, y: -np.square(y - (x if kind == "scalar" else x[:, 0])),
        batched=True,
    )
    return bootstrap(model, n)


START = [[0.1], [0.5], [0.9]]


def flat(theta):
    return 0.0


@pytest.mark.parametrize("n", [3, 2, 5])
@pytest.mark.parametrize("kind", ["scalar", "vectors", "of", "vectors without axis"])
def test_chains_equal_single_chains_or_refuse(kind, n):
    """Three chains; parameters of all chains without an axis do not fit vectors, whatever the sizes."""

    def chains(batched):
        return pmmh(lambda theta: chain_model(kind, theta, n), YS, flat, START, 0.2, 6, batched=batched)

    if kind == "vectors without axis":
        with pytest.raises(InputError, match="step 1, transition"):
            chains(True)
        return
    one, many = chains(False), chains(True)
    np.testing.assert_array_equal(one.theta, many.theta)
    np.testing.assert_array_equal(one.log_evidence, many.log_evidence)


@pytest.mark.parametrize("field", ["n", "resampler", "trigger"])
def test_chains_whose_filters_differ_in_more_than_numbers_are_run_singly(field):
    def filter_of(theta):
        high = bool(np.max(theta) > 0.55)
        other = {"n": 7, "resampler": Multinomial(), "trigger": Always()}[field]
        return replace(bootstrap(of(1), 4), **({field: other} if high else {}))

    with pytest.warns(UserWarning, match=f"one by one: all: the filters of the runs differ in {field}"):
        many = pmmh(filter_of, YS, flat, [[0.3], [0.8]], 0.1, 4, batched=True)
    np.testing.assert_array_equal(many.theta, pmmh(filter_of, YS, flat, [[0.3], [0.8]], 0.1, 4).theta)


def test_a_chain_whose_first_estimate_is_lost_is_drawn_again():
    """A filter of one particle survives three observations with probability .1 or so: most starts are drawn again."""

    def fragile(theta):
        filter = chain_model("scalar", theta, 1)
        return replace(
            filter, update=Reweight(lambda x, y: np.where(np.abs(x - y) < 0.9, 0.0, -np.inf), batched=True)
        )

    one, many = (pmmh(fragile, [0.1, 0.2], flat, START, 0.2, 4, 2, batched=batched) for batched in (False, True))
    assert np.isfinite(one.log_evidence).all() and (many.accepted < 1).all()
    np.testing.assert_array_equal(one.theta, many.theta)
    with pytest.raises(InputError, match=r"of chain 1 has log density -inf: 20 estimates"):
        pmmh(
            lambda theta: chain_model("scalar", theta, 3) if theta[0] < 0.4 else fragile_never(theta),
            [0.1],
            flat,
            [[0.1], [0.5]],
            0.01,
            2,
        )
    with pytest.raises(InputError, match="of chain 2 .* the log prior is -inf"):
        pmmh(fragile, [0.1], lambda theta: 0.0 if theta[0] < 0.8 else -np.inf, START, 0.2, 2)


def fragile_never(theta):
    return replace(chain_model("scalar", theta, 3), update=Reweight(lambda x, y: np.full(len(x), -np.inf)))


@dataclass(frozen=True)
class SpreadOfAllRuns(Trigger):
    """Wrong: it says that it treats runs separately, but does not."""

    batched: ClassVar[bool] = True

    def wants(self, population, t):
        return np.ptp(population.log_weights) > 20.0


@dataclass(frozen=True)
class ScaledByAllRuns(WeightResampler):
    """Wrong: the weights of a run depend on the largest weight of all runs."""

    batched: ClassVar[bool] = True

    def select(self, rng, log_weights, n):
        weights = np.exp(log_weights - log_weights.max())
        return Systematic().select(rng, np.log(weights + 1e-3), n)


@dataclass(frozen=True)
class TooFew(WeightResampler):
    """Returns one particle of n."""

    def select(self, rng, log_weights, n):
        return Systematic().select(rng, log_weights, 1)


@dataclass(frozen=True)
class HeavyIfAlone(WeightResampler):
    """Wrong: the log weights of a run depend on whether it is alone."""

    batched: ClassVar[bool] = True

    def select(self, rng, log_weights, n):
        index, _ = Systematic().select(rng, log_weights, n)
        return index, None if log_weights.ndim == 2 else np.full(n, 3.0)


@dataclass(frozen=True)
class OneBool(Trigger):
    """Right: one answer for all runs, as an array of one entry."""

    batched: ClassVar[bool] = True

    def wants(self, population, t):
        return np.array([t % 2 == 0])


YS = [0.1, 1.0, -2.0, 0.3, 0.2, 0.1]
FAR = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 0.3))


@pytest.mark.parametrize(
    ("slot", "component"),
    [("trigger", SpreadOfAllRuns()), ("resampler", ScaledByAllRuns()), ("resampler", HeavyIfAlone())],
    ids=str,
)
def test_triggers_and_resamplers_that_mix_runs_are_refused(slot, component):
    with pytest.raises(InputError, match=rf"step \d, {slot}"):
        run_many(replace(bootstrap(FAR, 8), **{"trigger": Always(), slot: component}), YS, range(4))


def test_a_resampler_of_another_size_is_run_one_by_one():
    filter = replace(bootstrap(FAR, 8), resampler=TooFew(), trigger=Always())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        runs = run_many(filter, YS, range(3))
    expected = [filter.run(YS, seed)[0].log_evidence for seed in range(3)]
    np.testing.assert_array_equal(runs["log_evidence"][:, -1], expected)


def test_a_trigger_may_return_one_entry():
    filter = replace(bootstrap(FAR, 8), trigger=OneBool())
    runs = run_many(filter, YS, range(3))
    np.testing.assert_array_equal(
        runs["log_evidence"][:, -1], [filter.run(YS, seed)[0].log_evidence for seed in range(3)]
    )

"""Probabilistic programs: the numbers of hand-written models, exact answers, clear errors."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy import stats

from mstfilter.errors import InputError
from mstfilter.smc import (
    Always,
    Bernoulli,
    Categorical,
    EssBelow,
    Normal,
    Poisson,
    Program,
    bootstrap,
    guided,
    log_mean_exp,
    observe,
    per_particle,
    sample,
    switch,
)
from tests.smc.models import (
    AR1,
    EMIT,
    MOVES,
    RHO,
    SD0,
    SIGMA,
    START,
    SYMBOLS,
    TAU,
    ar1_observations,
    forward,
    kalman_ar1,
    mean_ratio,
    optimal,
    optimal_initial,
)

YS = ar1_observations(8)
EXACT = kalman_ar1(YS)[1]


def ar1(previous, y):
    x = sample("x", Normal(0.0, SD0) if previous is None else Normal(RHO * previous["x"], SIGMA))
    observe("y", Normal(x, TAU), y)


def best(previous, y):
    sample("x", optimal_initial(y) if previous is None else optimal(previous["x"], y))


@per_particle
def ar1_one_by_one(previous, y):
    ar1(previous, y)


def test_a_program_gives_the_numbers_of_the_hand_written_model():
    """Bit for bit, particles and evidence."""
    ys = [*YS[:3], None, *YS[4:]]
    a, infos_a = bootstrap(AR1, 100).run(ys, 7)
    b, infos_b = Program(ar1).bootstrap(100).run(ys, 7)
    np.testing.assert_array_equal(a.population.particles, b.population.particles["x"])
    np.testing.assert_array_equal(a.population.log_weights, b.population.log_weights)
    assert a.log_evidence == b.log_evidence
    assert [i.resampled for i in infos_a] == [i.resampled for i in infos_b]
    for info_a, info_b in zip(infos_a[1:], infos_b[1:], strict=True):
        np.testing.assert_array_equal(info_a.parents["previous"], info_b.parents["previous"])


def test_a_guide_gives_the_draws_of_the_guided_filter():
    a, _ = guided(AR1, optimal, 60, optimal_initial).run(YS, 2)
    b, _ = Program(ar1).guided(best, 60).run(YS, 2)
    np.testing.assert_array_equal(a.population.particles, b.population.particles["x"])
    np.testing.assert_allclose(a.population.log_weights, b.population.log_weights, atol=1e-11)
    one, _ = Program(ar1).guided(best, 1).run(YS[:1], 0)
    assert one.log_evidence == pytest.approx(kalman_ar1(YS[:1])[1], abs=1e-9)


@pytest.mark.parametrize("trigger", [Always(), EssBelow(0.5)], ids=lambda t: type(t).__name__)
@pytest.mark.parametrize(
    "make",
    [
        lambda p, t: p.bootstrap(1500, trigger=t),
        lambda p, t: p.guided(best, 600, trigger=t),
        lambda p, t: p.auxiliary(1500, trigger=t, power=0.5),
        lambda p, t: p.auxiliary(600, best, trigger=t, power=0.5),
        lambda p, t: p.resample_move(1500, steps=2, scale=0.8, trigger=t),
    ],
    ids=["bootstrap", "guided", "auxiliary", "auxiliary guided", "resample-move"],
)
def test_filters_of_a_program_agree_with_kalman(make, trigger):
    """Within 4 standard errors (false alarm 6e-5 a case); 2 % of bias would be seen."""
    mean, standard, _ = mean_ratio(make(Program(ar1), trigger), YS, EXACT, range(500))
    assert abs(mean - 1) < 4 * standard
    assert standard < 0.005


@per_particle
def mild_one_by_one(previous, y):
    """Much noise, so that few particles give little spread."""
    x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(RHO * previous["x"], SIGMA))
    observe("y", Normal(x, 2.0), y)


def mild_guide(previous, y):
    sample("x", Normal(0.2 * y, 1.0) if previous is None else Normal(0.8 * previous["x"] + 0.1 * y, 0.7))


def test_a_program_that_is_run_particle_by_particle():
    """Within 4 standard errors (false alarm 6e-5 a case); 2 % of bias would be seen."""
    cov = np.array([[1.0, RHO], [RHO, RHO**2 + SIGMA**2]]) + 4.0 * np.eye(2)
    exact_mild = float(stats.multivariate_normal(np.zeros(2), cov).logpdf(YS[:2]))
    for make in (
        lambda p, guide: p.bootstrap(60),
        lambda p, guide: p.guided(guide, 30),
        lambda p, guide: p.auxiliary(60, power=0.5),
        lambda p, guide: p.resample_move(40, steps=1),
    ):
        filter = make(Program(mild_one_by_one), per_particle(mild_guide))
        mean, standard, _ = mean_ratio(filter, YS[:2], exact_mild, range(180))
        assert abs(mean - 1) < 4 * standard
        assert standard < 0.005
    state, _ = Program(ar1_one_by_one).bootstrap(5).run(YS, 0)
    assert np.ndim(state.population.particles[0]["x"]) == 0
    with pytest.raises(InputError, match="both be per_particle"):
        Program(ar1_one_by_one).guided(best, 5).run(YS, 0)


# --- a tracker that changes between two regimes -------------------------------------------------------------------
PROBS = np.array([0.7, 0.3])


def regimes(previous, y):
    before = None if previous is None else previous["x"]

    def calm(x):
        return sample("x", Normal(0.0 if x is None else 0.9 * x, 0.3))

    def wild(x):
        jump = sample("jump", Normal(1.0, 0.5))
        return sample("x", Normal(jump if x is None else x + jump, 1.0))

    x = switch("regime", PROBS, [calm, wild], before)
    observe("y", Normal(x, 0.5), y)
    return {"absolute": np.abs(x)}


def exact_regimes(ys):
    """Sum over the sequences of regimes; each is linear and Gaussian."""
    total, calm_at_end = [], []
    for path in product((0, 1), repeat=len(ys)):
        m, v, log_p = 0.0, 0.0, 0.0
        for t, (k, y) in enumerate(zip(path, ys, strict=True)):
            a, b, q = ((0.9, 0.0, 0.09), (1.0, 1.0, 1.25))[k]
            m, v = (a * m + b, a * a * v + q) if t else (b, q)
            log_p += np.log(PROBS[k])
            if y is not None:
                s = v + 0.25
                log_p += stats.norm(m, np.sqrt(s)).logpdf(y)
                m, v = m + v / s * (y - m), v * 0.25 / s
        total.append(log_p)
        calm_at_end.append(path[-1] == 0)
    total = np.array(total)
    log_evidence = log_mean_exp(total) + np.log(len(total))
    return log_evidence, float(np.exp(total - log_evidence)[calm_at_end].sum())


TRACK = [0.2, 1.4, 1.1, None, 2.9]


@pytest.mark.parametrize("kind", ["bootstrap", "guided", "auxiliary", "resample-move"])
def test_switch_agrees_with_enumeration(kind):
    def guide(previous, y):
        before = None if previous is None else previous["x"]

        def calm(x):
            m = 0.0 if x is None else 0.9 * x
            sample("x", Normal(0.7 * m + 0.3 * y, 0.4))

        def wild(x):
            sample("jump", Normal(1.0, 0.6))
            sample("x", Normal(np.full(0 if x is None else len(x), y) if x is not None else y, 0.9))

        switch("regime", [0.5, 0.5], [calm, wild], before)

    program = Program(regimes)
    filter = {
        "bootstrap": program.bootstrap(3000),
        "guided": program.guided(guide, 3000),
        "auxiliary": program.auxiliary(3000, power=0.3),
        "resample-move": program.resample_move(3000, steps=2),
    }[kind]
    exact, calm = exact_regimes(TRACK)
    mean, standard, _ = mean_ratio(filter, TRACK, exact, range(200))
    assert abs(mean - 1) < 4 * standard
    assert standard < 0.005
    shares = []
    for seed in range(60):
        population = filter.run(TRACK, seed)[0].population
        p = population.particles
        assert np.isnan(p["jump"][p["regime"] == 0]).all() and np.isfinite(p["jump"][p["regime"] == 1]).all()
        np.testing.assert_array_equal(p["absolute"], np.abs(p["x"]))
        shares.append(population.weights @ (p["regime"] == 0))
    assert abs(np.mean(shares) - calm) < 5 * np.std(shares, ddof=1) / np.sqrt(60) + 0.003


def test_a_hidden_chain_as_a_program():
    def chain(previous, y):
        k = sample("k", Categorical(START if previous is None else MOVES[previous["k"]]))
        observe("y", Categorical(EMIT[k]), y)

    for filter in (Program(chain).bootstrap(1000), Program(chain).resample_move(1000)):
        mean, standard, _ = mean_ratio(filter, SYMBOLS, forward()[1], range(400))
        assert abs(mean - 1) < 4 * standard
        assert standard < 0.005


@per_particle
def births(previous, count):
    """Objects are born and persist; each is seen as a Poisson count of its own strength."""
    n = 0 if previous is None else int(previous["n"])
    born = bool(sample("born", Bernoulli(0.3)))
    n += born
    if born:
        sample("strength", Normal(2.0, 0.1))  # exists only where something was born
    observe("count", Poisson(0.5 + 2.0 * n), count)
    return {"n": n}


def test_changing_structure_agrees_with_enumeration():
    counts = [1, 1, 2]
    total = 0.0
    for path in product((0, 1), repeat=3):
        n = np.cumsum(path)
        total += np.prod([0.3 if b else 0.7 for b in path]) * stats.poisson.pmf(counts, 0.5 + 2.0 * n).prod()
    for filter, seeds, bound in (
        (Program(births).bootstrap(50), 400, 0.005),
        (Program(births).resample_move(50, trigger=Always()), 120, 0.01),  # slow: a run a particle and move
    ):
        mean, standard, _ = mean_ratio(filter, counts, np.log(total), range(seeds))
        assert abs(mean - 1) < 4 * standard
        assert standard < bound
    state, _ = Program(births).bootstrap(60).run(counts, 0)
    names = {frozenset(p) for p in state.population.particles}
    assert names == {frozenset({"born", "n"}), frozenset({"born", "n", "strength"})}


def test_distributions_of_other_libraries_in_programs():
    def model(previous, y):
        x = sample("x", stats.norm(0.0, SD0) if previous is None else stats.norm(RHO * previous["x"], SIGMA))
        observe("y", stats.norm(x, TAU), y)

    state, _ = Program(model).bootstrap(2000).run(YS, 1)
    assert state.log_evidence == pytest.approx(EXACT, abs=0.5)
    torch = pytest.importorskip("torch", reason="torch cannot be imported", exc_type=ImportError)

    def in_torch(previous, y):
        before = torch.zeros(1) if previous is None else torch.from_numpy(np.array(previous["x"]))
        x = sample("x", torch.distributions.Normal(RHO * before, SIGMA if previous is not None else SD0))
        observe("y", torch.distributions.Normal(torch.from_numpy(np.array(x)), TAU), y)

    state, _ = Program(in_torch).bootstrap(2000).run(YS, 1)
    assert state.log_evidence == pytest.approx(EXACT, abs=0.5)


def test_errors_name_the_site():
    def run(model, guide=None):
        program = Program(model)
        (program.bootstrap(4) if guide is None else program.guided(guide, 4)).run([0.5, 0.5], 0)

    def nothing(previous, y):
        pass

    def other(previous, y):
        sample("x", Normal(0.0, 1.0))
        sample("z", Normal(0.0, 1.0))

    def twice(previous, y):
        sample("x", Normal(0.0, 1.0))
        sample("x", Normal(0.0, 1.0))

    def shape(previous, y):
        observe("y", Normal(sample("x", Normal(0.0, 1.0)), 1.0), np.zeros(3))

    def matrix(previous, y):
        sample("x", Normal(0.0, 1.0))
        observe("y", Normal(np.zeros(3), 1.0), y)

    def text(previous, y):
        sample("x", 3.0)

    with pytest.raises(InputError, match="the guide has no site 'x', which the model samples"):
        run(ar1, nothing_but_w)
    with pytest.raises(InputError, match="the model has no site 'z', which the guide samples"):
        run(ar1, other)
    with pytest.raises(InputError, match="sampled nothing"):
        run(nothing)
    with pytest.raises(InputError, match="'x' is sampled twice"):
        run(twice)
    with pytest.raises(InputError, match=r"observation 'y' has shape \(3,\), expected one number per particle"):
        run(matrix)
    with pytest.raises(InputError, match="step 0, initial: expected a distribution, found a builtins.float"):
        run(text)
    with pytest.raises(InputError, match="outside of a program"):
        sample("x", Normal(0.0, 1.0))
    with pytest.raises((InputError, ValueError)):
        run(shape)


def nothing_but_w(previous, y):
    sample("w", Normal(0.0, 1.0))

"""Probabilistic programs: the numbers of hand-written models, exact answers, clear errors."""

from __future__ import annotations

import math
import re
import runpy
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Always,
    Bernoulli,
    Categorical,
    Distribution,
    MultivariateNormal,
    Normal,
    Program,
    StateSpaceModel,
    Student,
    WithInput,
    bootstrap,
    guided,
    log_mean_exp,
    observe,
    sample,
    switch,
)
from tests.conftest import REPOSITORY
from tests.smc.models import (
    AR1,
    RHO,
    SD0,
    SIGMA,
    TAU,
    ar1_observations,
    kalman_ar1,
    mean_ratio,
    optimal,
    optimal_initial,
)

YS = ar1_observations(8)


def ar1(previous, y):
    x = sample("x", Normal(0.0, SD0) if previous is None else Normal(RHO * previous["x"], SIGMA))
    observe("y", Normal(x, TAU), y)


def best(previous, y):
    sample("x", optimal_initial(y) if previous is None else optimal(previous["x"], y))


def test_a_program_gives_the_numbers_of_the_hand_written_model():
    """Bit for bit, particles and evidence."""
    ys = [*YS[:3], None, *YS[4:]]
    ours, other = bootstrap(AR1, 100).iterate(ys, 7), Program(ar1).bootstrap(100).iterate(ys, 7)
    for (a, info_a), (b, info_b) in zip(ours, other, strict=True):
        np.testing.assert_array_equal(a.population.particles, b.population.particles["x"])
        np.testing.assert_array_equal(a.population.log_weights, b.population.log_weights)
        assert (a.log_evidence, info_a.resampled) == (b.log_evidence, info_b.resampled)
        assert a.population.parents.keys() == b.population.parents.keys()
        for name, index in a.population.parents.items():
            np.testing.assert_array_equal(index, b.population.parents[name])


def test_returned_values_are_kept_beside_sites():
    """A program that moves from a copy, which it returned, equals the one that moves from the site."""

    def model(previous, y):
        x = sample("x", Normal(0.0, SD0) if previous is None else Normal(RHO * previous["copy"], SIGMA))
        observe("y", Normal(x, TAU), y)
        return {"copy": x, "x": x}

    a, b = (Program(program).bootstrap(50).run(YS, 3)[0].population.particles for program in (ar1, model))
    for name in ("x", "copy"):
        np.testing.assert_array_equal(a["x"], b[name])


def test_a_guide_gives_the_draws_of_the_guided_filter():
    a, _ = guided(AR1, optimal, 60, optimal_initial).run(YS, 2)
    b, _ = Program(ar1).guided(best, 60).run(YS, 2)
    np.testing.assert_array_equal(a.population.particles, b.population.particles["x"])
    np.testing.assert_allclose(a.population.log_weights, b.population.log_weights, atol=1e-11)
    one, _ = Program(ar1).guided(best, 1).run(YS[:1], 0)
    assert one.log_evidence == pytest.approx(kalman_ar1(YS[:1])[1], abs=1e-9)


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


@pytest.mark.parametrize("kind", ["bootstrap", "guided"])
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
    filter = {"bootstrap": program.bootstrap(3000), "guided": program.guided(guide, 3000)}[kind]
    exact, calm = exact_regimes(TRACK)
    mean, standard, _ = mean_ratio(filter, TRACK, exact, range(90))
    assert abs(mean - 1) < 4 * standard
    assert standard < 0.008
    shares = []
    for seed in range(60):
        population = filter.run(TRACK, seed)[0].population
        p = population.particles
        assert np.isnan(p["jump"][p["regime"] == 0]).all() and np.isfinite(p["jump"][p["regime"] == 1]).all()
        np.testing.assert_array_equal(p["absolute"], np.abs(p["x"]))
        shares.append(population.weights @ (p["regime"] == 0))
    assert abs(np.mean(shares) - calm) < 5 * np.std(shares, ddof=1) / np.sqrt(60) + 0.003


def errors_of(model, guide=None, y=0.5, n=4, kind="bootstrap"):
    """The text of the error of a program, with its hints."""
    program = Program(model)
    filter = program.guided(guide, n) if guide is not None else getattr(program, kind)(n, trigger=Always())
    with pytest.raises(InputError) as caught:
        filter.run([y] * 3, 0)
    return "\n".join([caught.value.message, *caught.value.hints])


def x_and(statement):
    """A program that samples x and z (both scalar), v (a vector of one entry) and k, and then does something."""

    def model(previous, y):
        x = sample("x", Normal(np.zeros(1), 1.0))
        z = sample("z", stats.gamma(2.0))
        v = sample("v", MultivariateNormal([0.0], [[1.0]]))
        k = sample("k", Categorical([0.5, 0.5]))
        return statement(SimpleNamespace(x=x, z=z, v=v, k=k, y=y))

    return model


def changed(x):
    x += 1.0


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    "case",
    [
        # events and observations whose shapes differ
        (r"'o': the value has shape \(\), expected \(4,\)", lambda s: observe("o", Normal(s.v + s.x, 1), s.y)),
        (r"alone: site 's': the values have shape", lambda s: {"t": sample("s", Normal(s.v + s.x, 1))[:, 0]}),
        (r"returned 's' has rows of shape \(4,\), alone \(3,\)", lambda s: {"s": s.v + s.x}),
        (r"'o': the value has shape \(4,\), expected \(\)", lambda s: observe("o", Normal(s.x, 1), s.y), np.zeros(4)),
        (
            "alone: the program fails .*broadcast together",
            lambda s: observe("o", Normal(0.0, 1), s.y - s.x),
            np.zeros(4),
        ),
        (r"shape \(\), expected \(2,\)", lambda s: observe("o", Normal(np.zeros((1, 2)), 1), s.y)),
        (r"shape \(4,\), expected \(1,\)", lambda s: observe("o", Normal(s.v, 1), s.y), np.zeros(4)),
        (r"expected \(2,\)", lambda s: observe("o", MultivariateNormal([0, 0], np.eye(2)), s.y)),
        (r"'o': parameters of shape \(3,\) do not fit 4", lambda s: observe("o", Normal(np.zeros(3), 1), s.y)),
        (r"mean of shape \(4,\) does not fit", lambda s: observe("o", MultivariateNormal(s.x, [[1]]), s.y)),
        (r"'s': parameters of shapes \(4, 2\) and \(4,\)", lambda s: sample("s", Normal(np.zeros((4, 2)), s.z))),
        (r"returned 's' of shape \(3,\), expected one row per particle", lambda s: {"s": np.zeros(3)}),
        (r"alone: mean .* \(4, 4\)", lambda s: observe("o", MultivariateNormal(s.x, np.eye(4)), np.zeros(4))),
        # names
        ("expected a distribution", lambda s: sample(Normal(), "s")),
        ("the name of a site is a int", lambda s: sample(3, Normal())),
        ("site 'x': sampled twice", lambda s: sample("x", Normal(s.x, 1))),
        # arrays of all particles used as one number
        (r"as one number .*after site 'k', line \d+ `.*float\(s.x\).*TypeError.*numpy", lambda s: float(s.x)),
        ("as one number .*after site 'k'.*numpy.exp", lambda s: math.exp(s.x)),
        ("as one number .*after site 'k'.*an array as table", lambda s: ["a", "b"][s.k]),
        ("an array .* decides .*after site 'k'.*use switch", lambda s: 1 if s.x > 0 else 2),
        ("an array of particles is changed in place .*after site 'k'.*x = x \\+ 1", lambda s: changed(s.x)),
        ("None is used as a value .*missing observation is None", lambda s: s.y + 1, None),
        ("the program fails .*after site 'k'.*broadcast together", lambda s: s.x + np.zeros(3)),
        # parameters out of range
        (
            r"site 's': scale of a Student is -[\d.]+ in row 0 \(4 of 4\), expected",
            lambda s: sample("s", Student(3.0, 0.0, -s.z)),
        ),
        (r"scale of a Normal is -1,.*after site 'k', line \d+", lambda s: observe("o", Normal(s.x, -1), s.y)),
        ("'o': log density is nan.*missing is None", lambda s: observe("o", Normal(s.x, 1), np.nan * s.y)),
        ("the program fails .observation 'o'", lambda s: observe("o", Normal(s.x, 1), s.y), "a"),
    ],
)
def test_a_wrong_statement_is_a_named_error(case):
    """The error, the statement, and the observation if it is not 0.5."""
    expected, statement, *y = case
    text = errors_of(x_and(statement), y=y[0] if y else 0.5)
    assert text.startswith("step 0, initial: ")
    assert re.search(expected, text, re.DOTALL), text


def test_previous_names():
    def model(previous, y):
        x = sample("x", Normal())
        return {"w": x if previous is None else previous["z"]}

    text = errors_of(model)
    assert text.startswith("step 1, transition: previous has no 'z' (after site 'x', line")
    assert "it has ['w', 'x']" in text
    assert "previous is None at the first step" in errors_of(lambda previous, y: {"x": previous["x"]})


def in_branches(first, second=lambda x, y: None, probs=(0.5, 0.5), arguments=None):
    """A program that samples x and calls one of two functions of x and y in branches."""

    def model(previous, y):
        x = sample("x", Normal(np.zeros(1), 1.0))
        rows = (x,) if arguments is None else arguments(x)
        returned = switch("s", np.asarray(probs), [lambda *a: first(*a, y), lambda *a: second(*a, y)], *rows)
        return None if returned is None else {"returned": returned}

    return model


def draw(name, *shape):
    def branch(x, y):
        sample(name, Normal(np.zeros((len(x), *shape)), 1.0))

    return branch


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        (in_branches(lambda x, y: draw("a")(x, y) or draw("a")(x, y)), "site 'a' in branch 0 of 's': sampled twice"),
        (in_branches(draw("x")), "site 'x' in branch 0 of 's': sampled twice"),
        (in_branches(draw("a"), draw("a", 2)), r"event shape \(2,\) here, \(\) in another branch"),
        (
            in_branches(lambda x, y: np.zeros(len(x) + 1), lambda x, y: x),
            r"switch 's': branch 0 returns .*one row for each",
        ),
        (in_branches(lambda x, y: x, lambda x, y: np.stack([x, x], axis=1)), "branch 0 returns an array of shape"),
        (in_branches(lambda x, y: x), "switch 's': branches return different kinds"),
        (in_branches(lambda x, y: {"a": x}, lambda x, y: {"b": x}), "switch 's': branches return different names"),
        (
            in_branches(lambda x, y: {"a": x[0].max()}, lambda x, y: {"a": x.max()}, probs=[1.0, 0.0]),
            "when no particle",
        ),
        (in_branches(draw("a"), arguments=lambda x: (np.zeros(9),)), r"argument 0 of the branches has shape \(9,\)"),
        (in_branches(draw("a"), arguments=lambda x: ({"x": x, "y": 2.0},)), r"argument 0 .* shape \(\)"),
        (in_branches(draw("a"), arguments=lambda x: (0.5,)), "switch 's': argument 0 .*such as the observation"),
        (in_branches(draw("a"), probs=[0.2, 0.2, 0.6]), "switch 's': 3 probabilities for 2 branches"),
        (in_branches(draw("a"), probs=np.ones((3, 2))), r"site 's': parameters of shape \(3,\) do not fit 4"),
        (
            in_branches(lambda x, y: observe("o", Normal(x, 1.0), np.zeros(len(x) + 1))),
            "'o' in branch 0 of 's': the value has shape",
        ),
    ],
)
def test_a_wrong_branch_is_a_named_error(model, expected):
    text = errors_of(model)
    assert text.startswith("step 0, initial: ")
    assert re.search(expected, text, re.DOTALL), text


def test_branches_use_rows_of_their_own():
    """An array of all particles does not fit the particles of a branch."""

    def model(previous, y):
        x = sample("x", Normal(np.zeros(1), 1.0))

        def outer():
            sample("a", Normal(x, 1.0))

        switch("s", [0.5, 0.5], [outer, lambda: None])

    assert re.search(
        r"site 'a' in branch 0 of 's': parameters of shape \(4,\) do not fit \d particles", errors_of(model)
    )


def test_a_site_in_branches_of_two_switches():
    """A particle may reach both; in branches of one switch, also nested, it reaches one of them."""

    def model(previous, y):
        x = sample("x", Normal(np.zeros(1), 1.0))
        for name in ("s", "t"):
            switch(name, [0.5, 0.5], [lambda x: draw("a")(x, y), lambda x: None], x)

    assert "site 'a' in branch 0 of 't': sampled in branches of two switches, 's' and 't'" in errors_of(model)

    def nested(previous, y):
        x = sample("x", Normal(np.zeros(1), 1.0))

        def inner(x):
            switch("t", [0.5, 0.5], [lambda x: draw("a")(x, y), lambda x: draw("a")(x, y)], x)

        switch("s", [0.5, 0.5], [inner, lambda x: draw("a")(x, y)], x)

    state, _ = Program(nested).bootstrap(50).run([0.1, 0.2], 0)
    assert np.isfinite(state.population.particles["a"]).all()


@pytest.mark.parametrize(
    ("guide", "expected"),
    [
        (lambda previous, y: guide_of("z"), "the model has no site 'z', which the guide samples"),
        (lambda previous, y: guide_of(observes=True), "observation 'y': a guide does not observe"),
        (lambda previous, y: guide_of(k=Normal()), "no particle explains the observation"),
        (lambda previous, y: guide_of(x=Bernoulli(0.2)), "site 'x': the guide never draws values"),
        (
            lambda previous, y: guide_of(x=Normal(np.zeros((1, 2)))),
            r"site 'x': the values of the guide have shape \(200, 2\), expected \(200,\)",
        ),
        (lambda previous, y: guide_of(k=Categorical([0.5, 0.5])), "site 'k': the guide never draws values"),
        (lambda previous, y: guide_of(branches=[True]), "site 's': the guide never draws values"),
    ],
)
def test_a_guide_that_does_not_fit_the_model(guide, expected):
    def model(previous, y):
        guide_of()
        observe("y", Normal(), y)

    text = errors_of(model, guide, n=200)
    assert text.startswith("step 0, initial: ")
    assert re.search(expected, text, re.DOTALL), text


def guide_of(extra=None, x=Normal(), k=Categorical([0.2, 0.2, 0.6]), branches=(False, True), observes=False):  # noqa: B008
    """Sample x, k and in some branches a."""
    rows = sample("x", x)
    sample("k", k)
    if extra:
        sample(extra, Normal())
    names = [lambda x, reached=reached: draw("a")(x, 0.0) if reached else None for reached in branches]
    switch("s", np.ones(len(branches)), names, rows)
    if observes:
        observe("y", Normal(), 0.5)


def test_all_distributions_in_a_branch_without_particles():
    """The branch does not change the evidence."""

    def model(previous, y):
        x = sample("x", Normal(np.zeros(1), 1.0))

        def empty(x):
            sample("a", Categorical(np.ones((len(x), 3))))
            sample("b", stats.poisson(np.exp(x)))
            sample("c", Bernoulli(0.5))
            sample("d", MultivariateNormal(np.stack([x, x], axis=1), np.eye(2)))
            sample("e", stats.multivariate_normal([0.0, 0.0], np.eye(2)))
            sample("f", stats.norm(x, 1.0))
            sample("g", Normal(np.zeros((1, 3)), 1.0))
            observe("y", Categorical(np.ones((len(x), 3))), 1)
            observe("z", MultivariateNormal(np.stack([x, x], axis=1), np.eye(2)), [0.1, 0.2])

        switch("s", [0.0, 1.0], [empty, lambda x: observe("y", Normal(x, 1.0), y)], x)

    state, _ = Program(model).bootstrap(30).run([0.3, -0.2], 0)
    assert state.log_evidence == pytest.approx(stats.norm(0, np.sqrt(2)).logpdf([0.3, -0.2]).sum(), abs=0.8)
    assert np.isnan(state.population.particles["d"][state.population.weights > 0]).all()


def test_a_guide_may_draw_outside_of_branches_or_in_more():
    """The model uses the draws of the particles that reach the site; the others integrate to one."""

    def model(previous, y):
        x = sample("x", Normal(np.zeros(1), 1.0))
        jump = switch("s", [0.7, 0.3], [lambda x: 0.0 * x, lambda x: sample("a", Normal(2.0, 1.0))], x)
        observe("y", Normal(x + jump, 1.0), y)

    def outside(previous, y):
        x = sample("x", Normal(0.5 * y * np.ones(1), 1.0))
        sample("a", Normal(1.0 + 0.0 * x, 1.5))
        switch("s", [0.5, 0.5], [lambda: None, lambda: None])

    def everywhere(previous, y):
        sample("x", Normal(0.5 * y, 1.0))
        switch("s", [0.5, 0.5], [lambda: sample("a", Normal(1.0, 1.5))] * 2)

    exact = np.log(0.7 * stats.norm(0, np.sqrt(2)).pdf(1.3) + 0.3 * stats.norm(2, np.sqrt(3)).pdf(1.3))
    for guide in (outside, everywhere):
        mean, standard, _ = mean_ratio(Program(model).guided(guide, 400), [1.3], exact, range(100))
        assert abs(mean - 1) < 4 * standard  # false alarm 6e-5
        assert standard < 0.01


def test_values_of_particles_that_look_like_a_shared_vector():
    """One number for each particle is an observation, also if an event has as many entries as there are particles."""

    def model(previous, y):
        k = sample("k", Categorical([0.5, 0.5]))
        x = sample("x", Normal(np.zeros((1, 4)), 1.0))
        observe("of k", Normal(0.0, 1.0), np.array([y, y + 1])[k])
        observe("residual", Normal(0.0, 1.0), y - x)
        observe("one row", Normal(x[:, 0], 1.0), [y])
        observe("number", MultivariateNormal([[0.0]], [[1.0]]), y)

    Program(model).bootstrap(4).run([0.3, 0.2, 0.1], 0)
    a, _ = Program(model).bootstrap(4).run([0.1], 0)
    p = a.population.particles
    expected = (
        stats.norm.logpdf(np.array([0.1, 1.1])[p["k"]])
        + stats.norm.logpdf(0.1 - p["x"]).sum(axis=1)
        + stats.norm.logpdf(0.1 - p["x"][:, 0])
        + stats.norm.logpdf(0.1)
    )
    np.testing.assert_allclose(np.diff(a.population.log_weights), np.diff(expected))


def test_the_mean_states_the_event_shape():
    class Pair(Distribution):
        mean = np.ones((1, 2))

        def sample(self, rng, size):
            return rng.standard_normal((size, 2))

        def log_prob(self, value):
            return stats.norm.logpdf(value).sum(axis=-1)

    class Wrong(Pair):
        mean = np.ones(2)

    class Number(Pair):
        mean = 1.0

    state, _ = Program(lambda previous, y: {"x": sample("x", Pair())}).bootstrap(4).run([0.1], 0)
    assert state.population.particles["x"].shape == (4, 2)
    text = errors_of(lambda previous, y: {"x": sample("x", Wrong())})
    assert "site 'x': parameters of shape (2,) do not fit 4 particles" in text and "(1, d)" in text
    text = errors_of(lambda previous, y: {"x": sample("x", Number())})
    assert "site 'x': its draws have shape (4, 2), expected (4,) by the Number" in text


def test_errors_of_the_user_keep_their_type():
    class Stop(ValueError):
        pass

    def model(previous, y):
        sample("x", Normal())
        raise Stop

    with pytest.raises(Stop):
        Program(model).bootstrap(4).run([0.1], 0)


def test_errors_outside_of_steps():
    with pytest.raises(InputError, match="outside of a program"):
        sample("x", Normal(0.0, 1.0))
    assert "sampled nothing" in errors_of(lambda previous, y: None)
    assert "returned a ndarray" in errors_of(lambda previous, y: sample("x", Normal()))
    assert "site 'x': expected a distribution, found a builtins.float" in errors_of(lambda p, y: sample("x", 3.0))


def test_a_program_with_time_and_inputs_is_the_state_space_model_with_both():
    """Bit for bit, particles and evidence."""

    def model(previous, y, t, u=0.0):
        x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(0.9 * previous["x"] + u, 0.5 + 0.1 * t))
        observe("y", Normal(x, 1.0), y)

    exact = StateSpaceModel.of(
        Normal(0.0, 1.0), lambda x, t, u=0.0: Normal(0.9 * x + u, 0.5 + 0.1 * t), lambda x: Normal(x, 1.0)
    )
    ys = [WithInput(0.3, 1.0), WithInput(None, 2.0), WithInput(1.9, -1.0), 0.2]
    a, _ = bootstrap(exact, 200).run(ys, 3)
    b, _ = Program(model).bootstrap(200).run(ys, 3)
    np.testing.assert_array_equal(a.population.particles, b.population.particles["x"])
    assert a.log_evidence == b.log_evidence

    def needs(previous, y, u):
        sample("x", Normal(u, 1.0))

    with pytest.raises(InputError, match="step 1, transition: a function of the model has a parameter u, and step 1"):
        Program(needs).bootstrap(5).run([WithInput(0.1, 1.0), 0.2], 0)


# --- example programs ----------------------------------------------------------------------------------------------
PROGRAMS = sorted((REPOSITORY / "models" / "programs").glob("*.py"))


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda p: p.stem)
def test_every_filter_of_every_program_runs(path):
    module = runpy.run_path(str(path))
    if "filters" not in module:
        pytest.skip("is no program with filters()")
    model = module["model"]
    observations = (model if isinstance(model, StateSpaceModel) else Program(model)).simulate(6)[1]
    for filter in module["filters"](30).values():
        state, _ = filter.run(observations, 0)
        assert np.isfinite(state.log_evidence)
        again, _ = filter.run(observations, 0)
        assert again.log_evidence == state.log_evidence


def test_the_object_chain_agrees_with_the_forward_algorithm():
    """Only the number of boxes matters for the counts: a birth-death chain, summed exactly."""
    from scipy import stats

    module = runpy.run_path(str(REPOSITORY / "models" / "programs" / "object_hmm.py"))
    counts = [1, 1, 2]
    size = np.zeros(8)
    size[0], total = 1.0, 0.0
    for count in counts:
        moved = 0.5 * size
        moved[1:] += 0.3 * size[:-1]
        moved[:-1] += 0.2 * size[1:]
        moved[0] += 0.2 * size[0]
        size = moved * stats.binom.pmf(count, np.arange(8), 0.8)
        total += np.log(size.sum())
        size /= size.sum()
    filter = module["filters"](120)["bootstrap"]
    ratios = np.exp([filter.run(counts, seed)[0].log_evidence - total for seed in range(60)])
    assert abs(ratios.mean() - 1) < 4 * ratios.std(ddof=1) / np.sqrt(len(ratios))

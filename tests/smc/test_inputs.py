"""Models whose functions take the index of the step and an input."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Branching,
    Dynamics,
    Normal,
    Program,
    Reweight,
    StateSpaceModel,
    Transition,
    WithInput,
    auxiliary,
    backward_paths,
    bootstrap,
    conditional_path,
    forward_backward,
    guided,
    hidden_markov,
    kalman_filter,
    keep,
    linear_gaussian,
    nonlinear_gaussian,
    path_log_prob,
    run_many,
)
from mstfilter.smc.first_steps import unexamined
from mstfilter.smc.inputs import same_component, step_parameters
from tests.smc.models import mean_ratio

YS = [0.3, -0.2, None, 1.1, 0.4]
US = [0.5, 1.0, -1.0, 0.25, 2.0]
WITH = [WithInput(y, u) for y, u in zip(YS, US, strict=True)]
SEEN: list = []


def moving(x, t, u):
    SEEN.append((t, u))
    return Normal(0.9 * x + u, 0.5 + 0.1 * t)


MODEL = StateSpaceModel.of(Normal(0.0, 1.0), moving, lambda x, *, t: Normal(x, 1.0 + 0.1 * t))


def by_hand(t, u):
    """The model of step t."""
    return StateSpaceModel.of(
        Normal(0.0, 1.0), lambda x: Normal(0.9 * x + u, 0.5 + 0.1 * t), lambda x: Normal(x, 1.0 + 0.1 * t)
    )


def stepped(filter_of, seed=3):
    """A run in which each step has the filter of its own model."""
    state = filter_of(by_hand(0, US[0])).start(seed)
    for t, y in enumerate(YS):
        state, _ = filter_of(by_hand(t, US[t])).step(state, y)
    return state


FILTERS = {
    "bootstrap": lambda model: bootstrap(model, 30),
    "guided": lambda model: guided(model, lambda x, y: Normal(0.5 * (x + y), 1.0), 30),
    "auxiliary": lambda model: auxiliary(model, lambda x, y: -0.1 * (x - y) ** 2, 30),
    "branching": lambda model: replace(
        bootstrap(model, 30), transition=Branching(Dynamics(model), 2), resample="after"
    ),
}


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_equals_the_one_whose_model_is_made_anew_for_each_step(name):
    state, _ = FILTERS[name](MODEL).run(WITH, 3)
    expected = stepped(FILTERS[name])
    np.testing.assert_array_equal(state.population.particles, expected.population.particles)
    np.testing.assert_array_equal(state.population.log_weights, expected.population.log_weights)


def test_the_first_transition_is_called_with_the_second_step():
    SEEN.clear()
    with unexamined():
        bootstrap(MODEL, 3).run(WITH)
    assert list(enumerate(US))[1:] == SEEN


def test_batches_smoothing_and_conditional_paths_take_inputs():
    filter = bootstrap(MODEL, 20)
    runs = run_many(filter, WITH, [3, 4], together=False)
    single = [filter.run(WITH, seed)[0] for seed in (3, 4)]
    assert [state.log_evidence for state in single] == runs["log_evidence"][:, -1].tolist()
    path = conditional_path(filter, WITH, 1)
    total = MODEL.log_initial(path[:1])[0]
    for t, y in enumerate(YS):
        model = by_hand(t, US[t])
        total += model.log_transition(path[t - 1 : t], path[t : t + 1])[0] if t else 0.0
        total += 0.0 if y is None else model.log_likelihood(path[t : t + 1], y)[0]
    assert path_log_prob(filter, WITH, path) == pytest.approx(total, abs=1e-12)
    paths = backward_paths(np.random.default_rng(0), keep(filter, WITH, 0), Dynamics(MODEL), 50)
    assert len(paths) == len(WITH)


def test_an_input_that_is_not_given_is_named():
    with pytest.raises(InputError, match=r"step 1, transition: .* parameter u, and step 1 has no input"):
        bootstrap(MODEL, 5).run(YS)
    default = StateSpaceModel.of(Normal(0.0, 1.0), lambda x, u=0.0: Normal(x + u, 1.0), lambda x: Normal(x, 1.0))
    without = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(x, 1.0), lambda x: Normal(x, 1.0))
    assert bootstrap(default, 5).run(YS)[0].log_evidence == bootstrap(without, 5).run(YS)[0].log_evidence


def test_parameters_of_the_step_follow_the_other_arguments():
    assert step_parameters(lambda u: 0, 1) == {} == step_parameters(max, 1)
    assert step_parameters(lambda u, t: 0, 1) == {"t": True}
    assert step_parameters(lambda x, *, u=None, t: 0, 1) == {"u": False, "t": True}
    assert step_parameters(lambda x, *t, **u: 0, 1) == {}


@dataclass(frozen=True)
class Drift(Transition):
    rate: float = 0.0

    def at_step(self, t, u=None):
        return replace(self, rate=t * u)

    def predict(self, rng, population, observation):
        return population.moved(population.particles + self.rate)


def test_components_that_override_at_are_bound_also_inside_another():
    start = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(x, 1.0), lambda x: Normal(x, 1.0))
    filter = replace(bootstrap(start, 4), transition=Drift(), update=Reweight(lambda x, y: np.zeros(len(x))))
    first = filter.run(WITH[:1])[0].population.particles
    expected = first + sum(t * u for t, u in enumerate(US))
    np.testing.assert_allclose(filter.run(WITH)[0].population.particles, expected)
    branching = replace(filter, transition=Branching(Drift(), 1))
    np.testing.assert_allclose(branching.run(WITH)[0].population.particles, expected)


def test_components_without_time_are_used_as_they_are():
    filter = bootstrap(by_hand(0, 1.0), 5)
    assert filter.at_step(3, 1.0) is filter


# --- against exact answers ----------------------------------------------------------------------------------------
DT = np.array([0.0, 0.5, 1.5, 0.2, 1.0, 0.7])
ODOMETRY = np.random.default_rng(5).standard_normal((6, 2))
MATRICES = {
    "F": np.array([[[1.0, dt], [0.0, 0.9]] for dt in DT]),
    "Q": np.array([0.2 * dt * np.eye(2) + 0.01 * np.eye(2) for dt in DT]),
    "H": np.array([[1.0, 0.0]]),
    "R": np.array([[[0.5 + 0.1 * t]] for t in range(6)]),
    "m0": np.array([0.5, -0.2]),
    "P0": np.diag([1.0, 0.3]),
}
B = np.array([[1.0, 0.0], [0.2, 0.7]])
POSITIONS = [0.2, 0.7, None, 1.5, 0.3, 0.9]
DRIVEN = [WithInput(y, u) for y, u in zip(POSITIONS, ODOMETRY, strict=True)]


def augmented():
    """The exact answers of the same model by another state: a third entry that is 1 carries the input."""
    F = np.zeros((6, 3, 3))
    F[:, :2, :2], F[:, :2, 2], F[:, 2, 2] = MATRICES["F"], ODOMETRY @ B.T, 1.0
    Q, P0 = np.zeros((6, 3, 3)), np.zeros((3, 3))
    Q[:, :2, :2], P0[:2, :2] = MATRICES["Q"], MATRICES["P0"]
    H, m0 = np.array([[1.0, 0.0, 0.0]]), np.append(MATRICES["m0"], 1.0)
    return F, Q, H, MATRICES["R"], m0, P0


def test_inputs_of_the_kalman_filter_are_a_third_state():
    ours = kalman_filter(*MATRICES.values(), DRIVEN, B=B)
    other = kalman_filter(*augmented(), POSITIONS)
    np.testing.assert_allclose(ours.log_evidence, other.log_evidence, atol=1e-8)
    np.testing.assert_allclose(ours.means, other.means[:, :2], atol=1e-8)
    np.testing.assert_allclose(ours.smoothed_means, other.smoothed_means[:, :2], atol=1e-8)
    np.testing.assert_allclose(ours.covariances, other.covariances[:, :2, :2], atol=1e-8)


def test_bootstrap_filters_with_irregular_times_and_odometry_have_the_exact_evidence():
    """Mean of L_hat / L over 300 runs is 1 within 5 standard errors (false alarm 6e-7)."""
    exact = kalman_filter(*MATRICES.values(), DRIVEN, B=B)
    filter = bootstrap(linear_gaussian(*MATRICES.values(), B=B), 300)
    mean, error, _ = mean_ratio(filter, DRIVEN, exact.log_evidence[-1], range(300))
    assert abs(mean - 1) < 5 * error < 0.3
    by_hand = nonlinear_gaussian(
        lambda x, t, u: np.stack([x[:, 0] + DT[t] * x[:, 1], 0.9 * x[:, 1]], axis=1) + u @ B.T,
        MATRICES["Q"],
        lambda x: x[:, :1],
        MATRICES["R"],
        MATRICES["m0"],
        MATRICES["P0"],
    )
    same, _ = bootstrap(by_hand, 300).run(DRIVEN, 1)
    assert same.log_evidence == pytest.approx(filter.run(DRIVEN, 1)[0].log_evidence, abs=1e-9)


def test_chains_whose_likelihood_changes_with_time_have_the_exact_evidence():
    """As above; 0.3 bounds the error of the mean."""
    moves = np.random.default_rng(0).dirichlet(np.ones(3), size=3)
    start, table = np.array([0.5, 0.2, 0.3]), np.log([[0.7, 0.2, 0.1], [0.1, 0.3, 0.6]])

    def log_likelihood(y, t, u):
        return table[y] * (1 + 0.1 * t) + u * np.arange(3)

    ys = [None if y is None else WithInput(y, 0.1 * y) for y in (0, 1, None, 0, 1)]
    exact = forward_backward(start, moves, log_likelihood, ys)
    paths = np.array(list(product(range(3), repeat=5)))
    p = start[paths[:, 0]]
    for t, y in enumerate(ys):
        p = p * (moves[paths[:, t - 1], paths[:, t]] if t else 1.0)
        p = p * (1.0 if y is None else np.exp(log_likelihood(y.y, t, y.u)[paths[:, t]]))
    total = np.array([p[paths[:, 3] == k].sum() for k in range(3)]) / p.sum()
    assert exact.log_evidence[-1] == pytest.approx(np.log(p.sum()), abs=1e-12)
    np.testing.assert_allclose(exact.smoothed[3], total, atol=1e-12)
    model = hidden_markov(start, moves, log_likelihood)
    mean, error, _ = mean_ratio(bootstrap(model, 100), ys, exact.log_evidence[-1], range(300))
    assert abs(mean - 1) < 5 * error < 0.3


def test_singular_noise_of_filterpy_is_accepted():
    """Noise of an acceleration, of rank one: draws have its covariance, and the evidence is exact (as above)."""
    Q = pytest.importorskip("filterpy.common").Q_discrete_white_noise(2, dt=0.5, var=0.3)
    arguments = ([[1.0, 0.5], [0.0, 1.0]], Q, [[1.0, 0.0]], [[0.5]], [0.0, 0.0], np.diag([1.0, 0.0]))
    model, ys = linear_gaussian(*arguments), [0.2, 0.5, 0.1, 0.9]
    mean, error, _ = mean_ratio(bootstrap(model, 300), ys, kalman_filter(*arguments, ys).log_evidence[-1], range(300))
    assert abs(mean - 1) < 5 * error < 0.3
    noise = model.sample_transition(np.random.default_rng(0), np.zeros((200_000, 2)))
    np.testing.assert_allclose(np.cov(noise.T), Q, atol=5 * 0.3 * 0.5**2 / np.sqrt(200_000))
    np.testing.assert_allclose(noise[:, 0], 0.25 * noise[:, 1], atol=1e-7)
    assert model.log_transition is None and model.log_initial is None
    with pytest.raises(InputError, match="no log_transition"):
        backward_paths(np.random.default_rng(0), keep(bootstrap(model, 5), ys), Dynamics(model), 2)
    assert conditional_path(bootstrap(model, 5), ys, 0).shape == (4, 2)
    with pytest.raises(InputError, match="symmetric and positive semidefinite"):
        linear_gaussian(np.eye(2), -np.eye(2), [[1.0, 0.0]], [[1.0]], [0.0, 0.0], np.eye(2))


def test_what_exact_models_reject():
    one = ([[1.0]], [[1.0]], [[1.0]], [[1.0]], [0.0], [[1.0]])
    for wrong in (np.nan, np.inf):
        with pytest.raises(InputError, match=r"observation 1 is (NaN|.* expected finite numbers)") as error:
            kalman_filter(*one, [0.1, wrong])
        assert "missing is None" in error.value.hints[0]
    with pytest.raises(InputError, match="observation 1 has no input"):
        kalman_filter(*one, [0.1, 0.2], B=[[1.0]])
    with pytest.raises(InputError, match=r"step 1, transition: .* step 1 has no input"):
        bootstrap(linear_gaussian(*one, B=[[1.0]]), 5).run([0.1, 0.2])
    with pytest.raises(InputError, match=r"step 2, transition: F has 2 entries, and none for step 2"):
        bootstrap(linear_gaussian(np.ones((2, 1, 1)), *one[1:]), 5).run([0.1, 0.2, 0.3])
    with pytest.raises(InputError, match=r"the input has shape \(2,\), expected \(1,\)"):
        bootstrap(linear_gaussian(*one, B=[[1.0]]), 5).run([0.1, WithInput(0.2, [1.0, 2.0])])
    with pytest.raises(InputError, match=r"B has shape \(2, 1\), expected \(1, 1\)"):
        linear_gaussian(*one, B=[[1.0], [2.0]])
    with pytest.raises(InputError, match=r"B has shape \(1,\)"):
        kalman_filter(*one, [0.1], B=[1.0])
    with pytest.raises(InputError, match=r"transition has shape \(2, 1, 1\)"):
        forward_backward([1.0], np.ones((2, 1, 1)), lambda y: np.zeros(1), [0])


@dataclass(frozen=True)
class Inner:
    mean: object


@dataclass(frozen=True)
class Outer:
    inner: object
    hidden: object = field(default=0, compare=False)


def test_components_with_arrays_are_compared_field_by_field():
    a, b, c = np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.array([2.0, 1.0])
    for make in (Inner, lambda x: Outer(Inner(x)), lambda x: Outer({"m": x}), lambda x: Outer((x, [x])), lambda x: x):
        assert same_component(make(a), make(b))
        assert not same_component(make(a), make(c))
    assert same_component(Outer(a, 1), Outer(b, 2)) and not same_component(Inner(a), Outer(a))


def in_place(rng, x):
    x += rng.normal(size=len(x))
    return x


def decides(rng, x):
    return x + 1 if x > 0 else x


@pytest.mark.parametrize(
    ("make", "message", "hint"),
    [
        (
            lambda: StateSpaceModel.of(Normal(), lambda t, x: Normal(x, t), lambda x: Normal(x, 1.0)),
            r"transition has the parameters \(t, x\), and is called with one argument.*'x'",
            "a parameter t gets the index of the step",
        ),
        (
            lambda: StateSpaceModel.of(Normal(), lambda x, time: Normal(x, time), lambda x: Normal(x, 1.0)),
            r"transition has the parameters \(x, time\).*'time'",
            "by these names only",
        ),
        (
            lambda: StateSpaceModel.of(Normal(), lambda x: Normal(x, 1.0), lambda: Normal(0.0, 1.0)),
            r"observation has the parameters \(\).*too many",
            "",
        ),
        (
            lambda: moved_by(lambda x: x),
            r"StateSpaceModel.sample_transition has the parameters \(x\), and is called with 2 arguments",
            "",
        ),
        (lambda: moved_by(in_place), r"step 1, transition: .*changed in place .*test_inputs.py, line", "x = x + 1"),
        (lambda: moved_by(decides), r"step 1, transition: an array .* decides .*test_inputs.py", "numpy.where"),
        (
            lambda: Program(lambda y: None).bootstrap(3).run([0.1]),
            r"ProgramInitial.model has the parameters \(y\), and is called with 2 arguments",
            "",
        ),
    ],
)
def test_what_a_function_of_the_user_gets_is_said(make, message, hint):
    with pytest.raises(InputError, match=message) as error:
        make()
    assert any(hint in one for one in error.value.hints)


def moved_by(move):
    model = StateSpaceModel(lambda rng, n: rng.normal(size=n), move, lambda x, y: -((x - y) ** 2))
    return bootstrap(model, 20).run([0.1, 0.2])


def test_an_unknown_error_of_a_function_keeps_its_type_and_gets_its_place():
    with pytest.raises(ZeroDivisionError) as error:
        moved_by(lambda rng, x: x / 0 if len(x) < 0 else 1 // 0)
    assert "in step 1, transition" in error.value.__notes__

"""Simulated data have the law of the model: joint moments, Kalman filters, enumeration and ranks of the truth.

Statistical tests compare with exact values at |z| < 4.5 or p > 1e-4. With the fixed seeds they cannot fail by chance,
and a change of streams fails one with a probability below 1e-3.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Bernoulli,
    Categorical,
    ConditionallyLinear,
    Linear,
    Normal,
    Poisson,
    Program,
    StateSpaceModel,
    WithInput,
    bootstrap,
    forward_backward,
    hidden_markov,
    kalman_filter,
    linear_gaussian,
    nonlinear_gaussian,
    observe,
    rao_blackwellised,
    sample,
    switch,
)

F, Q = np.array([[0.9, 0.3], [0.0, 0.7]]), np.array([[0.3, 0.1], [0.1, 0.2]])
H, R = np.array([[1.0, 0.5]]), np.array([[0.4]])
M0, P0, B = np.array([1.0, -1.0]), np.array([[1.0, 0.2], [0.2, 0.5]]), np.array([[0.0], [1.0]])
US = np.array([[0.0], [2.0], [-1.0], [0.5]])


def test_linear_gaussian_data_have_the_joint_law():
    """Mean and covariance of (x_0 .. x_3, y_0 .. y_3) over 600 seeds, with inputs, against the dense joint."""
    T, n = 4, 600
    model = linear_gaussian(F, Q, H, R, M0, P0, B)
    runs = [model.simulate(T, seed, US) for seed in range(n)]
    assert all(isinstance(y, WithInput) for y in runs[0][1])
    found = np.stack([np.concatenate([x.ravel(), np.ravel([y.y for y in ys])]) for x, ys in runs])
    L, mean = np.zeros((2 * T, 2 * T)), [M0]  # x = mean + L e, by columns of blocks
    roots = [np.linalg.cholesky(P0), *[np.linalg.cholesky(Q)] * (T - 1)]
    for t in range(T):
        for s in range(t + 1):
            L[2 * t : 2 * t + 2, 2 * s : 2 * s + 2] = np.linalg.matrix_power(F, t - s) @ roots[s]
        if t:
            mean.append(F @ mean[-1] + B @ US[t])
    seen = np.kron(np.eye(T), H)
    cov_x = L @ L.T
    cov = np.block([[cov_x, cov_x @ seen.T], [seen @ cov_x, seen @ cov_x @ seen.T + 0.4 * np.eye(T)]])
    mean = np.concatenate([np.ravel(mean), seen @ np.ravel(mean)])
    assert (abs(found.mean(axis=0) - mean) / np.sqrt(np.diag(cov) / n) < 4.5).all()
    error = np.sqrt((np.outer(np.diag(cov), np.diag(cov)) + cov**2) / n)
    assert (abs(np.cov(found.T) - cov) / error < 4.5).all()


def test_the_truth_is_a_draw_from_the_exact_posterior():
    """Over 300 seeds, errors of the Kalman means have the covariances of the filter: chi-square of each step."""
    model, T = linear_gaussian(F, Q, H, R, M0, P0), 6
    errors = []
    for seed in range(300):
        x, ys = model.simulate(T, seed)
        exact = kalman_filter(F, Q, H, R, M0, P0, ys)
        residual = x - exact.means
        errors.append(np.einsum("ti,tij,tj->t", residual, np.linalg.inv(exact.covariances), residual))
    assert all(stats.kstest(column, stats.chi2(2).cdf).pvalue > 1e-4 for column in np.transpose(errors))


def test_a_chain_by_enumeration():
    """Frequencies of (x_0, x_1, y_0, y_1) over 1500 seeds against the product of the probabilities."""
    start, moves, p = [0.6, 0.4], [[0.9, 0.1], [0.3, 0.7]], np.array([[0.7, 0.2, 0.1], [0.1, 0.1, 0.8]])
    model, counts, expected = (
        hidden_markov(start, moves, Categorical(p)),
        np.zeros((2, 2, 3, 3)),
        np.zeros((2, 2, 3, 3)),
    )
    for seed in range(1500):
        x, y = model.simulate(2, seed)
        counts[*x, *y] += 1
    for (i, j, a, b), _ in np.ndenumerate(counts):
        expected[i, j, a, b] = 1500 * start[i] * moves[i][j] * p[i, a] * p[j, b]
    assert stats.chisquare(counts.ravel(), expected.ravel()).pvalue > 1e-4
    by_function = forward_backward(start, moves, lambda y: np.log(p[:, y]), y)
    np.testing.assert_allclose(forward_backward(start, moves, Categorical(p), y).filtered, by_function.filtered)
    run = bootstrap(model, 4000).run(y, 0)[0]
    assert abs(run.log_evidence - by_function.log_evidence[-1]) < 0.1
    with pytest.raises(InputError, match="no sample_observation"):
        hidden_markov(start, moves, lambda y: np.log(p[:, y])).simulate(2)
    with pytest.raises(InputError, match=r"emission has parameters of shape \(2,\), expected one row per state: 3"):
        hidden_markov([0.2, 0.3, 0.5], np.eye(3), Normal([0.0, 1.0], 1.0))


def program(previous, y):
    """Counts whose log rate moves, in one of two ways."""
    level = np.zeros(2) if previous is None else previous["x"]
    up = sample("up", Bernoulli(0.5))
    x = sample("x", Normal(level[: len(up)] if previous is None else level, 0.2))
    x = x + np.where(up, 0.1, -0.1)
    observe("y", Poisson(np.exp(x)), y)
    return {"moved": x}


def volatility(previous, y):
    x = sample("x", Normal(-1.0, 0.5) if previous is None else Normal(-1.0 + 0.9 * (previous["x"] + 1.0), 0.3))
    observe("y", Normal(0.0, np.exp(x / 2)), y)


SV = StateSpaceModel.of(
    Normal(-1.0, 0.5), lambda x: Normal(-1.0 + 0.9 * (x + 1.0), 0.3), lambda x: Normal(0.0, np.exp(x / 2))
)


@pytest.mark.parametrize("model", [SV, Program(volatility)], ids=["densities", "program"])
def test_the_rank_of_the_truth_is_uniform(model):
    """Over 150 seeds, the filter's distribution function at the true last state (Talts et al. 2018)."""
    filter = bootstrap(model, 200) if isinstance(model, StateSpaceModel) else model.bootstrap(200)
    ranks = []
    for seed in range(150):
        x, ys = model.simulate(5, seed)
        population = filter.run(ys, seed)[0].population
        particles, truth = (
            (population.particles, x) if isinstance(x, np.ndarray) else (population.particles["x"], x["x"])
        )
        ranks.append(population.weights @ (particles < truth[-1]))
    assert stats.kstest(ranks, "uniform").pvalue > 1e-4


def test_the_first_steps_do_not_depend_on_the_number():
    for model in (SV, Program(volatility)):
        (x, y), (longer, more) = model.simulate(3, 5), model.simulate(6, 5)
        np.testing.assert_array_equal(y, more[:3])
        np.testing.assert_array_equal(*((a["x"] if isinstance(a, dict) else a)[:3] for a in (x, longer)))
    assert not np.array_equal(SV.simulate(3, 6)[1], y)


def test_functions_of_objects_time_and_inputs():
    """Particles that are objects; the functions get t and u."""
    model = StateSpaceModel(
        lambda rng, n: tuple(("start", int(k)) for k in rng.integers(3, size=n)),
        lambda rng, x, t, u: tuple((u, k + t) for _, k in x),
        lambda x, y: np.zeros(len(x)),
        sample_observation=lambda rng, x, t: np.array([10 * t + k for _, k in x]),
    )
    states, ys = model.simulate(3, inputs="abc")
    k = states[0][1]
    assert states == (("start", k), ("b", k + 1), ("c", k + 3))
    assert [(y.y, y.u) for y in ys] == [(k, "a"), (11 + k, "b"), (23 + k, "c")]
    several = StateSpaceModel(
        lambda rng, n: {"x": rng.normal(size=n), "v": rng.normal(size=(n, 2))},
        lambda rng, p: {"x": p["x"] + 1.0, "v": p["v"]},
        lambda p, y: np.zeros(len(p["x"])),
        sample_observation=lambda rng, p: {"a": p["x"], "b": p["v"]},
    )
    states, ys = several.simulate(3)
    assert states["x"].shape == (3,) and states["v"].shape == (3, 2) and states["x"][2] == states["x"][0] + 2.0
    assert [y["a"] for y in ys] == states["x"].tolist() and ys[1]["b"].shape == (2,)
    named = StateSpaceModel.of(
        {"x": Normal(0.0, 1.0), "v": Normal(0.0, 0.1)},
        lambda p: {"x": Normal(p["x"] + p["v"], 0.1), "v": Normal(p["v"], 0.1)},
        lambda p: {"gps": Normal(p["x"], 1.0), "speed": Normal(p["v"], 1.0)},
    )
    states, ys = named.simulate(4)
    assert set(states) == {"x", "v"} and set(ys[0]) == {"gps", "speed"}
    assert bootstrap(named, 50).run(ys)[0].population.mean().keys() == {"x", "v"}
    with pytest.raises(InputError, match="there are 2 inputs for 3 steps"):
        model.simulate(3, inputs="ab")
    with pytest.raises(InputError, match="n_steps is 0"):
        model.simulate(0)


def pair(previous, y):
    x = sample("x", Normal(0.0, 1.0))
    observe("a", Normal(x, 1.0), None if y is None else y["a"])
    observe("b", Poisson(np.exp(x)), None if y is None else y["b"])


def entries(previous, y):
    x = sample("x", Normal(0.0, 1.0))
    observe("first", Normal(x, 1.0), y[0])
    observe("second", Poisson(np.exp(x)), y[1])


def named(previous, y):
    x = sample("x", Normal(0.0, 1.0))
    observe("range of the beacon", Normal(np.stack([x, x], axis=1), 1.0), y["range"])


def branches(previous, y):
    x = sample("x", Normal(0.0, 1.0))

    def low(x):
        observe("y", Normal(x - 100.0, 1.0), y)

    def high(x):
        observe("y", Normal(x + 100.0, 1.0), y)

    switch("k", [0.5, 0.5], [low, high], x)


def test_observations_of_programs_are_what_they_take():
    _, ys = Program(pair).simulate(3)
    assert [sorted(y) for y in ys] == [["a", "b"]] * 3
    _, ys = Program(entries).simulate(3)
    assert all(isinstance(y, tuple) and len(y) == 2 for y in ys)
    _, ys = Program(named).simulate(3)
    assert ys[0]["range"].shape == (2,)
    for model in (pair, entries, named):
        Program(model).bootstrap(50).run(Program(model).simulate(3)[1], 0)
    states, ys = Program(branches).simulate(40)
    np.testing.assert_array_equal(ys > 0, states["k"] == 1)
    states, ys = Program(program).simulate(5)
    assert ys.dtype.kind == "i" and set(states) == {"up", "x", "moved"}


def silent(previous, y):
    x = sample("x", Normal(0.0, 1.0))
    if y is not None:
        observe("y", Normal(x, 1.0), y)


def twice(previous, y):
    x = sample("x", Normal(0.0, 1.0))
    observe("a", Normal(x, 1.0), y["a"])
    observe("again", Normal(x, 1.0), y["a"])


@pytest.mark.parametrize(
    ("model", "message"), [(silent, "step 0: the program observes nothing"), (twice, "reads the entries .'a'.")]
)
def test_programs_that_cannot_be_simulated(model, message):
    with pytest.raises(InputError, match=message):
        Program(model).simulate(2)


def test_conditionally_linear_and_singular_models():
    """Errors of the exact posterior of z given the true regimes are chi-square; a singular Q is followed exactly."""

    def matrices(k):
        return Linear(F=[[0.9]], Q=np.where(k == 0, 0.1, 1.0)[:, None, None], H=[[1.0]], R=[[0.2]])

    def regime(rng, k):
        return np.where(rng.random(len(k)) < 0.3, 1 - k, k)

    model = ConditionallyLinear(lambda rng, n: rng.integers(2, size=n), regime, matrices, [0.5], [[1.0]])
    errors = []
    for seed in range(300):
        states, ys = model.simulate(5, seed)
        noise = np.where(states["u"] == 0, 0.1, 1.0)[:, None, None]
        exact = kalman_filter([[0.9]], noise, [[1.0]], [[0.2]], [0.5], [[1.0]], ys)
        errors.append((states["z"] - exact.means)[-1, 0] / np.sqrt(exact.covariances[-1, 0, 0]))
    assert states["z"].shape == (5, 1) and ys.shape == (5, 1)
    assert stats.kstest(errors, "norm").pvalue > 1e-4
    rao_blackwellised(model, 20).run(ys, 0)
    turning = nonlinear_gaussian(lambda x: 2 * x, np.zeros((1, 1)), lambda x: x, [[1e-12]], [1.0], np.zeros((1, 1)))
    states, ys = turning.simulate(4)
    np.testing.assert_allclose(states[:, 0], [1, 2, 4, 8])
    np.testing.assert_allclose(ys, states, atol=1e-5)

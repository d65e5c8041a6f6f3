"""Models that would be wrong in silence are named at the first steps of a run; right ones run, in any style."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Bernoulli,
    Categorical,
    MultivariateNormal,
    Normal,
    StateSpaceModel,
    Student,
    Uniform,
    WithInput,
    auxiliary,
    bootstrap,
    guided,
    log_mean_exp,
    run_many,
)
from mstfilter.smc.first_steps import unexamined
from mstfilter.smc.testing import ModelContract, check_properties

YS = [0.3, -0.2, 0.8]
X0 = Normal(0.0, 1.0)
OTHER = np.random.default_rng(1)


def of(transition=lambda x: Normal(0.9 * x, 0.5), observation=lambda x: Normal(x, 1.0), initial=X0):
    return StateSpaceModel.of(initial, transition, observation)


def by_functions(
    move=lambda rng, x: 0.9 * x + 0.5 * rng.normal(size=len(x)),
    likelihood=lambda x, y: -0.5 * (x - y) ** 2,
    initial=lambda rng, n: rng.normal(size=n),
    **densities,
):
    return StateSpaceModel(initial, move, likelihood, **densities)


def vectors(move, likelihood=lambda x, y: -0.5 * ((x - y) ** 2).sum(axis=1)):
    return by_functions(move, likelihood, lambda rng, n: rng.normal(size=(n, 2)))


class Counting:
    """A move that grows with each call."""

    n = 0

    def __call__(self, rng, x):
        self.n += 1
        return x + 0.1 * self.n + rng.normal(size=len(x))


def normalised(x, y):
    found = -0.5 * (x - y) ** 2
    return found - log_mean_exp(found)


MOVES = "moves differently among others|fails for|the transition density"
RIGHT_Q = of()
FAULTY = {
    "the mean of all": (of(lambda x: Normal(0.9 * x.mean(), 0.5)), MOVES),
    "the first of all": (of(lambda x: Normal(0.9 * x[0], 0.5)), MOVES),
    "the last of all": (of(lambda x: Normal(0.9 * x[-1], 0.5)), MOVES),
    "the spread of all": (of(lambda x: Normal(0.9 * x, x.std())), MOVES),
    "the largest of all": (of(lambda x: Normal(x - x.max(), 0.5)), MOVES),
    "neighbours": (of(lambda x: Normal(np.roll(x, 1), 0.5)), MOVES),
    "sorted": (of(lambda x: Normal(np.sort(x), 0.5)), MOVES),
    "backwards": (of(lambda x: Normal(x[::-1], 0.5)), MOVES),
    "a mean in the observation": (of(observation=lambda x: Normal(x - x.mean(), 1.0)), "log likelihood of particle"),
    "a spread in the observation": (of(observation=lambda x: Normal(x, x.std())), "log likelihood of particle"),
    "the mean of all, by functions": (by_functions(lambda rng, x: x.mean() + rng.normal(size=len(x))), MOVES),
    "the first of all, by functions": (by_functions(lambda rng, x: x[0] + rng.normal(size=len(x))), MOVES),
    "the spread of all, by functions": (by_functions(lambda rng, x: x + x.std() * rng.normal(size=len(x))), MOVES),
    "neighbours, by functions": (by_functions(lambda rng, x: np.roll(x, 1) + rng.normal(size=len(x))), MOVES),
    "a mean of vectors": (vectors(lambda rng, x: x.mean(axis=0) + rng.normal(size=x.shape)), MOVES),
    "one noise for all": (by_functions(lambda rng, x: x + rng.normal()), "same random number"),
    "one noise vector for all": (vectors(lambda rng, x: x + rng.normal(size=2)), "same random number"),
    "one noise for one coordinate": (
        vectors(lambda rng, x: x + np.column_stack([rng.normal(size=len(x)), np.full(len(x), rng.normal())])),
        "same random number",
    ),
    "one start for all": (by_functions(initial=lambda rng, n: np.full(n, rng.normal())), "same random number"),
    "a likelihood normalised over particles": (by_functions(likelihood=normalised), "log likelihood of particle"),
    "a softmax": (
        by_functions(likelihood=lambda x, y: stats.norm.logpdf(x, y) - np.logaddexp.reduce(stats.norm.logpdf(x, y))),
        "log likelihood of particle",
    ),
    "a sum over particles": (by_functions(likelihood=lambda x, y: -0.5 * ((x - y) ** 2).sum()), "one number per"),
    "a sum over particles, repeated": (
        by_functions(likelihood=lambda x, y: np.full(len(x), -0.5 * ((x - y) ** 2).sum())),
        "log likelihood of particle",
    ),
    "a sum over the wrong axis": (
        vectors(lambda rng, x: x + rng.normal(size=x.shape), lambda x, y: -0.5 * ((x - y) ** 2).sum(axis=0)),
        "one number per particle|has shape",
    ),
    "numpy's generator in a move": (
        by_functions(lambda rng, x: x + np.random.normal(size=len(x))),  # noqa: NPY002
        "repeated with the same generator",
    ),
    "another generator in a move": (by_functions(lambda rng, x: x + OTHER.normal(size=len(x))), "repeated with the"),
    "another generator at the start": (by_functions(initial=lambda rng, n: OTHER.normal(size=n)), "drawn again"),
    "another generator in a likelihood": (
        by_functions(likelihood=lambda x, y: -0.5 * (x - y + OTHER.normal(size=len(x))) ** 2),
        "computed again",
    ),
    "another generator in a distribution": (
        of(lambda x: Normal(x + OTHER.normal(size=len(x)), 0.5)),
        "repeated with",
    ),
    "scipy without random_state": (
        by_functions(lambda rng, x: stats.norm.rvs(x)),
        "repeated with the same generator",
    ),
    "a counter": (by_functions(Counting()), "repeated with the same generator"),
    "a number of particles in the closure": (by_functions(lambda rng, x: x + rng.normal(size=100)), "fails for 64"),
    "a density of the mean of all": (
        by_functions(log_transition=lambda old, new: stats.norm.logpdf(new, 0.9 * old.mean(), 0.5)),
        "the transition density of particle",
    ),
}
GUIDES = {
    "a mean": (
        lambda x, y: Normal(x.mean(), 1.0),
        MOVES.replace("the transition", "the proposal") + "|the density of",
    ),
    "a maximum": (lambda x, y: Normal(x, abs(x).max()), MOVES + "|the density of the proposal"),
    "a bounded interval": (lambda x, y: Uniform(0.9 * x - 0.5, 0.9 * x + 0.5), "never draws values that hold"),
    "an interval around the observation": (lambda x, y: Uniform(y - 0.6, y + 0.6), "never draws values that hold"),
    "positive values": (lambda x, y: stats.expon(loc=0.9 * x), "never draws values that hold"),
    "another generator": (
        lambda x, y: Normal(x + OTHER.normal(size=len(x)), 1.0),
        "repeated with the same generator",
    ),
}


@pytest.mark.parametrize("name", FAULTY)
def test_a_fault_of_a_model_is_named(name):
    model, expected = FAULTY[name]
    filter = bootstrap(model, 100)
    with pytest.raises(InputError, match=rf"^step [012], (initial|transition|update): .*({expected})"):
        filter.run(YS, 0)
    with pytest.raises(InputError, match=expected):
        run_many(filter, YS, range(3))
    state = filter.start(0)
    with pytest.raises(InputError, match=expected):
        for y in YS:
            state, _ = filter.step(state, y)


@pytest.mark.parametrize("n", [10, 5000])
@pytest.mark.parametrize("name", [name for name in FAULTY if "in the closure" not in name])
def test_a_fault_is_named_for_few_and_for_many_particles(name, n):
    model, expected = FAULTY[name]
    with pytest.raises(InputError, match=expected):
        bootstrap(model, n).run(YS, 1)


@pytest.mark.parametrize("name", GUIDES)
def test_a_fault_of_a_proposal_is_named(name):
    proposal, expected = GUIDES[name]
    with pytest.raises(InputError, match=rf"^step 1, transition: .*({expected})"):
        guided(RIGHT_Q, proposal, 100).run(YS, 0)


def test_faults_of_an_initial_proposal_and_of_a_priority_are_named():
    with pytest.raises(InputError, match="step 0, initial: the proposal never draws"):
        guided(RIGHT_Q, None, 100, lambda y: Uniform(y - 0.5, y + 0.5)).run(YS, 0)
    with pytest.raises(InputError, match="step 1, lookahead: the log priority of particle"):
        auxiliary(RIGHT_Q, lambda x, y: -((x.mean() - y) ** 2) - x**2, 100).run(YS, 0)


@pytest.mark.parametrize("n", [2, 3, 64, 100])
def test_an_observation_that_aligns_with_particles_is_named(n):
    with pytest.raises(InputError, match="the log likelihood fails|log likelihood of"):
        bootstrap(by_functions(), n).run([np.linspace(0, 1, n)] * 3, 0)


def test_particles_that_are_equal_at_first_are_examined_later():
    start = by_functions(lambda rng, x: x.mean() + rng.normal(size=len(x)), initial=lambda rng, n: np.zeros(n))
    with pytest.raises(InputError, match="step 2, transition: .*differently among others"):
        bootstrap(start, 100).run(YS, 0)


def jump(rng, x):
    """Numbers of draws that depend on values."""
    return x + rng.gamma(0.5 + abs(x)) - rng.poisson(abs(x))


def by_one(rng, x):
    return np.array([v + rng.normal() * (1 if rng.random() < 0.5 else 3) for v in x])


def lazily(rng, x):
    moves = rng.random(len(x)) < 0.5
    new = x.copy()
    new[moves] += rng.normal(size=moves.sum())
    return new


def hmm(rng, k):
    return (rng.random(len(k))[:, None] > np.cumsum(np.array([[0.9, 0.1], [0.2, 0.8]])[k], axis=1)).sum(axis=1)


WEIGHTS = np.random.default_rng(2).normal(size=(2, 40)).astype(np.float32)
RIGHT = {
    "densities": of(),
    "heavy tails": of(lambda x: Student(3.0, 0.9 * x, 0.5)),
    "scipy": of(lambda x: stats.laplace(0.9 * x, 0.5), lambda x: stats.norm(x, 1.0), stats.norm(0, 1)),
    "functions": by_functions(),
    "no noise": by_functions(lambda rng, x: 0.9 * x),
    "numbers of draws that depend on values": by_functions(jump),
    "a loop over particles": by_functions(by_one),
    "a draw for some particles": by_functions(lazily),
    "a partial": by_functions(functools.partial(lambda rng, x, a: a * x + rng.normal(size=x.shape), a=0.9)),
    "integers": by_functions(hmm, lambda k, y: stats.norm.logpdf(y, k), lambda rng, n: rng.integers(0, 2, n)),
    "rare jumps of integers": by_functions(
        lambda rng, k: k ^ (rng.random(len(k)) < 0.001), lambda k, y: -k * 0.1, lambda rng, n: rng.integers(0, 2, n)
    ),
    "booleans": by_functions(
        lambda rng, k: k ^ (rng.random(len(k)) < 0.1),
        lambda k, y: np.where(k, -0.1, -0.2),
        lambda rng, n: rng.random(n) < 0.3,
    ),
    "vectors": vectors(lambda rng, x: x @ np.array([[0.9, 0.1], [0.0, 0.8]]) + rng.normal(size=x.shape)),
    "a deterministic coordinate": vectors(
        lambda rng, x: np.column_stack([x[:, 0] + x[:, 1], x[:, 1] + rng.normal(size=len(x))])
    ),
    "single precision": vectors(
        lambda rng, x: np.tanh(x.astype(np.float32) @ WEIGHTS) @ WEIGHTS.T / 40 + rng.normal(size=x.shape),
        lambda x, y: -100 * np.square(np.float32(y) - np.tanh(x.astype(np.float32) @ WEIGHTS)[:, 0]).astype(float),
    ),
    "a mapping": StateSpaceModel(
        lambda rng, n: {"a": rng.normal(size=n), "k": rng.integers(0, 3, n)},
        lambda rng, x: {"a": x["a"] + rng.normal(size=len(x["a"])), "k": x["k"]},
        lambda x, y: -((x["a"] - y * x["k"]) ** 2),
    ),
    "objects": StateSpaceModel(
        lambda rng, n: tuple((rng.normal(),) for _ in range(n)),
        lambda rng, xs: tuple((*x, rng.normal()) if rng.random() < 0.5 else x for x in xs),
        lambda xs, y: np.array([-((sum(x) - y) ** 2) for x in xs]),
    ),
    "a static parameter": StateSpaceModel(
        lambda rng, n: np.column_stack([rng.normal(size=n), rng.gamma(2.0, size=n)]),
        lambda rng, x: np.column_stack([x[:, 0] + x[:, 1] * rng.normal(size=len(x)), x[:, 1]]),
        lambda x, y: -0.5 * (x[:, 0] - y) ** 2,
    ),
    "the same start for all": by_functions(initial=lambda rng, n: np.zeros(n)),
    "a shared covariance": of(
        lambda x: MultivariateNormal(x, np.eye(2)),
        lambda x: Normal(x[:, 0], 1.0),
        MultivariateNormal(np.zeros(2), np.eye(2)),
    ),
    "missing values in the state": vectors(
        lambda rng, x: np.column_stack([np.where(x[:, 0] > 0, x[:, 0], np.nan), x[:, 1] + rng.normal(size=len(x))]),
        lambda x, y: -0.5 * (x[:, 1] - y) ** 2,
    ),
    "discrete observations": of(observation=lambda x: Bernoulli(1 / (1 + np.exp(-x)))),
    "a distribution that ignores the state": of(lambda x: Normal(0.0 * x, 1.0)),
    "categories": StateSpaceModel.of(
        Categorical([0.5, 0.5]),
        lambda k: Categorical(np.array([[0.9, 0.1], [0.2, 0.8]])[k]),
        lambda k: Normal(1.0 * k, 1.0),
    ),
}


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_model_runs(name):
    ys = [1, 0, 1] if name == "discrete observations" else YS
    for n, seed in itertools.product((1, 2, 3, 5, 64, 200), range(3)):
        examined, _ = bootstrap(RIGHT[name], n).run(ys, seed)
        with unexamined():
            plain, _ = bootstrap(RIGHT[name], n).run(ys, seed)
        assert examined.log_evidence == plain.log_evidence  # an examination changes nothing


@pytest.mark.parametrize("name", RIGHT)
def test_check_finds_nothing_in_a_right_model(name):
    ys = [1, 0, 1] if name == "discrete observations" else YS
    contract = type("Contract", (ModelContract,), {"observations": ys})
    assert [result for result in check_properties(RIGHT[name], contract) if result.failure] == []


def test_check_accepts_a_model_in_which_most_particles_may_have_weight_0():
    contract = type("Contract", (ModelContract,), {"observations": [0.3, 1.5, 1.0]})
    model = of(observation=lambda x: Uniform(x - 0.3, x + 0.3))
    assert [result for result in check_properties(model, contract) if result.failure] == []


def test_check_draws_observations_from_the_model_or_asks_for_them():
    assert all(result.failure is None for result in check_properties(of(), ModelContract))
    (first, *_) = check_properties(by_functions(), ModelContract)
    assert "no sample_observation" in first.failure and "--observations" in first.failure


WRONG_DENSITIES = {
    "a variance for a standard deviation": lambda old, new: stats.norm.logpdf(new, 0.9 * old, 0.25),
    "a shift": lambda old, new: stats.norm.logpdf(new, 0.9 * old + 0.1, 0.5),
    "the arguments in the other order": lambda old, new: stats.norm.logpdf(old, 0.9 * new, 0.5),
    "no constant": lambda old, new: -0.5 * ((new - 0.9 * old) / 0.5) ** 2,
    "no logarithm": lambda old, new: stats.norm.pdf(new, 0.9 * old, 0.5),
}


@pytest.mark.parametrize("name", WRONG_DENSITIES)
def test_check_compares_draws_with_densities(name):
    contract = type("Contract", (ModelContract,), {"observations": YS})
    model = by_functions(log_transition=WRONG_DENSITIES[name])
    assert any("do not have its density" in (r.failure or "") for r in check_properties(model, contract))
    right = by_functions(log_transition=lambda old, new: stats.norm.logpdf(new, 0.9 * old, 0.5))
    assert not any(r.failure for r in check_properties(right, contract))


def test_check_finds_noise_that_depends_on_the_place():
    contract = type("Contract", (ModelContract,), {"observations": YS})
    model = by_functions(lambda rng, x: x + np.linspace(0.5, 1.5, len(x)) * rng.normal(size=len(x)))
    assert any("differently at place" in (r.failure or "") for r in check_properties(model, contract))


def test_inputs_reach_the_examination():
    model = StateSpaceModel.of(X0, lambda x, t, u: Normal(x + u, 0.5 + 0.1 * t), lambda x: Normal(x, 1.0))
    bootstrap(model, 50).run([WithInput(y, 0.3) for y in YS], 0)
    mixed = StateSpaceModel.of(X0, lambda x, u: Normal(x.mean() + u + 0 * x, 0.5), lambda x: Normal(x, 1.0))
    with pytest.raises(InputError, match="step 1, transition"):
        bootstrap(mixed, 50).run([WithInput(y, 0.3) for y in YS], 0)

"""Inference against exact posteriors: Kalman evidence on a grid, all paths of a hidden chain, conjugate normals.

Chi-square tests at 1e-4, means at 5 standard errors: false alarm below 2e-3 for the file.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.smc import (
    Branching,
    Categorical,
    ConditionallyLinear,
    Dynamics,
    Gamma,
    Kld,
    LargestWeights,
    Linear,
    MultivariateNormal,
    Normal,
    Population,
    Product,
    Program,
    Proposal,
    Reweight,
    Sized,
    StateSpaceModel,
    Transition,
    Uniform,
    auxiliary,
    bootstrap,
    conditional_path,
    ensemble,
    guided,
    kalman_filter,
    observe,
    particle_gibbs,
    path_log_prob,
    pmmh,
    rao_blackwellised,
    sample,
    smc2,
    switch,
)
from tests.smc.models import (
    AR1,
    BOXES,
    EMIT,
    MOVES,
    SD0,
    SIGMA,
    START,
    TAU,
    ar1_observations,
    hmm,
    predictive,
    states_of,
)

# --- conditional SMC: sweeps from an exact path give an exact path -------------------------------------------------

SYMBOLS = [1, 3, None]
PATHS = np.array(list(product(range(3), repeat=len(SYMBOLS))))
_P = START[PATHS[:, 0]] * np.prod([MOVES[PATHS[:, t], PATHS[:, t + 1]] for t in range(len(SYMBOLS) - 1)], axis=0)
JOINT = _P * np.prod([EMIT[PATHS[:, t], y] for t, y in enumerate(SYMBOLS) if y is not None], axis=0)
LOOK = np.array([[0.15, 0.25, 0.6], [0.6, 0.2, 0.2], [0.1, 0.8, 0.1]])  # a poor guide


def chain(previous, y):
    k = sample("k", Categorical(START if previous is None else MOVES[previous["k"]]))
    observe("y", Categorical(EMIT[k]), y)


def keeping(previous, y):
    chain(previous, y)
    return None if previous is None else {"age": np.full(len(previous["k"]), 1.0)}


def branching(previous, y):
    """The same chain: the switch chooses the state, and each branch observes."""

    def branch(k):
        return lambda: observe("y", Categorical(EMIT[k]), y)

    switch("k", START if previous is None else MOVES[previous["k"]], [branch(k) for k in range(3)])


def guide(previous, y):
    sample("k", Categorical(LOOK[0] if previous is None else LOOK[previous["k"]]))


def look(x, y):
    return Categorical(LOOK[x])


VECTOR = hmm("vector")
CONDITIONAL = {  # two particles: an error of the weights shows
    "vector": bootstrap(VECTOR, 2),
    "mapping": bootstrap(hmm("mapping"), 2),
    "objects": bootstrap(hmm("objects"), 2),
    "no density": bootstrap(replace(VECTOR, log_transition=None), 2),
    "guided": guided(VECTOR, look, 2, lambda y: Categorical(LOOK[0])),
    "program": Program(chain).bootstrap(2),
    "guided program": Program(chain).guided(guide, 2),
    "switch": Program(branching).bootstrap(2),
    "returned values": Program(keeping).bootstrap(2),
}


def as_path(name, states):
    """The states (T,) as a path of particles of a filter."""
    if name == "objects":
        return tuple(BOXES[k] for k in states)
    if name == "mapping":
        return {"k": states, "twice": np.stack([states] * 2, 1)}
    if name == "returned values":
        return {"k": states, "age": np.arange(len(states))}
    return {"k": states} if name in ("program", "guided program", "switch") else states


@pytest.mark.parametrize("name", ["vector", pytest.param("no density", marks=pytest.mark.nightly), "guided"])
def test_conditional_smc_keeps_the_law_of_paths(name):
    """Chi-square of the paths after three sweeps from paths that are drawn from the exact posterior."""
    n = 300
    starts = np.random.default_rng(1).choice(len(PATHS), n, p=JOINT / JOINT.sum())
    counts, moved = np.zeros(len(PATHS)), 0
    for seed, k in enumerate(starts):
        path = as_path(name, PATHS[k])
        for sweep in range(3):
            path = conditional_path(CONDITIONAL[name], SYMBOLS, 3 * seed + sweep, path)
        end = states_of(path)
        counts[int(end @ [9, 3, 1])] += 1
        moved += not np.array_equal(end, PATHS[k])
    expected = n * JOINT / JOINT.sum()
    often = expected > 4
    found = np.append(counts[often], counts[~often].sum())
    assert stats.chisquare(found, np.append(expected[often], expected[~often].sum())).pvalue > 1e-4
    assert moved > 0.2 * n


@pytest.mark.parametrize(
    ("name", "same"),
    [
        ("mapping", "vector"),
        ("objects", "vector"),
        ("program", "vector"),
        ("switch", "vector"),
        ("returned values", "no density"),
        ("guided program", "guided"),
    ],
)
def test_conditional_smc_is_the_same_for_every_form_of_a_model(name, same):
    """The same paths from the same streams, in chains of 30 sweeps; values that a program returns have no density."""
    one, other = (conditional_path(CONDITIONAL[form], SYMBOLS) for form in (name, same))
    distinct = set()
    for seed in range(30):
        one = conditional_path(CONDITIONAL[name], SYMBOLS, seed, one)
        other = conditional_path(CONDITIONAL[same], SYMBOLS, seed, other)
        np.testing.assert_array_equal(states_of(one), other)
        distinct.add(tuple(other))
    assert len(distinct) >= 3


def test_path_log_prob_is_the_joint_density():
    for name in ("vector", "mapping", "objects", "guided", "program", "switch"):
        for k in (4, 13, 24):
            path = as_path(name, PATHS[k])
            with np.errstate(divide="ignore"):
                assert path_log_prob(CONDITIONAL[name], SYMBOLS, path) == pytest.approx(np.log(JOINT[k]), abs=1e-12)


def test_what_has_no_conditional_form():
    ys = ar1_observations(3)
    for filter, message in (
        (auxiliary(AR1, predictive, 5), "a filter with `lookahead`"),
        (bootstrap(AR1, 5, LargestWeights()), "not properly weighted"),
        (bootstrap(AR1, 1), "n is 1"),
        (replace(bootstrap(AR1, 5), transition=Branching(Dynamics(AR1))), "transition made 20 particles of 5"),
        (replace(bootstrap(AR1, 5), transition=Drift()), "Drift that weights its particles"),
    ):
        with pytest.raises(InputError, match=message):
            conditional_path(filter, ys, 0, np.zeros(3))
    with pytest.raises(InputError, match="3 observations for a path of 2 states"):
        conditional_path(bootstrap(AR1, 5), ys, 0, np.zeros(2))
    with pytest.raises(InputError, match="there are 0 observations"):
        conditional_path(bootstrap(AR1, 5), [])
    with pytest.raises(InputError, match="densities are not known"):
        path_log_prob(replace(bootstrap(AR1, 5), initial=Drawn()), ys, np.zeros(3))
    for n in (2, 4):
        with pytest.raises(InputError, match=f"there are 3 observations for a path of {n} states"):
            path_log_prob(bootstrap(AR1, 5), ys, np.zeros(n))


@dataclass(frozen=True)
class Rebuilds(Reweight):
    """Weights as `Reweight`, in a population with new arrays; `shift` moves the particles."""

    shift: float = 0.0

    def update(self, rng, predicted, proposed, observation):
        found = super().update(rng, predicted, proposed, observation)
        return Population(found.particles + self.shift, found.log_weights)


def test_an_update_that_changes_particles_has_no_conditional_form():
    """A given path would be updated again. An update that returns equal particles in new arrays is accepted."""
    linear = ConditionallyLinear(
        lambda rng, n: np.zeros(n),
        lambda rng, u: u,
        lambda u: Linear([[1.0]], [[1.0]], [[1.0]], [[1.0]]),
        [0.0],
        [[1]],
    )
    ys, filter = ar1_observations(3), bootstrap(AR1, 5)
    shifting = replace(filter, update=Rebuilds(AR1.log_likelihood, shift=1.0))
    for wrong in (rao_blackwellised(linear, 5), shifting):
        with pytest.raises(InputError, match="step 0: the update changes the particles"):
            conditional_path(wrong, ys)
    rebuilding = replace(filter, update=Rebuilds(AR1.log_likelihood))
    for path in (None, np.zeros(3)):
        found = [conditional_path(f, ys, 1, path) for f in (filter, rebuilding)]
        np.testing.assert_array_equal(*found)


def test_parameters_that_are_drawn_in_place_are_counted():
    """Each draw changes the array that it gets, or always returns the same array: all are new parameters."""
    buffer = np.zeros(1)

    def in_place(rng, theta, path):
        theta += 0.01
        return theta

    def returned(rng, theta, path):
        buffer[:] = rng.random()
        return buffer

    for draw in (in_place, returned):
        chains = particle_gibbs(filter_of, YS, draw, [0.5], 5)
        assert chains.accepted.tolist() == [1.0] and len(set(chains.theta[:, 0, 0].tolist())) == 5


@dataclass(frozen=True)
class Drift(Transition):
    def predict(self, rng, population, observation):
        return population.reweighted(np.ones(len(population)))


@dataclass(frozen=True)
class Drawn(Proposal):
    def sample(self, rng, observation, n):
        return Population(rng.standard_normal(n))


# --- the coefficient of an AR(1) process, against Kalman evidence on a grid ---------------------------------------

YS = ar1_observations(6, seed=9)


def log_prior(theta):
    """Of N(0.4, 0.4^2), without its constant."""
    return -0.5 * ((theta[0] - 0.4) / 0.4) ** 2


def filter_of(theta, n=30):
    """Works for one coefficient and, with arrays (1, m), for the particles of several runs."""
    (rho,) = theta
    model = StateSpaceModel(
        lambda rng, n: SD0 * rng.standard_normal(n),
        lambda rng, x: rho * x + SIGMA * rng.standard_normal(x.shape),
        lambda x, y: -0.5 * ((y - x) / TAU) ** 2 - np.log(TAU * np.sqrt(2 * np.pi)),
        lambda x: stats.norm(0, SD0).logpdf(x),
        lambda old, new: -0.5 * ((new - rho * old) / SIGMA) ** 2,
    )
    return bootstrap(model, n)


def kalman(rho):
    return kalman_filter([[rho]], [[SIGMA**2]], [[1.0]], [[TAU**2]], [0.0], [[SD0**2]], YS).log_evidence[-1]


GRID = np.linspace(-1.5, 2.2, 150)
POSTERIOR = np.exp([kalman(rho) for rho in GRID]) * np.exp(log_prior([GRID]))
MEAN = POSTERIOR @ GRID / POSTERIOR.sum()
SQUARE = POSTERIOR @ (GRID - MEAN) ** 2 / POSTERIOR.sum()


def agrees(means, squares):
    """Whether independent estimates of the mean and of the mean square around it agree with the grid."""
    found = np.stack([means, squares], axis=1)
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    return (np.abs(found.mean(axis=0) - [MEAN, SQUARE]) < 6 * error).all() and (error < [0.05, 0.03]).all()


STARTS = np.random.default_rng(0).normal(MEAN, np.sqrt(SQUARE), (40, 1))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("batched", [False, True])
def test_pmmh_rejects_parameters_for_which_the_model_is_invalid(batched):
    """Above .6, the noise is 0 for some particles. The posterior is that of the prior without these values."""

    def filter_of(theta):
        noise = np.where(np.asarray(theta) > 0.6, 0.0, 1.0)
        model = StateSpaceModel.of(
            Normal(), lambda x: Normal(theta * x, 0.5), lambda x: Normal(x, noise * (1 + 0 * x))
        )
        return bootstrap(model, 10)

    prior, start = Uniform(0.0, 1.0), [[0.2], [0.5]]
    with pytest.raises(InputError, match=r"parameters \[0\.[6-9]"):
        pmmh(filter_of, [0.1, 0.2], prior, start, 0.5, 30, batched=batched)
    with pytest.warns(InputWarning, match="proposals were rejected because the model is invalid"):
        chains = pmmh(filter_of, [0.1, 0.2], prior, start, 0.5, 30, batched=batched, invalid="reject")
    assert chains.theta.max() <= 0.6 and len(np.unique(chains.theta)) > 5
    with pytest.raises(InputError, match="invalid is 'skip', expected raise or reject"):
        pmmh(filter_of, [0.1], prior, start, 0.5, 1, invalid="skip")
    with pytest.raises(InputError, match=r"\[0.9\]"):  # a start must be valid
        pmmh(filter_of, [0.1], prior, [[0.9]], 0.5, 1, batched=batched, invalid="reject")

    def strict(theta):
        if np.max(theta) > 0.6:
            raise InputError("too large")
        return filter_of(theta)

    with pytest.warns(InputWarning, match="proposals were rejected because the model is invalid"):
        chains = pmmh(strict, [0.1, 0.2], prior, start, 0.5, 30, batched=batched, invalid="reject")
    assert chains.theta.max() <= 0.6 and len(np.unique(chains.theta)) > 5


def test_pmmh_has_the_exact_posterior():
    """With only ten particles: the noise of the evidence slows the chain and does not bias it."""
    chains = pmmh(lambda theta: filter_of(theta, 10), YS, log_prior, STARTS, 0.5, 120, batched=True)
    rho = chains.theta[:, :, 0]
    assert agrees(rho.mean(axis=0), ((rho - MEAN) ** 2).mean(axis=0))
    assert 0.2 < chains.accepted.mean() < 0.8
    # An estimate changes exactly when the parameters do.
    same = (chains.theta[1:] == chains.theta[:-1])[:, :, 0]
    assert (same == (chains.log_evidence[1:] == chains.log_evidence[:-1])).all()
    density = log_prior([rho]) + chains.log_evidence
    np.testing.assert_allclose(chains.log_density, density)
    assert 1 < chains.autocorrelation_times()[0] < 30 and chains.effective_sizes(20)[0] > 100


def test_emcee_over_the_evidence_has_the_exact_posterior():
    evaluated = []

    def counted(theta):
        evaluated.append(1)
        return log_prior(theta)

    means, squares = [], []
    for seed in range(4):
        chains = ensemble(filter_of, YS, counted, STARTS[:16], 40, seed, batched=True)
        rho = chains.theta[10:, :, 0]
        means.append(rho.mean())
        squares.append(((rho - MEAN) ** 2).mean())
    assert agrees(np.array(means), np.array(squares))
    # Each walker is evaluated at the start and at each proposal, never again where it stays.
    assert sum(evaluated) == 4 * 16 * (40 + 1)
    same = (chains.theta[1:] == chains.theta[:-1])[:, :, 0]
    assert same.any() and (same == (chains.log_evidence[1:] == chains.log_evidence[:-1])).all()
    again = ensemble(filter_of, YS, log_prior, STARTS[:16], 3, 3, batched=True)
    np.testing.assert_array_equal(again.theta, chains.theta[:3])


def conjugate(rng, theta, path):
    """p(rho | x_0 .. x_T), a normal distribution."""
    old, new = path[:-1], path[1:]
    precision = 1 / 0.4**2 + old @ old / SIGMA**2
    return [rng.normal((0.4 / 0.4**2 + old @ new / SIGMA**2) / precision, precision**-0.5)]


def metropolis(rng, theta, path):
    """A Metropolis step on rho that knows only the density of the path."""
    new = theta + 0.5 * rng.standard_normal(1)
    gain = path_log_prob(filter_of(new), YS, path) - path_log_prob(filter_of(theta), YS, path)
    return new if np.log(rng.random()) < gain + log_prior(new) - log_prior(theta) else theta


@pytest.mark.parametrize(
    ("draw", "n_iterations"), [(conjugate, 50), pytest.param(metropolis, 30, marks=pytest.mark.nightly)]
)
def test_particle_gibbs_has_the_exact_posterior(draw, n_iterations):
    means, squares = [], []
    for seed in range(10):
        chains = particle_gibbs(lambda theta: filter_of(theta, 5), YS, draw, STARTS[seed], n_iterations, seed)
        rho = chains.theta[:, 0, 0]
        means.append(rho.mean())
        squares.append(((rho - MEAN) ** 2).mean())
    assert agrees(np.array(means), np.array(squares))
    assert len(chains.paths) == n_iterations and chains.paths[0].shape == (6,)
    assert chains.accepted == 1 or draw is metropolis


def test_what_chains_reject():
    with pytest.raises(InputError, match="start .* has log density -inf"):
        pmmh(filter_of, YS, lambda theta: -np.inf, [0.1], 0.5, 5)
    with pytest.raises(InputError, match="log prior of .* is NaN"):
        pmmh(filter_of, YS, lambda theta: np.nan, [0.1], 0.5, 5)
    for scale in (0.0, [0.1, 0.2], [[-1.0]]):
        with pytest.raises(InputError, match="scale is"):
            pmmh(filter_of, YS, log_prior, [0.1], scale, 5)
    with pytest.warns(UserWarning, match="one by one: a component looks at several particles"):
        pmmh(
            lambda theta: bootstrap(AR1, 5, Sized(size=Kld(n_min=2, n_max=9))),
            YS,
            log_prior,
            [0.1],
            0.5,
            5,
            batched=True,
        )
    with pytest.raises(InputError, match="not properly weighted"):
        pmmh(lambda theta: bootstrap(AR1, 5, LargestWeights()), YS, log_prior, [0.1], 0.5, 5)
    with pytest.raises(InputError, match=r"start has shape \(1, 1\)"):
        ensemble(filter_of, YS, log_prior, [[0.1]], 5)
    with pytest.raises(InputError, match=r"draw returned parameters of shape \(2,\)"):
        particle_gibbs(filter_of, YS, lambda rng, theta, path: [1.0, 2.0], [0.1], 5)


@pytest.mark.parametrize("observations", [{0: 5.0, 1: 6.0}, [np.ma.array([0.2, 999.0], mask=[False, True])], "5.6"])
def test_observations_are_checked(observations):
    """Iteration would filter the keys of a mapping, and the masked values."""

    def filter_of(theta):
        return bootstrap(AR1, 4)

    with pytest.raises(InputError, match="observations are|masked"):
        pmmh(filter_of, observations, lambda theta: 0.0, [0.5], [0.1], 2)
    with pytest.raises(InputError, match="observations are|masked"):
        ensemble(filter_of, observations, lambda theta: 0.0, [[0.5], [0.6]], 2)


def test_without_observations_a_batched_chain_samples_the_prior():
    def log_prior(theta):
        return float(-0.5 * theta[0] ** 2)

    chains = pmmh(lambda theta: bootstrap(AR1, 4), [], log_prior, [0.5], [0.1], 3, batched=True)
    np.testing.assert_array_equal(chains.log_evidence, 0.0)


def test_a_path_survives_if_all_free_particles_have_weight_zero():
    """A uniform walk with a wide proposal and two particles: the free particle is often impossible."""
    model = StateSpaceModel.of(Uniform(0.0, 1.0), lambda x: Uniform(x - 0.5, x + 0.5), lambda x: Normal(x, 1.0))
    filter = guided(model, lambda x, y: Normal(x, 2.0), 2)
    path, paths = np.array([0.5, 0.6, 0.7]), []
    for seed in range(1500):
        path = conditional_path(filter, [0.5, 0.5, 0.5], seed, path)
        paths.append(path)
    # x_0 by the exact law, on a grid: p(x_0) times the likelihoods of all paths
    grid = np.linspace(-1, 2, 301)
    move = (np.abs(grid[:, None] - grid) <= 0.5).astype(float)
    like = np.exp(-0.5 * (grid - 0.5) ** 2)
    law = ((grid >= 0) & (grid <= 1)) * like * (move @ (like * (move @ like)))
    mean = (grid * law).sum() / law.sum()
    assert np.mean([p[0] for p in paths]) == pytest.approx(mean, abs=0.07)


@pytest.mark.parametrize("infer", [pmmh, ensemble, particle_gibbs])
def test_parameters_are_numbers(infer):
    """What is no number is refused before the first run of a filter."""

    def call(start, **given):
        arguments = {"prior": lambda theta: 0.0, "scale": [0.1, 0.1], "draw": None, "n_iterations": 3}
        taken = inspect.signature(infer).parameters
        named = {name: value for name, value in {**arguments, **given}.items() if name in taken}
        infer(lambda theta: None, [0.0], start=start, **named)

    with pytest.raises(InputError, match="start is 'rho', expected an array of numbers"):
        call("rho")
    with pytest.raises(InputError, match="expected finite numbers"):
        call([0.5, np.nan])
    with pytest.raises(InputError, match="start has shape"):
        call(np.zeros((2, 3, 4)))
    if infer is particle_gibbs:
        with pytest.raises(InputError, match="start is a mapping with the keys rho, sigma"):
            call({"rho": 0.5, "sigma": 1.0})
        return
    with pytest.raises(InputError, match="start has the names .'rho'., expected .'rho', 'sigma'."):
        call({"rho": 0.5}, prior={"rho": Normal(), "sigma": Gamma(1.0)})
    with pytest.raises(InputError, match="start of rho has shape .2, 2., expected one number per chain"):
        call({"rho": np.zeros((2, 2))})
    with pytest.raises(InputError, match="start has arrays of different lengths"):
        call({"rho": np.zeros(2), "sigma": np.zeros(3)})
    with pytest.raises(InputError, match="start is missing"):
        call(None)
    with pytest.raises(InputError, match="expected a distribution, found a builtins.float"):
        call([0.1, 0.2], prior=0.5)
    vectors = {"rho": Normal(np.zeros((1, 3)), 1.0), "sigma": Gamma(1.0)}
    for given in (np.zeros(2), np.zeros((2, 2)), np.zeros((2, 3, 1))):
        with pytest.raises(InputError, match=r"start of rho has shape .*, expected \(3,\) or \(chains, 3\)"):
            call({"rho": given, "sigma": 1.0}, prior=vectors)
    if infer is pmmh:
        with pytest.raises(InputError, match="scale is a mapping with the keys rho, sigma"):
            call([0.5, 1.0], scale={"rho": 0.1, "sigma": 0.1})
        with pytest.raises(InputError, match=r"the log prior has shape \(2,\)"):
            call([0.5, 1.0], prior=Normal([0.0, 0.0], 1.0))
        with pytest.raises(InputError, match="scale is missing"):
            call([0.5, 1.0], scale=None)


def named_filter(theta):
    """The AR(1) filter whose coefficient has a name, and whose noise is known."""
    assert set(theta) == {"rho", "tau"}
    return filter_of([theta["rho"]])


PRIOR = {"rho": Normal(0.4, 0.4), "tau": Gamma(2.0, 0.5)}


def test_names_of_parameters_are_kept():
    """The chain of named parameters is that of the array, bit for bit; a parameter without data keeps its prior."""

    def by_array(theta):
        return filter_of(theta[:1])

    def log_density(theta):
        return stats.norm.logpdf(theta[0], 0.4, 0.4) + stats.gamma.logpdf(theta[1], 2.0, scale=0.5)

    start, scale = {"tau": [0.5, 1.0], "rho": 0.4}, {"tau": 0.3, "rho": 0.5}
    named = pmmh(named_filter, YS, PRIOR, start, scale, 20)
    plain = pmmh(by_array, YS, log_density, [[0.4, 0.5], [0.4, 1.0]], [0.5, 0.3], 20)
    np.testing.assert_array_equal(named.theta, plain.theta)
    np.testing.assert_allclose(named.log_density, plain.log_density)
    np.testing.assert_array_equal(named["tau"], named.theta[:, :, 1])
    assert named.names == ("rho", "tau") and plain.names == () and "rho, tau, accepted" in repr(named)
    assert list(named.columns()) == ["chain", "draw", "rho", "tau", "log_evidence", "log_density"]
    with pytest.raises(KeyError, match="no parameter 'sigma'; there are: rho, tau"):
        named["sigma"]
    function = pmmh(named_filter, YS, lambda theta: log_density([theta["rho"], theta["tau"]]), start, scale, 20)
    assert function.names == ("tau", "rho")  # without a distribution, the names are those of the start


@pytest.mark.parametrize("batched", [False, True])
def test_parameters_with_names_may_be_vectors(batched):
    """The chain of a vector with a name is that of its entries, bit for bit."""
    seen = []

    def of_vectors(theta):
        seen.append(np.shape(theta["b"])[:1])
        return filter_of([theta["b"][0]])

    vectors = {"tau": PRIOR["tau"], "b": MultivariateNormal([0.4, 0.0], [[0.16, 0.0], [0.0, 1.0]])}
    entries = {"tau": PRIOR["tau"], "b0": Normal(0.4, 0.4), "b1": Normal(0.0, 1.0)}
    start, scale = {"tau": [0.5, 1.0], "b": [[0.4, 0.1], [0.3, 0.2]]}, {"tau": 0.3, "b": [0.5, 0.1]}
    found = pmmh(of_vectors, YS, vectors, start, scale, 20, batched=batched)
    alone = pmmh(
        lambda theta: filter_of([theta["b0"]]),
        YS,
        entries,
        {"tau": [0.5, 1.0], "b0": [0.4, 0.3], "b1": [0.1, 0.2]},
        {"tau": 0.3, "b0": 0.5, "b1": 0.1},
        20,
        batched=batched,
    )
    assert set(seen) == {(2,)} and found.names == ("tau", "b")
    np.testing.assert_array_equal(found.theta, alone.theta)
    np.testing.assert_array_equal(found["b"], np.stack([alone["b0"], alone["b1"]], axis=-1))
    np.testing.assert_array_equal(found["tau"], alone["tau"])
    assert list(found.columns())[2:5] == ["tau", "b_0", "b_1"]
    one = pmmh(of_vectors, YS, vectors, scale={"tau": 0.1, "b": 0.1}, n_iterations=2, n_chains=3, batched=batched)
    assert one["b"].shape == (2, 3, 2)
    walkers = ensemble(of_vectors, YS, vectors, n_iterations=2, batched=batched)
    assert walkers["b"].shape == (2, 12, 2)


def test_first_parameters_are_draws_from_the_prior():
    one = pmmh(named_filter, YS, PRIOR, scale={"rho": 1e-9, "tau": 1e-9}, n_iterations=1)
    assert one.theta.shape == (1, 1, 2) and one["tau"] > 0
    many = pmmh(named_filter, YS, PRIOR, scale=[0.1, 0.1], n_iterations=2, n_chains=3, batched=True)
    assert many.theta.shape == (2, 3, 2)
    walkers = ensemble(named_filter, YS, PRIOR, n_iterations=2)
    assert walkers.theta.shape == (2, 8, 2) and walkers.names == ("rho", "tau")
    assert ensemble(named_filter, YS, PRIOR, n_iterations=1, n_walkers=6).theta.shape == (1, 6, 2)
    vectors = pmmh(
        lambda theta: filter_of(theta[:1]), YS, Product([*PRIOR.values()]), scale=[0.1, 0.1], n_iterations=2
    )
    assert vectors.theta.shape == (2, 1, 2) and not vectors.names
    number = pmmh(lambda theta: filter_of([theta]), YS, stats.norm(0.4, 0.4), scale=0.1, n_iterations=2)
    assert number.theta.shape == (2, 1, 1)


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize(
    "prior, scale, rho_of",
    [
        (Normal(0.4, 0.4), 0.1, lambda theta: theta),
        (Product([*PRIOR.values()]), [0.1, 0.1], lambda theta: theta[0]),
        (PRIOR, {"rho": 0.1, "tau": 0.1}, lambda theta: theta["rho"]),
    ],
    ids=["number", "vector", "names"],
)
def test_parameters_have_one_form_everywhere(prior, scale, rho_of, batched):
    """`filter_of` gets the same kinds of parameters from `pmmh`, `ensemble` and `smc2`."""

    def kind(theta):
        if isinstance(theta, dict):
            return tuple((name, kind(value)) for name, value in theta.items())
        return "number" if isinstance(theta, float) else f"array of {theta.ndim} axes"

    def kinds(run, **named):
        seen = set()

        def watched(theta):
            seen.add(kind(theta))
            return filter_of([rho_of(theta)], n=5)

        run(watched, YS[:2], prior, batched=batched, **named)
        return seen

    found = kinds(smc2, n=10, steps=1)
    assert len(found) == 1 + batched  # of one filter, and of all together
    assert kinds(pmmh, scale=scale, n_chains=2, n_iterations=2) == found
    assert kinds(ensemble, n_walkers=8, n_iterations=2) == found


def test_named_priors_have_the_exact_posterior():
    """In batches: rho against the grid; tau, of which the data say nothing, against its prior."""
    start = {"rho": STARTS[:, 0], "tau": np.random.default_rng(1).gamma(2.0, 0.5, 40)}
    chains = pmmh(named_filter, YS, PRIOR, start, {"rho": 0.5, "tau": 0.6}, 120, batched=True)
    rho, tau = chains["rho"], chains["tau"]
    assert agrees(rho.mean(axis=0), ((rho - MEAN) ** 2).mean(axis=0))
    means = tau.mean(axis=0)
    assert abs(means.mean() - 1.0) < 5 * means.std(ddof=1) / np.sqrt(40)

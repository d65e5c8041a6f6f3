"""Online sums and two-filter smoothing against all paths of a hidden chain, and against the RTS smoother.

z scores over independent runs. At every change: |z| < 4.5 with few seeds, false alarm below 1e-2 for the file. At
night: 200 runs of each setting at |z| < 3 (one scalar each, about 4 % for the 17 settings), with room for the bias of
order 1 / n.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Always,
    Categorical,
    Dynamics,
    Normal,
    Program,
    StateSpaceModel,
    WithInput,
    additive,
    bootstrap,
    genealogy,
    guided,
    kalman_filter,
    keep,
    linear_gaussian,
    observe,
    sample,
    two_filter,
)
from tests.smc.models import AR1, EMIT, MOVES, RHO, SD0, SIGMA, START, TAU, ar1_observations, hmm, optimal

YS = [*ar1_observations(3), None, *ar1_observations(12)[4:]]
BOUND = float(-np.log(SIGMA * np.sqrt(2 * np.pi)))

# --- exact answers ----------------------------------------------------------------------------------------------
SYMBOLS = [0, 2, None, 1, 3, 1]
PATHS = np.array(list(product(range(3), repeat=len(SYMBOLS))))
JOINT = START[PATHS[:, 0]] * np.prod([MOVES[PATHS[:, t], PATHS[:, t + 1]] for t in range(5)], axis=0)
JOINT = JOINT * np.prod([EMIT[PATHS[:, t], y] for t, y in enumerate(SYMBOLS) if y is not None], axis=0)
JOINT /= JOINT.sum()
JUMPS = float(JOINT @ (np.diff(PATHS, axis=1) != 0).sum(axis=1))
STATES = np.array([np.bincount(PATHS[:, t], JOINT, 3) for t in range(6)])  # (T, 3)


def smoothed_ar1():
    found = kalman_filter([[RHO]], [[SIGMA**2]], [[1.0]], [[TAU**2]], [0.0], [[SD0**2]], YS)
    return found.smoothed_means[:, 0], found.smoothed_covariances[:, 0, 0]


def jumps(previous, k):
    return np.zeros(len(k)) if previous is None else (previous != k).astype(float)


def itself(previous, x):
    return x


WAYS = {
    "paris": {},
    "paris, mcmc": {"backward": "mcmc", "steps": 2},
    "paris, rejection": {"backward": "rejection"},
    "forward": {"method": "forward"},
    "genealogy": {"method": "genealogy"},
}


def last(*arguments, **named):
    return list(additive(*arguments, **named))[-1]


def additive_chain(way, filter, seed):
    settings = {**WAYS[way], "log_bound": 0.0}
    return last(filter, SYMBOLS, jumps, Dynamics(hmm("vector")), seed, **settings) - JUMPS


def additive_ar1(way, filter, seed):
    settings = {**WAYS[way], "log_bound": BOUND}
    return last(filter, YS, itself, Dynamics(AR1), seed, **settings) - smoothed_ar1()[0].sum()


def reversed_chain(later, y):
    return Categorical(MOVES[:, later].T)


CHAIN, N = hmm("vector"), 150
FORWARD = {
    "bootstrap": bootstrap(AR1, N),
    "guided": guided(AR1, optimal, N),
    "after": replace(bootstrap(AR1, N, trigger=Always()), resample="after"),
}


def two_ar1(method, seed, forward="bootstrap"):
    """Summed errors of smoothed means and second moments."""
    found = two_filter(
        FORWARD[forward],
        YS,
        AR1,
        Normal(0.0, 1.2 * SD0),
        lambda later, y: Normal(RHO * later, 1.1 * SIGMA),
        seed,
        method,
    )
    mean, variance = smoothed_ar1()
    away = [p.particles - m for p, m in zip(found, mean, strict=True)]
    return sum(p.weights @ (a + a**2) for p, a in zip(found, away, strict=True)) - variance.sum()


def two_chain(method, seed):
    """Summed errors of the probabilities of state 1, weighted by time."""
    prior = Categorical([0.4, 0.4, 0.2])
    found = two_filter(bootstrap(CHAIN, N), SYMBOLS, CHAIN, prior, reversed_chain, seed, method)
    return sum((t + 1) * (p.weights @ (p.particles == 1) - STATES[t, 1]) for t, p in enumerate(found))


SETTINGS = {f"chain, {way}": lambda s, way=way: additive_chain(way, bootstrap(CHAIN, N), s) for way in WAYS}
SETTINGS |= {f"AR(1), {way}": lambda s, way=way: additive_ar1(way, FORWARD["bootstrap"], s) for way in WAYS}
SETTINGS |= {
    "AR(1), paris, guided": lambda s: additive_ar1("paris", FORWARD["guided"], s),
    "AR(1), paris, after": lambda s: additive_ar1("paris, mcmc", FORWARD["after"], s),
    "two filters, exact": lambda s: two_ar1("exact", s),
    "two filters, linear, guided": lambda s: two_ar1("linear", s, "guided"),
    "two filters, after": lambda s: two_ar1("exact", s, "after"),
    "two filters, chain": lambda s: two_chain("exact", s),
    "two filters, chain, linear": lambda s: two_chain("linear", s),
}


def z_score(name, seeds):
    found = np.array([SETTINGS[name](seed) for seed in seeds])
    spread = found.std(ddof=1)
    return max(abs(found.mean()) - spread**2 / 3 - 1 / N, 0.0) / (spread / np.sqrt(len(found)))


@pytest.mark.parametrize("name", SETTINGS)
def test_smoothers_are_exact(name):
    assert z_score(name, range(8)) < 4.5


@pytest.mark.nightly
@pytest.mark.parametrize("name", SETTINGS)
def test_smoothers_are_exact_at_night(name):
    assert z_score(name, range(100, 300)) < 3


# --- properties -------------------------------------------------------------------------------------------------
def test_forward_is_paris_with_many_draws_and_genealogy_follows_parents():
    """Given the same run, PaRIS has the mean of the forward sums; the genealogy has the paths of `keep`."""
    filter = bootstrap(CHAIN, 30)
    forward, paris = (
        np.array(list(additive(filter, SYMBOLS, jumps, Dynamics(CHAIN), 3, method, draws=1000)))
        for method in ("forward", "paris")
    )
    np.testing.assert_allclose(paris, forward, atol=0.05)
    paths = genealogy(keep(filter, SYMBOLS, 3))
    states = np.array([p.particles for p in paths])
    wanted = paths[-1].weights @ (np.diff(states, axis=0) != 0).sum(axis=0)
    assert last(filter, SYMBOLS, jumps, seed=3, method="genealogy") == pytest.approx(wanted)


def test_sums_of_vectors_and_programs():
    """The sum of (x, x^2) has two entries; a program has a genealogy."""

    def model(previous, y):
        x = sample("x", Normal(0.0, SD0) if previous is None else Normal(RHO * previous["x"], SIGMA))
        observe("y", Normal(x, TAU), y)

    def both(previous, p):
        return np.stack([p["x"], p["x"] ** 2], axis=1)

    found = last(Program(model).bootstrap(4000), YS[:4], both, method="genealogy")
    exact = kalman_filter([[RHO]], [[SIGMA**2]], [[1.0]], [[TAU**2]], [0.0], [[SD0**2]], YS[:4])
    mean = exact.smoothed_means[:, 0]
    np.testing.assert_allclose(found, [mean.sum(), (mean**2 + exact.smoothed_covariances[:, 0, 0]).sum()], atol=0.1)


def test_a_function_gets_time_and_input():
    def h(previous, x, t, u):
        return np.full(len(x), 10.0 * t + u)

    given = [WithInput(0.1, 1.0), WithInput(0.2, 2.0), WithInput(None, 3.0)]
    assert last(bootstrap(AR1, 20), given, h, Dynamics(AR1)) == pytest.approx(36.0)


def test_two_filters_of_a_model_that_changes_with_time():
    """Matrices of each step, inputs, a prior of each time: against the RTS smoother (5 standard errors)."""
    T = 5
    F, Q = np.array([0.9, 0.5, 1.2, 0.7, 1.0])[:, None, None], np.array([0.3, 0.5, 0.2, 0.6, 0.4])[:, None, None]
    H, B = np.array([1.0, 2.0, 0.5, 1.0, 1.5])[:, None, None], [[1.0]]
    given = [WithInput([y], [u]) for y, u in zip([0.3, -0.5, 1.0, 0.4, 2.0], [0.0, 1.0, -0.5, 0.3, 0.8], strict=True)]
    parts = {"F": F, "Q": Q, "H": H, "R": [[0.4]], "m0": [0.2], "P0": [[0.8]], "B": B}
    model, exact = linear_gaussian(**parts), kalman_filter(**parts, observations=given)

    def prior(t):
        return Normal(np.full((1, 1), 0.2 * t), 1.5)

    found = [
        [
            p.weights @ p.particles[:, 0]
            for p in two_filter(bootstrap(model, 300), given, model, prior, lambda x, y: Normal(0.5 * x, 1.2), seed)
        ]
        for seed in range(30)
    ]
    error = np.std(found, axis=0, ddof=1) / np.sqrt(30)
    assert (abs(np.mean(found, axis=0) - exact.smoothed_means[:, 0]) < 5 * error + 0.01).all() and len(error) == T


def test_what_is_refused():
    filter = bootstrap(AR1, 20)
    for change, message in (
        ({"transition": None}, "the method paris needs the transition of the model"),
        ({"method": "smooth"}, "method is 'smooth', expected paris, forward or genealogy"),
        ({"draws": 0}, "draws is 0"),
        ({"function": lambda previous, x: 1.0}, r"the function returned shape \(\), expected one row for each of 20"),
        ({"function": lambda x: x}, "function has the parameters"),
        ({"transition": AR1}, "transition is StateSpaceModel"),
    ):
        arguments = {"function": itself, "transition": Dynamics(AR1), **change}
        with pytest.raises(InputError, match=message):
            list(additive(filter, YS, **arguments))
    with pytest.raises(InputError, match="method is 'all'"):
        two_filter(filter, YS, AR1, Normal(), lambda x, y: Normal(x, 1.0), method="all")
    with pytest.raises(InputError, match="no log_transition"):
        bare = StateSpaceModel(AR1.sample_initial, AR1.sample_transition, AR1.log_likelihood)
        two_filter(filter, YS, bare, Normal(), lambda x, y: Normal(x, 1.0))

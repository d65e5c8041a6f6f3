"""Smoothers against the exact answers: RTS and the joint Gaussian, and all paths of a hidden chain.

Means over independent runs at 5 standard errors and a bias of order 1 / n, chi-square tests at 1e-5: false alarm
below 1e-3 for the file.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Always,
    DensityTransition,
    Dynamics,
    Population,
    Proposal,
    RandomWalkMove,
    Record,
    auxiliary,
    backward_paths,
    bootstrap,
    fixed_lag,
    genealogy,
    guided,
    keep,
    linear_gaussian,
    resample_move,
)
from tests.smc.models import (
    AR1,
    MOVES,
    RHO,
    SD0,
    SYMBOLS,
    TAU,
    ar1_observations,
    hmm,
    optimal,
    optimal_initial,
    predictive,
    states_of,
)

YS = [*ar1_observations(3), None, *ar1_observations(8)[4:]]
T = len(YS)


def smoothed():
    """Means, variances and covariances of neighbours given all that was seen, by the joint Gaussian."""
    cov = SD0**2 * RHO ** np.abs(np.subtract.outer(np.arange(T), np.arange(T)))
    seen = [t for t, y in enumerate(YS) if y is not None]
    gain = cov[:, seen] @ np.linalg.inv(cov[np.ix_(seen, seen)] + TAU**2 * np.eye(len(seen)))
    posterior = cov - gain @ cov[seen]
    return gain @ np.array([YS[t] for t in seen]), np.diag(posterior), np.diag(posterior, 1)


def moments(paths):
    """(3, T): means, mean squares around the exact mean, and products of neighbours (0 at the end)."""
    w = paths[0].weights
    away = np.array([p.particles for p in paths]) - smoothed()[0][:, None]
    return np.array([away @ w, away**2 @ w, np.append(away[:-1] * away[1:] @ w, 0.0)])


def agrees(found, n):
    mean, variance, neighbours = smoothed()
    wanted = np.array([0 * mean, variance, np.append(neighbours, 0.0)])
    error = np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
    return (np.abs(np.mean(found, axis=0) - wanted) <= 5 * error + 3 / n).all()


N = 300
FILTERS = {
    "bootstrap": bootstrap(AR1, N),
    "always": bootstrap(AR1, N, trigger=Always()),
    "after": replace(bootstrap(AR1, N), resample="after"),
    "guided": guided(AR1, optimal, N, optimal_initial),
    "auxiliary": auxiliary(AR1, predictive, N, optimal),
    "resample-move": resample_move(AR1, RandomWalkMove(AR1, 0.6), N, trigger=Always()),
}


METHODS = {
    "exact": {},
    "mcmc": {"method": "mcmc"},
    "mcmc, 4 steps": {"method": "mcmc", "steps": 4},
    "rejection": {"method": "rejection", "log_bound": 0.0},
}


def small_record():
    """Four particles of a hidden chain over three steps, with unequal weights and a parent that is unlikely."""
    model, states = hmm("vector"), [[0, 1, 2, 2], [2, 0, 1, 1], [1, 2, 0, 2]]
    weights, parents = [[0.5, 0.1, 0.3, 0.1], [0.2, 0.4, 0.0, 0.4], [0.1, 0.2, 0.3, 0.4]], [0, 3, 1, 1]
    with np.errstate(divide="ignore"):
        populations = [
            Population(np.array(k), np.log(w), {} if t == 0 else {"previous": np.array(parents)})
            for t, (k, w) in enumerate(zip(states, weights, strict=True))
        ]
    moves = [MOVES[np.ix_(a, b)].T * np.array(w) for (a, b), w in zip(pairwise(states), weights, strict=False)]
    return Record(tuple(populations), (0, 1, 2)), Dynamics(model), moves, parents


def independent_metropolis(target, weights, steps):
    """(m, m) transition matrix of the chain that proposes by weight."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = target / weights
        accepted = np.nan_to_num(np.minimum(1.0, ratio[None] / ratio[:, None]))
    kernel = weights / weights.sum() * accepted
    kernel += np.diag(1 - kernel.sum(axis=1))
    return np.linalg.matrix_power(kernel, steps)


@pytest.mark.parametrize("method", METHODS)
def test_the_law_of_a_path_given_the_record(method):
    """Chi-square over all 64 paths of indices, 20,000 paths; the law of the Markov chain is enumerated."""
    record, dynamics, moves, parents = small_record()
    marked = Record(
        tuple(replace(p, particles=np.arange(4) + 10 * t) for t, p in enumerate(record.populations)), (0, 1, 2)
    )
    states = np.concatenate([p.particles for p in record.populations])

    class Marked(DensityTransition):
        def predict(self, rng, population, observation):
            raise NotImplementedError

        def log_prob(self, previous, new, observation):
            return dynamics.log_prob(*(states[4 * (x // 10) + x % 10] for x in (previous, new)), observation)

    rng, n = np.random.default_rng(5), 20_000
    found = backward_paths(rng, marked, Marked(), n, **METHODS[method])
    index = np.array([p.particles % 10 for p in found])
    steps = METHODS[method].get("steps", 1)
    wanted = record.populations[2].weights
    for t in (1, 0):
        weights, back = record.populations[t].weights, moves[t] / moves[t].sum(axis=1, keepdims=True)
        if "mcmc" in method:
            back = np.array([independent_metropolis(back[j], weights, steps)[parents[j]] for j in range(4)])
        wanted = wanted[..., None] * back[(None,) * (wanted.ndim - 1)]
    counts = np.bincount(16 * index[2] + 4 * index[1] + index[0], minlength=64)
    expected = n * wanted.ravel()
    assert counts[expected < 1e-9].sum() == 0
    some = expected >= 1e-9
    assert stats.chi2.sf((((counts - expected) ** 2)[some] / expected[some]).sum(), some.sum() - 1) > 1e-5


@pytest.mark.parametrize("name", FILTERS)
def test_smoothers_agree_with_the_joint_gaussian(name):
    found = {method: [] for method in ("genealogy", *METHODS)}
    for seed in range(60):
        record = keep(FILTERS[name], YS, seed)
        found["genealogy"].append(moments(genealogy(record)))
        for method, settings in METHODS.items():
            if method == "rejection" and name != "bootstrap":  # the law of "exact", as is tested above
                continue
            paths = backward_paths(np.random.default_rng(seed), record, Dynamics(AR1), 100, **settings)
            found[method].append(moments(paths))
    for values in filter(len, found.values()):
        assert agrees(values, N)
    # What backward sampling is for: far less noise where the paths of the genealogy have grown together.
    if name == "always":
        noise = [np.std(found[method], axis=0)[0, 0] for method in ("genealogy", "exact")]
        assert noise[0] > 1.3 * noise[1]


@pytest.mark.nightly
@pytest.mark.parametrize("name", FILTERS)
def test_smoothers_are_exact_at_night(name):
    """The z score of one sum, of errors of means and second moments over all times, in 200 runs of each smoother."""
    variance, found = smoothed()[1].sum(), {method: [] for method in ("genealogy", "exact", "mcmc")}
    for seed in range(100, 300):
        record = keep(FILTERS[name], YS, seed)
        for method, sums in found.items():
            if method == "genealogy":
                paths = genealogy(record)
            else:
                paths = backward_paths(np.random.default_rng(seed), record, Dynamics(AR1), 100, method)
            sums.append(moments(paths)[:2].sum() - variance)
    for method, sums in found.items():
        spread = np.std(sums, ddof=1)
        away = max(abs(np.mean(sums)) - spread**2 / 3 - T / N, 0.0)  # a bias of order 1 / n at each time
        assert away / (spread / np.sqrt(len(sums))) < 3, method


@pytest.mark.parametrize("kind", ["mapping", "objects"])
def test_paths_are_the_same_with_any_kind_of_particle(kind):
    found = []
    for model in (hmm("vector"), hmm(kind)):
        record = keep(bootstrap(model, 30), [*SYMBOLS[:3], None, *SYMBOLS[4:6]], 1)
        smoothers = [genealogy(record), fixed_lag(record, 2)]
        smoothers += [
            backward_paths(np.random.default_rng(0), record, Dynamics(model), 20, m) for m in ("exact", "mcmc")
        ]
        found.append([states_of(p.particles) for paths in smoothers for p in paths])
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_fixed_lag_lies_between_the_filter_and_the_genealogy():
    record = keep(bootstrap(AR1, 200, trigger=Always()), YS, 3)
    for population, own in zip(fixed_lag(record, 0), record.populations, strict=True):
        np.testing.assert_array_equal(population.particles, own.particles)
        np.testing.assert_array_equal(population.log_weights, own.log_weights)
    for a, b in zip(fixed_lag(record, T), genealogy(record), strict=True):
        np.testing.assert_array_equal(a.particles, b.particles)
    distinct = [len(set(s[0].particles.tolist())) for s in (fixed_lag(record, 2), genealogy(record))]
    assert distinct[0] > 1.3 * distinct[1]


def test_a_large_run_is_done_in_blocks(monkeypatch):
    record = keep(bootstrap(AR1, 40), YS, 1)
    whole = backward_paths(np.random.default_rng(0), record, Dynamics(AR1), 30)
    monkeypatch.setattr("mstfilter.smc.inference.smoothing._PAIRS", 100)
    parts = backward_paths(np.random.default_rng(0), record, Dynamics(AR1), 30)
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_array_equal(a.particles, b.particles)


@dataclass(frozen=True)
class Listening(Dynamics):
    """Notes what it is told to have been observed, and how many densities it evaluates."""

    heard: list = field(default_factory=list)
    sizes: list = field(default_factory=list)

    def log_prob(self, previous, new, observation):
        self.heard.append(observation)
        self.sizes.append(len(new))
        return super().log_prob(previous, new, observation)


def test_the_density_is_asked_with_the_observation_of_its_move():
    listening = Listening(AR1)
    backward_paths(np.random.default_rng(0), keep(bootstrap(AR1, 20), YS, 1), listening, 5)
    assert listening.heard == YS[:0:-1]


@pytest.mark.parametrize(("method", "most"), [("exact", 400), ("mcmc", 2), ("mcmc, 4 steps", 5)])
def test_the_number_of_densities_per_path_and_step(method, most):
    listening, record = Listening(AR1), keep(bootstrap(AR1, 400), YS, 1)
    backward_paths(np.random.default_rng(0), record, listening, 300, **METHODS[method])
    assert sum(listening.sizes) / (300 * (T - 1)) == most


@dataclass(frozen=True)
class Fresh(Proposal):
    def sample(self, rng, observation, n):
        return Population(rng.standard_normal(n))


def test_what_cannot_be_smoothed():
    record = keep(bootstrap(AR1, 20), YS, 1)
    rng = np.random.default_rng(0)
    mixed = keep(replace(bootstrap(AR1, 20), proposal=Fresh()), YS[:3], 1)
    with pytest.raises(InputError, match="step 2: not every particle has a known parent"):
        genealogy(mixed)
    with pytest.raises(InputError, match="transition is StateSpaceModel"):
        backward_paths(rng, record, AR1, 5)
    for settings, message in (
        ({"method": "metropolis"}, "method is 'metropolis', expected exact, mcmc or rejection"),
        ({"method": "rejection"}, "the method rejection needs log_bound"),
        ({"method": "rejection", "log_bound": -1.0}, "log_bound is -1.0, and a log density from step 6 is -0.4"),
        ({"method": "mcmc", "steps": 0}, "steps is 0"),
    ):
        with pytest.raises(InputError, match=message):
            backward_paths(rng, record, Dynamics(AR1), 200, **settings)
    with pytest.raises(InputError, match="step 2: not every particle has a known parent"):
        backward_paths(rng, mixed, Dynamics(AR1), 5, "mcmc")
    with pytest.raises(InputError, match="lag is -1"):
        fixed_lag(record, -1)
    with pytest.raises(InputError, match="no observations"):
        keep(bootstrap(AR1, 20), [], 1)
    for bad, message in (
        (lambda old, new: np.full(len(old), -np.inf), "from step 6 to 7: a particle has no possible predecessor"),
        (lambda old, new: np.full(len(old), np.nan), "from step 6 to 7"),
        (lambda old, new: np.zeros(3), r"log_prob returned shape \(3,\)"),
    ):
        for method in METHODS:
            with pytest.raises(InputError, match=message):
                backward_paths(rng, record, Dynamics(replace(AR1, log_transition=bad)), 5, **METHODS[method])


def test_a_record_that_continues_a_run_has_the_transitions_of_its_steps():
    model = linear_gaussian(
        np.array([1.0, 0.1, 0.1, 0.1, -2.0, -2.0, -2.0, -2.0])[:, None, None],
        [[0.5]],
        [[1.0]],
        [[0.5]],
        [0.0],
        [[1.0]],
    )
    filter, ys = bootstrap(model, 200), list(np.random.default_rng(0).normal(size=(8, 1)))
    whole, part = keep(filter, ys, 0), keep(filter, ys[4:], filter.run(ys[:4], 0)[0])
    assert (whole.first, part.first) == (0, 4)
    expected, found = (
        backward_paths(np.random.default_rng(1), record, Dynamics(model), 300) for record in (whole, part)
    )
    for a, b in zip(expected[4:], found, strict=True):
        np.testing.assert_array_equal(a.particles, b.particles)

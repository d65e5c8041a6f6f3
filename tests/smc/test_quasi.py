"""SQMC against exact evidences: unbiased (5 standard errors), and with less variance than random numbers.

False alarm below 1e-4 for the file.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Bernoulli,
    Normal,
    Program,
    RandomWalkMove,
    SobolGenerator,
    StateSpaceModel,
    bootstrap,
    guided,
    kalman_filter,
    linear_gaussian,
    observe,
    sample,
    sqmc,
)
from tests.smc.models import AR1, RHO, SD0, SIGMA, TAU, ar1_observations, kalman_ar1, optimal, optimal_initial

YS = [*ar1_observations(3), None, *ar1_observations(8)[4:]]
PLANE = {"F": [[0.9, 0.2], [0.0, 0.8]], "Q": 0.3 * np.eye(2), "H": np.eye(2), "R": 0.5 * np.eye(2)}
PLANE |= {"m0": [0.0, 0.0], "P0": np.eye(2)}
Y2 = list(np.random.default_rng(0).normal(size=(6, 2)))


def program(previous, y):
    x = sample("x", Normal(0.0, SD0) if previous is None else Normal(RHO * previous["x"], SIGMA))
    observe("y", Normal(x, TAU), y)


CASES = {
    "bootstrap": (bootstrap(AR1, 128), YS, lambda: kalman_ar1(YS)[1]),
    "guided": (guided(AR1, optimal, 128, optimal_initial), YS, lambda: kalman_ar1(YS)[1]),
    "program": (Program(program).bootstrap(128), YS, lambda: kalman_ar1(YS)[1]),
    "two dimensions": (
        bootstrap(linear_gaussian(**PLANE), 128),
        Y2,
        lambda: kalman_filter(**PLANE, observations=Y2).log_evidence[-1],
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_evidence_is_unbiased_and_has_less_variance(name):
    filter, ys, exact = CASES[name]
    plain, quasi = (np.array([f.run(ys, seed)[0].log_evidence for seed in range(24)]) for f in (filter, sqmc(filter)))
    ratio = np.exp(quasi - exact())
    assert abs(ratio.mean() - 1) < 5 * ratio.std(ddof=1) / np.sqrt(24)
    assert quasi.std() < 0.75 * plain.std()


def test_the_error_falls_faster_than_with_random_numbers():
    """16 times the particles divide the error of random numbers by 4, that of SQMC by 7 or more."""
    found = [
        np.std([sqmc(bootstrap(AR1, n)).run(YS, seed)[0].log_evidence for seed in range(24)]) for n in (64, 1024)
    ]
    assert found[0] / found[1] > 7


def test_the_numbers_have_their_laws():
    """Columns of a large Sobol set, by the Kolmogorov-Smirnov distance, which even points keep below 5 / n."""
    n = 1024
    points = (np.arange(n)[:, None] + 0.5) / n
    draws = {
        "random": (lambda g: g.random(n), stats.uniform()),
        "uniform": (lambda g: g.uniform(-1.0, np.full(n, 3.0)), stats.uniform(-1.0, 4.0)),
        "standard_normal": (lambda g: g.standard_normal((n, 1))[:, 0], stats.norm()),
        "normal": (lambda g: g.normal(np.full(n, 2.0), 3.0), stats.norm(2.0, 3.0)),
        "standard_exponential": (lambda g: g.standard_exponential(n), stats.expon()),
        "standard_t": (lambda g: g.standard_t(4.0, n), stats.t(4.0)),
        "standard_gamma": (lambda g: g.standard_gamma(2.5, n), stats.gamma(2.5)),
    }
    for name, (draw, law) in draws.items():
        assert stats.ks_1samp(draw(SobolGenerator(points)), law.cdf).statistic < 5 / n, name


def test_a_run_is_reproducible_and_has_parents():
    filter = sqmc(bootstrap(AR1, 64))
    first, again = filter.run(YS, 3)[0], filter.run(YS, 3)[0]
    np.testing.assert_array_equal(first.population.particles, again.population.particles)
    assert not np.array_equal(first.population.particles, filter.run(YS, 4)[0].population.particles)
    assert first.population.known_parents().shape == (64,)


def test_what_is_refused():
    for filter, message in (
        (bootstrap(AR1, 100), "n is 100, expected a power of 2"),
        (replace(bootstrap(AR1, 64), rejuvenation=RandomWalkMove(AR1)), "does not know a filter with `rejuvenation`"),
        (replace(bootstrap(AR1, 64), transition=None), "needs a filter with `initial` and `transition`"),
    ):
        with pytest.raises(InputError, match=message):
            sqmc(filter)
    counts = StateSpaceModel(lambda rng, n: rng.poisson(3.0, n), lambda rng, x: x, lambda x, y: -0.5 * (x - y) ** 2.0)
    with pytest.raises(InputError, match="a method that has no inverse"):
        sqmc(bootstrap(counts, 64)).run([1.0, 2.0], 0)
    uneven = StateSpaceModel(
        lambda rng, n: rng.random(n), lambda rng, x: x + rng.random(3).sum(), lambda x, y: -((x - y) ** 2)
    )
    with pytest.raises(InputError, match=r"numbers of shape \(3,\) are drawn for 2 particles"):
        sqmc(bootstrap(uneven, 64)).run([1.0, 2.0], 0)


def test_a_discrete_site_is_drawn_by_its_inverse():
    def model(previous, y):
        k = sample("k", Bernoulli(0.25))
        observe("y", Normal(np.where(k, 1.0, 0.0), 1.0), y)

    state, _ = sqmc(Program(model).bootstrap(256)).run([None], 0)
    assert state.population.particles["k"].mean() == pytest.approx(0.25, abs=1 / 128)

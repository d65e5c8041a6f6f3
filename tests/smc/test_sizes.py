"""KLD size; similarities and classes of equal particles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import (
    Always,
    Bins,
    ExactEquality,
    Gaussian,
    Kld,
    Population,
    Sized,
    Systematic,
    bootstrap,
    linear_gaussian,
)


def test_one_bin_wants_the_least_not_the_most():
    assert Kld(Bins(10.0), n_min=7).choose(Population(np.full(100, 0.5))) == 7
    assert Kld(Bins(0.001), epsilon=1e-6, n_max=321).choose(Population(np.linspace(0, 1, 500))) == 321


def test_kld_is_the_least_number_that_is_enough():
    population = Population(np.arange(40.0), np.log(np.arange(1.0, 41)))
    size = Kld(Bins(1.0), epsilon=0.1, n_min=1)
    mass = population.weights

    def enough(n):
        return n >= np.ceil(size.bound((1 - (1 - mass) ** n).sum()))

    n = size.choose(population)
    assert enough(n)
    assert not any(enough(k) for k in range(2, n))
    assert size.bound(5) == pytest.approx(stats.chi2.ppf(0.99, 4) / 0.2)


def test_kld_follows_the_posterior_in_a_filter():
    """Narrow posterior, few particles; the filter takes the size at each resampling."""
    model = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[0.01]], m0=[0.0], P0=[[4.0]])
    start = bootstrap(model, n=1000, resampler=Systematic(), trigger=Always())
    sized = replace(start, resampler=Sized(Systematic(), Kld(Bins(0.25), epsilon=0.05, n_min=20)))
    state, _ = sized.run([0.3, -0.1, 0.8], seed=0)
    assert 20 <= len(state.population) < 300


def test_classes():
    np.testing.assert_array_equal(ExactEquality().classes(np.array([2.0, 1.0, 2.0])), [0, 1, 0])
    np.testing.assert_array_equal(ExactEquality().classes(np.array([[1, 2], [2, 1], [1, 2]])), [0, 1, 0])
    np.testing.assert_array_equal(ExactEquality().classes(("a", "b", "a")), [0, 1, 0])
    np.testing.assert_array_equal(
        ExactEquality().classes({"x": np.array([1, 1, 1]), "y": np.array([3, 4, 3])}), [0, 1, 0]
    )
    np.testing.assert_array_equal(Bins(1.0).classes(np.array([[0.5, -0.5], [0.1, -0.1], [0.5, 0.5]])), [0, 0, 1])


def test_gaussian_similarity():
    x = np.random.default_rng(0).standard_normal((200, 3)) + 1000
    d = ((x[:, None] - x[None]) ** 2).sum(axis=2)
    for particles in (x, {"a": x[:, :1], "b": x[:, 1:]}):
        np.testing.assert_allclose(Gaussian(2.0).matrix(particles), np.exp(-d / 8), atol=1e-9)
    with pytest.raises(InputError, match="str objects"):
        Gaussian().matrix(("a", "b"))


def test_particles_without_a_value_share_a_bin():
    x = np.array([[0.0, np.nan], [0.1, np.nan], [0.0, 0.5], [5.0, np.nan]])
    assert Bins(1.0).classes(x).tolist() == [0, 0, 1, 2]

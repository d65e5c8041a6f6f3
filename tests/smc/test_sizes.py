"""KLD size against drawing one by one; similarities and classes of equal particles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from mstfilter.errors import InputError
from mstfilter.smc import (
    Always,
    Bins,
    ExactEquality,
    Gaussian,
    Kld,
    Population,
    Systematic,
    bootstrap,
    linear_gaussian,
)


def sequential(rng, mass, epsilon, delta):
    """Fox's sampler: draw until the number of draws reaches the bound of the bins met so far."""
    draws, n = rng.choice(len(mass), size=1000, p=mass), np.arange(1, 1001)
    new = np.isin(np.arange(1000), np.unique(draws, return_index=True)[1])
    bounds = np.append([0.0, 2.0], stats.chi2.ppf(1 - delta, np.arange(1, len(mass))) / (2 * epsilon))
    return n[n >= bounds[np.cumsum(new)]][0]


@pytest.mark.parametrize("epsilon", [0.5, 0.2, 0.1])
def test_kld_agrees_with_drawing_one_by_one(epsilon):
    """Drawing one by one stops at the first lucky moment, so on average a little earlier; never later.

    200 runs; their mean has a standard error of about 1 %.
    """
    rng = np.random.default_rng(0)
    x = rng.normal(size=4000)
    population = Population(x, -0.5 * (x - 0.5) ** 2 / 0.8)
    classes = Bins(0.25).classes(x)
    mass = np.bincount(classes, population.weights)
    drawn = np.mean([sequential(rng, mass, epsilon, 0.01) for _ in range(200)])
    size = Kld(Bins(0.25), epsilon=epsilon, delta=0.01, n_min=2)
    assert 0.97 * drawn <= size.choose(population) <= 1.2 * drawn
    # The number of bins that is put into the bound is the one that so many draws do meet.
    n = size.choose(population)
    met = np.mean([len(set(rng.choice(len(mass), size=n, p=mass).tolist())) for _ in range(100)])
    assert size.bound(met) == pytest.approx(n, rel=0.05)


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
    sized = replace(start, size=Kld(Bins(0.25), epsilon=0.05, n_min=20))
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

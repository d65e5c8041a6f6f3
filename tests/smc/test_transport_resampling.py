"""Sorted particles and optimal transport: deterministic properties, a filter against the Kalman filter, errors."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy import stats

from mstfilter.errors import InputError
from mstfilter.smc import (
    Always,
    Chopthin,
    ClusterStratified,
    EnsembleTransform,
    Population,
    Shuffled,
    Sorted,
    Ssp,
    Stratified,
    Systematic,
    auxiliary,
    bootstrap,
)
from mstfilter.smc.transport_resampling import hilbert_position
from tests.smc.models import AR1, ar1_observations, kalman_ar1, predictive


def random_population(rng, m, shape=()):
    return Population(rng.standard_normal((m, *shape)), 2 * rng.standard_normal(m))


# --- sorted -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("d", "bits"), [(1, 4), (2, 1), (2, 5), (3, 3), (4, 2), (5, 2)])
def test_neighbours_on_the_hilbert_curve_are_neighbours_in_space(d, bits):
    cells = np.array(list(product(range(1 << bits), repeat=d)))
    position = hilbert_position(cells, bits)
    np.testing.assert_array_equal(np.sort(position), np.arange(len(cells)))
    steps = np.diff(cells[np.argsort(position)], axis=0)
    assert (np.abs(steps).sum(axis=1) == 1).all()


@pytest.mark.parametrize("scheme", [Systematic(), Stratified()], ids=["systematic", "stratified"])
@pytest.mark.parametrize("n", [10, 40, 130])
def test_distribution_function_of_sorted_particles(scheme, n):
    """It differs from the weighted one by less than 1 / n, for every draw; unsorted it does not."""
    rng, far = np.random.default_rng(n), 0.0
    for _ in range(20):
        population = random_population(rng, 40)
        order = np.argsort(population.particles)
        weighted = np.cumsum(population.weights[order])
        for chosen, sort in ((Sorted(scheme), True), (scheme, False)):
            out = np.sort(chosen.resample(rng, population, n).particles)
            found = np.searchsorted(out, population.particles[order], side="right") / n
            distance = np.abs(found - weighted).max()
            assert distance < 1 / n + 1e-12 or not sort
            far = max(far, distance if not sort else 0.0)
    assert far > 1 / n


def test_vectors_are_selected_closer_along_the_hilbert_curve():
    """Energy distance between the selected and the weighted particles, mean of 40: at most .7 of the unsorted one."""
    rng, distances = np.random.default_rng(3), {"sorted": 0.0, "plain": 0.0}
    for _ in range(40):
        population = random_population(rng, 300, (2,))
        x, w = population.particles, population.weights
        apart = np.sqrt(((x[:, None] - x[None]) ** 2).sum(axis=2))
        for name, scheme in (("sorted", Sorted(Systematic())), ("plain", Systematic())):
            found = np.bincount(scheme.resample(rng, population, 100).parents["ancestor"], minlength=300) / 100
            distances[name] -= (found - w) @ apart @ (found - w)
    assert 0 < distances["sorted"] < 0.7 * distances["plain"]


def test_mean_partition_keeps_as_many_light_particles_as_on_average():
    rng = np.random.default_rng(5)
    for _ in range(200):
        population = Population(np.arange(30.0), 0.3 * rng.standard_normal(30))
        light = population.weights <= 1 / 30
        chosen = Sorted(Systematic(), "mean_partition").resample(rng, population, 30)
        kept = light[chosen.parents["ancestor"]].sum()
        assert abs(kept - 30 * population.weights[light].sum()) < 1
        assert (np.bincount(chosen.parents["ancestor"], minlength=30)[light] <= 1).all()
        ssp = Sorted(Ssp(), "mean_partition").resample(rng, population, 30)
        assert len(ssp) == 30


def test_sorted_orders_mappings_and_refuses_objects():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((20, 1))
    mapping = Population({"x": x, "fixed": np.zeros(20)}, x[:, 0])
    chosen = Sorted().resample(rng, mapping, 7)
    np.testing.assert_array_equal(chosen.particles["x"], x[chosen.parents["ancestor"]])
    with pytest.raises(InputError, match="objects"):
        Sorted().resample(rng, Population(("a", "b")), 2)
    with pytest.raises(InputError, match="63 dimensions"):
        Sorted().resample(rng, Population(rng.standard_normal((5, 63))), 2)
    assert len(Sorted(order="mean_partition").resample(rng, Population(("a", "b")), 2)) == 2
    with pytest.raises(InputError, match="order is 'size'"):
        Sorted(order="size")


# --- chopthin -----------------------------------------------------------------------------------------------------
def test_chopthin_changes_nothing_if_the_weights_are_nearly_equal():
    population = Population(np.arange(6.0), np.log([1.0, 2.0, 1.5, 1.0, 1.9, 1.2]))
    chosen = Chopthin().resample(np.random.default_rng(0), population, 6)
    order = np.argsort(chosen.parents["ancestor"])
    np.testing.assert_array_equal(chosen.particles[order], population.particles)
    np.testing.assert_allclose(chosen.log_weights[order], population.log_weights)


def test_chopthin_keeps_half_of_the_effective_sample_size():
    rng = np.random.default_rng(1)
    for spread in (0.5, 3.0, 30.0):
        population = Population(np.arange(500.0), spread * rng.standard_normal(500))
        assert Chopthin().resample(rng, population, 500).ess >= 250 - 1e-6
    with pytest.raises(InputError, match="ratio"):
        Chopthin(3.9)


# --- ensemble transform -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("n", [1, 7, 40, 90])
@pytest.mark.parametrize("shape", [(), (1,), (2,)])
def test_transport_keeps_the_weighted_mean(n, shape):
    rng = np.random.default_rng(n)
    population = random_population(rng, 40, shape)
    made = EnsembleTransform().resample(rng, population, n)
    expected = np.tensordot(population.weights, population.particles, 1)
    np.testing.assert_allclose(made.particles.mean(axis=0), expected, atol=1e-12)
    np.testing.assert_allclose(made.log_weights, population.log_mean_weight, atol=1e-12)
    assert made.particles.shape == (n, *shape) and "ancestor" not in made.parents
    assert (made.particles.max(axis=0) <= population.particles.max(axis=0) + 1e-9).all()


def test_transport_in_one_dimension_is_that_of_the_linear_program():
    """The same particles with a second coordinate of zero are transported by the linear program."""
    rng = np.random.default_rng(2)
    for m in (1, 2, 25):
        population = random_population(rng, m)
        plane = Population(np.stack([population.particles, np.zeros(m)], axis=1), population.log_weights)
        line, program = (EnsembleTransform().resample(rng, p, m).particles for p in (population, plane))
        np.testing.assert_allclose(program[:, 0], line, atol=1e-9)


def test_transport_to_more_particles_is_the_quantile_function():
    """New particle j is the mean of the quantile function over [j / n, (j + 1) / n], here by the trapezoid rule."""
    population = Population(np.array([3.0, 1.0, 2.0]), np.log([1.0, 2.0, 1.0]))
    made = EnsembleTransform().resample(np.random.default_rng(0), population, 8).particles
    np.testing.assert_allclose(made, [1, 1, 1, 1, 2, 2, 3, 3])
    made = EnsembleTransform().resample(np.random.default_rng(0), population, 2).particles
    np.testing.assert_allclose(made, [1, 2.5])


def test_transport_of_equal_weights_changes_nothing():
    x = np.random.default_rng(3).standard_normal((30, 2))
    mapping = Population({"a": x[:, 0], "b": x[:, 1:]})
    made = EnsembleTransform().resample(np.random.default_rng(0), mapping, 30).particles
    np.testing.assert_allclose(made["a"], x[:, 0], atol=1e-9)
    np.testing.assert_allclose(made["b"], x[:, 1:], atol=1e-9)


def test_filter_by_transport_follows_the_kalman_filter():
    """Filtered means of 20 runs, in their standard errors (3.5) and a bias of .02; no evidence, no ancestors."""
    ys = ar1_observations(12)
    exact = kalman_ar1(ys)[0][-1, 0]
    filter = bootstrap(AR1, 200, EnsembleTransform(), Always())
    means, runs = [], [filter.run(ys, seed) for seed in range(20)]
    for state, _ in runs:
        means.append(state.population.weights @ state.population.particles)
        assert state.log_evidence is None
        assert (state.population.parents["previous"] == -1).all() and state.population.unique_ancestors == 0
    assert abs(np.mean(means) - exact) <= 3.5 * stats.sem(means) + 0.02
    with pytest.raises(InputError, match="a lookahead needs a resampler that reports ancestors"):
        auxiliary(AR1, predictive, 20, resampler=EnsembleTransform(), trigger=Always()).run(ys, 0)


def test_what_cannot_be_transported_is_an_error():
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="int64 cannot be mixed"):
        EnsembleTransform().resample(rng, Population(np.arange(4)), 4)
    with pytest.raises(InputError, match="objects"):
        EnsembleTransform().resample(rng, Population(("a", "b")), 2)
    with pytest.raises(InputError, match="linear program of 160000 variables"):
        EnsembleTransform().resample(rng, random_population(rng, 400, (2,)), 400)
    for wrapper in (Shuffled, Sorted):
        with pytest.raises(InputError, match="EnsembleTransform makes new particles"):
            wrapper(EnsembleTransform())
    with pytest.raises(InputError, match="without ancestors"):
        ClusterStratified(scheme=EnsembleTransform())

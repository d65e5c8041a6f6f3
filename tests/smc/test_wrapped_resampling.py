"""Sorted particles and bounded ratios of weights: deterministic properties and errors."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from mstfilter.errors import InputError
from mstfilter.smc import (
    Chopthin,
    Population,
    Sorted,
    Stratified,
    Systematic,
)
from mstfilter.smc.wrapped_resampling import hilbert_position


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

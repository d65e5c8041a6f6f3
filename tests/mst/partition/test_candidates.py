"""Descriptions of candidates: their probabilities by enumeration."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.mst.partition import Cells, Choices, Readings
from mstfilter.mst.partition.candidates import largest_products, stays, tempered

READINGS = Readings(np.arange(40), np.zeros((40, 3), int), (4, 10))

factors = st.lists(st.lists(st.floats(0.01, 1), min_size=1, max_size=4), max_size=4)


@settings(max_examples=100, deadline=None)
@given(factors, st.integers(1, 30))
def test_largest_products_by_brute_force(found, n):
    chosen, total = largest_products([np.log(one) for one in found], n)
    every = sorted((np.prod(row) for row in itertools.product(*found)), reverse=True)
    np.testing.assert_allclose(np.exp(total), every[:n])
    assert chosen.shape == (min(n, len(every)), len(found)) and len(np.unique(chosen, axis=0)) == len(chosen)
    np.testing.assert_allclose(
        np.exp(total), [np.prod([one[k] for one, k in zip(found, row, strict=True)]) for row in chosen]
    )


def test_which_occluded_objects_stay():
    found = dict(stays({3: 0.75, 5: 1.0, 8: 0.0, 9: 0.5}, 10))
    assert {k: np.exp(p) for k, p in found.items()} == pytest.approx(
        {(3, 5): 0.375, (3, 5, 9): 0.375, (5,): 0.125, (5, 9): 0.125}
    )
    assert stays({}, 10) == [((), 0.0)]
    assert len(stays({k: 0.5 for k in range(20)}, 7)) == 7


def two_regions():
    """Two components: the first has four columns in two possible objects, the second is in question as well."""
    columns = np.tile(np.arange(10), 4)
    left = [np.where(columns < 3, 1, 2), np.where(columns < 5, 1, 2), np.ones(40, int)]
    right = [np.where(columns < 7, 3, 4), np.full(40, 3), np.where(columns < 8, 3, 4)]
    rows = [
        np.where(columns < 6, a, b) * (columns != 5)  # the sixth column separates the components
        for a, b in itertools.product(left, right)
    ]
    return Cells.of(READINGS, rows, rows[:2])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
def test_candidates_by_enumeration(seed, n):
    """All products of predictions and alternatives, and the largest of them."""
    rng, cells = np.random.default_rng(seed), two_regions()
    components = cells.alternatives()
    assert len(components) == 2 and all(len(one.partitions) > 1 for one in components)
    log_odds = rng.normal(0, 2, (2, len(cells.pairs)))
    w = rng.dirichlet(np.ones(2))
    p = [[cells.probabilities(odds, one) for one in components] for odds in log_odds]
    every = {
        (j, cells.joined(components, np.array(row)).tobytes()): w[j] * p[j][0][row[0]] * p[j][1][row[1]]
        for j in range(2)
        for row in itertools.product(*(range(len(one.partitions)) for one in components))
    }
    assert sum(every.values()) == pytest.approx(1)
    found = Choices.of(cells, np.log(w), log_odds, n)
    names = [(j, row.tobytes()) for j, row in zip(found.prediction.tolist(), found.partitions, strict=True)]
    assert len(set(names)) == len(names) == min(n, sum(value > 0 for value in every.values()))
    np.testing.assert_allclose(np.exp(found.log_weights), [every[name] for name in names])
    assert min(np.exp(found.log_weights)) >= sorted(every.values(), reverse=True)[len(names) - 1] - 1e-12
    # Cells of different components never share an object.
    for row in found.partitions:
        assert not set(row[components[0].cells].tolist()) & set(row[components[1].cells].tolist())
    # Each candidate is divided into its sets of occluded objects.
    kept = found.with_occluded([{1: 0.25, 2: 1.0} for _ in names], 2 * n)
    assert len(kept) == 2 * len(names) and set(kept.staying) == {(1, 2), (2,)}
    assert np.exp(kept.log_weights).sum() == pytest.approx(np.exp(found.log_weights).sum())
    share = sum(w for w, labels in zip(np.exp(kept.log_weights), kept.staying, strict=True) if 1 in labels)
    assert share == pytest.approx(0.25 * np.exp(found.log_weights).sum())


def test_low_temperatures_do_not_underflow():
    np.testing.assert_allclose(tempered(np.array([0.4, 0.6]), 5e-4), [0, 1])

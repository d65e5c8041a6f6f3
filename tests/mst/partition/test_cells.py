"""Cells, the log odds of their pairs, and the probabilities of partitions: by brute force on small images."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from scipy.optimize import minimize
from scipy.special import softmax

from mstfilter.mst.partition import Cells, PairEvidence, Readings, cells as module

SHAPE = (5, 6)
PIXELS = np.arange(30)
READINGS = Readings(PIXELS, np.zeros((30, 3), int), SHAPE)
images = hnp.arrays(np.int64, SHAPE, elements=st.integers(0, 2))


def explained(samples, row, kept):
    """A prediction that explains all readings of the cells of the samples of which it explains at least half."""
    out = row.copy()
    code = [tuple(int(one[k]) for one in samples) for k in PIXELS]
    for cell in {code[k] for k in np.flatnonzero(kept)}:
        inside = [k for k in np.flatnonzero(kept) if code[k] == cell]
        counts = np.bincount(row[inside], minlength=2)
        if counts[1:].sum() >= counts[0]:
            for k in inside:
                out[k] = row[k] or 1 + counts[1:].argmax()
    return out


@settings(max_examples=80, deadline=None)
@given(st.lists(images, min_size=1, max_size=3), st.lists(images, max_size=2))
def test_cells_are_what_all_partitions_treat_alike(samples, predictions):
    rows = [one.ravel() for one in (*samples, *predictions)]
    found = Cells.of(READINGS, rows[: len(samples)], rows[len(samples) :])
    kept = np.mean([one.ravel() > 0 for one in samples], axis=0) >= 0.5
    np.testing.assert_array_equal(found.of_reading >= 0, kept)
    rows = rows[: len(samples)] + [explained(rows[: len(samples)], row, kept) for row in rows[len(samples) :]]
    codes = [tuple(int(row[k]) for row in rows) for k in PIXELS]
    for a, b in itertools.combinations(np.flatnonzero(kept), 2):
        assert (found.of_reading[a] == found.of_reading[b]) == (codes[a] == codes[b])
    for k in np.flatnonzero(kept):
        c = found.of_reading[k]
        assert codes[k] == (*found.samples[:, c], *found.predictions[:, c])
    # Alternatives: the components share no object in any partition, and list what the partitions say, once each.
    every = np.concatenate([found.samples, found.predictions])
    parts = found.alternatives()
    assert sorted(c for cells, _ in parts for c in cells.tolist()) == list(range(every.shape[1]))
    inside = {pair for cells, _ in parts for pair in itertools.combinations(cells.tolist(), 2)}
    assert {tuple(pair) for pair in found.pairs.tolist()} == inside
    np.testing.assert_array_equal(found.sizes, np.bincount(found.of_reading[kept], minlength=every.shape[1]))
    for cells, partitions in parts:
        expected = set()
        for sample in found.samples[:, cells]:
            expected.add(str(joins([v or -1 - k for k, v in enumerate(sample.tolist())])))
            for past in found.predictions[:, cells]:
                expected.add(str(joins(filled(past.tolist(), sample.tolist(), found.sizes[cells].tolist()))))
        assert {str(joins(one.tolist())) for one in partitions} == expected
        assert len(partitions) == len(expected)


def joins(row):
    return [[int(a == b) for b in row] for a in row]


def filled(past, sample, sizes):
    """A cell without a predicted object joins the one with most readings in its segment, or those without like it."""
    out = list(past)
    for k, own in enumerate(past):
        if not own:
            inside = [c for c, v in enumerate(sample) if c == k or (v and v == sample[k])]
            readings = {
                b: sum(sizes[c] for c in inside if past[c] == b) for b in sorted({past[c] for c in inside}) if b
            }
            out[k] = max(readings, key=readings.get) if readings else -1 - min(inside)
    return out


def two_halves():
    """Two cells side by side: the samples and the predictions differ about them."""
    one, two = np.ones(SHAPE, int), np.ones(SHAPE, int)
    two[:, 3:] = 2
    return one.ravel(), two.ravel()


def test_log_odds_by_hand():
    one, two = two_halves()
    nothing = np.zeros_like(one)
    found = Cells.of(READINGS, [one, two, two, two], [one, two, nothing])
    evidence = PairEvidence(
        image_only_constant=0.1,
        image_only=0.9,
        constant=-0.2,
        image=0.7,
        prediction=0.4,
        prediction_constant=0.3,
    )

    def logit(p):
        return np.log((p + 0.02) / (1 - p + 0.02))

    odds = evidence.log_odds(found, np.array([0.6, 0.2, 0.2]), None)
    right = -0.2 + 0.7 * logit(0.25) + 0.8 * (0.4 * logit(0.6 / 0.8) + 0.3)
    assert odds == pytest.approx([right])
    wrong = 0.1 + 0.9 * logit(0.25)  # with probability 3/4
    odds = evidence.log_odds(found, np.array([0.6, 0.2, 0.2]) / 4, None)
    assert odds == pytest.approx([right / 4 + wrong * 3 / 4])
    alone = Cells.of(READINGS, [one, two], [])
    assert evidence.log_odds(alone, np.zeros(0), None) == pytest.approx([0.1])


def test_the_mixture_forecasts_pairs_best():
    """Against a general optimiser, over several starts."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        p, e = rng.integers(2, 6), rng.integers(1, 8)
        joined = rng.integers(0, 2, (p, e)).astype(float)
        same, weights = rng.uniform(0.02, 0.98, e), rng.dirichlet(np.ones(e))

        def loss(q, joined=joined, same=same, weights=weights):
            m = np.clip(q @ joined, 1e-9, 1 - 1e-9)
            return -(weights * (same * np.log(m) + (1 - same) * np.log(1 - m))).sum()

        def of(x, loss=loss):
            return loss(softmax(x))

        found = module._fitted_mixture(joined, same, weights)
        assert found.sum() == pytest.approx(1) and (found >= 0).all()
        best = min(minimize(of, rng.normal(size=p)).fun for _ in range(3))
        assert loss(found) <= best + 2e-3


def test_a_pair_that_is_free_gets_its_own_probability():
    one, two = two_halves()
    found = Cells.of(READINGS, [one, two], [])
    (component,) = found.alternatives()
    p, partitions = found.probabilities(np.array([1.3]), component), component.partitions
    joined = (partitions[:, 0] == partitions[:, 1]).astype(float)
    assert p @ joined == pytest.approx(1 / (1 + np.exp(-1.3)), abs=2e-3)


def test_an_object_on_both_sides_of_another_can_be_one():
    """The samples cannot join its parts, as they do not touch; the predictions do."""
    strips = np.repeat([1, 2, 3], 2)[None].repeat(SHAPE[0], 0).ravel()
    behind = np.where(strips == 3, 1, strips)
    found = Cells.of(READINGS, [strips] * 3, [behind] * 2)
    odds = np.where((found.samples[0, found.pairs] != 2).all(axis=1), 3.0, -3.0)
    left, right, middle = (found.of_reading[k] for k in (0, 5, 2))
    (sides,) = (one for one in found.alternatives() if left in one.cells)
    assert set(sides.cells) == {left, right} and middle not in sides.cells
    joined = sides.partitions[:, 0] == sides.partitions[:, 1]
    assert found.probabilities(odds, sides) @ joined > 0.9


def test_slivers_join_a_neighbour(monkeypatch):
    monkeypatch.setattr(
        module, "_LEAST_READINGS", 20 * 307200 / (SHAPE[0] * SHAPE[1] * 6)
    )  # cells of less than 3.3 readings
    one, two = two_halves()
    thin = two.reshape(SHAPE).copy()
    thin[:3, 3] = 1  # a border that is one pixel off
    found = Cells.of(READINGS, [two, two, thin.ravel()], [one])
    assert found.samples.shape[1] == 2
    assert (found.of_reading.reshape(SHAPE)[:, :3] == found.of_reading[0]).all()


def test_small_objects_far_from_others_are_not_slivers(monkeypatch):
    monkeypatch.setattr(
        module, "_LEAST_READINGS", 4 * 307200 / 40
    )  # cells of less than four readings join others within two pixels
    one = np.zeros((1, 40), int)
    one[0, :10], one[0, 30:32] = 1, 2
    two = one.copy()
    two[0, 9] = 3
    readings = Readings(np.arange(40), np.zeros((40, 3), int), (1, 40))
    found = Cells.of(readings, [one.ravel(), two.ravel()], [])
    assert found.of_reading[0] == found.of_reading[9] != found.of_reading[30] >= 0
    assert found.samples[:, found.of_reading[30]].tolist() == [2, 2]
    np.testing.assert_array_equal(np.sort(found.sizes), [2, 10])


def test_no_objects():
    found = Cells.of(READINGS, [np.zeros(30, int)], [np.ones(30, int)])
    assert (found.of_reading == -1).all() and found.alternatives() == []


@settings(max_examples=20, deadline=None)
@given(st.lists(images, min_size=2, max_size=3), st.integers(1, 4))
def test_a_sample_of_a_larger_weight_counts_as_several(samples, more):
    """One sample with the weight of `more` copies, or these copies."""
    rows = [one.ravel() for one in samples]
    weights = np.array([more, *(1 for _ in rows[1:])]) / (more + len(rows) - 1)
    weighted = Cells.of(READINGS, rows, [], weights)
    copied = Cells.of(READINGS, [rows[0]] * more + rows[1:], [])
    np.testing.assert_array_equal(weighted.of_reading, copied.of_reading)
    given = np.zeros(0)
    for one, other in zip(PairEvidence().terms(weighted, given), PairEvidence().terms(copied, given), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)

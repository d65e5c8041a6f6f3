"""Cells, the log odds of their pairs, and the law of the draws: by brute force on small images."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from mstfilter.fusion import cells as module
from mstfilter.fusion.cells import Cells, PairEvidence

SHAPE = (5, 6)
PIXELS = np.arange(30)
images = hnp.arrays(np.int64, SHAPE, elements=st.integers(0, 2))


def snapped(samples, row, kept):
    """A prediction without labels of less than a quarter of a cell of the samples."""
    out = row.copy()
    code = [tuple(int(one[k]) for one in samples) for k in PIXELS]
    for cell in {code[k] for k in np.flatnonzero(kept)}:
        inside = [k for k in np.flatnonzero(kept) if code[k] == cell]
        counts = np.bincount(row[inside])
        for k in inside:
            if counts[row[k]] < 0.25 * len(inside):
                out[k] = counts.argmax()
    return out


@settings(max_examples=80, deadline=None)
@given(st.lists(images, min_size=1, max_size=3), st.lists(images, max_size=2))
def test_cells_are_what_all_partitions_treat_alike(samples, predictions):
    rows = [one.ravel() for one in (*samples, *predictions)]
    found = Cells.of(PIXELS, SHAPE, rows[: len(samples)], rows[len(samples) :])
    kept = np.mean([one.ravel() > 0 for one in samples], axis=0) >= 0.5
    np.testing.assert_array_equal(found.of_reading >= 0, kept)
    rows = rows[: len(samples)] + [snapped(rows[: len(samples)], row, kept) for row in rows[len(samples) :]]
    codes = [tuple(int(row[k]) for row in rows) for k in PIXELS]
    for a, b in itertools.combinations(np.flatnonzero(kept), 2):
        assert (found.of_reading[a] == found.of_reading[b]) == (codes[a] == codes[b])
    for k in np.flatnonzero(kept):
        c = found.of_reading[k]
        assert codes[k] == (*found.samples[:, c], *found.predictions[:, c])
    near = set()
    for a, b in itertools.combinations(np.flatnonzero(kept), 2):
        (ya, xa), (yb, xb) = divmod(int(a), 6), divmod(int(b), 6)
        if min(abs(ya - yb), abs(xa - xb)) == 0 and max(abs(ya - yb), abs(xa - xb)) <= 2:
            near.add(tuple(sorted((int(found.of_reading[a]), int(found.of_reading[b])))))
    assert {tuple(pair) for pair in found.pairs.tolist()} == {pair for pair in near if pair[0] != pair[1]}
    # Alternatives: the components share no object in any partition, and list what the partitions say, once each.
    every = np.concatenate([found.samples, found.predictions])
    parts = found.alternatives()
    assert sorted(c for cells, _ in parts for c in cells.tolist()) == list(range(every.shape[1]))
    for cells, partitions in parts:
        expected = set()
        for row in every[:, cells]:
            joined = [[int(a == b and (a > 0 or i == j)) for j, b in enumerate(row)] for i, a in enumerate(row)]
            expected.add(str(joined))
        assert {str((one[:, None] == one[None]).astype(int).tolist()) for one in partitions} == expected
        assert len(partitions) == len(expected)


def two_halves():
    """Two cells side by side: the samples and the predictions differ about them."""
    one, two = np.ones(SHAPE, int), np.ones(SHAPE, int)
    two[:, 3:] = 2
    return one.ravel(), two.ravel()


def test_log_odds_by_hand():
    one, two = two_halves()
    nothing = np.zeros_like(one)
    found = Cells.of(PIXELS, SHAPE, [one, two, two, two], [one, two, nothing])
    evidence = PairEvidence(
        alone_constant=0.1, alone_image=0.9, constant=-0.2, image=0.7, past=0.4, past_constant=0.3
    )

    def logit(p):
        return np.log((p + 0.02) / (1 - p + 0.02))

    odds = evidence.log_odds(found, np.array([0.6, 0.2, 0.2]), None)
    right = -0.2 + 0.7 * logit(0.25) + 0.8 * (0.4 * logit(0.6 / 0.8) + 0.3)
    assert odds == pytest.approx([right])
    wrong = 0.1 + 0.9 * logit(0.25)  # with probability 3/4
    odds = evidence.log_odds(found, np.array([0.6, 0.2, 0.2]) / 4, None)
    assert odds == pytest.approx([right / 4 + wrong * 3 / 4])
    alone = Cells.of(PIXELS, SHAPE, [one, two], [])
    assert evidence.log_odds(alone, np.zeros(0), None) == pytest.approx([0.1])


def test_partitions_are_drawn_with_their_weights():
    rng = np.random.default_rng(0)
    rows = [rng.integers(1, 3, (2, 2)).repeat(3, 0)[:5].repeat(3, 1).ravel() for _ in range(4)]
    rows.append(np.arange(1, 5).reshape(2, 2).repeat(3, 0)[:5].repeat(3, 1).ravel())
    found = Cells.of(PIXELS, SHAPE, rows[:3], rows[3:])
    log_odds = rng.normal(size=len(found.pairs))
    n = 20_000
    drawn = found.draw(np.random.default_rng(1), log_odds, n)
    for cells, partitions in found.alternatives():
        weights = []
        for partition in partitions:
            log_weight = 0.0
            for (a, b), odds in zip(found.pairs.tolist(), log_odds, strict=True):
                if a in cells and b in cells:
                    same = partition[cells == a] == partition[cells == b]
                    log_weight -= np.log1p(np.exp(-odds if same else odds))
            weights.append(float(np.exp(log_weight)))
        p = np.array(weights) / sum(weights)
        for partition, expected in zip(partitions, p, strict=True):
            same = (drawn[:, cells][:, :, None] == drawn[:, cells][:, None]) == (
                partition[:, None] == partition[None]
            )
            share = same.all(axis=(1, 2)).mean()
            assert abs(share - expected) < 4.5 * np.sqrt(expected * (1 - expected) / n)  # 1 false alarm in 20,000
    # Cells of different components never share an object.
    component = np.zeros(found.samples.shape[1], int)
    for k, (cells, _) in enumerate(found.alternatives()):
        component[cells] = k
    for label in np.unique(drawn[0]):
        assert len(np.unique(component[drawn[0] == label])) == 1


def test_slivers_join_a_neighbour(monkeypatch):
    monkeypatch.setattr(module, "LEAST", 20 * 307200 / (SHAPE[0] * SHAPE[1] * 6))  # cells of less than 3.3 readings
    one, two = two_halves()
    thin = two.reshape(SHAPE).copy()
    thin[:3, 3] = 1  # a border that is one pixel off
    found = Cells.of(PIXELS, SHAPE, [two, two, thin.ravel()], [one])
    assert found.samples.shape[1] == 2
    assert (found.of_reading.reshape(SHAPE)[:, :3] == found.of_reading[0]).all()


def test_no_objects():
    found = Cells.of(PIXELS, SHAPE, [np.zeros(30, int)], [np.ones(30, int)])
    assert (found.of_reading == -1).all() and found.draw(np.random.default_rng(0), np.zeros(0), 3).shape == (3, 0)

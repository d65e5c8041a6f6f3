"""The mode filter against plain loops, and its effect on thin objects."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from mstfilter.base.errors import InputError
from mstfilter.mst.crossover import ModeFilter


def by_loops(labels, window, margin, isolation):
    half, out = window // 2, labels.copy()
    for x, y, z in np.argwhere(labels > 0):
        box = labels[
            max(x - half, 0) : x + half + 1, max(y - half, 0) : y + half + 1, max(z - half, 0) : z + half + 1
        ]
        count = Counter(box.ravel().tolist())
        free = count.pop(0, 0)
        best = max(count.values())
        winner = max(k for k, c in count.items() if c == best)
        own = labels[x, y, z]
        if winner != own and best >= count[own] + margin:
            out[x, y, z] = winner
        if free > isolation:
            out[x, y, z] = 0
    return out


grids = hnp.arrays(np.uint16, (7, 6, 5), elements=st.sampled_from([0, 0, 0, 1, 1, 2, 5]))


@settings(max_examples=60, deadline=None)
@given(grids, st.sampled_from([1, 3, 5, 7, 11]), st.integers(1, 4), st.integers(5, 125))
def test_one_sweep_against_loops(labels, window, margin, isolation):
    one = ModeFilter(window, margin, isolation, max_sweeps=1)
    expected = by_loops(labels, window, margin, isolation) if window > 1 else labels
    np.testing.assert_array_equal(one.apply(labels), expected)


@pytest.mark.parametrize("seed", range(12))
def test_sweep_after_sweep_against_loops(seed):
    rng = np.random.default_rng(seed)
    window, margin, isolation = int(rng.choice([3, 5])), int(rng.integers(-1, 4)), int(rng.integers(5, 125))
    labels = rng.choice([0, 1, 2, 5], (4, 3, 3), p=[0.1, 0.3, 0.3, 0.3]).repeat(2, 0).repeat(2, 1).repeat(2, 2)
    labels = np.where(rng.random(labels.shape) < 0.4, rng.choice([0, 1, 2, 5], labels.shape), labels).astype(
        np.uint16
    )
    expected = labels
    for sweeps in range(1, 7):
        expected = by_loops(expected, window, margin, isolation)
        filter = ModeFilter(window, margin, isolation, max_sweeps=sweeps)
        np.testing.assert_array_equal(filter.apply(labels), expected)


def test_the_authors_real_estimates_are_fixed_points(shared_data):
    estimates = np.load(shared_data("r1") / "estimate.npz")["labels"][0]
    assert len(estimates) == 5
    for estimate in estimates:
        np.testing.assert_array_equal(ModeFilter(5, 3, 120).apply(estimate), estimate)


def test_thin_objects_are_removed():
    labels = np.zeros((30, 30, 30), np.uint16)
    labels[5:25, 5:20, 4:14] = 1
    labels[8:22, 8:17, 14:16] = 2  # a 2 cm book on a larger box
    labels[27, 27, 4:24] = 3  # an upright rod, one voxel thick
    assert set(np.unique(ModeFilter().apply(labels))) == {0, 1}


def test_an_even_window_is_an_error():
    with pytest.raises(InputError, match="odd"):
        ModeFilter(window=4)

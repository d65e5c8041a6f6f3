"""Degraded masks of experiments/front_ends have the given quality, by splits, merges and displacements."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.scoring import overlap, weighted_coverage
from tests.experiments.scripts import import_script

degradation = import_script("front_ends/degradation.py")
degrade = degradation.degrade


def picture(rng, n=6):
    """Boxes side by side, some touching, at 160 x 120."""
    image = np.zeros((120, 160), np.int32)
    for k in range(1, n + 1):
        row, column = 20 + 40 * ((k - 1) // 3), 15 + 42 * ((k - 1) % 3)
        height, width = rng.integers(14, 38), rng.integers(20, 42)
        image[row : row + height, column : column + width] = k
    return image


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    quality=st.sampled_from([0.5, 0.6, 0.7, 0.8, 0.9, 0.95]),
    shares=st.sampled_from([(0.35, 0.35), (1.0, 0.0), (0.0, 0.0), (0.5, 0.5), (0.0, 1.0)]),
)
def test_the_given_quality_is_reached(seed, quality, shares):
    rng = np.random.default_rng(seed)
    true = picture(rng)
    worse = degrade(rng, true, quality, *shares)
    reached = weighted_coverage(worse, true)
    assert abs(reached - quality) <= 0.011, reached
    assert worse.shape == true.shape
    assert not worse[true == 0].any()


def test_splits_merges_and_displacements_have_their_effect():
    rng = np.random.default_rng(1)
    true = picture(rng)
    table = overlap(degrade(rng, true, 0.8, 1.0, 0.0), true)
    inner = table.counts[table.labels_a > 0][:, table.labels_b > 0]
    assert len(inner) > 6 and ((inner > 0).sum(axis=1) == 1).all()  # splits alone: no object holds two
    assert inner.sum() == (true > 0).sum()
    merged = degrade(rng, true, 0.7, 0.0, 1.0)
    assert len(np.unique(merged[merged > 0])) < 6
    moved = degrade(rng, true, 0.8, 0.0, 0.0)
    assert len(np.unique(moved[moved > 0])) == 6
    assert (moved > 0).sum() < (true > 0).sum()


@pytest.mark.parametrize("seed", range(5))
def test_split_objects_are_not_merged_again(seed):
    """Merges after splits: each object stays in as many pieces as it was cut into."""
    rng = np.random.default_rng(seed)
    true = np.kron(np.arange(1, 7).reshape(2, 3), np.ones((40, 45), np.int32))  # all touch
    split, names = degradation._split(rng, true, 0.8)
    both = degradation._merge(rng, true, split, names, 0.6)
    assert len(np.unique(split)) > 7 and len(np.unique(both)) < len(np.unique(split))
    for k in range(1, 7):
        assert len(np.unique(both[true == k])) == len(np.unique(split[true == k]))


def test_similar_images_get_similar_errors():
    """An object that has moved by some pixels is split at the same place."""
    rng = np.random.default_rng(3)
    true = picture(rng)
    later = np.where(true == 2, 0, true)
    rows, columns = np.nonzero(true == 2)
    later[rows + 3, columns + 1] = 2
    one, same, other = (
        degrade(np.random.default_rng(s), image, 0.6, 0.5, 0.5) for s, image in ((1, true), (1, later), (2, later))
    )
    still = true == later
    assert weighted_coverage(one * still, same * still) > 0.9
    assert weighted_coverage(one * still, other * still) < 0.8


def test_perfect_masks_and_empty_images_are_unchanged():
    true = picture(np.random.default_rng(0))
    assert (degrade(np.random.default_rng(0), true, 1.0) == true).all()
    assert not degrade(np.random.default_rng(0), true * 0, 0.5).any()


def test_the_same_stream_makes_the_same_masks():
    true = picture(np.random.default_rng(0))
    a, b, c = (degrade(np.random.default_rng(s), true, 0.7) for s in (1, 1, 2))
    assert (a == b).all() and (a != c).any()

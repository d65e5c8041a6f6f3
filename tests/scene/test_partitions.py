"""Canonical labels and the common refinement of partitions, by brute force."""

from __future__ import annotations

import itertools

import numpy as np

from mstfilter.scene import canonical, common_refinement


def test_labels_are_numbered_by_their_first_voxel():
    np.testing.assert_array_equal(canonical(np.array([[[0, 5, 5, 2]]])), [[[0, 1, 1, 2]]])
    np.testing.assert_array_equal(canonical(np.array([[[3, 1, 1, 9]]])), [[[1, 2, 2, 3]]])


def test_refinement():
    """Two places share a cell exactly when all segmentations agree about both."""
    rng = np.random.default_rng(3)
    base = rng.integers(0, 4, (4, 3, 2))
    grids = [np.where(rng.random(base.shape) < 0.25, rng.integers(0, 5, base.shape), base) for _ in range(5)]
    found = common_refinement(grids)
    columns = np.stack([g.ravel() for g in grids])
    cells = found.cells.ravel()
    for a, b in itertools.combinations(range(columns.shape[1]), 2):
        assert (cells[a] == cells[b]) == (columns[:, a] == columns[:, b]).all()
    np.testing.assert_array_equal(cells == 0, (columns == 0).all(axis=0))
    assert found.sizes.sum() == columns.shape[1]
    np.testing.assert_array_equal(found.objects[:, cells] > 0, columns > 0)
    members = [found.objects[:, cells] == k for k in range(1, found.n_objects + 1)]
    own = {frozenset(np.flatnonzero(row == k)) for row in columns for k in set(row.tolist()) - {0}}
    assert {frozenset(np.flatnonzero(m.any(axis=0))) for m in members} == own
    want = [[(a.any(axis=0) & b.any(axis=0)).sum() for b in members] for a in members]
    np.testing.assert_array_equal(found.overlaps()[1:, 1:], want)
    sparse = common_refinement([np.array([0, 65535, 9]), np.array([0, 65535, 65534])])
    np.testing.assert_array_equal(sparse.cells, [0, 2, 1])


def test_the_largest_label():
    labels = np.zeros((20, 20, 25), np.uint16)
    labels[:] = 65535
    assert common_refinement([labels]).n_objects == 1

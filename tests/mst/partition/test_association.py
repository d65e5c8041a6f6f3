"""Which segment continues which predicted object: by cases, and properties of all of them."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from mstfilter.mst.partition import Overlaps
from mstfilter.mst.partition.association import recognised
from mstfilter.scene import Camera, Frame, ObjectRecord, ObjectView, areas_of_colours


def overlaps_of(segments, objects, least):
    """Every reading is a cell."""
    return Overlaps.of(np.array(segments), np.eye(1 + np.max(objects), dtype=int)[objects], least)


def tracks_of(segments, objects, least):
    overlaps = overlaps_of(segments, objects, least)
    return {a: tracks for component in overlaps.components() for a, tracks in overlaps.tracks(component).items()}


@pytest.mark.parametrize(
    ("segments", "objects", "continued"),
    [
        ([1] * 60 + [2] * 240, [1] * 100 + [2] * 200, {1: [1], 2: [2]}),  # the second comes to stand before the first
        ([1] * 20 + [2] * 280, [1] * 100 + [2] * 200, {1: [1], 2: [2]}),
        ([1] * 15 + [2] * 285, [1] * 100 + [2] * 200, {1: [1], 2: [2]}),  # a track has one segment
        ([1] * 15 + [2] * 285 + [3] * 100, [1] * 100 + [2] * 300, {1: [1], 2: [2], 3: []}),
        ([1] * 15 + [2] * 235 + [3] * 150, [1] * 100 + [2] * 300, {1: [1], 2: [], 3: []}),
        ([1] * 50 + [2] * 50, [1] * 100, {1: [], 2: []}),  # an object is split
        ([1] * 51 + [2] * 49, [1] * 100, {1: [1], 2: []}),
        ([1] * 90 + [2] * 10, [1] * 100, {1: [1], 2: []}),
        ([1] * 300, [1] * 100 + [2] * 200, {1: [2, 1]}),  # two objects are merged
        ([1] * 300, [1] * 10 + [2] * 290, {1: [2]}),  # the first is occluded: readings of the second lie near it
        ([1] * 10 + [2] * 290, [1] * 10 + [2] * 290, {1: [1], 2: [2]}),
        ([1] * 100, [0] * 100, {1: []}),
        ([1] * 51 + [0] * 49, [1] * 100, {1: [1]}),  # readings of no segment do not count
        ([1] * 100, [1] * 6 + [0] * 94, {1: [1]}),
    ],
)
def test_which_objects_a_segment_continues(segments, objects, continued):
    objects = objects + [0] * (len(segments) - len(objects))
    assert tracks_of(segments, objects, 20) == continued
    visible = overlaps_of(segments, objects, 20).visible
    assert (1 in visible) == (objects.count(1) > 0 and continued != {1: [2]})


labels = hnp.arrays(np.int64, 60, elements=st.integers(0, 4))


@settings(max_examples=100, deadline=None)
@given(labels, labels)
def test_components_and_tracks_by_brute_force(segments, objects):
    overlaps = overlaps_of(segments, objects, 4)
    pairs = [(a, b) for a in range(1, 5) for b in range(1, 5)]
    shared = {(a, b): int(((segments == a) & (objects == b)).sum()) for a, b in pairs}
    inside = {b: int(((segments > 0) & (objects == b)).sum()) for b in range(1, 5)}
    conflicts = {(a, b) for a, b in pairs if shared[a, b] > 0.1 * min((segments == a).sum(), inside[b])}
    main = {
        max(range(1, 5), key=lambda b: (shared[a, b], -b)) for a in range(1, 5) if any(shared[a, b] for b in inside)
    }
    conflicts = {(a, b) for a, b in conflicts if b in main or inside[b] >= 4}
    assert set(map(tuple, np.argwhere(overlaps.in_conflict).tolist())) == conflicts
    assert overlaps.visible == {b for _, b in conflicts}
    components = overlaps.components()
    assert sorted(a for one in components for a in one.segments) == sorted(set(segments.tolist()) - {0})
    assert [one.segments[0] for one in components] == sorted(one.segments[0] for one in components)
    where = {(kind, k): n for n, one in enumerate(components) for kind in (0, 1) for k in one[kind]}
    assert all(where[0, a] == where[1, b] for a, b in conflicts)
    tracks = tracks_of(segments, objects, 4)
    continued = [b for found in tracks.values() for b in found]
    assert len(continued) == len(set(continued)), "an object is continued by one segment at most"
    for a, found in tracks.items():
        assert all((a, b) in conflicts for b in found)
        assert [shared[a, b] for b in found] == sorted((shared[a, b] for b in found), reverse=True)
    whole = {b for a, b in conflicts if shared[a, b] > 0.5 * inside[b]}
    assert whole <= set(continued), "an object of which a segment has more than half is continued"


def view(colours):
    none = np.zeros((0, 0, 0))
    return ObjectView(np.zeros(3, int), none, none, "", colours=np.asarray(colours, np.float32))


def similarity(a, b):
    return np.minimum(a / a.sum(), b / b.sum()).sum() * np.sqrt(min(a.sum(), b.sum()) / max(a.sum(), b.sum()))


@pytest.mark.parametrize("seed", range(10))
def test_lost_objects_are_recognised(seed):
    """Against all assignments."""
    rng = np.random.default_rng(seed)
    before = rng.dirichlet(np.full(5, 0.3), 3) * rng.uniform(0.5, 2, (3, 1))
    now = np.vstack([before[rng.permutation(3)] * rng.uniform(0.7, 1.4, (3, 1)), rng.dirichlet(np.ones(5), 1)])
    lost = [ObjectRecord(k, 70 + k, views=(view(rng.random(5)), view(row))) for k, row in enumerate(before)]
    alike = np.array([[similarity(a, b) for b in now] for a in before])
    best = max(permutations(range(4), 3), key=lambda order: sum(alike[k, order[k]] for k in range(3)))
    expected = {new: 70 + k for k, new in enumerate(best) if alike[k, new] >= 0.5}
    found = recognised([ObjectRecord(9, 9), *lost], [view(row) for row in now])
    assert {new: record.id for new, record in found.items()} == expected


def test_areas_of_colours():
    """Two squares in a plane: areas, and the same shares at half of the distance. Red is not green."""
    rgb, squares = np.zeros((60, 80, 3), np.uint8), np.zeros((60, 80), np.int64)
    squares[10:20, 10:30], squares[30:50, 40:50] = 1, 2
    rgb[squares == 1], rgb[squares == 2] = (200, 30, 30), (30, 160, 30)
    red, green, near = (
        areas_of_colours(
            Frame(rgb, np.full((60, 80), depth), Camera.from_intrinsics(100.0, 100.0, 40, 30, 80, 60)), squares == k
        )
        for k, depth in ((1, 0.5), (2, 0.5), (1, 0.25))
    )
    assert red.sum() == pytest.approx(200 * 0.005**2, rel=1e-5)
    assert np.allclose(near, red / 4)
    assert np.minimum(red, green).sum() < 0.1 * red.sum()

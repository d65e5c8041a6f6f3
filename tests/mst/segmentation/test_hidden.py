"""Joins of segments on both sides of something nearer, and the tree that contains them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.mst.segmentation import BorderTree, ColourDepthBoundary, SeamTree, hidden
from mstfilter.mst.segmentation.hidden import DISAGREEMENT, _inserted, hidden_pairs, likely_segments, with_joins
from mstfilter.mst.segmentation.regions import REGION, Regions, measure_regions
from mstfilter.mst.segmentation.seams import by_odds
from mstfilter.scene import render
from tests.mst.segmentation.scenes import GRID, boxes, camera, frame_of

WIDTH = 320
BOX, POLE, SHORT = ((12, 36, 0), (48, 42, 8)), ((28, 26, 0), (31, 29, 26)), ((28, 26, 0), (31, 29, 3))


def seen(*corners):
    """Frame of a scene, the true object of each pixel, and the connected parts of all objects as segments."""
    scene = boxes(*corners)
    truth = render(scene, GRID, camera(WIDTH)).labels
    segments = np.zeros(truth.shape, np.int64)
    for k in range(1, int(truth.max()) + 1):
        n, parts = cv2.connectedComponents((truth == k).astype(np.uint8))
        for part in range(1, n):
            segments[parts == part] = segments.max() + 1
    return frame_of(scene, width=WIDTH), truth, segments


def pairs_of(*corners):
    """The pairs of a scene as pairs of true objects, and how they disagree by name."""
    frame, truth, segments = seen(*corners)
    sums = measure_regions(segments, frame, ColourDepthBoundary().boundary(frame)).sums
    pairs, values = hidden_pairs(segments, sums, frame)
    named = [dict(zip(DISAGREEMENT, row.tolist(), strict=True)) for row in values]
    return [tuple(int(truth[segments == k][0]) for k in pair) for pair in pairs], named


def test_a_pole_divides_a_box():
    pairs, [found] = pairs_of(BOX, POLE)
    assert pairs == [(1, 1)]
    assert max(found.values()) < 0.5


def test_what_is_seen_between_two_boxes_is_not_hidden():
    left, right = ((12, 36, 0), (26, 42, 8)), ((34, 36, 0), (48, 42, 8))
    assert pairs_of(left, right)[0] == []  # nothing is nearer
    assert pairs_of(left, right, SHORT)[0] == []  # something stands before the gap, but is too low


def test_a_box_that_a_pole_does_not_divide_has_no_pair():
    assert pairs_of(BOX, SHORT)[0] == []


def test_two_boxes_behind_a_pole_are_a_pair_that_differs():
    left, right = ((12, 36, 0), (30, 42, 8)), ((30, 38, 0), (48, 44, 14))
    pairs, [found] = pairs_of(left, right, POLE)
    assert pairs == [(1, 2)]
    assert found["height"] == pytest.approx(0.6 / 0.45, abs=0.25)  # 6 cm
    assert found["texture"] > 2
    assert found["misfit"] > 0.5


@pytest.mark.parametrize(("even", "joined"), [(1.0, True), (-3.0, False)])
def test_a_join_is_a_node_of_the_tree(monkeypatch, even, joined):
    monkeypatch.setattr(hidden, "EVEN", even)
    frame, _, segments = seen(BOX, POLE)
    regions = measure_regions(segments, frame, ColourDepthBoundary().boundary(frame))
    merges = [(1, 3, 2.0), (4, 2, 5.0)]  # one side of the box and the pole, then the other side
    found = with_joins(merges, regions, frame)
    if joined:
        [(a, b, odds), last] = found
        assert (a, b, last) == (1, 2, (4, 3, 2.0))
        assert -hidden.SLOPE <= odds < -hidden.SLOPE / 2  # the disagreement is below one half
    else:
        assert found == merges


@pytest.mark.parametrize("kind", [BorderTree, lambda joins: SeamTree(base=BorderTree(joins=joins))])
def test_the_trees_have_the_join(kind):
    frame, truth, _ = seen(BOX, POLE)
    boundary = ColourDepthBoundary().boundary(frame)
    for joins in (True, False):
        tree = kind(joins=joins).build(boundary, frame)
        masks = [tree.mask(node) for node in range(tree.n_nodes - 1)]
        box, pole = truth == 1, truth == 2
        whole = [m for m in masks if (m & box).sum() > 0.9 * box.sum() and (m & pole).sum() < 0.1 * pole.sum()]
        assert bool(whole) == joins


def random_tree(rng, n):
    """Merges of n regions, in ascending order of log odds as agglomeration makes them, or nearly."""
    alive, merges, odds = list(range(1, n)), [], -6.0
    while len(alive) > 1:
        a, b = rng.choice(alive, 2, replace=False).tolist()
        odds += float(rng.exponential(1.0)) - 0.2
        merges.append((a, b, odds))
        alive = [one for one in alive if one not in (a, b)] + [n + len(merges) - 1]
    return merges


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000))
def test_the_order_of_merges_by_log_odds_keeps_the_nodes(seed):
    """From any order in which children come first, as an examination makes merges."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 14))
    merges = [(a, b, float(rng.normal(0, 4))) for a, b, _ in random_tree(rng, n)]
    found = by_odds(merges, n)
    nodes, most = [], []
    for these in (merges, found):
        below = {k: frozenset([k]) for k in range(n)}
        largest = dict.fromkeys(range(n), -np.inf)
        for k, (a, b, odds) in enumerate(these):
            below[n + k], largest[n + k] = below[a] | below[b], max(odds, largest[a], largest[b])
        nodes.append({(below[n + k], odds) for k, (_, _, odds) in enumerate(these)})
        most.append([largest[n + k] for k in range(len(these))])
    assert nodes[0] == nodes[1] and most[1] == sorted(most[0])


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000))
def test_joins_keep_segments_and_every_region_has_one_way_up(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 14))
    merges = random_tree(rng, n)
    regions = Regions(np.arange(n)[None], np.ones((n, REGION["perimeter"].stop)), [{} for _ in range(n)])
    inside, image, sums, nodes = likely_segments(merges, regions)
    assert sums[1:, 0].sum() == n - 1  # each region is in one segment
    s = len(nodes) - 1
    joins = sorted(
        (float(rng.normal(0, 3)), nodes[a + 1], nodes[b + 1])
        for a in range(s)
        for b in range(a + 1, s)
        if rng.uniform() < 0.3
    )
    found = _inserted(merges, n, inside, joins)
    below = {k: frozenset([k]) for k in range(n)}
    for k, (a, b, _) in enumerate(found):
        assert not below[a] & below[b]
        below[n + k] = below[a] | below[b]
    assert len({child for a, b, _ in found for child in (a, b)}) == 2 * len(found)  # no node has two parents
    assert max(below.values(), key=len) == frozenset(range(1, n)) if n > 2 else True
    for node in nodes[1:]:  # segments are nodes of the new tree too
        assert frozenset(np.flatnonzero(image[0] == nodes.index(node)).tolist()) in below.values()
    if not joins:
        assert found == merges
    else:  # the most probable join is a node
        _, a, b = joins[0]
        members = [frozenset(np.flatnonzero(image[0] == nodes.index(one)).tolist()) for one in (a, b)]
        assert any(members[0] <= one and members[1] <= one for one in below.values())

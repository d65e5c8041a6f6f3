"""Support and stability: analytic scenes, a voxel-by-voxel oracle, and invariances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.errors import InputError
from mstfilter.fusion.support import Support, stands
from mstfilter.scene import Clip, Frame, Hypothesis, VoxelGrid
from tests.scene.scenes import CAMERA, GRID, table_scene

CLIP = Clip((Frame(*table_scene()[:2], CAMERA),), GRID, 0)


def scene(*boxes, grid=GRID):
    """Boxes (x0, x1, y0, y1, z0, z1) in voxels, labels 1, 2, ...; later ones paint over earlier ones."""
    labels = np.zeros(grid.shape, np.uint16)
    for label, (x0, x1, y0, y1, z0, z1) in enumerate(boxes, start=1):
        labels[x0:x1, y0:y1, z0:z1] = label
    return Hypothesis.from_labels(labels, grid)


def score(*boxes, **fields):
    return Support(**fields).log_score([scene(*boxes)], CLIP)[0]


BOX = (20, 30, 20, 30)
UPON = (22, 28, 22, 28)


def test_a_box_on_the_table_costs_nothing_and_one_in_the_air_does():
    assert score((*BOX, 0, 8)) == 0
    heights = [score((*BOX, z, z + 8)) for z in range(6)]
    assert heights[0] == heights[1] == 0  # a voxel's tolerance
    # Above it, in proportion up to three voxels; 30 nats when all that there is floats.
    assert heights[2:] == pytest.approx([-10, -20, -30, -30])
    assert score((*BOX, 1, 8), tolerance=0) == pytest.approx(-10)


def test_only_the_share_that_floats_costs():
    stays, floats = (5, 15, 20, 30, 0, 6), (40, 50, 20, 30, 5, 7)
    assert score(stays, floats) == pytest.approx(-30 * 200 / 800)


def test_a_stack_stands_in_any_order_of_labels():
    assert score((*BOX, 0, 5), (*UPON, 5, 9), (*UPON, 9, 12)) == 0
    assert score((*UPON, 9, 12), (*UPON, 5, 9), (*BOX, 0, 5)) == 0
    # Without the one below, the upper two fall together by its height.
    found = stands(scene((*UPON, 5, 9), (*UPON, 9, 12)))
    assert [found[k].gap for k in (1, 2)] == [4, 8]  # each to the table: the other does not carry it
    assert score((*UPON, 5, 9), (*UPON, 9, 12)) == -30


def test_a_support_is_below():
    tall = (20, 30, 20, 30, 0, 20)
    beside, under = (30, 36, 20, 30, 8, 12), (32, 38, 20, 30, 8, 12)
    assert stands(scene(tall, beside))[2].gap == 7  # touches the side of a tall one
    shelf = (28, 40, 20, 30, 12, 14)
    roof = scene(tall, shelf, under).labels.copy()
    roof[roof == 2] = 1
    assert stands(Hypothesis.from_labels(roof, GRID))[3].gap == 7  # hangs below a shelf
    # Hooked into one another in the air: each has the other below it.
    hooked = np.zeros(GRID.shape, np.uint16)
    hooked[20:30, 20:25, 6:8] = hooked[20:22, 20:30, 6:10] = 1
    hooked[20:30, 25:30, 4:6] = hooked[24:30, 20:30, 9:11] = 2
    found = stands(Hypothesis.from_labels(hooked, GRID), tolerance=2)
    assert found[1].gap == 4 and found[2].gap == 2


@pytest.mark.parametrize("width", range(1, 8))
def test_half_supported_boxes_lean_over(width):
    """A box of 10 on a post of `width` at its end: the centre is 5 voxels from that end."""
    post, box = (20, 20 + width, 20, 30, 0, 6), (20, 30, 20, 30, 6, 10)
    found = stands(scene(post, box))
    assert found[2].overhang == pytest.approx(max(5 - width, 0), abs=1e-9)
    assert found[1] == (width * 60, 0, 0)
    assert (score(post, box) < 0) == (width < 5)


def test_a_hull_carries_what_no_leg_is_under():
    legs = [(x, x + 1, y, y + 1, 0, 5) for x, y in ((20, 20), (20, 29), (29, 20), (29, 29))]
    top = (20, 30, 20, 30, 5, 6)
    assert score(*legs, top) == 0
    # On two legs of a diagonal it still balances; on two of a side it does not: 4.5 voxels off, less half a leg.
    assert stands(scene(legs[0], legs[3], top))[3].overhang == 0
    assert stands(scene(legs[0], legs[1], top))[3].overhang == pytest.approx(4)
    # A corner is nearest: 4 voxels along each axis.
    assert stands(scene(legs[0], top))[2].overhang == pytest.approx(4 * np.sqrt(2))


def test_only_what_touches_carries():
    """A post at each end; the other one ends a voxel below the box (it touches within the tolerance), or two."""
    post, box = (20, 23, 20, 30, 0, 6), (20, 30, 20, 30, 6, 10)
    overhang = [stands(scene(post, box, (27, 30, 20, 30, 0, top)))[2].overhang for top in (6, 5, 4)]
    assert overhang == pytest.approx([0, 0, 2])


def test_what_is_not_known_costs_nothing():
    assert score() == 0
    assert score((0, 5, 20, 30, 10, 15)) == 0  # it may stand on something outside the workspace
    assert score((1, 5, 20, 30, 10, 15)) == -30
    high = VoxelGrid((-0.3, -0.3, 0.05), 0.01, GRID.shape)
    assert Support().log_score([scene((*BOX, 0, 5), grid=high)], CLIP)[0] == 0  # nobody sees what is below
    low = VoxelGrid((-0.3, -0.3, -0.05), 0.01, GRID.shape)
    assert Support().log_score([scene((*BOX, 5, 9), grid=low)], CLIP)[0] == 0
    assert Support().log_score([scene((*BOX, 9, 12), grid=low)], CLIP)[0] == pytest.approx(-30)


def test_fields_are_checked():
    for wrong in ({"strength": 0}, {"tolerance": -1}, {"gap": 0}, {"overhang": np.nan}, {"table_height": np.inf}):
        with pytest.raises(InputError, match="support has"):
            Support(**wrong)


SMALL = VoxelGrid((0, 0, 0), 0.01, (14, 14, 10))
boxes = st.lists(
    st.tuples(*[st.integers(1, 9), st.integers(1, 5), st.integers(1, 9), st.integers(1, 5)], st.integers(0, 6)),
    min_size=1,
    max_size=5,
)


def random_scene(found):
    labels = np.zeros(SMALL.shape, np.uint16)
    for k, (x, dx, y, dy, z) in enumerate(found, start=1):
        labels[x : min(x + dx, 13), y : min(y + dy, 13), z : z + 3] = k
    return Hypothesis.from_labels(labels, SMALL)


def held_by_looking(labels, tolerance):
    """Labels that rest on the table or on others that do, voxel by voxel."""
    held = set()
    while True:
        more = set()
        for x, y in np.ndindex(labels.shape[:2]):
            column = labels[x, y]
            for k in set(column[column > 0].tolist()) - held:
                bottom = int(np.flatnonzero(column == k)[0])
                below = column[max(bottom - 1 - tolerance, 0) : bottom]
                if bottom <= tolerance or any(int(j) in held for j in below):
                    more.add(k)
        if not more:
            return held
        held |= more


@settings(max_examples=60, deadline=None, derandomize=True)
@given(boxes, st.integers(0, 2))
def test_supported_are_those_that_an_oracle_finds(found, tolerance):
    hypothesis = random_scene(found)
    ours = {k for k, stand in stands(hypothesis, tolerance).items() if stand.gap == 0}
    assert ours == held_by_looking(hypothesis.labels, tolerance)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.lists(boxes, min_size=2, max_size=4), st.randoms(use_true_random=False))
def test_names_order_and_direction_do_not_matter(scenes, random):
    hypotheses = [random_scene(s) for s in scenes]
    scores = Support().log_score(hypotheses, CLIP)
    assert (scores <= 0).all() and (scores >= -30).all()
    order = list(range(len(scenes)))
    random.shuffle(order)
    assert np.array_equal(Support().log_score([hypotheses[k] for k in order], CLIP), scores[order])
    names = np.array([0, *random.sample(range(1, 60), 5)], np.uint16)
    renamed = [Hypothesis.from_labels(names[h.labels], SMALL) for h in hypotheses]
    np.testing.assert_allclose(Support().log_score(renamed, CLIP), scores, atol=1e-9)
    turned = [Hypothesis.from_labels(h.labels[::-1].transpose(1, 0, 2), SMALL) for h in hypotheses]
    np.testing.assert_allclose(Support().log_score(turned, CLIP), scores, atol=1e-9)

"""Pushes along open borders: where they touch, which way they go, and what is in the way."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.mst.belief import Belief, push_candidates
from mstfilter.scene import Camera, Hypothesis, VoxelGrid, WeightedSegmentations, look_at, project
from mstfilter.smc import Population

GRID = VoxelGrid((-0.3, -0.3, 0.0), 0.01, (60, 60, 30))
POSE = look_at(np.array([0.0, -0.7, 0.7]), np.array([0.0, 0.0, 0.05]))
CAMERA = Camera.from_intrinsics(260, 260, 159.5, 119.5, 320, 240, POSE)
REACH = ((-0.3, -0.3, 0.0), (0.3, 0.3, 0.3))


def scene(two, other=None):
    """Two boxes in line along x (or one), which meet at x = 0, and perhaps another one in the way."""
    labels = np.zeros(GRID.shape, np.uint16)
    labels[20:30, 26:34, :8] = 1
    labels[30:40, 26:34, :8] = 2 if two else 1
    if other is not None:
        labels[other] = 3
    return labels


def belief_of(p_one, other=None):
    hypotheses = tuple(Hypothesis.from_labels(scene(two, other), GRID) for two in (False, True))
    return Belief(Population(hypotheses, np.log([p_one, 1 - p_one])))


def test_pushes_go_along_the_border_and_touch_one_side():
    pushes = push_candidates(belief_of(0.5), CAMERA, REACH)
    assert len(pushes) == 4  # both ways, against both sides
    for push in pushes:
        assert np.allclose(np.abs(push.direction), (0, 1, 0), atol=0.05)
        assert 0.02 < abs(push.contact[0]) < 0.1 and 0 < push.contact[2] < 0.08
        face = -0.04 if push.direction[1] > 0 else 0.04
        assert abs(push.contact[1] - face) < 0.011
        assert np.isclose(push.information, np.log(2), atol=0.02)
        assert np.allclose(push.end - push.start, 0.1 * push.direction)
        row = json.loads(json.dumps(push.row()))
        assert np.allclose(row["contact"], push.contact, atol=1e-5)
        assert np.isclose(row["information"], push.information, atol=1e-4)


def test_the_most_informative_push_asks_the_most_open_question():
    labels = [scene(two) for two in (False, True)]
    second = [np.zeros(GRID.shape, np.uint16) for _ in range(2)]
    for k, one in enumerate(second):
        one[20:30, 8:14, :8] = 4
        one[30:40, 8:14, :8] = 5 if k else 4
    both = [np.maximum(a, b) for a in labels for b in second]
    belief = Belief(
        Population(tuple(Hypothesis.from_labels(g, GRID) for g in both), np.log([0.45, 0.05, 0.45, 0.05]))
    )
    pushes = push_candidates(belief, CAMERA, REACH)
    assert abs(pushes[0].contact[1]) < 0.06  # the row of which nothing is known, not the probable one
    assert pushes[0].information > pushes[-1].information > 0.1


def test_a_thing_in_the_way_and_a_short_reach_leave_pushes_out():
    blocked = belief_of(0.5, other=np.s_[20:30, 21:23, :8])  # before the left box, seen from the camera
    sides = {(push.contact[0] > 0, push.direction[1] > 0) for push in push_candidates(blocked, CAMERA, REACH)}
    assert sides == {(True, True), (True, False), (False, False)}
    right = ((0.0, -0.3, 0.0), (0.3, 0.3, 0.3))
    assert {push.contact[0] > 0 for push in push_candidates(belief_of(0.5), CAMERA, right)} == {True}


def test_a_stack_is_pushed_at_its_upper_part():
    def stack(two):
        labels = np.zeros(GRID.shape, np.uint16)
        labels[24:36, 24:36, :6] = 1
        labels[25:35, 25:35, 6:12] = 2 if two else 1
        return Hypothesis.from_labels(labels, GRID)

    belief = Belief(Population((stack(False), stack(True)), np.log([0.5, 0.5])))
    pushes = push_candidates(belief, CAMERA, REACH)
    assert pushes and all(0.06 < push.contact[2] < 0.12 for push in pushes)


def test_candidates_of_an_update_open_borders_that_the_kept_hypotheses_do_not():
    kept = Population((Hypothesis.from_labels(scene(True), GRID),))
    image = project(kept.particles[0], CAMERA)
    ways = WeightedSegmentations(image.astype(np.int64), np.array([[1, 1], [1, 2]]), np.array([0.4, 0.6]), CAMERA)
    belief = Belief(kept, ways)
    assert not push_candidates(belief.kept, CAMERA, REACH)
    assert len(push_candidates(belief, CAMERA, REACH)) == 4
    assert np.isclose(belief.open_borders(CAMERA)[0].one_object, 0.4)
    assert np.isclose(belief.open_borders(CAMERA.scaled(0.5))[:1] == [], True)  # of another camera, nothing is known


def test_a_sure_belief_has_no_pushes():
    assert push_candidates(belief_of(0.999), CAMERA, REACH) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": Camera(CAMERA.K, 320, 240)}, "the camera has no pose"),
        ({"reach": None}, "expected two corners of a box"),
        ({"reach": ((0, 0, 0), (0, 1, 1))}, "expected two corners of a box"),
        ({"reach": ((5, 5, 0), (6, 6, 1))}, "nothing of the grid"),
        (
            {"belief": Belief(Population((Hypothesis.from_labels(np.zeros(GRID.shape, np.uint16), GRID),)))},
            "no objects",
        ),
        ({"length": -1.0}, "length"),
    ],
)
def test_what_cannot_be_asked(change, message):
    with pytest.raises(InputError, match=message):
        push_candidates(**{"belief": belief_of(0.5), "camera": CAMERA, "reach": REACH, **change})

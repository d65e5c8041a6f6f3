"""The answer of a belief: outlines and borders where they are in the image, and sentences that say what is known."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from mstfilter.app.report.answer import Answer, changes, share
from mstfilter.mst.belief import push_candidates
from mstfilter.scene import WeightedSegmentations, project
from tests.mst.belief.test_objects import CAMERA, FAR, GRID, HIDDEN, LEFT, RIGHT, at, belief_of, scene, two_readings


def polygons(path):
    """The vertices of each polygon of a path of SVG."""
    return [
        np.array([[float(x) for x in pair.split(",")] for pair in part.split()])
        for part in re.findall(r"M([^Z]*)Z", path)
    ]


def answer_of(belief, table=None):
    return Answer.of(belief, belief.objects() if table is None else table, CAMERA)


def test_sentences_and_borders_of_two_readings():
    belief = two_readings(p_one=0.25)
    table = belief.objects()
    answer = answer_of(belief, table)
    left, right, hidden = (at(table, box).number for box in (LEFT, RIGHT, HIDDEN))
    assert answer.sentences == [
        "3 objects in view.",
        f"1 is hidden and remembered: {hidden} (.60).",
        f"1 border is open: between objects {left} and {right} (.25 that both sides are one object).",
        f"A push against {answer.push.number}, as the arrow shows, would tell most.",
    ]
    best = push_candidates(belief, CAMERA, (GRID.origin, GRID.upper))[0]
    assert answer.push.number in (left, right)
    np.testing.assert_allclose(answer.push.end, CAMERA.project(best.contact[None])[0][0], atol=1e-6)
    along = np.subtract(answer.push.end, answer.push.start)
    step = CAMERA.project((best.contact + 0.01 * best.direction)[None])[0][0] - answer.push.end
    assert along @ step > 0.9 * np.linalg.norm(along) * np.linalg.norm(step)
    [border] = answer.borders
    assert border.numbers == (left, right) and border.tag.text == ".25"
    # The border is drawn where the boxes touch: the plane x = -0.04 m.
    x, _ = CAMERA.project(np.array([[-0.04, -0.05, 0.0], [-0.04, 0.02, 0.09]]))[0].T
    drawn = np.concatenate(polygons(border.path))
    assert x.min() - 4 < drawn[:, 0].min() and drawn[:, 0].max() < x.max() + 4


def test_two_objects_whose_common_border_is_uncertain_have_no_open_border():
    """Both hypotheses have two objects; in one, the first ends 1 cm farther to the right."""
    other = (np.s_[8:17, 15:22, :9], np.s_[17:24, 15:22, :9])
    belief = belief_of((0.6, scene(LEFT, RIGHT, FAR)), (0.4, scene(*other, FAR)))
    assert belief.open_borders(CAMERA)
    answer = answer_of(belief)
    assert not answer.borders and answer.push is None
    assert answer.sentences == [
        "3 objects in view.",
        "No border is open.",
        "Uncertain by a few pixels is where these meet, which are two: 1 and 2.",
    ]


def test_the_push_asks_about_an_open_border():
    """Where two objects meet is uncertain by 1 cm, and a third one is perhaps two: the push is along the latter."""
    other, parts = (np.s_[8:17, 15:22, :9], np.s_[17:24, 15:22, :9]), (np.s_[30:36, 8:15, :5], FAR)
    whole = list(parts)
    belief = belief_of(
        (0.5, scene(LEFT, RIGHT, whole)), (0.43, scene(*other, whole)), (0.07, scene(*other, *parts))
    )  # more is to be learned about where the first two meet
    answer = answer_of(belief)
    assert answer.meeting and len(answer.borders) == 1
    assert answer.push is not None and answer.push.number in answer.borders[0].numbers


def test_an_object_that_is_perhaps_somewhere_else():
    """A hidden object with the record of a visible one is another place of it, and nothing that is remembered."""
    moved, kept = scene(LEFT, FAR), scene(LEFT, HIDDEN, hidden=(2,))
    kept = replace(kept, objects=(kept.objects[0], replace(kept.objects[1], id=moved.objects[1].id)))
    table = belief_of((0.7, moved), (0.3, kept)).objects()
    far, hidden = (at(table, box).number for box in (FAR, HIDDEN))
    text = f"Perhaps {far} is hidden elsewhere, as {hidden} (.30)."
    assert answer_of(belief_of((0.7, moved), (0.3, kept))).sentences[:2] == ["2 objects in view.", text]


def test_two_borders_of_one_pair_are_named_together():
    answer = answer_of(two_readings(p_one=0.25))
    [border] = answer.borders
    a, b = border.numbers
    twice = replace(answer, borders=(replace(border, one_object=0.19), replace(border, one_object=0.81)))
    text = f"between objects {a} and {b}, at 2 places (.19 and .81 that both sides are one object)"
    assert twice.sentences[-2] == f"1 border is open: {text}."
    inside = replace(border, one_object=0.5, numbers=(a,))
    both = replace(twice, borders=(*twice.borders, inside))
    that = f"inside object {a} (.50)"
    assert both.sentences[-2] == f"2 borders are open: {text}, {that}."


def test_outlines_are_those_of_the_objects():
    belief = two_readings()
    table = belief.objects()
    answer = answer_of(belief, table)
    image = project(belief.estimate(), CAMERA)
    for one, outline in zip(table, answer.outlines, strict=True):
        assert outline.number == one.number and outline.hidden == (not one.visible)
        points = np.concatenate(polygons(outline.path))
        if one.visible:
            rows, columns = np.nonzero(image == one.label)
            np.testing.assert_allclose(points.min(axis=0), (columns.min() + 0.5, rows.min() + 0.5), atol=1.5)
            np.testing.assert_allclose(points.max(axis=0), (columns.max() + 0.5, rows.max() + 0.5), atol=1.5)
        else:  # where it would be seen if nothing were in front of it
            uv = CAMERA.project(belief.grid.centre_of(np.argwhere(belief.estimate().labels == one.label)))[0]
            np.testing.assert_allclose(
                (points.min(axis=0), points.max(axis=0)), (uv.min(axis=0), uv.max(axis=0)), atol=5
            )
        assert outline.tag is not None and outline.tag.text == str(one.number)


def test_tags_have_room():
    answer = answer_of(two_readings())
    tags = [one.tag for one in (*answer.outlines, *answer.borders)]
    places = np.array([tag.place for tag in tags])
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + 1e9 * np.eye(len(places))
    assert apart.min() > 0.04 * answer.box[2]


def test_without_open_borders_and_without_objects():
    assert answer_of(belief_of((1.0, scene(FAR)))).sentences == ["1 object in view.", "No border is open."]
    assert answer_of(belief_of((1.0, scene()))).sentences == ["0 objects in view.", "No border is open."]


def test_parts_with_something_between_them_are_mentioned():
    belief = belief_of((0.6, scene([LEFT, FAR])), (0.4, scene(LEFT, FAR)))
    assert answer_of(belief).sentences[-1] == "Perhaps several objects, with something between them: 1 (.40)."


def test_outlines_follow_the_cells_of_the_image():
    belief = belief_of((1.0, scene(FAR)))
    image = project(belief.estimate(), CAMERA)
    rows, columns = np.nonzero(image)
    cells = np.zeros(image.shape, np.int64)
    cells[rows.min() - 3 : rows.max() + 1, columns.min() : columns.max() + 1] = 1
    seen = WeightedSegmentations(cells, np.array([[1]]), np.ones(1), CAMERA)
    [outline] = answer_of(replace(belief, seen=seen)).outlines
    assert np.concatenate(polygons(outline.path))[:, 1].min() == pytest.approx(rows.min() - 2.5, abs=0.6)


def test_what_a_push_decided():
    """One or two before; a push has moved one part away, hidden another object, and shown a third one again."""
    before = two_readings(p_one=0.25).objects()
    left, right, far, hidden = (at(before, box).number for box in (LEFT, RIGHT, FAR, HIDDEN))
    moved = np.s_[22:30, 9:16, :9]
    other = scene(LEFT, moved, FAR, HIDDEN, seen=2, hidden=(3,))
    records = tuple(
        replace(r, id=900 + r.label) if r.label == 2 else r for r in other.objects
    )  # a new identity, so that the shift counts
    now = belief_of((1.0, replace(other, objects=records))).objects()
    now = now.renumbered([left, right, far, hidden])
    assert changes(before, now) == [
        f"Moved: {right} (by 8 cm).",
        f"{left} and {right} are one object with probability .00 (.25 before).",
        f"{far} is hidden now, and is remembered (1.00).",
        f"{hidden} is seen again.",
    ]
    assert changes(before, before) == ["Nothing changed."]


def test_one_that_turns_out_to_be_two_new_ones_and_lost_ones():
    before = belief_of((0.6, scene([LEFT, RIGHT], FAR)), (0.4, scene(LEFT, RIGHT, FAR))).objects()
    now = belief_of((1.0, scene(LEFT, np.s_[20:28, 12:19, :9], np.s_[1:5, 34:38, :3], seen=2))).objects()
    merged, far = before[0].number, before[1].number
    now = now.renumbered([merged, 8, 9])
    assert changes(before, now) == [
        f"{merged} is two objects, {merged} and 8 (.40 before).",
        "New: 9.",
        f"No longer there: {far} (1.00 before).",
    ]


@pytest.mark.parametrize(("p", "text"), [(0.474, ".47"), (0.0, ".00"), (1.0, "1.00"), (0.999, "1.00")])
def test_share(p, text):
    assert share(p) == text

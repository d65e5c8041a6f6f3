"""The table of objects as plain types: another frame, flat columns, the document of a pause."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.mst.belief.rows import OBJECT_COLUMNS, flat_row, pause_document
from tests.mst.belief.test_objects import CAMERA, FAR, GRID, HIDDEN, at, belief_of, scene, two_readings

TURN = Rotation.from_euler("z", 90, degrees=True)  # x becomes y, y becomes -x
T_BASE_WORLD = RigidTransform.from_components([1.0, 2.0, 0.7], TURN)


def test_rows_in_the_frame_of_a_base():
    pose = RigidTransform.from_components([0.1, 0.0, 0.0], Rotation.from_euler("z", 30, degrees=True))
    h = scene(FAR)
    h = replace(h, objects=(replace(h.objects[0], pose=pose),))
    [one] = belief_of((1.0, h)).objects()
    one = replace(one, spread=np.array([0.01, 0.02, 0.03]))
    row, here = one.row(T_BASE_WORLD), one.row()
    middle = GRID.origin + 0.01 * np.array([33, 18, 2.5])
    np.testing.assert_allclose(here["centre"], middle, atol=1e-5)
    np.testing.assert_allclose(row["centre"], [1 - middle[1], 2 + middle[0], 0.7 + middle[2]], atol=1e-5)
    np.testing.assert_allclose(row["spread"], [0.02, 0.01, 0.03], atol=1e-5)
    # The box has the same corners.
    box = RigidTransform.from_components(row["box_centre"], Rotation.from_quat(row["box_quaternion_xyzw"]))
    corners = 0.5 * np.array(row["sides"]) * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    want = T_BASE_WORLD.apply(one.T_world_box.apply(corners))
    np.testing.assert_allclose(box.apply(corners), want, atol=1e-4)
    # The middle has come from where the inverse motion takes it, whatever the frame, and the object turns about it.
    came_from = T_BASE_WORLD.apply(pose.inv().apply(middle))
    np.testing.assert_allclose(row["moved"], np.array(row["centre"]) - came_from, atol=2e-5)
    assert np.linalg.norm(row["moved"]) == pytest.approx(np.linalg.norm(here["moved"]), abs=2e-5)
    turned, before = Rotation.from_quat(row["turned_quaternion_xyzw"]), np.array([0.05, -0.1, 0.02])
    np.testing.assert_allclose(
        turned.apply(T_BASE_WORLD.apply(before) - came_from) + row["centre"],
        T_BASE_WORLD.apply(pose.apply(before)),
        atol=1e-4,
    )
    same = ("object", "existence", "volume", "volume_range", "sides", "colour", "one_with")
    assert all(row[name] == here[name] for name in same) and list(row) == list(here)


def test_flat_rows_have_one_value_a_column():
    table = two_readings(p_one=0.25).objects()
    for one in table:
        row = one.row()
        flat = flat_row(row)
        assert tuple(flat) == OBJECT_COLUMNS
        assert all(value is None or isinstance(value, (str, int, float)) for value in flat.values())
        assert [flat["centre_x"], flat["centre_y"], flat["centre_z"]] == row["centre"]
        assert [flat[f"box_q{k}"] for k in "xyzw"] == row["box_quaternion_xyzw"]
        assert [flat["volume_low"], flat["volume_high"]] == row["volume_range"]
        assert flat["red"] is flat["blue"] is None  # nothing is known of its colour
        shown = dict(pair.split(":") for pair in flat["one_with"].split())
        assert {int(k): float(p) for k, p in shown.items()} == pytest.approx(dict(one.one_with))
    assert flat_row({"colour": [1, 2, 3]}) == {"red": 1, "green": 2, "blue": 3}


def test_the_document_of_a_pause():
    belief = two_readings(p_one=0.25)
    table = belief.objects()
    found = json.loads(json.dumps(pause_document(table, belief.open_borders(CAMERA), pause=1, time=2.5)))
    assert list(found) == ["pause", "time", "objects", "open_borders"]
    assert found["objects"] == json.loads(json.dumps(table.rows()))
    [border] = found["open_borders"]
    assert border["one_object"] == pytest.approx(0.25) and border["middle"] in border["pixels"]
    hidden = at(table, HIDDEN)
    assert [row["object"] for row in found["objects"] if not row["visible"]] == [hidden.number]

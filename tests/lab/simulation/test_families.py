"""Scene families: defaults and invalid fields."""

from dataclasses import replace

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.lab.simulation.families import SCENE_FAMILIES, SceneFamily, scene_family
from mstfilter.lab.simulation.shapes import ANY, REPORTED, TUNING


def test_the_seed_decides_the_catalogue_of_the_studied_families():
    for name in ("s1", "s2", "s3"):
        family = scene_family(name)
        assert {family.pool(seed) for seed in (0, 99, 999)} == {TUNING}
        assert {family.pool(seed) for seed in (1000, 5000)} == {REPORTED}
    assert scene_family("table").pool(0) == ANY


def test_studied_families_differ_only_in_their_objects():
    s1, s2, s3 = (scene_family(name) for name in ("s1", "s2", "s3"))
    number = ("name", "n_objects_min", "n_objects_max", "n_twins", "n_stacked", "n_hidden", "min_moved")
    for other in (s2, s3):
        assert replace(s1, **{field: getattr(other, field) for field in number}) == other
    assert (s1.n_objects_min, s2.n_objects_min, s3.n_objects_min, s3.n_objects_max) == (5, 9, 15, 20)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("n_objects_max", 2),
        ("n_twins", 9),
        ("n_hidden", 5),
        ("catalogue", "mine"),
        ("width", 4097),
    ],
)
def test_fields_out_of_bounds(field, value):
    with pytest.raises(InputError, match=f"{field} is {value!r}, expected"):
        replace(SceneFamily(), **{field: value})


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [("shapes", "can, teapot", "unknown family of shapes 'teapot'"), ("fps", 30.0, "too short to push anything")],
)
def test_unknown_shapes_and_short_actions(field, value, message):
    with pytest.raises(InputError, match=message):
        replace(SceneFamily(), **{field: value})


def test_an_unknown_family_lists_the_known_ones():
    with pytest.raises(InputError) as caught:
        scene_family("kitchen")
    assert "demo" in caught.value.hints[0]


def test_points_in_workspace_and_view():
    demo = SCENE_FAMILIES["demo"]
    inside = demo.contains_points(
        np.array([[0.0, 0.0, 0.05], [0.6, 0.0, 0.05], [0.0, -0.45, 0.05], [0.0, 0.0, -0.5]])
    )
    assert inside.tolist() == [True, False, False, False]


def test_fields_that_were_added_do_not_change_the_description_of_earlier_families():
    described = scene_family("s2").described()
    assert "voxel_size" in described and "sensor" not in described and "objects" not in described
    changed = replace(scene_family("s2"), sensor="d435", camera_higher=10.0).described()
    assert changed == {**described, "sensor": "d435", "camera_higher": 10.0}


def test_cameras_differ_in_focal_length_and_height():
    s1 = scene_family("s1")
    assert (
        replace(s1, sensor="azure").camera().K[0, 0]
        < s1.camera().K[0, 0]
        < replace(s1, sensor="d435").camera().K[0, 0]
    )
    heights = [replace(s1, camera_higher=degrees).camera().position[2] for degrees in (-15.0, 0.0, 30.0)]
    assert heights[0] < heights[1] < heights[2]
    for degrees in (-15.0, 30.0):
        uv, depth = replace(s1, camera_higher=degrees).camera().project(np.array([0.02, 0.05, 0.04]))
        np.testing.assert_allclose(uv, [319.5, 239.5], atol=1e-6)
        assert depth == pytest.approx(0.8)

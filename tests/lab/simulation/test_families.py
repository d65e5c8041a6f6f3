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

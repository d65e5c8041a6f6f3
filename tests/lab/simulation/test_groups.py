"""Groups: one or several, how they stand, and pushes with an aim."""

from dataclasses import replace

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.lab.simulation import PUSH_AIMS, SimulatedScene, part_image, scene_family, simulate_recording
from mstfilter.lab.simulation.groups import draw_group
from mstfilter.lab.simulation.shapes import ANY, draw_shape
from mstfilter.lab.simulation.textures import draw_skin, sliced
from mstfilter.lab.simulation.world import play_push

KINDS = ("row", "stack", "pack")
TINY = {"width": 160, "height": 120, "n_actions": 2, "frames_per_clip": 6, "fps": 3.0, "supersample": False}


@pytest.mark.parametrize("kind", KINDS)
def test_the_share_of_one_is_the_parameter(kind):
    for share in (0.0, 0.3, 1.0):
        family = replace(scene_family(kind), one_share=share)
        n = 60 if share == 0.3 and kind == "row" else 12
        one = [draw_group(np.random.default_rng(k), family, ANY).one for k in range(n)]
        # Five standard deviations of a share of 60.
        assert np.mean(one) == pytest.approx(share, abs=0.3 if n == 60 else (0.7 if share == 0.3 else 0.0))


@pytest.mark.parametrize("kind", KINDS)
def test_groups_stand_at_rest_as_they_were_set_down(kind):
    for seed in range(3):
        scene = SimulatedScene(replace(scene_family(kind), **TINY), seed)
        world, poses = scene.world, scene.world.poses()
        assert world.deepest_overlap() < 0.0015
        world.step(250)
        assert np.linalg.norm(world.positions() - poses[:, :3, 3], axis=1).max() < 0.002
        for group in scene.objects.groups:
            assert group.stands(world.poses())
            assert len(group.objects) == (1 if group.one else len(group.parts))
            turns, at = group.part_poses(world.poses())
            if kind == "stack":
                assert (np.diff(at[:, 2]) > 0.004).all()
                assert np.linalg.norm(np.diff(at[:, :2], axis=0), axis=1).max() < 0.04
            else:
                lowest = [
                    z - np.abs(turn[2]) @ p.shape.half
                    for z, turn, p in zip(at[:, 2], turns, group.parts, strict=True)
                ]
                assert np.abs(lowest).max() < 0.002


def test_parts_of_one_body_stay_in_place_when_it_moves():
    scene = SimulatedScene(replace(scene_family("row"), one_share=1.0, **TINY), 1)
    group = scene.objects.groups[0]
    _, before = group.part_poses(scene.world.poses())
    for action in range(2):
        play_push(scene.world, scene.choose_push(action), scene.family)
    _, after = group.part_poses(scene.world.poses())
    distance = [np.linalg.norm(at[:, None] - at[None], axis=2) for at in (before, after)]
    np.testing.assert_allclose(*distance, atol=1e-9)


@pytest.mark.parametrize(
    ("aim", "seeds"),
    [("nothing", [0]), ("apart", [0]), ("together", [1])]
    + [pytest.param(aim, [0, 1, 2], marks=pytest.mark.nightly) for aim in PUSH_AIMS],
)
def test_pushes_do_what_their_aim_says(aim, seeds):
    """In two of three scenes; the fast tests have a scene in which the aim is reached."""
    reached = 0
    for seed in seeds:
        family = replace(scene_family("row"), one_share=0.0, push_aims=aim, n_candidates=12)
        scene = SimulatedScene(replace(family, **TINY), seed)
        before = [group.part_poses(scene.world.poses())[1] for group in scene.objects.groups]
        assert scene.push_aim(0) == aim
        play_push(scene.world, scene.choose_push(0), scene.family)
        after = [group.part_poses(scene.world.poses())[1] for group in scene.objects.groups]
        moved = [np.linalg.norm(b - a, axis=1) for a, b in zip(before, after, strict=True)]
        change = [
            np.abs(np.linalg.norm(b[:, None] - b, axis=2) - np.linalg.norm(a[:, None] - a, axis=2)).max()
            for a, b in zip(before, after, strict=True)
        ]
        reached += {
            "nothing": max(m.max() for m in moved) < 0.001,
            "apart": max(change) > 0.01,
            "together": any(m.min() > 0.02 and c < 0.004 for m, c in zip(moved, change, strict=True)),
        }[aim]
    assert reached >= (len(seeds) + 1) // 2


def test_the_manifest_and_the_image_of_parts(tmp_path):
    for share in (0.0, 1.0):
        family = replace(scene_family("stack"), one_share=share, **{**TINY, "n_actions": 1})
        recording = simulate_recording(family, 2, tmp_path / str(share))
        groups = recording.manifest["groups"]
        assert [group["one"] for group in groups] == [bool(share)] * 2
        assert recording.manifest["frames"][recording.pauses[1]]["push"]["aim"] in PUSH_AIMS
        parts, instance = part_image(recording, 0), recording.instance(0)
        n = sum(len(group["parts"]) for group in groups)
        assert set(np.unique(parts)) <= set(range(n + 1)) and len(np.unique(parts)) > 3
        owner = [part["object"] for group in groups for part in group["parts"]]
        for k in range(n):
            assert (instance[parts == k + 1] == owner[k]).all()


def test_one_print_over_several_boxes_is_cut_between_them():
    shape = draw_shape(np.random.default_rng(0), "carton")
    skin = draw_skin(np.random.default_rng(1), shape)
    for axis in range(3):
        parts = sliced(skin, axis, 2)
        for face in range(6):
            chart = skin.charts[face]
            if face // 2 == axis:
                np.testing.assert_array_equal(parts[0].charts[face], chart)
                continue
            along = 1 if parts[0].charts[face].shape[0] == chart.shape[0] else 0
            joined = [np.concatenate([a.charts[face], b.charts[face]], axis=along) for a, b in (parts, parts[::-1])]
            assert any(one.shape == chart.shape and (one == chart).all() for one in joined)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_groups": 9}, "n_groups is 9"),
        ({"groups": "heap"}, "groups is 'heap'"),
        ({"groups": "", "n_groups": 1}, "groups of no kind"),
        ({"push_aims": "sideways"}, "unknown aim of pushes 'sideways'"),
        ({"one_share": 1.5}, "one_share is 1.5"),
    ],
)
def test_wrong_fields_of_groups(change, message):
    with pytest.raises(InputError, match=message):
        replace(scene_family("row"), **change)

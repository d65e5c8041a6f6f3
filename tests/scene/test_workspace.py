"""Input that is not plausible gives a warning or an error, in Python and on the command line; other input none."""

from __future__ import annotations

import warnings
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.formats import RecordingWriter, open_recording, save_recording
from mstfilter.scene import Frame, examine
from mstfilter.scene.camera import Camera, look_at
from mstfilter.scene.frame import depth_sigma
from mstfilter.scene.planes import fit_support_plane
from mstfilter.scene.recording import Recording
from tests.app.test_cli import call
from tests.formats.layouts import video
from tests.scene.scenes import CAMERA, GRID, table_scene


def arrays(grid, noise=None, **named):
    rgb, depth, _ = table_scene(noise=noise)
    return Recording.from_arrays(rgb, depth, **{"K": CAMERA.K, "T_world_camera": CAMERA.pose, "grid": grid, **named})


def scaled_focal_length(factor):
    return CAMERA.K * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])


# Further cases, in Python alone, are in tests/wrong_inputs.py.
ERRORS = {
    "focal length that contradicts the plane": (
        {"K": scaled_focal_length(0.8), "grid": None},
        # The camera looks at (0, 0, 0.03) from (0, -0.6, 0.5). The gradient of disparity is measured, so the tangent
        # of the angle between axis and normal, 0.6 / 0.47, is scaled by 0.8: atan(1.277) - atan(1.021) = 6.3 degrees.
        "tilted by 6.",
    ),
}


@pytest.mark.parametrize("case", ERRORS)
def test_input_that_cannot_be_right_is_one_error(case, tmp_path, capsys):
    named, message = ERRORS[case]
    noise = np.random.default_rng(0)
    with pytest.raises(InputError) as caught:
        arrays(noise=noise, **named)
    assert message in caught.value.message
    assert caught.value.hints
    with RecordingWriter(
        tmp_path / "r", Camera(named.get("K", CAMERA.K), 160, 120, CAMERA.pose), named["grid"]
    ) as out:
        out.add_frame(*table_scene(noise=np.random.default_rng(0))[:2], 0.0, "static")
    code, _, err = call("run", tmp_path / "r", "--out", tmp_path / "run", capsys=capsys)
    assert code != 0
    assert err.count("error:") == 1
    assert message in err
    assert not (tmp_path / "run").exists()


def test_a_long_focal_length_gives_a_warning(tmp_path, capsys):
    with pytest.warns(InputWarning, match="field of view of 8.73 degrees") as caught:
        recording = arrays(None, np.random.default_rng(0), K=scaled_focal_length(8), T_world_camera=None)
    assert all(one.message.hints for one in caught)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        save_recording(recording, tmp_path / "r")
    command = ("run", tmp_path / "r", "--preset", "floor_one_blob", "n=1", "--out", tmp_path / "run", "--no-report")
    err = call(*command, capsys=capsys)[2]
    assert err.count("field of view of 8.73 degrees") == 1, err
    assert "hint: check" in err


def test_a_warning_is_given_once_by_each_action(tmp_path):
    with pytest.warns(InputWarning, match="field of view") as caught:
        recording = arrays(None, K=scaled_focal_length(8), T_world_camera=None)
    assert len([one for one in caught if "field of view" in str(one.message)]) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording.clips()  # does not repeat it
    for action in (recording.check, lambda: save_recording(recording, tmp_path / "r")):
        with pytest.warns(InputWarning, match="field of view"):
            action()


def test_a_workspace_with_objects_gives_no_warning(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for grid in (GRID, None):
            arrays(grid, np.random.default_rng(0)).check()
        # Empty at the first pause, objects at the second.
        with RecordingWriter(tmp_path / "r", CAMERA, GRID) as writer:
            for k, empty in enumerate((True, False)):
                rgb, depth, _ = table_scene(empty=empty)
                writer.add_frame(rgb, depth, float(k), "static")
        open_recording(tmp_path / "r").check()


SMALL = Camera.from_intrinsics(262, 262, 159.5, 119.5, 320, 240)


def seen(pose, shift=0, **named):
    rgb, depth, _ = table_scene(shift, np.random.default_rng(shift), camera=SMALL.at(pose), **named)
    return rgb, depth


def around(degrees, distance=0.8, side=0.0):
    """A camera that looks down on the table by an angle."""
    down = np.radians(degrees)
    return look_at((side, -distance * np.cos(down) - 1e-6, distance * np.sin(down)), (0, 0, 0.03))


@pytest.mark.parametrize("degrees", [20, 60, 90])
def test_cameras_at_usual_angles_are_silent(degrees):
    images = [seen(around(degrees), shift) for shift in (0, 4)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Recording.from_arrays(*map(np.stack, zip(*images, strict=True)), SMALL.K)


def test_still_scenes_empty_tables_and_small_tables_are_silent():
    pose = around(40)
    still = [seen(pose)[0]] * 3, [seen(pose)[1] + np.float32(0.0005) * k for k in range(3)]
    empty = [seen(pose, k, empty=True) for k in range(2)]
    rgb, depth = seen(pose)
    points = SMALL.at(pose).unproject(depth)
    beyond = (np.abs(points[..., :2]) > 0.2).any(axis=-1)
    floor = depth * (pose.translation[2] + 0.7) / pose.translation[2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Recording.from_arrays(*map(np.stack, still), SMALL.K, pauses="every")
        Recording.from_arrays(*map(np.stack, still), SMALL.K, pauses=[1])
        Recording.from_arrays(*map(np.stack, zip(*empty, strict=True)), SMALL.K)
        small = np.where(beyond, floor, depth).astype(np.float32)
        Recording.from_arrays(rgb, small, SMALL.K, T_world_camera=pose)


@pytest.mark.parametrize("poses", [np.stack, list])
def test_a_hand_held_camera_has_a_pose_in_every_frame(poses):
    cameras = [around(40), around(44, 0.82, 0.05), around(48, 0.78, -0.06)]
    images = [seen(pose, shift) for pose, shift in zip(cameras, (0, 2, 4), strict=True)]
    rgb, depth = map(np.stack, zip(*images, strict=True))
    given = poses([pose.as_matrix() for pose in cameras]) if poses is np.stack else cameras
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = Recording.from_arrays(rgb, depth, SMALL.K, pauses="every", T_world_camera=given)
    for frame, pose in zip(recording.frames, cameras, strict=True):
        np.testing.assert_allclose(frame.camera.pose.as_matrix(), pose.as_matrix(), atol=1e-12)
    with pytest.raises(InputError, match="has 2 poses for 3 frames"):
        Recording.from_arrays(rgb, depth, SMALL.K, pauses="every", T_world_camera=given[:2])
    with pytest.raises(InputError, match="the camera moves from frame 0 to 1"):
        Recording.from_arrays(rgb, depth, SMALL.K, pauses="every", T_world_camera=cameras[0])


def test_the_workspace_ends_at_a_wall_behind_the_table():
    rgb, depth, _ = table_scene()
    directions = CAMERA.rays() @ CAMERA.pose.as_matrix()[:3, :3].T
    with np.errstate(divide="ignore"):
        wall = (0.5 - CAMERA.position[1]) / directions[..., 1]  # the plane y = 0.5, which is visible up to z = 0.2
    behind = np.where((wall > 0) & (wall < depth), wall, depth)
    assert (behind < depth).sum() > 2000
    alone = Recording.from_arrays(rgb, depth, CAMERA.K, T_world_camera=CAMERA.pose).grid
    grid = Recording.from_arrays(rgb, behind, CAMERA.K, T_world_camera=CAMERA.pose).grid
    assert alone.upper[1] > 0.8 and 0.5 <= grid.upper[1] <= 0.65
    assert grid.origin[1] == alone.origin[1]  # the end of the table near the camera


def test_robot_masks_of_most_pixels_and_of_another_shape_are_named():
    most = np.broadcast_to(np.arange(160) < 110, (1, 120, 160))
    with pytest.warns(InputWarning, match="the robot mask of frame 0 covers 69% of the image"):
        arrays(GRID, robot_masks=most[0])
    rgb, depth, _ = video((0, 1))
    with pytest.raises(InputError, match=r"robot_masks has shape \(120, 160\), expected \(2, 120, 160\)"):
        Recording.from_arrays(rgb, depth, CAMERA.K, robot_masks=most[0])


def test_the_pose_of_a_view_is_examined():
    rgb, depth, _ = table_scene()
    right, wrong = (Frame(rgb, depth, CAMERA.at(pose)) for pose in (CAMERA.pose, CAMERA.pose.inv()))
    main = Frame(rgb, depth, CAMERA)
    assert examine([replace(main, views=(right,))], [0], GRID) == examine([main], [0], GRID)
    found = examine([replace(main, views=(right, wrong))], [0], GRID)
    assert any(one.message.startswith("one of the views: no table is at z = 0") for one in found)
    assert not any(one.stop for one in found)


def test_times_are_numbers_or_dates_of_numpy():
    rgb, depth, _ = video((0, 1))
    seconds = [0.0, 0.25]
    dates = np.datetime64("2024-05-01T10:00:00.000") + np.array([0, 250], "timedelta64[ms]")
    made = [Recording.from_arrays(rgb, depth, CAMERA.K, times=times) for times in (seconds, dates)]
    assert made[0].times == made[1].times == replace(made[0], times=tuple(dates)).times == (0.0, 0.25)
    for wrong in (["10:00:00", "10:00:01"], [datetime(2024, 5, 1, 10), datetime(2024, 5, 1, 11)]):
        with pytest.raises(InputError, match="times of arrays begin with .* expected seconds") as caught:
            Recording.from_arrays(rgb, depth, CAMERA.K, times=wrong)
        assert "total_seconds" in caught.value.hints[0]


def room(wall, floor, half=0.4):
    """Two boxes on a table that ends at x, y = +-`half` metres, a floor, and a wall at y = `wall`."""
    camera = Camera.from_intrinsics(200, 200, 159.5, 119.5, 320, 240, look_at((0.0, -0.7, 1.1), (0, 0, 0)))
    rgb, depth, _ = table_scene(camera=camera)
    directions = camera.rays() @ camera.pose.as_matrix()[:3, :3].T
    points = camera.unproject(depth)
    beyond = (np.abs(points[..., :2]) > half).any(axis=-1) & (points[..., 2] < 0.005)
    with np.errstate(divide="ignore"):
        below = (floor - camera.position[2]) / np.where(directions[..., 2] < 0, directions[..., 2], np.nan)
        behind = (wall - camera.position[1]) / np.where(directions[..., 1] > 0, directions[..., 1], np.nan)
    far = np.fmin(below, behind)
    depth = np.where(beyond, far, np.fmin(depth, behind))
    noise = np.random.default_rng(0).normal(size=depth.shape) * depth_sigma(depth)
    return rgb, (depth + noise).astype(np.float32), camera


def test_a_wall_that_is_farther_is_not_part_of_the_table():
    """A strip of the wall at the height of the table is about 2 % of the readings at z = 0."""
    grids = []
    for wall in (5.0, 0.9):
        rgb, depth, camera = room(wall, -0.72)
        grids.append(Recording.from_arrays(rgb, depth, camera.K, T_world_camera=camera.pose).grid)
    z = camera.unproject(depth)
    strip = (np.abs(z[..., 2]) < 0.01) & (z[..., 1] > 0.8)
    assert strip.sum() > 0.01 * (np.abs(z[..., 2]) < 0.01).sum()
    assert grids[1].upper[1] < 0.6 and grids[0] == grids[1]


@pytest.mark.parametrize(("wall", "floor"), [(1.0, -0.6), (9.0, -0.5), (0.45, -3.0)])
def test_the_table_is_found_before_a_large_floor_and_a_large_wall(wall, floor):
    """The table, at 1.1 m below the camera, has fewer readings than the plane that is behind it."""
    rgb, depth, camera = room(wall, floor, 0.3)
    unposed = Camera(camera.K, camera.width, camera.height)
    fitted = fit_support_plane(Frame(rgb, depth, unposed)).T_world_camera
    up, expected = (pose.rotation.inv().apply([0.0, 0.0, 1.0]) for pose in (fitted, camera.pose))
    assert fitted.translation[2] == pytest.approx(1.1, abs=0.01) and np.degrees(np.arccos(up @ expected)) < 1
    assert not any(one.stop for one in examine([Frame(rgb, depth, camera)], [0], GRID))


def test_a_pose_that_places_the_floor_at_the_height_of_the_table_is_refused():
    rgb, depth, camera = room(1.0, -0.6)
    low = RigidTransform.from_translation([0, 0, 0.6]) * camera.pose
    with pytest.raises(InputError, match="the floor is taken for the table: a second plane is 0.6"):
        Recording.from_arrays(rgb, depth, camera.K, T_world_camera=low, grid=GRID)

"""Input that is not plausible gives a warning or an error, in Python and on the command line; other input none."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.errors import InputError, InputWarning
from mstfilter.formats import RecordingWriter, open_recording, save_recording
from mstfilter.scene.camera import Camera, look_at
from mstfilter.scene.recording import Recording
from mstfilter.scene.voxels import VoxelGrid
from tests.scene.scenes import CAMERA, GRID, table_scene
from tests.test_cli import call

ELSEWHERE = VoxelGrid((3.0, 3.0, 0.0), 0.01, (60, 60, 30))


def arrays(grid, pose=CAMERA.pose, noise=None):
    rgb, depth, _ = table_scene(noise=noise)
    return Recording.from_arrays(rgb, depth, CAMERA.K, T_world_camera=pose, grid=grid)


def scaled_focal_length(factor):
    return CAMERA.K * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])


def deeper(factor):
    return lambda d: factor * d


WRONG_DEPTH_OR_CAMERA = {
    "a tenth of a metre": (deeper(0.1), {}, "the table is 0.078 m from the camera, expected 0.25 to 2 m"),
    "ten metres": (deeper(10), {}, "the table is 7.97 m"),
    "half the scale, known pose": (deeper(0.5), {"T_world_camera": CAMERA.pose}, "at z = 0.250 m, expected z = 0"),
    "focal length that contradicts the plane": (
        deeper(1),
        {"K": scaled_focal_length(0.8), "T_world_camera": CAMERA.pose},
        # The camera looks at (0, 0, 0.03) from (0, -0.6, 0.5). The gradient of disparity is measured, so the tangent
        # of the angle between axis and normal, 0.6 / 0.47, is scaled by 0.8: atan(1.277) - atan(1.021) = 6.3 degrees.
        "tilted by 6.",
    ),
    "voxels of a metre": (deeper(1), {"grid": VoxelGrid((-2, -2, 0.0), 1.0, (4, 4, 1))}, "edges of 1 m"),
    "a wall": (np.ones_like, {}, "all depth readings of the first pause are 1 m"),
    "a misplaced workspace": (deeper(1), {"grid": ELSEWHERE, "T_world_camera": CAMERA.pose}, "has no reading above"),
    "a workspace above the objects": (
        deeper(1),
        {"grid": VoxelGrid((-0.3, -0.3, 0.2), 0.01, (60, 60, 30)), "T_world_camera": CAMERA.pose},
        "spans x -0.30 to 0.30, y -0.30 to 0.30, z 0.20 to 0.50 m, depth readings span x -",
    ),
    "an upside-down pose": (
        deeper(1),
        {"T_world_camera": RigidTransform.from_rotation(Rotation.from_rotvec([np.pi, 0, 0])) * CAMERA.pose},
        "the largest plane is tilted by 180 degrees",
    ),
}
IMPLAUSIBLE = {
    "focal length of a larger image": ({"K": scaled_focal_length(8)}, "field of view of 8.73 degrees"),
    "focal lengths that differ": ({"K": CAMERA.K * [[1, 1, 1], [1, 2, 1], [1, 1, 1]]}, "131 and 262 pixels"),
    "a low workspace": (
        {"grid": VoxelGrid((-0.3, -0.3, 0.0), 0.01, (60, 60, 2)), "T_world_camera": CAMERA.pose},
        "are above the workspace, which ends at z = 0.02 m",
    ),
}


@pytest.mark.parametrize("case", WRONG_DEPTH_OR_CAMERA)
def test_input_that_cannot_be_right_is_an_error(case, tmp_path, capsys):
    change, named, message = WRONG_DEPTH_OR_CAMERA[case]
    rgb, depth, _ = table_scene(noise=np.random.default_rng(0))
    depth = change(depth).astype(np.float32)
    arguments = {"K": CAMERA.K, **named}
    with pytest.raises(InputError) as caught:
        Recording.from_arrays(rgb, depth, **arguments)
    assert message in caught.value.message
    assert caught.value.hints
    camera = Camera(arguments["K"], 160, 120, arguments.get("T_world_camera"))
    with RecordingWriter(tmp_path / "r", camera, arguments.get("grid")) as writer:
        writer.add_frame(rgb, depth, 0.0, "static")
    code, _, err = call("run", tmp_path / "r", "--out", tmp_path / "run", capsys=capsys)
    assert code != 0
    assert err.count("error:") == 1
    assert message in err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("case", IMPLAUSIBLE)
def test_implausible_input_gives_a_warning(case, tmp_path, capsys):
    named, message = IMPLAUSIBLE[case]
    rgb, depth, _ = table_scene(noise=np.random.default_rng(0))
    with pytest.warns(InputWarning) as caught:
        recording = Recording.from_arrays(rgb, depth, **{"K": CAMERA.K, **named})
    texts = [str(one.message) for one in caught]
    assert any(message in text for text in texts), texts
    assert all(one.message.hints for one in caught)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        save_recording(recording, tmp_path / "r")
    command = ("run", tmp_path / "r", "--preset", "floor_one_blob", "n=1", "--out", tmp_path / "run", "--no-report")
    err = call(*command, capsys=capsys)[2]
    assert err.count(message) == 1, err
    assert "hint: check" in err


def test_a_warning_is_given_once_by_each_action(tmp_path):
    grid = VoxelGrid((-0.3, -0.3, 0.0), 0.01, (60, 60, 2))
    with pytest.warns(InputWarning, match="above the workspace") as caught:
        recording = arrays(grid)
    assert len(caught) == 1
    recording.clips()  # does not repeat it
    for action in (recording.check, lambda: save_recording(recording, tmp_path / "r")):
        with pytest.warns(InputWarning, match="above the workspace"):
            action()


def test_a_workspace_with_objects_gives_no_warning(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for grid in (GRID, None):
            arrays(grid, noise=np.random.default_rng(0)).check()
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


@pytest.mark.parametrize("degrees", [20, 45, 60, 75, 90])
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


def test_a_wall_behind_the_table_does_not_move_the_workspace():
    rgb, depth, _ = table_scene()
    directions = CAMERA.rays() @ CAMERA.pose.as_matrix()[:3, :3].T
    with np.errstate(divide="ignore"):
        wall = (0.5 - CAMERA.position[1]) / directions[..., 1]  # the plane y = 0.5, which is visible up to z = 0.2
    behind = np.where((wall > 0) & (wall < depth), wall, depth)
    assert (behind < depth).sum() > 2000
    alone = Recording.from_arrays(rgb, depth, CAMERA.K, T_world_camera=CAMERA.pose)
    np.testing.assert_array_equal(
        Recording.from_arrays(rgb, behind, CAMERA.K, T_world_camera=CAMERA.pose).grid.origin, alone.grid.origin
    )

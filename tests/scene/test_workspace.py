"""Input that is not plausible gives a warning, in Python and on the command line; other input gives none."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.errors import InputWarning
from mstfilter.formats import RecordingWriter, open_recording, save_recording
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


IMPLAUSIBLE = {
    "a tenth of a metre": (lambda d: 0.1 * d, {}, "the median depth is 0.078 m, expected 0.2 to 4 m"),
    "ten metres": (lambda d: 10 * d, {}, "the median depth is 7.8 m"),
    "half the scale, known pose": (
        lambda d: 0.5 * d,
        {"T_world_camera": CAMERA.pose},
        "at z = 0.250 m, expected z = 0",
    ),
    "focal length of a larger image": (lambda d: d, {"K": scaled_focal_length(8)}, "field of view of 8.73 degrees"),
    "focal lengths that differ": (
        lambda d: d,
        {"K": CAMERA.K * [[1, 1, 1], [1, 2, 1], [1, 1, 1]]},
        "131 and 262 pixels",
    ),
    "focal length that contradicts the plane": (
        lambda d: d,
        {"K": scaled_focal_length(0.8), "T_world_camera": CAMERA.pose},
        # The camera looks at (0, 0, 0.03) from (0, -0.6, 0.5). The gradient of disparity is measured, so the tangent
        # of the angle between axis and normal, 0.6 / 0.47, is scaled by 0.8: atan(1.277) - atan(1.021) = 6.3 degrees.
        "tilted by 6.3 degrees",
    ),
    "voxels of a metre": (lambda d: d, {"grid": VoxelGrid((-2, -2, 0.0), 1.0, (4, 4, 1))}, "edges of 1 m"),
    "a wall": (lambda d: np.ones_like(d), {}, "has no reading above the table"),
    "an empty table": (lambda d: table_scene(empty=True)[1], {}, "has no reading above the table"),
    "a low workspace": (
        lambda d: d,
        {"grid": VoxelGrid((-0.3, -0.3, 0.0), 0.01, (60, 60, 2)), "T_world_camera": CAMERA.pose},
        "are above the workspace, which ends at z = 0.02 m",
    ),
}


@pytest.mark.parametrize("case", IMPLAUSIBLE)
def test_implausible_input_gives_a_warning(case, tmp_path, capsys):
    change, named, message = IMPLAUSIBLE[case]
    rgb, depth, _ = table_scene(noise=np.random.default_rng(0))
    arguments = {"K": CAMERA.K, **named}
    with pytest.warns(InputWarning) as caught:
        recording = Recording.from_arrays(rgb, change(depth).astype(np.float32), **arguments)
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


@pytest.mark.parametrize("grid", [ELSEWHERE, VoxelGrid((-0.3, -0.3, 0.2), 0.01, (60, 60, 30))])
def test_a_misplaced_workspace_gives_a_warning(grid, tmp_path):
    with pytest.warns(InputWarning, match="has no reading above the table") as caught:
        recording = arrays(grid)
    assert len(caught) == 1
    assert "check the pose" in caught[0].message.hints[1]
    recording.clips()  # does not repeat it
    for action in (recording.check, lambda: save_recording(recording, tmp_path / "r")):
        with pytest.warns(InputWarning, match=r"spans x .* depth readings span x -"):
            action()


def test_an_upside_down_pose_gives_a_warning():
    flipped = RigidTransform.from_rotation(Rotation.from_rotvec([np.pi, 0, 0])) * CAMERA.pose
    with pytest.warns(InputWarning, match="has no reading above"):
        arrays(GRID, flipped)


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

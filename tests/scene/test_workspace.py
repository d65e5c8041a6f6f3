"""A workspace without readings above the table gives a warning; other workspaces give none."""

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

ELSEWHERE = VoxelGrid((3.0, 3.0, 0.0), 0.01, (60, 60, 30))


def arrays(grid, pose=CAMERA.pose, noise=None):
    rgb, depth, _ = table_scene(noise=noise)
    return Recording.from_arrays(rgb, depth, CAMERA.K, T_world_camera=pose, grid=grid)


@pytest.mark.parametrize("grid", [ELSEWHERE, VoxelGrid((-0.3, -0.3, 0.2), 0.01, (60, 60, 30))])
def test_a_misplaced_workspace_gives_a_warning(grid, tmp_path):
    with pytest.warns(InputWarning, match="has no reading above the table") as caught:
        recording = arrays(grid)
    assert len(caught) == 1
    assert "check the pose" in caught[0].message.hints[1]
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

"""Recordings: round trips, clips, errors of invalid input, the support plane."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from mstfilter.errors import InputError
from mstfilter.formats import PairedImages, RecordingWriter, open_recording, save_recording
from mstfilter.scene import Hypothesis, check_grid, write_image
from mstfilter.scene.camera import Camera, look_at
from mstfilter.scene.geometry import fit_support_plane, table_residual, workspace
from mstfilter.scene.recording import Recording
from mstfilter.scene.voxels import VoxelGrid
from tests.scene.scenes import CAMERA, GRID, table_scene


def write(path, n=5, statics=(0, 2, 4)):
    with RecordingWriter(path, CAMERA, GRID, generator="test", seed=1) as writer:
        for index in range(n):
            rgb, depth, labels = table_scene(shift=index)
            role = "static" if index in statics else "action"
            writer.add_frame(rgb, depth, index / 5, role, robot_mask=depth < 0.3 if index == 1 else None)
            if role == "static":
                writer.add_voxels(labels)
    return path


@pytest.fixture
def folder(tmp_path):
    return write(tmp_path / "recording")


def test_round_trip(folder):
    recording = open_recording(folder)
    recording.check()
    rgb, depth, labels = table_scene(shift=2)
    np.testing.assert_array_equal(recording.frames[2].rgb, rgb)
    np.testing.assert_allclose(recording.frames[2].depth, depth, atol=5.1e-4)
    np.testing.assert_array_equal(recording.truth(1), labels)
    assert recording.grid == GRID
    assert recording.frames[1].robot_mask is not None
    assert [len(c) for c in recording.clips()] == [1, 3, 3]
    clip = recording.clips()[2]
    assert (clip.index, clip.times) == (2, (0.4, 0.6, 0.8))
    assert clip.before.key == recording.clips()[1].after.key
    assert not list(folder.parent.glob(".*"))
    again = save_recording(recording, folder.parent / "again", generator="copy")
    assert open_recording(again).key == recording.key


def test_true_poses_are_read_and_invalid_ones_raise_an_error(tmp_path):
    assert open_recording(write(tmp_path / "none")).poses(0) is None
    pose = look_at((0.3, 0.1, 0.5), (0, 0, 0)).as_matrix()
    with RecordingWriter(tmp_path / "r", CAMERA, GRID) as writer:
        for index in range(2):
            rgb, depth, _ = table_scene(index)
            writer.add_frame(rgb, depth, index / 5, "static", poses={"3": pose} if index else None)
    for recording in (
        open_recording(tmp_path / "r"),
        open_recording(save_recording(open_recording(tmp_path / "r"), tmp_path / "s")),
    ):
        assert recording.poses(0) is None
        assert list(recording.poses(1)) == [3]
        np.testing.assert_allclose(recording.poses(1)[3], pose, atol=1e-12)
    for text in ("[{}]", "[", '[{"frame": 0, "T_world_object": {"1": [[1, 2], [3, 4]]}}]', '{"frame": 0}'):
        (tmp_path / "r" / "poses.json").write_text(text)
        with pytest.raises(InputError, match=r"poses\.json"):
            open_recording(tmp_path / "r").poses(0)


def test_a_failed_writer_leaves_no_files(tmp_path):
    with pytest.raises(RuntimeError), RecordingWriter(tmp_path / "r", CAMERA, GRID) as writer:
        rgb, depth, _ = table_scene()
        writer.add_frame(rgb, depth, 0.0, "static")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def change(folder, name, edit):
    data = json.loads((folder / name).read_text())
    edit(data)
    (folder / name).write_text(json.dumps(data))


def drop_scale(folder):
    change(folder, "camera.json", lambda c: c.pop("depth_scale"))


def truncate(folder):
    path = folder / "rgb" / "000003.png"
    path.write_bytes(path.read_bytes()[:-40])


def blank_depth(folder):
    import cv2

    cv2.imwrite(str(folder / "depth" / "000002.png"), np.zeros((CAMERA.height, CAMERA.width), np.uint16))


def small_image(folder):
    import cv2

    cv2.imwrite(str(folder / "rgb" / "000001.png"), np.zeros((10, 12, 3), np.uint8))


def bad_pose(folder):
    def edit(c):
        c["T_world_camera"][0][3] = float("nan")

    change(folder, "camera.json", edit)


def clear(folder):
    shutil.rmtree(folder)
    folder.mkdir()


FAULTS = {
    "missing image": (lambda f: (f / "depth" / "000004.png").unlink(), "image is missing: .*000004"),
    "all-invalid depth": (blank_depth, "no reading at all"),
    "wrong image size": (small_image, "12 x 10"),
    "singular camera": (lambda f: change(f, "camera.json", lambda c: c.update(K=[[0, 0, 0]] * 3)), "not invertible"),
    "depth scale unset": (drop_scale, "depth_scale: field required"),
    "depth scale wrong": (lambda f: change(f, "camera.json", lambda c: c.update(depth_scale=1.0)), "median of"),
    "pose NaN": (bad_pose, "NaN"),
    "empty folder": (clear, "folder is empty"),
    "no folder": (shutil.rmtree, "does not exist"),
    "truncated PNG": (truncate, "truncated"),
    "no manifest": (lambda f: (f / "manifest.json").unlink(), "manifest.json is missing"),
    "not JSON": (lambda f: (f / "camera.json").write_text("{"), "not valid JSON"),
    "no pause": (
        lambda f: change(f, "manifest.json", lambda m: [e.update(role="action") for e in m["frames"]]),
        "no frame has role static",
    ),
    "other version": (lambda f: change(f, "manifest.json", lambda m: m.update(version=9)), "version is 9"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_invalid_recordings(folder, fault):
    spoil, message = FAULTS[fault]
    spoil(folder)
    with pytest.raises(InputError, match=message):
        open_recording(folder).check()


def test_arrays_without_pose_find_table_and_workspace():
    rgb, depth, _ = table_scene()
    bare = Recording.from_arrays(rgb, depth.astype(float), CAMERA.K)
    frame = bare.frames[0]
    known = CAMERA.unproject(depth)
    found = frame.points
    # The table is at z = 0 and heights are right, though x and y may be turned.
    np.testing.assert_allclose(found[..., 2], known[..., 2], atol=3e-3)
    assert np.nanmax(np.abs(table_residual(frame)[labels_of(depth) == 0])) < 2
    object_points = found[labels_of(depth) > 0]
    assert bare.grid.contains(bare.grid.index_of(object_points + [0, 0, 1e-3])).mean() > 0.97


def labels_of(depth):
    from mstfilter.scene.rendering import render

    return render(table_scene()[2], GRID, CAMERA).labels


def test_invalid_arrays():
    rgb, depth, _ = table_scene()
    K = CAMERA.K
    for arguments, message in (
        ((rgb, (depth * 1000).astype(np.uint16), K), "metres"),
        ((rgb, depth * 1000, K), "median of"),
        ((rgb, depth[:-1], K), "expected"),
        ((rgb, np.full_like(depth, np.nan), K), "no reading at all"),
        ((rgb, depth, np.zeros((3, 3))), "not invertible"),
    ):
        with pytest.raises(InputError, match=message):
            Recording.from_arrays(*arguments)
    with pytest.raises(InputError, match="pauses"):
        Recording.from_arrays(rgb, depth, K, pauses=[3])
    with pytest.raises(InputError, match="colour images of arrays have different shapes"):
        Recording.from_arrays([rgb[0], rgb[0][1:]], depth[:2], K)
    with pytest.raises(InputError, match="from the end or in seconds as text"):
        Recording.from_arrays(rgb, depth, K, pauses=[0, -1])
    assert Recording.from_arrays(rgb, depth, K, pauses=0).pauses == (0,)
    with pytest.raises(InputError, match="NaN"):
        Recording.from_arrays(rgb, depth, K, T_world_camera=np.full((4, 4), np.nan))


def test_support_plane_of_known_pose():
    """Pose and plane of a noisy tilted table with a box are estimated."""
    rgb, depth, _ = table_scene(noise=np.random.default_rng(0))
    recording = Recording.from_arrays(rgb, depth, CAMERA.K)
    plane = fit_support_plane(recording.frames[0])
    tilt = np.degrees(
        np.arccos(np.clip(plane.T_world_camera.as_matrix()[2, :3] @ CAMERA.pose.as_matrix()[2, :3], -1, 1))
    )
    assert tilt < 0.3
    assert abs(plane.T_world_camera.translation[2] - CAMERA.position[2]) < 3e-3
    truth = labels_of(depth) == 0
    both = plane.on_or_behind & truth & recording.frames[0].valid
    assert both.sum() / (plane.on_or_behind | (truth & recording.frames[0].valid)).sum() > 0.97


def test_no_plane_raises_an_error():
    from mstfilter.scene.frame import Frame

    depth = np.full((CAMERA.height, CAMERA.width), np.nan)
    depth[0, :5] = 1
    with pytest.raises(InputError, match="no support plane"):
        fit_support_plane(Frame(table_scene()[0], depth, CAMERA))
    scatter = np.random.default_rng(0).uniform(0.3, 3, depth.shape)
    with pytest.raises(InputError, match="no support plane"):
        fit_support_plane(Frame(table_scene()[0], scatter, CAMERA))


def test_workspace_of_an_empty_table():
    rgb, depth, _ = table_scene(empty=True)
    from mstfilter.scene.frame import Frame

    grid = workspace(Frame(rgb, depth, CAMERA))
    assert grid.shape == (100, 100, 50)
    far = Camera(CAMERA.K, CAMERA.width, CAMERA.height, look_at((0, 0, 5), (0, 0.1, 9)))
    with pytest.raises(InputError, match="no workspace"):
        workspace(Frame(rgb, depth, far))


def test_paired_images(tmp_path, folder):
    recording = open_recording(folder)
    for index in (0, 2):
        shutil.copy(folder / "rgb" / f"{index:06d}.png", tmp_path / f"f{index}_rgb.png")
        shutil.copy(folder / "depth" / f"{index:06d}.png", tmp_path / f"f{index}_depth.png")
    K = CAMERA.K
    info = {"K": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], "depth_scale_m": 0.001}
    (tmp_path / "info.json").write_text(json.dumps(info))
    pairs = PairedImages(("f2", "f0")).open(tmp_path)
    assert pairs.pauses == (0, 1)
    np.testing.assert_array_equal(pairs.frames[1].rgb, recording.frames[0].rgb)
    with pytest.raises(InputError, match="no frame 'f9'"):
        PairedImages(("f9",)).open(tmp_path)
    for part in ("rgb", "depth"):
        shutil.copy(tmp_path / f"f0_{part}.png", tmp_path / f"f10_{part}.png")
    assert PairedImages().open(tmp_path).name == "f0-f10"  # f0, f2, f10


def test_real_frames_find_their_table(shared_data):
    """On 45 real frames the table is found: intersection over union with the labelled table above 0.9 on average."""
    import cv2

    path = shared_data("real/osd_learn")
    scores = []
    for name in ("learn0", "learn9", "learn17", "learn25", "learn33", "learn41"):
        recording = PairedImages((name,)).open(path)
        label = cv2.imread(str(path / f"{name}_label.png"), cv2.IMREAD_UNCHANGED)
        table = fit_support_plane(recording.frames[0]).on_or_behind & (label > 0)
        scores.append((table & (label == 1)).sum() / (table | (label == 1)).sum())
    assert np.mean(scores) > 0.9


def test_grids_are_stored_exactly(tmp_path):
    rgb, depth, _ = table_scene()
    grid = VoxelGrid((-0.2, -0.25, -0.01), 0.015, (30, 31, 17))
    recording = Recording.from_arrays(rgb, depth, CAMERA.K, T_world_camera=CAMERA.pose, grid=grid)
    assert open_recording(save_recording(recording, tmp_path / "r")).grid == grid


def test_a_moving_camera_keeps_its_poses(tmp_path):
    """Poses by frame are read, used, and written again."""
    from scipy.spatial.transform import RigidTransform

    with RecordingWriter(tmp_path / "r", CAMERA, GRID) as writer:
        for index in range(3):
            rgb, depth, _ = table_scene(shift=index)
            turned = RigidTransform.from_translation([0.01 * index, 0, 0]) * CAMERA.pose
            extra = {"T_world_camera": turned.as_matrix().tolist()} if index else {}
            writer.add_frame(rgb, depth, index / 5, "static", **extra)
    recording = open_recording(tmp_path / "r")
    positions = [recording.frames[k].camera.position for k in range(3)]
    np.testing.assert_allclose(np.diff(positions, axis=0), [[0.01, 0, 0]] * 2, atol=1e-12)
    np.testing.assert_allclose(
        recording.frames[2].points[40, 40] - recording.frames[2].camera.position,
        open_recording(tmp_path / "r").frames[0].camera.at(CAMERA.pose).unproject(recording.frames[2].depth)[40, 40]
        - CAMERA.position,
        atol=1e-9,
    )
    again = open_recording(save_recording(recording, tmp_path / "again"))
    np.testing.assert_allclose([again.frames[k].camera.position for k in range(3)], positions, atol=1e-12)


def test_frames_do_not_share_writable_memory():
    """Changing the arrays of a caller does not change the frame."""
    from mstfilter.scene.frame import Frame

    rgb, depth, _ = table_scene()
    robot = np.zeros(depth.shape, bool)
    frame = Frame(rgb, depth, CAMERA, robot)
    before = frame.rgb.copy()
    rgb[:], depth[:], robot[:] = 0, 9, True
    np.testing.assert_array_equal(frame.rgb, before)
    assert not frame.robot_mask.any()
    assert np.nanmax(frame.depth) < 9
    again = Frame(frame.rgb, frame.depth, CAMERA)
    assert np.shares_memory(again.rgb, frame.rgb)  # read-only memory is shared


MORE_FAULTS = {
    "ragged K": (lambda f: change(f, "camera.json", lambda c: c.update(K=[[1, 2], [3]])), "K"),
    "workspace upside down": (
        lambda f: change(f, "camera.json", lambda c: c["workspace"].update(min=[1, 1, 1], max=[0, 0, 0])),
        "has no voxel",
    ),
    "workspace in mm": (
        lambda f: change(f, "camera.json", lambda c: c["workspace"].update(min=[-500] * 3, max=[500] * 3)),
        "too large",
    ),
    "truncated truth": (
        lambda f: (f / "voxels.npz").write_bytes((f / "voxels.npz").read_bytes()[:300]),
        "cannot be read",
    ),
    "time NaN": (
        lambda f: change(f, "manifest.json", lambda m: m["frames"][1].update(time_s=float("nan"))),
        "ascending",
    ),
}


@pytest.mark.parametrize("fault", MORE_FAULTS)
def test_more_invalid_recordings(folder, fault):
    spoil, message = MORE_FAULTS[fault]
    spoil(folder)
    with pytest.raises(InputError, match=message):
        open_recording(folder).check()


def test_the_plane_does_not_depend_on_the_image_size():
    """Thresholds are in units of the sensor, not of pixels, so a smaller image gives the same plane."""
    rgb, depth, _ = table_scene(noise=np.random.default_rng(0))
    small = CAMERA.scaled(0.5)
    recording = Recording.from_arrays(rgb[::2, ::2], depth[::2, ::2], small.K)
    assert abs(recording.frames[0].camera.position[2] - CAMERA.position[2]) < 6e-3


def test_no_object_has_the_number_of_the_robot(tmp_path, folder):
    """A mask of 0 and 255, the most common one of 8 bits, is an object."""
    recording = open_recording(folder)
    for part in ("rgb", "depth"):
        shutil.copy(folder / part / "000000.png", tmp_path / f"a_{part}.png")
    (tmp_path / "info.json").write_text(json.dumps({"K": CAMERA.K.tolist(), "depth_scale_m": 0.001}))
    frame = recording.frames[0]
    raised = frame.valid & (frame.points[..., 2] > 0.03)
    write_image(tmp_path / "a_label.png", raised.astype(np.uint8) * 255)
    found = PairedImages().open(tmp_path).instance(0)
    assert np.array_equal(found == 256, raised) and not (found == 255).any()


@pytest.mark.parametrize("part", ["rgb", "instance"])
@pytest.mark.parametrize("kind", [np.float64, np.int64])
def test_images_of_another_type_are_not_written(tmp_path, part, kind):
    rgb, depth, _ = table_scene(0)
    images = {"rgb": rgb, "instance": np.zeros(depth.shape, np.uint8)}
    images[part] = images[part].astype(kind)
    message = f"{part} image of frame 0 .* type {np.dtype(kind).name}"
    with pytest.raises(InputError, match=message), RecordingWriter(tmp_path / "r", CAMERA, GRID) as writer:
        writer.add_frame(images["rgb"], depth, 0.0, "static", instance=images["instance"])
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="rgb image of frame 0"), RecordingWriter(tmp_path / "r", CAMERA) as writer:
        writer.add_frame(np.dstack([rgb, rgb[..., :1]]), depth, 0.0, "static")


def test_true_volumes_may_change_after_they_were_added(tmp_path):
    rgb, depth, labels = table_scene(0)
    truth = np.zeros_like(labels, np.uint16)
    with RecordingWriter(tmp_path / "r", CAMERA, GRID) as writer:
        for k in range(3):
            writer.add_frame(rgb, depth, float(k), "static")
            truth[k, 0, 0] = k + 1
            writer.add_voxels(truth)
    again = open_recording(tmp_path / "r")
    assert [int(again.truth(t).max()) for t in range(3)] == [1, 2, 3]


def test_parts_of_a_session_share_a_world(tmp_path):
    """A part with another pose and workspace gets those of the first: the same pixel is at the same place."""
    first = open_recording(write(tmp_path / "first"))
    other = Recording.from_arrays(
        np.stack([f.rgb for f in first.frames]), np.stack([f.depth for f in first.frames]), first.frames[0].camera.K
    )
    assert other.grid != first.grid
    joined = other.in_world_of(first)
    assert joined.grid == first.grid and joined.pauses == other.pauses
    np.testing.assert_allclose(joined.frames[1].points, first.frames[1].points, atol=1e-9)
    hypothesis = Hypothesis.from_labels(np.ones(other.grid.shape, int), other.grid)
    with pytest.raises(InputError, match="grid of prediction") as caught:
        check_grid("prediction", hypothesis, first.grid)
    assert "in_world_of(first)" in caught.value.hints[1]

"""Recordings: round trips, clips, errors of invalid input, the support plane."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.formats import (
    PairedImages,
    RecordingWriter,
    open_recording,
    read_depth,
    read_rgb,
    save_recording,
    write_image,
)
from mstfilter.scene import TABLE_TOLERANCE, Frame, Hypothesis, check_grid, find_world, render
from mstfilter.scene.camera import Camera, look_at
from mstfilter.scene.geometry import workspace
from mstfilter.scene.planes import fit_support_plane, table_residual
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
    grid = VoxelGrid((-0.2, -0.25, -0.01), 0.015, (30, 31, 17))
    given = Recording.from_arrays(rgb, depth, CAMERA.K, T_world_camera=CAMERA.pose, grid=grid)
    assert open_recording(save_recording(given, folder.parent / "given")).grid == grid


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


def test_a_failed_writer_leaves_no_files(tmp_path, monkeypatch):
    images = table_scene()[:2]
    with pytest.raises(RuntimeError), RecordingWriter(tmp_path / "r", CAMERA, GRID) as writer:
        writer.add_frame(*images, 0.0, "static")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []

    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(InputError, match="No space left"), RecordingWriter(tmp_path / "r", CAMERA) as writer:
        writer.add_frame(*images, 0.0, "static")
    assert list(tmp_path.iterdir()) == []


def change(folder, name, edit):
    data = json.loads((folder / name).read_text())
    edit(data)
    (folder / name).write_text(json.dumps(data))


def cut_file(path, n):
    path.write_bytes(path.read_bytes()[:n])


def half_jpeg(folder):
    path = folder / "rgb/000003.png"
    data = cv2.imencode(".jpg", cv2.imread(str(path)))[1].tobytes()
    path.write_bytes(data[: len(data) // 2])


@pytest.mark.parametrize("name", ["T_world_cam", "t_world_camera", "camera_pose", "T_camera_world", "pose"])
def test_a_pose_of_a_frame_under_another_name_gives_a_warning(folder, name):
    change(folder, "manifest.json", lambda m: m["frames"][1].update({name: np.eye(4).tolist(), "action": 3}))
    with pytest.warns(InputWarning, match=f"manifest.json: not read: {name}\n.*T_world_camera"):
        open_recording(folder)


def camera(**entries):
    return lambda folder: change(folder, "camera.json", lambda c: c.update(entries))


def workspace_of(low, high):
    return lambda folder: change(folder, "camera.json", lambda c: c["workspace"].update(min=low, max=high))


def image(name, pixels):
    return lambda folder: write_image(folder / name, pixels)


BLANK = np.zeros((CAMERA.height, CAMERA.width), np.uint16)


def clear(folder):
    shutil.rmtree(folder)
    folder.mkdir()


NAN_POSE = np.full((4, 4), np.nan).tolist()
FAULTS = {
    "missing image": (lambda f: (f / "depth" / "000004.png").unlink(), "image is missing: .*000004"),
    "all-invalid depth": (
        image("depth/000002.png", BLANK),
        "no reading at all",
    ),
    "wrong image size": (image("rgb/000001.png", np.zeros((10, 12, 3), np.uint8)), "12 x 10"),
    "singular camera": (camera(K=[[0, 0, 0]] * 3), "not invertible"),
    "depth scale unset": (
        lambda f: change(f, "camera.json", lambda c: c.pop("depth_scale")),
        "depth_scale: field required",
    ),
    "depth scale wrong": (camera(depth_scale=1.0), "median of"),
    "pose NaN": (camera(T_world_camera=NAN_POSE), "NaN"),
    "empty folder": (clear, "folder is empty"),
    "no folder": (shutil.rmtree, "does not exist"),
    "truncated PNG": (lambda f: cut_file(f / "rgb/000003.png", -40), "truncated"),
    "truncated JPEG": (half_jpeg, "no end of JPEG"),
    "no manifest": (lambda f: (f / "manifest.json").unlink(), "manifest.json is missing"),
    "not JSON": (lambda f: (f / "camera.json").write_text("{"), "camera.json cannot be read: Expecting"),
    "no pause": (
        lambda f: change(f, "manifest.json", lambda m: [e.update(role="action") for e in m["frames"]]),
        "no frame has role static",
    ),
    "other version": (
        lambda f: change(f, "manifest.json", lambda m: m.update(version=9)),
        "version: input should be 1, found 9",
    ),
    "ragged K": (camera(K=[[1, 2], [3]]), "K"),
    "workspace upside down": (workspace_of([1] * 3, [0] * 3), "has no voxel"),
    "workspace in mm": (workspace_of([-500] * 3, [500] * 3), "too large"),
    "truncated truth": (lambda f: cut_file(f / "voxels.npz", 300), "cannot be read"),
    "time NaN": (
        lambda f: change(f, "manifest.json", lambda m: m["frames"][1].update(time_s=float("nan"))),
        "ascending",
    ),
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


@pytest.mark.parametrize("several", [np.ma.stack, list])
def test_masked_depth_is_no_reading(several):
    rgb, depth = (np.stack([image] * 2) for image in table_scene()[:2])
    masked = [np.ma.masked_array(image, np.arange(image.size).reshape(image.shape) % 3 == 0) for image in depth]
    for frame in Recording.from_arrays(rgb, several(masked), CAMERA.K).frames:
        assert np.isnan(frame.depth.ravel()[::3]).all() and not np.isnan(frame.depth.ravel()[1::3]).all()


def test_raw_depth_is_not_written(tmp_path):
    rgb, depth, _ = table_scene()
    with RecordingWriter(tmp_path / "raw", CAMERA, GRID) as writer:
        with pytest.raises(InputError, match="only readings beyond 65.535 m"):
            writer.add_frame(rgb, np.nan_to_num(1000 * depth).astype(np.uint16), 0.0, "static")
        with pytest.raises(InputError, match="role of frame 0"):
            writer.add_frame(rgb, depth, 0.0, "pause")
        writer.add_frame(rgb, depth, 0.0, "static")


def labels_of(depth):
    return render(table_scene()[2], GRID, CAMERA).labels


RGB, DEPTH, _ = table_scene()
INVALID_ARRAYS = {
    "integers": ({"depth": (DEPTH * 1000).astype(np.uint16)}, "metres"),
    "millimetres": ({"depth": DEPTH * 1000}, "median of"),
    "depth of another size": ({"depth": DEPTH[:-1]}, "expected"),
    "no reading": ({"depth": np.full_like(DEPTH, np.nan)}, "no reading at all"),
    "no depth": ({"depth": None}, "depth is None"),
    "K of zeros": ({"K": np.zeros((3, 3))}, "not invertible"),
    "a pause after the end": ({"pauses": [3]}, "pauses"),
    "a pause from the end": ({"pauses": [0, -1]}, "from the end or in seconds as text"),
    "a rotation and a translation": ({"T_world_camera": (np.eye(3), np.zeros(3))}, "parts of T_world_camera have"),
    "ragged images": ({"rgb": [RGB[0], RGB[0][1:]]}, "colour images of arrays have different shapes"),
    "a pose of NaN": ({"T_world_camera": np.full((4, 4), np.nan)}, "NaN"),
}


@pytest.mark.parametrize("case", INVALID_ARRAYS)
def test_invalid_arrays(case):
    change, message = INVALID_ARRAYS[case]
    with pytest.raises(InputError, match=message):
        Recording.from_arrays(**{"rgb": RGB, "depth": DEPTH, "K": CAMERA.K, **change})


def test_support_plane_of_known_pose():
    """Pose and plane of a noisy tilted table with boxes are estimated, whatever the size of the image."""
    rgb, depth, _ = table_scene(noise=np.random.default_rng(0))
    frame = Recording.from_arrays(rgb, depth, CAMERA.K).frames[0]
    plane = fit_support_plane(frame)
    up = plane.T_world_camera.as_matrix()[2, :3] @ CAMERA.pose.as_matrix()[2, :3]
    assert np.degrees(np.arccos(np.clip(up, -1, 1))) < 0.3
    assert abs(plane.T_world_camera.translation[2] - CAMERA.position[2]) < 3e-3
    truth, table = (labels_of(depth) == 0) & frame.valid, plane.residual < TABLE_TOLERANCE
    assert (table & truth).sum() / (table | truth).sum() > 0.97
    # Thresholds are in units of the sensor, not of pixels.
    half = Recording.from_arrays(rgb[::2, ::2], depth[::2, ::2], CAMERA.scaled(0.5).K)
    assert abs(half.frames[0].camera.position[2] - CAMERA.position[2]) < 6e-3


def test_no_plane_raises_an_error():

    depth = np.full((CAMERA.height, CAMERA.width), np.nan)
    depth[0, :5] = 1
    with pytest.raises(InputError, match="no support plane"):
        fit_support_plane(Frame(table_scene()[0], depth, CAMERA))
    scatter = np.random.default_rng(0).uniform(0.3, 3, depth.shape)
    with pytest.raises(InputError, match="no support plane"):
        fit_support_plane(Frame(table_scene()[0], scatter, CAMERA))


def test_workspace_of_an_empty_table():
    rgb, depth, _ = table_scene(empty=True)

    frame = Frame(rgb, depth, CAMERA)
    grid = workspace(frame)
    assert all(100 <= n <= 200 for n in grid.shape[:2]) and grid.shape[2] == 50
    assert grid.contains(grid.index_of(frame.points + [0, 0, 0.02]))[frame.valid].mean() > 0.95
    far = Camera(CAMERA.K, CAMERA.width, CAMERA.height, look_at((0, 0, 5), (0, 0.1, 9)))
    with pytest.raises(InputError, match="no workspace"):
        workspace(Frame(rgb, depth, far))


def test_paired_images(tmp_path, folder):
    recording = open_recording(folder)
    for index, name in ((0, "f0"), (2, "f2"), (0, "f10")):
        for part in ("rgb", "depth"):
            shutil.copy(folder / part / f"{index:06d}.png", tmp_path / f"{name}_{part}.png")
    (tmp_path / "info.json").write_text(json.dumps({"K": CAMERA.K.tolist(), "depth_scale_m": 0.001}))
    pairs = PairedImages(frames=("f2", "f0")).open(tmp_path)
    assert pairs.pauses == (0, 1)
    np.testing.assert_array_equal(pairs.frames[1].rgb, recording.frames[0].rgb)
    with pytest.raises(InputError, match="no frame 'f9'"):
        PairedImages(frames=("f9",)).open(tmp_path)
    pairs = PairedImages().open(tmp_path)
    assert pairs.name == "f0-f10"  # f0, f2, f10
    # A mask of 0 and 255, the most common one of 8 bits, is an object: 255 would be the robot.
    raised = pairs.frames[0].valid & (pairs.frames[0].points[..., 2] > 0.03)
    write_image(tmp_path / "f0_label.png", raised.astype(np.uint8) * 255)
    found = pairs.instance(0)
    assert np.array_equal(found == 256, raised) and not (found == 255).any()


def test_real_frames_find_their_table(shared_data):
    """On 45 real frames the table is found: intersection over union with the labelled table above 0.9 on average."""
    path = shared_data("real/osd_learn")
    scores = []
    for name in ("learn0", "learn9", "learn17", "learn25", "learn33", "learn41"):
        recording = PairedImages(frames=(name,)).open(path)
        label = cv2.imread(str(path / f"{name}_label.png"), cv2.IMREAD_UNCHANGED)
        table = (fit_support_plane(recording.frames[0]).residual < TABLE_TOLERANCE) & (label > 0)
        scores.append((table & (label == 1)).sum() / (table | (label == 1)).sum())
    assert np.mean(scores) > 0.9


def test_a_moving_camera_keeps_its_poses(tmp_path):
    """Poses by frame are read, used, and written again."""
    with RecordingWriter(tmp_path / "r", CAMERA, GRID) as writer:
        for index in range(3):
            rgb, depth, _ = table_scene(shift=index)
            turned = RigidTransform.from_translation([0.01 * index, 0, 0]) * CAMERA.pose
            extra = {"T_world_camera": turned.as_matrix().tolist()} if index else {}
            writer.add_frame(rgb, depth, index / 5, "static", **extra)
    recording = open_recording(tmp_path / "r")
    positions = [recording.frames[k].camera.position for k in range(3)]
    np.testing.assert_allclose(np.diff(positions, axis=0), [[0.01, 0, 0]] * 2, atol=1e-12)
    from_first = CAMERA.unproject(recording.frames[2].depth)[40, 40] - CAMERA.position
    np.testing.assert_allclose(recording.frames[2].points[40, 40] - positions[2], from_first, atol=1e-9)
    again = open_recording(save_recording(recording, tmp_path / "again"))
    np.testing.assert_allclose([again.frames[k].camera.position for k in range(3)], positions, atol=1e-12)


@pytest.mark.parametrize(("part", "kind"), [("rgb", np.float64), ("instance", np.int64)])
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


def test_entries_that_json_cannot_store_are_converted_or_refused(tmp_path):
    rgb, depth, _ = table_scene(0)
    with RecordingWriter(tmp_path / "r", CAMERA, GRID, seed=np.int64(3), note=tmp_path) as writer:
        mask = np.zeros(depth.shape, np.float32)
        mask[:4] = 0.9
        writer.add_frame(rgb, depth, 0.0, "static", T_world_camera=CAMERA.pose.as_matrix(), robot_mask=mask)
        for time, message in ((0.0, "above 0"), (np.nan, "finite"), ("a", "time of frame 1")):
            with pytest.raises(InputError, match=message):
                writer.add_frame(rgb, depth, time, "static")
        with pytest.raises(InputError, match="cannot be stored as JSON"):
            writer.add_frame(rgb, depth, 1.0, "static", note={(1, 2): 3})
    assert open_recording(tmp_path / "r").frames[0].robot_mask.mean() == 4 / depth.shape[0]
    with pytest.raises(InputError, match="has no frame"), RecordingWriter(tmp_path / "empty", CAMERA, GRID):
        pass
    assert not (tmp_path / "empty").exists()


def test_some_frames_may_have_no_robot_mask():
    images = [table_scene(0)[:2] for _ in range(2)]
    rgb, depth = (np.stack(part) for part in zip(*images, strict=True))
    mask = np.zeros(depth.shape[1:], bool)
    mask[:4] = True
    with pytest.warns(InputWarning):  # equal images
        made = Recording.from_arrays(rgb, depth, CAMERA.K, robot_masks=[None, mask])
    assert made.frames[0].robot_mask is None and (made.frames[1].robot_mask == mask).all()
    for changed, message in (({"robot_masks": [mask]}, "robot_masks has shape"), ({}, "no frame")):
        images = (rgb, depth) if changed else (rgb[:0], depth[:0])
        with pytest.raises(InputError, match=message):
            Recording.from_arrays(*images, CAMERA.K, **changed)


@pytest.mark.parametrize("kind", [">u2", "<u2", "float16", ">f8"])
def test_depth_files_of_any_byte_order(tmp_path, kind):
    values = np.array([[0, 1, 2], [1, 2, 1]]).astype(kind)
    np.save(tmp_path / "d.npy", values)
    found = read_depth(tmp_path / "d.npy", 0.001)
    expected = values.astype(float) * (0.001 if "u" in kind else 1)
    np.testing.assert_allclose(found, np.where(expected > 0, expected, np.nan), rtol=1e-6)


@pytest.mark.parametrize(
    ("lower", "upper", "size"),
    [((0, 0, 0), (1, 1), 0.01), ("abc", (1, 1, 1), 0.01), ((0, 0, 0), (1, 1, 1), "x"), ((0,) * 3, (1,) * 3, np.nan)],
)
def test_invalid_bounds_are_one_error(lower, upper, size):
    with pytest.raises(InputError, match="has no voxel|voxel size is"):
        VoxelGrid.from_bounds(lower, upper, size)


RAISED = RigidTransform.from_translation([0.3, -0.2, 0.41]) * RigidTransform.from_rotation(
    Rotation.from_rotvec([0, 0, 0.7])
)


def two_pauses(shifts=(0, 5)):
    images = [table_scene(shift, np.random.default_rng(shift))[:2] for shift in shifts]
    return tuple(np.stack(part) for part in zip(*images, strict=True))


def check_shifted(recording, world):
    """Check that the world is `world`, shifted along z so that its table is at z = 0."""
    expected = (world * CAMERA.pose).as_matrix()
    expected[2, 3] = CAMERA.position[2]
    for frame in recording.frames:
        np.testing.assert_allclose(frame.camera.pose.as_matrix(), expected, atol=2e-3)
    assert recording.grid.origin[2] == pytest.approx(0, abs=2e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording.clips()


@pytest.mark.parametrize("several", [False, True])
@pytest.mark.parametrize("bounded", [False, True])
def test_the_world_of_a_robots_base_is_shifted(tmp_path, several, bounded):
    """Arrays, a recording folder with and without a workspace, with one pose or one of each frame."""
    rgb, depth = two_pauses()
    pose = RAISED * CAMERA.pose
    poses = np.stack([pose.as_matrix()] * 2) if several else pose
    grid = VoxelGrid((0.0, -0.5, 0.41), 0.01, (60, 60, 30)) if bounded else 0.01
    with pytest.warns(InputWarning, match=r"the table is at z = 0\.4\d+ m .* the world is shifted"):
        recording = Recording.from_arrays(rgb, depth, CAMERA.K, T_world_camera=poses, grid=grid)
    check_shifted(recording, RAISED)
    if bounded:
        np.testing.assert_allclose(recording.grid.origin[:2], grid.origin[:2])
    with RecordingWriter(tmp_path / "r", CAMERA.at(pose), grid if bounded else None) as writer:
        for k in range(2):
            more = {"T_world_camera": pose.as_matrix().tolist()} if several else {}
            writer.add_frame(rgb[k], np.round(depth[k], 3), float(k), "static", **more)
    with pytest.warns(InputWarning, match="the world is shifted"):
        check_shifted(open_recording(tmp_path / "r"), RAISED)


@pytest.mark.parametrize("height", [0.03, -0.03, 0.06, -0.2])
def test_a_pose_of_the_wrong_height_is_not_a_moving_camera(height):
    """The workspace on z = 0 stays there."""
    rgb, depth = two_pauses()
    world = RigidTransform.from_translation([0, 0, height])
    with pytest.warns(InputWarning) as caught:
        recording = Recording.from_arrays(rgb, depth, CAMERA.K, T_world_camera=world * CAMERA.pose, grid=GRID)
    assert len(caught) == 1 and f"at z = {height:.2f}" in str(caught[0].message)
    check_shifted(recording, world)
    assert recording.grid == GRID


def test_the_floor_and_a_tray_do_not_shift_the_world():
    """The table at z = 0 is smaller than another level plane."""
    rgb, depth = (part[0] for part in two_pauses())
    points = CAMERA.unproject(depth)
    floor = depth * (CAMERA.position[2] + 0.7) / CAMERA.position[2]
    tray = depth * (CAMERA.position[2] - 0.06) / CAMERA.position[2]
    for other, inside in ((floor, np.abs(points[..., :2]).max(axis=-1) < 0.25), (tray, points[..., 1] > 0.05)):
        changed = np.where(inside | (points[..., 2] > 0.02), depth, other).astype(np.float32)
        camera, _, _ = find_world(Frame(rgb, changed, CAMERA), GRID)
        assert camera is CAMERA


def test_one_camera_matrix_may_be_four_numbers_and_an_alpha_channel_is_dropped(tmp_path):
    rgb, depth = two_pauses()
    expected = Recording.from_arrays(rgb, depth, CAMERA.K)
    alpha = np.concatenate([rgb, np.full_like(rgb[..., :1], 255)], axis=-1)
    for four in ((131, 131, 79.5, 59.5), np.array([131, 131, 79.5, 59.5])):
        assert Recording.from_arrays(alpha, depth, four).key == expected.key
    assert Recording.from_arrays(alpha[0], depth[0], CAMERA.K).frames[0].rgb.shape == (120, 160, 3)
    assert Frame(alpha[0], depth[0], CAMERA).key == Frame(rgb[0], depth[0], CAMERA).key
    cv2.imwrite(str(tmp_path / "a.png"), alpha[0][..., [2, 1, 0, 3]])
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.png"), rgb[0])


def test_a_frame_without_depth_does_not_refuse_arrays():
    rgb, depth = two_pauses((0, 1, 2, 3, 4))
    missing = depth.copy()
    missing[1], missing[4] = np.nan, 0
    recording = Recording.from_arrays(rgb, missing, CAMERA.K, pauses=[0, 3])
    assert [frame.valid.any() for frame in recording.frames] == [True, False, True, True, False]
    with pytest.warns(InputWarning, match="frame 4 of arrays has no depth reading: the pause is at frame 3"):
        assert Recording.from_arrays(rgb, missing, CAMERA.K, pauses=[0, 4], times=np.arange(5) / 10).pauses == (0, 3)
    with pytest.raises(InputError, match="frame 4 has no reading at all") as caught:
        Recording.from_arrays(rgb, missing, CAMERA.K, pauses=[0, 4])
    assert "another pause" in caught.value.hints[0]

"""Reading of every layout, and errors of invalid data."""

from __future__ import annotations

import json
import shutil
import warnings
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.formats import open_recording, read_depth, read_rgb, write_image
from mstfilter.formats.folder import RecordingWriter, save_recording
from mstfilter.formats.pauses import Ends
from mstfilter.formats.redwood import Redwood
from mstfilter.formats.tum import Tum
from mstfilter.formats.video import KnownWorld, pair_stamps, undistortion_map
from mstfilter.scene import Recording
from tests.formats.layouts import (
    FPS,
    PAUSES,
    SHIFTS,
    K,
    units,
    video,
    write_redwood,
    write_tum,
)
from tests.scene.scenes import CAMERA

WORLD = KnownWorld(tuple(CAMERA.pose.as_matrix().ravel()))


def same_frames(recording, shifts, atol=2e-7):
    rgb, depth, _ = video(shifts)
    assert len(recording) == len(shifts)
    for index in range(len(shifts)):
        np.testing.assert_array_equal(recording.frames[index].rgb, rgb[index])
        np.testing.assert_allclose(recording.frames[index].depth, depth[index], atol=atol)
        np.testing.assert_allclose(recording.frames[index].camera.K, CAMERA.K)


def same_on_disk(recording, path):
    """A converted recording is byte-identical."""
    assert open_recording(save_recording(recording, path)).key == recording.key
    assert not list(path.parent.glob(".*"))


def test_large_images_are_reduced(tmp_path):
    path = write_redwood(tmp_path / "video")
    full, small = (Redwood(fps=FPS, world=WORLD, max_pixels=n).open(path) for n in (0, 5000))
    same_frames(full, SHIFTS)
    for index in range(len(small)):
        frame = small.frames[index]
        assert frame.depth.shape == (61, 82) and small.pauses == full.pauses
        seen, exact = frame.points[20:50, 20:60], full.frames[index].points[40:98, 40:117]
        distance, _ = cKDTree(exact[np.isfinite(exact).all(axis=-1)]).query(seen[np.isfinite(seen).all(axis=-1)])
        assert np.quantile(distance, 0.9) < 0.008  # pixels are 8 mm apart


VIDEOS = {
    "tum": (write_tum, Tum(K=K, world=WORLD)),
    "tum in millimetres": (lambda path: write_tum(path, scale=0.001), Tum(K=K, depth_scale=0.001, world=WORLD)),
    "redwood": (write_redwood, Redwood(fps=FPS, world=WORLD)),
}


@pytest.mark.parametrize("layout", VIDEOS)
def test_videos(tmp_path, layout):
    write, reader = VIDEOS[layout]
    recording = reader.open(write(tmp_path / "data"))
    same_frames(recording, SHIFTS)
    assert recording.pauses == PAUSES
    np.testing.assert_allclose(recording.times, np.arange(len(SHIFTS)) / FPS, atol=1e-5)
    same_on_disk(recording, tmp_path / "out")


def test_the_pose_is_found_and_lists_of_other_lengths_are_refused(tmp_path):
    path = write_tum(tmp_path / "tum")
    found = Tum(K=K).open(path).frames[0].camera
    assert abs(found.position[2] - CAMERA.position[2]) < 3e-3
    for wrong, message in ((KnownWorld(workspace=(1.0, 2.0)), "6"), (KnownWorld(T_world_camera=(1.0,)), "16")):
        with pytest.raises(InputError, match=message):
            Tum(K=K, world=wrong).open(path)


def test_entries_of_the_intrinsics_that_are_not_read_are_named(tmp_path):
    path = write_redwood(tmp_path / "data")
    stored = json.loads((path / "intrinsic.json").read_text())
    (path / "intrinsic.json").write_text(json.dumps({**stored, "dist_coeffs": [0.1, 0, 0, 0]}))
    with pytest.warns(InputWarning, match="not read: dist_coeffs\n"):
        Redwood(fps=FPS).open(path)


@pytest.mark.parametrize(
    "names",
    [
        ("1700000000_950000000", "1700000001_050000000"),  # seconds and nanoseconds
        ("2023-11-14T22-13-59.850", "2023-11-14T22-14-00.101"),
    ],
)
def test_names_whose_order_is_not_clear_are_refused(tmp_path, names):
    path = write_redwood(tmp_path / "data", SHIFTS[:2])
    for part in ("color", "depth"):
        for k, name in enumerate(names):
            (path / part / f"{k:05d}.png").rename(path / part / f"{name}.png")
    with pytest.raises(InputError, match=f"{names[0]}.png or {names[1]}.png first"):
        Redwood(K=K).open(path)


def test_the_voxel_size_holds_without_a_workspace(tmp_path):
    path = write_tum(tmp_path / "tum")
    fine, coarse = (Tum(K=K, world=KnownWorld(voxel_size=size)).open(path).grid for size in (0.01, 0.02))
    assert coarse.voxel_size == 0.02 and coarse.shape[2] == 25
    np.testing.assert_allclose(coarse.upper - coarse.origin, fine.upper - fine.origin, atol=0.021)
    for wrong in (0.0, -0.01, float("nan"), 1.0):
        with pytest.raises(InputError, match="voxel size"):
            Tum(K=K, world=KnownWorld(voxel_size=wrong)).open(path)


def camera_to_world(k):
    """The pose at frame k of a trajectory in another world than that of the table.

    The images are those of a still camera, so the poses at the two pauses are equal.
    """
    k = k if k < PAUSES[1] else PAUSES[0]
    return RigidTransform.from_components([1 + 0.01 * k, -2, 0.9], Rotation.from_rotvec([0.3, -0.2, 0.02 * k]))


def check_motion(recording):
    """Check the camera motion relative to the first pause."""
    home = recording.pauses[0]
    # At the first pause the pose is the one that the table gives, not the trajectory's.
    assert abs(recording.frames[home].camera.position[2] - CAMERA.position[2]) < 5e-3
    for k in (0, 5, 11, len(recording) - 1):
        expected = camera_to_world(home).inv() * camera_to_world(k)
        found = recording.frames[home].camera.pose.inv() * recording.frames[k].camera.pose
        np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-9)


def write_trajectory(path):
    """The file of poses of a TUM folder."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for k in range(len(SHIFTS)):
        pose = camera_to_world(k)
        numbers = (1305031102.175 + k / FPS + 0.001, *pose.translation, *pose.rotation.as_quat())
        lines.append(" ".join(f"{v:.12f}" for v in numbers))
    (path / "groundtruth.txt").write_text("\n".join(lines))


def test_tum_trajectory(tmp_path):
    path = write_tum(tmp_path / "tum")
    write_trajectory(path)
    check_motion(Tum(K=K).open(path))
    (path / "groundtruth.txt").write_text("5.0 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="nearest pose"):
        Tum(K=K).open(path)


def test_depth_scale_and_rate_of_the_recorders_of_open3d(tmp_path):
    """Units per metre and frames per second are those of intrinsic.json, unless they are given."""
    path = write_redwood(tmp_path / "frames", SHIFTS, scale=0.00025)
    edit(path / "intrinsic.json", lambda d: d.update(depth_scale=4000.0, fps=FPS, device_name="Intel RealSense L515"))
    recording = Redwood(world=WORLD).open(path)
    _, depth, _ = video()
    assert recording.depth_scale == 0.00025
    np.testing.assert_allclose(recording.times[1], 1 / FPS)
    np.testing.assert_allclose(np.nan_to_num(recording.frames[0].depth), np.nan_to_num(depth[0]), atol=0.0002)
    assert Redwood(depth_scale=0.000251, world=WORLD).open(path).depth_scale == 0.000251


FOUR = json.dumps(dict(zip(("fx", "fy", "cx", "cy"), K, strict=True)))


def write_rgb_and_depth(
    path, names=lambda part, k: f"{k:06d}", intrinsics=("intrinsics.json", FOUR), kind="png", n=None
):
    """The frames of `write_redwood` as rgb/ and depth/ with other names, intrinsics and kind of depth file."""
    write_redwood(path, SHIFTS[:n])
    (path / "color").rename(path / "rgb")
    (path / "intrinsic.json").unlink()
    for part in ("rgb", "depth"):
        for k, file in enumerate(sorted((path / part).iterdir())):
            target = file.rename(file.with_name(f"{names(part, k)}.png"))
            if part == "depth" and kind == "npy":
                np.save(target.with_suffix(".npy"), read_depth(target, 0.001))
                target.unlink()
            elif part == "rgb" and kind == "jpg":
                cv2.imwrite(str(target.with_suffix(".jpg")), read_rgb(target)[..., ::-1])
                target.unlink()
    if intrinsics is not None:
        name, text = intrinsics
        (path / name).write_text(text)
    return path


STAMP = 1_700_000_000
NAMES = {
    "numbers": lambda part, k: str(k),
    "prefix": lambda part, k: f"cam0_{part}_{k:04d}",
    "seconds": lambda part, k: f"{STAMP + k / FPS + (part == 'depth') * 0.004:.6f}",
    "milliseconds": lambda part, k: f"{STAMP * 1000 + k * 100 + (part == 'depth') * 4}.250",
    "nanoseconds": lambda part, k: str(STAMP * 10**9 + k * 10**8 + (part == "depth") * 4_000_000),
}


@pytest.mark.parametrize(
    ("names", "kind"), [*((names, "png") for names in NAMES), ("seconds", "npy"), ("numbers", "jpg")]
)
def test_rgb_and_depth_by_number_or_time(tmp_path, names, kind):
    path = write_rgb_and_depth(tmp_path / "mine", NAMES[names], kind=kind)
    recording = Redwood(fps=FPS, world=WORLD).open(path)
    np.testing.assert_allclose(recording.times, np.arange(len(SHIFTS)) / FPS, atol=1e-6)
    assert recording.pauses == PAUSES
    if kind != "jpg":
        same_frames(recording, SHIFTS)


def test_images_without_a_partner_are_omitted_by_time_and_refused_by_number(tmp_path):
    stamped = write_rgb_and_depth(tmp_path / "stamped", NAMES["seconds"])
    first_file(stamped, "depth").unlink()
    assert len(Redwood(world=WORLD).open(stamped)) == len(SHIFTS) - 1
    numbered = write_rgb_and_depth(tmp_path / "numbered")
    first_file(numbered, "depth").unlink()
    with pytest.raises(InputError, match="17 colour images and 16 depth images"):
        Redwood(world=WORLD).open(numbered)
    same = write_rgb_and_depth(tmp_path / "same", lambda part, k: f"frame_{chr(97 + k)}")
    with pytest.raises(InputError, match="no numbers that differ"):
        Redwood(world=WORLD).open(same)


def test_rgb_and_depth_without_a_file_of_intrinsics(tmp_path):
    path = write_rgb_and_depth(tmp_path / "mine", intrinsics=None)
    with pytest.raises(InputError, match="intrinsics are missing") as caught:
        open_recording(path)
    assert "-o K=fx,fy,cx,cy" in caught.value.hints[0]
    given = open_recording(path, options=["K=131,131,79.5,59.5", "fps=10"])
    np.testing.assert_allclose(given.frames[0].camera.K, CAMERA.K)
    (path / "camera.json").write_text(json.dumps({"K": CAMERA.K.tolist(), "width": 160, "height": 120}))
    np.testing.assert_allclose(open_recording(path, options=["fps=10"]).frames[0].camera.K, CAMERA.K)
    for wrong in ("{}", "[1, 2]", '{"fx": 1}', '{"K": "x"}', '{"fx": 0, "fy": 1, "cx": 2, "cy": 3}', "{"):
        (path / "intrinsics.json").write_text(wrong)
        with pytest.raises(InputError, match="intrinsics.json"):
            open_recording(path)


REALSENSE = {
    **dict(zip(("fx", "fy", "ppx", "ppy"), K, strict=True)),
    "width": 160,
    "height": 120,
    "model": "distortion.inverse_brown_conrady",
    "coeffs": [0.0] * 5,
}


@pytest.mark.parametrize("scale", [0.001, 1000])
@pytest.mark.parametrize("name", ["intrinsics.json", "camera.json"])
def test_intrinsics_of_pyrealsense2(tmp_path, name, scale):
    """Its names, and its depth scale in metres per unit, where Open3D has units per metre."""
    stored = json.dumps({**REALSENSE, "depth_scale": scale, "fps": FPS})
    path = write_rgb_and_depth(tmp_path / "mine", intrinsics=(name, stored))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = Redwood(world=WORLD).open(path)
    same_frames(recording, SHIFTS)
    assert recording.depth_scale == 0.001


def test_distortion_of_pyrealsense2_is_read_and_its_fisheye_models_are_refused(tmp_path):
    bent = {**REALSENSE, "coeffs": [0.3, 0.0, 0.0, 0.0, 0.0]}
    path = write_rgb_and_depth(tmp_path / "mine", intrinsics=("intrinsics.json", json.dumps(bent)), n=1)
    assert Redwood().video(path).distortion == (0.3, 0, 0, 0, 0)
    for model in ("distortion.kannala_brandt4", "distortion.ftheta", 3, 5):
        (path / "intrinsics.json").write_text(json.dumps({**bent, "model": model}))
        with pytest.raises(InputError, match="distortion model is"):
            Redwood().video(path)


def edit(file, change):
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))


def first_file(path, part):
    return sorted((path / part).iterdir())[0]


def other_size(file):
    write_image(file, np.full((60, 80), 700, np.uint16))


def blank(path):
    for file in (path / "depth").iterdir():
        write_image(file, np.zeros((120, 160), np.uint16))


def shift_stamps(file):
    rows = [line.split() for line in file.read_text().splitlines()[1:]]
    file.write_text("".join(f"{float(t) + 1000:.6f} {name}\n" for t, name in rows))


def nothing(path):
    pass


def without(part, k=0):
    return lambda path: sorted((path / part).iterdir())[k].unlink()


def intrinsics(**entries):
    return lambda path: edit(path / "intrinsic.json", lambda data: data.update(entries))


def text(name, content):
    return lambda path: (path / name).write_text(content)


ROW_BY_ROW = intrinsics(intrinsic_matrix=CAMERA.K.ravel().tolist())
TUM = Tum(K=K)
FAULTS = {
    "tum, file missing": (TUM, without("rgb"), "image is missing"),
    "tum, other clock": (TUM, lambda path: shift_stamps(path / "depth.txt"), "within 0.02 s"),
    "tum, not a list": (TUM, text("rgb.txt", "a b\n"), "line 1"),
    "tum, empty list": (TUM, text("depth.txt", "# none\n"), "0 depth images"),
    "tum, sizes differ": (TUM, lambda path: other_size(first_file(path, "depth")), "not registered"),
    "tum, no depth": (TUM, blank, "no reading at all"),
    "tum, K of another size": (Tum(K=(525, 525, 319.5, 239.5)), nothing, "principal point"),
    "tum, three numbers": (Tum(K=(1.0, 2.0, 3.0)), nothing, "3 numbers"),
    "redwood, one of each missing": (
        Redwood(),
        lambda path: (without("depth")(path), without("color", 5)(path)),
        "does not fit depth image",
    ),
    "redwood, other size": (Redwood(), intrinsics(height=240), "images of another height: the images have 120"),
    "redwood, row by row": (Redwood(), ROW_BY_ROW, "expected the rows fx 0 cx"),
    "redwood, no unit": (Redwood(), intrinsics(depth_scale=0), "depth_scale is 0, expected"),
    "redwood, no depth": (Redwood(), lambda path: shutil.rmtree(path / "depth"), "depth is missing"),
}
WRITERS = {"tum": write_tum, "redwood": write_redwood}


@pytest.mark.parametrize("fault", FAULTS)
def test_invalid_data_raise_an_error(tmp_path, fault):
    reader, spoil, message = FAULTS[fault]
    path = WRITERS[fault.partition(",")[0]](tmp_path / "data")
    spoil(path)
    with pytest.raises(InputError, match=message) as caught:
        reader.open(path).check()
    assert "\n" not in caught.value.message


def test_pairs_of_stamps():
    """Each image is used once, also with jitter, gaps and different rates; many omitted images give a warning."""
    rng = np.random.default_rng(0)
    colour = np.arange(60) / 30 + 100
    depth = np.delete(colour + rng.uniform(-0.01, 0.01, 60), [7, 30])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pairs = pair_stamps(colour, depth, 0.02, "bag")
    assert [i for i, _ in pairs] == [i for i in range(60) if i not in (7, 30)]
    assert len({j for _, j in pairs}) == 58
    with pytest.warns(InputWarning, match="30 of 60"):
        half = pair_stamps(colour, colour[::2] + 0.001, 0.02, "bag")
    assert half == tuple((2 * k, k) for k in range(30))
    with pytest.warns(InputWarning):  # no depth image is used twice, however wide the limit
        assert pair_stamps(colour, colour[::2] + 0.001, 0.05, "bag") == half
    assert pair_stamps([5.0], [5.01], 0.02, "bag") == ((0, 0),)
    with pytest.raises(InputError, match="0.5 s apart"):
        pair_stamps([5.0], [5.5], 0.02, "bag")


def test_images_are_undistorted():
    """The map is that of the lens model."""
    bend = (0.2, -0.5, 0.001, -0.002, 0.1)
    source = undistortion_map(CAMERA, bend)
    k1, k2, p1, p2, k3 = bend
    x, y = CAMERA.rays()[..., 0], CAMERA.rays()[..., 1]
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = CAMERA.K[0, 0] * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + CAMERA.K[0, 2]
    v = CAMERA.K[1, 1] * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + CAMERA.K[1, 2]
    # The brown model: pixel (x, y) of the straight image is at (u, v) of the distorted one.
    np.testing.assert_allclose(source[..., 0], u, atol=1e-3)
    np.testing.assert_allclose(source[..., 1], v, atol=1e-3)
    assert undistortion_map(CAMERA, (1e-4, 0, 0, 0)) is None
    with pytest.raises(InputError, match="3 numbers"):
        undistortion_map(CAMERA, (0.1, 0.1, 0.1))


def test_distorted_images_are_undistorted_when_read(tmp_path):
    path = write_tum(tmp_path / "tum", shifts=(0, 0))
    straight = Tum(K=K, distortion=(0.3, 0.0, 0.0, 0.0), pauses=Ends(), world=WORLD).open(path).frames[0]
    bent = Tum(K=K, pauses=Ends(), world=WORLD).open(path).frames[0]
    assert (straight.rgb != bent.rgb).mean() > 0.02
    np.testing.assert_allclose(straight.rgb[50:70, 70:90].astype(int), bent.rgb[50:70, 70:90], atol=4)
    u, v = np.moveaxis(np.rint(undistortion_map(CAMERA, (0.3, 0.0, 0.0, 0.0))).astype(int), -1, 0)
    inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
    picked = bent.depth[v.clip(0, 119), u.clip(0, 159)]
    assert (straight.depth[inside] == picked[inside]).mean() > 0.99  # halves of a pixel may round the other way
    assert (straight.depth != bent.depth).mean() > 0.3
    assert np.isnan(straight.depth[~inside]).all()


def test_depth_out_of_the_range_of_the_file_is_no_reading(tmp_path):
    """Depth beyond 65535 units is stored as no reading, not as 65535."""
    _, depth, _ = video((0,))
    depth = depth[0].copy()
    depth[:5] = 80.0
    with RecordingWriter(tmp_path / "r", CAMERA) as writer:
        writer.add_frame(video((0,))[0][0], depth, 0.0, "static")
    assert np.isnan(open_recording(tmp_path / "r").frames[0].depth[:5]).all()


def test_two_camera_matrices_in_one_folder_raise_an_error(tmp_path):
    rgb, depth, _ = video((0, 1))
    recording = Recording.from_arrays(rgb, depth, CAMERA.K)
    other = replace(recording.frames[1].camera, K=CAMERA.K * [[1.1], [1.1], [1.0]])
    mixed = replace(recording, frames=[recording.frames[0], replace(recording.frames[1], camera=other)])
    with pytest.raises(InputError, match="frame 1 .* camera matrix"):
        save_recording(mixed, tmp_path / "r")
    assert list(tmp_path.iterdir()) == []


def test_a_part_of_a_video(tmp_path):
    """Frames at the start are omitted, with their poses and times."""
    path = write_tum(tmp_path / "tum")
    write_trajectory(path)
    recording = Tum(K=K, start_s=0.35, stop_s=1.45, pauses=Ends(), world=WORLD).open(path)
    assert (len(recording), recording.pauses, recording.times[0]) == (11, (0, 10), 0.0)
    np.testing.assert_array_equal(recording.frames[3].rgb, video((SHIFTS[7],))[0][0])
    expected = camera_to_world(4).inv() * camera_to_world(9)
    found = recording.frames[0].camera.pose.inv() * recording.frames[5].camera.pose
    np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-9)
    with pytest.raises(InputError, match=r"lasts 1\.6 s"):
        Tum(K=K, start_s=9).open(path)


@pytest.mark.parametrize("layout", VIDEOS)
def test_robot_masks_beside_the_images_are_read(tmp_path, layout):
    write, reader = VIDEOS[layout]
    path = write(tmp_path / "data")
    (path / "robot").mkdir()
    left = np.where(np.arange(160) < 40, 255, np.zeros((120, 160))).astype(np.uint8)
    colour = sorted((path / ("color" if layout == "redwood" else "rgb")).iterdir())
    write_image(path / "robot" / f"{colour[3].stem}.png", left)
    masks = [frame.robot_mask for frame in reader.open(path).frames]
    assert [k for k, mask in enumerate(masks) if mask is not None] == [3] and masks[3].mean() == 0.25
    (path / "robot" / f"{colour[3].stem}.png").rename(path / "robot" / "mask_3.png")
    shutil.copytree(path / "robot", path / "robot_masks")
    with pytest.warns(InputWarning, match="robot_masks is not read"):
        reader.open(path)
    with pytest.warns(InputWarning, match="robot: 1 masks of no colour image are not read, for example mask_3.png"):
        reader.open(path)


def test_depth_images_are_not_taken_for_colour(tmp_path):
    path = write_tum(tmp_path / "tum")
    (path / "rgb.txt").write_text((path / "depth.txt").read_text())
    with pytest.raises(InputError, match=r"colour image .* has type uint16, expected 8 bits"):
        Tum(K=K).open(path)


def test_the_largest_value_of_16_bits_is_no_reading(tmp_path):
    _, (depth,), _ = video((0,))
    write_image(tmp_path / "a.png", np.where(np.arange(160) < 9, 65535, units(depth, 0.001)).astype(np.uint16))
    found = read_depth(tmp_path / "a.png", 0.001)
    assert np.isnan(found[:, :9]).all() and not np.isnan(found[:, 9:][depth[:, 9:] > 0]).any()


def test_a_second_colour_folder_is_named(tmp_path):
    path = write_redwood(tmp_path / "data")
    shutil.copytree(path / "color", path / "rgb")
    with pytest.warns(InputWarning, match="colour folders color, rgb: color is read"):
        Redwood(fps=FPS).open(path)


def test_distortion_may_be_nested_and_must_be_numbers(tmp_path):
    path = write_redwood(tmp_path / "data", (0, 1))
    for stored, fault in (([[0.1, 0, 0, 0]], None), (["a", "b", "c", "d"], "intrinsic.json .*could not convert")):
        edit(path / "intrinsic.json", lambda data, stored=stored: data.update(distortion=stored))
        if fault is None:
            assert Redwood().video(path).distortion == (0.1, 0, 0, 0)
        else:
            with pytest.raises(InputError, match=fault):
                Redwood().video(path)


def test_milliseconds_of_tum_lists_are_recognised(tmp_path):
    path = write_tum(tmp_path / "tum")
    expected = Tum(K=K, world=WORLD).open(path)
    for name in ("rgb.txt", "depth.txt"):
        rows = [line.split() for line in (path / name).read_text().splitlines()[1:]]
        (path / name).write_text("".join(f"{float(t) * 1000:.3f} {file}\n" for t, file in rows))
    found = Tum(K=K, world=WORLD).open(path)
    assert found.pauses == expected.pauses
    np.testing.assert_allclose(found.times, expected.times, atol=1e-5)


def test_floating_point_depth_in_millimetres_is_not_blamed_on_the_scale(tmp_path):
    path = write_rgb_and_depth(tmp_path / "mine", kind="npy")
    for file in (path / "depth").iterdir():
        np.save(file, 1000 * np.load(file))
    rgb, depth, _ = video((0,))
    for make in (
        lambda: open_recording(path, options=["depth_scale=0.001"]),
        lambda: Recording.from_arrays(rgb, 1000 * depth, CAMERA.K),
    ):
        with pytest.raises(InputError, match="has a median of 778 m") as caught:
            make()
        assert "per unit" not in caught.value.message and "multiply millimetres by 0.001" in caught.value.hints[0]


def test_times_of_which_some_have_no_decimals(tmp_path):
    seconds = [9.5, 10.25, 11, *range(12, 12 + len(SHIFTS) - 3)]
    path = write_rgb_and_depth(tmp_path / "mine", lambda part, k: f"{seconds[k]:g}")
    recording = Redwood(world=WORLD).open(path)
    np.testing.assert_allclose(recording.times, np.array(seconds) - 9.5)


def test_arrays_of_depth_are_read_like_other_files(tmp_path):
    """A header that claims more than the file holds, and an archive."""
    path = tmp_path / "depth.npy"
    with path.open("wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": (10**7, 10**6)}
        np.lib.format.write_array_header_1_0(file, header)
    with pytest.raises(InputError, match=r"depth.npy cannot be read: an array of shape"):
        read_depth(path, 1.0)
    np.savez(tmp_path / "depth.npz", a=np.ones((4, 4), np.float32))
    (tmp_path / "depth.npz").rename(path)
    with pytest.raises(InputError, match="expected one channel"):
        read_depth(path, 1.0)


def test_numbers_are_not_paired_with_seconds(tmp_path):
    path = write_rgb_and_depth(
        tmp_path / "mine", lambda part, k: f"{k / 30:.3f}" if part == "depth" else f"{k:06d}", n=4
    )
    with pytest.raises(InputError, match="does not fit depth image"):
        Redwood(world=WORLD).open(path)


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("name", ["aligned_depth", "depth_aligned", "depth_registered", "aligned_depth_to_color"])
def test_raw_depth_is_not_read_beside_aligned_depth(tmp_path, layout, name):
    """Renamed, or named in depth.txt, the aligned depth is read."""
    path = WRITERS[layout](tmp_path / "data")
    shutil.copytree(path / "depth", path / name)
    reader = Tum(K=K, world=WORLD) if layout == "tum" else Redwood(fps=FPS, world=WORLD)
    with pytest.raises(InputError, match=f"depth/ would be read, but {name}/ is there") as caught:
        reader.open(path)
    assert name in caught.value.hints[0]
    if layout == "tum":
        (path / "depth.txt").write_text((path / "depth.txt").read_text().replace("depth/", f"{name}/"))
    else:
        (path / "depth").rename(path / "raw")
        (path / name).rename(path / "depth")
    same_frames(reader.open(path), SHIFTS)


@pytest.mark.parametrize("layout", VIDEOS)
def test_frames_without_depth_do_not_refuse_a_video(tmp_path, layout):
    """The first frame, one that moves, and one at a pause, which gives its place to a neighbour."""
    write, reader = VIDEOS[layout]
    path, missing = write(tmp_path / "data"), (0, 7, PAUSES[1])
    for k, file in enumerate(sorted((path / "depth").iterdir())):
        if k in missing:
            write_image(file, np.zeros((120, 160), np.uint16))
    with pytest.warns(InputWarning, match=rf"frame {PAUSES[1]} of .* has no depth reading: the pause is at frame 12"):
        recording = reader.open(path)
    assert recording.pauses == (PAUSES[0], 12)
    recording.check()
    assert [k for k, frame in enumerate(recording.frames) if not frame.valid.any()] == list(missing)
    same_on_disk(recording, tmp_path / "out")
    with pytest.raises(InputError, match="the first pause has no reading at all") as caught:
        replace(reader, pauses=Ends(), stop_s=0.09, world=KnownWorld()).open(path)
    assert "another pause" in caught.value.hints[0]

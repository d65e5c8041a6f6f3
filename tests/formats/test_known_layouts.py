"""Recordings of phones and scenes of data sets: written here as their documentation says, and read.

In each, the camera moves around a scene whose surfaces are known. What is read must give the known points in the
world: so intrinsics, unit, orientation and poses are right together.
"""

from __future__ import annotations

import json
import sys
import zipfile
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.formats import EveryNth, KnownLayout, open_recording, save_recording
from mstfilter.formats.layouts import LAYOUTS
from mstfilter.formats.reprojection import colour_in, depth_in, labels_in, resized_to
from mstfilter.formats.sources import detect_format
from mstfilter.formats.video import KnownWorld
from mstfilter.scene import Camera
from mstfilter.scene.camera import look_at
from mstfilter.scene.rendering import render
from tests.formats import layouts
from tests.formats.layouts import PAUSES
from tests.scene.scenes import CAMERA, GRID, table_scene

WIDE = Camera.from_intrinsics(262, 260, 158, 122, 320, 240)
TALL = Camera.from_intrinsics(262, 260, 118, 162, 240, 320)  # as phones turn their images
PLACES = ((0.0, -0.6, 0.5), (0.1, -0.62, 0.48), (0.2, -0.55, 0.55), (-0.1, -0.5, 0.6))
ARKIT = Rotation.from_euler("xyz", (20, 50, 10), degrees=True)  # of the world of the recorder
MOVED = np.array([1.0, -2.0, 0.5])


def poses():
    """Poses T_world_camera in the world of the scene, and matrices of the same poses in the world of the recorder."""
    true = [look_at(place, (0.02, 0, 0.03)) for place in PLACES]
    other = np.eye(4)
    other[:3, :3], other[:3, 3] = ARKIT.as_matrix(), MOVED
    return true, [other @ pose.as_matrix() for pose in true]


def reduced(camera, size):
    """The camera of an image of another size, with the corner of the image at the same place."""
    width, height = size
    x, y = width / camera.width, height / camera.height
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    return Camera.from_intrinsics(fx * x, fy * y, (cx + 0.5) * x - 0.5, (cy + 0.5) * y - 0.5, width, height)


def seen(camera, pose):
    rgb, depth, _ = table_scene(camera=camera.at(pose))
    return rgb, depth


def four(camera):
    return [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]]


def save(path, image, **more):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path, **more)


def millimetres(depth, unit=0.001):
    return np.rint(depth / unit).astype(np.uint16)


def opened(path, n=4, **fields):
    world = KnownWorld(tuple(poses()[0][0].as_matrix().ravel()))
    recording = KnownLayout(pauses=EveryNth(), world=world, **fields).open(path)
    assert len(recording) == n
    return recording


def check(recording, within=1e-3, share=0.995, still=False, colour=0.99):
    """Each pixel has the colour and the point in the world that a ray through it meets, within 1 m of the camera."""
    for j, frame in enumerate(recording.frames):
        pose = poses()[0][0 if still else j]
        np.testing.assert_allclose(frame.camera.pose.as_matrix(), pose.as_matrix(), atol=1e-5)
        camera = frame.camera.at(pose)
        rgb, depth = seen(camera, pose)
        distance = np.linalg.norm(frame.points - camera.unproject(depth), axis=-1)
        assert np.mean(distance[np.isfinite(distance) & (depth < 1)] < within) > share
        assert np.isfinite(frame.depth).mean() > 0.97
        # The three colours of the scene differ in red minus blue, which its texture leaves alone.
        found, true = (image[..., 0].astype(int) - image[..., 2] for image in (frame.rgb, rgb))
        assert np.mean(np.abs(found - true) < 45) > colour


def write_stray(path, new=True, small=(128, 96)):
    """Stray Scanner: a video, small depth in millimetres, rows of poses with axes right, down, forward."""
    path.mkdir()
    movie = cv2.VideoWriter(str(path / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 60, (320, 240))
    true, stored = poses()
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw" + (", fx, fy, cx, cy" if new else "")]
    for k, (pose, matrix) in enumerate(zip(true, stored, strict=True)):
        wide = replace(WIDE, K=WIDE.K + k * np.array([[1.0, 0, 0.7], [0, 1.0, -0.4], [0, 0, 0]])) if new else WIDE
        movie.write(np.ascontiguousarray(seen(wide, pose)[0][..., ::-1]))
        save(path / "depth" / f"{k:06d}.png", millimetres(seen(reduced(wide, small), pose)[1]))
        numbers = [*matrix[:3, 3], *Rotation.from_matrix(matrix[:3, :3]).as_quat(), *(four(wide) if new else [])]
        rows.append(", ".join(map(str, [5000 + k / 10, f"{k:06d}", *numbers])))
    movie.release()
    (path / "odometry.csv").write_text("\n".join(rows) + "\n")
    (path / "camera_matrix.csv").write_text("\n".join(", ".join(map(str, row)) for row in WIDE.K) + "\n")
    (path / "imu.csv").write_text("timestamp, a_x\n")
    return path


@pytest.mark.parametrize("new", [False, True])
def test_stray_scanner(tmp_path, new):
    """The colour image is 2.5 times larger than depth; newer versions write the intrinsics of each frame."""
    path = write_stray(tmp_path / "scan", new)
    assert detect_format(path) == "layout"
    recording = opened(path)
    check(recording, share=0.96)
    recording.check()
    np.testing.assert_allclose(recording.times, np.arange(4) / 10, atol=1e-6)
    np.testing.assert_allclose(recording.frames[0].camera.K, WIDE.K)
    rgb = [recording.frames[k].rgb for k in (3, 1, 1, 0)]  # backwards too
    assert np.array_equal(rgb[1], rgb[2]) and not np.array_equal(rgb[0], rgb[3])
    small = opened(path, max_pixels=20_000)
    assert small.frames[0].depth.size <= 20_100
    check(small, share=0.95)


def test_a_phone_that_stands_still(tmp_path):
    """The pauses are found in the video, in spite of its compression, and the pose of the camera from the table."""
    path = layouts.write_stray(tmp_path / "scan")
    recording = open_recording(path, options=["pauses.levels=6"], pauses="still")
    recording.check()
    assert recording.pauses == PAUSES and recording.path == path
    position = recording.frames[0].camera.position
    assert abs(position[2] - CAMERA.position[2]) < 0.01
    copy = open_recording(save_recording(recording, tmp_path / "out"))
    np.testing.assert_allclose(copy.frames[2].depth, recording.frames[2].depth, atol=1.3e-4)


def test_frames_that_ffmpeg_extracted_are_not_one_late(tmp_path):
    path = write_stray(tmp_path / "scan")
    for k, pose in enumerate(poses()[0]):
        save(path / "rgb" / f"{k + 1:06d}.png", seen(WIDE, pose)[0])
    (path / "rgb.mp4").unlink()
    with pytest.raises(InputError, match="colour images begin with number 1, depth images with 0") as caught:
        opened(path)
    assert "-start_number 0" in caught.value.hints[0]
    for k in range(4):
        (path / "rgb" / f"{k + 1:06d}.png").rename(path / "rgb" / f"{k:06d}.png")
    assert detect_format(path) == "layout"
    check(opened(path), share=0.96)


def test_a_video_that_cannot_be_decoded(tmp_path):
    path = write_stray(tmp_path / "scan")
    (path / "rgb.mp4").write_bytes((path / "rgb.mp4").read_bytes()[:1000])
    with pytest.raises(InputError, match="video cannot be decoded|video ends before") as caught:
        opened(path)
    assert caught.value.hints


def metadata(camera=TALL, small=(96, 128), **change):
    """The metadata of Record3D: K column by column, quaternions (x, y, z, w) and positions with axes of OpenGL."""
    flip = np.diag([1.0, -1, -1, 1])
    stored = [matrix @ flip for matrix in poses()[1]]
    listed = [[*Rotation.from_matrix(m[:3, :3]).as_quat(), *m[:3, 3]] for m in stored]
    made = {"w": camera.width, "h": camera.height, "dw": small[0], "dh": small[1], "fps": 10, "poses": listed}
    made |= {"K": camera.K.T.ravel().tolist(), "perFrameIntrinsicCoeffs": [four(camera)] * 4}
    return {k: v for k, v in {**made, "frameTimestamps": [0.0, 0.2, 0.3, 0.5], **change}.items() if v is not None}


def write_r3d(path, stored, small=(96, 128)):
    lzfse = pytest.importorskip("lzfse", reason="lzfse absent: pip install -e '.[record3d]'")
    for k, pose in enumerate(poses()[0]):
        save(path / "rgbd" / f"{k}.jpg", seen(TALL, pose)[0], quality=95)
        depth = seen(reduced(TALL, small), pose)[1].astype("<f4")
        depth[:2, :2] = np.nan
        (path / "rgbd" / f"{k}.depth").write_bytes(lzfse.compress(depth.tobytes()))
        (path / "rgbd" / f"{k}.conf").write_bytes(b"")
    (path / "metadata").write_text(json.dumps(stored))
    return path


@pytest.mark.parametrize("change", [{}, {"dw": None, "dh": None}, {"perFrameIntrinsicCoeffs": None}])
def test_record3d(tmp_path, change):
    """The archive .r3d, and its unpacked folder."""
    path = write_r3d(tmp_path / "session", metadata(**change))
    assert detect_format(path) == "layout"
    with zipfile.ZipFile(tmp_path / "session.r3d", "w") as archive:
        for file in path.rglob("*"):
            archive.write(file, file.relative_to(path))
    for source in (path, tmp_path / "session.r3d"):
        recording = opened(source)
        check(recording, share=0.96)
        np.testing.assert_allclose(recording.times, [0, 0.2, 0.3, 0.5])
    assert detect_format(tmp_path / "session.r3d") == "layout"


def test_record3d_without_its_library_or_damaged(tmp_path, monkeypatch):
    path = write_r3d(tmp_path / "session", metadata())
    (path / "rgbd" / "0.depth").write_bytes(b"damaged")
    with pytest.raises(InputError, match=r"0.depth cannot be read: it is not LZFSE"):
        opened(path)
    (tmp_path / "a.r3d").write_bytes(b"PK")
    with pytest.raises(InputError, match="a.r3d"):
        open_recording(tmp_path / "a.r3d", "layout")
    (path / "metadata").write_text(json.dumps(metadata(w=999)))
    with pytest.raises(InputError, match=r"intrinsics are of images of \(999, 320\)"):
        opened(path)
    (path / "metadata").write_text(json.dumps(metadata()))
    monkeypatch.setitem(sys.modules, "lzfse", None)
    with pytest.raises(InputError, match="depth of Record3D needs lzfse") as caught:
        opened(path)
    assert "mstfilter[record3d]" in caught.value.hints[0]


@pytest.mark.parametrize("packed", [False, True])
def test_export_of_record3d(tmp_path, packed):
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR absent: pip install -e '.[exr]'")
    path = tmp_path / "EXR_RGBD"
    (path / "depth").mkdir(parents=True)
    for k, pose in enumerate(poses()[0]):
        save(path / "rgb" / f"{k}.jpg", seen(TALL, pose)[0], quality=95)
        depth = seen(reduced(TALL, (96, 128)), pose)[1].astype(np.float32)
        header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
        openexr.File(header, {"R": depth}).write(str(path / "depth" / f"{k}.exr"))
    (path / "metadata.json").write_text(json.dumps(metadata()))
    if packed:
        with zipfile.ZipFile(tmp_path / "export.zip", "w") as archive:
            for file in path.rglob("*"):
                archive.write(file, file.relative_to(tmp_path))
    source = tmp_path / "export.zip" if packed else path
    assert detect_format(source) == "layout"
    check(opened(source), share=0.96)


@pytest.mark.parametrize("folder", ["lowres_wide", "vga_wide"])
def test_arkitscenes(tmp_path, folder):
    """Poses map the world to the camera, as axis and angle, at other times than those of the images."""
    camera = WIDE if folder == "vga_wide" else reduced(WIDE, (128, 96))
    path, start = tmp_path / "41048190", 3386.4
    (path / f"{folder}_intrinsics").mkdir(parents=True)
    true, stored = poses()
    for k, pose in enumerate(true):
        name = f"41048190_{start + k / 10:.3f}"
        save(path / folder / f"{name}.png", seen(camera, pose)[0])
        save(path / "lowres_depth" / f"{name}.png", millimetres(seen(reduced(WIDE, (128, 96)), pose)[1]))
        text = " ".join(map(str, [camera.width, camera.height, *four(camera)]))
        (path / f"{folder}_intrinsics" / f"41048190_{start + k / 10 + 0.001:.3f}.pincam").write_text(text)
    lines = []
    for k, matrix in enumerate(stored):
        inverse = np.linalg.inv(matrix)
        numbers = [*Rotation.from_matrix(inverse[:3, :3]).as_rotvec(), *inverse[:3, 3]]
        lines.append(" ".join(map(str, [start + k / 10, *numbers])))
    (path / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    assert detect_format(path) == "layout"
    check(opened(path), share=0.96)
    (path / "lowres_wide.traj").write_text(lines[0] + "\n" + lines[2] + "\n")
    with pytest.warns(InputWarning, match="1 of 4 frames are omitted"):
        recording = opened(path, 3)
    between = recording.frames[1].camera.position  # half-way, as positions are interpolated
    np.testing.assert_allclose(between, (np.array(PLACES[0]) + PLACES[2]) / 2, atol=1e-5)


def write_bop(path, unit=0.0001, moves=True, first=3):
    cameras, objects = {}, {}
    for k, pose in enumerate(poses()[0]):
        number, place = first + 10 * k, pose if moves else poses()[0][0]
        rgb, depth, labels = table_scene(camera=WIDE.at(place))
        shown = render(labels, GRID, WIDE.at(place)).labels
        save(path / "rgb" / f"{number:06d}.png", rgb)
        save(path / "depth" / f"{number:06d}.png", millimetres(depth, unit))
        for j in range(2):
            save(path / "mask_visib" / f"{number:06d}_{j:06d}.png", (shown == j + 1).astype(np.uint8) * 255)
        cameras[number] = {"cam_K": WIDE.K.ravel().tolist(), "depth_scale": unit * 1000}
        if moves:
            inverse = np.linalg.inv(poses()[1][k])
            cameras[number] |= {"cam_R_w2c": inverse[:3, :3].ravel().tolist()}
            cameras[number] |= {"cam_t_w2c": (1000 * inverse[:3, 3]).tolist()}
        objects[number] = [{"obj_id": 255}, {"obj_id": 9}]
    (path / "scene_camera.json").write_text(json.dumps(cameras))
    (path / "scene_gt.json").write_text(json.dumps(objects))
    return path


@pytest.mark.parametrize("moves", [False, True])
def test_bop(tmp_path, moves):
    """Each scene has its unit, and positions are in millimetres; objects have their numbers, but 255 is the robot."""
    path = write_bop(tmp_path / "000048", moves=moves)
    assert detect_format(path) == "layout"
    recording = opened(path)
    check(recording, 3e-4, 0.999, still=not moves)
    np.testing.assert_allclose(recording.times, np.arange(4) / 3)
    _, _, labels = table_scene()
    shown = render(labels, GRID, recording.frames[2].camera).labels
    np.testing.assert_array_equal(recording.instance(2), np.array([0, 256, 9])[shown])
    twice = {k: [{"obj_id": 5}, {"obj_id": 5}] for k in json.loads((path / "scene_gt.json").read_text())}
    (path / "scene_gt.json").write_text(json.dumps(twice))
    np.testing.assert_array_equal(opened(path).instance(2), shown)


def test_other_intrinsics_of_one_frame(tmp_path):
    path = write_bop(tmp_path / "000001")
    other = replace(WIDE, K=WIDE.K * [[0.9], [0.9], [1.0]])
    rgb, depth = seen(other, poses()[0][1])
    save(path / "rgb" / "000013.png", rgb)
    save(path / "depth" / "000013.png", millimetres(depth, 0.0001))
    stored = json.loads((path / "scene_camera.json").read_text())
    stored["13"]["cam_K"] = other.K.ravel().tolist()
    (path / "scene_camera.json").write_text(json.dumps(stored))
    recording = opened(path)
    check(recording, 3e-4, 0.99)
    given = opened(path, K=tuple(four(other)))
    np.testing.assert_allclose(given.frames[0].camera.K, other.K)


@pytest.mark.parametrize(
    "names", [("intrinsic/intrinsic_color", "intrinsic/intrinsic_depth"), ("intrinsics_color", "intrinsics_depth")]
)
def test_scannet(tmp_path, names):
    """Depth of another camera with the same centre; a frame whose pose was lost is omitted."""
    small = Camera.from_intrinsics(120, 122, 77, 63, 160, 120)
    for k, (pose, matrix) in enumerate(zip(*poses(), strict=True)):
        save(tmp_path / "color" / f"{20 * k}.jpg", seen(WIDE, pose)[0], quality=95)
        save(tmp_path / "depth" / f"{20 * k}.png", millimetres(seen(small, pose)[1]))
        (tmp_path / "pose").mkdir(exist_ok=True)
        lost = np.full((4, 4), -np.inf)
        np.savetxt(tmp_path / "pose" / f"{20 * k}.txt", lost if k == 3 else matrix)
    for name, camera in zip(names, (WIDE, small), strict=True):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        matrix = np.eye(4)
        matrix[:3, :3] = camera.K
        np.savetxt(tmp_path / f"{name}.txt", matrix)
    assert detect_format(tmp_path) == "layout"
    with pytest.warns(InputWarning, match="1 of 4 frames are omitted: they have no pose"):
        recording = opened(tmp_path, 3)
    assert recording.times == pytest.approx((0, 20 / 30, 40 / 30))
    for j, frame in enumerate(recording.frames):
        camera = frame.camera.at(poses()[0][j])
        np.testing.assert_allclose(frame.camera.K, WIDE.K)
        distance = np.linalg.norm(frame.points - camera.unproject(seen(camera, poses()[0][j])[1]), axis=-1)
        assert np.mean(distance[np.isfinite(distance)] < 2e-3) > 0.95 and np.isfinite(distance).mean() > 0.8


def test_seven_scenes(tmp_path):
    for k, (pose, matrix) in enumerate(zip(*poses(), strict=True)):
        rgb, depth = seen(WIDE, pose)
        depth = millimetres(depth)
        depth[:3] = 65535
        save(tmp_path / f"frame-{k:06d}.color.png", rgb)
        save(tmp_path / f"frame-{k:06d}.depth.png", depth)
        np.savetxt(tmp_path / f"frame-{k:06d}.pose.txt", matrix)
    assert detect_format(tmp_path) == "layout"
    with (
        pytest.warns(InputWarning, match="depth and colour are not registered"),
        pytest.raises(InputError, match="intrinsics are missing") as caught,
    ):
        opened(tmp_path)
    assert "585,585,320,240" in caught.value.hints[0]
    with pytest.warns(InputWarning, match="not registered"):
        check(opened(tmp_path, K=tuple(four(WIDE))), 2e-3)


def test_a_folder_with_cam_k(tmp_path):
    """BundleSDF and FoundationPose: a still camera here, and a mask of the first frame."""
    rgb, depth, labels = table_scene(camera=WIDE.at(poses()[0][0]))
    shown = render(labels, GRID, WIDE.at(poses()[0][0])).labels
    for k in range(4):
        save(tmp_path / "rgb" / f"15811204241{k}0148532.png", rgb)
        save(tmp_path / "depth" / f"15811204241{k}0148532.png", millimetres(depth))
    save(tmp_path / "masks" / "1581120424100148532.png", (shown == 1).astype(np.uint8) * 255)
    np.savetxt(tmp_path / "cam_K.txt", WIDE.K)
    assert detect_format(tmp_path) == "layout"
    recording = opened(tmp_path)
    check(recording, still=True)
    np.testing.assert_array_equal(recording.instance(0), shown == 1)
    np.testing.assert_allclose(recording.times, (0, 0.01, 0.02, 0.03), atol=1e-9)  # names are nanoseconds
    assert recording.instance(1) is None
    hand = np.where(np.arange(320) < 80, 255, np.zeros((240, 320))).astype(np.uint8)
    save(tmp_path / "robot" / "1581120424110148532.png", hand)
    assert opened(tmp_path).frames[1].robot_mask.mean() == 0.25


def test_dexycb(tmp_path):
    """One still camera; the hand has label 255; intrinsics lie beside the subjects."""
    root, serial = tmp_path / "data", "836212060125"
    path = root / "20200709-subject-01" / "20200709_141754" / serial
    rgb, depth, labels = table_scene(camera=WIDE.at(poses()[0][0]))
    shown = render(labels, GRID, WIDE.at(poses()[0][0])).labels.astype(np.uint8)
    shown[shown == 2] = 21
    shown[:40, :50] = 255
    for k in range(4):
        save(path / f"color_{k:06d}.jpg", rgb, quality=95)
        save(path / f"aligned_depth_to_color_{k:06d}.png", millimetres(depth))
        np.savez_compressed(path / f"labels_{k:06d}.npz", seg=shown, pose_y=np.zeros((2, 3, 4), np.float32))
    assert detect_format(path) == "layout"
    with pytest.raises(InputError, match="intrinsics are missing") as caught:
        opened(path)
    assert "calibration/intrinsics/" in caught.value.hints[0]
    (root / "calibration" / "intrinsics").mkdir(parents=True)
    fx, fy, cx, cy = four(WIDE)
    text = f"color:\n  fx: {fx}\n  fy: {fy}\n  height: 480\n  ppx: {cx}\n  ppy: {cy}\n  width: 640\n"
    text += "depth:\n  fx: 1.0\n  fy: 1.0\n  ppx: 1.0\n  ppy: 1.0\n"
    (root / "calibration" / "intrinsics" / f"{serial}_640x480.yml").write_text(text)
    recording = opened(path)
    check(recording, still=True)
    np.testing.assert_array_equal(recording.instance(3), shown)
    np.testing.assert_array_equal(recording.frames[3].robot_mask, shown == 255)


def test_a_layout_is_named_if_it_is_not_clear(tmp_path):
    path = write_bop(tmp_path / "000001")
    np.savetxt(path / "cam_K.txt", WIDE.K)
    with pytest.raises(InputError, match="may be bop or cam_k") as caught:
        opened(path)
    assert "layout=NAME" in caught.value.hints[0]
    check(opened(path, layout="bop"), 3e-4, 0.999)
    with pytest.raises(InputError, match="layout is 'bob', expected stray, "):
        opened(path, layout="bob")
    with pytest.raises(InputError, match="has none of the layouts"):
        opened(tmp_path)


def test_what_is_missing_is_named(tmp_path):
    path = write_bop(tmp_path / "000001")
    for k in (13, 23, 33):
        (path / "depth" / f"{k:06d}.png").unlink()
    with pytest.warns(InputWarning, match="1 frames of 4 colour and 1 depth images"):
        opened(path, 1)
    (path / "depth" / "000003.png").rename(path / "depth" / "000004.png")
    with pytest.raises(InputError, match="no colour image has a depth image of the same number"):
        opened(path)
    save(path / "depth" / "000003.png", np.full((240, 240), 700, np.uint16))
    with pytest.warns(InputWarning), pytest.raises(InputError, match="depth of 240 x 240, colour of 320 x 240"):
        opened(path)
    (path / "scene_camera.json").write_text("{}")
    with pytest.warns(InputWarning), pytest.raises(InputError, match="no frame of BOP"):
        opened(path)


def test_every_layout_has_a_test():
    assert set(LAYOUTS) == {"stray", "record3d", "record3d_exr", "arkitscenes", "bop", "scannet", "seven_scenes"} | {
        "cam_k",
        "dexycb",
    }


def test_planes_stay_planes_and_edges_stay_edges():
    """Depth of a plane is exact between the pixels; at an edge, only depths of the two sides occur."""
    small = reduced(WIDE, (80, 60))
    normal = np.array([0.1, -0.3, -1.0])
    plane = (-0.8 / (small.rays() @ normal)).astype(np.float32)
    exact = -0.8 / (WIDE.rays() @ normal)
    found = depth_in(plane, small, WIDE)
    inner = np.s_[5:-5, 5:-5]
    np.testing.assert_allclose(found[inner], exact[inner], rtol=2e-4)
    small = reduced(WIDE, (40, 30))
    step = np.where(np.arange(40) < 20, 0.7, 0.9).repeat(30).reshape(40, 30).T.astype(np.float32)
    step[10, 10] = np.nan
    found = depth_in(step, small, WIDE)
    assert set(np.unique(np.round(found[np.isfinite(found)], 5))) == {np.float32(0.7), np.float32(0.9)}
    assert np.isnan(found[80:88, 80:88]).all() and np.isnan(found).sum() == 64
    assert (found[:, 159] == np.float32(0.7)).mean() > 0.9 and (found[:, 160] == np.float32(0.9)).all()


def test_an_image_is_not_changed_without_need():
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    near = Camera.from_intrinsics(262.001, 260, 158.001, 122, 320, 240)
    assert colour_in(image, WIDE, near) is image and labels_in(image[..., 0], WIDE, near).base is image
    with pytest.raises(InputError, match="not registered"):
        resized_to(WIDE, (240, 240), "frame 0")
    half = colour_in(image, WIDE, WIDE.scaled(0.5))
    mean = image.reshape(120, 2, 160, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(half, mean, atol=0.51)

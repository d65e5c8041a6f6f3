"""Cameras and frames: projection against the formula, and errors of invalid input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.base.errors import InputError
from mstfilter.scene.camera import Camera, look_at, rigid_from_matrix, scaled_area, scaled_length
from mstfilter.scene.frame import Frame

K = np.array([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]])
CAMERA = Camera(K, 640, 480, look_at((0.05, -0.72, 0.58), (0.02, 0.05, 0.04)))


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(-1, 1)] * 3), st.tuples(*[st.floats(-3, 3)] * 6), st.floats(0, 5))
def test_projection_inverts_unprojection(position, rotation, skew):
    pose = RigidTransform.from_components(position, Rotation.from_rotvec(rotation[:3]))
    matrix = K.copy()
    matrix[0, 1] = skew
    camera = Camera(matrix, 64, 48, pose)
    depth = np.random.default_rng(0).uniform(0.3, 3, (48, 64))
    uv, z = camera.project(camera.unproject(depth))
    v, u = np.mgrid[:48, :64]
    np.testing.assert_allclose(uv[..., 0], u, atol=1e-6)
    np.testing.assert_allclose(uv[..., 1], v, atol=1e-6)
    np.testing.assert_allclose(z, depth, atol=1e-9)


def test_look_at_centres_the_target():
    uv, z = CAMERA.project(np.array([0.02, 0.05, 0.04]))
    np.testing.assert_allclose(uv, [319.5, 239.5], atol=1e-9)
    assert z == pytest.approx(np.linalg.norm([0.03, 0.77, 0.54]))
    above, _ = CAMERA.project(np.array([0.02, 0.05, 0.14]))
    assert above[1] < 239.5


def test_points_behind_have_no_pixel():
    uv, z = CAMERA.project(np.array([[0.05, -2.0, 0.58]]))
    assert np.isnan(uv).all()
    assert z[0] < 0


def test_scaling_keeps_rays():
    half = CAMERA.scaled(0.5)
    point = np.array([0.1, 0.1, 0.05])
    big, small = CAMERA.project(point)[0], half.project(point)[0]
    np.testing.assert_allclose((big + 0.5) / 2 - 0.5, small, atol=1e-9)


def test_a_resized_frame_shows_the_same_plane():
    camera = Camera.from_intrinsics(1000, 1000, 959.5, 539.5, 1920, 1080)
    normal, offset = np.array([0.1, -0.6, -1.0]), -1.2  # the plane normal @ x = offset in camera axes
    depth = (offset / (camera.rays() @ normal)).astype(np.float32)
    rgb = np.repeat((np.arange(1920) / 10).astype(np.uint8)[None, :, None], 1080, 0).repeat(3, 2)
    small = camera.limited(410_000)
    frame = Frame(rgb, depth, camera, depth > 1.3).resized(small)
    assert 400_000 < frame.depth.size < 420_000 and frame.camera is small
    exact = offset / (small.rays() @ normal)
    slope = np.abs(np.gradient(exact)).max()  # metres per pixel of the small image
    assert np.abs(frame.depth - exact).max() < 0.8 * slope  # the nearest pixel is at most half a pixel away
    assert abs((frame.depth - exact).mean()) < 0.02 * slope  # and in no preferred direction
    assert np.mean(frame.robot_mask == (exact > 1.3)) > 0.99
    columns = np.arange(small.width) + 0.5
    np.testing.assert_allclose(frame.rgb[5, :, 0], columns * 1920 / small.width / 10 - 0.5, atol=1.5)
    assert frame.resized(small) is frame
    assert camera.limited(0) is camera and small.limited(410_000).width <= small.width


def test_numbers_of_pixels_scale_with_the_image():
    assert (scaled_length(3, 640), scaled_length(3, 1280), scaled_length(3, 320)) == (3, 6, 1.5)
    assert (scaled_area(60, 640 * 480), scaled_area(60, 320 * 240)) == (60, 15)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.zeros((3, 3)), "not invertible"),
        (np.diag([525.0, 0.0, 1.0]), "not invertible"),
        ((525.0, 525, 319.5), "expected 3 x 3 finite numbers, or fx, fy, cx, cy"),
        ((525.0, 0, 319.5, 239.5), "not invertible"),
        (np.eye(4), "expected 3 x 3 finite"),
        (K.T, "upper triangular"),
        (K * np.nan, "expected 3 x 3 finite"),
        ([["a"] * 3] * 3, "numeric"),
    ],
)
def test_invalid_intrinsics(matrix, message):
    with pytest.raises(InputError, match=message):
        Camera(matrix, 640, 480)


def test_invalid_poses():
    bad = np.eye(4)
    bad[0, 3] = np.nan
    with pytest.raises(InputError, match="NaN"):
        rigid_from_matrix(bad)
    with pytest.raises(InputError, match="rigid"):
        rigid_from_matrix(np.diag([2.0, 2, 2, 1]))
    with pytest.raises(InputError, match="rigid"):
        rigid_from_matrix(np.diag([1.0, 1, -1, 1]))
    with pytest.raises(InputError, match="RigidTransform"):
        Camera(K, 640, 480, np.eye(4))


def test_frames_are_checked_and_read_only():
    rgb, depth = np.zeros((480, 640, 3), np.uint8), np.ones((480, 640), np.float32)
    depth[0, 0], depth[0, 1], depth[0, 2] = 0, np.inf, -1
    robot = np.zeros((480, 640), bool)
    robot[5] = True
    frame = Frame(rgb, depth, CAMERA, robot)
    assert np.isnan(frame.depth[0, :3]).all()
    assert frame.valid.sum() == 480 * 640 - 3 - 640
    with pytest.raises(ValueError, match="read-only"):
        frame.depth[3, 3] = 1
    rgb[0, 0], robot[6] = 9, True
    assert not frame.rgb[0, 0].any() and not frame.robot_mask[6].any()  # the caller's arrays are copied
    assert np.shares_memory(Frame(frame.rgb, frame.depth, CAMERA).rgb, frame.rgb)  # read-only memory is shared
    rgb[0, 0], robot[6] = 0, False
    assert frame.key == Frame(rgb.copy(), depth.copy(), CAMERA, robot).key
    assert frame.key != Frame(rgb, depth, CAMERA).key
    for wrong, message in (
        ((rgb[:-1], depth), "colour image"),
        ((rgb, depth[:-1]), "depth image"),
        ((rgb.astype(float), depth), "uint8"),
        ((rgb, np.ones((480, 640), np.uint16)), "metres"),
        ((rgb, depth, CAMERA, robot[:4]), "robot_mask of the frame"),
        ((rgb, depth, CAMERA, None, (), robot[:4]), "estimated of the frame"),
    ):
        with pytest.raises(InputError, match=message):
            Frame(*wrong, *([CAMERA] if len(wrong) == 2 else []))


def test_pixels_of_points_inside_and_outside_the_image():
    camera = Camera(np.array([[100, 0, 9.5], [0, 100, 4.5], [0, 0, 1.0]]), 20, 10)
    # Pixel (12, 3) at 2 m; one row above the image; behind the camera.
    points = np.array([[(12 - 9.5) * 0.02, (3 - 4.5) * 0.02, 2.0], [0.0, (-1 - 4.5) * 0.01, 1.0], [0.0, 0.0, -1.0]])
    u, v, z, inside = camera.pixels_of(points)
    assert inside.tolist() == [True, False, False]
    assert (u.tolist(), v.tolist()) == ([12, 0, 0], [3, 0, 0])
    assert z.tolist() == [2.0, 1.0, -1.0]


def test_a_camera_that_looks_straight_down():
    pose = look_at((0.1, 0.2, 1.0), (0.1, 0.2, 0.0))
    np.testing.assert_allclose(pose.apply([[0, 0, 1], [0, -1, 0]]), [[0.1, 0.2, 0], [0.1, 1.2, 1]], atol=1e-12)
    with pytest.raises(InputError, match="are both at"):
        look_at((0, 0, 1), (0, 0, 1))


def test_depth_in_millimetres_is_refused():
    depth = np.full((CAMERA.height, CAMERA.width), 800.0)
    with pytest.raises(InputError, match="median of 800 m"):
        Frame(np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA)

"""Rendered against observed depth: closed forms, what says nothing, and invariances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.errors import InputError
from mstfilter.fusion.depth_evidence import DepthAgreement, _every
from mstfilter.scene import Camera, Clip, Frame, Hypothesis, VoxelGrid, depth_sigma, look_at, render
from tests.scene.scenes import CAMERA, GRID, table_scene

ABOVE = look_at((0.0, 0.0, 0.8), (0, 0, 0), up=(0, 1, 0))


def frame_of(labels, camera, robot=None, noise=None):
    """What the camera measures of a label grid on the table."""
    seen = render(labels, GRID, camera)
    directions = camera.rays() @ camera.pose.as_matrix()[:3, :3].T
    depth = np.where(seen.labels > 0, seen.depth, -camera.position[2] / directions[..., 2])
    if noise is not None:
        depth = depth + noise.normal(size=depth.shape) * depth_sigma(depth)
    return Frame(np.zeros((*depth.shape, 3), np.uint8), depth, camera, robot)


def score(labels, frame, **fields):
    hypotheses = [Hypothesis.from_labels(np.asarray(a, np.uint16), GRID) for a in labels]
    return DepthAgreement(**fields).log_score(hypotheses, Clip((frame,), GRID, 0))


def variants():
    """The truth of the table scene; box 1 missing, 5 cm higher, 3 and 6 voxels further; one more box."""
    truth = table_scene()[2]
    box = truth == 1
    rest = np.where(box, 0, truth)
    out = [truth, rest]
    for axis, way in ((2, 5), (0, 3), (0, 6)):
        out.append(np.where(np.roll(box, way, axis), 1, rest))
    extra = truth.copy()
    extra[48:56, 45:52, :10] = 3
    return [*out, extra]


@pytest.mark.parametrize("noise", [None, np.random.default_rng(0)])
def test_the_truth_is_best(noise):
    truth, *others = score(variants(), frame_of(table_scene()[2], CAMERA, noise=noise))
    if noise is None:
        assert truth == pytest.approx(0, abs=1e-3)
    assert truth > max(others) + 5
    missing, _, near, far, _ = others
    assert near > far and near > missing


def test_one_reading_by_hand():
    """One pixel that sees the table from above: half a squared difference, times its share of a block."""
    camera = Camera.from_intrinsics(100, 100, 0, 0, 1, 1, ABOVE)
    labels = np.zeros(GRID.shape, np.uint16)
    voxel = 100 * 0.01 / 0.65  # pixels; the middle of the workspace is 0.65 m away
    share = 1 / (2 * voxel) ** 2
    for reading, error in ((0.8, 0.0), (0.79, 0.01), (0.815, 0.015), (0.7, None)):
        frame = Frame(np.zeros((1, 1, 3), np.uint8), np.full((1, 1), reading), camera)
        scale = np.hypot(0.00185 * reading**2, 0.01)
        cost = 9.0 if error is None else (error / scale) ** 2
        assert score([labels], frame)[0] == pytest.approx(-0.5 * cost * share, rel=1e-4, abs=1e-9)
    # Far away the sensor is worse, and the same difference says less.
    frame = Frame(np.zeros((1, 1, 3), np.uint8), np.full((1, 1), 0.79), camera)
    assert score([labels], frame, voxels=0.01)[0] == pytest.approx(
        -0.5 * min((0.01 / np.hypot(0.00185 * 0.79**2, 1e-4)) ** 2, 9) * share, rel=1e-3
    )


def test_blocks_count_and_not_pixels():
    """A missing box costs half the cap a block, whatever the size of the image."""
    truth = np.zeros(GRID.shape, np.uint16)
    truth[20:40, 20:40, :20] = 1
    found = []
    for size in (1, 2, 4):
        camera = Camera.from_intrinsics(131, 131, 79.5, 59.5, 160, 120, ABOVE).scaled(size)
        right, wrong = score([truth, np.zeros_like(truth)], frame_of(truth, camera))
        found.append(right - wrong)
        if size == 4:  # the top is 0.6 m away, the middle of the workspace 0.65 m; a block is 2 voxels wide
            pixels = (render(truth, GRID, camera).labels > 0).sum()
            assert found[-1] == pytest.approx(4.5 * pixels / (2 * 4 * 131 * 0.01 / 0.65) ** 2, rel=0.03)
    assert found == pytest.approx([found[0]] * 3, rel=0.05)


def test_what_is_not_measured_says_nothing():
    truth, missing = variants()[:2]
    whole = frame_of(truth, CAMERA)
    hidden = render(truth, GRID, CAMERA).labels == 1
    right, wrong = score([truth, missing], whole)
    assert right > wrong + 5
    blind = Frame(whole.rgb, np.where(hidden, np.nan, whole.depth), CAMERA)
    robot = Frame(whole.rgb, np.where(hidden, 3.0, whole.depth), CAMERA, hidden)
    for frame in (blind, robot):
        assert score([truth, missing], frame) == pytest.approx([0, 0], abs=1e-3)
    nothing = Frame(whole.rgb, np.full_like(whole.depth, np.nan), CAMERA)
    assert score([truth, missing], nothing).tolist() == [0, 0]
    # Before the workspace something stands in the way: it hides the table, an object behind it and their absence.
    before = Frame(whole.rgb, np.where(hidden, 0.15, whole.depth), CAMERA)
    assert score([truth, missing], before) == pytest.approx([0, 0], abs=1e-3)
    # But what the sensor looked through is not there.
    through = Frame(whole.rgb, np.where(hidden, 3.0, whole.depth), CAMERA)
    right, wrong = score([truth, missing], through)
    assert right < -5


def test_beside_the_workspace_no_table_is_expected():
    narrow = VoxelGrid((-0.1, -0.1, 0.0), 0.01, (20, 20, 30))
    frame = frame_of(np.zeros(GRID.shape, np.uint16), CAMERA)
    floor = Frame(frame.rgb, frame.depth + 0.2, CAMERA)  # no table at all, but a floor
    empty = Hypothesis.from_labels(np.zeros(narrow.shape, np.uint16), narrow)
    inside = DepthAgreement().log_score([empty], Clip((floor,), narrow, 0))[0]
    points = frame.points
    seen = (np.abs(points[..., :2]) < 0.1).all(axis=-1).sum()
    voxel = 131 * 0.01 / float(CAMERA.project((narrow.origin + narrow.upper) / 2)[1])
    assert inside == pytest.approx(-4.5 * seen / (2 * voxel) ** 2, rel=0.05)


@pytest.mark.parametrize("step", [1, 2, 3, 7])
def test_the_camera_of_every_third_pixel(step):
    first = step // 2
    np.testing.assert_allclose(_every(CAMERA, step).rays(), CAMERA.rays()[first::step, first::step], atol=1e-12)


def test_fields_are_checked():
    for wrong in ({"strength": 0}, {"block": -1}, {"spacing": 0}, {"voxels": np.nan}, {"cap": np.inf}):
        with pytest.raises(InputError, match="depth has"):
            DepthAgreement(**wrong)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.permutations(range(6)), st.permutations(range(1, 20)))
def test_order_and_names_do_not_matter(order, names):
    frame = frame_of(table_scene()[2], CAMERA, noise=np.random.default_rng(1))
    found = variants()
    scores = score(found, frame)
    assert np.array_equal(score([found[k] for k in order], frame), scores[list(order)])
    table = np.array([0, *names])
    assert np.array_equal(score([table[a] for a in found], frame), scores)

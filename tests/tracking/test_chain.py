"""Objects that are followed from frame to frame, and the cost of a complete shape."""

import numpy as np
import pytest

from mstfilter.tracking import flow as dense
from mstfilter.tracking.chain import follow
from mstfilter.tracking.flow import DenseFlow
from mstfilter.tracking.residual import _signed_distance, shape_cost
from mstfilter.tracking.rules import MstRule
from mstfilter.tracking.segments import Track, segments_of
from tests.tracking.scenes import Box, Scene, at, errors, slide

SIZE = np.array([0.12, 0.08, 0.1])


@pytest.fixture(scope="module")
def turning():
    """A textured box that slides 6 cm and turns by 72 degrees in 12 frames; the last frame shows another face."""
    poses = slide(at(-0.03, 0, 0.05), at(0.03, 0, 0.05, 72), 12)
    scene = Scene([Box(tuple(SIZE), texture=0.7)], [[p] for p in poses], (480, 360))
    clip = scene.clip(0)
    return scene, Track(segments_of(scene.hypothesis(), clip.before)[1], clip, DenseFlow().track(clip))


def test_an_object_that_turns_is_followed(turning):
    scene, track = turning
    chain = follow(np.random.default_rng(0), track)
    mm, degrees = errors(chain.T, scene.motions()[1], track.points.mean(axis=0))
    assert mm < 6 and degrees < 4
    assert chain.n_pixels > 500 and chain.score < 1.5


def test_the_rule_takes_the_chain_only_if_nothing_else_fits(turning):
    scene, track = turning
    rng, centre = np.random.default_rng(0), track.points.mean(axis=0)
    for rule in (MstRule(), MstRule(use_flow=False, use_icp=False, use_sift=False, search_above=-1)):
        chosen = rule.choose(rng, rule.candidates(rng, track))
        mm, degrees = errors(chosen.T, scene.motions()[1], centre)
        assert mm < 6 and degrees < 4
    assert chosen.kind == "chain"
    assert all(c.kind != "chain" for c in MstRule(follow_above=-1).candidates(rng, track))


def test_the_cost_of_a_shape_is_least_at_the_true_motion(turning):
    scene, track = turning
    truth = scene.motions()[1]
    steps = [at(0.02, 0, 0), at(-0.02, 0, 0), at(0, 0.02, 0), at(0, -0.02, 0), at(0, 0, 0.02)]
    costs = shape_cost(track, np.stack([truth, *(step @ truth for step in steps), np.eye(4)]))
    assert costs[0] < 2 and (costs[1:] > costs[0] + 2).all()


def test_the_distance_from_a_crop_is_that_of_the_box(turning):
    scene, track = turning
    grid = track.clip.grid
    local = np.random.default_rng(0).uniform(-0.07, 0.07, (2000, 3))
    q = np.abs(local) - SIZE / 2
    exact = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    pose = scene.poses[0][0]
    found = _signed_distance(track.crop, grid, local @ pose[:3, :3].T + pose[:3, 3])
    assert np.abs(found - np.minimum(exact / grid.voxel_size, 4)).max() < 1.6
    assert np.abs(found - np.minimum(exact / grid.voxel_size, 4)).mean() < 0.6


def test_flow_of_half_the_resolution_moves_points_alike():
    v, u = np.mgrid[:48, :64].astype(np.float32)
    full = np.stack([0.1 * u + 2, 0.05 * v - 0.1 * u], axis=-1)
    half = full.reshape(24, 2, 32, 2, 2).mean(axis=(1, 3))
    points = np.random.default_rng(0).uniform(2, 44, (100, 2)).astype(np.float32)
    expected = np.stack([0.1 * points[:, 0] + 2, 0.05 * points[:, 1] - 0.1 * points[:, 0]], axis=1)
    for field in (full, half):
        moved = dense._sample(field, points, field.shape[1] / 64)
        assert np.abs(moved - expected).max() < 0.02  # the weights of `remap` are multiples of 1 / 32

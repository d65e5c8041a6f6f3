"""Residual, refinement, features and the static test, one segment at a time."""

import numpy as np
import pytest

from mstfilter.mst.tracking.features import SiftMatching
from mstfilter.mst.tracking.flow import DenseFlow
from mstfilter.mst.tracking.residual import MotionResidual, normals, refine_motion
from mstfilter.mst.tracking.segments import StaticTest, Track, segments_of
from mstfilter.scene import Clip, Frame
from tests.mst.tracking.scenes import Box, Cylinder, Scene, at, errors, slide, standard

RESTING, MOVING = (3, 4, 6), (1, 2, 5)


def tracks_of(scene, clip):
    flow = DenseFlow().track(clip)
    return {k: Track(s, clip, flow) for k, s in segments_of(scene.hypothesis(), clip.before).items()}


def test_static_objects_pass_the_test_for_rest_and_moving_ones_do_not(textured, plain):
    for scene, clip in (textured, plain):
        tracks = tracks_of(scene, clip)
        assert [k for k, t in tracks.items() if StaticTest().rests(t)] == list(RESTING)
        assert not any(StaticTest(enabled=False).rests(t) for t in tracks.values())


def test_an_occluded_static_object_passes_the_test_for_rest():
    wall = slide(at(-0.22, -0.12, 0.06), at(-0.03, -0.12, 0.06), 5)
    scene = Scene(
        [Box((0.12, 0.1, 0.1)), Box((0.05, 0.04, 0.12), (60, 120, 60))], [[at(0, 0.05, 0.05), p] for p in wall]
    )
    tracks = tracks_of(scene, scene.clip(0))
    assert StaticTest().rests(tracks[1])
    assert not StaticTest().rests(tracks[2])


@pytest.mark.parametrize("shift", [0.004, 0.01])
def test_small_shifts_fail_the_test_for_rest(shift):
    scene = Scene([Box((0.1, 0.08, 0.07))], [[at(0, 0, 0.035)], [at(shift, 0, 0.035)]])
    assert not StaticTest().rests(tracks_of(scene, scene.clip(0))[1])


def test_the_true_motion_has_the_least_residual(textured):
    scene, clip = textured
    residual = MotionResidual()
    for k in (1, 5):
        track, truth = tracks_of(scene, clip)[k], scene.motions()[k]
        centre = track.points.mean(axis=0)
        best = residual.score(track, truth)
        for step in (at(0.01, 0, 0), at(0, 0.01, 0), at(0, 0, 0.01), at(-0.02, 0.02, 0)):
            assert residual.score(track, step @ truth) > best
        turn = at(0, 0, 0, 8)
        turn[:3, 3] = centre - turn[:3, :3] @ centre
        assert residual.score(track, truth @ turn) > best
        assert residual.score(track, np.eye(4)) > best + 5


def test_the_residual_distinguishes_equal_objects_by_the_flow():
    scene = standard(9, size=(480, 360))
    track = tracks_of(scene, scene.clip(0))[5]
    onto_twin = scene.poses[0][3] @ np.linalg.inv(scene.poses[0][4])  # object 5 to where its twin, 4, rests
    truth = scene.motions()[5]
    assert MotionResidual().score(track, truth) < MotionResidual().score(track, onto_twin)
    by_look = MotionResidual(track_weight=0.0, target_weight=0.0)
    assert by_look.score(track, onto_twin) < by_look.score(track, truth) + 0.5


def test_occluded_points_and_points_outside_have_constant_costs(textured):
    scene, clip = textured
    track, residual = tracks_of(scene, clip)[1], MotionResidual(track_weight=0.0, target_weight=0.0, min_visible=0.0)
    assert residual.score(track, at(0, 0, -0.5)) == pytest.approx(5.6)
    assert residual.score(track, at(30, 0, 0)) == pytest.approx(16.0)
    assert MotionResidual().score(track, at(0, 0, -0.5)) == np.inf, "a hidden place has no evidence"


def test_scores_of_several_motions_equal_single_scores(textured):
    scene, clip = textured
    track, rng = tracks_of(scene, clip)[1], np.random.default_rng(0)
    motions = np.stack([at(*rng.uniform(-0.1, 0.1, 3), 10 * rng.normal()) for _ in range(20)])
    together = MotionResidual().scores(track, motions)
    np.testing.assert_array_equal(together, [MotionResidual().score(track, T) for T in motions])


def test_the_residual_is_infinite_without_depth(textured):
    scene, clip = textured
    blank = Frame(clip.after.rgb, np.full_like(clip.after.depth, np.nan), clip.after.camera)
    blind = Clip((clip.before, blank), clip.grid)
    assert tracks_of(scene, blind)[1].target_surface is None
    assert MotionResidual().score(tracks_of(scene, blind)[1], np.eye(4)) == np.inf


def test_refinement_reduces_the_error_of_a_motion(textured, plain):
    for kind, (scene, clip) in (("textured", textured), ("plain", plain)):
        for k in (1, 5):
            track, truth = tracks_of(scene, clip)[k], scene.motions()[k]
            centre = track.points.mean(axis=0)
            off = at(0.006, -0.005, 0.004, 3)
            off[:3, 3] += centre - off[:3, :3] @ centre
            refined = refine_motion(track, truth @ off)
            mm, deg = errors(refined, truth, centre)
            assert deg < 1.2
            assert MotionResidual().score(track, refined) < 0.6 * MotionResidual().score(track, truth @ off)
            if kind == "textured":  # along a plain face neither depth nor colour determines the motion
                assert mm < 2.0


def test_refinement_uses_colour_for_the_spin_of_a_can():
    poses = [[at(0, 0, 0.06)], [at(0.0, 0.0, 0.06, 6)]]
    scene = Scene([Cylinder((0.09, 0.09, 0.12), texture=0.7)], poses, (640, 480))
    track = tracks_of(scene, scene.clip(0))[1]
    T = refine_motion(track, np.eye(4))
    assert errors(T, scene.motions()[1], track.points.mean(axis=0))[1] < 1.5


def test_normals_are_those_of_the_table(plain):
    scene, clip = plain
    table = scene.trace(scene.poses[-1])[1] == 0
    n = normals(clip.after)[table]
    up = np.nanmedian(n[:, 2])
    assert up > 0.95
    assert np.nanmax(np.abs(np.linalg.norm(n, axis=1) - 1)) < 1e-4


def test_sift_matches_follow_a_textured_box():
    scene = Scene(
        [Box((0.16, 0.14, 0.08), texture=0.7)], [[at(-0.04, 0, 0.04)], [at(0.03, 0.02, 0.04, 8)]], (640, 480)
    )
    clip = scene.clip(0)
    m = SiftMatching().match(clip.before, clip.after)
    chosen = m.within(scene.trace(scene.poses[0])[1] == 1, scene.trace(scene.poses[1])[1] == 1)
    T = scene.motions()[1]
    error = np.linalg.norm(m.p[chosen] @ T[:3, :3].T + T[:3, 3] - m.q[chosen], axis=1)
    assert len(chosen) >= 20
    assert np.median(error) < 0.005


def test_search_radii_bound_the_matches(textured):
    _, clip = textured
    near = SiftMatching(search_share=0.05, search_distance=0.03).match(clip.before, clip.after)
    assert (np.linalg.norm(near.before - near.after, axis=1) <= 16).all()
    assert (np.linalg.norm(near.p - near.q, axis=1) <= 0.03).all()
    many = SiftMatching(mutual=False).match(clip.before, clip.after)
    one = SiftMatching().match(clip.before, clip.after)
    assert len(many.p) > len(one.p)
    assert len(np.unique(one.before, axis=0)) == len(one.before)

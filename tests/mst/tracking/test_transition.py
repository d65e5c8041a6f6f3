import json

import numpy as np
import pytest
from hypothesis import given, strategies as st

from mstfilter.mst.tracking import (
    AuthorsRule,
    IdentityTransition,
    MstRule,
    PaperRule,
    StaticTest,
    TrackingTransition,
    Warp,
)
from mstfilter.mst.tracking.segments import segments_of
from mstfilter.mst.tracking.transition import _tracked_as
from mstfilter.scene import Clip, Frame, Hypothesis, render
from mstfilter.smc import Population
from tests.mst.tracking.scenes import Box, Cylinder, Scene, at, errors, iou, slide
from tests.scene.scenes import CAMERA, GRID as TABLE

RULES = {"mst": MstRule(), "paper": PaperRule(), "authors": AuthorsRule()}


def population(*hypotheses):
    return Population(tuple(hypotheses), np.arange(len(hypotheses)) / 10.0)


def predict(clip, *hypotheses, seed=0, transition=None):
    return (transition or TrackingTransition()).predict(np.random.default_rng(seed), population(*hypotheses), clip)


def merged(h, a, b):
    """The same scene with object a counted to b."""
    return Hypothesis.from_labels(np.where(h.labels == a, b, h.labels), h.grid)


@pytest.mark.parametrize("kind", ["textured", "plain"])
def test_hypotheses_follow_the_scene(kind, request):
    scene, clip = request.getfixturevalue(kind)
    h, truth = scene.hypothesis(), scene.labels(scene.poses[-1])
    moved = predict(clip, h).particles[0]
    for k in (1, 2, 5):
        assert iou(h.labels == k, truth == k) < 0.1
        assert iou(moved.labels == k, truth == k) > 0.75
    for k in (3, 4, 6):
        np.testing.assert_array_equal(moved.labels == k, h.labels == k)


@pytest.mark.parametrize("rule", RULES)
def test_a_static_clip_returns_the_same_hypothesis(rule):
    poses = [[at(-0.1, 0, 0.04, 20), at(0.08, 0, 0.05)]] * 4
    scene = Scene([Box((0.1, 0.08, 0.08)), Cylinder((0.08, 0.08, 0.1), texture=0.0)], poses)
    h = scene.hypothesis()
    moved = predict(scene.clip(0), h, transition=TrackingTransition(RULES[rule]))
    assert moved.particles[0] is h
    assert moved.notes["motions"] == {"static": 2}


def test_population_bookkeeping(textured):
    scene, clip = textured
    h = scene.hypothesis()
    moved = predict(clip, h, merged(h, 4, 5), h)
    np.testing.assert_array_equal(moved.log_weights, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(moved.parents["previous"], [0, 1, 2])
    assert json.loads(json.dumps(moved.notes)) == moved.notes
    assert sum(moved.notes["motions"].values()) == 6 + 5 + 6
    assert moved.notes["segments"] == 7  # six, and the merged one
    assert not TrackingTransition.properly_weighted
    assert [r.id for r in moved.particles[0].objects] == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("rule", RULES)
def test_the_order_of_hypotheses_has_no_effect(rule, textured):
    scene, clip = textured
    h = scene.hypothesis()
    hs = [h, merged(h, 4, 5), merged(h, 3, 1)]
    transition = TrackingTransition(RULES[rule])
    forward, backward = predict(clip, *hs, transition=transition), predict(clip, *hs[::-1], transition=transition)
    for a, b in zip(forward.particles, backward.particles[::-1], strict=True):
        np.testing.assert_array_equal(a.labels, b.labels)
    assert forward.notes == backward.notes


@given(st.lists(st.frozensets(st.integers(0, 30), min_size=8), min_size=1, max_size=8))
def test_similar_segments_are_tracked_as_the_first_of_them(pixels):
    found = _tracked_as([np.array(sorted(one)) for one in pixels], 0.9)
    for k, n in enumerate(found):
        earlier = sorted(set(found[:k]))
        similar = [m for m in earlier if len(pixels[m] & pixels[k]) >= 0.9 * max(len(pixels[m]), len(pixels[k]))]
        assert n == (similar[0] if similar else k)


@pytest.mark.parametrize("share, n_tracked", [(0.03, 1), (0.3, 2)])
def test_nearly_equal_segments_have_one_motion(share, n_tracked, textured):
    """A hypothesis in which a strip of a moved object is missing, narrow or broad."""
    scene, clip = textured
    h = scene.hypothesis()
    moved = predict(clip, h).particles[0]
    label = next(r.label for r in moved.objects if np.abs(r.motion.translation).max() > 0.01)
    voxels = np.argwhere(h.labels == label)
    labels = h.labels.copy()
    labels[tuple(voxels[voxels[:, 0] < np.quantile(voxels[:, 0], share)].T)] = 0
    calls = []

    class Counting(MstRule):
        def candidates(self, rng, track):
            calls.append(track.segment.key)
            return super().candidates(rng, track)

    pair = predict(clip, h, h.with_labels(labels), transition=TrackingTransition(Counting()))
    first, second = (p.record(label).motion.as_matrix() for p in pair.particles)
    assert np.array_equal(first, second) is (n_tracked == 1)
    assert len(calls) >= n_tracked


def test_a_stochastic_rule_moves_copies_differently_and_repeats_with_the_seed(textured):
    scene, clip = textured
    transition = TrackingTransition(MstRule(select="sample", n_eff=0.5))
    hs = [scene.hypothesis()] * 12
    a, b, c = (predict(clip, *hs, seed=s, transition=transition) for s in (0, 0, 1))
    grids = [p.labels.tobytes() for p in a.particles]
    assert len(set(grids)) > 1
    assert grids == [p.labels.tobytes() for p in b.particles]
    assert grids != [p.labels.tobytes() for p in c.particles]


def test_without_video_no_object_moves(textured):
    scene, clip = textured
    h = scene.hypothesis()
    single = Clip((clip.before,), clip.grid)
    for observation in (single, None):
        assert predict(observation, h).particles[0] is h
    assert IdentityTransition().predict(np.random.default_rng(0), population(h), clip).particles[0] is h


def test_an_occluded_object_does_not_move():
    """Box 2 is hidden behind box 1 all the time."""
    poses = [[at(0, -0.05, 0.09), at(0.0, 0.06, 0.02)]] * 2
    scene = Scene([Box((0.3, 0.06, 0.18)), Box((0.05, 0.05, 0.04))], poses)
    moved = predict(scene.clip(0), scene.hypothesis())
    assert moved.notes["motions"] == {"invisible": 1, "static": 1}


@pytest.mark.parametrize("rule", RULES)
def test_full_occlusion_at_the_end_leaves_the_object_where_it_was(rule):
    screen = slide(at(-0.3, -0.12, 0.12), at(0.0, -0.12, 0.12), 7)
    scene = Scene(
        [Box((0.06, 0.06, 0.05)), Box((0.2, 0.03, 0.24), (60, 120, 60))], [[at(0, 0.05, 0.025), p] for p in screen]
    )
    h = scene.hypothesis()
    moved = predict(scene.clip(0), h, transition=TrackingTransition(RULES[rule])).particles[0]
    assert iou(moved.labels == 1, h.labels == 1) > 0.9


def test_voxels_that_leave_the_workspace_are_counted():
    scene = Scene([Box((0.08, 0.08, 0.06))], [[p] for p in slide(at(0.30, 0, 0.03), at(0.40, 0, 0.03), 6)])
    moved = predict(scene.clip(0), scene.hypothesis())
    volume = scene.hypothesis().volumes()[1]
    assert moved.notes["voxels_left"] > 0.3 * volume
    assert moved.particles[0].volumes()[1] < 0.7 * volume


def test_an_object_that_leaves_the_view_does_not_affect_others():
    scene = Scene(
        [Box((0.08, 0.08, 0.06)), Box((0.08, 0.08, 0.06), (60, 120, 60))],
        [[p, at(0, 0.1, 0.03)] for p in slide(at(-0.1, -0.12, 0.03), at(-0.1, -0.5, 0.03), 6)],
    )
    moved = predict(scene.clip(0), scene.hypothesis())
    np.testing.assert_array_equal(moved.particles[0].labels == 2, scene.hypothesis().labels == 2)


def small_box(shift, camera):
    """A box of 2 x 2 x 1 voxels that stands `shift` voxels further right: colour, depth and labels."""
    labels = np.zeros(TABLE.shape, np.uint16)
    labels[30 + shift : 32 + shift, 30:32, :1] = 1
    seen = render(labels, TABLE, camera)
    directions = camera.rays() @ camera.pose.as_matrix()[:3, :3].T
    table = -camera.position[2] / np.minimum(directions[..., 2], -1e-6)
    depth = np.where(seen.labels > 0, seen.depth, table).astype(np.float32)
    checks = (np.floor((camera.position + depth[..., None] * directions) / 0.03).astype(int).sum(-1) % 2) * 30
    rgb = np.where(seen.labels[..., None] > 0, [190, 60, 50], 130 + checks[..., None])
    return rgb.astype(np.uint8), depth, labels


@pytest.mark.parametrize("scale", [1, 4])
@pytest.mark.parametrize("steps", [(0, 0, 0), (0, 1, 2, 3)])
def test_a_small_object_is_tracked_in_images_of_any_size(scale, steps):
    """The box has 6 readings in an image of 160 x 120, and 16 times as many, up to the rim, in one of 640 x 480."""
    camera = CAMERA.scaled(scale)
    frames = [Frame(*small_box(step, camera)[:2], camera) for step in steps]
    h = Hypothesis.from_labels(small_box(0, camera)[2], TABLE)
    (support,) = (segment.support for segment in segments_of(h, frames[0]).values())
    assert 4 <= len(support) / scale**2 < 12
    moved = predict(Clip(frames, TABLE, 1, tuple(map(float, steps)) if steps[-1] else (0.0, 1.0, 2.0)), h)
    assert moved.notes["motions"] == {"search" if steps[-1] else "static": 1}
    shift = moved.particles[0].record(1).motion.translation
    np.testing.assert_allclose(shift, (0.01 * steps[-1], 0, 0), atol=0.002)


@pytest.mark.parametrize("rule", RULES)
def test_a_mask_without_depth_stays(rule, textured):
    scene, clip = textured
    h = scene.hypothesis()
    hole = np.array(clip.before.depth)
    hole[scene.trace(scene.poses[0])[1] == 1] = np.nan
    blind = Clip(
        (Frame(clip.before.rgb, hole, clip.before.camera, clip.before.robot_mask), *clip.frames[1:]), clip.grid
    )
    moved = predict(blind, h, transition=TrackingTransition(RULES[rule]))
    assert moved.notes["motions"]["unsupported"] >= 1
    np.testing.assert_array_equal(moved.particles[0].record(1).motion.as_matrix(), np.eye(4))


@pytest.mark.parametrize("rule", RULES)
def test_without_depth_no_object_moves(rule, textured):
    scene, clip = textured
    h = scene.hypothesis()
    blind = [Frame(f.rgb, np.full_like(f.depth, np.nan), f.camera) for f in clip.frames]
    assert predict(Clip(blind, clip.grid), h, transition=TrackingTransition(RULES[rule])).particles[0] is h


@pytest.mark.parametrize("rule", RULES)
def test_an_object_of_one_voxel_raises_no_error(rule, textured):
    scene, clip = textured
    labels = scene.labels(scene.poses[0])
    x, y, z = np.argwhere(labels == 1)[-1]
    labels[labels == 1] = 0
    labels[x, y, z] = 1
    h = Hypothesis.from_labels(labels, scene.grid)
    moved = predict(clip, h, transition=TrackingTransition(RULES[rule], min_support=1)).particles[0]
    assert moved.n_objects >= 5


def test_twins_are_not_exchanged():
    """4 and 5 look alike and touch; 5 slides away, 4 rests."""
    poses = [[at(-0.04, 0, 0.04), p] for p in slide(at(0.041, 0, 0.04), at(0.11, 0.05, 0.04, 25), 8)]
    twins = [Box((0.08, 0.08, 0.08), texture=0.6, seed=4)] * 2
    scene = Scene(twins, poses, (480, 360))
    h, truth = scene.hypothesis(), scene.labels(poses[-1])
    moved = predict(scene.clip(0), h, transition=TrackingTransition(static=StaticTest(False))).particles[0]
    assert iou(moved.labels == 1, truth == 1) > 0.8
    assert iou(moved.labels == 2, truth == 2) > 0.8


def test_half_of_an_object_moves_like_the_complete_object(plain):
    scene, clip = plain
    labels = scene.labels(scene.poses[0])
    where = np.argwhere(labels == 1)
    half = where[where[:, 2] >= 5]
    labels[tuple(half.T)] = 9
    moved = predict(clip, Hypothesis.from_labels(labels, scene.grid)).particles[0]
    truth = scene.labels(scene.poses[-1]) == 1
    assert iou(np.isin(moved.labels, (1, 9)), truth) > 0.7


def test_records_carry_the_composed_motion(textured):
    scene, clip = textured
    h = scene.hypothesis()
    once = predict(clip, h).particles[0]
    record = once.record(1)
    centre = np.array([*scene.poses[0][0][:2, 3], 0.1])
    mm, deg = errors(record.motion.as_matrix(), scene.motions()[1], centre)
    assert mm < 5 and deg < 2
    np.testing.assert_array_equal(h.labels[record.source.box] == 1, record.source.occupied)
    back = Clip(tuple(reversed(clip.frames)), clip.grid)
    twice = predict(back, once).particles[0]
    assert iou(twice.labels == 1, h.labels == 1) > 0.9  # and not 0.9 of 0.9


def test_splat_removes_the_source(textured):
    scene, clip = textured
    transition = TrackingTransition(warp=Warp("splat", "label"))
    moved = predict(clip, scene.hypothesis(), transition=transition).particles[0]
    assert all(r.source is None for r in moved.objects)

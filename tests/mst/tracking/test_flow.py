import numpy as np
import pytest

from mstfilter.mst.tracking.flow import DenseFlow, _changed
from mstfilter.scene import Clip, Frame
from tests.mst.tracking.scenes import Box, Scene, at, iou, slide


def track_labels(labels, clip):
    return DenseFlow().track(clip).warp(labels)


MOVERS, RESTING = (1, 2, 5), (3, 4, 6)


def label_images(scene):
    images = []
    for poses in (scene.poses[0], scene.poses[-1]):
        ids = scene.trace(poses)[1]
        ids[ids == 7] = 0
        images.append(ids.astype(np.uint16))
    return images


@pytest.mark.parametrize("kind", ["textured", "plain"])
def test_masks_follow_moving_objects_and_stay_on_static_ones(kind, request):
    scene, clip = request.getfixturevalue(kind)
    before, after = label_images(scene)
    tracked = track_labels(before, clip)
    standing = np.mean([iou(before == k, after == k) for k in MOVERS])
    moving = np.mean([iou(tracked == k, after == k) for k in MOVERS])
    assert standing < 0.35
    assert moving > 0.68
    # A label bleeds between touching twins (4 and 5): that is why rest is tested first.
    assert min(iou(tracked == k, after == k) for k in RESTING) > 0.7


def test_a_static_clip_returns_the_masks_unchanged():
    frame = Scene([Box((0.1, 0.1, 0.1))], [[at(0, 0, 0.05)]]).frame(np.random.default_rng(0), [at(0, 0, 0.05)])
    clip = Clip((frame, frame, frame), Scene([], [[]]).grid)
    labels = np.random.default_rng(1).integers(0, 9, frame.depth.shape).astype(np.uint16)
    seen = np.isfinite(frame.depth)
    np.testing.assert_array_equal(track_labels(labels, clip)[seen], labels[seen])


def test_a_mask_does_not_depend_on_the_other_masks(textured):
    scene, clip = textured
    before, _ = label_images(scene)
    alone = track_labels(np.where(before == 5, before, 0), clip)
    np.testing.assert_array_equal(alone == 5, track_labels(before, clip) == 5)


def test_the_robot_is_never_followed(textured):
    _, clip = textured
    tracks = DenseFlow().track(clip)
    start_on_robot = clip.before.robot_mask[tracks.start[:, 1], tracks.start[:, 0]]
    assert not (tracks.alive & start_on_robot).any()
    assert (tracks.source[clip.after.robot_mask] == -1).all()
    everything = np.ones(tracks.source.shape, np.uint16)
    assert (tracks.warp(everything)[clip.after.robot_mask] == 0).all()


@pytest.mark.parametrize("region", ["changed", "image"])
def test_points_end_where_the_surface_went(region):
    scene = Scene(
        [Box((0.14, 0.12, 0.08), texture=0.6)], [[p] for p in slide(at(-0.05, 0, 0.04), at(0.04, 0.03, 0.04, 12), 6)]
    )
    clip = scene.clip(0)
    tracks = DenseFlow(region=region).track(clip)
    ids = scene.trace(scene.poses[0])[1]
    chosen = tracks.points_in(ids == 1)
    u, v = tracks.start[chosen].T
    truth, _ = clip.after.camera.project(
        clip.before.points[v, u] @ scene.motions()[1][:3, :3].T + scene.motions()[1][:3, 3]
    )
    error = np.linalg.norm(tracks.end[chosen] - truth, axis=1)
    assert len(chosen) > 100
    assert np.nanmedian(error) < 2.0


def test_the_flow_of_the_changed_region_follows_masks_as_well_as_that_of_the_image(textured):
    scene, clip = textured
    before, after = label_images(scene)
    quality = {}
    for region in ("changed", "image"):
        tracked = DenseFlow(region=region).track(clip).warp(before)
        quality[region] = np.mean([iou(tracked == k, after == k) for k in MOVERS])
    assert quality["changed"] > quality["image"] - 0.03


def test_pixels_far_from_any_change_keep_their_position(textured):
    _, clip = textured
    a, b = clip.frames[0], clip.frames[-1]
    (rows, columns), settled = _changed(a, b)
    outside = np.ones(settled.shape, bool)
    outside[rows, columns] = False
    source = DenseFlow().track(Clip((a, b), clip.grid)).source
    grid = np.arange(source.size, dtype=np.int32).reshape(source.shape)
    assert (outside & settled).any()
    np.testing.assert_array_equal(source[outside & settled], grid[outside & settled])
    assert _changed(a, a)[0] == np.s_[0:0, 0:0]


def test_colour_alone_is_enough():
    scene = Scene(
        [Box((0.14, 0.12, 0.08), texture=0.6)], [[p] for p in slide(at(-0.04, 0, 0.04), at(0.03, 0.0, 0.04), 5)]
    )
    clip = scene.clip(0)
    blind = [Frame(f.rgb, np.full_like(f.depth, np.nan), f.camera) for f in clip.frames]
    before, after = (scene.trace(p)[1].astype(np.uint16) for p in (scene.poses[0], scene.poses[-1]))
    tracked = track_labels(before, Clip(blind, clip.grid))
    assert iou(tracked == 1, after == 1) > 0.8 > iou(before == 1, after == 1)


def test_a_change_of_exposure_is_not_a_change_of_the_scene():
    scene = Scene([Box((0.1, 0.1, 0.08))], [[at(0, 0, 0.04)]] * 2)
    clip = scene.clip(0)
    dimmed = np.clip(clip.after.rgb * np.array([0.8, 0.85, 0.9]) + 6, 0, 255).astype(np.uint8)
    after = Frame(dimmed, clip.after.depth, clip.after.camera)
    tracks = DenseFlow().track(Clip((clip.before, after), clip.grid))
    both = clip.before.valid & after.valid
    assert tracks.unchanged[both].mean() > 0.98

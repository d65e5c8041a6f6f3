"""Motion segmentation: one number per rigid motion of a clip."""

import numpy as np
import pytest

from mstfilter.scene import Clip, Hypothesis, VoxelGrid, project, scene_cache
from mstfilter.tracking.flow import DenseFlow
from mstfilter.tracking.motion_segmentation import MotionSegmentation, followed_points
from tests.tracking.scenes import Box, Scene, at, standard


@pytest.fixture(scope="module")
def pushed():
    """Six textured solids: 1, 2 and 5 are moved apart, 3, 4 and 6 rest."""
    scene = standard(8)
    clip = scene.clip(0)
    truth = Hypothesis.from_labels(scene.labels(scene.poses[-1]), scene.grid)
    return clip, project(truth, clip.after.camera)


def test_every_motion_has_a_different_number(pushed):
    clip, objects = pushed
    motions = MotionSegmentation().labels(clip)
    main = {}
    for k in range(1, 7):
        seen = motions[(objects == k) & (motions >= 0)]
        numbers, counts = np.unique(seen, return_counts=True)
        assert len(seen) >= 40
        assert counts.max() > 0.9 * len(seen)  # an object is not broken
        main[k] = int(numbers[counts.argmax()])
    assert main[3] == main[4] == main[6] == 0
    assert len({main[1], main[2], main[5], 0}) == 4


def test_nothing_moved_or_a_single_frame(pushed):
    clip, _ = pushed
    still = Clip((clip.before,) * 3, clip.grid, 1)
    motions = MotionSegmentation().labels(still)
    assert motions.max() == 0
    assert MotionSegmentation().labels(Clip((clip.before,), clip.grid, 0)) is None


@pytest.mark.parametrize("change", ["frames", "grid"])
def test_cached_motions_belong_to_one_clip(pushed, change):
    """Clips with equal first and last frames have different keys if other frames or the workspace differ."""
    clip, _ = pushed
    frames, grid = list(clip.frames), clip.grid
    if change == "frames":
        frames[1:-1] = [clip.after] * (len(frames) - 2)
    else:
        grid = VoxelGrid(grid.origin, grid.voxel_size, (grid.shape[0] // 2, *grid.shape[1:]))
    other = Clip(frames, grid, clip.index)

    def found(c):
        return MotionSegmentation().labels(c), followed_points(c, DenseFlow()).p

    scene_cache.clear()
    alone = found(other)
    scene_cache.clear()
    first, second = found(clip), found(other)
    np.testing.assert_array_equal(alone[0], second[0])
    np.testing.assert_array_equal(alone[1], second[1])
    assert len(first[1]) != len(second[1]) and (first[0] != second[0]).any()


def test_the_limit_of_misfit_decides(pushed):
    """A limit larger than any motion joins everything that touches."""
    clip, objects = pushed
    fine = MotionSegmentation().labels(clip)
    coarse = MotionSegmentation(misfit=1.0, reach=1.0).labels(clip)
    inside = (objects > 0) & (fine >= 0) & (coarse >= 0)
    assert len(np.unique(coarse[inside])) < len(np.unique(fine[inside]))


def test_an_object_that_turned_is_not_split():
    """A long bar turns about its end: points near the axis also agree with rest."""
    length, turns = 0.24, np.linspace(0, 24, 5)
    poses = []
    for degrees in turns:
        pose = at(-0.1, 0.0, 0.03, degrees)
        pose[:3, 3] += pose[:3, 0] * length / 2
        poses.append([pose])
    clip = Scene([Box((length, 0.06, 0.06))], poses).clip(0)
    points = followed_points(clip, MotionSegmentation().flow)
    went = np.linalg.norm(points.q - points.p, axis=1)
    bar = points.q[:, 2] > 0.02
    careful, careless = (MotionSegmentation(rival=r).labels(clip)[points.row, points.column] for r in (0.006, 0.0))
    assert ((careful[bar] > 0) & (went[bar] > 0.03)).sum() > 40
    assert (careless[bar] == 0).sum() > 5
    assert (careful[bar] == 0).sum() < 0.2 * (careless[bar] == 0).sum()  # a few readings are off

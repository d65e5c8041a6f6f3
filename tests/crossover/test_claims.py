"""Claims: voxels at the surface belong to the sample; wrong predictions add no hidden voxels."""

import numpy as np
import pytest

from mstfilter.crossover import Claims, Crossover, CrossoverUpdate, ModeFilter
from mstfilter.errors import InputError
from mstfilter.scene import Clip, Frame, FreeSpace, Hypothesis
from mstfilter.smc import Population
from tests.scene.scenes import CAMERA, GRID, table_scene

MST = Claims(surface="sample", max_cleared=0.03)


@pytest.fixture(scope="module")
def scene():
    noise = np.random.default_rng(0)
    rgb, depth, truth = table_scene(0, noise)
    frame = Frame(rgb, depth, CAMERA)
    return Clip((frame, frame), GRID, 1), truth


def children(clip, sample, prediction, claims, seeds=range(4), **fields):
    predicted = Population((Hypothesis.from_labels(prediction, GRID),), np.zeros(1), {"previous": np.zeros(1, int)})
    proposed = Population((Hypothesis.from_labels(sample, GRID, 1),), np.zeros(1), {"proposed": np.zeros(1, int)})
    update = CrossoverUpdate(eta=1, claims=claims, **fields)
    return [update.update(np.random.default_rng(k), predicted, proposed, clip).particles[0].labels for k in seeds]


def test_the_prediction_is_limited_by_surface_and_doubtful_voxels(scene):
    clip, truth = scene
    empty = np.zeros_like(truth)
    exposed = Claims(surface="sample").exposed(clip)
    sample, prediction = Hypothesis.from_labels(truth, GRID), Hypothesis.from_labels((truth == 0) * 7, GRID)
    left = MST.limited(sample, prediction, exposed, None).labels
    assert not (left[exposed] > 0).any()  # nothing of the sample there, so nothing of the prediction either
    np.testing.assert_array_equal(left[~exposed], prediction.labels[~exposed])
    both = MST.limited(sample, prediction, exposed, np.ones(truth.shape, bool)).labels
    assert not both.any()
    nothing = Hypothesis.from_labels(empty, GRID)
    assert MST.limited(nothing, prediction, exposed, None) is prediction
    assert Claims().exposed(clip) is None


def test_objects_that_free_space_cleared_too_much_of_are_doubtful(scene):
    clip, truth = scene
    lifted = np.roll(truth, 8, axis=2)  # into the air: free space clears it
    right = Hypothesis.from_labels(truth, GRID)
    wrong = Hypothesis.from_labels(np.where(lifted == 1, 1, np.where(truth == 2, 2, 0)), GRID)
    for hypothesis, labels in ((right, set()), (wrong, {1})):
        refined, _ = FreeSpace().project(hypothesis, clip.after)
        doubtful = MST.doubtful(hypothesis, refined)
        found = set() if doubtful is None else set(np.unique(refined.labels[doubtful]).tolist())
        assert found == labels
    assert Claims().doubtful(wrong, FreeSpace().project(wrong, clip.after)[0]) is None


def test_a_perfect_prediction_and_measurement_leave_the_scene_as_it_is(scene):
    """A book of 2 cm and a thin rod too, for every merge and every order of painting."""
    clip, truth = scene
    for claims in (MST, Claims("sample", 0.0), Claims()):
        for merge in ("covered", "never", "always", "share"):
            crossover = Crossover(merge=merge, mode_filter=ModeFilter(scope="disputed"))
            for labels in children(clip, truth, truth, claims, crossover=crossover):
                assert ((labels > 0) == (truth > 0)).all()
                for k in np.unique(truth)[1:]:
                    assert len(np.unique(labels[truth == k])) == 1


@pytest.mark.parametrize("fields", [{"surface": "none"}, {"max_cleared": 1.5}, {"max_cleared": -1}])
def test_wrong_fields_are_named(fields):
    with pytest.raises(InputError, match=next(iter(fields))):
        Claims(**fields)

"""Partition of the readings and completion from all views: what is carried on, what is not, and the weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError
from mstfilter.mst.completion import Extrude, SurfaceOnly
from mstfilter.mst.partition import PairEvidence, PartitionUpdate, Readings
from mstfilter.mst.partition.update import _segments
from mstfilter.mst.segmentation import hypothesis_of
from mstfilter.scene import Clip, Evidence, Hypothesis, Occupancy, surface_agreement
from mstfilter.smc import Population
from tests.mst.completion.test_completion import masks_of
from tests.mst.segmentation.scenes import GRID, TOUCHING, TWO, boxes, frame_of

#: A tall box in front of where a small one stands, as seen from the camera.
ALONE = boxes(((22, 30, 0), (28, 36, 5)))


def clip_of(scene, index=0):
    return Clip([frame_of(scene, noise=0)], GRID, index)


def sample_of(clip, masks, completer=None):
    completions = (completer or SurfaceOnly()).complete(np.random.default_rng(0), clip.after, masks, GRID)
    return hypothesis_of(completions, GRID, clip.index)


def step(update, clip, sample, state=None, seed=0):
    proposed = Population((sample,))
    predicted = None if state is None else Population((state,))
    return update.update(np.random.default_rng(seed), predicted, proposed, clip)


def test_a_first_frame_is_its_samples_completed():
    clip = clip_of(TWO)
    found = step(PartitionUpdate(), clip, sample_of(clip, masks_of(TWO, clip.after)))
    for one in found.particles:
        assert [record.birth for record in one.objects] == [0, 0]
        assert [len(record.views) for record in one.objects] == [1, 1]
        for k in (1, 2):
            same, either = (one.labels == k) & (k == TWO), (one.labels == k) | (k == TWO)
            assert same.sum() > 0.6 * either.sum()


def test_guesses_are_not_added_up():
    """The same view again and again changes nothing: volumes, identities and the number of views stay bounded."""
    update, clip = PartitionUpdate(n_views=3), clip_of(TWO)
    sample = sample_of(clip, masks_of(TWO, clip.after))
    state = step(update, clip, sample).particles[0]
    first, ids = state.labels, [record.id for record in state.objects]
    for index in range(1, 6):
        found = step(update, clip_of(TWO, index), sample, state, seed=index)
        for one in found.particles:
            np.testing.assert_array_equal(one.labels, first)
            assert [record.id for record in one.objects] == ids
        state = found.particles[-1]
        assert [len(record.views) for record in state.objects] == [min(index + 1, 3)] * 2


def test_the_pose_of_an_object_stays_when_its_shape_is_completed_again():
    update, clip = PartitionUpdate(), clip_of(TWO)
    sample = sample_of(clip, masks_of(TWO, clip.after))
    state = step(update, clip, sample).particles[0]
    T = RigidTransform.from_translation([0.1, 0, 0])  # since the object was first proposed
    before = replace(state, objects=tuple(replace(record, pose=T) for record in state.objects))
    for one in step(update, clip_of(TWO, 1), sample, before).particles:
        assert [one.pose(record.label).translation.tolist() for record in one.objects] == [[0.1, 0, 0]] * 2


def test_hidden_objects_stay_until_the_frame_sees_through_them():
    update, clip = PartitionUpdate(mend=False), clip_of(TWO)  # `mend` would see the object by its colour
    state = step(update, clip, sample_of(clip, masks_of(TWO, clip.after))).particles[0]
    identity = state.record(2).id
    # In front of the second object the frame has no readings: nothing says that it is gone.
    blind = frame_of(TWO, noise=0)
    depth = np.where(masks_of(TWO, blind)[1], np.nan, blind.depth)
    hidden = Clip([type(blind)(blind.rgb, depth, blind.camera)], GRID, 1)
    mask = masks_of(TWO, blind)[:1]
    for one in step(update, hidden, sample_of(hidden, mask), state).particles:
        kept = [record for record in one.objects if record.id == identity]
        assert len(kept) == 1 and len(kept[0].views) == 1
        assert (one.mask(kept[0].label) & (TWO == 2)).sum() > 0.5 * (TWO == 2).sum()
    only_first = np.where(TWO == 1, 1, 0).astype(np.uint16)
    gone = clip_of(only_first, 1)
    for one in step(update, gone, sample_of(gone, masks_of(only_first, gone.after)), state).particles:
        assert [record.id for record in one.objects] == [state.record(1).id]


def test_hidden_objects_of_a_prediction_that_the_frame_refutes_stay_less_often():
    update = PartitionUpdate(completer=SurfaceOnly(), mend=False)
    labels = TWO.astype(np.uint16)
    in_the_air = np.zeros(labels.shape, bool)
    in_the_air[4:18, 4:19, -4:] = True
    labels[in_the_air & (labels == 0)] = 3
    past = Hypothesis.from_labels(labels, GRID)
    blind = frame_of(TWO, noise=0)
    depth = np.where(masks_of(TWO, blind)[1], np.nan, blind.depth)
    hidden = Clip([type(blind)(blind.rgb, depth, blind.camera)], GRID, 1)
    left, _ = update.free_space.project(past, hidden.after)
    of_objects, of_scene = surface_agreement(past, hidden.after)
    own = (left.labels == 2).sum() / (labels == 2).sum()
    expected = (of_scene * own) ** update.quality_exponent
    assert of_objects[1] > 0.9 and np.isnan(of_objects[2]) and of_objects[3] < 0.1 and own > 0.9 and expected > 0.02
    found = step(update, hidden, sample_of(hidden, masks_of(TWO, blind)[:1]), past)
    stays = [past.record(2).id in {record.id for record in one.objects} for one in found.particles]
    assert found.weights @ stays == pytest.approx(expected, abs=1e-6)


def test_objects_without_views_keep_their_voxels_where_the_frame_does_not_see_through():
    """Objects with their probabilities."""
    update, clip = PartitionUpdate(n_views=0, mend=False), clip_of(TWO)
    state = step(update, clip, sample_of(clip, masks_of(TWO, clip.after))).particles[0]
    assert not any(record.views for record in state.objects)
    p = np.where(state.labels > 0, 0.8, 0).astype(np.float16)
    state = replace(state, occupancy=Occupancy(state.labels, p))
    blind = frame_of(TWO, noise=0)
    depth = np.where(masks_of(TWO, blind)[1], np.nan, blind.depth)
    hidden = Clip([type(blind)(blind.rgb, depth, blind.camera)], GRID, 1)
    for one in step(update, hidden, sample_of(hidden, masks_of(TWO, blind)[:1]), state).particles:
        record = next(record for record in one.objects if record.id == state.record(2).id)
        kept = one.mask(record.label)
        assert (kept <= state.mask(2)).all() and kept.sum() > 0.8 * state.mask(2).sum()
        np.testing.assert_allclose(one.shares.probability[kept], 0.8, atol=2e-3)


def test_objects_without_views_keep_their_labels_also_where_they_are_unlikely():
    update, clip = PartitionUpdate(n_views=0), clip_of(TWO)
    labels = np.where(TWO == 2, 1, 0).astype(np.uint16)
    state = Hypothesis.from_labels(labels, GRID)
    state = replace(state, occupancy=Occupancy(labels, np.where(labels > 0, 0.45, 0).astype(np.float16)))
    blind = Clip(
        [type(clip.after)(clip.after.rgb, np.full_like(clip.after.depth, np.nan), clip.after.camera)], GRID, 1
    )
    found = step(update, blind, Hypothesis.from_labels(0 * labels, GRID), state).particles
    assert all((one.labels > 0).sum() == (labels > 0).sum() for one in found)


#: Log odds that leave no doubt, in favour of the image or of the prediction.
IMAGE = PairEvidence(constant=0.0, image=100.0, prediction=0.0, prediction_constant=0.0)
PREDICTION = PairEvidence(constant=0.0, image=0.0, prediction=100.0, prediction_constant=0.0)


def test_objects_continue_what_lies_in_them():
    """A sample that sees two predicted objects as one, and one that cuts an object in two."""
    clip, later = clip_of(TOUCHING), clip_of(TOUCHING, 1)
    masks = masks_of(TOUCHING, clip.after)
    state = step(PartitionUpdate(mend=False), clip, sample_of(clip, masks)).particles[0]
    merged = sample_of(later, [masks[0] | masks[1]])
    (one,) = step(PartitionUpdate(pairs=IMAGE, mend=False), later, merged, state).particles
    assert one.n_objects == 1 and len(one.objects[0].views) == 3  # the views of both
    (one,) = step(PartitionUpdate(pairs=PREDICTION, mend=False), later, merged, state).particles
    assert [record.id for record in one.objects] == [record.id for record in state.objects]
    half = masks[0] & (np.arange(masks[0].shape[1]) < np.nonzero(masks[0])[1].mean())
    cut = sample_of(later, [half, masks[0] & ~half, masks[1]])
    (one,) = step(PartitionUpdate(pairs=IMAGE, mend=False), later, cut, state).particles
    assert one.n_objects == 3 and state.record(2).id in {record.id for record in one.objects}
    (one,) = step(PartitionUpdate(pairs=PREDICTION, mend=False), later, cut, state).particles
    assert [record.id for record in one.objects] == [record.id for record in state.objects]


def test_a_past_that_the_frame_sees_through_says_nothing_about_pairs():
    """Two objects touch. A prediction that joins them decides; if much else is seen through, the image does."""
    clip, later = clip_of(TOUCHING), clip_of(TOUCHING, 1)
    masks = masks_of(TOUCHING, clip.after)
    state = step(PartitionUpdate(), clip, sample_of(clip, [masks[0] | masks[1]])).particles[0]
    pairs = PairEvidence(
        image_only_constant=0.0, image_only=1.0, constant=0.0, image=0.0, prediction=100.0, prediction_constant=0.0
    )
    proposed = sample_of(later, masks)

    def objects(past, **changes):
        update = PartitionUpdate(pairs=pairs, completer=SurfaceOnly(), **changes)
        return step(update, later, proposed, past).best.n_objects

    assert objects(state) == 1
    labels = state.labels.copy()
    labels[:, :, -8:] = 2  # a slab in the air
    wrong = Hypothesis.from_labels(labels, clip.grid)
    assert objects(wrong) == 2
    assert objects(wrong, quality_exponent=0.0) == 1


def test_a_merged_object_keeps_the_latest_views_of_both():
    first, second = ("a0", "a1", "a2", "a3"), ("b0", "b1", "b2")
    assert PartitionUpdate()._latest(first, second) == ("b1", "a2", "b2", "a3")
    assert PartitionUpdate()._latest(first) == first
    assert PartitionUpdate(n_views=3)._latest((*first, "now")) == ("a2", "a3", "now")
    assert PartitionUpdate(n_views=0)._latest(first, second) == ()


def test_partitions_by_pairs_follow_image_and_past():
    """Two objects that half of the samples join: the past decides, in the proportion of the weights by hand."""
    clip = clip_of(TOUCHING)
    masks = masks_of(TOUCHING, clip.after)
    apart, merged = sample_of(clip, masks), sample_of(clip, [masks[0] | masks[1]])
    state = step(PartitionUpdate(mend=False), clip, apart).particles[0]
    pairs = PairEvidence(constant=0.0, image=1.0, prediction=0.3, prediction_constant=0.0)
    update = PartitionUpdate(pairs=pairs, completer=SurfaceOnly(), mend=False)
    proposed = Population((apart, merged))
    later = clip_of(TOUCHING, 1)
    found = update.update(np.random.default_rng(0), Population((state,)), proposed, later)
    share = found.weights @ [one.n_objects == 2 for one in found.particles]
    odds = 0.3 * np.log(1.02 / 0.02)  # the image says 1 : 1, the prediction that they are two
    assert share == pytest.approx(1 / (1 + np.exp(-odds)), abs=2e-3)
    first = update.update(np.random.default_rng(0), None, proposed, clip)  # candidates are the samples
    assert [one.n_objects for one in first.particles] == [2, 1]


def test_labels_of_readings_by_brute_force():
    rng = np.random.default_rng(0)
    readings = Readings(np.arange(300), rng.integers(10, 30, (300, 3)), (20, 15))
    labels = np.zeros(GRID.shape, np.uint16)
    for k in range(1, 40):
        labels[tuple(rng.integers(10, 30, 3))] = k
    occupied = np.argwhere(labels)
    found = readings.labels(labels, 2.5)
    for voxel, label in zip(readings.voxels, found, strict=True):
        distance = np.linalg.norm(occupied - voxel, axis=1)
        nearest = {int(labels[tuple(v)]) for v in occupied[distance == distance.min()]}
        assert label in nearest if distance.min() <= 2.5 else label == 0


@pytest.mark.parametrize(
    ("labelled", "expected"), [((10, 10, 0), [1, 0, 1, 0, 0, 0]), ((20, 20, 0), [0, 0, 0, 0, 1, 0])]
)
def test_readings_of_the_table_belong_to_an_object_only_if_its_voxel_has_no_others(labelled, expected):
    """A voxel with readings of the table and of an object, beside a voxel with readings of the table alone."""
    labels = np.zeros(GRID.shape, np.uint16)
    labels[labelled] = 7
    voxels = np.array([(10, 10, 0), (10, 10, 0), (11, 10, 0), (11, 10, 0), (20, 20, 0), (21, 20, 0)])
    raised = np.array([True, False, True, False, False, False])
    readings = Readings(np.arange(6), voxels, (2, 3))
    found = _segments(Population((Hypothesis.from_labels(labels, GRID),)), readings, raised)[0]
    np.testing.assert_array_equal(found > 0, expected)


def test_candidates_have_the_weights_of_their_predictions():
    clip = clip_of(ALONE)
    sample = sample_of(clip, masks_of(ALONE, clip.after), Extrude())
    w = np.array([0.7, 0.2, 0.1])
    proposed = Population((sample,) * 3, np.zeros(3), {"proposed": np.arange(3)})
    predicted = Population((sample,) * 3, np.log(w), {"previous": np.arange(3)})
    update = PartitionUpdate(completer=SurfaceOnly())
    found = update.update(np.random.default_rng(0), predicted, proposed, clip)
    quality = PartitionUpdate().free_space.refine((sample,), clip)[1][0]
    assert quality == 1.0  # so the predictions keep their weights
    np.testing.assert_allclose(np.bincount(found.parents["previous"], found.weights), w)
    assert found.notes["discarded_mass"] == 0 and found.particles.n_built == 0
    few = replace(update, n_candidates=1).update(np.random.default_rng(0), predicted, proposed, clip)
    assert len(few) == 1 and few.notes["discarded_mass"] == pytest.approx(0.3)


def test_equal_samples_of_the_first_frame_are_one_candidate():
    clip = clip_of(TOUCHING)
    masks = masks_of(TOUCHING, clip.after)
    apart, merged = sample_of(clip, masks), sample_of(clip, [masks[0] | masks[1]])
    proposed = Population((apart, merged, apart), np.log([1.0, 2.0, 3.0]))
    found = PartitionUpdate(completer=SurfaceOnly()).update(np.random.default_rng(0), None, proposed, clip)
    assert [one.n_objects for one in found.particles] == [2, 1]
    np.testing.assert_allclose(found.weights, [4 / 6, 2 / 6])


def test_evidence_weights_built_candidates():
    """Evidence multiplies the weights of the most probable candidates; the others are not built."""
    clip, later = clip_of(TOUCHING), clip_of(TOUCHING, 1)
    masks = masks_of(TOUCHING, clip.after)
    samples = Population((sample_of(clip, masks), sample_of(clip, [masks[0] | masks[1]])))
    state = step(PartitionUpdate(), clip, samples.particles[0]).particles[0]
    update = PartitionUpdate(completer=SurfaceOnly())

    def weights(update):
        found = update.update(np.random.default_rng(0), Population((state,)), samples, later)
        return {one.n_objects: w for one, w in zip(found.particles, found.weights, strict=True)}

    before, after = weights(update), weights(replace(update, evidence=(FewObjects(),)))
    odds = (after[1] / after[2]) / (before[1] / before[2])
    assert odds == pytest.approx(np.e)
    one = replace(update, evidence=(FewObjects(),), n_scored=1)
    assert weights(one).keys() == {max(before, key=before.get)}
    found = one.update(np.random.default_rng(0), Population((state,)), samples, later)
    assert found.notes["discarded_mass"] == pytest.approx(min(before.values()), abs=1e-4)


class FewObjects(Evidence):
    """Favours hypotheses of few objects."""

    def log_score(self, hypotheses, clip):
        return -np.array([one.n_objects for one in hypotheses], float)


def test_hypotheses_of_another_grid_are_refused():
    clip = clip_of(ALONE)
    other = Hypothesis(np.zeros((2, 2, 2), np.uint16), type(GRID)((0, 0, 0), 0.01, (2, 2, 2)))
    with pytest.raises(InputError, match="grid of proposed hypothesis 0"):
        step(PartitionUpdate(), clip, other)

"""Objects that move apart in a clip are split, and are not merged again."""

from dataclasses import replace

import numpy as np
import pytest

from mstfilter.crossover import Crossover, CrossoverUpdate
from mstfilter.partition import NoDivision, PartRule, RigidMotions
from mstfilter.partition.division import split_by_motion, split_like
from mstfilter.scene import Hypothesis, ObjectRecord, VoxelGrid, decode_hypotheses, encode_hypotheses
from mstfilter.scoring import weighted_coverage
from mstfilter.smc import Population
from tests.tracking.scenes import standard

GRID = VoxelGrid(np.zeros(3), 0.01, (20, 10, 5))


@pytest.fixture(scope="module")
def pushed():
    """Six textured solids: 1, 2 and 5 are moved apart, 3, 4 and 6 rest. 4 and 5 look alike."""
    scene = standard(8)
    return scene.clip(0), scene.labels(scene.poses[-1])


def merged(truth, *pairs):
    for keep, gone in pairs:
        truth = np.where(truth == gone, keep, truth)
    return truth.astype(np.uint16)


def record_at(hypothesis, where):
    return hypothesis.record(int(np.bincount(hypothesis.labels[where])[1:].argmax()) + 1)


def test_objects_that_moved_apart_are_split_and_recorded(pushed):
    clip, truth = pushed
    motions = RigidMotions().divide(clip)
    one = Hypothesis.from_labels(merged(truth, (4, 5)), clip.grid)
    two = split_by_motion(one, motions, clip)
    assert two.n_objects == one.n_objects + 1
    assert weighted_coverage(two.labels, truth) > 0.97 > weighted_coverage(one.labels, truth)
    a, b = record_at(two, truth == 4), record_at(two, truth == 5)
    assert b.id in a.apart and a.id in b.apart
    assert len({r.id for r in two.objects}) == two.n_objects
    resting = record_at(two, truth == 3)
    assert a.id not in resting.apart  # both rest: nothing is known
    assert b.id in resting.apart  # 5 moved, 3 did not


def test_objects_of_one_motion_are_not_split(pushed):
    clip, truth = pushed
    motions = RigidMotions().divide(clip)
    right = split_by_motion(Hypothesis.from_labels(truth, clip.grid), motions, clip)
    np.testing.assert_array_equal(right.labels, truth)
    resting = Hypothesis.from_labels(merged(truth, (3, 4)), clip.grid)
    np.testing.assert_array_equal(split_by_motion(resting, motions, clip).labels, resting.labels)
    nothing = Hypothesis.from_labels(np.zeros_like(truth), clip.grid)
    assert split_by_motion(nothing, motions, clip) is nothing


def test_small_parts_are_not_split(pushed):
    clip, truth = pushed
    one = Hypothesis.from_labels(merged(truth, (4, 5)), clip.grid)
    kept = split_by_motion(one, RigidMotions().divide(clip), clip, PartRule(min_pixels=10**6))
    np.testing.assert_array_equal(kept.labels, one.labels)


def bars(*labels):
    """Bars of five voxels' width along x: labels of each."""
    grid = np.zeros(GRID.shape, np.uint16)
    for k, label in enumerate(labels):
        grid[5 * k : 5 * k + 5, 2:8, :3] = label
    return grid


def moved_apart(labels, *pairs):
    """A predicted hypothesis in which pairs of labels have moved apart."""
    h = Hypothesis.from_labels(labels, GRID)
    ids = {r.label: r.id for r in h.objects}
    apart = {r.label: set() for r in h.objects}
    for a, b in pairs:
        apart[a].add(ids[b])
        apart[b].add(ids[a])
    return Hypothesis(h.labels, GRID, tuple(replace(r, apart=frozenset(apart[r.label])) for r in h.objects))


def test_a_sample_is_split_like_the_prediction():
    sample = Hypothesis.from_labels(bars(1, 1, 2, 2), GRID, birth=1)
    parted = split_like(sample, moved_apart(bars(1, 2, 3, 4), (1, 2)))
    assert parted.n_objects == 3
    assert weighted_coverage(parted.labels, bars(1, 2, 3, 3)) == 1.0
    assert split_like(sample, moved_apart(bars(1, 2, 3, 4))) is sample
    three = split_like(
        Hypothesis.from_labels(bars(1, 1, 1, 1), GRID, 1), moved_apart(bars(1, 2, 3, 0), (1, 2), (2, 3))
    )
    assert weighted_coverage(three.labels, bars(1, 2, 3, 3)) == 1.0  # the rest goes to the nearest


@pytest.mark.parametrize("merge", ["always", "share", "match", "never"])
def test_crossover_never_merges_objects_that_moved_apart(merge):
    predicted = moved_apart(bars(1, 2, 3, 4), (1, 2), (3, 4))
    for seed in range(50):
        rng = np.random.default_rng(seed)
        labels = rng.integers(0, 3, 4)
        child = Crossover(merge=merge).cross(rng, Hypothesis.from_labels(bars(*labels), GRID, 1), predicted)
        for a, b in (((2, 4, 1), (7, 4, 1)), ((12, 4, 1), (17, 4, 1))):
            assert child.labels[a] != child.labels[b]
            one, other = child.record(int(child.labels[a])), child.record(int(child.labels[b]))
            assert other.id in one.apart and one.id in other.apart
        assert len({r.id for r in child.objects}) == child.n_objects


def test_without_the_record_the_same_objects_are_merged():
    """The test above can fail: without records of motion the crossover merges the objects."""
    child = Crossover(merge="always").cross(
        np.random.default_rng(0),
        Hypothesis.from_labels(bars(1, 1, 2, 2), GRID, 1),
        Hypothesis.from_labels(bars(1, 2, 3, 4), GRID),
    )
    assert child.labels[2, 4, 1] == child.labels[7, 4, 1]


def test_the_record_is_stored_in_files():
    h = moved_apart(bars(1, 2, 3, 4), (1, 2), (1, 4))
    (back,) = decode_hypotheses(encode_hypotheses([h]))
    assert [r.apart for r in back.objects] == [r.apart for r in h.objects]
    assert ObjectRecord.born(1, 0).apart == frozenset()


def test_the_update_splits_twins_that_both_parents_merge(pushed):
    clip, truth = pushed
    one = Hypothesis.from_labels(merged(truth, (4, 5)), clip.grid)
    predicted = Population((one,), np.zeros(1), {"previous": np.zeros(1, int)})
    proposed = Population(
        (Hypothesis.from_labels(one.labels, clip.grid, 1),), np.zeros(1), {"proposed": np.zeros(1, int)}
    )
    joined = CrossoverUpdate(eta=1).update(np.random.default_rng(0), predicted, proposed, clip).particles[0]
    assert joined.n_objects == one.n_objects
    for seed in range(5):
        update = CrossoverUpdate(eta=1, division=RigidMotions())
        child = update.update(np.random.default_rng(seed), predicted, proposed, clip).particles[0]
        assert child.n_objects == one.n_objects + 1
        assert weighted_coverage(child.labels, truth) > 0.95


def test_no_division_returns_none(pushed):
    assert NoDivision().divide(pushed[0]) is None

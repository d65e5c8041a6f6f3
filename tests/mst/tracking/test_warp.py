from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from mstfilter.mst.tracking.rigid import rigid_transform
from mstfilter.mst.tracking.transition import Warp
from mstfilter.scene import Hypothesis, ObjectView, Occupancy, VoxelGrid
from tests.mst.tracking.scenes import at, iou


def move(warp, hypothesis, motions, residuals=None):
    """Move by motions given as matrices."""
    return warp.move(hypothesis, {label: rigid_transform(T) for label, T in motions.items()}, residuals)


GRID = VoxelGrid((-0.3, -0.3, 0.0), 0.01, (60, 60, 30))


def hypothesis(*boxes):
    labels = np.zeros(GRID.shape, np.uint16)
    for label, (low, high) in enumerate(boxes, start=1):
        labels[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = label
    return Hypothesis.from_labels(labels, GRID)


BOX = ((20, 20, 0), (30, 28, 6))
OTHER = ((40, 20, 0), (48, 28, 6))


def turn(deg, shift=(0, 0, 0), centre=(-0.05, -0.06, 0.0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", deg, degrees=True).as_matrix()
    T[:3, 3] = np.array(shift) + centre - T[:3, :3] @ centre
    return T


@pytest.mark.parametrize("warp", [Warp(), Warp("splat", "label")])
def test_identity_returns_the_same_bytes(warp):
    h = hypothesis(BOX, OTHER)
    moved = move(warp, h, {1: np.eye(4), 2: np.eye(4)})
    assert moved.hypothesis is h
    assert (moved.voxels_left, moved.contested, moved.dropped) == (0, 0, ())


@settings(max_examples=40, deadline=None)
@given(shift=st.tuples(*[st.integers(-8, 8)] * 2, st.integers(0, 8)), method=st.sampled_from(["smooth", "splat"]))
def test_whole_voxel_shift_is_exact(shift, method):
    h = hypothesis(BOX)
    view = ObjectView(np.zeros(3, np.int64), np.ones((1, 1, 1), np.uint8), np.zeros((1, 1, 1), np.int8), "view")
    h = replace(h, objects=(replace(h.record(1), views=(view,)),))
    moved = move(Warp(method), h, {1: at(*np.array(shift) * 0.01)})
    np.testing.assert_array_equal(moved.hypothesis.labels, np.roll(h.labels, shift, (0, 1, 2)))
    np.testing.assert_allclose(moved.hypothesis.record(1).views[0].motion.translation, np.array(shift) * 0.01)


def test_probabilities_move_with_their_object():
    """Exactly by whole voxels; what rests keeps its probabilities, and labels are at least as probable as not."""
    h = hypothesis(BOX, OTHER)
    owner = np.where(h.labels > 0, h.labels, np.where(np.arange(60)[:, None, None] < 35, 1, 2))
    p = np.random.default_rng(0).uniform(0, 0.5, GRID.shape)
    near = np.zeros(GRID.shape, bool)
    near[18:32, 18:30, :8] = near[38:50, 18:30, :8] = True
    p = np.where(h.labels > 0, 1 - p, p) * near
    h = replace(h, occupancy=Occupancy(np.where(near, owner, 0), p))
    shift = (0, 20, 3)
    moved = move(Warp(), h, {1: at(*np.array(shift) * 0.01)}).hypothesis
    own = np.where(h.occupancy.owner == 1, h.occupancy.probability, 0)
    expected = np.where(h.occupancy.owner == 2, h.occupancy.probability, np.roll(own, shift, (0, 1, 2)))
    known = expected > 0.02  # smaller ones are not moved
    np.testing.assert_allclose(moved.occupancy.probability[known], expected[known], atol=2e-3)
    assert (moved.occupancy.probability[~known] <= 0.02).all()
    np.testing.assert_array_equal(moved.occupancy.owner[known & (expected == np.roll(own, shift, (0, 1, 2)))], 1)
    back = move(Warp(), moved, {1: at(*np.array(shift) * -0.01)}).hypothesis
    np.testing.assert_allclose(back.occupancy.probability, h.occupancy.probability, atol=0.021)
    turned = move(Warp(), h, {1: turn(30)}).hypothesis
    found, sure = turned.labels, turned.occupancy
    np.testing.assert_array_equal(sure.owner[found > 0], found[found > 0])
    assert (sure.probability[found > 0] >= 0.5).all() and (sure.probability[found == 0] <= 0.5).all()


@pytest.mark.parametrize("method", ["smooth", "splat"])
def test_objects_that_are_lost_leave_no_probability(method):
    """One that moves out of the grid, and one at rest that loses all its voxels to another."""
    h = hypothesis(BOX, OTHER)
    h = replace(h, occupancy=Occupancy(h.labels, np.where(h.labels > 0, 0.9, 0)))
    gone = move(Warp(method), h, {1: at(0, 2, 0)})
    assert gone.dropped and not (gone.hypothesis.occupancy.owner == 1).any()
    np.testing.assert_array_equal(gone.hypothesis.occupancy.probability > 0, h.labels == 2)
    small = hypothesis(BOX, ((24, 38, 1), (25, 39, 2)))
    small = replace(small, occupancy=Occupancy(small.labels, np.where(small.labels > 0, 0.9, 0)))
    covered = move(Warp(method), small, {1: at(0, 0.14, 0)})
    owners = {int(k) for k in np.unique(covered.hypothesis.occupancy.owner)} - {0}
    assert owners == {record.label for record in covered.hypothesis.objects}


def test_smooth_is_nearer_to_the_true_voxels_than_splat():
    """Turned and shifted boxes against the voxels whose centres they hold."""
    rng, found = np.random.default_rng(0), {"splat": [], "smooth": []}
    centres = GRID.centres()
    for _ in range(12):
        half = np.array([*rng.uniform(0.02, 0.045, 2), rng.uniform(0.02, 0.06)])
        home = np.array([*rng.uniform(-0.05, 0.05, 2), half[2]])
        yaw = turn(rng.uniform(0, 90), centre=(0, 0, 0))[:3, :3]
        T = turn(rng.uniform(-90, 90), (*rng.uniform(-0.06, 0.06, 2), 0), centre=(0, 0, 0))

        def box(x, home=home, yaw=yaw, half=half):
            return (np.abs((x - home) @ yaw) <= half).all(axis=-1)

        source = Hypothesis.from_labels(box(centres).astype(np.uint16), GRID)
        true = box((centres - T[:3, 3]) @ T[:3, :3])
        for method, values in found.items():
            moved = move(Warp(method), source, {1: T}).hypothesis
            values.append(iou(moved.labels == 1, true))
            if method == "smooth":
                assert moved.volumes() == source.volumes()
    assert np.mean(found["smooth"]) > np.mean(found["splat"]) + 0.02, found
    assert np.mean(found["smooth"]) > 0.86


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_many_small_turns_keep_the_volume_and_equal_one_turn(seed):
    rng = np.random.default_rng(seed)
    h = hypothesis(BOX)
    volume = h.volumes()[1]
    total = np.eye(4)
    for _ in range(6):
        T = turn(rng.uniform(-15, 15), (*rng.uniform(-0.01, 0.01, 2), 0))
        total = T @ total
        h = move(Warp(), h, {1: T}).hypothesis
    assert h.volumes()[1] == volume
    once = move(Warp(), hypothesis(BOX), {1: total}).hypothesis
    np.testing.assert_array_equal(h.labels, once.labels)
    np.testing.assert_allclose(h.record(1).motion.as_matrix(), total, atol=1e-9)
    assert h.record(1).source.occupied.sum() == volume


def test_voxels_that_leave_are_counted_and_empty_objects_removed():
    h = hypothesis(BOX, OTHER)
    moved = move(Warp(), h, {2: at(0.15, 0, 0)})
    assert moved.voxels_left == 3 * 8 * 6
    assert moved.hypothesis.volumes() == {1: 480, 2: 5 * 8 * 6}
    gone = move(Warp(), h, {2: at(0.5, 0, 0)})
    assert gone.hypothesis.volumes() == {1: 480}
    assert gone.dropped == (2,) and gone.voxels_left == 384
    # What left comes back with the object.
    back = move(Warp(), moved.hypothesis, {2: at(-0.15, 0, 0)})
    np.testing.assert_array_equal(back.hypothesis.labels, h.labels)


@pytest.mark.parametrize("swap", [False, True])
def test_a_contested_voxel_goes_to_the_object_it_is_deeper_in(swap):
    boxes = (OTHER, BOX) if swap else (BOX, OTHER)
    mover, rest = (2, 1) if swap else (1, 2)
    moved = move(Warp(), hypothesis(*boxes), {mover: at(0.12, 0, 0)}).hypothesis
    assert moved.labels[40, 24, 2] == rest or moved.labels[40, 24, 2] == mover
    line = moved.labels[30:50, 24, 2]
    # The overlap is 40..41; each keeps its own side of it.
    assert line[41 - 30] == rest
    assert line[39 - 30] == mover
    assert moved.volumes()[1] + moved.volumes()[2] == 480 + 384 - 2 * 8 * 6


def test_collisions_do_not_depend_on_label_order():
    def run(order):
        boxes = [((20, 20, 0), (30, 28, 6)), ((31, 20, 0), (39, 28, 6)), ((22, 30, 0), (29, 38, 6))]
        T = [turn(20, (0.03, 0.0, 0)), turn(-10, (-0.02, 0.01, 0)), turn(0, (0, -0.03, 0))]
        h = hypothesis(*[boxes[i] for i in order])
        moved = move(
            Warp(), h, {n + 1: T[i] for n, i in enumerate(order)}, {n + 1: 0.1 * i for n, i in enumerate(order)}
        )
        lookup = np.array([0, *[i + 1 for i in order]])
        return lookup[moved.hypothesis.labels]

    np.testing.assert_array_equal(run([0, 1, 2]), run([2, 1, 0]))
    np.testing.assert_array_equal(run([0, 1, 2]), run([1, 2, 0]))


def test_voxels_lost_in_a_collision_are_restored():
    h = hypothesis(BOX, OTHER)
    bitten = move(Warp(), h, {1: at(0.13, 0, 0)}).hypothesis
    assert bitten.volumes()[2] < 384
    apart = move(Warp(), bitten, {1: at(-0.13, 0, 0), 2: at(0.02, 0, 0)}).hypothesis
    assert apart.volumes() == {1: 480, 2: 384}


def test_authors_collision_rule_gives_the_higher_label_precedence():
    moved = move(Warp("splat", "label"), hypothesis(BOX, OTHER), {1: at(0.14, 0, 0)}).hypothesis
    assert moved.volumes()[2] == 384


def test_single_voxels_survive_any_turn():
    h = hypothesis(((10, 10, 3), (11, 11, 4)))
    for deg in range(0, 90, 7):
        assert move(Warp(), h, {1: turn(deg, (0.0132, 0.0047, 0))}).hypothesis.n_objects == 1

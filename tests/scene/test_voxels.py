"""Grids, hypotheses and their storage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError
from mstfilter.scene.encoding import decode_hypotheses, encode_hypotheses
from mstfilter.scene.occupancy import Occupancy
from mstfilter.scene.voxels import Crop, Hypothesis, ObjectRecord, ObjectView, VoxelGrid

GRID = VoxelGrid((-0.3, -0.3, -0.05), 0.01, (6, 5, 4))


def test_centres_and_indices_are_inverse():
    centres = GRID.centres()
    np.testing.assert_allclose(centres[0, 0, 0], [-0.295, -0.295, -0.045])
    index = GRID.index_of(centres)
    np.testing.assert_array_equal(index[..., 0], np.broadcast_to(np.arange(6)[:, None, None], GRID.shape))
    assert GRID.contains(index).all()
    assert not GRID.contains(GRID.index_of(np.array([-0.31, 0, 0])))
    assert not GRID.contains(GRID.index_of(np.array([np.nan, 0, 0])))
    assert VoxelGrid.from_bounds(GRID.origin, GRID.upper, 0.01) == GRID


@pytest.mark.parametrize(
    "arguments",
    [
        ((0, 0), 0.01, (1, 1, 1)),
        ((0, 0, np.nan), 0.01, (1, 1, 1)),
        ((0, 0, 0), 0, (1, 1, 1)),
        ((0, 0, "low"), 0.01, (1, 1, 1)),
        ((0, 0, 0), 1, (0, 1, 1)),
        ((0, 0, 0), 1, (9.5, 1, 1)),
        ((0, 0, 0), 1, 9),
    ],
)
def test_invalid_grids(arguments):
    with pytest.raises(InputError, match="grid|voxel"):
        VoxelGrid(*arguments)


labels = hnp.arrays(np.uint16, GRID.shape, elements=st.sampled_from([0, 0, 1, 2, 7, 65535]))


@settings(max_examples=60, deadline=None)
@given(labels)
def test_volumes_and_crops(array):
    hypothesis = Hypothesis.from_labels(array, GRID, birth=2)
    assert hypothesis.volumes() == {int(k): int((array == k).sum()) for k in np.unique(array) if k}
    assert len({o.id for o in hypothesis.objects}) == hypothesis.n_objects
    for record in hypothesis.objects:
        crop = Crop.of(array == record.label)
        back = np.zeros(GRID.shape, bool)
        back[crop.box] = crop.occupied
        np.testing.assert_array_equal(back, array == record.label)
        for axis in range(3):  # tight
            assert crop.occupied.any(axis=tuple(a for a in range(3) if a != axis))[[0, -1]].all()


@settings(max_examples=60, deadline=None)
@given(labels, labels)
def test_with_labels_keeps_the_records_of_unchanged_objects(before, after):
    start = Hypothesis.from_labels(before, GRID)
    moved = tuple(
        replace(o, source=Crop.of(before == o.label), motion=RigidTransform.from_translation([1.0, 0, 0]))
        for o in start.objects
    )
    start = Hypothesis(before, GRID, moved)
    after = np.where(np.isin(after, list(start.volumes())), after, 0)
    end = start.with_labels(after)
    assert [o.label for o in end.objects] == [k for k in np.unique(after) if k]
    for record in end.objects:
        same = np.array_equal(before == record.label, after == record.label)
        assert (record.source is not None) == same
        assert record.id == start.record(record.label).id


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((2, 2, 2), np.uint16), "shape"),
        (np.zeros(GRID.shape), "integers"),
        (np.full(GRID.shape, -1), "-1"),
        (np.full(GRID.shape, 70000), "70000"),
    ],
)
def test_invalid_labels(array, message):
    with pytest.raises(InputError, match=message):
        Hypothesis.from_labels(array, GRID)


def test_records_and_occupancy_must_match_the_grid():
    array = np.zeros(GRID.shape, np.uint16)
    array[0, 0, 0] = 3
    two, small = (ObjectRecord(3, 3), ObjectRecord(1, 1)), Occupancy(np.zeros((1, 1, 1)), np.zeros((1, 1, 1)))
    for further, message in (((), "differ"), ((two,), "ascending"), (((), small), "occupancy has shape")):
        with pytest.raises(InputError, match=message):
            Hypothesis(array, GRID, *further)


def sure_of(array, rng):
    """Random probabilities of labels (X, Y, Z), also of voxels that are more probably free."""
    present = [k for k in np.unique(array) if k] or [0]
    owner = np.where(array > 0, array, rng.choice(present, array.shape))
    return Occupancy(owner, rng.uniform(0, 1, array.shape) * (owner > 0))


@settings(max_examples=40, deadline=None)
@given(labels)
def test_occupancy_returns_what_it_was_given(array):
    rng = np.random.default_rng(int(array.sum()))
    owner, p = array, rng.uniform(0, 1, array.shape).astype(np.float16) * (rng.random(array.shape) < 0.3)
    found = Occupancy(owner, p)
    for given_array, stored in ((owner, found.owner), (p, found.probability)):
        assert stored.dtype == given_array.dtype and not stored.flags.writeable
        np.testing.assert_array_equal(stored, given_array)
    other = p.copy()
    other[0, 0, 0] = 0.75 if p[0, 0, 0] < 0.5 else 0.25
    assert found.key == Occupancy(owner.copy(), p.astype(float)).key != Occupancy(owner, other).key


@settings(max_examples=40, deadline=None)
@given(labels, labels)
def test_probabilities_follow_the_labels(before, after):
    rng = np.random.default_rng(0)
    start = replace(Hypothesis.from_labels(before, GRID), occupancy=sure_of(before, rng))
    assert start.key == Hypothesis.from_labels(before, GRID).key  # random streams do not depend on probabilities
    after = np.where(np.isin(after, list(start.volumes())), after, 0).astype(np.uint16)
    end = start.with_labels(after)
    columns = Hypothesis(np.asfortranarray(before), GRID, start.objects, start.occupancy)  # another order in memory
    assert columns.with_labels(np.asfortranarray(after)).occupancy.key == end.occupancy.key
    owner, p = end.occupancy.owner, end.occupancy.probability
    np.testing.assert_array_equal(owner[after > 0], after[after > 0])
    same = before == after
    np.testing.assert_array_equal(p[~same], (after > 0)[~same])
    gone = ~np.isin(start.occupancy.owner, [o.label for o in end.objects])
    np.testing.assert_array_equal(p[same & ~gone], start.occupancy.probability[same & ~gone])
    assert not p[same & gone].any() and not owner[same & gone].any()
    for label in end.volumes():
        crop, dense = end.crop(label), Crop.of(after == label, np.where(owner == label, p, np.float16(0)))
        for found, expected in ((crop.offset, dense.offset), (crop.occupied, dense.occupied)):
            np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(crop.probability, dense.probability)
    cleared = rng.random(GRID.shape) < 0.5
    free = start.without(cleared)
    assert not free.labels[cleared].any() and not free.occupancy.probability[cleared].any()
    assert Hypothesis.from_labels(before, GRID).shares.probability.sum() == (before > 0).sum()


def test_encoding_is_lossless_and_reproducible():
    rng = np.random.default_rng(0)
    hypotheses = []

    def crop_of(mask, n):
        return Crop.of(mask, rng.random(GRID.shape) if n == 2 else None)

    for n in range(4):
        array = rng.choice([0, 0, 0, 1, 4], GRID.shape).astype(np.uint16) * (n > 0)
        h = Hypothesis.from_labels(array, GRID, birth=n)
        records = tuple(
            replace(
                o,
                source=crop_of(array == o.label, n) if o.label == 4 else None,
                motion=RigidTransform.from_exp_coords(rng.normal(size=6)),
                pose=RigidTransform.from_exp_coords(rng.normal(size=6)),
                completion_key="a" * n,
                views=tuple(
                    ObjectView(
                        rng.integers(3, size=3),
                        rng.integers(32, size=(2, 3, k + 1), dtype=np.uint8),
                        rng.integers(-127, 128, size=(2, 3, k + 1), dtype=np.int8),
                        f"view {k}",
                        RigidTransform.from_exp_coords(rng.normal(size=6)),
                        rng.random(5, dtype=np.float32),
                    )
                    for k in range(n - 1)
                ),
            )
            for o in h.objects
        )
        hypotheses.append(Hypothesis(array, GRID, records, sure_of(array, rng) if n > 1 else None))
    arrays = encode_hypotheses(hypotheses)
    loaded = decode_hypotheses(arrays)
    for a, b in zip(hypotheses, loaded, strict=True):
        np.testing.assert_array_equal(a.labels, b.labels)
        assert a.grid == b.grid and a.key == b.key
        assert (a.occupancy is None) == (b.occupancy is None)
        assert a.occupancy is None or (b.occupancy is not None and a.occupancy.key == b.occupancy.key)
        np.testing.assert_array_equal(a.shares.owner, b.shares.owner)
        np.testing.assert_array_equal(a.shares.probability, b.shares.probability)
        for p, q in zip(a.objects, b.objects, strict=True):
            assert (p.label, p.id, p.birth, p.completion_key or None) == (q.label, q.id, q.birth, q.completion_key)
            np.testing.assert_allclose(p.motion.as_matrix(), q.motion.as_matrix(), atol=1e-12)
            np.testing.assert_allclose(p.pose.as_matrix(), q.pose.as_matrix(), atol=1e-12)
            assert (p.source is None) == (q.source is None)
            if p.source is not None:
                np.testing.assert_array_equal(p.source.occupied, q.source.occupied)
                np.testing.assert_array_equal(p.source.offset, q.source.offset)
                np.testing.assert_array_equal(p.source.probability, q.source.probability)
            assert [v.name for v in p.views] == [v.name for v in q.views]
            for v, w in zip(p.views, q.views, strict=True):
                for name in ("offset", "bits", "signed", "colours"):
                    np.testing.assert_array_equal(getattr(v, name), getattr(w, name))
    older = decode_hypotheses({name: a for name, a in arrays.items() if name != "pose"})  # a file of version 0.1
    assert all(o.pose.as_matrix().tolist() == o.motion.as_matrix().tolist() for h in older for o in h.objects)
    again = encode_hypotheses(loaded)
    assert {name: a.tobytes() for name, a in again.items()} == {name: a.tobytes() for name, a in arrays.items()}


def test_a_voxel_size_is_one_number():
    arrays = encode_hypotheses([Hypothesis.from_labels(np.zeros(GRID.shape, np.uint16), GRID)])
    for wrong in ([0.01, 0.01, 0.01], [0.01], np.nan, "x"):
        with pytest.raises(InputError, match="voxel size is "):
            VoxelGrid((0, 0, 0), wrong, (1, 1, 1))
        with pytest.raises(InputError, match="voxel size is .*, expected one number"):
            VoxelGrid.from_bounds((0, 0, 0), (1, 1, 1), wrong)
        with pytest.raises(InputError, match="voxel size is "):
            decode_hypotheses(arrays | {"voxel_size": np.array(wrong)})
    with pytest.raises(InputError, match="grid"):
        VoxelGrid.from_bounds((0, 0, 0), (1e300, 1, 1), 1e-300)


def test_objects_of_one_id_are_refused():
    labels = np.zeros((2, 2, 2), np.uint16)
    labels[0], labels[1] = 1, 2
    grid = VoxelGrid((0, 0, 0), 0.01, (2, 2, 2))
    records = tuple(ObjectRecord(label, 5) for label in (1, 2))
    with pytest.raises(InputError, match=r"labels \[1, 2\] have one id, 5"):
        Hypothesis(labels, grid, records)
    first, second = ObjectRecord.born(1, 3), ObjectRecord.born(1, 3, taken={3 * 65536 + 1, 4 * 65536 + 1})
    assert (first.id, second.id) == (3 * 65536 + 1, 5 * 65536 + 1)
    whole = Hypothesis.from_labels(labels, grid)
    assert [o.id for o in whole.born_at(2).objects] == [2 * 65536 + 1, 2 * 65536 + 2] and whole.born_at(0) is whole


def test_points_mesh_pose_and_box_of_an_object():
    grid = VoxelGrid((-0.2, -0.2, 0.0), 0.01, (60, 60, 20))
    x, y, z = (grid.centre_of(np.argwhere(np.ones(grid.shape, bool)))).reshape(*grid.shape, 3).transpose(3, 0, 1, 2)
    c, s = np.cos(0.4), np.sin(0.4)
    along, across = c * (x - 0.1) + s * (y - 0.05), -s * (x - 0.1) + c * (y - 0.05)
    mask = (np.abs(along) < 0.15) & (np.abs(across) < 0.05) & (z < 0.1)
    hypothesis = Hypothesis.from_labels(3 * mask.astype(np.uint16), grid)
    np.testing.assert_allclose(hypothesis.points(3), np.stack([x, y, z], axis=-1)[mask])
    corners, triangles = hypothesis.mesh(3)
    a, b, d = (corners[triangles[:, k]] for k in range(3))
    assert np.einsum("ij,ij->i", a, np.cross(b, d)).sum() / 6 == pytest.approx(mask.sum() * 1e-6)  # its volume
    T, sides = hypothesis.box(3)
    assert sides == pytest.approx([0.3, 0.1, 0.1], abs=0.02) or sides == pytest.approx([0.1, 0.3, 0.1], abs=0.02)
    np.testing.assert_allclose(T.translation, [0.1, 0.05, 0.05], atol=0.006)
    inside = np.abs(T.inv().apply(corners)) <= sides / 2 + 1e-6
    assert inside.all()
    assert np.allclose(hypothesis.pose(3).as_matrix(), np.eye(4))
    moved = RigidTransform.from_translation([0.02, 0, 0])
    record = hypothesis.record(3).moved(moved, hypothesis.crop(3))
    turned = RigidTransform.from_exp_coords([0, 0, 0.5, 0, 0.1, 0])
    for one, expected in ((record, moved), (record.changed().moved(turned, hypothesis.crop(3)), turned * moved)):
        found = replace(hypothesis, objects=(one,)).pose(3)  # also after a change of the voxels
        np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-12)
    for method in (hypothesis.points, hypothesis.mesh, hypothesis.pose, hypothesis.box):
        with pytest.raises(InputError, match="no object with label 4"):
            method(4)

"""The table of objects: every figure by brute force or by geometry, what nothing may depend on, numbers over time."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from mstfilter import Belief, InputError
from mstfilter.scene import (
    Camera,
    Frame,
    Hypothesis,
    ObjectRecord,
    ObjectView,
    Occupancy,
    VoxelGrid,
    WeightedSegmentations,
    areas_of_colours,
    look_at,
    main_colour,
    project,
)
from mstfilter.smc import Population

GRID = VoxelGrid(np.array([-0.2, -0.2, 0.0]), 0.01, (40, 40, 20))
CAMERA = Camera.from_intrinsics(260, 260, 159.5, 119.5, 320, 240, look_at((0.0, -0.6, 0.5), (0, 0, 0.04)))
LEFT, RIGHT = np.s_[8:16, 15:22, :9], np.s_[16:24, 15:22, :9]  # boxes that touch
FAR, HIDDEN = np.s_[30:36, 15:21, :5], np.s_[16:20, 26:30, :4]


def scene(*boxes, seen=1, hidden=()):
    """A hypothesis with a label for each box; those of `hidden` were last seen at pause 0."""
    labels = np.zeros(GRID.shape, np.uint16)
    for k, box in enumerate(boxes, start=1):
        for part in box if isinstance(box, list) else [box]:
            labels[part] = k
    h = Hypothesis.from_labels(labels, GRID, birth=0)
    records = (replace(r, last_seen=0 if r.label in hidden else seen) for r in h.objects)
    return replace(h, objects=tuple(records))


def belief_of(*weighted, seen=None):
    weights, hypotheses = zip(*weighted, strict=True)
    return Belief(Population(hypotheses, np.log(weights)), seen)


def two_readings(p_one=0.25):
    """One box or two, beside a third one; 0.6 of the weight remembers a hidden object."""
    two = scene(LEFT, RIGHT, FAR, HIDDEN, hidden=(4,))
    one = scene([LEFT, RIGHT], FAR)
    return belief_of((0.6, two), (p_one, one), (0.4 - p_one, scene(LEFT, RIGHT, FAR)))


def at(table, box):
    """The object of the table that has the middle of a box."""
    middle = np.array([(side.start or 0) + side.stop for side in box]) / 2
    [one] = [one for one in table if np.abs(one.centre - GRID.origin - middle * GRID.voxel_size).max() < 1e-9]
    return one


def test_existence_one_several_and_place():
    table = two_readings().objects()
    assert len(table) == 4
    left, right, far, hidden = (at(table, box) for box in (LEFT, RIGHT, FAR, HIDDEN))
    np.testing.assert_allclose([one.existence for one in (left, right, far, hidden)], [1, 1, 1, 0.6], atol=1e-12)
    assert left.one_with == {right.number: pytest.approx(0.25)}
    assert right.one_with == {left.number: pytest.approx(0.25)}
    assert not far.one_with and not hidden.one_with
    assert [one.visible for one in (left, right, far, hidden)] == [True, True, True, False]
    assert hidden.last_seen == 0 and left.last_seen == 1
    np.testing.assert_allclose(sorted(left.sides), [0.07, 0.08, 0.09], atol=1e-6)
    np.testing.assert_allclose(sorted(far.sides), [0.05, 0.06, 0.06], atol=1e-6)
    assert far.volume == pytest.approx(6 * 6 * 5 * 1e-6) and far.volume_range == pytest.approx((180e-6, 180e-6))
    assert far.spread.max() < 1e-9


def test_an_estimate_that_merges_may_be_several():
    only = belief_of((0.7, scene([LEFT, RIGHT], FAR)), (0.3, scene(LEFT, RIGHT, FAR))).objects()
    merged, far = only
    assert merged.several == pytest.approx(0.3) and far.several == 0 and len(only) == 2
    assert merged.existence == pytest.approx(1)


def test_an_object_that_only_others_have():
    """A row of its own, with its weight, unless the estimate has something there."""
    belief = belief_of((0.7, scene(LEFT, FAR)), (0.3, scene(LEFT, FAR, HIDDEN, hidden=(3,))))
    hidden = at(belief.objects(), HIDDEN)
    assert (
        not hidden.in_estimate
        and hidden.hypothesis == 1
        and hidden.existence == pytest.approx(0.3)
        and not hidden.visible
    )
    twice = belief_of(
        (0.6, scene(LEFT)), (0.2, scene(LEFT, HIDDEN, hidden=(2,))), (0.2, scene(FAR, LEFT, HIDDEN, hidden=(3,)))
    ).objects()
    assert len(twice) == 3
    assert at(twice, HIDDEN).existence == pytest.approx(0.4) and at(twice, FAR).existence == pytest.approx(0.2)


def test_a_row_that_has_most_of_two_others():
    """Two small objects of one hypothesis are parts of a large one of another, and the estimate has none of them."""
    small, other = np.s_[16:18, 26:30, :4], np.s_[18:20, 26:30, :4]
    large = np.s_[10:30, 24:36, :8]
    table = belief_of((0.6, scene(LEFT)), (0.25, scene(LEFT, small, other)), (0.15, scene(LEFT, large))).objects()
    assert len(table) == 4
    assert at(table, large).volume == pytest.approx(20 * 12 * 8 * 1e-6)
    assert at(table, small).existence == pytest.approx(0.4, abs=1e-6)  # as a part of the large one


@pytest.mark.parametrize("seed", range(3))
def test_nothing_depends_on_labels_or_order(seed):
    rng = np.random.default_rng(seed)
    belief = two_readings()
    renamed = []
    for w, h in zip(belief.weights, belief.hypotheses, strict=True):
        to = np.concatenate([[0], rng.permutation(np.arange(1, 30))[: h.n_objects]]).astype(np.uint16)
        records = sorted((replace(r, label=int(to[r.label])) for r in h.objects), key=lambda r: r.label)
        renamed.append((w, Hypothesis(to[h.labels], GRID, tuple(records))))
    rng.shuffle(renamed)

    def figures(table):
        names = {one.number: tuple(one.centre.round(9)) for one in table}
        return {
            names[one.number]: (
                round(one.existence, 9), one.visible, one.last_seen, round(one.several, 9), round(one.volume, 12),
                {names[k]: round(p, 9) for k, p in one.one_with.items()},
            )
            for one in table
        }  # fmt: skip

    assert figures(belief_of(*renamed).objects()) == figures(belief.objects())


def test_centre_spread_volume_and_shape_by_enumeration():
    """Over hypotheses and the levels of the occupancy, as the docstring says."""
    labels = np.zeros(GRID.shape, np.uint16)
    labels[LEFT] = 1
    p = np.where(labels > 0, 0.83, 0.0)
    owner = labels.copy()
    owner[8:18, 15:22, :9] = 1
    p[16:18, 15:22, :9] = 0.37
    soft = replace(Hypothesis.from_labels(labels, GRID), occupancy=Occupancy(owner, p))
    shifted = scene(np.s_[9:17, 15:22, :9], seen=0)
    [one] = belief_of((0.7, soft), (0.3, shifted)).objects()
    cases = [(0.7, *((8, 12.0) if u > 0.37 else (10, 13.0))) for u in np.arange(0.05, 0.8, 0.1)]  # none above .83
    cases += [(0.3, 8, 13.0)] * 10
    w = np.array([c[0] for c in cases]) / sum(c[0] for c in cases)
    middle, length = (np.array([c[k] for c in cases]) for k in (2, 1))
    mean = w @ middle
    assert one.centre[0] == pytest.approx(-0.2 + 0.01 * mean)
    assert one.spread[0] == pytest.approx(0.01 * np.sqrt(w @ (middle - mean) ** 2))
    assert one.spread[1:].max() < 1e-9
    assert one.volume == pytest.approx(float(w @ length) * 63e-6)
    assert one.volume_range == pytest.approx((8 * 63e-6, 10 * 63e-6))
    row = one.shape.probability[:, 0, 0].astype(float)
    want = 0.7 * np.array([0.83] * 8 + [0.37] * 2) + 0.3 * np.array([0] + [1] * 8 + [0])
    np.testing.assert_allclose(row, want, atol=2e-3)


def test_visible_objects_are_asked_of_all_segmentations():
    belief = belief_of((1.0, scene(LEFT, RIGHT, FAR, HIDDEN, hidden=(4,))))
    image = project(belief.estimate(), CAMERA)
    assert set(np.unique(image)) >= {0, 1, 2, 3}
    cells = np.where(image == 4, 0, image)
    ways = np.array([[1, 2, 3], [1, 1, 3], [1, 2, 0]])
    seen = WeightedSegmentations(cells, ways, np.array([0.45, 0.35, 0.2]), CAMERA)
    table = replace(belief, seen=seen).objects()
    left, right, far, hidden = table
    assert left.one_with == {right.number: pytest.approx(0.35)}
    assert far.existence == pytest.approx(0.8) and hidden.existence == pytest.approx(1)
    assert replace(belief, seen=seen).kept.objects()[0].one_with == {}


def test_numbers_follow_objects():
    before = belief_of((1.0, scene(LEFT, FAR, HIDDEN))).objects()
    moved = np.s_[28:34, 15:21, :5]
    now = belief_of((1.0, scene(np.s_[1:4, 1:4, :3], HIDDEN, moved, LEFT))).objects(previous=before)
    assert [one.number for one in now] == [4, at(before, HIDDEN).number, at(before, FAR).number, 1]
    # An object that is gone keeps its number for itself.
    h = scene(LEFT, np.s_[1:4, 30:34, :3])
    h = replace(h, objects=(h.objects[0], ObjectRecord.born(2, birth=2)))
    last = belief_of((1.0, h)).objects(previous=now)
    assert [one.number for one in last] == [1, 5] and last.by_number(5) is last[1]
    with pytest.raises(InputError, match=r"(?s)no object has number 3.*numbers: \[1, 5\]"):
        last.by_number(3)


def test_an_object_that_jumps_keeps_its_number_by_descent():
    before = belief_of((1.0, scene(LEFT, FAR))).objects()
    labels = np.zeros(GRID.shape, np.uint16)
    labels[LEFT], labels[25:31, 2:8, :5] = 1, 2
    records = tuple(ObjectRecord(r.label, r.id, last_seen=1) for r in scene(LEFT, FAR).objects)
    now = belief_of((1.0, Hypothesis(labels, GRID, records))).objects(previous=before)
    assert [one.number for one in now] == [1, 2]


def test_an_object_that_jumps_keeps_its_number_by_its_colours_and_size():
    def coloured(h, rows):
        none = np.zeros((0, 0, 0))
        views = [
            ObjectView(np.zeros(3, int), none, none, "", colours=np.pad(np.array(row, np.float32), (0, 141)))
            for row in rows
        ]
        pairs = zip(h.objects, views, strict=True)
        return replace(h, objects=tuple(replace(r, id=50 + seed * 10 + r.label, views=(v,)) for r, v in pairs))

    seed = 0
    before = belief_of((1.0, coloured(scene(LEFT, FAR, HIDDEN), [(4, 0, 1), (0, 5, 0), (1, 1, 0)]))).objects()
    seed = 1
    elsewhere = np.s_[25:31, 2:8, :5], np.s_[2:6, 30:34, :4]
    now = coloured(scene(LEFT, *elsewhere), [(4, 0, 1), (0, 5, 1), (0, 0, 5)])
    assert [one.number for one in belief_of((1.0, now)).objects(previous=before)] == [1, 2, 4]


def test_the_mesh_is_closed_and_has_the_volume():
    [one] = belief_of((1.0, scene(FAR))).objects()
    corners, triangles = one.mesh()
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}
    a, b, c = np.moveaxis(corners[triangles] - corners.mean(axis=0), 1, 0)
    volume = (a * np.cross(b, c)).sum() / 6
    assert 0.8 * one.volume < volume < one.volume  # marching cubes cuts the corners
    middle = GRID.origin + 0.01 * np.array([33, 18, 2.5])
    np.testing.assert_allclose((corners.min(axis=0) + corners.max(axis=0)) / 2, middle, atol=1e-9)
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.06, 0.06, 0.05], atol=1e-9)


def test_pose_colour_rows_and_text():
    h = scene(FAR, HIDDEN, hidden=(2,))
    turned = RigidTransform.from_components([0.1, 0, 0], RigidTransform.identity().rotation)
    h = replace(h, objects=(replace(h.objects[0], pose=turned), h.objects[1]))
    table = belief_of((0.6, h), (0.4, scene(FAR))).objects()
    assert table[0].pose is turned and table[0].colour is None
    rows = json.loads(json.dumps(table.rows()))
    assert rows[0]["moved"] == [0.1, 0, 0] and rows[1]["existence"] == 0.6 and rows[1]["visible"] is False
    text = repr(table)
    assert text.startswith("2 objects, 1 hidden, from 2 hypotheses") and "hidden, last seen at pause 0" in text
    assert not belief_of((1.0, scene())).objects().rows()


def test_main_colour():
    camera = Camera.from_intrinsics(100, 100, 9.5, 9.5, 20, 20, CAMERA.pose)
    rgb = np.full((20, 20, 3), (160, 95, 80), np.uint8)
    rgb[:, 14:] = (70, 100, 150)
    frame = Frame(rgb, np.full((20, 20), 0.8, np.float32), camera)
    found = main_colour(areas_of_colours(frame, np.ones((20, 20), bool)))
    np.testing.assert_allclose(found, (160, 95, 80), atol=12)


def test_the_estimate_uses_all_segmentations_of_the_image():
    """Two equal hypotheses kept, but the weighted segmentations say which reading is the likelier one."""
    one, two = scene([LEFT, RIGHT], FAR), scene(LEFT, RIGHT, FAR)
    belief = belief_of((0.5, one), (0.5, two))
    image = project(two, CAMERA)
    for p, expected in ((0.8, one), (0.2, two)):
        seen = WeightedSegmentations(image, np.array([[1, 1, 2], [1, 2, 3]]), np.array([p, 1 - p]), CAMERA)
        assert replace(belief, seen=seen).estimate() is expected
    # What the image cannot tell is left to the voxels: the weights of the kept hypotheses.
    hidden = scene(LEFT, RIGHT, FAR, HIDDEN, hidden=(4,))
    only = WeightedSegmentations(image, np.array([[1, 2, 3]]), np.ones(1), CAMERA)
    for p, expected in ((0.7, hidden), (0.3, two)):
        image_of_hidden = project(hidden, CAMERA)
        if (image_of_hidden == 4).any():
            only = WeightedSegmentations(image_of_hidden % 4, np.array([[1, 2, 3]]), np.ones(1), CAMERA)
        assert belief_of((p, hidden), (1 - p, two), seen=only).estimate() is expected


def test_labels_of_cells():
    cells = np.array([[1, 1, 1, 2, 2], [1, 3, 3, 2, 0]])
    seen = WeightedSegmentations(cells, np.array([[1, 2, 2]]), np.ones(1), Camera(np.eye(3), 5, 2, CAMERA.pose))
    image = np.array([[7, 7, 0, 4, 0], [7, 0, 5, 0, 9]])
    assert seen.cell_labels(image).tolist() == [7, 0, 0]  # of 3 has half of its pixels no object
    assert seen.refined_with(np.array([[5, 5, 0]])).objects.tolist() == [[0, 1, 1, 0], [0, 2, 3, 3]]


def test_the_camera_of_open_borders():
    belief = two_readings()
    with pytest.raises(InputError, match="does not know the camera"):
        belief.open_borders()
    image = project(scene(LEFT, RIGHT, FAR), CAMERA)
    seen = WeightedSegmentations(image, np.array([[1, 1, 2], [1, 2, 3]]), np.array([0.3, 0.7]), CAMERA)
    [border] = replace(belief, seen=seen).open_borders()
    assert border.one_object == pytest.approx(0.3)


def test_pixels_without_depth_have_the_nearest_segment():
    """As in an image with holes: cells are known at a half of the pixels, and the hypotheses show the others."""
    two = scene(LEFT, RIGHT, FAR)
    image = project(two, CAMERA)
    cells = np.where(np.indices(image.shape).sum(axis=0) % 2 == 0, image, 0)
    cells[image == 3] = 0  # too far from a reading
    seen = WeightedSegmentations(cells, np.array([[1, 1, 2], [1, 2, 3]]), np.array([0.3, 0.7]), CAMERA)
    belief = belief_of((1.0, two), seen=seen)
    found = belief.segmentations.cells
    assert (found[image == 0] == 0).all() and (found[cells > 0] == cells[cells > 0]).all()
    for k in (1, 2):
        own = found[image == k]
        assert (own > 0).all() and (own == k).mean() > 0.9  # others are nearer to the neighbour
    [column, row], [other, below] = np.argwhere(image == 1)[::-1][0][::-1], np.argwhere(image == 2)[0][::-1]
    assert belief.same_object_at_pixels(CAMERA, (column, row), (other, below)) == pytest.approx(0.3)
    nothing = replace(belief, seen=replace(seen, cells=np.zeros_like(cells)))
    assert nothing.segmentations is nothing.seen and Belief(belief.population).segmentations is None


def test_an_object_without_probabilities_at_its_voxels():
    """A probability of 0 where there is a label: the label counts as one half."""
    h = scene(FAR)
    none = replace(h, occupancy=Occupancy(h.labels, np.zeros(h.labels.shape)))
    [one] = belief_of((1.0, none)).objects()
    assert one.volume == pytest.approx(180e-6) and one.shape.occupied.all()
    assert float(one.shape.probability.max()) == 0.5
    assert one.mesh()[1].size

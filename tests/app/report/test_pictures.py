"""Palette, identities and pictures."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from mstfilter.app.report.identities import TRUTH, assign_identities
from mstfilter.app.report.pictures import (
    PALETTE,
    UNASSIGNED_COLOUR,
    close_up,
    colour,
    overlay,
    overlay_layer,
    png_bytes,
    viewpoint,
    voxel_picture,
)
from mstfilter.scene import Hypothesis, project, render
from tests.app.report.runs import CAMERA, GRID, labels_of, make_run


def test_identities_follow_objects_through_relabelling_and_time(tmp_path):
    assert colour(21) == PALETTE[1] and colour(-1) == UNASSIGNED_COLOUR
    run = make_run(tmp_path / "run")
    identities = assign_identities(run)
    for t in range(run.n_pauses):
        truth = identities.of(t, TRUTH)
        assert truth == {1: 0, 2: 1}
        for k, h in enumerate(run.hypotheses(t)):
            own = identities.of(t, k)
            assert set(own) == {o.label for o in h.objects}
            assert len(set(own.values())) == len(own), "two objects of a hypothesis never share an identity"
            if h.n_objects == 2:
                assert own == truth
            assert identities.colours(t, k) == {label: colour(i) for label, i in own.items()}


def test_the_numbers_of_the_pictures_are_those_of_the_tables(tmp_path):
    run = make_run(tmp_path / "run")
    identities, rows = assign_identities(run), list(csv.DictReader((run.path / "objects.csv").open()))
    assert len(rows) >= run.n_pauses
    for t, table in enumerate(run.tables()):
        assert [one.number for one in table] == [int(row["object"]) for row in rows if row["pause"] == str(t)]
        for one in table:
            assert identities.of(t, one.hypothesis)[one.label] == one.number - 1
        given = {one.number - 1 for one in table if one.in_estimate}
        for k in range(len(run.hypotheses(t))):
            own = identities.of(t, k)
            assert len(set(own.values())) == len(own)
            if len(own) == len(given) == 2:
                assert set(own.values()) == given


def test_given_identities_are_kept_and_others_are_new():
    """The same boxes with swapped identities, then a hypothesis of their own and one with a further object."""
    from mstfilter.app.report.identities import _Assignment

    book = _Assignment(9)
    first, swapped = labels_of((1, 1, 3), (12, 12, 3)), labels_of((12, 12, 3), (1, 1, 3))
    more = labels_of((1, 1, 3), (12, 12, 3), (6, 6, 3))
    made = [Hypothesis.from_labels(labels, GRID) for labels in (first, swapped, more)]
    book.add(0, made, [0.2, 0.3, 0.5], None, first, {0: {1: 7, 2: 3}})
    assert book.table[0, 0] == {1: 7, 2: 3} and book.table[0, 1] == {1: 3, 2: 7}
    assert book.table[0, TRUTH] == {1: 7, 2: 3} and book.table[0, 2] == {1: 7, 2: 3, 3: 9}


def test_the_identity_of_a_moved_object_is_inherited_from_its_ancestor(tmp_path):
    from mstfilter.app.report.identities import _Assignment

    book = _Assignment()
    first = Hypothesis.from_labels(labels_of((1, 1, 3), (12, 12, 3)), GRID)
    # Both have moved to where neither was; labels are swapped, ids are kept.
    moved = labels_of((7, 2, 3), (2, 8, 3))
    second = Hypothesis(
        np.array([0, 2, 1], np.uint16)[moved],
        GRID,
        tuple(type(o)(3 - o.label, o.id) for o in reversed(first.objects)),
    )
    book.add(0, (first,), [1.0], None, None)
    book.add(1, (second,), [1.0], [0], None)
    assert book.table[0, 0] == {1: 0, 2: 1}
    assert book.table[1, 0] == {2: 0, 1: 1}


def test_the_larger_part_of_a_split_object_keeps_its_identity():
    """Where the truth is known, also if the smaller part descends from the object."""
    from mstfilter.app.report.identities import _Assignment

    book, truth = _Assignment(), labels_of((1, 1, 3), (12, 12, 3))
    whole = Hypothesis.from_labels(truth, GRID)
    split = truth.copy()
    split[truth == 2] = 3
    split[12, 12:16, :3] = split[13, 12:14, :3] = 2  # 6 of 16 columns of the second object keep its label and id
    parts = (*whole.objects, type(whole.objects[0])(3, 99))
    book.add(0, (whole,), [1.0], None, truth)
    book.add(1, (Hypothesis(split, GRID, parts),), [1.0], [0], truth)
    assert book.table[1, 0][3] == book.table[1, -1][2] == book.table[0, 0][2]
    assert book.table[1, 0][2] not in book.table[0, 0].values()


def test_overlay_touches_objects_only():
    rgb = np.random.default_rng(0).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    labels = np.zeros((20, 30), np.uint16)
    labels[5:15, 5:20] = 3
    labels[5:15, 20:25] = 7
    colours = {3: (255, 0, 0), 7: (0, 0, 255)}
    picture = overlay(rgb, labels, colours, fill=0.5, line=1)
    np.testing.assert_array_equal(picture[labels == 0], rgb[labels == 0])
    np.testing.assert_array_equal(picture[5, 5:20], np.tile([255, 0, 0], (15, 1)))
    np.testing.assert_array_equal(picture[6:14, 20], np.tile([0, 0, 255], (8, 1)))
    red, green, blue = rgb[10, 10].astype(float)
    inside = (0.299 * red + 0.587 * green + 0.114 * blue) * 0.5 + np.array([127.5, 0, 0])
    assert np.abs(picture[10, 10] - inside).max() <= 1
    big = overlay_layer(labels, colours, scale=3)
    assert big.shape == (60, 90, 4)
    assert ((big[..., 3] > 0) == (labels > 0).repeat(3, 0).repeat(3, 1)).all()


def test_contours_do_not_wrap_around_the_image():
    labels = np.zeros((8, 8), np.uint16)
    labels[:, 0] = 1
    alpha = overlay_layer(labels, {}, line=2)[..., 3]
    assert (alpha[:, 0] == 255).all()  # its right neighbour is free
    labels[:] = 1
    assert (overlay_layer(labels, {}, line=2)[..., 3] < 255).all()


def test_viewpoint_holds_every_voxel():
    hypotheses = [Hypothesis.from_labels(labels_of((2, 3, 8), (14, 15, 2)), GRID)]
    for camera in (None, CAMERA):
        view = viewpoint(hypotheses, camera)
        uv, z = view.project(GRID.centre_of(np.argwhere(hypotheses[0].labels > 0)))
        assert (z > 0).all()
        assert (uv > 10).all() and (uv < np.array([view.width, view.height]) - 10).all()
        share = (uv.max(axis=0) - uv.min(axis=0)) / [view.width, view.height]
        assert share.max() > 0.6


def test_voxel_picture_shows_what_the_camera_would_see():
    labels = labels_of((4, 4, 5), (12, 8, 2))
    view = viewpoint([(labels, GRID)], CAMERA, 160, 120)
    picture = voxel_picture(labels, GRID, view, {1: (200, 0, 0), 2: (0, 0, 200)})
    assert picture.shape == (120, 160, 4) and picture.dtype == np.uint8
    seen = render(labels, GRID, view).labels
    from scipy.ndimage import binary_erosion

    for label, strong, weak in ((1, 0, 2), (2, 2, 0)):
        inside = binary_erosion(seen == label, iterations=3)
        assert inside.sum() > 50
        assert (picture[inside][:, 3] == 255).all()
        assert (picture[inside][:, strong] > picture[inside][:, weak].astype(int) + 40).all()
    # Tops are lighter than sides, and the table is there around them.
    top = picture[binary_erosion(seen == 1, iterations=3)][:, 0]
    assert top.max() > 1.3 * top.min()
    assert picture[118, 80, 3] < 10 and picture[60, 80, 3] > 25
    again = voxel_picture(labels, GRID, view, {1: (200, 0, 0), 2: (0, 0, 200)})
    assert png_bytes(again) == png_bytes(picture)


def test_an_empty_grid_shows_the_table():
    labels = np.zeros(GRID.shape, np.uint16)
    view = viewpoint([(labels, GRID)], CAMERA, 80, 60)
    picture = voxel_picture(labels, GRID, view, {})
    middle = picture[25:35, 35:45].astype(int)
    assert (middle[..., 3] > 25).all() and (middle[..., 3] < 100).all(), "translucent: light and dark pages"
    assert np.ptp(middle[..., :3], axis=2).max() == 0 and picture[0, 0, 3] == 0


def test_close_up_holds_the_objects_and_keeps_the_proportions():
    labels = labels_of((8, 8, 4))
    x, y, width, height = close_up([(labels, GRID)], CAMERA)
    assert width / height == pytest.approx(CAMERA.width / CAMERA.height, rel=0.02)
    rows, columns = np.nonzero(project(Hypothesis.from_labels(labels, GRID), CAMERA))
    assert x <= columns.min() and columns.max() <= x + width and y <= rows.min() and rows.max() <= y + height
    assert x >= 0 and y >= 0 and x + width <= CAMERA.width + 0.1 and y + height <= CAMERA.height + 0.1
    assert close_up([(np.zeros_like(labels), GRID)], CAMERA) == (0, 0, CAMERA.width, CAMERA.height)

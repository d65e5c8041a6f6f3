"""Free-space projection on an exact scene."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.base.errors import InputError
from mstfilter.formats import save_recording
from mstfilter.scene import Camera, Frame, FreeSpace, Hypothesis, NoFreeSpace, Recording
from tests.scene.free_space_reference import CAMERAS, SMALL, frame_of, observe, shelf, views
from tests.scene.scenes import CAMERA, GRID, table_scene

RGB, DEPTH, LABELS = table_scene()
FRAME = Frame(RGB, DEPTH, CAMERA)
TRUTH = Hypothesis.from_labels(LABELS, GRID)


def test_the_truth_is_unchanged():
    refined, quality = FreeSpace().project(TRUTH, FRAME)
    assert quality == 1.0
    assert refined is TRUTH
    noisy = Frame(RGB, table_scene(noise=np.random.default_rng(0))[1], CAMERA)
    assert FreeSpace().project(TRUTH, noisy)[1] > 0.998


def test_a_false_object_in_free_space_is_cleared_and_lowers_the_quality():
    labels = LABELS.copy()
    labels[20:26, 8:14, :8] = 3  # stands free in front of everything
    labels[16:24, 40:46, :6] = 4  # behind box 1: partly hidden
    refined, quality = FreeSpace().project(Hypothesis.from_labels(labels, GRID), FRAME)
    removed = (labels > 0) & (refined.labels == 0)
    assert (removed & (labels == 3)).sum() > 0.75 * (labels == 3).sum()
    hidden = (refined.labels == 4).sum()
    assert hidden > 0, "what is not seen is unknown and stays"
    assert not (removed & (LABELS > 0)).any()
    assert quality == pytest.approx(1 - removed.sum() / (labels > 0).sum())


def test_table_and_none():
    refined, _ = FreeSpace(table_height=0.03).project(TRUTH, FRAME)
    assert not refined.labels[:, :, :3].any()
    assert refined.labels[:, :, 3:].any()
    assert NoFreeSpace().project(TRUTH, FRAME) == (TRUTH, 1.0)
    nothing = Hypothesis.from_labels(np.zeros(GRID.shape, np.uint16), GRID)
    assert FreeSpace().project(nothing, FRAME) == (nothing, 1.0)


# -- against an oracle that looks at one voxel and one camera at a time ----------------------------------------------

margins = st.tuples(st.sampled_from([0.0, 0.5, 1.0, 2.5]), st.sampled_from([0.0, 3.0, 20.0]))
tables = st.sampled_from([-1.0, 0.0, 0.05])
EVERYTHING = Hypothesis.from_labels(np.ones(SMALL.shape, np.uint16), SMALL)


def cleared_of(frame, voxels=0.5, sigmas=3.0, table=0.0):
    """(X, Y, Z) bool: what is cleared of a hypothesis that fills the grid; its quality agrees."""
    refined, quality = FreeSpace(voxels, sigmas, table).project(EVERYTHING, frame)
    cleared = refined.labels == 0
    assert quality == pytest.approx(1 - cleared.mean())
    return cleared


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 3).flatmap(views), margins, tables)
def test_known_free_voxels_match_the_reference(frame, margin, table):
    found = cleared_of(frame, *margin, table)
    expected = observe(frame, SMALL, *margin, table)
    sure = ~expected.unsure
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(found[sure], expected.free[sure])
    above = SMALL.centres()[..., 2] >= table
    assert not (found & expected.hit & above).any(), "what has depth support stays"
    assert found[~above].all()


def test_views_belong_to_the_content_of_a_frame_and_are_checked(tmp_path, monkeypatch):
    monkeypatch.setattr("mstfilter.formats.folder.examine", lambda *recording: [])  # the frames show no table
    plain = frame_of(np.ones((9, 12), np.float32), CAMERAS[0])
    other = frame_of(np.ones((9, 12), np.float32), CAMERAS[1])
    with_view = frame_of(plain.depth, CAMERAS[0], views=(other,))
    assert with_view.key != plain.key
    assert with_view.key == frame_of(plain.depth, CAMERAS[0], views=[other]).key
    assert with_view.all_views == (with_view, other)
    with pytest.raises(InputError, match="a view has views"):
        frame_of(plain.depth, CAMERAS[0], views=(with_view,))
    with pytest.raises(InputError, match="images of 2 cameras"):
        save_recording(Recording((with_view,), SMALL, (0,), (0.0,)), tmp_path / "two")
    assert not list(tmp_path.iterdir())
    lost = frame_of(np.ones((9, 12), np.float32), Camera(CAMERAS[0].K, 12, 9))
    with pytest.raises(InputError, match="no pose"):
        frame_of(plain.depth, CAMERAS[0], views=(lost,))


@pytest.mark.parametrize("voxel", [0.01, 0.02])
def test_thin_objects_are_unchanged(voxel):
    """A book on a box and a rod one voxel thick, seen without noise."""
    grid, labels, frame = shelf(voxel)
    truth = Hypothesis.from_labels(labels, grid)
    assert FreeSpace().project(truth, frame) == (truth, 1.0)

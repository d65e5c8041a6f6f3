"""Free-space projection on an exact scene."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.fusion.free_space import FreeSpace, NoFreeSpace
from mstfilter.scene.frame import Frame
from mstfilter.scene.voxels import Hypothesis
from tests.scene.scenes import CAMERA, GRID, table_scene

RGB, DEPTH, LABELS = table_scene()
FRAME = Frame(RGB, DEPTH, CAMERA)
TRUTH = Hypothesis.from_labels(LABELS, GRID)


def test_the_truth_is_left_alone():
    refined, quality = FreeSpace().project(TRUTH, FRAME)
    assert quality == 1.0
    assert refined is TRUTH
    noisy = Frame(RGB, table_scene(noise=np.random.default_rng(0))[1], CAMERA)
    assert FreeSpace().project(TRUTH, noisy)[1] > 0.998


def test_an_invented_object_in_view_is_cleared_and_costs():
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


def test_no_known_free_voxel_survives_and_measured_ones_do():
    everything = Hypothesis.from_labels(np.ones(GRID.shape, np.uint16), GRID)
    refined, _ = FreeSpace().project(everything, FRAME)
    assert not (refined.labels[FreeSpace().known_free(FRAME, GRID)] > 0).any()
    seen = GRID.index_of(FRAME.points[FRAME.valid])
    seen = seen[GRID.contains(seen)]
    assert (refined.labels[tuple(seen.T)] > 0).all()


def test_unknown_stays_unknown():
    robot = Frame(RGB, DEPTH, CAMERA, np.ones(DEPTH.shape, bool))
    holes = Frame(RGB, np.full_like(DEPTH, np.nan), CAMERA)
    everything = Hypothesis.from_labels(np.ones(GRID.shape, np.uint16), GRID)
    for frame in (robot, holes):
        assert FreeSpace().project(everything, frame)[1] == 1.0


def test_table_and_none():
    refined, _ = FreeSpace(table_height=0.03).project(TRUTH, FRAME)
    assert not refined.labels[:, :, :3].any()
    assert refined.labels[:, :, 3:].any()
    assert NoFreeSpace().project(TRUTH, FRAME) == (TRUTH, 1.0)
    nothing = Hypothesis.from_labels(np.zeros(GRID.shape, np.uint16), GRID)
    assert FreeSpace().project(nothing, FRAME) == (nothing, 1.0)


def test_the_margin_covers_the_noise():
    """Without the margin for noise, a noisy image eats into what stands there; with it, hardly."""
    noisy = Frame(RGB, table_scene(noise=np.random.default_rng(1))[1], CAMERA)
    labels = LABELS.copy()
    labels[:, :, 0][labels[:, :, 0] == 0] = 9  # a mat one voxel thick: most of its centres lie just above the reading
    mat = Hypothesis.from_labels(labels, GRID)
    strict = FreeSpace(margin_voxels=0.45, margin_sigmas=0.0).project(mat, noisy)[1]
    kind = FreeSpace(margin_voxels=0.45, margin_sigmas=3.0).project(mat, noisy)[1]
    assert strict < kind - 0.02


@pytest.mark.parametrize(
    "wrong", [{"margin_sigmas": float("nan")}, {"margin_voxels": -1.0}, {"table_height": float("inf")}]
)
def test_wrong_fields(wrong):
    from mstfilter.errors import InputError

    with pytest.raises(InputError):
        FreeSpace(**wrong)

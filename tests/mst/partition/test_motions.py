"""Which predicted objects moved as one body, and what the update makes of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.mst.partition.cells import Cells, PairEvidence
from mstfilter.mst.partition.motions import common_motions
from mstfilter.mst.tracking import Warp
from mstfilter.scene import Hypothesis, VoxelGrid
from tests.mst.partition.test_cells import READINGS

GRID = VoxelGrid((-0.3, -0.3, 0.0), 0.01, (60, 60, 20))


def moved(*motions):
    """Three boxes in a row along x, moved by rigid motions (None: at rest)."""
    labels = np.zeros(GRID.shape, np.uint16)
    for k in range(3):
        labels[10 + 8 * k : 18 + 8 * k, 20:30, :8] = k + 1
    given = {k: T for k, T in enumerate(motions, start=1) if T is not None}
    return Warp().move(Hypothesis.from_labels(labels, GRID), given).hypothesis


def shift(x, y, degrees=0.0):
    return RigidTransform.from_components((x, y, 0.0), Rotation.from_euler("z", degrees, degrees=True))


def test_objects_with_one_motion_are_one_body():
    bodies = common_motions(moved(shift(0.0, 0.05), shift(0.0, 0.05), shift(0.0, 0.12)))
    assert bodies[1] == bodies[2] > 0 and bodies[3] > 0 and bodies[3] != bodies[1]


def test_a_turn_about_one_axis_is_one_motion_and_about_two_axes_is_not():
    turn = shift(0.02, 0.03, 20.0)
    bodies = common_motions(moved(turn, turn, None))
    assert bodies[1] == bodies[2] > 0
    about = (
        RigidTransform.from_translation((-0.08, -0.05, 0)) * turn * RigidTransform.from_translation((0.08, 0.05, 0))
    )
    bodies = common_motions(moved(turn, about, None))
    assert bodies[1] != bodies[2]


@pytest.mark.parametrize("small", [None, shift(0.004, 0.0)])
def test_objects_at_rest_are_no_body(small):
    assert common_motions(moved(small, small, shift(0, 0.05)))[:3].tolist() == [0, 0, 0]


def test_common_motion_adds_to_the_log_odds_of_the_predictions_that_have_it():
    one = np.repeat([1, 2], len(READINGS.pixels) // 2)
    bodies = [np.array([0, 1, 1]), np.array([0, 1, 2]), np.array([0, 0, 0])]
    cells = Cells.of(READINGS, [one], [one, one, one], None, bodies)
    weights = np.array([0.4, 0.3, 0.2])
    still, moving = (PairEvidence(together=value).log_odds(cells, weights, None) for value in (0.0, 2.0))
    assert np.allclose(moving - still, 0.4 * 2.0)
    unknown = Cells.of(READINGS, [one], [one, one, one])
    assert np.allclose(PairEvidence(together=2.0).log_odds(unknown, weights, None), still)

"""Distance of partitions, voxels in metres, and the errors of wrong input to a belief."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.mst.belief import Belief
from mstfilter.mst.belief.information import partition_distance
from mstfilter.scene import Hypothesis, VoxelGrid
from mstfilter.smc import Population
from tests.mst.belief.test_belief import CAMERA, GRID, SHAPE, belief_of, scenes


def test_distance_of_partitions():
    rows = np.array([[1, 1, 2, 0], [1, 1, 1, 0], [1, 2, 3, 4], [0, 0, 0, 0]])
    sizes = np.array([5, 1, 2, 10])
    want = [[0, 2, 11, 8], [2, 0, 13, 8], [11, 13, 0, 18], [8, 8, 18, 0]]
    np.testing.assert_array_equal(partition_distance(rows, sizes), want)


def test_places_in_metres():
    belief = belief_of(*scenes(0))
    np.testing.assert_array_equal(belief.voxel([[-0.02, -0.015, 0.0], [0.0199, 0.0, 0.015]]), [[0, 0, 0], [3, 1, 1]])


BAD = {
    "no hypotheses": (lambda b: Belief(Population(())), "no particles"),
    "no population": (lambda b: Belief(b.hypotheses), "Population"),
    "vectors": (lambda b: Belief(Population(np.zeros((3, 2)))), "hypotheses"),
    "mapping": (lambda b: Belief(Population({"x": np.zeros(3)})), "hypotheses"),
    "other things": (lambda b: Belief(Population(("a", "b"))), "hypotheses"),
    "point outside": (lambda b: b.voxel([[0, 0, 0], [0, 0, 9.0]]), "9.0.*outside"),
    "NaN point": (lambda b: b.voxel([0, 0, np.nan]), "outside"),
    "no point": (lambda b: b.voxel([0, 0]), "shape"),
    "voxel outside": (lambda b: b.same_object((0, 0, 0), (4, 0, 0)), r"\[4, 0, 0\].*outside"),
    "negative voxel": (lambda b: b.same_object((0, 0, 0), (0, 0, -1)), "outside"),
    "metres for voxels": (lambda b: b.same_object((0, 0, 0), (0.0, 0.01, 0.0)), "integers"),
    "region of another grid": (lambda b: b.push_information(np.ones((2, 2, 2), bool)), "region has shape"),
    "region outside": (lambda b: b.push_information([(0, 0, 0), (9, 9, 9)]), "outside"),
    "pixel outside": (lambda b: b.same_object_at_pixels(CAMERA, (0, 0), (20, 0)), r"\[20, 0\].*20 x 16"),
    "negative pixel": (lambda b: b.same_object_at_pixels(CAMERA, (0, 0), (3, -1)), "outside"),
    "pixel in floats": (lambda b: b.same_object_at_pixels(CAMERA, (0, 0), (1.5, 0)), "integers"),
    "no camera": (lambda b: b.view_information("left"), "Camera"),
    "no camera for pixels": (lambda b: b.same_object_at_pixels(None, (0, 0), (0, 0)), "Camera"),
    "negative tolerance": (lambda b: b.push_map(-1), "tolerance is -1"),
    "NaN tolerance": (lambda b: b.push_information((0, 0, 0), np.nan), "tolerance"),
    "no tolerance": (lambda b: b.partition_entropy(tolerance="a"), "tolerance"),
    "array outcome": (lambda b: b.information(lambda h: h.labels), "outcome"),
    "NaN": (lambda b: b.most_informative("ab", {"a": float("nan"), "b": 1.0}.__getitem__), "action 0 is NaN"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_clear_error(name):
    act, says = BAD[name]
    with pytest.raises(InputError, match=says) as caught:
        act(belief_of(*scenes(0)))
    assert "\n" not in caught.value.message


def test_different_grids():
    labels = scenes(0)[0][0]
    for other in (VoxelGrid(GRID.origin, 0.02, SHAPE), VoxelGrid(GRID.origin + 0.01, 0.01, SHAPE)):
        with pytest.raises(InputError, match="grid of hypothesis 1"):
            Belief(Population((Hypothesis.from_labels(labels, GRID), Hypothesis.from_labels(labels, other))))

"""Similarity of hypotheses: all pairs at once against one pair at a time; equality up to the names of labels."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.mst.belief import SameSegmentation, WeightedCoverage
from mstfilter.runs.presets import REGISTRY
from mstfilter.scene import Hypothesis, VoxelGrid
from mstfilter.scoring import weighted_coverage
from mstfilter.smc import ClusterStratified, Coalesced, Population

GRID = VoxelGrid(np.zeros(3), 0.01, (6, 5, 4))


def hypotheses(n, seed=0):
    rng = np.random.default_rng(seed)
    grids = [rng.integers(0, rng.integers(1, 6), GRID.shape) * rng.integers(0, 2, GRID.shape) for _ in range(n)]
    grids[1] = np.zeros(GRID.shape, int)  # two without objects, one with gaps, one without free space
    grids[2] = np.zeros(GRID.shape, int)
    grids[3] = grids[3] * 7
    grids[4] = np.ones(GRID.shape, int)
    return [Hypothesis.from_labels(g, GRID) for g in grids]


def test_all_pairs_equal_one_pair_at_a_time():
    particles = hypotheses(9)
    found = WeightedCoverage().matrix(particles)
    want = [[weighted_coverage(a.labels, b.labels) for b in particles] for a in particles]
    np.testing.assert_allclose(found, want, atol=1e-12)
    coarse = WeightedCoverage(stride=2).matrix(particles)
    want = [
        [weighted_coverage(a.labels[::2, ::2, ::2], b.labels[::2, ::2, ::2]) for b in particles] for a in particles
    ]
    np.testing.assert_allclose(coarse, want, atol=1e-12)


def test_hypotheses_without_any_object():
    empty = Hypothesis.from_labels(np.zeros(GRID.shape, int), GRID)
    np.testing.assert_array_equal(WeightedCoverage().matrix([empty, empty]), np.ones((2, 2)))
    with pytest.raises(InputError, match="stride"):
        WeightedCoverage(stride=0)
    other = VoxelGrid(np.zeros(3), 0.01, (2, 2, 2))
    with pytest.raises(InputError, match="grid of a hypothesis"):
        WeightedCoverage().matrix([empty, Hypothesis.from_labels(np.zeros((2, 2, 2), int), other)])


def test_renamed_labels_are_equal():
    a, b, c = np.array([[[0, 5, 5, 2]]]), np.array([[[0, 1, 1, 9]]]), np.array([[[3, 1, 1, 9]]])
    grid = VoxelGrid(np.zeros(3), 0.01, (1, 1, 4))
    particles = [Hypothesis.from_labels(x, grid) for x in (a, b, c, a)]
    np.testing.assert_array_equal(SameSegmentation().classes(particles), [0, 0, 1, 0])


def test_resamplers_of_hypotheses_as_a_preset_file_names_them():
    clusters = {"component": "clusters", "similarity": {"component": "weighted_coverage", "stride": 2}}
    config = {"component": "coalesced", "equivalence": "same_segmentation", "scheme": clusters}
    scheme = REGISTRY.build("resampler", config)
    assert scheme == Coalesced(ClusterStratified(WeightedCoverage(2)), SameSegmentation())
    assert REGISTRY.build("resampler", REGISTRY.describe(scheme)) == scheme
    particles = hypotheses(8)
    population = Population((*particles, particles[0], particles[5]), np.log(np.arange(1.0, 11)))
    chosen = scheme.resample(np.random.default_rng(0), population, 3)
    assert chosen.notes["distinct"] == 7
    assert len(set(SameSegmentation().classes(chosen.particles).tolist())) == len(chosen) == 3

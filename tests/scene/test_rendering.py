"""Ray casting through voxels against marching along the ray in tiny steps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.errors import InputError
from mstfilter.scene.camera import Camera, look_at
from mstfilter.scene.rendering import project, render
from mstfilter.scene.voxels import Hypothesis, VoxelGrid

GRID = VoxelGrid((-0.1, -0.1, 0.0), 0.02, (10, 11, 9))
CAMERA = Camera.from_intrinsics(40, 42, 15.3, 12.1, 32, 24, look_at((0.03, -0.5, 0.4), (0, 0, 0.05)))


def by_marching(labels, grid, camera, step=2e-5):
    """The first occupied sample along each ray; `boundary` marks rays that graze within rounding."""
    directions = camera.rays() @ camera.pose.as_matrix()[:3, :3].T
    t = np.arange(0.0, 1.2, step)
    image, depth = np.zeros(directions.shape[:2], int), np.full(directions.shape[:2], np.nan)
    for v in range(camera.height):
        for u in range(camera.width):
            index = grid.index_of(camera.position + t[:, None] * directions[v, u])
            inside = grid.contains(index)
            seen = np.zeros(len(t), int)
            seen[inside] = labels[tuple(index[inside].T)]
            hit = np.flatnonzero(seen)
            if len(hit):
                image[v, u], depth[v, u] = seen[hit[0]], t[hit[0]]
    return image, depth


@pytest.mark.parametrize("density", [0.02, 0.3, 1.0])
def test_against_marching(density):
    rng = np.random.default_rng(int(100 * density))
    labels = np.where(rng.random(GRID.shape) < density, rng.integers(1, 6, GRID.shape), 0)
    image, depth = by_marching(labels, GRID, CAMERA)
    got = render(labels, GRID, CAMERA)
    # A ray may cut a corner by less than a marching step: such pixels differ without either being wrong.
    same = got.labels == image
    assert same.mean() > 0.995
    np.testing.assert_allclose(got.depth[same], depth[same], atol=4e-5)


def test_depth_of_a_wall_is_the_distance_to_its_plane():
    labels = np.zeros(GRID.shape, np.uint16)
    labels[:, 5:, :] = 3
    got = render(labels, GRID, CAMERA)
    directions = CAMERA.rays() @ CAMERA.pose.as_matrix()[:3, :3].T
    wall = (-0.1 + 5 * 0.02 - CAMERA.position[1]) / directions[..., 1]
    point = CAMERA.position + wall[..., None] * directions
    face = (np.abs(point[..., 0]) < 0.0999) & (point[..., 2] > 1e-4) & (point[..., 2] < 0.1799)
    assert face.sum() > 20
    np.testing.assert_allclose(got.depth[face], wall[face], rtol=1e-5)
    assert (got.labels[face] == 3).all()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), x=st.floats(-0.6, 0.6), y=st.floats(-0.6, 0.6), z=st.floats(0.02, 0.7))
def test_from_anywhere_even_from_inside(seed, x, y, z):
    """Whatever the camera's place: labels come from the grid, depth leads to a voxel of that label."""
    rng = np.random.default_rng(seed)
    labels = np.where(rng.random(GRID.shape) < 0.1, rng.integers(1, 9, GRID.shape), 0)
    target = np.array([0.011, 0.013, 0.057])
    camera = Camera.from_intrinsics(20, 20, 7.5, 7.5, 16, 16, look_at(np.array([x, y, z]) + 1e-3, target))
    got = render(labels, GRID, camera)
    hit = got.labels > 0
    assert (np.isfinite(got.depth) == hit).all()
    directions = camera.rays() @ camera.pose.as_matrix()[:3, :3].T
    point = camera.position + (got.depth[..., None] + 1e-6) * directions
    index = GRID.index_of(point[hit])
    inside = GRID.contains(index)
    assert inside.mean() > 0.98 if hit.any() else True
    assert (labels[tuple(index[inside].T)] == got.labels[hit][inside]).mean() > 0.97 if hit.any() else True


def test_empty_grids_and_wrong_shapes():
    got = render(np.zeros(GRID.shape, np.uint16), GRID, CAMERA)
    assert not got.labels.any()
    assert np.isnan(got.depth).all()
    with pytest.raises(InputError, match="shape"):
        render(np.zeros((2, 2, 2), int), GRID, CAMERA)


def test_project_of_a_hypothesis():
    labels = np.zeros(GRID.shape, np.uint16)
    labels[3:6, 3:6, :4] = 7
    hypothesis = Hypothesis.from_labels(labels, GRID)
    np.testing.assert_array_equal(project(hypothesis, CAMERA), render(labels, GRID, CAMERA).labels)
    assert set(np.unique(project(hypothesis, CAMERA))) == {0, 7}

"""Ray casting through voxels against the ray caster of open3d, planes, and properties for any camera."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.base.errors import InputError, MissingLibraryError
from mstfilter.base.lazy import import_open3d
from mstfilter.scene.camera import Camera, look_at
from mstfilter.scene.rendering import render, render_hypothesis
from mstfilter.scene.voxels import Hypothesis, VoxelGrid

GRID = VoxelGrid((-0.1, -0.1, 0.0), 0.02, (10, 11, 9))
CAMERA = Camera.from_intrinsics(40, 42, 15.3, 12.1, 32, 24, look_at((0.03, -0.5, 0.4), (0, 0, 0.05)))


def cast_by_open3d(labels, grid, camera):
    """Label image and z-depth of a triangle mesh: a cube of 12 triangles for every occupied voxel."""
    try:
        o3d = import_open3d()
    except MissingLibraryError as error:
        pytest.skip(str(error))
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    triangles = o3d.geometry.TriangleMesh.create_box()
    assert np.array_equal(np.unique(np.asarray(triangles.vertices), axis=0), corners)
    vertices, faces = np.asarray(triangles.vertices), np.asarray(triangles.triangles)
    index = np.argwhere(labels)
    points = grid.origin + (index[:, None] + vertices) * grid.voxel_size
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(points.reshape(-1, 3).astype(np.float32)),
        o3d.core.Tensor((faces + 8 * np.arange(len(index))[:, None, None]).reshape(-1, 3).astype(np.uint32)),
    )
    directions = camera.rays() @ camera.pose.as_matrix()[:3, :3].T  # z = 1 in camera axes: t is z-depth
    rays = np.concatenate([np.broadcast_to(camera.position, directions.shape), directions], axis=-1)
    found = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
    t, voxel = found["t_hit"].numpy(), found["primitive_ids"].numpy() // 12
    hit = np.isfinite(t)
    image = np.zeros(hit.shape, int)
    image[hit] = labels[tuple(index[voxel[hit]].T)]
    return image, np.where(hit, t, np.nan)


@pytest.mark.parametrize("density", [0.02, 0.3, 1.0])
@pytest.mark.parametrize("position", [(0.03, -0.5, 0.4), (-0.45, 0.2, 0.1), (0.004, 0.003, 0.6)])
def test_rendering_agrees_with_open3d(density, position):
    rng = np.random.default_rng(int(100 * density))
    grid = VoxelGrid((-0.2, -0.2, 0.0), 0.02, (20, 20, 10))
    labels = np.where(rng.random(grid.shape) < density, rng.integers(1, 6, grid.shape), 0)
    camera = Camera.from_intrinsics(150, 152, 59.3, 45.1, 120, 90, look_at(np.array(position), (0, 0, 0.05)))
    image, depth = cast_by_open3d(labels, grid, camera)
    got = render(labels, grid, camera)
    # open3d computes in single precision: a ray through an edge may hit the voxel on either side of it.
    same = got.labels == image
    assert same.mean() > 0.999 and (image > 0).mean() > 0.1
    difference = np.abs(got.depth - depth)[same & (image > 0)]
    assert (difference < 1e-5).mean() > 0.999


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), x=st.floats(-0.6, 0.6), y=st.floats(0.1, 0.6), z=st.floats(0.02, 0.7))
def test_objects_rendered_one_by_one_give_the_scene(seed, x, y, z):
    """The nearest object at each pixel is that of the ray through all voxels; other pixels are on edges."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, 6, (4, 4, 3)).repeat(3, axis=0).repeat(3, axis=1).repeat(3, axis=2)
    labels = blocks[:10, :11].astype(np.uint16)
    camera = CAMERA.at(look_at((x, y, z), (0.0123, 0.0071, 0.05)))
    whole = render(labels, GRID, camera)
    parts = render_hypothesis(Hypothesis.from_labels(labels, GRID), camera)
    same = (parts.labels == whole.labels) & (np.isnan(parts.depth) == np.isnan(whole.depth))
    assert same.mean() > 0.995
    np.testing.assert_allclose(parts.depth[same], whole.depth[same], rtol=1e-5)


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
def test_cameras_anywhere_also_inside_the_grid(seed, x, y, z):
    """For any camera position, labels come from the grid, and depth leads to a voxel of that label."""
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
    # A ray that touches an edge leaves the voxel within the added micrometre: at most one, or 2 %.
    assert (~inside).sum() <= max(1, 0.02 * len(inside))
    wrong = labels[tuple(index[inside].T)] != got.labels[hit][inside]
    assert wrong.sum() <= max(1, 0.03 * len(wrong))


def test_an_empty_grid_gives_an_empty_image_and_a_wrong_shape_an_error():
    got = render(np.zeros(GRID.shape, np.uint16), GRID, CAMERA)
    assert not got.labels.any()
    assert np.isnan(got.depth).all()
    with pytest.raises(InputError, match="shape"):
        render(np.zeros((2, 2, 2), int), GRID, CAMERA)

"""Regions, joins and the tree that merges them, on rendered scenes with known truth."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.errors import InputError
from mstfilter.scene import Camera, Frame
from mstfilter.segmentation.boundary import ColourDepthBoundary
from mstfilter.segmentation.cuts import MergeLogOdds
from mstfilter.segmentation.learned_tree import Agglomeration, LearnedTree, tree_of_merges
from mstfilter.segmentation.regions import (
    BORDER,
    PAIR_FEATURES,
    REGION,
    measure_regions,
    pair_features,
    quadric_residual,
)
from tests.segmentation.scenes import GRID, TOUCHING, TWO, frame_of


def measured(n: int = 6, seed: int = 0):
    """Regions of arbitrary blocks of an image with boxes."""
    frame = frame_of(TOUCHING, width=320, noise=0.4)
    height, width = frame.depth.shape
    leaves = (np.arange(height) * n // height)[:, None] * n + np.arange(width) * n // width
    boundary = np.random.default_rng(seed).random(frame.depth.shape)
    return leaves, measure_regions(leaves, frame, boundary), frame, boundary


def test_sums_of_merged_regions_are_the_sums_of_the_merged_image():
    leaves, regions, frame, boundary = measured()
    a, b = next((i, j) for i in range(1, len(regions.sums)) for j in regions.borders[i] if j > i)
    together = leaves.copy()
    first, second = (int(np.flatnonzero(regions.of_leaf == r)[0]) for r in (a, b))
    together[leaves == second] = first
    merged = measure_regions(np.unique(together, return_inverse=True)[1].reshape(leaves.shape), frame, boundary)
    growing = Agglomeration(regions, lambda *pair: np.zeros(len(pair[0])))
    new = growing.merge(a, b, 0.0)
    k = a  # regions are numbered in order of their leaves, and `a` kept its leaf
    assert np.allclose(growing.sums[new], merged.sums[k], rtol=1e-9, atol=1e-6)
    assert np.allclose(growing.table[new], merged.borders[k].get(0, 0), atol=1e-6)
    assert len(growing.borders[new]) == len(merged.borders[k].keys() - {0})
    assert np.allclose(sum(growing.borders[new].values()), sum(v for j, v in merged.borders[k].items() if j))


def test_borders_turn_with_the_point_of_view():
    _, regions, _, _ = measured()
    for i, near in enumerate(regions.borders):
        for j, row in near.items():
            turned = regions.borders[j][i].copy()
            turned[BORDER["step"]] *= -1
            assert np.array_equal(turned, row)


def test_features_do_not_depend_on_which_region_comes_first():
    _, regions, _, _ = measured()
    a, b = next((i, j) for i in range(1, len(regions.sums)) for j in regions.borders[i] if j > i)
    empty = np.zeros((1, len(BORDER)))
    table = [regions.borders[r].get(0, empty[0])[None] for r in (a, b)]
    one = pair_features(regions.sums[[a]], regions.sums[[b]], regions.borders[a][b][None], *table, 0.5)
    other = pair_features(regions.sums[[b]], regions.sums[[a]], regions.borders[b][a][None], *table[::-1], 0.5)
    assert one.shape == (1, len(PAIR_FEATURES))
    assert np.isfinite(one).all()
    assert np.allclose(one, other)


def test_the_residual_of_a_quadric_matches_least_squares():
    rng = np.random.default_rng(5)
    u, v = rng.uniform(-1, 1, (2, 200))
    design = np.stack([np.ones(200), u, v, u * u, u * v, v * v], axis=1)
    d = design @ rng.normal(size=6) * 20 + rng.normal(size=200)
    row = np.zeros((1, REGION["perimeter"].stop))
    row[0, REGION["pixels"]] = 200
    row[0, REGION["gram"]] = (design.T @ design).ravel()
    row[0, REGION["moment"]] = design.T @ d
    row[0, REGION["square"]] = d @ d
    assert quadric_residual(row)[0] == pytest.approx(
        np.linalg.lstsq(design, d, rcond=None)[1][0], rel=1e-4
    )  # the ridge


@pytest.mark.parametrize("width", [160, 320, 640])
def test_the_table_is_one_leaf_and_objects_are_nodes(width):
    frame = frame_of(TWO, width=width, noise=0.4)
    tree = LearnedTree().build(ColourDepthBoundary().boundary(frame), frame)
    assert tree.mask(0).mean() > 0.5
    assert tree.parent[0] == tree.root
    table = frame.points[tree.mask(0)]
    assert np.nanmean(np.abs(table[:, 2]) < 0.02) > 0.95
    w = MergeLogOdds().values(tree, frame)
    for node in range(tree.n_leaves, tree.n_nodes):
        assert w[node] == pytest.approx(
            w[list(tree.children[node])].sum() - np.clip(tree.odds[node], -6.91, 6.91), abs=0.01
        )


def test_frames_without_pose_readings_or_objects():
    frame = frame_of(TWO, noise=0.2)
    camera = Camera(frame.camera.K, frame.camera.width, frame.camera.height)
    boundary = ColourDepthBoundary().boundary(frame)
    assert LearnedTree().build(boundary, Frame(frame.rgb, frame.depth, camera)).n_leaves > 2
    blind = Frame(frame.rgb, np.full_like(frame.depth, np.nan), frame.camera)
    assert LearnedTree().build(ColourDepthBoundary().boundary(blind), blind).n_nodes == 1
    bare = frame_of(np.zeros(GRID.shape, np.uint16))
    assert LearnedTree().build(ColourDepthBoundary().boundary(bare), bare).n_nodes == 1


def test_the_tree_of_merges():
    tree = tree_of_merges(np.arange(4)[None], 4, [(1, 2, -3.0), (3, 4, 2.0)])
    assert tree.parent.tolist() == [6, 4, 4, 5, 5, 6, 6]
    assert tree.odds[4:].tolist() == [-3.0, 2.0, 30.0]
    assert (np.diff(tree.start[4:]) > 0).all()


def test_a_builder_that_needs_the_frame_says_so():
    with pytest.raises(InputError, match="needs the frame"):
        LearnedTree().build(np.zeros((4, 4)))

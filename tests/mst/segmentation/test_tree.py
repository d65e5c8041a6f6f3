"""Trees: helpers against brute force, and the contour hierarchy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.base.errors import InputError
from mstfilter.mst.segmentation.boundary import ColourDepthBoundary
from mstfilter.mst.segmentation.tree import Tree, UcmTree, merge_tree, prune
from tests.mst.segmentation.scenes import TWO, frame_of
from tests.mst.segmentation.trees import is_cut, random_tree


def brute_leaves(tree: Tree, node: int) -> set[int]:
    found = set()
    for leaf in range(tree.n_leaves):
        at = leaf
        while at != tree.root and at != node:
            at = int(tree.parent[at])
        if at == node:
            found.add(leaf)
    return found


@given(st.integers(0, 10**6), st.integers(1, 12), st.integers(2, 4))
def test_helpers_match_brute_force(seed, leaves, most):
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, leaves, most)
    values = rng.integers(0, 9, leaves)
    below = [brute_leaves(tree, i) for i in range(tree.n_nodes)]
    for node in range(tree.n_nodes):
        assert set(tree.leaves_of(node).tolist()) == below[node]
        assert set(tree.children[node]) == {i for i in range(tree.n_nodes - 1) if tree.parent[i] == node}
        assert tree.mask(node).sum() == len(below[node]) == tree.area[node]
    assert tree.accumulate(values).tolist() == [values[list(b)].sum() for b in below]
    a, b = rng.integers(0, leaves, (2, 5))
    a, b = np.minimum(a, b), np.maximum(a, b)
    position = tree.leaf_position
    for first, last, node in zip(a, b, tree.lowest_common(a, b), strict=True):
        span = {k for k in range(leaves) if first <= position[k] <= last}
        assert node == min(i for i in range(tree.n_nodes) if span <= below[i])
    assert is_cut(tree, np.array([tree.root]))
    assert is_cut(tree, np.arange(leaves))
    assert leaves == 1 or not is_cut(tree, np.array([0]))
    assert leaves == 1 or not is_cut(tree, np.array([0, tree.root]))


def test_malformed_trees_raise_an_error():
    with pytest.raises(InputError, match="not ordered"):
        Tree([2, 2, 1], [[0, 1]], [0, 0, 0])
    with pytest.raises(InputError, match="leaves must come before"):
        Tree([1, 4, 4, 4, 4], [[0]], np.zeros(5))
    with pytest.raises(InputError, match="leaf image"):
        Tree([2, 2, 2], [[0, 2]], np.zeros(3))
    with pytest.raises(InputError, match="tree start"):
        Tree([2, 2, 2], [[0, 1]], np.zeros(2))


def test_heights_never_decrease_and_agree_with_mean_linkage():
    """The merges are the library's mean-pb hierarchy, whose heights are checked against ours."""
    import higra as hg

    boundary = ColourDepthBoundary().boundary(frame_of(TWO, width=160))
    parent, altitude, leaves = merge_tree(boundary)
    assert (altitude[parent] >= altitude).all()
    graph = hg.get_4_adjacency_graph(boundary.shape)
    weights = hg.weight_graph(graph, boundary.astype(np.float64), hg.WeightFunction.mean)
    tree, heights = hg.mean_pb_hierarchy(graph, weights, boundary.shape)
    assert np.array_equal(tree.parents(), parent)
    assert np.allclose(heights, altitude, atol=1e-9)
    assert leaves.max() + 1 == tree.num_leaves()


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.integers(1, 20), st.integers(1, 25))
def test_pruning_keeps_the_highest_merges(seed, leaves, most):
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, leaves, 2)
    parent, height, image = prune(tree.parent, tree.start, tree.leaves, most)
    pruned = Tree(parent, image, height)
    assert pruned.n_leaves == min(leaves, most)
    kept = np.sort(tree.start[tree.n_leaves :])[::-1][: pruned.n_leaves - 1]
    assert np.allclose(np.sort(pruned.start[pruned.n_leaves :])[::-1], kept)
    before = {frozenset(np.flatnonzero(tree.mask(i)).tolist()) for i in range(tree.n_nodes)}
    assert {frozenset(np.flatnonzero(pruned.mask(i)).tolist()) for i in range(pruned.n_nodes)} <= before


@pytest.mark.parametrize("boundary", [np.zeros((1, 1)), np.zeros((5, 7)), np.ones((4, 4)), np.eye(6)])
def test_degenerate_maps(boundary):
    tree = UcmTree().build(boundary)
    assert tree.leaves.shape == boundary.shape
    assert tree.area[tree.root] == boundary.size


def test_invalid_maps_are_reported():
    with pytest.raises(InputError, match="not finite"):
        UcmTree().build(np.full((3, 3), np.nan))
    with pytest.raises(InputError, match="shape"):
        UcmTree().build(np.zeros(3))

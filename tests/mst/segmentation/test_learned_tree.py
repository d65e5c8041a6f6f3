"""Regions, features of pairs, and the trees that merge them, on rendered scenes with known truth."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from mstfilter.base.errors import InputError
from mstfilter.base.trained import TrainedModel, write_model
from mstfilter.mst.segmentation import (
    EVIDENCE_FEATURES,
    FEATURES,
    PAIR_FEATURES,
    BorderTree,
    ColourDepthBoundary,
    LearnedTree,
    MergeLogOdds,
    PairNetwork,
    SeenBorders,
    UcmTree,
    pair_features,
)
from mstfilter.mst.segmentation.border_network import BORDER_ARCHITECTURE, IMAGE_CHANNELS, BorderNet
from mstfilter.mst.segmentation.learned_tree import Agglomeration, tree_of_merges
from mstfilter.mst.segmentation.pair_measures import quadric_residual
from mstfilter.mst.segmentation.regions import BORDER, REGION, measure_regions, object_leaves
from mstfilter.scene import Camera, Frame, pixels_above_table, render
from tests.mst.segmentation.scenes import GRID, TOUCHING, TWO, camera, frame_of


def measured(n: int = 6, seed: int = 0):
    """Regions of arbitrary blocks of an image with boxes."""
    frame = frame_of(TOUCHING, width=320, noise=0.4)
    height, width = frame.depth.shape
    leaves = (np.arange(height) * n // height)[:, None] * n + np.arange(width) * n // width
    boundary = np.random.default_rng(seed).random(frame.depth.shape)
    leaves = object_leaves(leaves, pixels_above_table(frame))
    return leaves, measure_regions(leaves, frame, boundary), frame, boundary


def test_sums_of_merged_regions_are_the_sums_of_the_merged_image():
    leaves, regions, frame, boundary = measured()
    a, b = next((i, j) for i in range(1, len(regions.sums)) for j in regions.borders[i] if j > i)
    together = leaves.copy()
    together[leaves == b] = a
    merged = measure_regions(np.unique(together, return_inverse=True)[1].reshape(leaves.shape), frame, boundary)
    growing = Agglomeration(regions, lambda *pair: np.zeros(len(pair[0])))
    new = growing.merge(a, b, 0.0)
    k = a  # regions are numbered in order of their leaves, and `a` kept its leaf
    assert np.allclose(growing.sums[new], merged.sums[k], rtol=1e-9, atol=1e-6)
    assert np.allclose(growing.table[new], merged.borders[k].get(0, 0), atol=1e-6)
    assert len(growing.borders[new]) == len(merged.borders[k].keys() - {0})
    assert np.allclose(sum(growing.borders[new].values()), sum(v for j, v in merged.borders[k].items() if j))


def features_of(regions, a, b, names):
    """The features of the regions a and b."""
    table = [regions.borders[r].get(0, np.zeros(len(BORDER)))[None] for r in (a, b)]
    return pair_features(regions.sums[[a]], regions.sums[[b]], regions.borders[a][b][None], *table, 0.5, names)[0]


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
    one, other = features_of(regions, a, b, FEATURES), features_of(regions, b, a, FEATURES)
    assert np.isfinite(one).all()
    assert np.allclose(one, other)
    assert not one[-len(EVIDENCE_FEATURES) :].any()  # without a network nothing is seen


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


def test_perfect_evidence_tells_pairs_of_objects_from_parts():
    frame = frame_of(TOUCHING, width=320, noise=0.4)
    truth = render(TOUCHING, GRID, camera(320)).labels.astype(np.int64)
    rows, columns = np.indices(truth.shape)
    centre = np.zeros((*truth.shape, 2), np.float32)
    edge = np.zeros(truth.shape, bool)
    for axis in (0, 1):
        edge |= np.roll(truth, 1, axis) != truth
    for k in (1, 2):
        centre[truth == k] = columns[truth == k].mean(), rows[truth == k].mean()
    seen = SeenBorders(np.where(edge, 9, -9).astype(np.float32), truth > 0, centre)
    boundary = ColourDepthBoundary().boundary(frame)
    h, w = truth.shape
    blocks = (np.arange(h) // 12)[:, None] * 40 + np.arange(w) // 12 + 2000 * truth
    leaves = np.unique(np.where(truth > 0, blocks, 0), return_inverse=True)[1].reshape(truth.shape)
    regions = measure_regions(leaves, frame, boundary, seen)
    object_of = np.zeros(len(regions.sums), np.int64)
    object_of[leaves] = truth
    found = {True: [], False: []}
    for i in range(1, len(regions.sums)):
        for j in regions.borders[i]:
            if j > i and min(object_of[i], object_of[j]) > 0:
                found[bool(object_of[i] != object_of[j])].append(features_of(regions, i, j, EVIDENCE_FEATURES))
    seen_by, gap = EVIDENCE_FEATURES.index("seen"), EVIDENCE_FEATURES.index("centre gap")
    different, same = np.array(found[True]), np.array(found[False])
    assert len(different) > 3 and len(same) > 10
    assert np.allclose(different[:, seen_by], 6) and np.median(same[:, seen_by]) < -4
    assert different[:, gap].min() > 1 and np.allclose(same[:, gap], 0, atol=1e-3)


def write_network(folder, evidence: dict[str, float], correction: PairNetwork | None = None) -> str:
    torch.manual_seed(0)
    net = BorderNet(8)
    torch.nn.init.normal_(net.head.weight, std=0.5)
    description = {
        "architecture": BORDER_ARCHITECTURE,
        "network": {"channels": list(IMAGE_CHANNELS), "width": 8},
        "calibration": {"scale": 1.0, "shift": 0.0},
        "evidence": {"features": list(evidence), "weights": list(evidence.values())},
    }
    own = {} if correction is None else correction.tensors()
    write_model(folder, description, {name: t.numpy() for name, t in net.state_dict().items()} | own)
    return str(folder)


def perceptron(rng: np.random.Generator, n_features: int, n_hidden: int = 5) -> PairNetwork:
    shapes = (n_features, n_hidden), (n_hidden, 1)
    weights = tuple(rng.normal(size=shape) for shape in shapes)
    biases = tuple(rng.normal(size=shape[1]) for shape in shapes)
    return PairNetwork(rng.normal(size=n_features), rng.uniform(0.5, 2, n_features), weights, biases)


def test_the_correction_is_a_bounded_perceptron():
    network = perceptron(np.random.default_rng(0), 3)
    for x in np.random.default_rng(1).normal(scale=5, size=(20, 3)):
        z = [min(max((x[i] - network.mean[i]) / network.scale[i], -4), 4) for i in range(3)]
        hidden = [
            max(sum(z[i] * network.weights[0][i, k] for i in range(3)) + network.biases[0][k], 0) for k in range(5)
        ]
        odds = sum(hidden[k] * network.weights[1][k, 0] for k in range(5)) + network.biases[1][0]
        assert network(x[None]) == pytest.approx([odds])
    far = np.array([[1e9, -1e9, 1e9], [1e12, -1e12, 1e12]])
    assert network(far)[0] == network(far)[1]  # bounded


def test_the_correction_is_read_from_a_model_and_checked(tmp_path):
    network = perceptron(np.random.default_rng(0), 3)
    tensors = {name: t.astype(np.float32) for name, t in network.tensors().items()}
    model = TrainedModel(tmp_path, {}, {"other": np.ones(2), **tensors}, "key")
    plain, own = model.split("pairs.")
    assert set(plain.tensors) == {"other"} and set(own.tensors) == set(tensors)
    x = np.random.default_rng(1).normal(size=(4, 3))
    again = PairNetwork.of(model, 3)
    assert again is not None and np.allclose(again(x), network(x), atol=1e-5)
    assert PairNetwork.of(plain, 3) is None
    wrong = [
        ({name: t for name, t in tensors.items() if name != missing}, 3, missing)
        for missing in ("pairs.mean", "pairs.bias0", "pairs.bias1")
    ]
    wrong.append((tensors, 4, "pairs.mean"))
    wrong.append(({**tensors, "pairs.weight1": np.ones((5, 2))}, 3, "pairs.weight1"))
    wrong.append(({**tensors, "pairs.bias0": np.ones(6)}, 3, "pairs.weight0"))
    for found, n_features, name in wrong:
        with pytest.raises(InputError, match=f"tensor '{name}' is .*the architecture has"):
            PairNetwork.of(replace(model, tensors=found), n_features)


def test_the_correction_is_added_to_the_log_odds_of_the_border_tree(tmp_path):
    learned, _ = LearnedTree().model()
    evidence = {**learned, **dict.fromkeys(EVIDENCE_FEATURES, 0.0)}
    n = len(evidence)
    shift = PairNetwork(np.zeros(n), np.ones(n), (np.zeros((n, 1)),), (np.array([-2.0]),))
    frame = frame_of(TOUCHING, noise=0.4)
    boundary, leaves = ColourDepthBoundary().boundary(frame), UcmTree(max_leaves=100)
    one, other = (
        BorderTree(leaves, write_network(tmp_path / str(k), evidence, network)).build(boundary, frame)
        for k, network in enumerate((None, shift))
    )
    assert np.array_equal(one.parent, other.parent)
    merged = slice(one.n_leaves, -1)  # without the root
    assert np.allclose(other.odds[merged], one.odds[merged] - 2)


def test_weights_of_zero_for_the_evidence_give_the_learned_tree(tmp_path):
    learned, _ = LearnedTree().model()
    name = write_network(tmp_path / "plain", {**learned, **dict.fromkeys(EVIDENCE_FEATURES, 0.0)})
    frame = frame_of(TOUCHING, noise=0.4)
    boundary = ColourDepthBoundary().boundary(frame)
    leaves = UcmTree(max_leaves=100)
    one, other = BorderTree(leaves, name).build(boundary, frame), LearnedTree(leaves).build(boundary, frame)
    assert np.array_equal(one.parent, other.parent) and np.allclose(one.odds, other.odds)
    used = write_network(tmp_path / "used", {**learned, **dict.fromkeys(EVIDENCE_FEATURES, 0.5)})
    assert not np.allclose(BorderTree(leaves, used).build(boundary, frame).odds[-9:], one.odds[-9:])
    with pytest.raises(InputError, match="needs the frame"):
        BorderTree(weights=name).build(boundary)


def test_weights_of_other_features_are_an_error(tmp_path):
    learned, key = LearnedTree().model()
    path = tmp_path / "weights.json"
    few = {name: value for name, value in learned.items() if name != "rim"}
    for number, (content, message) in enumerate(
        (
            (few, "has no weight of the feature 'rim'"),
            ({**learned, "seen": 1.0}, "has a weight of the feature 'seen'"),
            ({**learned, "bias": "1"}, "the weight of 'bias' is '1', expected a finite number"),
            ([1.0], "is no mapping"),
        )
    ):
        path = tmp_path / f"{number}.json"
        path.write_text(json.dumps(content))
        with pytest.raises(InputError, match=message):
            LearnedTree(weights=str(path)).model()
    with pytest.raises(InputError, match="has no weight of the feature"):
        BorderTree(weights=write_network(tmp_path / "bare", {})).model()
    path.write_text(json.dumps({**learned, "bias": -11.0}))
    assert LearnedTree(weights=str(path)).weights_key != key
    assert set(learned) == set(PAIR_FEATURES)

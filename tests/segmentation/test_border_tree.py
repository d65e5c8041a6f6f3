"""The evidence of a border network in the tree; what a network sees is given, or a network has random weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mstfilter.errors import InputError
from mstfilter.scene import render
from mstfilter.segmentation import (
    EVIDENCE_FEATURES,
    PAIR_FEATURES,
    BorderTree,
    ColourDepthBoundary,
    LearnedTree,
    SeenBorders,
    UcmTree,
    evidence_features,
)
from mstfilter.segmentation.border_network import BORDER_ARCHITECTURE, IMAGE_CHANNELS, BorderNet
from mstfilter.segmentation.regions import BORDER, measure_regions
from mstfilter.trained import write_model
from tests.segmentation.scenes import GRID, TOUCHING, camera, frame_of

NAMES = [*PAIR_FEATURES, *EVIDENCE_FEATURES]


def write_network(folder, evidence: dict[str, float]) -> str:
    torch.manual_seed(0)
    net = BorderNet(8)
    torch.nn.init.normal_(net.head.weight, std=0.5)
    description = {
        "architecture": BORDER_ARCHITECTURE,
        "network": {"channels": list(IMAGE_CHANNELS), "width": 8},
        "calibration": {"scale": 1.0, "shift": 0.0},
        "evidence": {"features": list(evidence), "weights": list(evidence.values())},
    }
    write_model(folder, description, {name: t.numpy() for name, t in net.state_dict().items()})
    return str(folder)


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
    leaves = np.unique(blocks, return_inverse=True)[1].reshape(truth.shape)
    regions = measure_regions(leaves, frame, boundary, seen)
    object_of = np.zeros(len(regions.sums), np.int64)
    object_of[regions.of_leaf[leaves]] = truth
    found = {True: [], False: []}
    for i in range(1, len(regions.sums)):
        for j, border in regions.borders[i].items():
            if j > i and min(object_of[i], object_of[j]) > 0:
                x = evidence_features(regions.sums[[i]], regions.sums[[j]], border[None], 0.5)[0]
                found[bool(object_of[i] != object_of[j])].append(x)
                turned = evidence_features(regions.sums[[j]], regions.sums[[i]], regions.borders[j][i][None], 0.5)[0]
                assert np.allclose(x, turned)
    seen_by, gap = EVIDENCE_FEATURES.index("seen"), EVIDENCE_FEATURES.index("centre gap")
    different, same = np.array(found[True]), np.array(found[False])
    assert len(different) > 3 and len(same) > 10
    assert np.allclose(different[:, seen_by], 6) and np.median(same[:, seen_by]) < -4
    assert different[:, gap].min() > 1 and np.allclose(same[:, gap], 0, atol=1e-3)


def test_without_a_network_nothing_is_seen():
    frame = frame_of(TOUCHING)
    _, regions = LearnedTree().regions(ColourDepthBoundary().boundary(frame), frame)
    rows = [row for near in regions.borders for row in near.values()]
    assert not np.array(rows)[:, BORDER["seen"]].any()


def test_weights_of_zero_for_the_evidence_give_the_learned_tree(tmp_path):
    from mstfilter.segmentation.join_weights import JOIN_WEIGHTS

    name = write_network(tmp_path / "plain", {**JOIN_WEIGHTS, **dict.fromkeys(EVIDENCE_FEATURES, 0.0)})
    frame = frame_of(TOUCHING, noise=0.4)
    boundary = ColourDepthBoundary().boundary(frame)
    leaves = UcmTree(max_leaves=100)
    one, other = BorderTree(leaves, name).build(boundary, frame), LearnedTree(leaves).build(boundary, frame)
    assert np.array_equal(one.parent, other.parent) and np.allclose(one.odds, other.odds)
    used = write_network(tmp_path / "used", {**JOIN_WEIGHTS, **dict.fromkeys(EVIDENCE_FEATURES, 0.5)})
    assert not np.allclose(BorderTree(leaves, used).build(boundary, frame).odds[-9:], one.odds[-9:])
    with pytest.raises(InputError, match="no weights of the features"):
        BorderTree(weights=write_network(tmp_path / "bare", {})).build(boundary, frame)
    with pytest.raises(InputError, match="needs the frame"):
        BorderTree(weights=name).build(boundary)

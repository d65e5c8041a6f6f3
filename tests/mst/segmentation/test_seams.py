"""Ways to divide a region, what is measured of them, and the tree that contains the divisions."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from mstfilter.base.errors import InputError
from mstfilter.base.trained import write_model
from mstfilter.mst.segmentation import ColourDepthBoundary, MergeLogOdds, SeamTree, SeenBorders, optimal_cut
from mstfilter.mst.segmentation.divisions import Division, SeamImage, TreePart, divisions
from mstfilter.mst.segmentation.pair_measures import FEATURES, pair_features
from mstfilter.mst.segmentation.regions import measure_regions
from mstfilter.mst.segmentation.seam_measures import SEAM_FEATURES, STRIP, STRIP_CHANNELS, SeamMeasures
from mstfilter.mst.segmentation.seam_network import INPUTS, SEAM_ARCHITECTURE, SeamNet
from mstfilter.mst.segmentation.seams import BaseTree, SharedPrior, _Examination, _Judged
from mstfilter.scene import Camera, Frame, look_at, pixels_above_table, render
from tests.mst.segmentation.scenes import GRID, boxes, camera, frame_of

ROW = boxes(((20, 20, 0), (32, 34, 10)), ((32, 20, 0), (46, 34, 10)))


def blind(frame):
    """The output of a border network that sees nothing."""
    h, w = frame.depth.shape
    return SeenBorders(
        np.full((h, w), -4.0, np.float32), np.zeros((h, w), np.float32), np.zeros((h, w, 2), np.float32)
    )


@pytest.fixture(scope="module")
def touching():
    """Two boxes in line, of one colour: frame, image of the seams, flat pixels, true object of each pixel."""
    frame = frame_of(ROW, width=320, noise=0.3)
    frame = Frame(np.where(frame.rgb == frame.rgb[0, 0], frame.rgb, 90).astype(np.uint8), frame.depth, frame.camera)
    truth = render(ROW, GRID, camera(320)).labels
    pixels = np.flatnonzero(pixels_above_table(frame) & (truth > 0))
    boundary = ColourDepthBoundary().boundary(frame)
    return frame, SeamImage.of(frame, boundary, blind(frame)), pixels, truth.ravel()[pixels]


def agreement(side, truth):
    """Share of the pixels on the right side, for the better of both ways to name the sides."""
    right = float(np.mean(side == (truth == truth[0])))
    return max(right, 1 - right)


def test_planes_contain_the_true_division(touching):
    _, image, pixels, truth = touching
    found = divisions(image, pixels)
    assert max(agreement(one.side, truth) for one in found) > 0.97
    for one in found:
        assert min(one.side.sum(), (~one.side).sum()) >= 0.04 * len(pixels)
        assert np.isclose(np.linalg.norm(one.normal), 1.0)
    for k, one in enumerate(found):  # no division occurs twice, in whatever order its sides are
        for other in found[:k]:
            assert 0.02 < np.mean(one.side == other.side) < 0.98


def test_parts_of_a_tree_come_first_and_once(touching):
    _, image, pixels, truth = touching
    own = truth == 1
    found = divisions(image, pixels, [TreePart(side, 1.5) for side in (own, ~own, np.zeros(len(pixels), bool))])
    assert found[0].kind == "tree" and (found[0].side == own).all()
    assert [one.kind for one in found].count("tree") == 1
    assert (found[0].overlap, found[0].odds) == (1.0, 1.5)
    alone = divisions(image, pixels)
    assert all((one.overlap, one.odds) == (0.0, -8.0) for one in alone)


def test_features_of_the_sides_are_those_of_measured_regions(touching):
    frame, image, pixels, truth = touching
    objects = np.zeros(frame.depth.shape, bool)
    objects.ravel()[pixels] = True
    found = divisions(image, pixels, [TreePart(truth == 1, 1.5)])
    x, strips = SeamMeasures.of(image, objects).describe(pixels, found)
    assert x.shape == (len(found), len(INPUTS)) and np.isfinite(x).all()
    assert strips.shape == (len(found), len(STRIP_CHANNELS), *STRIP)
    for k in (0, len(found) - 1):
        regions = np.zeros(frame.depth.shape, np.int64)
        regions.ravel()[pixels] = 1 + found[k].side
        whole = measure_regions(regions, frame, image.boundary, image.seen)
        a, b = whole.sums[[2]], whole.sums[[1]]
        none = np.zeros((1, 8))
        expected = pair_features(a, b, whole.borders[2][1][None], none, none, 0.5, FEATURES)
        assert np.allclose(x[k, : len(FEATURES)], expected[0], rtol=1e-4, atol=1e-4)


def test_strips_follow_the_seam(touching):
    frame, image, pixels, truth = touching
    objects = np.zeros(frame.depth.shape, bool)
    objects.ravel()[pixels] = True
    found = divisions(image, pixels, [TreePart(truth == 1, 1.5)])
    _, strips = SeamMeasures.of(image, objects).describe(pixels, found[:1])
    first, second = (strips[0, k].astype(float) - 128 for k in (0, 1))
    left, right = np.s_[16:48, :11], np.s_[16:48, 13:]
    assert first[left].mean() > 5 * first[right].mean() and second[right].mean() > 5 * second[left].mean()


def pair_of_boxes(turn: float, noise: float) -> tuple[Frame, np.ndarray]:
    """A frame of two boxes, side by side, the second one turned by so many degrees, and the objects (H, W)."""
    view = Camera.from_intrinsics(525, 525, 319.5, 239.5, 640, 480, look_at((0.25, -0.75, 0.4), (0.0, 0.0, 0.05)))
    rays = view.rays() @ view.pose.rotation.as_matrix().T
    depth = np.where(rays[..., 2] < -0.1, -view.position[2] / np.minimum(rays[..., 2], -0.1), 3.0)  # of the table
    labels = np.zeros(depth.shape, int)
    for k, (x, angle) in enumerate(((-0.05, 0.0), (0.05, turn)), start=1):
        to_box = Rotation.from_euler("z", -angle, degrees=True).as_matrix()
        start, along = to_box @ (view.position - (x, 0.0, 0.06)), rays @ to_box.T
        near, far = (((side * np.array([0.047, 0.03, 0.06]) - start) / along) for side in (-1, 1))
        enter, leave = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
        hit = (enter < leave) & (enter < depth)
        depth, labels = np.where(hit, enter, depth), np.where(hit, k, labels)
    readings = depth + np.random.default_rng(0).normal(0.0, noise, depth.shape) * depth**2
    return Frame(np.zeros((*depth.shape, 3), np.uint8), readings.astype(np.float32), view), labels


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_the_turn_of_faces_is_measured(noise):
    """To a degree, also with the noise of a depth camera."""
    for turn in (0.0, 3.0, 8.0):
        frame, labels = pair_of_boxes(turn, noise)
        image = SeamImage.of(frame, ColourDepthBoundary().boundary(frame), blind(frame))
        pixels = np.flatnonzero(labels > 0)
        measures = SeamMeasures.of(image, labels > 0)
        x, _ = measures.describe(pixels, [Division(labels.ravel()[pixels] == 1, "tree", np.zeros(3), 0.0, 0.0, 0.0)])
        found = dict(zip(SEAM_FEATURES, x[0, len(FEATURES) :], strict=True))
        assert found["turn"] == pytest.approx(turn, abs=0.5 if not noise else 1.0)
        assert found["flat faces"] > 0.5 and found["face pixels"] > 6


def write_judge(folder, bias):
    """An untrained judge whose scores are about `bias`."""
    torch.manual_seed(0)
    net = SeamNet(8)
    torch.nn.init.zeros_(net.head[-1].weight)
    torch.nn.init.constant_(net.head[-1].bias, bias)
    described = {
        "architecture": SEAM_ARCHITECTURE,
        "network": {"channels": [*INPUTS, *STRIP_CHANNELS], "width": 8},
        "calibration": {"scale": 1.0, "shift": 0.0},
    }
    write_model(folder, described, {name: t.numpy() for name, t in net.state_dict().items()})
    return str(folder)


@pytest.fixture(scope="module")
def judges(tmp_path_factory):
    folder = tmp_path_factory.mktemp("judges")
    return {bias: write_judge(folder / f"judge{k}", bias) for k, bias in enumerate((-20.0, -2.0, 5.0))}


def test_a_sure_judge_keeps_the_regions_of_the_base_tree(touching, judges):
    frame, image, _, _ = touching
    builder = SeamTree(weights=judges[-20.0])
    tree, base = builder.build(image.boundary, frame), builder.base.build(image.boundary, frame)
    cuts = [one.label_image(optimal_cut(one, MergeLogOdds().values(one, frame))) for one in (tree, base)]
    pixels = pixels_above_table(frame)
    pairs = np.unique(np.stack([cut[pixels] for cut in cuts]), axis=1)
    assert len(np.unique(pairs[0])) == len(np.unique(pairs[1])) == pairs.shape[1]


def test_odds_of_a_division_are_those_of_the_judge_and_the_prior(touching, judges):
    frame, image, _, _ = touching
    shares = (0.5, 0.8)
    known = {"weights": judges[-2.0], "prior_size": 1e5}
    trees = [SeamTree(one_share=share, **known).build(image.boundary, frame) for share in shares]
    inner = [tree.odds[tree.n_leaves :] for tree in trees]
    odds = [found[found > -4.9] for found in inner]
    for share, found in zip(shares, odds, strict=True):
        n = np.exp(found[found < 2] + 2.0) * share / (1 - share)  # of n divisions with the score -2
        assert len(n) > 1 and np.allclose(n, np.rint(n), atol=0.05) and n.min() > 0.9


def test_regions_share_their_prior():
    """By enumeration: regions are one or several, their share is a grid, and the readings have known likelihoods."""
    log_odds, mean, size = np.array([1.0, -2.0, 0.5, -0.3]), 0.7, 3.0
    prior = SharedPrior.of(log_odds, mean, size)
    grid = (np.arange(4000) + 0.5) / 4000
    density = grid ** (size * mean - 1) * (1 - grid) ** (size * (1 - mean) - 1)
    joint = {}
    for states in itertools.product((0, 1), repeat=4):  # 1: several
        p = np.prod([np.exp(l * s) for l, s in zip(log_odds, states, strict=True)])
        joint[states] = p * np.mean(density * grid ** (4 - sum(states)) * (1 - grid) ** sum(states))
    total = sum(joint.values())
    for k, value in enumerate(log_odds):
        several = sum(p for states, p in joint.items() if states[k]) / total
        assert prior.log_odds(value) == pytest.approx(np.log(several / (1 - several)), abs=0.01)
    fixed = SharedPrior.of(log_odds, mean, 1e5)
    assert fixed.log_odds(1.0) == pytest.approx(1.0 - np.log(0.7 / 0.3), abs=0.02)
    alone = SharedPrior.of(np.zeros(0), mean, size)
    assert alone.log_odds(0.0) == pytest.approx(-np.log(0.7 / 0.3), abs=0.01)
    assert np.isfinite(alone.log_odds(-np.inf)) and np.isfinite(alone.log_odds(1e4))


def test_both_sides_of_the_true_seam_are_nodes(touching, judges, monkeypatch):
    frame, image, pixels, truth = touching
    label = np.zeros(frame.depth.size, int)
    label[pixels] = truth

    def knowing(self, pixels, parts, below):
        """The judge that knows the objects: even odds where there are two."""
        if min(np.bincount(label[pixels], minlength=3)[1:]) < 0.1 * len(pixels):
            return _Judged(-20.0, None)
        found = divisions(image, pixels, parts)
        return _Judged(0.0, max(found, key=lambda one: agreement(one.side, label[pixels])).side)

    monkeypatch.setattr(_Examination, "_judged", knowing)
    built = SeamTree(weights=judges[5.0]).build(image.boundary, frame)
    masks = [built.mask(node).ravel()[pixels] for node in range(built.n_nodes)]
    for true in (truth == 1, truth == 2, truth > 0):
        assert max((mask & true).sum() / (mask | true).sum() for mask in masks) > 0.93


@given(st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_nodes_of_a_base_tree_cover_its_regions(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 12))
    alive, merges = list(range(1, n)), []
    while len(alive) > 2:
        a, b = (alive.pop(int(rng.integers(len(alive)))) for _ in range(2))
        merges.append((a, b, float(rng.normal(0, 5))))
        alive.append(n + len(merges) - 1)
    base = BaseTree(np.arange(n)[None], n, merges)
    masks = [base.regions_of(node) for node in base.uncertain()]
    assert (np.sum(masks, axis=0) == np.append(0, np.ones(n - 1))).all()  # each region once, the table never
    for node in base.uncertain():
        assert all((part.side <= base.regions_of(node)).all() for part in base.parts(node))


def test_a_tree_needs_a_frame(judges):
    with pytest.raises(InputError, match="SeamTree needs the frame"):
        SeamTree(weights=judges[5.0]).build(np.zeros((4, 4), np.float32))


def test_seam_features_have_names():
    assert len(set(INPUTS)) == len(INPUTS) == len(FEATURES) + len(SEAM_FEATURES)

"""From an image to hypotheses, on rendered scenes with known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mstfilter.mst.completion import SurfaceOnly
from mstfilter.mst.segmentation.boundary import ColourDepthBoundary
from mstfilter.mst.segmentation.cuts import MergeLogOdds, OptimalCut, SceneCutObjectness, optimal_cut
from mstfilter.mst.segmentation.learned_tree import LearnedTree
from mstfilter.mst.segmentation.mh import MetropolisHastingsCuts
from mstfilter.mst.segmentation.proposal import ObjectRule, TreeCutProposal, _core
from mstfilter.mst.segmentation.tree import UcmTree
from mstfilter.scene import Camera, Frame, render
from mstfilter.scoring import weighted_coverage
from tests.mst.segmentation.scenes import GRID, TOUCHING, TWO, clip_of, frame_of
from tests.mst.segmentation.trees import random_tree


def seen(labels: np.ndarray, frame: Frame) -> np.ndarray:
    return render(labels, GRID, frame.camera).labels


@pytest.mark.parametrize("scene", [TWO, TOUCHING])
@pytest.mark.parametrize("width", [320, 640])
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_the_optimal_cut_finds_boxes(scene, width, noise):
    frame = frame_of(scene, width=width, noise=noise)
    labels = TreeCutProposal().label_image(frame)
    assert len(np.unique(labels)) - 1 == 2
    assert weighted_coverage(labels, seen(scene, frame)) > 0.85


@pytest.mark.parametrize("holes", ["lattice", "random"])
def test_depth_may_have_holes_everywhere(holes):
    """A quarter of the readings: every second pixel in both directions, or drawn."""
    frame = frame_of(TWO, width=640, noise=0.3)
    kept = np.zeros(frame.depth.shape, bool)
    kept[::2, ::2] = True
    if holes == "random":
        kept = np.random.default_rng(0).random(kept.shape) < 0.3
    sparse = Frame(frame.rgb, np.where(kept, frame.depth, np.nan), frame.camera)
    proposal = TreeCutProposal(tree=LearnedTree(), sampler=OptimalCut())
    assert len(np.unique(proposal.label_image(sparse))) - 1 == 2


def test_depth_alone_separates_touching_boxes_of_one_colour():
    frame = frame_of(TOUCHING, width=640, noise=0.3)
    grey = Frame(np.full_like(frame.rgb, 128), frame.depth, frame.camera)
    assert weighted_coverage(TreeCutProposal().label_image(grey), seen(TOUCHING, frame)) > 0.85


def test_a_frame_without_pose_finds_the_table():
    frame = frame_of(TWO, noise=0.2)
    camera = Camera(frame.camera.K, frame.camera.width, frame.camera.height)
    labels = TreeCutProposal().label_image(Frame(frame.rgb, frame.depth, camera))
    assert weighted_coverage(labels, seen(TWO, frame)) > 0.85


def test_depth_holes_and_robot():
    frame = frame_of(TWO, noise=0.2)
    depth = frame.depth.copy()
    depth[::7, ::5] = np.nan
    robot = np.zeros(depth.shape, bool)
    robot[:60, 150:170] = True
    holed = Frame(frame.rgb, depth, frame.camera, robot)
    boundary = ColourDepthBoundary().boundary(holed)
    assert np.isfinite(boundary).all()
    assert boundary.min() >= 0
    assert boundary.max() <= 1
    assert (boundary[2:57, 153:167] == 0).all()  # inside the robot
    assert (boundary[5:55, 150] == 1).all()  # its rim
    labels = TreeCutProposal().label_image(holed)
    assert not labels[robot].any()
    assert labels[np.isnan(depth) & (seen(TWO, frame) > 0)].any()  # holes inside objects belong to them
    truth = np.where(robot, 0, seen(TWO, frame))
    assert weighted_coverage(labels, truth) > 0.85


@pytest.mark.parametrize("depth", [np.nan, 1.0])
def test_no_depth_or_no_relief(depth):
    """Boundaries are finite without any reading."""
    frame = frame_of(TWO)
    flat = Frame(frame.rgb, np.full(frame.depth.shape, depth, np.float32), frame.camera)
    assert np.isfinite(ColourDepthBoundary().boundary(flat)).all()


def test_sample():
    clip = clip_of(TOUCHING, noise=0.3)
    proposal = TreeCutProposal()
    population = proposal.sample(np.random.default_rng(0), clip, 12)
    again = proposal.sample(np.random.default_rng(0), clip, 12)
    assert len(population) == 12
    assert not proposal.properly_weighted
    assert (population.log_weights == 0).all()
    for a, b in zip(population.particles, again.particles, strict=True):
        assert (a.labels == b.labels).all()
        assert a.grid == clip.grid
        assert all(o.birth == 0 and o.id == o.label and o.completion_key for o in a.objects)
    optimal = replace(proposal, sampler=replace(proposal.sampler, include_optimal=True))
    best = optimal.sample(np.random.default_rng(0), clip, 3).particles[0]
    shown = render(best.labels, GRID, clip.after.camera).labels
    assert weighted_coverage(shown, seen(TOUCHING, clip.after)) > 0.75


def test_each_object_shows_in_its_own_mask():
    clip = clip_of(TWO, noise=0.3)
    proposal = TreeCutProposal(sampler=OptimalCut())
    hypothesis = proposal.sample(np.random.default_rng(0), clip, 1).particles[0]
    image = proposal.label_image(clip.after)
    shown = render(hypothesis.labels, GRID, clip.after.camera).labels
    for k, segment in enumerate(np.unique(image)[1:], start=1):
        assert (shown[image == segment] == k).mean() > 0.9


@pytest.mark.parametrize(
    ("tree", "value"),
    [
        (UcmTree(), SceneCutObjectness()),
        (LearnedTree(), MergeLogOdds()),
    ],
)
@pytest.mark.parametrize("rule", ["equal", "p"])
def test_components_are_interchangeable(tree, value, rule):
    sampler = MetropolisHastingsCuts(0.25, 0, 20, "authors", restart=True, include_optimal=True, redraw_repeated=True)
    proposal = TreeCutProposal(tree=tree, value=value, sampler=sampler, completer=SurfaceOnly(), weight_rule=rule)
    population = proposal.sample(np.random.default_rng(0), clip_of(TOUCHING, width=640, noise=0.6), 5)
    assert population.log_weights[0] == 0
    assert (population.log_weights <= 0).all()
    assert (population.log_weights[1:] < 0).any() == (rule == "p")


def test_an_empty_table_gives_hypotheses_without_objects():
    clip = clip_of(np.zeros(GRID.shape, np.uint16), noise=0.3)
    population = TreeCutProposal().sample(np.random.default_rng(0), clip, 4)
    assert [h.n_objects for h in population.particles] == [0] * 4


def test_core_matches_erosion():
    """The one-pass count of interior pixels against eroding every node's mask by itself."""
    import cv2

    rng = np.random.default_rng(4)
    tree = random_tree(rng, 12)
    blocks = np.kron(rng.permutation(12).reshape(3, 4), np.ones((9, 8), np.int64))
    tree = type(tree)(tree.parent, blocks, tree.start)
    own = np.ones(blocks.shape, bool)
    own[10:16, 5:30] = False
    core = _core(tree, own, 2)
    for node in range(tree.n_nodes):
        mask = (tree.mask(node) & own).astype(np.uint8)
        # outside the image counts as inside the node, so that objects cut by the frame keep their core
        grown = cv2.erode(np.pad(mask, 2, mode="edge"), np.ones((5, 5), np.uint8), borderValue=1)[2:-2, 2:-2]
        inside = cv2.erode(own.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0)
        assert core[node] == (grown & inside).sum()


def test_object_rule_scales_with_the_image():
    for width in (160, 320, 640):
        frame = frame_of(TWO, width=width)
        tree, w = TreeCutProposal().tree_of(frame)
        found = ObjectRule().segments(tree, frame, GRID)
        assert found.is_object[optimal_cut(tree, w)].sum() == 2

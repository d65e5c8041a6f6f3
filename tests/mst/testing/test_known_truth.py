"""The contracts compare components of scenes with clips whose motions are known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from mstfilter.mst.segmentation import BoundaryModel, ColourDepthBoundary
from mstfilter.mst.testing import check_of, run_contract
from mstfilter.mst.testing.scenes import known_motions
from mstfilter.mst.tracking import (
    IDENTITY,
    Candidate,
    MaskTracker,
    MotionRule,
    MstRule,
    Registration,
    SmallGicp,
    TrackingTransition,
)
from mstfilter.scene import FreeSpace, Hypothesis, Projection
from mstfilter.smc import Population, Proposal, Similarity, Transition
from tests.mst.testing import run_property

MOVING = Candidate("mine", RigidTransform.from_translation([0.04, 0.0, 0.0]), score=1.0)


@dataclass(frozen=True)
class Follows(MotionRule):
    """Knows the motion of each box in the two clips, and returns a change of it."""

    change: object = field(default=lambda T, centre: T)
    worst: bool = False

    def candidates(self, rng, track):
        known = next(one for one in known_motions() if one.clip is track.clip)
        moving = track.points[:, 0].mean() < 0
        T = known.motions[1] if moving else RigidTransform.identity()
        mine = Candidate("mine", self.change(T, track.points.mean(axis=0)), score=1.0 if moving else 3.0)
        return replace(IDENTITY, score=2.0), mine

    def choose(self, rng, candidates):
        return (max if self.worst else min)(candidates, key=lambda c: c.score)


def about_the_origin(T, centre):
    """The rotation is about the origin of the world, and the translation is that of the object."""
    return RigidTransform.from_components(T.apply(centre) - centre, T.rotation)


RULES = {
    "backwards": (Follows(lambda T, centre: T.inv()), "ends 8.0 cm from its place"),
    "another origin": (Follows(about_the_origin), "a rotation about c is"),
    "worst candidate": (Follows(worst=True), "lower scores are better"),
    "millimetres": (
        Follows(lambda T, centre: RigidTransform.from_translation(T.translation / 1000)),
        "is the unit metres",
    ),
}


@pytest.mark.parametrize("name", RULES)
def test_wrong_motions_are_reported(name):
    rule, words = RULES[name]
    with pytest.raises(AssertionError, match=words):
        run_property(rule, "motions_are_those_of_the_objects")


def test_right_rules_pass():
    for rule in (Follows(), MstRule(), MstRule(select="sample")):
        run_property(rule, "motions_are_those_of_the_objects")


def test_transitions_that_move_backwards_are_reported():
    with pytest.raises(AssertionError, match=r"moves by -1\.00 of the push"):
        run_scenes(TrackingTransition(rule=Follows(lambda T, centre: T.inv())), "objects_move_as_they_are_seen_to")
    run_scenes(TrackingTransition(rule=Follows()), "objects_move_as_they_are_seen_to")


def run_scenes(component, name):
    """Run one test of the contract that `run_contract` chooses."""
    check = check_of(component)
    assert "scene" in check.input
    methods = {"make": staticmethod(lambda: component), "example": staticmethod(check.example)}
    getattr(type("Contract", (check.contract,), methods)(), f"test_{name}")()


@dataclass(frozen=True)
class SceneMoves(Transition):
    """Moves the hypothesis at each place by a function ``(hypothesis, place)``."""

    change: object
    properly_weighted = False

    def predict(self, generator, moving, clip):
        return moving.moved(tuple(self.change(h, k) for k, h in enumerate(moving.particles)))


def test_identities_and_places_of_hypotheses():
    with pytest.raises(AssertionError, match="with_labels"):
        run_scenes(
            SceneMoves(lambda h, k: Hypothesis.from_labels(h.labels, h.grid, birth=7)), "objects_keep_their_identity"
        )
    with pytest.raises(AssertionError, match="number 1 moves differently than number 0"):
        run_scenes(
            SceneMoves(lambda h, k: h.with_labels(np.roll(h.labels, k % 2, 0))), "places_of_hypotheses_are_irrelevant"
        )
    run_scenes(SceneMoves(lambda h, k: h.with_labels(h.labels)), "places_of_hypotheses_are_irrelevant")


@dataclass(frozen=True)
class OneBlob(Proposal):
    """All voxels with readings of an image of the clip are one object."""

    first: bool = False
    turned: bool = False
    properly_weighted = False

    def sample(self, rng, clip, n):
        frame, grid = (clip.before if self.first else clip.after), clip.grid
        index = grid.index_of(frame.points[frame.valid & (frame.points[..., 2] > 0.005)])
        labels = np.zeros(grid.shape, np.uint16)
        labels[tuple(index[grid.contains(index)].T)] = 1
        labels = labels.transpose(1, 0, 2) if self.turned else labels
        return Population((Hypothesis.from_labels(labels, grid, birth=clip.index),) * n)


def test_scene_components_are_tested_with_scenes_without_being_told():
    for component in (OneBlob(), SceneMoves(lambda h, k: h.with_labels(h.labels)), TrackingTransition()):
        assert "scene" in check_of(component).input
    assert [r.failure for r in run_contract(OneBlob()) if r.failure] == []
    for component, words in ((OneBlob(first=True), "before the push"), (OneBlob(turned=True), "x and y")):
        with pytest.raises(AssertionError, match=words):
            run_scenes(component, "hypotheses_are_about_the_last_image")


class SourceForTarget(Registration):
    def register(self, source, target, init, reach):
        found = SmallGicp().register(source, target, init, reach)
        return None if found is None else replace(found, T=np.linalg.inv(found.T))


class Inverted(BoundaryModel):
    def boundary(self, frame):
        return 1 - ColourDepthBoundary().boundary(frame)


class Elsewhere(MaskTracker):
    def track(self, clip, masks):
        return [np.roll(mask, -10, axis=1) for mask in masks]


class ClearsAll(Projection):
    def project(self, hypothesis, frame):
        return hypothesis.with_labels(np.zeros_like(hypothesis.labels)), 0.0


@pytest.mark.parametrize(
    ("component", "name", "words", "right"),
    [
        (SourceForTarget(), "motion_is_from_source_to_target", "T moves the source to the target", SmallGicp()),
        (Inverted(), "boundaries_are_between_objects", "1 is a boundary", ColourDepthBoundary()),
        (Elsewhere(), "masks_follow_the_objects", "if it stays", None),
        (ClearsAll(), "right_hypotheses_stay", "keeps 0.00", FreeSpace()),
    ],
)
def test_stages_that_contradict_a_known_clip_are_reported(component, name, words, right):
    with pytest.raises(AssertionError, match=words):
        run_property(component, name)
    if right is not None:
        run_property(right, name)


@dataclass(frozen=True)
class LabelNumbers(Similarity):
    def matrix(self, particles):
        labels = np.stack([h.labels.ravel() for h in particles])
        return (labels[:, None] == labels).mean(axis=2)


def test_similarities_do_not_compare_label_numbers():
    with pytest.raises(AssertionError, match="have no meaning"):
        run_scenes(LabelNumbers(), "numbers_of_labels_are_irrelevant")

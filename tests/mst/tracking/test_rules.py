import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mstfilter.mst.tracking import rigid, rules
from mstfilter.mst.tracking.flow import DenseFlow
from mstfilter.mst.tracking.rules import IDENTITY, AuthorsRule, Candidate, MstRule, PaperRule
from mstfilter.mst.tracking.segments import Track, segments_of
from tests.mst.tracking.scenes import Box, Scene, at, errors, slide


def track_of(scene, clip, label=1):
    return Track(segments_of(scene.hypothesis(), clip.before)[label], clip, DenseFlow().track(clip))


@pytest.fixture(scope="module")
def printed_box():
    """A well textured box near the camera's centre that moves 5 cm and 8 degrees."""
    poses = slide(at(-0.03, 0, 0.04), at(0.02, 0.01, 0.04, 8), 4)
    scene = Scene([Box((0.16, 0.14, 0.08), texture=0.7)], [[p] for p in poses], (480, 360))
    return scene, scene.clip(0)


def test_paper_rule_accepts_sift_with_enough_inliers(printed_box):
    scene, clip = printed_box
    rng = np.random.default_rng(0)
    track = track_of(scene, clip)
    rule = PaperRule()
    chosen = rule.choose(rng, rule.candidates(rng, track))
    assert chosen.kind == "sift" and chosen.support > 5
    mm, deg = errors(chosen.T, scene.motions()[1], track.points.mean(axis=0))
    assert mm < 4 and deg < 3


def test_the_published_limit_of_1_mm_is_below_the_noise(printed_box, plain):
    """As printed ICP is not accepted, and without texture everything becomes the identity."""
    rng = np.random.default_rng(0)
    scene, clip = plain
    for label in (1, 2, 5):
        rule = PaperRule()
        assert [c.kind for c in rule.candidates(rng, track_of(scene, clip, label))] == ["identity"]
        loose = PaperRule(max_error=0.02)
        assert loose.candidates(rng, track_of(scene, clip, label))[0].kind == "icp"


def test_authors_rule_uses_clusters_with_the_stated_probability():
    """Binomial checks; each bound is 4.4 standard deviations, false alarm below 1e-4 in all."""
    n = 4000
    icp = Candidate("icp", IDENTITY.T, 100)
    for support, p in ((3, 0.1), (6, 0.35), (9, 0.65), (30, 0.9)):
        cluster = Candidate("sift", IDENTITY.T, support)
        rng = np.random.default_rng(support)
        used = sum(AuthorsRule().choose(rng, (cluster, icp, IDENTITY)) is cluster for _ in range(n))
        assert abs(used - n * p) < 4.4 * np.sqrt(n * p * (1 - p))


def test_authors_rule_draws_clusters_by_size():
    """A cluster of 36 among 48 is drawn with probability .75 and used with .9. False alarm below 1.1e-5."""
    a, b = Candidate("sift", IDENTITY.T, 36), Candidate("sift", IDENTITY.T, 12)
    rng, n, p = np.random.default_rng(1), 4000, 0.75 * 0.9
    drawn = sum(AuthorsRule().choose(rng, (a, b, IDENTITY)) is a for _ in range(n))
    assert abs(drawn - n * p) < 4.4 * np.sqrt(n * p * (1 - p))


def test_authors_rule_falls_back_to_icp_then_identity():
    rng = np.random.default_rng(2)
    icp = Candidate("icp", IDENTITY.T, 100)
    assert AuthorsRule().choose(rng, (icp, IDENTITY)) is icp
    assert AuthorsRule().choose(rng, (IDENTITY,)) is IDENTITY


@pytest.mark.parametrize("kind", ["textured", "plain"])
def test_mst_rule_finds_the_motion_of_boxes(kind, request):
    scene, clip = request.getfixturevalue(kind)
    rule, rng = MstRule(), np.random.default_rng(0)
    for label in (1, 5):
        track = track_of(scene, clip, label)
        chosen = rule.choose(rng, rule.candidates(rng, track))
        mm, deg = errors(chosen.T, scene.motions()[label], track.points.mean(axis=0))
        assert mm < (3 if kind == "textured" else 9) and deg < 2


def test_mst_rule_finds_the_position_of_a_cylinder(textured, plain):
    for scene, clip in (textured, plain):
        track, truth = track_of(scene, clip, 2), scene.motions()[2]
        rule, rng = MstRule(), np.random.default_rng(0)
        chosen = rule.choose(rng, rule.candidates(rng, track))
        axis = np.append(scene.poses[0][1][:3, 3], 1.0)
        assert np.linalg.norm((chosen.T.as_matrix() @ axis - truth @ axis)[:3]) < 0.008


def test_mst_rule_prefers_rest_by_the_margin():
    rest, better, best = (Candidate(k, IDENTITY.T, 0, s) for k, s in (("identity", 0.85), ("icp", 0.9), ("icp", 0.8)))
    rng = np.random.default_rng(0)
    assert MstRule().choose(rng, (rest, better)) is rest
    assert MstRule().choose(rng, (rest, best)) is best
    nothing = Candidate("identity", IDENTITY.T, 0, np.inf)
    assert MstRule().choose(rng, (nothing,)).kind == "identity"


def test_sampling_follows_the_scores():
    a, b = Candidate("identity", IDENTITY.T, 0, 1.0), Candidate("icp", IDENTITY.T, 0, 1.2)
    rule, rng, n = MstRule(select="sample", n_eff=10.0), np.random.default_rng(3), 4000
    p = 1 / (1 + np.exp(-0.5 * 10 * 0.2))
    drawn = sum(rule.choose(rng, (a, b)) is a for _ in range(n))
    assert abs(drawn - n * p) < 4.4 * np.sqrt(n * p * (1 - p))
    impossible = Candidate("icp", IDENTITY.T, 0, np.inf)
    assert MstRule(select="sample", n_eff=0.0).choose(rng, (impossible, a)) is a


def test_candidates_with_large_shift_or_rotation_are_rejected(printed_box, monkeypatch):
    scene, clip = printed_box
    rng = np.random.default_rng(0)
    centre = track_of(scene, clip).points.mean(axis=0)
    monkeypatch.setattr(rules, "_MAX_SHIFT", 0.005)
    assert len(MstRule().candidates(rng, track_of(scene, clip))) < 3
    monkeypatch.setattr(rules, "_MAX_SHIFT", 0.02)
    monkeypatch.setattr(rules, "_MAX_ANGLE", 0.05)
    for c in MstRule().candidates(rng, track_of(scene, clip)):
        assert rigid.displacement(c.T.as_matrix(), centre) <= 0.02 and rigid.angle(c.T.as_matrix()) <= 0.05


def test_an_object_that_flow_lost_is_searched_for():
    """Two frames, a jump of 12 cm: no flow can follow, the look of the box can."""
    scene = Scene([Box((0.1, 0.08, 0.07), (170, 80, 60))], [[at(-0.06, 0, 0.035)], [at(0.06, 0.0, 0.035, 8)]])
    clip = scene.clip(0)
    track = track_of(scene, clip)
    rng = np.random.default_rng(0)
    rule = MstRule(use_flow=False, use_icp=False, use_sift=False)
    chosen = rule.choose(rng, rule.candidates(rng, track))
    assert chosen.kind == "search"
    assert errors(chosen.T, scene.motions()[1], track.points.mean(axis=0))[0] < 5
    never = MstRule(use_flow=False, use_icp=False, use_sift=False, search_above=-1.0)
    assert [c.kind for c in never.candidates(rng, track)] == ["identity"]


def test_an_object_that_was_taken_away_does_not_move_into_others():
    """Nothing looks like it, and nothing hides it: the search would find the least bad place."""
    boxes = [Box((0.06, 0.06, 0.05), (170, 80, 60)), Box((0.1, 0.08, 0.03), (60, 150, 60), seed=1)]
    scene = Scene(boxes, [[at(-0.08, 0, 0.025), at(0.06, 0, 0.015)], [at(-2, 0, 0.025), at(0.06, 0, 0.015)]])
    track, rng = track_of(scene, scene.clip(0)), np.random.default_rng(0)
    [rest] = MstRule().candidates(rng, track)
    assert rest.kind == "identity" and rest.score > 10, "resting is bad, too"
    never = MstRule(max_score=np.inf)
    assert never.choose(rng, never.candidates(rng, track)).kind == "search"


def test_a_box_that_toppled_between_two_frames_is_found():
    """A quarter turn about a horizontal edge. No estimator can follow the box, its colours and its faces can."""
    fallen = at(0.0, 0.03, 0.035, 10)
    fallen[:3, :3] = fallen[:3, :3] @ Rotation.from_euler("x", -90, degrees=True).as_matrix()
    scene = Scene([Box((0.1, 0.07, 0.15), texture=0.9)], [[at(0.0, 0.0, 0.075, 10)], [fallen]], (480, 360))
    track, rng = track_of(scene, scene.clip(0)), np.random.default_rng(0)
    rule = MstRule(use_flow=False, use_icp=False, use_sift=False)
    chosen = rule.choose(rng, rule.candidates(rng, track))
    mm, deg = errors(chosen.T, scene.motions()[1], track.points.mean(axis=0))
    assert mm < 5 and deg < 3


def test_a_place_that_is_seen_wins_against_a_place_behind_another_object():
    """The box moves behind a low wall, half of it hidden. Behind the high wall nothing of it would be seen."""
    boxes = [
        Box((0.08, 0.05, 0.09), texture=0.6),
        Box((0.2, 0.02, 0.05), (60, 150, 60)),
        Box((0.2, 0.02, 0.2), seed=3),
    ]
    walls = [at(-0.15, -0.05, 0.025), at(0.12, -0.02, 0.1)]
    poses = [[T, *walls] for T in slide(at(0.0, -0.12, 0.045), at(-0.15, 0.02, 0.045, 15), 12)]
    scene = Scene(boxes, poses, (480, 360))
    track, truth = track_of(scene, scene.clip(0)), scene.motions()[1]
    behind = at(0.12, 0.1, 0.0) @ at(0.0, 0.12, 0.0)
    residual = rules.MotionResidual()
    assert residual.score(track, truth) < residual.score(track, behind) - 1.0

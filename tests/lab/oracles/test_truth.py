"""Stages replaced by the truth: binding, results, and random streams of the other stages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from mstfilter.base.errors import InputError
from mstfilter.lab.oracles import (
    TrueBoundary,
    TrueCompletion,
    TrueFreeSpace,
    TrueMasks,
    TrueMotions,
    TruePairs,
    TrueQuality,
    bind_truth,
    front_end,
    uses_truth,
)
from mstfilter.lab.oracles.truth import RecordingTruth
from mstfilter.mst.partition import Cells, Choices, Readings
from mstfilter.mst.segmentation import ColourDepthBoundary
from mstfilter.runs import filter_recording
from mstfilter.runs.presets import build_filter, describe_filter, load_config
from mstfilter.scene import Hypothesis, Occupancy, component_key
from mstfilter.scoring import weighted_coverage
from mstfilter.smc import Key, LargestWeights, Population
from tests.lab.baselines.scenes import slide

ALL = (
    'proposal={component="true_masks", completer="surface"}',
    "transition=true_motions",
    'update={component="partition", completer="true_completion", pairs="true_pairs", free_space="true_free_space", '
    'evidence=["true_quality"]}',
    "resampler=largest_weights",
)
RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return slide(tmp_path_factory.mktemp("oracles") / "slide")


# Binding


def test_all_nested_components_are_bound_and_nothing_else_changes(recording):
    filter = build_filter(load_config("mst", ALL))
    names = ["TrueMotions", "TrueMasks", "TrueCompletion", "TrueFreeSpace", "TruePairs", "TrueQuality"]
    assert uses_truth(filter) == names
    ready = bind_truth(filter, recording)
    assert ready == filter
    assert describe_filter(ready) == describe_filter(filter)
    for part in (
        ready.transition,
        ready.proposal,
        ready.update.completer,
        ready.update.pairs,
        ready.update.free_space,
        ready.update.evidence[0],
    ):
        assert part.truth.recording is recording
    with pytest.raises(InputError, match="is bound to no recording"):
        filter.transition.truth  # noqa: B018 (the unbound one stays unbound)
    plain = build_filter(load_config("mst"))
    assert bind_truth(plain, recording) is plain


@pytest.mark.parametrize(
    "lacking, override, says",
    [
        ("poses", "transition=true_motions", "TrueMotions uses the truth, and .* has no true poses at pause 0"),
        ("instance", "proposal=true_masks", "TrueMasks uses the truth, and .* has no instance image at pause 0"),
        (
            "truth",
            'update.evidence=["true_quality"]',
            "TrueQuality uses the truth, and .* has no true voxels at pause 0",
        ),
        ("truth", "update.free_space=true_free_space", "TrueFreeSpace uses the truth"),
    ],
)
def test_a_recording_without_truth_is_an_error_before_anything_is_written(
    recording, tmp_path, lacking, override, says
):
    blind = replace(recording, **{lacking: lambda index: None})
    with pytest.raises(InputError, match=says):
        filter_recording(blind, load_config("mst", [override]), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_frame_of_another_recording_is_an_error(recording, tmp_path):
    other = slide(tmp_path / "other", (5, 6, 7))
    with pytest.raises(InputError, match="is none of the 3 pauses"):
        bind_truth(TrueBoundary(), recording).boundary(other.frames[0])


# Streams


@pytest.mark.parametrize("make", [TrueMasks, TrueMotions])
def test_oracles_do_not_advance_their_generator(recording, make):
    """They draw from child streams only."""
    component, clip = bind_truth(make(), recording), recording.clips()[1]
    rng = Key(0).child("step", 1, "x").generator()
    before = rng.bit_generator.state
    truth = Hypothesis.from_labels(recording.truth(0), recording.grid)
    population = Population((truth, truth))
    if isinstance(component, TrueMasks):
        component.sample(rng, clip, 2)
    else:
        component.predict(rng, population, clip)
    assert rng.bit_generator.state == before


# All together


def test_with_every_stage_true_visible_objects_are_exact(recording):
    filter = bind_truth(build_filter(load_config("mst", ALL)), recording)
    state = filter.start(0)
    for clip in recording.clips():
        state, _ = filter.step(state, clip)
        for hypothesis in state.population.particles:
            assert weighted_coverage(hypothesis.labels, recording.truth(clip.index)) >= 0.97


def test_a_hidden_object_follows_its_true_motion(tmp_path):
    """Box 2 is not visible in the last images; its remembered volume follows its true motion."""
    made = slide(tmp_path / "r")
    last = len(made.frames) - 1
    blind = replace(
        made, instance=lambda index: np.where(made.instance(index) == 2, 0, made.instance(index))
        if index == last else made.instance(index)
    )  # fmt: skip
    filter = bind_truth(build_filter(load_config("mst", ALL)), blind)
    state = filter.start(0)
    for clip in blind.clips():
        state, _ = filter.step(state, clip)
    for hypothesis in state.population.particles:
        best = max((hypothesis.mask(o.label) & (made.truth(2) == 2)).sum() for o in hypothesis.objects)
        assert best / (made.truth(2) == 2).sum() > 0.88


# Masks, boundary, completion


def test_true_masks_are_the_instance_image_where_the_sensor_sees(recording, monkeypatch):
    proposal, clip = bind_truth(TrueMasks(), recording), recording.clips()[0]
    masks = proposal.masks(clip.after, clip)
    instance = recording.instance(0)
    assert set(np.unique(masks)) == {0, 1, 2}
    assert (masks[masks > 0] == instance[masks > 0]).all()
    assert (masks > 0).sum() > 0.8 * (instance > 0).sum()
    population = proposal.sample(RNG, clip, 3)
    assert len({h.key for h in population.particles}) == 1
    assert population.particles[0].n_objects == 2
    assert proposal.masks(clip.after, clip) is not None
    monkeypatch.setattr(front_end, "MIN_PIXELS", 1e9)
    assert proposal.sample(RNG, clip, 1).particles[0].n_objects == 0


def test_the_robot_is_not_an_object(recording):
    """255 in an instance image stands for the robot; it has no true voxels."""

    def with_robot(index):
        image = recording.instance(index).copy()
        image[:20] = 255
        return image

    truth = RecordingTruth(replace(recording, instance=with_robot))
    assert set(np.unique(truth.instance(0))) == {0, 1, 2}


def test_a_true_boundary_is_the_measured_one_near_true_borders(recording):
    frame, image = recording.frames[0], recording.instance(0)
    border = np.zeros(image.shape, bool)  # both sides of every border
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        border[a] |= image[a] != image[b]
        border[b] |= image[a] != image[b]
    model = TrueBoundary(ColourDepthBoundary(quiet_table=-1))
    found, measured = bind_truth(model, recording).boundary(frame), model.measured.boundary(frame)
    np.testing.assert_array_equal(found[border], measured[border])
    far = distance_transform_edt(~border) > 3
    assert (measured[far] > 0).any() and not found[far].any()


def test_true_completion_gives_a_mask_what_it_shows(recording):
    completer, frame, grid = bind_truth(TrueCompletion(), recording), recording.frames[0], recording.grid
    true, image = recording.truth(0), recording.instance(0)

    def voxels(mask):
        one = completer.complete(RNG, frame, [mask], grid)[0]
        out = np.zeros(grid.shape, bool)
        out[one.box] = one.probability >= 0.5
        return out

    whole = voxels(image == 1)
    np.testing.assert_array_equal(whole, true == 1)  # the hidden side too
    left = image == 1
    left[:, : int(np.nonzero(left)[1].mean())] = False
    parts = voxels(left), voxels((image == 1) & ~left)
    assert not (parts[0] & parts[1]).any()
    np.testing.assert_array_equal(parts[0] | parts[1], true == 1)
    assert 0.2 < parts[0].sum() / whole.sum() < 0.8
    np.testing.assert_array_equal(voxels(image > 0), true > 0)
    table = np.zeros(image.shape, bool)
    table[-15:, 40:120] = True
    assert not (voxels(table & (image == 0)) & (true > 0)).any()


# Motions


def test_objects_move_as_the_true_object_in_them(recording):
    clip, transition = recording.clips()[1], bind_truth(TrueMotions(), recording)
    before, after = recording.truth(0), recording.truth(1)
    labels = np.where(before == 1, 5, np.where(before == 2, 9, 0)).astype(np.uint16)
    labels[2:4, 2:4, 2:4] = 3  # an object that is not there
    labels[15:17][labels[15:17] == 5] = 7  # the rear of box 1, where nothing is afterwards
    moved = transition.predict(RNG, Population((Hypothesis.from_labels(labels, recording.grid),)), clip)
    found = moved.particles[0].labels
    np.testing.assert_array_equal((found == 5) | (found == 7), after == 1)  # two voxels to the right, exactly
    assert (found == 7)[17:19].sum() == (found == 7).sum() > 0
    np.testing.assert_array_equal(found == 9, after == 2)
    np.testing.assert_array_equal(found == 3, labels == 3)
    assert moved.notes["motions"] == {"true": 2, "rest": 1, "no object": 1}
    first = recording.clips()[0]
    same = transition.predict(RNG, moved, first)
    assert same.particles[0] is moved.particles[0]


# Free space, fusion, selection


def test_true_free_space_clears_what_is_free_and_seen(recording):
    true = recording.truth(0)
    labels = true.copy()
    labels[:, :, 20:25] = 3  # in the air
    labels[true > 0] = true[true > 0]
    hypothesis = Hypothesis.from_labels(labels, recording.grid)
    frame = recording.frames[0]
    seen, share = bind_truth(TrueFreeSpace(), recording).project(hypothesis, frame)
    assert (seen.labels[true > 0] == true[true > 0]).all()  # nothing true is lost at any border
    assert (seen.labels == 3).sum() < 0.5 * (labels == 3).sum()
    assert share == pytest.approx((seen.labels != 0).sum() / (labels != 0).sum()) and share < 1
    shadow = true * 0  # right behind the upper half of box 1
    shadow[18:22, 35, 6:10] = 4
    kept, share = bind_truth(TrueFreeSpace(), recording).project(
        Hypothesis.from_labels(shadow, recording.grid), frame
    )
    assert (kept.labels == shadow).all() and share == 1
    # Probabilities of voxels that are no label are cleared too.
    exact = Hypothesis.from_labels(true, recording.grid)
    air = (labels == 3) & (seen.labels == 0)
    unsure = replace(exact, occupancy=Occupancy(np.where(air, 3, true), np.where(air, 0.4, true > 0)))
    kept, share = bind_truth(TrueFreeSpace(), recording).project(unsure, frame)
    assert not kept.shares.probability[air].any() and share == 1
    assert bind_truth(TrueFreeSpace(), recording).project(exact, frame) == (exact, 1.0)


def test_true_pairs_choose_what_agrees_with_the_truth(recording):
    """Cells of one true object belong together, all others do not; an alternative that agrees has probability 1."""
    clip, true = recording.clips()[1], recording.instance(recording.pauses[1])
    pixels = np.flatnonzero(true.ravel() > 0)
    owner = true.ravel()[pixels].astype(np.int64)
    column = pixels % true.shape[1]
    half = np.where(owner == 1, np.where(column > np.median(column[owner == 1]), 1, 3), owner)
    readings = Readings(pixels, np.zeros((len(pixels), 3), int), true.shape)
    cells = Cells.of(readings, [half, np.ones_like(owner)], [owner])
    odds = bind_truth(TruePairs(), recording).log_odds(cells, np.ones(1), clip)
    label = np.array([np.bincount(owner[cells.of_reading == c]).argmax() for c in range(cells.samples.shape[1])])
    same = label[cells.pairs[:, 0]] == label[cells.pairs[:, 1]]
    assert same.any() and (odds[same] > 100).all() and (odds[~same] < -100).all()
    choices = Choices.of(cells, np.zeros(1), [odds], 5)
    best = choices.partitions[choices.log_weights.argmax()]
    assert choices.log_weights.max() > np.log(0.99)
    np.testing.assert_array_equal(best[:, None] == best[None], label[:, None] == label[None])


def test_choice_and_selection_prefer_true_quality(recording):
    true, grid, clip = recording.truth(1), recording.grid, recording.clips()[1]
    worse = true.copy()
    worse[worse == 2] = 0
    blob = (true > 0).astype(np.uint16)
    hypotheses = tuple(Hypothesis.from_labels(x, grid) for x in (blob, true, worse, blob))
    score = bind_truth(TrueQuality(), recording).log_score(hypotheses, clip)
    assert score.argmax() == 1
    np.testing.assert_allclose(score / 1e4, [weighted_coverage(h.labels, true) for h in hypotheses])
    population = Population(hypotheses, np.log([1.0, 1e-9, 2.0, 1.0]))
    chosen = LargestWeights().resample(RNG, population.reweighted(score), 2)
    order = np.argsort(-score, kind="stable")
    assert chosen.parents["ancestor"].tolist() == order[:2].tolist()


def test_component_key_depends_on_the_truth(tmp_path):
    first, second = slide(tmp_path / "a"), slide(tmp_path / "b")
    second = replace(second, truth=lambda t: first.truth(t) * 2)
    keys = {component_key(bind_truth(TrueBoundary(), r)) for r in (first, second)} | {component_key(TrueBoundary())}
    assert len(keys) == 3
    assert component_key(bind_truth(TrueBoundary(), first)) in keys

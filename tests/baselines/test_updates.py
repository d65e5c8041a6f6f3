"""Baselines: controls of the protocol, and what each update keeps of predictions and samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mstfilter.baselines.updates import SamplesOnly, TrackingOnly, Union
from mstfilter.fusion import Division, Evidence, FreeSpace, FusionUpdate, NoFreeSpace
from mstfilter.presets import build_filter, load_config
from mstfilter.scene import Hypothesis
from mstfilter.scoring import weighted_coverage
from mstfilter.smc import Population
from mstfilter.smc.testing import UpdateContract
from mstfilter.testing import scene_example
from tests.baselines.scenes import ProposalRecorder, slide


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return slide(tmp_path_factory.mktemp("baselines") / "slide")


def run(name, recording, seed=3, *overrides):
    filter, populations = build_filter(load_config(name, overrides)), []
    state = filter.start(seed)
    for clip in recording.clips():
        state, _ = filter.step(state, clip)
        populations.append(state.population)
    return populations


@pytest.fixture(scope="module")
def rules(recording):
    return run("mst_rules", recording, 3, "proposal.completer=network")


def keys(population):
    return [h.key for h in population.particles]


@pytest.mark.parametrize("name", ["samples_only", "tracking_only", "union"])
def test_at_the_first_pause_filter_and_baselines_tie_exactly(recording, rules, name):
    population = run(name, recording)[0]
    assert keys(population) == keys(rules[0])
    np.testing.assert_array_equal(population.log_weights, rules[0].log_weights)


def test_at_the_first_pause_mst_has_its_samples(recording):
    """Those of `samples_only` with as many samples and the same selection, up to the borders of segments."""
    mst = run("mst", recording)[0]
    samples = run("samples_only", recording, 3, "n_proposed=30", "resampler=systematic")[0]
    for a, b in zip(mst.particles, samples.particles, strict=True):
        assert a.n_objects == b.n_objects and weighted_coverage(a.labels, b.labels) > 0.95


def test_another_seed_breaks_the_tie(recording):
    sampler = "proposal.sampler.temperature=8"  # so that samples differ at all on so plain a scene
    assert keys(run("samples_only", recording, 3, sampler)[0]) != keys(run("samples_only", recording, 4, sampler)[0])


def test_samples_are_those_that_the_filter_draws_at_the_same_pause(recording):
    """The proposal's stream is the same in both arms at every pause."""
    seen = {}
    for name in ("mst_rules", "samples_only"):
        filter = build_filter(load_config(name, ["proposal.sampler.temperature=8", "proposal.completer=network"]))
        recorder = ProposalRecorder(filter.proposal)
        replace(filter, proposal=recorder).run(recording.clips(), seed=5)
        seen[name] = recorder.drawn
    assert len(seen["mst_rules"]) == len(recording.clips())
    assert seen["mst_rules"] == seen["samples_only"]


def test_the_single_frame_baseline_is_the_optimal_cut_and_knows_no_past(recording):
    from mstfilter.scene import project

    populations = run("single_frame", recording)
    filter = build_filter(load_config("mst"))
    for population, clip in zip(populations, recording.clips(), strict=True):
        assert len(population) == 5 and len(set(keys(population))) == 1
        image = project(population.particles[0], clip.after.camera)
        optimal = filter.proposal.label_image(clip.after)
        inside = optimal > 0
        assert len(np.unique(optimal[inside])) == population.particles[0].n_objects
        assert (image[inside] > 0).mean() > 0.9
    alone = run("single_frame", recording, 99)
    assert keys(alone[2]) == keys(populations[2])  # nothing is drawn


def test_tracking_only_follows_the_objects_of_the_first_pause(recording):
    populations = run("tracking_only", recording)
    first = {o.id for h in populations[0].particles for o in h.objects}
    for population in populations[1:]:
        assert {o.id for h in population.particles for o in h.objects} <= first
        assert all(o.birth == 0 for h in population.particles for o in h.objects)
    assert keys(populations[2]) != keys(populations[0])  # box 1 moved


def two(rng=None):
    population, clip = scene_example(np.random.default_rng(0), 4)
    predicted = Population(population.particles[:2], np.log([0.2, 0.6]), {"previous": np.arange(2)})
    proposed = Population(population.particles[1:], np.zeros(3), {"proposed": np.arange(3)})
    return predicted, proposed, clip


def test_refinement_of_tracked_objects_is_a_field():
    predicted, _, clip = two()
    floating = predicted.particles[0].labels.copy()
    floating[2:4, 2:4, 6:] = 7
    predicted = Population((Hypothesis.from_labels(floating, clip.grid),))
    rng = np.random.default_rng(0)
    assert keys(TrackingOnly(NoFreeSpace()).update(rng, predicted, None, clip)) == keys(predicted)
    cleared = TrackingOnly(FreeSpace()).update(rng, predicted, None, clip)
    assert not (cleared.particles[0].labels == 7).any()
    assert cleared.notes["quality"][0] < 1


def test_a_union_holds_both_populations_weighted_as_fusion_weighs():
    predicted, proposed, clip = two()
    rng = np.random.default_rng(0)
    fusion = FusionUpdate(quality_exponent=2.0, free_space=FreeSpace())
    both = Union(fusion).update(rng, predicted, proposed, clip)
    assert len(both) == 5
    refined = [fusion.free_space.project(h, clip.after) for h in predicted.particles]
    assert keys(both) == [h.key for h, _ in refined] + keys(proposed)
    q = np.array([q for _, q in refined])
    np.testing.assert_allclose(both.log_weights, np.log([0.5 * q[0] ** 2, 1.5 * q[1] ** 2, 1, 1, 1]), atol=1e-12)
    assert both.parents["previous"].tolist() == [0, 1, -1, -1, -1]
    assert both.parents["proposed"].tolist() == [-1, -1, 0, 1, 2]

    class Objects(Evidence):
        def log_score(self, hypotheses, clip):
            return np.array([float(h.n_objects) for h in hypotheses])

    judged = Union(FusionUpdate(quality_exponent=2.0, evidence=(Objects(),))).update(rng, predicted, proposed, clip)
    n = np.array([h.n_objects for h in both.particles])
    np.testing.assert_allclose(judged.log_weights - both.log_weights, n)


def test_a_union_takes_apart_what_fusion_takes_apart():
    """All of fusion but its crossover: the left and the right half of the image are said to be different things."""

    class Halves(Division):
        def divide(self, clip):
            motions = np.zeros(clip.after.depth.shape, np.int32)
            motions[:, motions.shape[1] // 2 :] = 1
            return motions

    predicted, proposed, clip = two()
    merged = np.where(predicted.particles[0].labels > 0, 1, 0).astype(np.uint16)
    predicted = Population((Hypothesis.from_labels(merged, clip.grid),))
    rng = np.random.default_rng(0)
    plain = Union(FusionUpdate()).update(rng, predicted, proposed, clip)
    parted = Union(FusionUpdate(division=Halves())).update(rng, predicted, proposed, clip)
    assert plain.particles[0].n_objects == 1
    assert parted.particles[0].n_objects == 2
    assert len(parted) == len(plain)


@pytest.mark.parametrize("update", [FusionUpdate(), SamplesOnly(), Union()])
def test_with_an_empty_prediction_the_samples_come_back(update):
    """Hypotheses without objects know nothing: fusion of them with samples is the samples."""
    _, proposed, clip = two()
    empty = Hypothesis(np.zeros(clip.grid.shape, np.uint16), clip.grid)
    predicted = Population((empty, empty), parents={"previous": np.arange(2)})
    fused = update.update(np.random.default_rng(0), predicted, proposed, clip)
    found = {h.key for h in fused.particles if h.n_objects}
    assert found == set(keys(proposed))
    for h in fused.particles:
        if h.n_objects:
            assert any(h is p for p in proposed.particles)


class TestTrackingOnly(UpdateContract):
    def make(self):
        return TrackingOnly()

    def example(self, rng, n):
        return scene_example(rng, n)


class TestUnion(UpdateContract):
    def make(self):
        return Union()

    def example(self, rng, n):
        return scene_example(rng, n)


class TestSamplesOnly(UpdateContract):
    def make(self):
        return SamplesOnly()

    def example(self, rng, n):
        return scene_example(rng, n)

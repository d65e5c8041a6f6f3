"""Baselines: controls of the protocol, and what each update keeps of predictions and samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mstfilter.lab.baselines import SamplesOnly, TrackingOnly, Union
from mstfilter.mst.crossover import CrossoverUpdate
from mstfilter.mst.testing import scene_example
from mstfilter.runs.presets import build_filter, load_config
from mstfilter.scene import FreeSpace, Hypothesis, NoFreeSpace
from mstfilter.scoring import weighted_coverage
from mstfilter.smc import Population
from mstfilter.smc.testing import UpdateContract
from tests.lab.baselines.scenes import ProposalRecorder, slide


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return slide(tmp_path_factory.mktemp("baselines") / "slide")


def run(name, recording, seed=3, *overrides, pauses=None):
    """The populations after the first pauses."""
    filter = build_filter(load_config(name, overrides))
    return [state.population for state, _ in filter.iterate(recording.clips()[:pauses], seed)]


def keys(population):
    return [h.key for h in population.particles]


def test_at_the_first_pause_filter_and_baselines_tie_exactly(recording):
    """The baselines exactly; `mst`, which completes in its update, up to the borders of segments."""
    rules = run("mst_rules", recording, 3, "proposal.tree=border", "proposal.completer=network", pauses=1)[0]
    for population in (run(name, recording, pauses=1)[0] for name in ("samples_only", "tracking_only", "union")):
        assert keys(population) == keys(rules)
        np.testing.assert_array_equal(population.log_weights, rules.log_weights)
    for a, b in zip(run("mst", recording, pauses=1)[0].particles, rules.particles, strict=True):
        assert a.n_objects == b.n_objects and weighted_coverage(a.labels, b.labels) > 0.95


def test_another_seed_breaks_the_tie(recording):
    sampler = "proposal.sampler.temperature=8"  # otherwise samples are equal on such a plain scene
    a, b = (run("samples_only", recording, seed, sampler, pauses=1)[0] for seed in (3, 4))
    assert keys(a) != keys(b)


def test_samples_are_those_that_the_filter_draws_at_the_same_pause(recording):
    """The proposal's stream is the same in both arms at every pause."""
    seen, overrides = {}, ["proposal.sampler.temperature=8", "proposal.completer=network", "n_proposed=4"]
    overrides += ["proposal.tree=learned"]
    for name in ("mst_rules", "samples_only"):
        filter = build_filter(load_config(name, overrides))
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


def test_a_union_holds_both_populations_weighted_as_the_crossover_weighs():
    predicted, proposed, clip = two()
    rng = np.random.default_rng(0)
    both = Union(quality_exponent=2.0).update(rng, predicted, proposed, clip)
    assert len(both) == 5
    refined = [FreeSpace().project(h, clip.after) for h in predicted.particles]
    assert keys(both) == [h.key for h, _ in refined] + keys(proposed)
    q = np.array([q for _, q in refined])
    np.testing.assert_allclose(both.log_weights, np.log([0.5 * q[0] ** 2, 1.5 * q[1] ** 2, 1, 1, 1]), atol=1e-12)
    assert both.parents["previous"].tolist() == [0, 1, -1, -1, -1]
    assert both.parents["proposed"].tolist() == [-1, -1, 0, 1, 2]
    alone = Union(quality_exponent=2.0).update(rng, predicted, None, clip)
    np.testing.assert_allclose(alone.log_weights, both.log_weights[:2])


@pytest.mark.parametrize("update", [CrossoverUpdate(), SamplesOnly(), Union()])
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
            assert any(h.labels is p.labels and h.occupancy is p.occupancy for p in proposed.particles)


class OnScenes(UpdateContract):
    def example(self, rng, n):
        return scene_example(rng, n)


class TestTrackingOnly(OnScenes):
    def make(self):
        return TrackingOnly()


class TestUnion(OnScenes):
    def make(self):
        return Union()


class TestSamplesOnly(OnScenes):
    def make(self):
        return SamplesOnly()


del OnScenes  # not a test by itself

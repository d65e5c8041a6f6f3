"""Free space as a separate update, for any particle with labels on a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mstfilter.errors import InputError
from mstfilter.fusion.free_space import FreeSpace, NoFreeSpace, ProjectionUpdate
from mstfilter.fusion.update import FusionUpdate
from mstfilter.presets import REGISTRY
from mstfilter.scene import Clip, Frame, Hypothesis, VoxelGrid
from mstfilter.smc import ParticleFilter, Population, ProjectOnto, Proposal, Transition
from mstfilter.smc.testing import UpdateContract
from mstfilter.testing import scene_example
from tests.scene.scenes import CAMERA, GRID, table_scene

RGB, DEPTH, LABELS = table_scene()
CLIP = Clip((Frame(RGB, DEPTH, CAMERA),), GRID, 0)


@dataclass(frozen=True)
class Occupancy:
    """A particle of another class: occupancy and a name."""

    labels: np.ndarray
    grid: VoxelGrid
    name: str


class TestProjectionUpdate(UpdateContract):
    def make(self):
        return ProjectionUpdate()

    def example(self, rng, n):
        return scene_example(rng, n)


def test_it_is_fusion_without_a_proposal():
    predicted, clip = scene_example(np.random.default_rng(1), 6)
    for exponent in (0.0, 3.0):
        mine = ProjectionUpdate(quality_exponent=exponent).update(None, predicted, None, clip)
        fused = FusionUpdate(quality_exponent=exponent).update(np.random.default_rng(0), predicted, None, clip)
        np.testing.assert_array_equal(mine.log_weights, fused.log_weights)
        assert [h.key for h in mine.particles] == [h.key for h in fused.particles]
        assert mine.notes["quality"] == fused.notes["quality"]
    assert min(mine.notes["quality"]) < 1


def test_the_manifold_update_for_vectors_takes_the_same_projection():
    predicted, clip = scene_example(np.random.default_rng(1), 6)
    onto = ProjectOnto(lambda particles, y: FreeSpace().refine(particles, y)[0])
    found = onto.update(None, predicted, None, clip)
    mine = ProjectionUpdate(quality_exponent=0.0).update(None, predicted, None, clip)
    assert [h.key for h in found.particles] == [h.key for h in mine.particles]


def test_other_particles_in_a_filter_without_a_proposal():
    """Shifted copies of the scene: voxels in free space are cleared, and the best shift gets the largest weight."""

    @dataclass(frozen=True)
    class Guesses(Proposal):
        def sample(self, rng, observation, n):
            shifts = rng.integers(-12, 13, n)
            return Population(tuple(Occupancy(np.roll(LABELS > 0, k, axis=0), GRID, str(k)) for k in shifts))

    @dataclass(frozen=True)
    class Jitter(Transition):
        def predict(self, rng, population, observation):
            return population.moved(
                tuple(Occupancy(np.roll(o.labels, rng.integers(2), 1), o.grid, o.name) for o in population.particles)
            )

    filter = ParticleFilter(initial=Guesses(), transition=Jitter(), update=ProjectionUpdate(), n=30)
    state, infos = filter.run([CLIP] * 3, seed=0)
    assert state.log_evidence is None
    free = FreeSpace().known_free(CLIP.after, GRID)
    for particle in state.population.particles:
        assert isinstance(particle, Occupancy)
        assert particle.labels.dtype == bool
        assert not (particle.labels & free).any()
    first = [abs(int(o.name)) for o in filter.step(filter.start(0), CLIP)[0].population.particles]
    last = [abs(int(o.name)) for o in state.population.particles]
    assert np.mean(last) < 0.5 * np.mean(first)
    assert min(infos[0].notes["update"]["quality"]) < 0.9


def test_proposed_particles_join_and_are_projected():
    predicted, clip = scene_example(np.random.default_rng(0), 2)
    proposed, _ = scene_example(np.random.default_rng(1), 3)
    predicted = predicted.labelled({"previous": np.arange(2)})
    both = ProjectionUpdate().update(None, predicted, proposed.labelled({"proposed": np.arange(3)}), clip)
    assert both.parents["previous"].tolist() == [0, 1, -1, -1, -1]
    assert both.parents["proposed"].tolist() == [-1, -1, 0, 1, 2]
    free = FreeSpace().known_free(clip.after, clip.grid)
    assert not any((h.labels[free] > 0).any() for h in both.particles)


def test_a_particle_that_loses_all_keeps_a_weight():
    nowhere = np.zeros(GRID.shape, np.uint16)
    nowhere[30, 5, 20] = 1
    lost = Population((Hypothesis.from_labels(nowhere, GRID),))
    found = ProjectionUpdate(quality_exponent=2.0).update(None, lost, None, CLIP)
    assert found.notes["quality"] == [0.0]
    assert found.log_weights[0] == pytest.approx(2 * np.log(1e-3))


def test_it_is_built_by_name_and_checks_its_fields():
    built = REGISTRY.build("update", {"component": "projection", "free_space": "none", "quality_exponent": 1.0})
    assert built == ProjectionUpdate(NoFreeSpace(), 1.0)
    with pytest.raises(InputError, match="quality_exponent"):
        ProjectionUpdate(quality_exponent=-1.0)
    with pytest.raises(InputError, match="Projection"):
        ProjectionUpdate(free_space="projective")

    class Loose:
        labels, grid = np.ones(GRID.shape, bool), GRID

    with pytest.raises(InputError, match="a particle is a Loose"):
        ProjectionUpdate().update(None, Population((Loose(),)), None, CLIP)

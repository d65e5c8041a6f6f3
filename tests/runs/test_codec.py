"""Hypotheses in checkpoints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.runs.run_folder import HypothesisCodec
from mstfilter.scene import Hypothesis
from mstfilter.smc import ParticleFilter, Population, Proposal, Transition
from tests.scene.scenes import GRID, table_scene


@dataclass(frozen=True)
class Scenes(Proposal):
    def sample(self, rng, observation, n):
        noise = np.random.default_rng(0)
        return Population(tuple(Hypothesis.from_labels(table_scene(k, noise)[2], GRID) for k in range(n)))


@dataclass(frozen=True)
class Relabel(Transition):
    """Gives every object a label that was drawn, so that the run depends on its stream."""

    def predict(self, rng, population, observation):
        moved = []
        for h in population.particles:
            old = np.array(sorted(h.volumes()))
            table = np.zeros(int(h.labels.max()) + 1, np.uint16)
            table[old] = rng.permutation(np.arange(1, len(old) + 1))
            moved.append(Hypothesis.from_labels(table[h.labels], GRID))
        return Population(tuple(moved), population.log_weights + rng.normal(size=len(moved)))


def test_a_run_of_hypotheses_resumes_from_its_checkpoint(tmp_path):
    filter = ParticleFilter(initial=Scenes(), transition=Relabel(), n=3)
    whole, _ = filter.run(range(4), 1)
    filter.run(range(2), 1, checkpoint=tmp_path / "c.npz", codec=HypothesisCodec())
    state, infos = filter.run(range(4), 1, checkpoint=tmp_path / "c.npz", codec=HypothesisCodec())
    assert [i.t for i in infos] == [2, 3]
    np.testing.assert_array_equal(state.population.log_weights, whole.population.log_weights)
    for a, b in zip(state.population.particles, whole.population.particles, strict=True):
        np.testing.assert_array_equal(a.labels, b.labels)
        assert [o.id for o in a.objects] == [o.id for o in b.objects]

"""Scored candidates: the two stages have the law they should."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from mstfilter.belief import Agreement
from mstfilter.crossover import CrossoverUpdate
from mstfilter.presets import build_filter, load_config
from mstfilter.scene import Clip, Evidence, Frame, Hypothesis, NoFreeSpace, VoxelGrid
from mstfilter.smc import Population
from tests.scene.scenes import CAMERA, GRID, table_scene


def frames(shifts):
    noise = np.random.default_rng(0)
    return tuple(Frame(*table_scene(shift, noise)[:2], CAMERA) for shift in shifts)


@dataclass(frozen=True)
class Size(Evidence):
    """Prefers hypotheses by their number of voxels."""

    def log_score(self, hypotheses, clip):
        return np.array([float(sum(h.volumes().values())) for h in hypotheses]) / 10


def test_two_stages_give_pair_weight_times_score():
    """Drawn by pair weight, weighted by score alone: chi-square over pairs, false alarm 1e-6."""
    grid = VoxelGrid((0, 0, 0), 0.01, (6, 2, 2))
    predicted, proposed = [], []
    for k in range(2):
        labels = np.zeros(grid.shape, np.uint16)
        labels[k] = 1
        predicted.append(Hypothesis.from_labels(labels, grid))
        labels = np.zeros(grid.shape, np.uint16)
        labels[3, :, : k + 1] = 1
        proposed.append(Hypothesis.from_labels(labels, grid, 1))
    a = Population(tuple(predicted), np.log([0.2, 0.8]), {"previous": np.arange(2)})
    b = Population(tuple(proposed), np.log([0.7, 0.3]), {"proposed": np.arange(2)})
    clip = Clip(frames((0,)), grid, 1)
    update = CrossoverUpdate(NoFreeSpace(), eta=3, evidence=(Size(),), n_scored=8)
    total = np.zeros((2, 2))
    for seed in range(800):
        fused = update.update(np.random.default_rng(10_000 + seed), a, b, clip)
        assert len(fused) == 8
        size = np.array([sum(h.volumes().values()) for h in fused.particles])
        assert np.ptp(fused.log_weights - size / 10) < 1e-12
        assert fused.notes["scores"]["Size"] == (size / 10).round(3).tolist()
        k = np.random.default_rng(seed).integers(8)  # any place among the drawn ones
        total[fused.parents["previous"][k], fused.parents["proposed"][k]] += 1
    expected = 800 * np.outer([0.2, 0.8], [0.7, 0.3])
    assert stats.chi2.sf(((total - expected) ** 2 / expected).sum(), 3) > 1e-6

    twice = CrossoverUpdate(NoFreeSpace(), eta=3, evidence=(Size(), Size()), n_scored=8)
    fused = twice.update(np.random.default_rng(0), a, b, clip)
    size = np.array([sum(h.volumes().values()) for h in fused.particles])
    assert np.ptp(fused.log_weights - 2 * size / 10) < 1e-12  # two terms of a kind both count
    assert len(fused.notes["scores"]) == 2


def test_terms_are_named_in_presets():
    filter = build_filter(load_config("mst_rules", ['update.evidence=["agreement"]', "update.n_scored=12"]))
    assert [type(e) for e in filter.update.evidence] == [Agreement]
    clips = [Clip(frames((0,)), GRID, 0), Clip(frames((0, 1, 2)), GRID, 1)]
    _, infos = filter.run(clips, seed=0)
    assert infos[1].n_candidates == 12
    scores = infos[1].notes["update"]["scores"]
    assert set(scores) == {"Agreement"} and len(scores["Agreement"]) == 12
    with pytest.raises(Exception, match="there is no evidence 'smell'"):
        build_filter(load_config("mst", ['update.evidence=["smell"]']))

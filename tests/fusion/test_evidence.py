"""Scored candidates: the two terms know right from wrong, and the two stages have the law they should."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from mstfilter.fusion.free_space import NoFreeSpace
from mstfilter.fusion.update import FusionUpdate
from mstfilter.presets import build_filter, load_config
from mstfilter.scene import Clip, Evidence, Frame, Hypothesis, VoxelGrid
from mstfilter.segmentation import BoundaryAgreement
from mstfilter.smc import Population
from mstfilter.tracking import MotionAgreement
from tests.scene.scenes import CAMERA, GRID, table_scene
from tests.tracking.scenes import standard


def frames(shifts):
    noise = np.random.default_rng(0)
    return tuple(Frame(*table_scene(shift, noise)[:2], CAMERA) for shift in shifts)


def hypotheses(shift):
    """The truth; both boxes as one; the resting box in two; nothing."""
    truth = table_scene(shift)[2]
    split = truth.copy()
    split[:, 30:][split[:, 30:] == 2] = 3
    arrays = (truth, (truth > 0).astype(np.uint16), split, np.zeros_like(truth))
    return [Hypothesis.from_labels(a, GRID) for a in arrays]


@pytest.fixture(scope="module")
def pushed():
    """Six textured solids: 1, 2 and 5 are moved apart, 3, 4 and 6 rest."""
    scene = standard(8)
    return scene.clip(0), scene.labels(scene.poses[-1]), scene.grid


def test_motions_speak_against_two_things_in_one_object(pushed):
    clip, truth, grid = pushed

    def score(labels):
        return MotionAgreement().log_score([Hypothesis.from_labels(labels, grid)], clip)[0]

    right = score(truth)
    for pair in ((1, 3), (4, 5), (1, 2)):  # moved and at rest; twins, one of which moved; both moved
        assert right > score(np.where(truth == pair[1], pair[0], truth)) + 3
    assert abs(right - score(np.where(truth == 6, 3, truth))) < 1e-9  # both rest: nothing is known
    assert right > score(np.zeros_like(truth)) + 3  # what moved must be something
    assert right > score((truth > 0).astype(np.uint16)) + 3


def test_where_nothing_moves_motions_say_nothing():
    for clip in (Clip(frames((0, 0)), GRID, 1), Clip(frames((0,)), GRID, 0)):
        assert np.ptp(MotionAgreement().log_score(hypotheses(0), clip)) < 1e-9


def test_borders_speak_for_the_objects_that_the_image_shows():
    right, merged, split, nothing = BoundaryAgreement().log_score(hypotheses(0), Clip(frames((0,)), GRID, 0))
    assert right > split
    assert right >= merged  # the boxes do not touch in the image: one object or two, the same borders
    assert right > nothing


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
    update = FusionUpdate(NoFreeSpace(), eta=3, evidence=(Size(),), n_scored=8)
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

    twice = FusionUpdate(NoFreeSpace(), eta=3, evidence=(Size(), Size()), n_scored=8)
    fused = twice.update(np.random.default_rng(0), a, b, clip)
    size = np.array([sum(h.volumes().values()) for h in fused.particles])
    assert np.ptp(fused.log_weights - 2 * size / 10) < 1e-12  # two terms of a kind both count
    assert len(fused.notes["scores"]) == 2


def test_terms_are_named_in_presets():
    filter = build_filter(load_config("mst", ['update.evidence=["motions", "boundaries"]', "update.n_scored=12"]))
    assert [type(e) for e in filter.update.evidence] == [MotionAgreement, BoundaryAgreement]
    clips = [Clip(frames((0,)), GRID, 0), Clip(frames((0, 1, 2)), GRID, 1)]
    _, infos = filter.run(clips, seed=0)
    assert infos[1].n_candidates == 12
    assert set(infos[1].notes["update"]["scores"]) == {"MotionAgreement", "BoundaryAgreement"}
    filter = build_filter(load_config("mst", ['update.evidence=["agreement", "depth", "support"]']))
    _, infos = filter.run(clips, seed=0)
    scores = infos[1].notes["update"]["scores"]
    assert list(scores) == ["Agreement", "DepthAgreement", "Support"]
    assert max(scores["DepthAgreement"]) < 0 and len(scores["Support"]) == infos[1].n_candidates
    with pytest.raises(Exception, match="there is no evidence 'smell'"):
        load_config("mst", ['update.evidence=["smell"]'])

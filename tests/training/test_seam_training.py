"""Samples, loss and training of the judge of seams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mst_training.loop import run_training
from mst_training.seam_data import SeamSamples, _purity
from mst_training.seams import SeamsTraining, _Source, region_losses
from mstfilter.base.errors import InputError
from mstfilter.mst.segmentation.divisions import Division
from mstfilter.mst.segmentation.seam_measures import STRIP, STRIP_CHANNELS
from mstfilter.mst.segmentation.seam_network import INPUTS, load_seam_network
from mstfilter.scene import render
from tests.mst.segmentation.scenes import GRID, boxes, camera, frame_of

ROW = boxes(((20, 20, 0), (32, 34, 10)), ((32, 20, 0), (46, 34, 10)))
SMALL = SeamsTraining(n_scenes=1, n_validation=1, n_test=1, width=8, steps=60, batch=6, rate=1e-2, average=0.8)


def samples(seed, n=40):
    """Regions with three divisions each. A feature and a channel of the strip tell which division is clean."""
    rng = np.random.default_rng(seed)
    two = rng.uniform(size=n) < 0.5
    clean = two[:, None] & (np.arange(3) == rng.integers(0, 3, n)[:, None])
    x = rng.normal(size=(n, 3, len(INPUTS))).astype(np.float32)
    x[..., 0] += 3 * clean
    strip = rng.integers(100, 156, (n, 3, len(STRIP_CHANNELS), *STRIP)).astype(np.uint8)
    strip[..., 4, :, :] += (60 * clean[..., None, None]).astype(np.uint8)
    every = {
        "x": x.reshape(3 * n, -1),
        "strip": strip.reshape(3 * n, len(STRIP_CHANNELS), *STRIP),
        "purity": clean.reshape(-1).astype(np.float32),
        "region": np.repeat(np.arange(n), 3),
        "objects": np.repeat(1 + two, 3).astype(np.int32),
        "depth": np.zeros(3 * n, np.int32),
        "grouped": np.repeat(np.arange(n) % 2 == 0, 3),
    }
    return SeamSamples(**every)


def test_training_learns_which_division_separates(tmp_path, monkeypatch):
    def write(folder, seed, n_scenes, workers=1, kinds=(), per_file=10):
        path = folder / "scenes-000000.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **samples(seed).columns())
        return [path]

    monkeypatch.setattr(SeamSamples, "write", write)
    figures = run_training(SMALL, tmp_path)
    assert figures["region_loss"] < 0.5 < -np.log(1 / 4)  # of four equal answers: 1.39
    judge = load_seam_network(str(tmp_path))
    new = samples(9)
    scores = judge.scores(new.x, new.strip)
    assert scores[new.purity == 1].min() > np.median(scores[new.purity == 0])


def test_further_samples_join_every_batch(tmp_path):
    samples(3).save(tmp_path / "desk.npz")
    replace(samples(4), objects=np.full(120, 3, np.int32)).save(tmp_path / "shelf.npz")
    settings = replace(SMALL, extra=str(tmp_path), extra_without="desk", extra_batch=5)
    for *_, region, objects, prior in settings.batches(samples(1), 0, 3):
        assert len(objects) == len(prior) == settings.batch + 5 and (objects[-5:] == 3).all()
        assert region.unique().tolist() == list(range(len(objects)))
    with pytest.raises(InputError, match="no files of samples"):
        next(replace(settings, extra_without="desk, shelf").batches(samples(1), 0, 1))


def test_the_prior_is_the_share_of_one_in_scenes_of_a_kind():
    given = samples(5)
    rows = np.arange(0, 120, 3)
    one, grouped = given.objects[rows] < 2, given.grouped[rows]
    prior = _Source.of(given).prior
    for kind in (False, True):
        own = grouped == kind
        expected = np.log((one[own].sum() + 1) / ((~one)[own].sum() + 1))
        assert prior[own] == pytest.approx(expected)


def test_a_labelled_image_gives_samples():
    frame = frame_of(ROW, width=320, noise=0.3)
    truth = render(ROW, GRID, camera(320)).labels.astype(int)
    found = SeamSamples.of_frame(frame, GRID, truth)
    assert not found.grouped.any() and set(found.objects[found.depth == 0]) <= {1, 2}
    assert (found.objects == 2).any() and found.purity.max() > 0.95
    with pytest.raises(InputError, match="labels"):
        SeamSamples.of_frame(frame, GRID, truth[:-1])
    with pytest.raises(InputError, match="no region"):
        SeamSamples.of_frame(frame, GRID, 0 * truth)


def test_region_losses_are_those_of_the_formula():
    scores = torch.tensor([0.3, -1.0, 2.0, 0.5, -30.0, 40.0], dtype=torch.float64)
    purity = torch.tensor([0.96, 0.97, 0.2, 0.1, 0.0, 0.99])
    region = torch.tensor([0, 0, 0, 1, 2, 3])
    objects = torch.tensor([2, 1, 3, 2])
    prior = torch.tensor([0.0, 1.5, 0.0, -1.0])  # log odds of "one" that the loss takes as known
    losses, log_one = region_losses(scores, purity, region, objects, prior)
    odds = torch.exp(scores - prior[region])
    one = 1 / (1 + torch.stack([odds[:3].sum(), odds[3], odds[4], odds[5]]))
    assert torch.allclose(log_one, torch.log(one))
    expected = [-torch.log((odds[0] + odds[1]) * one[0]), -torch.log(one[1]), -torch.log(odds[4] * one[2]), 0.0]
    assert torch.allclose(losses, torch.tensor([float(value) for value in expected], dtype=torch.float64), atol=1e-9)


def test_scores_of_one_region_do_not_depend_on_the_others():
    scores, purity = torch.randn(7, generator=torch.Generator().manual_seed(0)), torch.rand(7)
    region, objects = torch.tensor([0, 0, 1, 1, 1, 2, 2]), torch.tensor([1, 2, 2])
    prior = torch.zeros(3)
    together = region_losses(scores, purity, region, objects, prior)[0]
    for k in range(3):
        own = region == k
        alone = region_losses(scores[own], purity[own], region[own] - k, objects[[k]], prior[[k]])[0]
        assert torch.allclose(alone, together[[k]])


def test_purity():
    instance = np.repeat([0, 1, 2, 3], (50, 400, 300, 20))  # the third object is a piece of one that is elsewhere
    visible = np.bincount(np.repeat([0, 1, 2, 3], (50, 400, 300, 900)), minlength=256)
    sides = {"clean": instance == 1, "half": np.arange(len(instance)) % 2 == 0, "one object": instance == 0}
    sides["oblique"] = np.arange(len(instance)) < 400
    found, n = _purity(
        instance, [Division(side, "tree", np.zeros(3), 0.0, 1.0, 0.0) for side in sides.values()], visible
    )
    assert n == 2
    assert dict(zip(sides, found, strict=True)) == pytest.approx(
        {"clean": 1.0, "half": 0.0, "one object": 0.0, "oblique": 650 / 700}
    )


@pytest.mark.nightly
def test_a_sample_depends_on_its_scene_alone():
    first, again = (SeamSamples.of_scene(5, 1) for _ in range(2))
    for name, values in first.columns().items():
        assert np.array_equal(values, again.columns()[name]), name
    assert first.x.shape[1] == len(INPUTS) and np.isfinite(first.x).all()
    assert ((first.purity >= 0) & (first.purity <= 1)).all() and (first.purity[first.objects < 2] == 0).all()
    assert 0 < (first.objects > 1).mean() < 1

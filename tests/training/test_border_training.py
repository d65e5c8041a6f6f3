"""Samples and training of the border network, in a small form."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest
import torch

from mst_training.border import BorderTraining, Tally, encoded
from mst_training.border_data import BorderSamples, targets
from mst_training.loop import run_training
from mstfilter.mst.segmentation.border_network import (
    CENTRE_UNIT,
    IMAGE_CHANNELS,
    BorderNet,
    encode_image,
    load_border_network,
    near_objects,
    reduced,
)
from mstfilter.scene import Camera, Frame
from tests.mst.segmentation.scenes import TWO, frame_of

SMALL = BorderTraining(n_scenes=1, n_validation=1, n_test=1, width=8, steps=16, batch=2, rate=6e-3, average=0.8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("border")
    BorderSamples.write(folder / "train", 3, 2, per_file=1)
    return folder


@pytest.fixture(scope="module")
def samples(folder) -> BorderSamples:
    return BorderSamples.read(sorted((folder / "train").glob("*.npz")))


def test_a_sample_depends_on_its_scene_alone(samples):
    again, first = BorderSamples.of_scene(3, 1), int((samples.scene == 0).sum())
    for name, values in samples.columns().items():
        assert np.array_equal(values[first:], again.columns()[name]), name
    assert set(samples.scene.tolist()) == {0, 1} and 8 < len(samples) <= 12


def test_what_samples_show(samples):
    """Objects are above the table, some readings are missing, and centres lie where the objects are."""
    above = IMAGE_CHANNELS.index("above")
    inside, outside, missing = [], [], []
    for k in range(len(samples)):
        x, near, truth, offset = encoded(samples, k)
        assert np.isfinite(x).all() and np.abs(x).max() < 8
        objects = (truth[1] > 0) & (x[5] > 0)
        inside.append((x[above][objects] > 0.15).mean())
        outside.append(np.median(x[above][near & (truth[1] == 0) & (x[5] > 0)]))
        missing.append((x[5] == 0).mean())
        assert near[truth[0] > 0].mean() > 0.8
        assert np.median(np.abs(offset[:, truth[1] > 0])) * CENTRE_UNIT < 60
    assert np.mean(inside) > 0.85 and np.abs(np.median(outside)) < 0.1
    assert 0.005 < np.mean(missing) < 0.5
    grey = [np.ptp(rgb.reshape(-1, 3), axis=0).max() < 3 for rgb in samples.rgb]
    assert not all(grey)


def test_targets():
    instance = np.zeros((6, 8), np.uint8)
    instance[1:4, 2:5], instance[1:4, 5:7] = 1, 2
    centre = np.array([(0, 0), (3, 2), (5, 2)], np.float32)
    border, foreground, offset = targets(instance, centre)
    square = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    differs = cv2.dilate(instance, square) != cv2.erode(instance, square)
    assert np.array_equal(border, differs) and foreground.sum() == 15
    at = np.argwhere(instance == 2)
    found = offset[:, instance == 2].T * CENTRE_UNIT + at[:, ::-1]
    assert np.allclose(found, (5, 2)) and not offset[:, instance == 0].any()


def test_input_of_a_plane():
    """A horizontal table from above: nothing is above it, and its normal is up."""
    rays = frame_of(TWO).camera
    direction = rays.rays() @ rays.pose.as_matrix()[2, :3]
    depth = (-rays.position[2] / direction).astype(np.float32)
    x = encode_image(Frame(np.full((*depth.shape, 3), 119, np.uint8), depth, rays))
    inner = np.s_[:, 20:-20, 20:-20]
    assert np.abs(x[0]).max() < 1e-3 and np.allclose(x[2:5][inner], np.array([0, 1, 0])[:, None, None], atol=0.02)
    assert not near_objects(x).any() and np.abs(x[6:]).max() < 0.03
    boxes = encode_image(frame_of(TWO))
    assert near_objects(boxes).mean() > 0.05 and (boxes[0] > 0.3).mean() > 0.03


def test_size_and_raster():
    assert 2e5 < sum(p.numel() for p in BorderNet(BorderTraining().width).parameters()) < 6e5
    frame = frame_of(TWO, width=640)
    small = reduced(frame)
    assert small.depth.shape == (240, 320) and set(np.unique(small.depth)) <= set(np.unique(frame.depth))
    unposed = Frame(frame.rgb, frame.depth, Camera(frame.camera.K, 640, 480))
    up = reduced(unposed).camera.pose.as_matrix()[2, :3]
    assert up @ frame.camera.pose.as_matrix()[2, :3] > 0.999


def test_training_learns_resumes_and_is_used(folder, tmp_path):
    """The log loss after a few steps is below that of the best constant; a resumed training ends the same."""
    torch.set_num_threads(1)
    for name in ("train", "validation", "test"):
        (tmp_path / f"a/samples/{name}").mkdir(parents=True)
        shutil.copy(folder / "train/scenes-000000.npz", tmp_path / f"a/samples/{name}")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    assert run_training(SMALL, tmp_path / "a", max_steps=6) is None
    figures = run_training(SMALL, tmp_path / "a")
    run_training(SMALL, tmp_path / "b")
    resumed, straight = (load_border_network(str(tmp_path / name)) for name in "ab")
    for one, other in zip(resumed.net.parameters(), straight.net.parameters(), strict=True):
        assert torch.allclose(one, other, atol=1e-3)

    assert figures is not None
    model = (tmp_path / "a/model.toml").read_bytes()
    assert run_training(SMALL, tmp_path / "a") == pytest.approx(figures, abs=1e-4)
    assert (tmp_path / "a/model.toml").read_bytes() == model
    found = BorderSamples.read(sorted((tmp_path / "a/samples/test").glob("*.npz")))
    near = [encoded(found, k) for k in range(len(found))]
    p = np.concatenate([truth[0][inside] for _, inside, truth, _ in near]).mean()
    assert figures["log_loss"] < -(p * np.log(p) + (1 - p) * np.log(1 - p)) - 0.01
    assert figures["calibration_error"] < 0.1

    frame = frame_of(TWO, width=640)
    seen = resumed.look(frame)
    assert seen.border.shape == (480, 640) and seen.centre.shape == (480, 640, 2)
    assert np.isfinite(seen.border).all() and np.isfinite(seen.centre).all()
    odd = frame_of(TWO, width=324)
    assert resumed.look(odd).foreground.shape == odd.depth.shape


def test_tally():
    """Against the definitions on logits that lie in the middle of bins."""
    rng = np.random.default_rng(0)
    logits = np.round(rng.normal(size=4000) / 0.025) * 0.025 + 0.0125
    p = 1 / (1 + np.exp(-logits))
    truth = rng.random(4000) < p
    tally = Tally()
    tally.add(logits[:1000], truth[:1000])
    tally.add(logits[1000:], truth[1000:])
    found = tally.figures((1.0, 0.0))
    assert found["log_loss"] == pytest.approx(-np.log(np.where(truth, p, 1 - p)).mean(), rel=1e-6)
    best = max(2 * (truth & (p > t)).sum() / (truth.sum() + (p > t).sum()) for t in np.unique(p))
    assert found["f"] == pytest.approx(best, abs=1e-3) and found["calibration_error"] < 0.03

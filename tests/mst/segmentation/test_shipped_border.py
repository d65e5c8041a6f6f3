"""The border weights that are part of the package: they open, and see borders and centres on new scenes."""

from __future__ import annotations

import numpy as np
import pytest

from mst_training.border_data import BorderSamples, targets
from mstfilter.mst.segmentation import BorderTree, ColourDepthBoundary
from mstfilter.mst.segmentation.border_network import encode_image, load_border_network, near_objects, reduced
from mstfilter.scene import Camera, Frame, look_at
from tests.experiments.scripts import EXPERIMENTS, own_modules
from tests.mst.segmentation.scenes import TOUCHING, frame_of

SEED = 99  # of no training


def test_borders_and_centres_on_new_scenes():
    """On six images. The forecasts beat the share of border pixels, which the network does not know."""
    network = load_border_network("border")
    odds, true, off, by_pixel = [], [], [], []
    samples = BorderSamples.of_scene(SEED, 0)
    for k in range(len(samples)):
        frame = samples.frame(k)
        seen, near = network.look(frame), near_objects(encode_image(frame))
        border, foreground, _ = targets(samples.instance[k], samples.centre[k])
        odds.append(seen.border[near])
        true.append(border[near])
        rows, columns = np.nonzero(foreground)
        centre = samples.centre[k][samples.instance[k][foreground]]
        off.append(np.linalg.norm(seen.centre[foreground] - centre, axis=1))
        by_pixel.append(np.linalg.norm(np.stack([columns, rows], axis=1) - centre, axis=1))
    l, y = np.concatenate(odds).astype(float), np.concatenate(true)
    loss = np.logaddexp(0, np.where(y, -l, l)).mean()
    share = y.mean()
    assert loss < 0.6 * -(share * np.log(share) + (1 - share) * np.log(1 - share))
    assert np.mean(np.concatenate(off)) < 0.6 * np.mean(np.concatenate(by_pixel))


def test_the_tree_has_weights_for_the_evidence():
    frame = frame_of(TOUCHING, noise=0.4)
    tree = BorderTree().build(ColourDepthBoundary().boundary(frame), frame)
    assert np.isfinite(tree.odds).all() and tree.n_leaves > 2 and BorderTree().weights_key


@pytest.mark.nightly
def test_the_correction_lowers_the_log_loss_of_pairs_on_new_images():
    """Pairs of regions in twelve images of two scenes. Log loss .016 with the correction and .020 without."""
    correction, (weights, _) = BorderTree().correction(), BorderTree().model()
    pairs = ([], [], [])
    with own_modules(EXPERIMENTS / "segmentation_fit"):
        from run import episode, measured_image
        from scenes import training_images

        for index in range(2):
            for pause in training_images(BorderSamples, SEED, index):
                episode(*measured_image(pause, BorderTree()), weights, pairs)
    x, different, weight = (np.array(part) for part in pairs)
    linear, sign = x @ np.array(list(weights.values())), np.where(different, 1, -1)
    losses = [np.average(np.logaddexp(0, -sign * l), weights=weight) for l in (linear + correction(x), linear)]
    assert losses[0] < losses[1] < np.log(2)


def test_the_network_sees_the_depth_images_of_its_training():
    """Every second pixel, from the first one, of an image of 640 columns."""
    depth = np.arange(480 * 640, dtype=np.float32).reshape(480, 640) / 1e6 + 0.5
    frame = Frame(
        np.zeros((480, 640, 3), np.uint8),
        depth,
        Camera.from_intrinsics(525, 525, 319.5, 239.5, 640, 480, look_at((0, -0.6, 0.5), (0, 0, 0))),
    )
    np.testing.assert_array_equal(reduced(frame).depth, depth[::2, ::2])

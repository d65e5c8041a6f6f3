"""Objects that are visible, hidden or never seen: a small recording with a known answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.scene import Recording
from mstfilter.scoring.quality import object_status
from tests.scene.scenes import CAMERA, GRID, table_scene

SHAPE = (120, 160)  # 1/16 of 640 x 480: 100 pixels there are 6.25 here


def recording_of(images, labels, action=None):
    """Pauses with these instance images; between the first two a frame whose image is `action`."""
    shown = [images[0], action if action is not None else images[0], *images[1:]]
    frames, depths = [], []
    for _ in shown:
        rgb, depth, _ = table_scene(0)
        frames.append(rgb)
        depths.append(depth)
    pauses = (0, *range(2, len(shown)))
    made = Recording.from_arrays(
        np.stack(frames), np.stack(depths), CAMERA.K, pauses=pauses, T_world_camera=CAMERA.pose, grid=GRID
    )
    return replace(made, truth=lambda t: labels, instance=lambda index: shown[index])


def image_of(**pixels):
    image = np.zeros(SHAPE, np.uint8)
    for name, count in pixels.items():
        image[int(name[1:]) * 5 : int(name[1:]) * 5 + 5].ravel()[:count] = int(name[1:])
    return image


def test_status_of_visible_hidden_and_unseen_objects():
    labels = np.zeros(GRID.shape, np.uint16)
    for k in (1, 2, 3, 4):
        labels[10 * k, 5, :3] = k
    images = [image_of(o1=50, o2=50, o4=6), image_of(o1=7, o2=6), image_of(o2=200, o5=90)]
    recording = recording_of(images, labels, action=image_of(o3=300, o4=300))
    assert object_status(recording, 0) == {1: "visible", 2: "visible", 3: "unseen", 4: "unseen"}
    assert object_status(recording, 1) == {1: "visible", 2: "hidden", 3: "unseen", 4: "unseen"}
    assert object_status(recording, 2) == {1: "hidden", 2: "visible", 3: "unseen", 4: "unseen"}
    assert object_status(recording, 1, min_pixels=96)[2] == "visible"  # 6 of the small image


def test_missing_ground_truth_raises_an_error():
    labels = np.zeros(GRID.shape, np.uint16)
    recording = recording_of([image_of(), image_of()], labels)
    assert object_status(recording, 1) == {}
    with pytest.raises(InputError, match="has no pause 2, it has 2"):
        object_status(recording, 2)
    with pytest.raises(InputError, match="no true voxels at pause 1"):
        object_status(replace(recording, truth=lambda t: None), 1)
    with pytest.raises(InputError, match="no instance image at pause 0"):
        object_status(replace(recording, instance=lambda index: None), 0)

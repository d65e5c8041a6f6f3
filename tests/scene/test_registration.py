"""Depth that is not registered to colour is found, and a table with a wood grain is no such depth."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from mstfilter.formats import PairedImages, open_recording
from mstfilter.scene import Camera, Frame, examine, look_at, render
from mstfilter.scene.frame import depth_sigma
from tests.scene.scenes import GRID

SEEDS = range(4)
SHIFTS = {"right": (0.03, 0.0), "down": (0.0, 0.03), "left and down": (-0.025, 0.02)}


@cache
def boxes(seed, contrast):
    """Colour and depth of four boxes on a table at three pauses, 640 x 480, the pixels of the table, and the camera.

    `contrast` scales the difference between the colours of the boxes and that of the table. A box is moved before
    each pause but the first.
    """
    rng = np.random.default_rng(seed)
    pose = look_at((rng.uniform(-0.2, 0.2), -0.6, rng.uniform(0.4, 0.7)), (0, 0, 0.03))
    camera = Camera.from_intrinsics(525, 525, 319.5, 239.5, 640, 480, pose)
    found = [(rng.integers(5, 45, 2), rng.integers(6, 15, 2), rng.integers(4, 16)) for _ in range(4)]
    wood = np.array([150.0, 110, 70])
    colours = np.stack([wood, *(wood + contrast * rng.normal(size=3) * 45 for _ in found)]).clip(0, 255)
    directions = camera.rays() @ camera.pose.as_matrix()[:3, :3].T
    images = []
    for k in range(3):
        labels = np.zeros(GRID.shape, np.uint16)
        for i, (place, size, height) in enumerate(found):
            x, y = np.clip(place + (i == k > 0) * np.array([6 * k, -3 * k]), 0, 45)
            labels[x : x + size[0], y : y + size[1], :height] = i + 1
        seen = render(labels, GRID, camera)
        depth = np.where(seen.labels > 0, seen.depth, -camera.position[2] / np.minimum(directions[..., 2], -1e-6))
        depth = depth + rng.normal(size=depth.shape) * depth_sigma(depth)
        rgb = (colours[seen.labels] + 2 * rng.normal(size=(*depth.shape, 3))).clip(0, 255).astype(np.uint8)
        images.append((rgb, depth.astype(np.float32), seen.labels == 0))
    rgb, depth, table = map(np.stack, zip(*images, strict=True))
    return rgb, depth, table, camera


def grained(rgb, table, amplitude=60):
    """Images whose table has a grain along the rows, with a period of ten rows."""
    grain = amplitude * np.sin(2 * np.pi * np.arange(rgb.shape[1]) / 10)[:, None, None]
    return np.where(table[..., None], (rgb + grain).clip(0, 255), rgb).astype(np.uint8)


def shifted(depth, right, down):
    """Depth images shifted by shares of the image width."""
    height, width = depth.shape[1:]
    T = np.float32([[1, 0, right * width], [0, 1, down * width]])
    how = {"flags": cv2.INTER_NEAREST, "borderValue": float("nan")}
    return np.stack([cv2.warpAffine(image, T, (width, height), **how) for image in depth])


def not_registered(rgb, depth, camera, grid=GRID):
    """Whether the edges of depth and colour are said to differ."""
    frames = [Frame(*images, camera) for images in zip(rgb, depth, strict=True)]
    found = examine(frames, range(len(frames)), grid)
    return any("not registered" in finding.message for finding in found)


@pytest.mark.parametrize("contrast", [0.15, 0.4])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_wood_grain_is_no_shift(seed, contrast):
    rgb, depth, table, camera = boxes(seed, contrast)
    assert not not_registered(grained(rgb, table), depth, camera)


@pytest.mark.parametrize("shift", SHIFTS)
def test_shifts_are_found(shift):
    """At all uniform tables, and at all but one with a grain, if the boxes have other colours."""
    found = {"uniform": 0, "grain": 0}
    for seed in SEEDS:
        rgb, depth, table, camera = boxes(seed, 1.0)
        wrong = shifted(depth, *SHIFTS[shift])
        found["uniform"] += not_registered(rgb, wrong, camera)
        found["grain"] += not_registered(grained(rgb, table), wrong, camera)
    assert found["uniform"] == len(SEEDS) and found["grain"] >= len(SEEDS) - 1, found


REAL = {
    "hots/mix_1": (), "hots/table_7": (), "hots/office_9": (),
    "osd_learn": ("learn6", "learn7", "learn8"), "osd_learn ": ("learn33", "learn34", "learn35"),
}  # fmt: skip


@pytest.mark.parametrize("name", [*REAL, "jack"])
def test_real_recordings_are_registered_and_shifts_of_them_are_found(shared_data, name):
    """A shift to the right by 3 % of the width, at all but `jack`, in which few edges of depth are seen in colour."""
    path = shared_data(f"real/{name.strip()}")
    recording = open_recording(path) if name == "jack" else PairedImages(frames=REAL[name]).open(path)
    frames = [recording.frames[p] for p in recording.pauses[:3]]
    rgb, depth, camera = np.stack([f.rgb for f in frames]), np.stack([f.depth for f in frames]), frames[0].camera
    assert not not_registered(rgb, depth, camera, recording.grid)
    if name != "jack":
        assert not_registered(rgb, shifted(depth, 0.03, 0), camera, recording.grid)

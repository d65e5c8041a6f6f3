"""Pauses of a video: given ones, and ones found by image motion on simulated recordings."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.formats.pauses import At, Ends, EveryNth, Still, grey_blocks, pauses_from_text
from mstfilter.scene import Recording
from tests.formats.layouts import PAUSES, video
from tests.scene.scenes import CAMERA, table_scene

TIMES = tuple(10 + k / 10 for k in range(40))


def none(index):
    raise AssertionError("no image is needed")


def test_given_pauses():
    assert At(frames=(30, 0, -1)).find(TIMES, none) == (0, 30, 39)
    assert At(seconds=(0.0, 1.52, 3.9)).find(TIMES, none) == (0, 15, 39)
    assert Ends().find(TIMES, none) == (0, 39)
    assert Ends().find(TIMES[:1], none) == (0,)
    assert EveryNth(15).find(TIMES, none) == (0, 15, 30)
    for rule, message in (
        (At(), "no pause"),
        (At(frames=(40,)), "frame 40: the video has 40"),
        (At(frames=(2.7,)), "frame 2.7: the video has 40"),
        (At(seconds=(9.0,)), "lasts from 0 to 3.9 s"),
    ):
        with pytest.raises(InputError, match=message):
            rule.find(TIMES, none)


@pytest.mark.parametrize(
    ("rule", "wrong", "message"),
    [
        (EveryNth, {"n": 0}, "n is 0, expected an integer of at least 1"),
        (Still, {"hold_s": -0.1}, "hold_s is -0.1"),
        (Still, {"levels": -1.0}, "levels is -1.0"),
        (Still, {"region": (0.5, 0.0, 0.5, 1.0)}, "region is"),
        (Still, {"region": (0.1, 0.2)}, "region is"),
    ],
)
def test_numbers_of_rules_have_bounds(rule, wrong, message):
    with pytest.raises(InputError, match=message):
        rule(**wrong)


def test_pauses_as_text():
    assert pauses_from_text("0,40,85") == {"component": "at", "frames": (0, 40, 85)}
    assert pauses_from_text("0s, 4.2s,9") == {"component": "at", "seconds": (0.0, 4.2), "frames": (9,)}
    assert pauses_from_text("-1") == {"component": "at", "frames": (-1,)}
    assert pauses_from_text("still") == {"component": "still"}
    with pytest.raises(InputError, match="1.5"):
        pauses_from_text("0,1.5")


def test_pauses_of_arrays():
    """The rules of the command line, and its default if the times are known."""
    scenes = [table_scene(shift) for shift in (0, 0, 0, 1, 2, 3, 3, 3, 3)]
    rgb, depth = np.stack([s[0] for s in scenes]), np.stack([s[1] for s in scenes])
    times = 0.3 * np.arange(9)

    def pauses(*, n=9, **named):
        return Recording.from_arrays(rgb[:n], depth[:n], CAMERA.K, **named).pauses

    assert pauses() == (0, 8)
    assert pauses(times=times) == pauses(times=times, pauses="still") == (1, 6)
    assert pauses(times=times[:2], n=2) == (0, 1)
    assert pauses(pauses="every") == tuple(range(9))
    assert pauses(pauses="ends", times=times) == pauses(pauses="0,-1") == pauses(pauses=Ends()) == (0, 8)
    assert pauses(pauses="0s,1.2s", times=times) == (0, 4)
    assert pauses(pauses=[2, 5]) == (2, 5)
    for wrong, message in (("evry", "no pauses 'evry'"), ("0,x", "no pauses '0,x'"), ("99", "frame 99")):
        with pytest.raises(InputError, match=message):
            pauses(pauses=wrong)
    for wrong in ((0, 4.9), (False, True), (-1, 3)):
        with pytest.raises(InputError, match="a pause of arrays is .* expected an integer"):
            pauses(pauses=wrong)
    with pytest.raises(InputError, match="3 times for 9 frames"):
        pauses(times=times[:3])
    many = np.repeat(rgb[:1], 30, axis=0), np.repeat(depth[:1], 30, axis=0)
    with pytest.warns(InputWarning, match="30 frames of arrays are one clip"):
        Recording.from_arrays(*many, CAMERA.K)


def times_of(images, fps=10.0):
    return tuple(k / fps for k in range(len(images)))


def test_still_intervals_of_an_exact_video():
    rgb, _, _ = video()
    assert Still().intervals(times_of(rgb), lambda k: rgb[k]) == ((0, 5), (10, 16))
    assert Still().find(times_of(rgb), lambda k: rgb[k]) == PAUSES
    assert Still(hold_s=0.6).find(times_of(rgb), lambda k: rgb[k]) == (13,)
    with pytest.raises(InputError, match="no pause found: in 17 frames"):
        Still(hold_s=0.7).find(times_of(rgb), lambda k: rgb[k])
    assert Still().find((0.0,), lambda k: rgb[k]) == (0,)


def test_changes_of_all_pixels_are_no_motion():
    """Exposure that drifts, flickers and steps, noise and a flickering edge do not change the pauses."""
    rng = np.random.default_rng(0)
    rgb, _, _ = video()
    steady = np.zeros(len(rgb))
    steps = np.where(np.arange(len(rgb)) > 2, 20.0, 0.0)
    flicker = rng.uniform(-6, 6, len(rgb)) + np.linspace(0, 12, len(rgb))
    for levels, noise in ((steady, 4.0), (steps, 0.5), (flicker, 4.0)):
        noisy = [
            np.clip(image * 0.8 + level + rng.normal(size=image.shape) * noise, 0, 255).astype(np.uint8)
            for image, level in zip(rgb, levels, strict=True)
        ]
        assert Still().intervals(times_of(noisy), lambda k, v=noisy: v[k]) == ((0, 5), (10, 16))
    shimmer = [image.astype(float) for image in rgb]
    for image in shimmer:  # noise is measured per block: one percent of the image flickers
        image[100:102] += rng.normal(size=(1, 160, 1)) * 3
    assert Still().intervals(times_of(rgb), lambda k: shimmer[k]) == ((0, 5), (10, 16))


def test_a_region_excludes_motion_elsewhere():
    """A person moves behind the table in every frame."""
    rgb, _, _ = video()
    walking = rgb.copy()
    for k, image in enumerate(walking):
        image[:15, 5 * k : 5 * k + 12] = 0
    assert Still().intervals(times_of(rgb), lambda k: walking[k]) == ()
    table = Still(region=(0.0, 0.2, 1.0, 1.0))
    assert table.intervals(times_of(rgb), lambda k: walking[k]) == ((0, 5), (10, 16))


def test_slow_motion_adds_up():
    """Motion of a twentieth of a pixel per frame changes a block by three levels only after several frames."""
    image = video((0,))[0][0].astype(float)
    slow = [(1 - f) * image + f * np.roll(image, 1, axis=1) for f in np.arange(20) * 0.05]
    changes = [np.abs(grey_blocks(b) - grey_blocks(a)).max() for a, b in pairwise(slow)]
    assert max(changes) < 3
    assert max(b - a for a, b in Still(hold_s=0.1).intervals(times_of(slow), lambda k: slow[k])) < 10
    assert Still(hold_s=1.9, levels=100).intervals(times_of(slow), lambda k: slow[k]) == ((0, 19),)


def test_blocks_are_means():
    image = np.random.default_rng(0).integers(0, 255, (48, 163, 3), dtype=np.uint8)
    blocks = grey_blocks(image)
    assert blocks.shape == (24, 81)
    np.testing.assert_allclose(blocks[3, 5], image[6:8, 10:12].mean(), rtol=1e-6)

"""Pixels of objects, and their depth where the sensor has none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import ArrayLike
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, gaussian_filter, label

from mstfilter.scene import (
    Frame,
    Hypothesis,
    VoxelGrid,
    foreground,
    outlined,
    pixels_above_table,
    project,
    readings_above_table,
    render,
)
from mstfilter.scene.heights import height_in_noise
from mstfilter.scene.planes import beyond_table
from tests.mst.segmentation.scenes import GRID, TWO, camera, frame_of

SEEN = render(TWO, GRID, camera(640)).labels


def without(frame: Frame, holes: np.ndarray, colour: tuple[int, int, int] | None = None) -> Frame:
    """The frame without readings in some pixels, perhaps of another colour."""
    rgb = np.array(frame.rgb)
    if colour is not None:
        rgb[holes] = colour
    return Frame(rgb, np.where(holes, np.nan, frame.depth).astype(np.float32), frame.camera)


def share(found: np.ndarray, true: np.ndarray) -> float:
    return float((found & true).sum() / true.sum())


def test_without_noise_the_foreground_is_the_readings_above_the_table_and_the_contact_with_the_table():
    frame = frame_of(TWO, width=640)
    found = foreground(frame, GRID).pixels
    above, true = readings_above_table(frame, GRID), SEEN > 0
    inside = binary_erosion(true)  # the colours of the other pixels are mixed
    assert not (found & ~true).any() and (above & ~found).sum() < 0.01 * above.sum()
    assert not (above & inside & ~found).any()
    contact = inside & ~above
    assert contact.sum() > 100 and (contact & ~found).sum() < 0.1 * contact.sum()


def test_noise_on_the_table_is_no_object():
    frame = frame_of(TWO, width=640, noise=0.9)
    table = SEEN == 0
    assert (pixels_above_table(frame) & table).sum() > 500
    found = foreground(frame, GRID).pixels
    assert (found & table).sum() < 50
    assert share(found, SEEN > 0) > 0.9


def middle_of_an_object(radius: float) -> np.ndarray:
    rows, columns = np.nonzero(SEEN == 1)
    return (SEEN == 1) & (np.hypot(np.arange(480)[:, None] - rows.mean(), np.arange(640) - columns.mean()) < radius)


@pytest.mark.parametrize("colour", [None, (200, 190, 170)])
def test_a_hole_in_an_object_belongs_to_the_object(colour):
    """The colour of the table does not matter: readings of the object are on all sides."""
    frame = frame_of(TWO, width=640, noise=0.3)
    for radius in (4, 25):
        hole = middle_of_an_object(radius)
        assert foreground(without(frame, hole, colour), GRID).pixels[hole].all()


@pytest.mark.parametrize("missing", ["every second row", "a checker board", "every third row"])
def test_sparse_readings_show_the_same_objects(missing):
    """A dark object without readings, a low sheet with the colour of the table, and the objects of the scene."""
    rows, columns = np.indices(SEEN.shape)
    holes = {"every second row": rows % 2, "a checker board": (rows + columns) % 2, "every third row": rows % 3 == 2}
    dark, sheet = patch(slice(320, 350), slice(285, 335)), patch(slice(400, 460), slice(250, 340))
    frame = lifted(frame_of(TWO, width=640, noise=0.3), sheet, 8.0, None)
    sparse = without(without(frame, dark, (20, 20, 20)), holes[missing] > 0)
    found = foreground(sparse).pixels
    assert found[dark].mean() > 0.95 and found[sheet & sparse.valid].mean() > 0.9
    assert share(found, SEEN > 0) > 0.9 and (found & (SEEN == 0) & ~dark & ~sheet).sum() < 50


@pytest.mark.parametrize("part", ["all of an object", "its middle"])
def test_an_object_without_readings_is_found_by_its_colour(part):
    frame = frame_of(TWO, width=640, noise=0.3)
    holes = middle_of_an_object(25) if part == "its middle" else SEEN == 1
    found = foreground(without(frame, holes), GRID)
    assert share(found.pixels, SEEN == 1) > 0.95
    error = np.abs(found.frame.depth - frame.depth)[holes & found.pixels]
    # The readings of the other pixels are near; an object without any stands at its lowest pixels.
    assert np.median(error) < (0.05 if part == "its middle" else 0.12)
    above = ~holes & readings_above_table(frame, GRID)
    assert np.array_equal(found.frame.depth[above], frame.depth[above])


def test_a_hole_in_the_table_is_an_object_by_its_colour_or_its_size():
    frame = frame_of(TWO, width=640, noise=0.3)
    small, large = np.zeros(SEEN.shape, bool), np.zeros(SEEN.shape, bool)
    small[320:332, 290:330], large[320:350, 290:330] = True, True  # on the table, before the objects
    assert not SEEN[large].any() and not foreground(without(frame, small), GRID).pixels[small].any()
    assert foreground(without(frame, small, (20, 20, 20)), GRID).pixels[small].mean() > 0.9
    assert foreground(without(frame, large), GRID).pixels[large].mean() > 0.9


def test_readings_around_a_gap_give_its_depth():
    """A dark gap in the side of a box is filled by the plane of the side."""
    frame = frame_of(TWO, width=640, noise=0)
    side = SEEN == 1
    rows, columns = np.nonzero(side)
    gap = np.zeros(SEEN.shape, bool)
    gap[int(np.percentile(rows, 50)) : int(np.percentile(rows, 80)), int(columns.mean()) - 16 :] = True
    gap &= side & (np.arange(640) < columns.mean() + 16)
    found = foreground(without(frame, gap, (20, 20, 20)), GRID)
    assert gap.sum() > 500 and found.pixels[gap].all()
    error = np.abs(found.frame.depth - frame.depth)[gap]
    assert error.max() < 0.015 and np.median(error) < 0.004


def test_pixels_outside_the_workspace_are_no_objects():
    frame = frame_of(TWO, width=640, noise=0.3)
    holes = np.zeros(SEEN.shape, bool)
    holes[400:440, 300:360] = True
    dark = without(frame, holes, (20, 20, 20))
    assert foreground(dark).pixels[holes].mean() > 0.9 and not foreground(dark, GRID).pixels[holes].any()


def test_a_single_near_reading_and_the_robot_cast_the_shadows_that_they_cast():
    frame = frame_of(TWO, width=640, noise=0.3)
    holes = np.zeros(SEEN.shape, bool)
    holes[300:340, 280:320] = True
    dark = without(frame, holes, (20, 20, 20))
    flying = np.array(dark.depth)
    flying[300:340, 322] = 0.45
    assert foreground(Frame(dark.rgb, flying, dark.camera), GRID).pixels[holes].mean() > 0.9
    robot, strip = np.zeros(SEEN.shape, bool), np.zeros(SEEN.shape, bool)
    robot[300:340, 250:280], strip[300:340, 280:296] = True, True
    arm = np.where(robot, 0.6, without(frame, strip).depth).astype(np.float32)
    shaded = without(frame, strip, (90, 80, 70)).rgb
    assert not foreground(Frame(shaded, arm, frame.camera, robot), GRID).pixels[strip].any()


def test_empty_margins_of_registered_depth_are_no_objects():
    frame = frame_of(TWO, width=640, noise=0.3)
    rows, columns = np.indices(SEEN.shape)
    top, at = np.argwhere(SEEN > 0)[0]
    slanted = rows < top + (columns - at) / 30  # the image is turned, and an object is at its margin
    margin = (columns < 15) | slanted
    assert not foreground(without(frame, margin, (10, 10, 10)), GRID).pixels[margin & (SEEN == 0)].any()


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000), missing=st.floats(0, 0.9), noise=st.floats(0, 1))
def test_readings_of_objects_stay_and_estimates_are_above_the_table(seed, missing, noise):
    frame = frame_of(TWO, width=160, noise=noise)
    blocks = np.random.default_rng(seed).random((12, 16)) < missing
    holed = without(frame, np.kron(blocks, np.ones((10, 10))) > 0)
    found = foreground(holed, GRID)
    raised = readings_above_table(holed, GRID)
    kept = raised | ~found.pixels
    np.testing.assert_array_equal(found.frame.depth[kept], holed.depth[kept])
    assert np.isfinite(found.frame.depth[found.pixels]).all()
    estimated = found.frame.estimated if found.frame.estimated is not None else np.zeros_like(raised)
    assert not (estimated & (raised | ~found.pixels)).any()
    assert estimated[found.pixels & ~np.isfinite(holed.depth)].all()
    assert (found.frame.points[..., 2][found.pixels & ~raised] > 0.7 * GRID.voxel_size).all()


def lifted(frame: Frame, pixels: np.ndarray, units: ArrayLike, colour: tuple[int, int, int] | None) -> Frame:
    """The frame with readings in some pixels that are higher by some sensor units, perhaps of another colour."""
    depth = np.where(pixels, 315.0 / (315.0 / frame.depth + units), frame.depth).astype(np.float32)
    rgb = frame.rgb if colour is None else np.where(pixels[..., None], np.uint8(colour), frame.rgb)
    return Frame(rgb, depth, frame.camera)


def patch(rows: slice, columns: slice) -> np.ndarray:
    found = np.zeros(SEEN.shape, bool)
    found[rows, columns] = True
    assert not SEEN[found].any()
    return found


@pytest.mark.parametrize(
    ("rise", "colour", "is_object"), [(1.2, (30, 30, 40), True), (0, (30, 30, 40), False), (1.2, None, False)]
)
def test_a_flat_object_has_another_colour_and_rises_a_little_from_the_table(rise, colour, is_object):
    """A pen is an object, a print on the table is none, and a dent in the readings is none."""
    pen = patch(slice(330, 344), slice(280, 360))
    found = foreground(lifted(frame_of(TWO, width=640, noise=0.3), pen, rise, colour), GRID)
    assert (found.pixels[pen].mean() > 0.8) if is_object else not found.pixels[pen].any()
    if is_object:  # the voxels at its readings have their centres inside the object
        assert (found.frame.points[..., 2][pen & found.pixels] >= 0.7 * GRID.voxel_size).all()
        assert found.frame.estimated is None or not found.frame.estimated[pen].any()


def test_prints_on_the_table_are_no_flat_objects_in_small_images():
    """The mean rise of a few pixels is noisy: without a least number of pixels, 17 of the 288 prints were found."""
    frame, found = frame_of(0 * TWO, width=160), 0
    rows, columns = np.indices(frame.depth.shape)
    prints = (rows % 12 < 4) & (columns % 12 < 5) & (rows > 37) & (rows < 105) & (columns > 30) & (columns < 130)
    printed = lifted(frame, prints, 0, (40, 40, 60))
    for seed in range(6):
        noise = np.random.default_rng(seed).normal(0, 0.9, frame.depth.shape)
        noisy = lifted(printed, np.ones_like(prints), noise, None)
        found += label(foreground(noisy).pixels & prints)[1]
    assert found <= 3  # of 288


def test_a_raised_region_beside_an_object_can_be_its_shadow():
    """The same dark patch is an object if it stands alone."""
    rows, columns = np.nonzero(SEEN == 1)
    row, left = int(np.percentile(rows, 60)), columns[rows == int(np.percentile(rows, 60))].min()
    shadow = np.zeros(SEEN.shape, bool)
    shadow[row : row + 12, left - 45 : left] = True
    shadow &= SEEN == 0
    beyond = shadow & (np.arange(640) < left - 10)
    frame = frame_of(TWO, width=640, noise=0.3)
    assert not foreground(lifted(frame, shadow, 1.2, (60, 60, 55)), GRID).pixels[beyond].any()
    alone = patch(slice(330, 342), slice(280, 325))
    assert foreground(lifted(frame, alone, 1.2, (60, 60, 55)), GRID).pixels[alone].mean() > 0.8


@pytest.mark.parametrize("shift", [-3, 3])
def test_outlines_follow_the_colours_if_depth_is_shifted(shift):
    frame, bare, true = frame_of(TWO, width=640, noise=0.3), frame_of(0 * TWO, width=640, noise=0.3), SEEN > 0
    shown = np.roll(true, shift, axis=0)
    moved = Frame(frame.rgb, np.where(shown, np.roll(frame.depth, shift, axis=0), bare.depth), frame.camera)
    found, readings = foreground(moved, GRID), readings_above_table(moved, GRID)
    far = binary_erosion(true) | binary_erosion(~true)  # the colours of the other pixels are mixed
    assert (found.pixels != true)[far].sum() < 0.1 * (readings != true)[far].sum()
    added = found.pixels & true & ~shown  # their readings are of the table behind
    assert added.sum() > 100 and np.median(np.abs(found.frame.depth - frame.depth)[added]) < 0.02


def test_low_regions_with_the_colour_of_the_table_are_noise_of_any_size():
    frame = frame_of(TWO, width=640, noise=0.3)
    blob, sheet = patch(slice(330, 345), slice(280, 310)), patch(slice(330, 360), slice(280, 330))
    for pixels in (blob, sheet):
        assert not foreground(lifted(frame, pixels, 4.5, None), GRID).pixels[pixels].any()
    for pixels, rise, colour in ((blob, 4.5, (90, 120, 60)), (blob, 12.0, None), (sheet, 4.5, (90, 120, 60))):
        assert foreground(lifted(frame, pixels, rise, colour), GRID).pixels[pixels].mean() > 0.9


def test_a_plate_with_the_colour_of_the_table_is_an_object_by_its_rim():
    rows, columns = np.indices(SEEN.shape)
    radius = np.hypot(rows - 390, columns - 310)
    plate = (radius < 45) & patch(slice(340, 440), slice(260, 360))
    rise = np.where(radius > 32, 9.0, 4.0)
    found = foreground(lifted(frame_of(TWO, width=640, noise=0.3), plate, rise, None)).pixels
    assert found[plate].mean() > 0.95


@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_the_noise_of_a_sensor_shows_below_the_table(noise):
    """Noise that is smooth over ten pixels, as of stereo cameras: with the tolerance of a Kinect, it is objects."""
    bare = frame_of(0 * TWO, width=640)
    smooth = gaussian_filter(np.random.default_rng(1).normal(size=bare.depth.shape), 5)
    frame = lifted(bare, np.ones_like(SEEN, bool), noise * smooth / smooth.std(), None)
    height = height_in_noise(frame)[40:-40, 40:-40]
    assert np.nanpercentile(-height, 98) < 2 * 1.25 * 1.1  # 98 % of normal values are below 2.05
    assert foreground(frame).pixels.sum() < 100
    assert (pixels_above_table(frame).sum() > 10_000) == (noise > 2)


def test_depth_that_is_smeared_into_the_table_is_cut_by_colour():
    """Around objects of another colour, the depth falls to the table over 12 pixels."""
    frame = frame_of(TWO, width=640, noise=0.3)
    away = distance_transform_edt(SEEN == 0)
    skirt = (away > 0) & (away < 12)
    found = foreground(lifted(frame, skirt, 16 * (1 - away / 12), None), GRID).pixels
    assert (found & skirt & (away > 3)).sum() < 0.1 * (skirt & (away > 3)).sum()
    assert share(found, SEEN > 0) > 0.9


def test_a_wall_that_bounds_the_table_is_no_object():
    frame = frame_of(TWO, width=640, noise=0.3)
    camera_ = frame.camera
    directions = camera_.rays() @ camera_.pose.as_matrix()[:3, :3].T
    at = np.nanpercentile(frame.points[SEEN > 0][:, 1], 100) + 0.1
    with np.errstate(divide="ignore"):
        wall = np.where(directions[..., 1] > 0, (at - camera_.position[1]) / directions[..., 1], np.inf)
    behind = wall < frame.depth
    seen = Frame(np.where(behind[..., None], np.uint8([150, 90, 80]), frame.rgb), np.fmin(frame.depth, wall), camera_)
    assert behind.sum() > 5000 and beyond_table(seen)[behind & (seen.points[..., 2] > 0.02)].mean() > 0.98
    found = foreground(seen).pixels
    assert (found & behind).sum() < 0.02 * behind.sum() and share(found, SEEN > 0) > 0.9


def test_a_shadow_of_the_projector_is_no_object():
    """Strips beside an object that are as wide as the geometry says, of another colour; and three times as wide."""
    frame = frame_of(TWO, width=640, noise=0.3)
    rows, columns = np.nonzero(SEEN == 1)
    narrow, wide = np.zeros(SEEN.shape, bool), np.zeros(SEEN.shape, bool)
    for row in np.unique(rows):
        right = columns[rows == row].max()
        near, far = frame.depth[row, right - 2], frame.depth[row, right + 30]
        width = int(frame.camera.K[0, 0] * 0.075 * (1 / near - 1 / far))
        if far - near > 0.04:
            narrow[row, right + 1 : right + 1 + width] = True
            wide[row, right + 1 : right + 5 + 3 * width] = True
    assert narrow.sum() > 100
    assert foreground(without(frame, narrow, (20, 20, 200)), GRID).pixels[narrow].mean() < 0.1
    assert foreground(without(frame, wide, (20, 20, 200)), GRID).pixels[wide].mean() > 0.9


def test_outlines_of_the_image_are_nearer_to_the_truth_than_those_of_voxels():
    """The hypothesis has coarser voxels than the scene, and one object is a voxel too large on every side."""
    coarse = VoxelGrid(GRID.origin, 2 * GRID.voxel_size, tuple(n // 2 for n in GRID.shape))
    labels = TWO[::2, ::2, ::2].copy()
    labels[binary_dilation(labels == 2) & (labels == 0)] = 2
    hypothesis, frame = Hypothesis.from_labels(labels, coarse), frame_of(TWO, width=640, noise=0.3)
    before, after = project(hypothesis, frame.camera), outlined(hypothesis, frame)
    for k in (1, 2):
        overlap = [((one == k) & (k == SEEN)).sum() / ((one == k) | (k == SEEN)).sum() for one in (before, after)]
        assert overlap[1] > 0.93 and overlap[1] > overlap[0] + 0.02
    assert not outlined(Hypothesis.from_labels(0 * labels, coarse), frame).any()

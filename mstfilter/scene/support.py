"""Foreground: the pixels of objects on the table, in a depth image with noise and missing readings.

>>> found = foreground(frame, grid)
>>> found.pixels                        # (H, W) bool, may belong to an object
>>> found.frame.depth                   # metres, estimated where a pixel of an object has no reading of it

Pixels with a depth reading are classified by depth (`mstfilter.scene.heights`): connected regions of readings above
the table are objects. Isolated ones are noise, and so are low ones with the colour of the table, which come from
cloth, from glare, and from the depth that sensors smear from an object into the table. Walls and things beside the
table are no objects either.

Where depth fails, colour decides. Dark or shiny surfaces often have no readings, so a pixel without one belongs to an
object if its colour differs from the nearby table. Near the outline of an object, depth images have errors of several
pixels, so there the colours of the object and of the table decide. A region of another colour with readings on the
table is a flat object if it is higher than the table around it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import laplacian
from scipy.sparse.linalg import spsolve

from mstfilter.scene.arrays import read_only
from mstfilter.scene.cache import memo
from mstfilter.scene.camera import scaled_area, scaled_length
from mstfilter.scene.frame import Frame
from mstfilter.scene.heights import (
    above_table,
    filled_above_table,
    height_in_noise,
    pixels_above_table,
    posed_camera,
    readings_above_table,
    surroundings,
)
from mstfilter.scene.planes import BASELINE, TABLE_TOLERANCE, beyond_table
from mstfilter.scene.voxels import VoxelGrid

# Areas and lengths are those of an image of 640 x 480 pixels.
_FEW_BESIDE = 0.1  # share of readings around a reading: with less, the reading is noise
_SMALLEST = 25  # pixels of a region of readings
_RISE = 1.75  # mean rise of a region of readings, in tolerances
_SMALLEST_DARK = 60  # pixels of a region without readings
_COLOUR_REACH = 40.0  # standard deviation of the surroundings that show the colour of the table, pixels
_TABLE_NEAR = 0.1  # share of table in these surroundings
_COLOUR_DISTANCE = 11.3  # squared Mahalanobis distance of Lab colour from the table; 1 % of its pixels are above
_COLOUR_NOISE = (9.0, 4.0, 4.0)  # variance of Lab colour in addition to that of the table
_ON_TABLE = 0.4  # share of table around a region without readings
_ENCLOSED, _FEW_AROUND = 0.55, 0.1  # share of the readings around a region that enclose it; least share of readings
_HOLE = 0.9  # share of the readings around a hole in an object that are readings of objects
_SOLID, _GLARE = 8.0, 2.0  # radius of a solid gap, pixels; brightness of glare in standard deviations of the table
_STEP, _SHADOW = 0.02, 1.2  # smallest step of depth in metres; tolerance of the width of a shadow
_EDGE = 9  # pixels around the end of a gap that may have cast a shadow
_FEW_NEAR = 1e-3  # share of the core of objects around a pixel that shows their colours
_NARROW = 6.0  # pixels between a reading and an estimate that is this reading
_FEW = 10  # readings of an object that do not determine the depth of its other pixels
_STANDS = 0.004  # metres: least height of estimated readings above the table, without a grid
_LAYER = 0.75  # the same in voxels of the grid: at least one layer of voxel centres lies inside a flat object
_LOW = 6.0  # rise of noise with the colour of the table, in units of noise
_LIKE_TABLE = 3.0  # squared distance of such a colour
# The same beside an object: rise, squared distance of colour, least log odds of the table per unit of noise.
_SMEARED, _SHADED, _DOUBT = 30.0, 6.0, 0.8
_PLATE = 0.7  # share of the readings around the inside of a plate that are higher
_SAME_COLOUR, _OTHER_COLOUR = 2.0, 0.25  # squared distance of the colour of the table; share of pixels above it
_OUTLINE = 6.0  # pixels on both sides of an outline that are assigned by colour
_CORE = 2.0  # pixels between an outline and the core of an object
_CORE_REACH = 10.0  # standard deviation of the surroundings that show the colours of the core, pixels
_ADDED, _REMOVED = 4.0, 8.0  # log odds that a reading on the table is right, and that a reading above the table is
_FLAT, _HIGHER = 80, 0.4  # pixels of a flat object; its rise above the table around it, in sensor units
_FEWEST = 20  # pixels of an image of any size: the mean rise of fewer pixels is noisy
_BESIDE = 0.05  # share of other objects around a flat object; with more, it can be a shadow


@dataclass(frozen=True, eq=False)
class Foreground:
    """The pixels that can belong to objects, and the frame with known or estimated depth at these pixels."""

    pixels: np.ndarray  #: (H, W) bool
    frame: Frame  #: the frame, with estimated depth at pixels without a reading of the object


def foreground(frame: Frame, grid: VoxelGrid | None = None) -> Foreground:
    """The pixels of objects in the workspace, and the depth of these pixels. The result is cached.

    Parameters
    ----------
    frame : Frame
        The image.
    grid : VoxelGrid
        The workspace. By default, objects can be anywhere above the table.
    """
    key = (frame.key, None if grid is None else grid.key)
    return memo("foreground", key, lambda: _foreground(frame, grid))


def _foreground(frame: Frame, grid: VoxelGrid | None) -> Foreground:
    missing, seen = _without_readings(frame), _Colours.of(frame)
    measured = _regions_of_readings(frame, grid, seen)
    pixels = _joined(measured, _silent(frame, measured, missing, seen), seen.table, missing)
    pixels = _outlined(frame, pixels, seen)
    flat = _flat(frame, pixels, seen)
    pixels |= flat
    raised = pixels_above_table(frame)
    height = _STANDS if grid is None else _LAYER * grid.voxel_size
    depth = _with_estimates(frame, pixels, raised, flat, height)
    pixels &= np.isfinite(depth)
    if grid is not None:
        pixels &= grid.contains(grid.index_of(posed_camera(frame).unproject(depth)))
    estimated = pixels & ~raised & ~flat
    if not (flat | estimated).any():
        return Foreground(read_only(pixels), frame)
    mended = replace(frame, depth=np.where(pixels, depth, frame.depth), estimated=read_only(estimated))
    return Foreground(read_only(pixels), mended)


@dataclass(frozen=True, eq=False)
class _Colours:
    """The colours of an image, compared with the colours of the nearby table."""

    table: np.ndarray  #: (H, W) bool, whether a pixel has a reading on the table
    lab: np.ndarray  #: (H, W, 3) CIELAB
    near: np.ndarray  #: (H, W) bool, whether the table is near
    brightness: np.ndarray  #: (H, W) difference from the table in standard deviations
    distance: np.ndarray  #: (H, W) squared Mahalanobis distance from the colours of the table
    log_variance: np.ndarray  #: (H, W) log of the product of the variances of the colours of the table

    @classmethod
    def of(cls, frame: Frame) -> _Colours:
        """The colours of a frame. Without table near a pixel, the pixel is compared with the whole table."""
        table, lab = _on_table(frame), cv2.cvtColor(frame.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)
        lab = cv2.GaussianBlur(lab, (0, 0), max(0.7, scaled_length(1, frame.camera.width)))
        share, mean, variance = _around(lab, table, _COLOUR_REACH)
        near = share > _TABLE_NEAR
        if table.any():
            mean[~near], variance[~near] = lab[table].mean(axis=0), lab[table].var(axis=0) + _COLOUR_NOISE
        deviation = (lab - mean) / np.sqrt(variance)
        return cls(table, lab, near, deviation[..., 0], (deviation**2).sum(axis=-1), np.log(variance).sum(axis=-1))

    def like_object(self, core: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Share (H, W) of the core (H, W) bool of objects near each pixel, and log likelihood ratio of its colours.

        The ratio (H, W) is that of two normal distributions: of the nearby core and of the nearby table.
        """
        share, mean, variance = _around(self.lab, core, _CORE_REACH)
        distance = ((self.lab - mean) ** 2 / variance).sum(axis=-1)
        log_ratio = 0.5 * (self.distance + self.log_variance - distance - np.log(variance).sum(axis=-1))
        return share, log_ratio


def _regions_of_readings(frame: Frame, grid: VoxelGrid | None, seen: _Colours) -> np.ndarray:
    """Pixels (H, W) bool of connected regions of readings above the table, without noise.

    A low region with the colour of the table is noise, whatever its size. The heights of pixels of another colour are
    in sensor units, as two kinds of evidence are enough.
    """
    coloured = seen.distance > _COLOUR_DISTANCE
    height = np.where(coloured, filled_above_table(frame), height_in_noise(frame, filled=True))
    height = np.minimum(np.nan_to_num(height, posinf=1e3), 1e3)
    raised = readings_above_table(frame, grid) & (height > TABLE_TOLERANCE) & ~beyond_table(frame)
    raised &= ~_doubtful(frame, raised, height, seen) & ~(_beside_beyond(frame) & (height < _SMEARED))
    solid = raised | (~frame.valid & (height > TABLE_TOLERANCE))
    core = cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    regions, _ = ndimage.label(core)
    area, rise, other = (
        np.bincount(regions.ravel(), weights=values.ravel())
        for values in (np.ones(core.shape), height, seen.distance > _SAME_COLOUR)
    )
    kept = (area >= scaled_area(_SMALLEST, raised.size)) & (rise > _RISE * TABLE_TOLERANCE * area)
    kept &= (other > _OTHER_COLOUR * area) | (rise >= _LOW * area)
    kept[0] = False
    return (cv2.dilate(kept[regions].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & raised


def _doubtful(frame: Frame, raised: np.ndarray, height: np.ndarray, seen: _Colours) -> np.ndarray:
    """Pixels (H, W) bool of low `raised` readings that have the colour of the table and not that of an object.

    Around objects, sensors smear the depth into the table; glare, cloth, and the end of a table rise too. The colours
    of the nearby higher readings decide. Without any nearby, a low reading with the colour of the table is doubtful.
    A low region that higher readings enclose is the inside of a plate.
    """
    low = raised & (height < _SMEARED)
    high = (raised & ~low).astype(np.uint8)
    share, log_ratio = seen.like_object(cv2.erode(high, _ellipse(scaled_length(_CORE, frame.camera.width))) > 0)
    beside = (seen.distance < _SHADED) & (-log_ratio > _DOUBT * height)
    alone = (seen.distance < _LIKE_TABLE) & (height < _LOW)
    found = _opened(low & np.where(share > _FEW_NEAR, beside, alone), 1)
    return found & ~_enclosed(found, raised & ~found, frame.valid, _PLATE)


def _on_table(frame: Frame) -> np.ndarray:
    """Pixels (H, W) bool with a reading on the table."""
    with np.errstate(invalid="ignore"):
        return frame.valid & (np.abs(above_table(frame)) <= TABLE_TOLERANCE)


def _without_readings(frame: Frame) -> np.ndarray:
    """Pixels (H, W) bool without reading that can show an object.

    They do not show the robot, are not in the shadow of the projector, and not beside what is beyond the table.
    """
    missing = ~np.isfinite(frame.depth) & ~_shadows(frame) & ~_beside_beyond(frame)
    return missing if frame.robot_mask is None else missing & ~frame.robot_mask


def _beside_beyond(frame: Frame) -> np.ndarray:
    """Pixels (H, W) bool beside walls and what else is beyond the table, where depth is smeared or missing."""
    return cv2.dilate(beyond_table(frame).astype(np.uint8), _ellipse(2 * _reach(frame.camera.width))) > 0


def _shadows(frame: Frame) -> np.ndarray:
    """Pixels (H, W) bool in the shadow that a nearer surface casts in the light of the projector of the sensor.

    A shadow in an image row between depths z1 < z2 is at most f b (1 / z1 - 1 / z2) pixels wide. The symbol f is the
    focal length, and b is the baseline of a Kinect. The projector may be on the left or on the right of the camera.
    """
    read = np.isfinite(frame.depth)  # also of the robot, which casts shadows
    columns = np.broadcast_to(np.arange(frame.camera.width), read.shape)
    last = np.maximum.accumulate(np.where(read, columns, -1), axis=1)
    following = np.minimum.accumulate(np.where(read, columns, frame.camera.width)[:, ::-1], axis=1)[:, ::-1]
    between = ~read & (last >= 0) & (following < frame.camera.width)
    rows, at = np.nonzero(between)
    first, second = last[rows, at], following[rows, at]
    far = np.maximum(frame.depth[rows, first], frame.depth[rows, second])
    # The edge that casts the shadow can be a few pixels away from the gap. A single near reading is noise.
    beside = ndimage.rank_filter(np.where(read, frame.depth, np.inf), rank=1, size=(1, _EDGE))
    near = np.minimum(beside[rows, first], beside[rows, second])
    widest = frame.camera.K[0, 0] * BASELINE * (1 / near - 1 / far)
    shadow = np.zeros(read.shape, bool)
    shadow[rows, at] = (far - near > _STEP) & (second - first - 1 <= _SHADOW * widest + 2)
    return shadow


def _silent(frame: Frame, measured: np.ndarray, missing: np.ndarray, seen: _Colours) -> np.ndarray:
    """The pixels (H, W) bool without a depth reading that are assigned to objects by colour or by outline.

    A pixel near the table must differ in colour from the nearby table. A pixel far from the table must differ from
    the colours of the whole table, and readings of objects (`measured`) must enclose its region. A gap of any colour
    that is a hole in an object belongs to the object. A large gap in the readings of the table that is not brighter
    than the table also belongs to an object, for example a glass.
    """
    searched = missing & _measured_part(frame)
    other = _opened(searched & (seen.distance > _COLOUR_DISTANCE), 1)
    enclosed = _enclosed(other & ~seen.near, measured, frame.valid)
    gaps = _opened(searched & (seen.brightness < _GLARE), scaled_length(_SOLID, frame.camera.width))
    holes = _enclosed(_opened(searched, 1), measured, frame.valid, _HOLE)
    return (other & seen.near) | enclosed | holes | _enclosed(gaps, seen.table, frame.valid)


def _outlined(frame: Frame, pixels: np.ndarray, seen: _Colours) -> np.ndarray:
    """The pixels (H, W) bool of objects, with outlines that follow the colours.

    A pixel near an outline is assigned by the likelihood ratio of two normal distributions of colours: of the nearby
    core of objects and of the nearby table. The prior odds say how reliable a depth reading is near an outline.
    Pixels without a reading are not added, because the estimates of their depth made simulated shapes worse.
    """
    width, image = frame.camera.width, pixels.astype(np.uint8)
    beside = _ellipse(scaled_length(_OUTLINE, width))
    asked = (cv2.dilate(image, beside) > cv2.erode(image, beside)) & seen.near & (frame.valid | pixels)
    core = cv2.erode(image, _ellipse(scaled_length(_CORE, width))) > 0
    regions, _ = ndimage.label(pixels)
    core |= pixels & ~np.isin(regions, regions[core])  # a thin object is its own core
    share, log_ratio = seen.like_object(core)
    log_prior = np.where(frame.valid, np.where(pixels, _REMOVED, -_ADDED), 0)
    return np.asarray(np.where(asked & (share > _FEW_NEAR), log_ratio + log_prior > 0, pixels))


def _flat(frame: Frame, pixels: np.ndarray, seen: _Colours) -> np.ndarray:
    """Pixels (H, W) bool of flat objects: regions of another colour that are a little higher than the table around.

    `pixels` (H, W) bool are those of other objects. A region beside another object can be its shadow, which the depth
    errors at the outline of the object raise, and is not used.
    """
    bare, rise = seen.table & ~pixels, above_table(frame)
    other = _opened(frame.valid & ~pixels & seen.near & (seen.distance > _COLOUR_DISTANCE), 1)
    regions, _ = ndimage.label(other)
    kept = np.bincount(regions.ravel()) >= max(_FEWEST, scaled_area(_FLAT, pixels.size))
    kept[0] = False
    for k, box in enumerate(ndimage.find_objects(regions), start=1):
        if kept[k]:
            ring, around = _ring(regions, k, box)
            beside = ring & bare[around]
            kept[k] = (
                pixels[around][ring].mean() <= _BESIDE
                and beside.sum() >= _ON_TABLE * ring.sum()
                and rise[box][regions[box] == k].mean() - rise[around][beside].mean() > _HIGHER
            )
    return np.asarray(kept[regions])


def _around(image: np.ndarray, pixels: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Share (H, W) of `pixels` (H, W) bool around each pixel, and mean and variance (H, W, 3) of their colours.

    The surroundings have a standard deviation of `reach` pixels of an image of 640 x 480 pixels.
    """
    share = surroundings(pixels.astype(np.float32), reach)
    n = np.maximum(share, 1e-6)[..., None]
    mean = surroundings(image * pixels[..., None], reach) / n
    variance = np.maximum(surroundings(image**2 * pixels[..., None], reach) / n - mean**2, 0) + _COLOUR_NOISE
    return share, mean, variance


def _opened(pixels: np.ndarray, radius: float) -> np.ndarray:
    return cv2.morphologyEx(pixels.astype(np.uint8), cv2.MORPH_OPEN, _ellipse(radius)) > 0


def _enclosed(pixels: np.ndarray, by: np.ndarray, valid: np.ndarray, share: float = _ENCLOSED) -> np.ndarray:
    """The connected regions of `pixels` (H, W) bool around which a share of the readings is in `by` (H, W) bool."""
    regions, n = ndimage.label(pixels)
    kept = np.zeros(n + 1, bool)
    for k, box in enumerate(ndimage.find_objects(regions), start=1):
        ring, around = _ring(regions, k, box)
        read = ring & valid[around]
        kept[k] = read.sum() > _FEW_AROUND * ring.sum() and by[around][read].mean() >= share
    kept[0] = False
    return np.asarray(kept[regions])


def _measured_part(frame: Frame) -> np.ndarray:
    """The convex hull (H, W) bool of the readings. Registered depth images have empty margins."""
    part = np.zeros(frame.depth.shape, np.uint8)
    beside = cv2.blur(frame.valid.astype(np.float32), (5, 5))
    points = cv2.findNonZero((frame.valid & (beside > _FEW_BESIDE)).astype(np.uint8))
    if points is not None:
        cv2.fillConvexPoly(part, cv2.convexHull(points), 1)
    return part > 0


def _joined(measured: np.ndarray, silent: np.ndarray, table: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Pixels of objects: readings of objects, and regions of missing readings beside objects or surrounded by table.

    All images are (H, W) bool. Small gaps between the pixels of objects are closed.
    """
    either = (measured | silent).astype(np.uint8)
    closed = cv2.morphologyEx(either, cv2.MORPH_CLOSE, _ellipse(scaled_length(2, measured.shape[1]))) > 0
    regions, n = ndimage.label(closed & (measured | missing))
    kept = np.zeros(n + 1, bool)
    kept[regions[measured]] = True
    for k, box in enumerate(ndimage.find_objects(regions), start=1):
        kept[k] |= not kept[k] and _stands_alone(regions, k, box, table)
    kept[0] = False
    return np.asarray(kept[regions])


def _stands_alone(regions: np.ndarray, k: int, box: tuple[slice, slice], table: np.ndarray) -> bool:
    """Whether region `k` of a label image (H, W) of missing readings is large enough and surrounded by the table."""
    height, width = regions.shape
    rows, columns = box
    if (regions[box] == k).sum() < scaled_area(_SMALLEST_DARK, regions.size):
        return False
    reach = _reach(width)
    if min(rows.start, columns.start, height - rows.stop, width - columns.stop) < reach:
        return False  # the sensor has no readings at the rim of the image
    ring, around = _ring(regions, k, box)
    return bool(table[around][ring].mean() >= _ON_TABLE)


def _ring(regions: np.ndarray, k: int, box: tuple[slice, slice]) -> tuple[np.ndarray, tuple[slice, slice]]:
    """The pixels around region `k` of a label image: a mask (h, w) bool, and the rows and columns of the mask."""
    reach = _reach(regions.shape[1])
    rows, columns = (slice(max(0, side.start - reach), side.stop + reach) for side in box)
    inside = regions[rows, columns] == k
    return (cv2.dilate(inside.astype(np.uint8), _ellipse(reach)) > 0) & ~inside, (rows, columns)


def _reach(width: int) -> int:
    return max(1, round(scaled_length(4, width)))


def _ellipse(radius: float) -> np.ndarray:
    size = 2 * max(1, round(radius)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))


def _with_estimates(
    frame: Frame, pixels: np.ndarray, known: np.ndarray, flat: np.ndarray, height: float
) -> np.ndarray:
    """Depth (H, W) with estimates at pixels of objects that are not `known` (H, W) bool.

    In a narrow gap, the estimate is the nearest reading, because two objects can meet in a gap. In a wide gap,
    inverse depth is interpolated by a harmonic function, which is exact on planes. If an object has fewer than ten
    readings, the estimate is the smallest depth of the table at its pixels. Estimates, and the readings of `flat`
    objects (H, W) bool, are at least `height` metres above the table.
    """
    camera, depth = posed_camera(frame), np.array(frame.depth)
    down = camera.rays() @ camera.pose.as_matrix()[2, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        lowest = np.where(down < 0, (height - camera.position[2]) / down, np.inf)
    lowest[lowest <= 0] = np.inf  # the camera is below
    regions, _ = ndimage.label(pixels & ~flat)
    for k, box in enumerate(ndimage.find_objects(regions), start=1):
        inside = regions[box] == k
        read, missing = inside & known[box], inside & ~known[box]
        if missing.any():
            few = read.sum() < _FEW
            depth[box][missing] = (
                lowest[box][inside].min() if few else _estimated(depth[box], read, missing, frame.camera.width)
            )
    return np.where(flat | (pixels & ~known), np.minimum(depth, lowest), depth)


def _estimated(depth: np.ndarray, known: np.ndarray, missing: np.ndarray, width: int) -> np.ndarray:
    """Estimated depth (n,) at the `missing` pixels of a region, from the `known` pixels; both (H, W) bool.

    `width` is the width of the whole image.
    """
    distance, (rows, columns) = ndimage.distance_transform_edt(~known, return_indices=True)
    filled = np.array(depth[rows, columns])
    wide = missing & (distance > scaled_length(_NARROW, width))
    if wide.any():
        filled[wide] = _interpolated(filled, (known | missing) & ~wide, wide)
    return filled[missing]


def _interpolated(depth: np.ndarray, known: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Depth (n,) at missing pixels. The inverse depth is the mean over the neighbours (Laplace's equation).

    `known` and `missing` (H, W) bool are the pixels of one connected region. Only `known` gives boundary conditions.
    """
    used, asked = known | missing, missing.ravel()
    graph = pixel_graph(used[:, :-1] & used[:, 1:], used[:-1] & used[1:])
    equations = laplacian(graph + graph.T).tocsr()[asked]
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float64).ravel()
    return np.asarray(1 / spsolve(equations[:, asked].tocsc(), -(equations @ inverse)))


def pixel_graph(right: np.ndarray, down: np.ndarray) -> coo_array:
    """Adjacency matrix (H W, H W) of the pixels of an image, with one entry for each pair of joined neighbours.

    `right` (H, W - 1) and `down` (H - 1, W) bool say whether a pixel is joined to its right or its lower neighbour.
    """
    shape = len(right), down.shape[1]
    pixel = np.arange(shape[0] * shape[1]).reshape(shape)
    first = np.concatenate([pixel[:, :-1][right], pixel[:-1][down]])
    second = np.concatenate([pixel[:, 1:][right], pixel[1:][down]])
    return coo_array((np.ones(len(first)), (first, second)), shape=(pixel.size, pixel.size))

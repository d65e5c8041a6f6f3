"""Measurements of image regions and of their common borders.

A region is described by a row of sums over its pixels, so the row of a merged region is the sum of the rows of its
parts. Disparity is in sensor units (1/8 px at f = 525 px), and lengths are in metres.

>>> leaves = object_leaves(watershed, pixels)                 # objects do not share a leaf with the table
>>> regions = measure_regions(leaves, frame, boundary)
>>> regions.sums.shape, regions.borders[0]                    # region 0 is the table
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import connected_components

from mstfilter.mst.segmentation.boundary import curvature, filled_disparity
from mstfilter.scene import Frame, above_table, pixel_graph, posed_camera, scaled_area, scaled_length

#: Bin width of the height histogram in metres; the last bin has no upper limit.
HEIGHT_BIN = 0.01
_BINS = 32
_QUADRIC = 6
_SMALLEST_LEAF, _LEAF_REACH = 20, 4  # pixels of a leaf; distance at which a smaller one joins it
#: Smallest clear step of disparity, in sensor disparity units.
_CLEAR_STEP = 4.0

_WIDTHS = {
    "pixels": 1,
    "lab": 3,
    "lab2": 3,
    "gram": _QUADRIC * _QUADRIC,
    "moment": _QUADRIC,
    "square": 1,
    "ground": 2,
    "spread": 1,
    "bend": 1,
    "heights": _BINS,
    "centre": 2,
    "perimeter": 1,
}


def _columns(widths: dict[str, int]) -> dict[str, slice]:
    ends = np.cumsum(list(widths.values())).tolist()
    return {name: slice(end - n, end) for (name, n), end in zip(widths.items(), ends, strict=True)}


#: Columns of `Regions.sums`. All but the perimeter are sums over the region's readings above the table: their number,
#: Lab colour and its squares, normal equations and squares of the quadric fit of disparity, ground coordinates (m)
#: and their squares, signed curvature of disparity (> 0 where the surface is concave), histogram of heights, column
#: and row of the object's centre that a network sees (0 without one). The perimeter is the number of pairs of
#: neighbouring pixels of which one is outside the region.
REGION = _columns(_WIDTHS)

#: Columns of a border: number of neighbouring pixel pairs, sums over them of boundary strength, concave ("hollow")
#: and convex curvature, step of disparity (first region minus second) and its magnitude, number of clear steps, and
#: the sum of the log odds of a border that a network sees (0 without one).
BORDER = {
    name: k for k, name in enumerate(("length", "strength", "hollow", "convex", "step", "size", "clear", "seen"))
}
BORDER_SIGN = np.array([1, 1, 1, 1, -1, 1, 1, 1], dtype=np.float64)  #: of a border seen from its other side
_MOST_LOG_ODDS = 6.0  # of a seen border


@dataclass(frozen=True, eq=False)
class SeenBorders:
    """The output of a border network for a frame."""

    border: np.ndarray  #: (H, W) float32, calibrated log odds that the pixel is at the border of an object
    foreground: np.ndarray  #: (H, W) float32, log odds that the pixel belongs to an object
    centre: np.ndarray  #: (H, W, 2) float32, column and row of the centre of the pixel's object


@dataclass(frozen=True, eq=False)
class Regions:
    """Measured regions of an image."""

    image: np.ndarray  #: (H, W) int, region of every pixel; 0 is the table
    sums: np.ndarray  #: (R, C) columns `REGION`
    #: For each region a mapping from neighbour to the row (columns `BORDER`) of the common border, with the region
    #: as the first of the two.
    borders: list[dict[int, np.ndarray]]


def object_leaves(leaves: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Split leaves (H, W) int at the outline of `pixels` (H, W) bool. Other pixels become 0.

    Each connected part of a leaf becomes a leaf. Parts of a few pixels join the nearest larger part.
    """
    image = np.where(pixels, leaves + 1, 0)
    parts = connected_pixels(image[:, :-1] == image[:, 1:], image[:-1] == image[1:])
    sizes = np.bincount(parts[pixels], minlength=int(parts.max()) + 1)
    large = sizes >= scaled_area(_SMALLEST_LEAF, pixels.size)
    if large.any():
        near, (rows, columns) = distance_transform_edt(~large[parts], return_indices=True)
        joins = pixels & (near <= _LEAF_REACH)
        parts = np.where(joins, parts[rows, columns], parts)
    numbers = np.zeros(int(parts.max()) + 1, np.int64)
    used = np.unique(parts[pixels])
    numbers[used] = np.arange(1, len(used) + 1)
    return np.where(pixels, numbers[parts], 0)


def connected_pixels(right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Index (H, W) of the connected component of each pixel of an image.

    `right` (H, W - 1) and `down` (H - 1, W) bool say whether a pixel is joined to its right or its lower neighbour.
    """
    parts = connected_components(pixel_graph(right, down), directed=False)[1]
    return np.asarray(parts.reshape(len(right), down.shape[1]))


def measure_regions(
    region: np.ndarray, frame: Frame, boundary: np.ndarray, seen: SeenBorders | None = None
) -> Regions:
    """Measure regions (H, W) int of an image, with a boundary map (H, W) and the output of a border network.

    Region 0 is the table and all other pixels without an object. See `object_leaves`.
    """
    n = int(region.max()) + 1
    bend, maps, smooth = edge_maps(frame, boundary, seen)
    sums = _region_sums(region, n, frame, bend, seen)
    borders = _borders(region, n, maps, smooth)
    sums[:, REGION["perimeter"].start] = [sum(row[0] for row in near.values()) for near in borders]
    return Regions(region, sums, borders)


def edge_maps(
    frame: Frame, boundary: np.ndarray, seen: SeenBorders | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the rows of regions and borders are sums of.

    The concave minus the convex curvature (H, W); the boundary strength, both curvatures and the log odds of a border
    (H, W, 4); the smoothed disparity (H, W).
    """
    width = boundary.shape[1]
    D = filled_disparity(frame)
    hollow, convex = curvature(D, scaled_length(1, width))
    smooth = cv2.GaussianBlur(D, (0, 0), max(0.7, scaled_length(1.5, width)))
    # The border that the network sees can be beside that of the leaves: the largest log odds in the surroundings.
    reach = 2 * max(1, round(scaled_length(2, width))) + 1
    odds = np.zeros(boundary.shape, np.float32) if seen is None else seen.border
    odds = np.clip(cv2.dilate(odds, np.ones((reach, reach), np.uint8)), -_MOST_LOG_ODDS, _MOST_LOG_ODDS)
    return hollow - convex, np.stack([boundary, hollow, convex, odds], axis=-1), smooth


def _region_sums(region: np.ndarray, n: int, frame: Frame, bend: np.ndarray, seen: SeenBorders | None) -> np.ndarray:
    """Sums (n, C) over the depth readings of each region. The columns are `REGION`; the perimeter is 0.

    `bend` (H, W) is the concave minus the convex curvature.
    """
    at = np.nonzero(frame.valid & (region > 0))
    which = region[at]
    terms, bins = pixel_terms(frame, bend, seen, at)
    sums = np.zeros((n, sum(_WIDTHS.values())))
    for k in np.flatnonzero(terms.any(axis=0)).tolist():
        sums[:, k] = np.bincount(which, weights=terms[:, k], minlength=n)
    sums[:, REGION["heights"]] = np.bincount(which * _BINS + bins, minlength=n * _BINS).reshape(n, _BINS)
    return sums


def pixel_terms(
    frame: Frame, bend: np.ndarray, seen: SeenBorders | None, at: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """What each of the k pixels `at` (rows, columns) adds to the sums of its region (columns `REGION`).

    Returns the terms (k, C), in which heights and perimeter are 0, and the bins (k,) of the heights. All pixels have
    readings. `bend` (H, W) is the concave minus the convex curvature.
    """
    height, width = bend.shape
    found = np.zeros((len(at[0]), sum(_WIDTHS.values())))

    def put(name: str, *values: np.ndarray) -> None:
        for k, value in enumerate(values, start=REGION[name].start):
            found[:, k] = value

    lab = cv2.cvtColor(frame.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)[at]
    put("pixels", np.ones(len(lab)))
    put("lab", *lab.T)
    put("lab2", *(lab.T**2))
    u, v = (at[1] - width / 2) / (width / 4), (at[0] - height / 2) / (width / 4)
    terms = np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v])
    # Relative to the table the numbers are smaller; the table is affine, so the residuals are the same.
    d = np.minimum(above_table(frame)[at], 1e3)
    put("gram", *(a * b for a in terms for b in terms))
    put("moment", *(terms * d))
    put("square", d * d)
    points = posed_camera(frame).unproject(frame.depth)[at]
    put("ground", points[:, 0], points[:, 1])
    put("spread", points[:, 0] ** 2 + points[:, 1] ** 2)
    put("bend", bend[at])
    if seen is not None:
        put("centre", *seen.centre[at].T)
    return found, np.clip(points[:, 2] / HEIGHT_BIN, 0, _BINS - 1).astype(np.int64)


def _borders(region: np.ndarray, n: int, maps: np.ndarray, disparity: np.ndarray) -> list[dict[int, np.ndarray]]:
    """For every region, a mapping from the number of a neighbour to the border row (columns `BORDER`).

    `maps` (H, W, 4) has the boundary strength, the concave and the convex curvature, and the log odds of a border.
    """
    first, second, rows = [], [], []
    for axis in (0, 1):
        last = region.shape[axis] - 1
        pair_a, pair_b = np.take(region, np.arange(last), axis), np.take(region, np.arange(1, last + 1), axis)
        at = np.nonzero(pair_a != pair_b)
        i, j = pair_a[at], pair_b[at]
        row = border_terms(maps, disparity, axis, at)
        turned = i > j
        row[turned] *= BORDER_SIGN
        first.append(np.minimum(i, j))
        second.append(np.maximum(i, j))
        rows.append(row)
    code = np.concatenate(first) * n + np.concatenate(second)
    pairs, inverse = np.unique(code, return_inverse=True)
    table = np.stack(
        [np.bincount(inverse, weights=column, minlength=len(pairs)) for column in np.concatenate(rows).T], axis=1
    )
    borders: list[dict[int, np.ndarray]] = [{} for _ in range(n)]
    for k, pair in enumerate(pairs.tolist()):
        i, j = divmod(pair, n)
        borders[i][j] = table[k]
        borders[j][i] = table[k] * BORDER_SIGN
    return borders


def border_terms(maps: np.ndarray, disparity: np.ndarray, axis: int, at: tuple[np.ndarray, ...]) -> np.ndarray:
    """What each of k pairs of neighbouring pixels adds to the row of its border, (k, columns `BORDER`).

    A pair is the pixel `at` (rows, columns) and the next one along the `axis`. `maps` as in `_borders`.
    """
    reach = max(1, round(scaled_length(3, disparity.shape[1])))
    # Step of disparity, measured `reach` pixels away from the border on both sides, minus the change that the slopes
    # on both sides predict over that distance.
    far_a, near_a, near_b, far_b = (
        _shifted(disparity, at, axis, shift) for shift in (-2 * reach, -reach, 1 + reach, 1 + 2 * reach)
    )
    slopes = (near_a - far_a) + (far_b - near_b)
    raw = near_a - near_b
    step = raw + slopes * ((2 * reach + 1) / (2 * reach))
    step = np.where(np.sign(step) == np.sign(raw), np.sign(raw) * np.minimum(np.abs(step), np.abs(raw)), 0)
    step = np.clip(step, -20, 20)
    other = list(at)
    other[axis] = at[axis] + 1
    edge, size = (maps[at] + maps[tuple(other)]) / 2, np.abs(step)
    return np.column_stack([np.ones(len(step)), edge[:, :3], step, size, size > _CLEAR_STEP, edge[:, 3]])


def _shifted(image: np.ndarray, at: tuple[np.ndarray, ...], axis: int, shift: int) -> np.ndarray:
    """Values of an image (H, W) at pixels shifted along an axis. Pixels outside the image take the edge value."""
    index = list(at)
    index[axis] = np.clip(at[axis] + shift, 0, image.shape[axis] - 1)
    return image[tuple(index)]

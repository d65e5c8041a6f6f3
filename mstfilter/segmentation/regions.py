"""Measurements of image regions and of their common borders, and features of pairs of regions.

Regions and borders are measured as sums over pixels, so the row of a merged region is the sum of two rows.

>>> regions = measure_regions(leaves, frame, boundary)
>>> regions.of_leaf[leaf], regions.sums.shape, regions.borders[0]              # region 0 is the table
>>> x = pair_features(sums[a], sums[b], border, table_a, table_b, scale)       # (k, len(PAIR_FEATURES))

The features are inputs of the log odds that two regions are different objects. Sizes are in pixels of a 640 px wide
image, disparity in sensor units (1/8 px at f = 525 px), lengths in metres. "Front" is the region that is nearer to
the camera at the border.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.scene import Frame, fit_support_plane
from mstfilter.segmentation.boundary import (
    TABLE_TOLERANCE,
    above_table,
    curvature,
    filled_disparity,
    pixels_above_table,
)
from mstfilter.segmentation.join_weights import JOIN_WEIGHTS

#: Bin width of the height histogram in metres; the last bin has no upper limit.
_HEIGHT_BIN = 0.01
_BINS = 32
_QUADRIC = 6
#: Smallest share of pixels above the table of a leaf that is part of an object.
_MIXED = 0.1
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
_SIGN = np.array([1, 1, 1, 1, -1, 1, 1, 1], dtype=np.float64)
_MOST_LOG_ODDS = 6.0  # of a seen border


@dataclass(frozen=True, eq=False)
class SeenBorders:
    """What a border network sees in a frame."""

    border: np.ndarray  #: (H, W) float32, calibrated log odds that the pixel is at the border of an object
    foreground: np.ndarray  #: (H, W) float32, log odds that the pixel belongs to an object
    centre: np.ndarray  #: (H, W, 2) float32, column and row of the centre of the pixel's object


@dataclass(frozen=True, eq=False)
class Regions:
    """Measured leaves of a tree. All leaves of the table form one region."""

    of_leaf: np.ndarray  #: (n_leaves,) int, region of every leaf; 0 is the table
    sums: np.ndarray  #: (R, C) columns `REGION`
    #: For each region a mapping from neighbour to the row (columns `BORDER`) of the common border, with the region
    #: as the first of the two.
    borders: list[dict[int, np.ndarray]]


def measure_regions(
    leaves: np.ndarray, frame: Frame, boundary: np.ndarray, seen: SeenBorders | None = None
) -> Regions:
    """Measure the leaves (H, W) of a tree of a boundary map (H, W), and what a network sees.

    A leaf belongs to the table if most of its pixels do.
    """
    height, width = leaves.shape
    n_leaves = int(leaves.max()) + 1
    flat = leaves.ravel()
    above = above_table(frame)
    raised = pixels_above_table(frame)
    areas = np.bincount(flat, minlength=n_leaves)
    # A leaf that contains object and table pixels is an object. Rays above the horizon of the table (infinite
    # disparity above it) make a leaf an object only if they are the majority.
    meets = raised & (above < np.inf)
    of_leaf = np.where(_raised(flat, above, meets, areas, _MIXED) | _raised(flat, above, raised, areas, 0.5), 1, 0)
    of_leaf[of_leaf > 0] = 1 + np.arange(int(of_leaf.sum()))
    region = of_leaf[leaves]
    n = int(of_leaf.max()) + 1

    D = filled_disparity(frame)
    hollow, convex = curvature(D, width / 640)
    sums = np.zeros((n, sum(_WIDTHS.values())))
    at = np.nonzero(raised & (region > 0))
    which = region[at]

    def put(name: str, *values: np.ndarray) -> None:
        block = REGION[name]
        for k, value in enumerate(values):
            sums[:, block.start + k] = np.bincount(which, weights=value, minlength=n)

    import cv2

    lab = cv2.cvtColor(frame.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)[at]
    put("pixels", np.ones(len(which)))
    put("lab", *lab.T)
    put("lab2", *(lab.T**2))
    u, v = (at[1] - width / 2) / (width / 4), (at[0] - height / 2) / (width / 4)
    terms = np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v])
    # Relative to the table the numbers are smaller; the table is affine, so the residuals are the same.
    d = np.minimum(above[at], 1e3)
    put("gram", *(a * b for a in terms for b in terms))
    put("moment", *(terms * d))
    put("square", d * d)
    camera = frame.camera
    if camera.T_world_camera is None:
        camera = camera.at(fit_support_plane(frame).T_world_camera)
    points = camera.unproject(frame.depth)[at]
    put("ground", points[:, 0], points[:, 1])
    put("spread", points[:, 0] ** 2 + points[:, 1] ** 2)
    put("bend", (hollow - convex)[at])
    if seen is not None:
        put("centre", *seen.centre[at].T)
    bins = np.clip(points[:, 2] / _HEIGHT_BIN, 0, _BINS - 1).astype(np.int64)
    sums[:, REGION["heights"]] = np.bincount(which * _BINS + bins, minlength=n * _BINS).reshape(n, _BINS)

    smooth = cv2.GaussianBlur(D, (0, 0), max(0.7, 1.5 * width / 640))
    # The border that the network sees can be beside that of the leaves: the largest log odds in the surroundings.
    reach = 2 * max(1, round(2 * width / 640)) + 1
    odds = np.zeros(leaves.shape, np.float32) if seen is None else seen.border
    odds = np.clip(cv2.dilate(odds, np.ones((reach, reach), np.uint8)), -_MOST_LOG_ODDS, _MOST_LOG_ODDS)
    borders = _borders(region, n, boundary, hollow, convex, smooth, odds)
    sums[:, REGION["perimeter"].start] = [sum(row[0] for row in near.values()) for near in borders]
    return Regions(of_leaf, sums, borders)


def _raised(flat: np.ndarray, above: np.ndarray, mask: np.ndarray, areas: np.ndarray, fraction: float) -> np.ndarray:
    """Leaves with more than this fraction of pixels in the mask, and a mean height there above 1.75 tolerances."""
    inside = np.bincount(flat[mask.ravel()], minlength=len(areas))
    rise = np.bincount(flat[mask.ravel()], weights=np.minimum(above[mask], 1e3), minlength=len(areas))
    raised: np.ndarray = (inside > fraction * areas) & (rise > 1.75 * TABLE_TOLERANCE * inside)
    return raised


def _borders(
    region: np.ndarray,
    n: int,
    boundary: np.ndarray,
    hollow: np.ndarray,
    convex: np.ndarray,
    disparity: np.ndarray,
    odds: np.ndarray,
) -> list[dict[int, np.ndarray]]:
    """For every region its neighbours and the border rows (columns `BORDER`)."""
    reach = max(1, round(3 * region.shape[1] / 640))
    first, second, rows = [], [], []
    for axis in (0, 1):
        size = region.shape[axis]
        pair_a, pair_b = np.take(region, np.arange(size - 1), axis), np.take(region, np.arange(1, size), axis)
        at = np.nonzero(pair_a != pair_b)
        i, j = pair_a[at], pair_b[at]
        # Step of disparity, measured `reach` pixels away from the border on both sides, minus the change that the
        # slopes on both sides predict over that distance.
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
        here, there = at, tuple(other)
        row = np.stack(
            [
                np.ones(len(i)),
                (boundary[here] + boundary[there]) / 2,
                (hollow[here] + hollow[there]) / 2,
                (convex[here] + convex[there]) / 2,
                step,
                np.abs(step),
                np.abs(step) > _CLEAR_STEP,
                (odds[here] + odds[there]) / 2,
            ],
            axis=1,
        )
        turned = i > j
        row[turned] *= _SIGN
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
        borders[j][i] = table[k] * _SIGN
    return borders


def _shifted(image: np.ndarray, at: tuple[np.ndarray, ...], axis: int, shift: int) -> np.ndarray:
    """Values of an image (H, W) at pixels moved along an axis; pixels outside take the value at the edge."""
    index = list(at)
    index[axis] = np.clip(at[axis] + shift, 0, image.shape[axis] - 1)
    return image[tuple(index)]


PAIR_FEATURES = tuple(JOIN_WEIGHTS)  #: Names of the columns of `pair_features`


def quadric_residual(sums: np.ndarray) -> np.ndarray:
    """Squared residual (k,) of the least-squares quadric of disparity of each region (k, C), sensor units squared."""
    gram = sums[:, REGION["gram"]].reshape(-1, 6, 6)
    moment = sums[:, REGION["moment"]]
    n = sums[:, REGION["pixels"].start]
    ridge = (1e-9 * n + 1e-9)[:, None, None] * np.eye(6)
    fit = np.linalg.solve(gram + ridge, moment[..., None])[..., 0]
    return np.maximum(sums[:, REGION["square"].start] - (moment * fit).sum(axis=1), 0)


def pair_features(
    a: np.ndarray, b: np.ndarray, border: np.ndarray, table_a: np.ndarray, table_b: np.ndarray, scale: float
) -> np.ndarray:
    """Features of k pairs of regions, from their rows `a` and `b` (k, C) of `Regions.sums`.

    `border` (k, B) are their common borders, seen from `a`; `table_a` and `table_b` (k, B) their borders with the
    table, zeros if there is none. `scale` is the image width / 640.
    """
    flip = (border[:, BORDER["step"]] < 0)[:, None]
    sums_front, sums_back = np.where(flip, b, a), np.where(flip, a, b)
    front = _RegionMeans(sums_front, np.where(flip, table_b, table_a))
    back = _RegionMeans(sums_back, np.where(flip, table_a, table_b))
    small = np.minimum(front.n, back.n)
    log_small = np.log(small / scale**2)
    lab, gap = front.lab - back.lab, front.ground - back.ground
    joint = quadric_residual(sums_front + sums_back)
    excess = joint - quadric_residual(sums_front) - quadric_residual(sums_back)
    misfit = np.log1p(np.maximum(excess, 0) / small)
    higher = np.clip((front.top - back.top) * 10, -1, 1)
    rim = np.exp(-(((front.top - back.top) / 0.015) ** 2))
    distance = np.minimum(np.hypot(gap[:, 0], gap[:, 1]) / (front.extent + back.extent + 1e-3), 4)
    length = np.maximum(border[:, BORDER["length"]], 1)
    mean = border / length[:, None]
    strength, hollow, convex = (mean[:, BORDER[name]] for name in ("strength", "hollow", "convex"))
    step = np.log1p(np.abs(mean[:, BORDER["step"]]))
    columns = {
        "bias": np.ones(len(small)),
        "strength": strength,
        "strength^2": strength**2,
        "hollow": hollow,
        "convex": convex,
        "step": step,
        "clear step share": mean[:, BORDER["clear"]],
        "lightness": np.minimum(np.abs(lab[:, 0]) / 20, 3),
        "chroma": np.minimum(np.hypot(lab[:, 1], lab[:, 2]) / 10, 4),
        "texture": _texture(front, back),
        "misfit": misfit,
        "residual": np.log1p(joint / (front.n + back.n)),
        "border share": np.minimum(length / np.minimum(front.outline, back.outline), 1),
        "free border share": np.minimum(length / np.maximum(np.minimum(front.free, back.free), 1), 1),
        "log pixels": log_small,
        "log ratio": np.abs(np.log(front.n / back.n)),
        "front higher": np.maximum(higher, 0),
        "back higher": np.maximum(-higher, 0),
        "front bottom": np.minimum(front.bottom * 10, 2),
        "back bottom": np.minimum(back.bottom * 10, 2),
        "front bend": front.bend,
        "back bend": back.bend,
        "ground distance": distance,
        "front on table": front.on_table,
        "back on table": back.on_table,
        "front drop": front.drop,
        "back drop": back.drop,
        "rim": rim,
        "rim * back bend": rim * back.bend,
        "rim * step": rim * step,
        "rim * inside": rim * np.exp(-(distance**2)) * step,
        "step * misfit": step * misfit,
        "hollow * misfit": hollow * misfit,
        "strength * log pixels": strength * log_small,
        "hollow * log pixels": hollow * log_small,
        "convex * strength": convex * strength,
    }
    return np.stack([columns[name] for name in PAIR_FEATURES], axis=1)


class _RegionMeans:
    """Measurements of k regions from rows of `Regions.sums` (k, C) and their borders with the table (k, B)."""

    def __init__(self, sums: np.ndarray, table: np.ndarray) -> None:
        self.n = np.maximum(sums[:, REGION["pixels"].start], 1)
        lab, lab2, self.ground = (sums[:, REGION[name]] / self.n[:, None] for name in ("lab", "lab2", "ground"))
        self.lab, self.lab_variance = lab, np.maximum(lab2 - lab**2, 0) + 4
        # Standard deviation of the ground coordinates, metres.
        spread = sums[:, REGION["spread"].start] / self.n
        self.extent = np.sqrt(np.maximum(spread - (self.ground**2).sum(axis=1), 0))
        self.bend = sums[:, REGION["bend"].start] / self.n
        # 3rd and 97th percentile of the heights, metres.
        share = np.cumsum(sums[:, REGION["heights"]], axis=1) / self.n[:, None]
        self.bottom = (share < 0.03).sum(axis=1) * _HEIGHT_BIN
        self.top = ((share < 0.97).sum(axis=1) + 1) * _HEIGHT_BIN
        # Shares of the outline that touch the table, and that border on it with a clear step.
        clear = table[:, BORDER["clear"]]
        self.outline = np.maximum(sums[:, REGION["perimeter"].start], 1)
        self.on_table, self.drop = (table[:, 0] - clear) / self.outline, clear / self.outline
        self.free = self.outline - table[:, 0]


def _texture(a: _RegionMeans, b: _RegionMeans) -> np.ndarray:
    """Bhattacharyya distance of normal distributions of Lab colour, summed over the channels, at most 4."""
    total = a.lab_variance + b.lab_variance
    distance = (a.lab - b.lab) ** 2 / (4 * total)
    distance += 0.5 * np.log(total / (2 * np.sqrt(a.lab_variance * b.lab_variance)))
    return np.minimum(distance.sum(axis=1), 4)

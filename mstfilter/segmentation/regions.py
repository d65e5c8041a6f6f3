"""What regions and their common borders look like, as sums over pixels, so that merging two adds their rows.

>>> regions = measure_regions(leaves, frame, boundary)
>>> regions.of_leaf[leaf], regions.sums.shape, regions.borders[0]     # region 0 is the table
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.scene import BASELINE, Camera, Frame, fit_support_plane
from mstfilter.segmentation.background import SENSOR_FOCAL, above_table
from mstfilter.segmentation.boundary import fill_from_nearest

__all__ = ["BORDER", "HEIGHT_BIN", "REGION", "Regions", "measure_regions"]

#: Metres of height a bin of the height histogram; the last bin holds everything above.
HEIGHT_BIN = 0.01
_BINS = 32
_QUADRIC = 6
#: Share of a leaf's pixels above the table from which it is object matter.
_MIXED = 0.1

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
    "perimeter": 1,
}


def _columns(widths: dict[str, int]) -> dict[str, slice]:
    ends = np.cumsum(list(widths.values())).tolist()
    return {name: slice(end - n, end) for (name, n), end in zip(widths.items(), ends, strict=True)}


#: Columns of `Regions.sums`. All but the perimeter are sums over the region's readings above the table: their number,
#: Lab colour and its squares, normal equations and squares of the quadric fit of disparity, ground coordinates (m)
#: and their squares, signed curvature of disparity (> 0 where the surface is hollow), histogram of heights. The
#: perimeter counts the pairs of neighbouring pixels of which one is outside.
REGION = _columns(_WIDTHS)

#: Columns of a border: neighbouring pixel pairs, and their sums of boundary strength, hollow and convex curvature,
#: step of disparity (first region minus second), its magnitude, and the number of pairs with a clear step.
BORDER = {name: k for k, name in enumerate(("length", "strength", "hollow", "convex", "step", "size", "clear"))}
_SIGN = np.array([1, 1, 1, 1, -1, 1, 1], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Regions:
    """The leaves of a tree, those of the table taken together.

    Parameters
    ----------
    of_leaf : (n_leaves,) int
        Region of every leaf; 0 is the table.
    sums : (R, C) float64
        Columns `REGION`.
    borders : list of dict
        For each region its neighbours, and the row (columns `BORDER`) of the common border seen from it.
    """

    of_leaf: np.ndarray
    sums: np.ndarray
    borders: list[dict[int, np.ndarray]]


def measure_regions(
    leaves: np.ndarray, frame: Frame, boundary: np.ndarray, table_tolerance: float, clear_step: float
) -> Regions:
    """Measure the leaves (H, W) of a tree.

    Parameters
    ----------
    leaves : (H, W) int
    frame : Frame
    boundary : (H, W) float
        Boundary strength.
    table_tolerance : float
        Readings up to this much above the table are table, in sensor disparity units. A leaf most of whose pixels
        are not above it belongs to the table.
    clear_step : float
        Step that counts as clear, in sensor disparity units.
    """
    height, width = leaves.shape
    n_leaves = int(leaves.max()) + 1
    flat = leaves.ravel()
    above = above_table(frame)
    with np.errstate(invalid="ignore"):
        own = frame.valid & (above > table_tolerance)
    areas = np.bincount(flat, minlength=n_leaves)
    # Leaves that mix object and table keep their object; rays above the table's horizon need a clear majority.
    meets = own & (above < np.inf)
    some, most = (
        _raised(flat, above, mask, areas, table_tolerance, share) for mask, share in ((meets, _MIXED), (own, 0.5))
    )
    of_leaf = np.where(some | most, 1, 0)
    of_leaf[of_leaf > 0] = 1 + np.arange(int(of_leaf.sum()))
    region = of_leaf[leaves]
    n = int(of_leaf.max()) + 1

    disparity, hollow, convex = _curvature(frame)
    sums = np.zeros((n, sum(_WIDTHS.values())))
    at = np.nonzero(own & (region > 0))
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
    # Relative to the table: smaller numbers, and the table is affine, so the quadrics are the same.
    d = np.minimum(above[at], 1e3)
    gram = {}
    for i in range(_QUADRIC):
        for j in range(i, _QUADRIC):
            gram[i, j] = np.bincount(which, weights=terms[i] * terms[j], minlength=n)
    start = REGION["gram"].start
    for i in range(_QUADRIC):
        for j in range(_QUADRIC):
            sums[:, start + i * _QUADRIC + j] = gram[min(i, j), max(i, j)]
    put("moment", *(terms * d))
    put("square", d * d)
    points = _camera(frame).unproject(frame.depth)[at]
    put("ground", points[:, 0], points[:, 1])
    put("spread", points[:, 0] ** 2 + points[:, 1] ** 2)
    put("bend", (hollow - convex)[at])
    bins = np.clip(points[:, 2] / HEIGHT_BIN, 0, _BINS - 1).astype(np.int64)
    sums[:, REGION["heights"]] = np.bincount(which * _BINS + bins, minlength=n * _BINS).reshape(n, _BINS)

    borders = _borders(region, n, boundary, hollow, convex, disparity, clear_step)
    sums[:, REGION["perimeter"].start] = [sum(row[0] for row in near.values()) for near in borders]
    return Regions(of_leaf, sums, borders)


def _raised(
    flat: np.ndarray, above: np.ndarray, mask: np.ndarray, areas: np.ndarray, tolerance: float, share: float
) -> np.ndarray:
    """Leaves of which more than `share` is in the mask, and rises there clearly above the tolerance on average."""
    inside = np.bincount(flat[mask.ravel()], minlength=len(areas))
    rise = np.bincount(flat[mask.ravel()], weights=np.minimum(above[mask], 1e3), minlength=len(areas))
    raised: np.ndarray = (inside > share * areas) & (rise > 1.75 * tolerance * inside)
    return raised


def _camera(frame: Frame) -> Camera:
    """The frame's camera, posed by the support plane where it has no pose of its own."""
    camera = frame.camera
    return camera if camera.T_world_camera is not None else camera.at(fit_support_plane(frame).T_world_camera)


def _curvature(frame: Frame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smoothed disparity in sensor units, and x / (x + 2) of its positive and negative curvature; (H, W) each."""
    import cv2

    resize = frame.camera.width / 640
    D = (8 * SENSOR_FOCAL * BASELINE / fill_from_nearest(frame.depth, ~frame.valid)).astype(np.float32)
    smooth = cv2.GaussianBlur(D, (0, 0), max(0.7, 1.5 * resize))
    s = max(1.0, 2.5 * resize)
    wide = cv2.GaussianBlur(D, (0, 0), s)
    xx = cv2.Sobel(wide, cv2.CV_32F, 2, 0) * (s * s / 4)
    yy = cv2.Sobel(wide, cv2.CV_32F, 0, 2) * (s * s / 4)
    xy = cv2.Sobel(wide, cv2.CV_32F, 1, 1) * (s * s / 4)
    middle, radius = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    hollow, convex = np.maximum(middle + radius, 0), np.maximum(radius - middle, 0)
    return smooth, hollow / (hollow + 2), convex / (convex + 2)


def _borders(
    region: np.ndarray,
    n: int,
    boundary: np.ndarray,
    hollow: np.ndarray,
    convex: np.ndarray,
    disparity: np.ndarray,
    clear_step: float,
) -> list[dict[int, np.ndarray]]:
    """Neighbours of every region with sums over the pairs of neighbouring pixels."""
    reach = max(1, round(3 * region.shape[1] / 640))
    first, second, rows = [], [], []
    for axis in (0, 1):
        size = region.shape[axis]
        a, b = np.arange(size - 1), np.arange(1, size)
        pair_a, pair_b = np.take(region, a, axis), np.take(region, b, axis)
        at = np.nonzero(pair_a != pair_b)
        i, j = pair_a[at], pair_b[at]
        # A little away from the border on both sides; what the slopes there account for is no step.
        along = at[axis]

        def value(
            shift: int, along: np.ndarray = along, at: tuple = at, axis: int = axis, size: int = size
        ) -> np.ndarray:
            index = list(at)
            index[axis] = np.clip(along + shift, 0, size - 1)
            return disparity[tuple(index)]

        near_a, near_b = value(-reach), value(1 + reach)
        slopes = (near_a - value(-2 * reach)) + (value(1 + 2 * reach) - near_b)
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
                np.abs(step) > clear_step,
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

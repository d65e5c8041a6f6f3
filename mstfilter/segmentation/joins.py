"""How two regions of an image meet: the features that tell one object from two.

All are plain functions of the sums in `Regions`; sizes count in pixels of a 640 px wide image, disparity in sensor
units, lengths in metres. "Front" is the region that is nearer to the camera at the common border.

>>> x = features(sums[a], sums[b], border, table_a, table_b, scale)      # (k, len(FEATURES))
"""

from __future__ import annotations

import numpy as np

from mstfilter.segmentation.regions import BORDER, HEIGHT_BIN, REGION

__all__ = ["FEATURES", "features", "quadric_residual"]

FEATURES = (
    "bias",
    "strength",
    "strength^2",
    "hollow",
    "convex",
    "step",
    "clear step share",
    "lightness",
    "chroma",
    "texture",
    "misfit",
    "residual",
    "border share",
    "free border share",
    "log pixels",
    "log ratio",
    "front higher",
    "back higher",
    "front bottom",
    "back bottom",
    "front bend",
    "back bend",
    "ground distance",
    "front on table",
    "back on table",
    "front drop",
    "back drop",
    "rim",
    "rim * back bend",
    "rim * step",
    "rim * inside",
    "step * misfit",
    "hollow * misfit",
    "strength * log pixels",
    "hollow * log pixels",
    "convex * strength",
)


def quadric_residual(sums: np.ndarray) -> np.ndarray:
    """(k,) squared residual of the best quadric of disparity through each region (k, C), in squared units."""
    gram = sums[:, REGION["gram"]].reshape(-1, 6, 6)
    moment = sums[:, REGION["moment"]]
    n = sums[:, REGION["pixels"].start]
    ridge = (1e-9 * n + 1e-9)[:, None, None] * np.eye(6)
    fit = np.linalg.solve(gram + ridge, moment[..., None])[..., 0]
    return np.maximum(sums[:, REGION["square"].start] - (moment * fit).sum(axis=1), 0)


def features(
    a: np.ndarray, b: np.ndarray, border: np.ndarray, table_a: np.ndarray, table_b: np.ndarray, scale: float
) -> np.ndarray:
    """Features of k pairs of regions.

    Parameters
    ----------
    a, b : (k, C) float64
        Rows of `Regions.sums`.
    border : (k, B) float64
        Their common borders, seen from `a`.
    table_a, table_b : (k, B) float64
        Their borders with the table; zeros where there is none.
    scale : float
        Image width / 640.
    """
    flip = border[:, BORDER["step"]] < 0
    front, back = np.where(flip[:, None], b, a), np.where(flip[:, None], a, b)
    table_front = np.where(flip[:, None], table_b, table_a)
    table_back = np.where(flip[:, None], table_a, table_b)
    length = np.maximum(border[:, BORDER["length"]], 1)
    mean = border / length[:, None]
    n_front, n_back = _get(front, "pixels"), _get(back, "pixels")
    small = np.minimum(n_front, n_back)

    lab = front[:, REGION["lab"]] / n_front[:, None] - back[:, REGION["lab"]] / n_back[:, None]
    joint = quadric_residual(front + back)
    excess = np.maximum(joint - quadric_residual(front) - quadric_residual(back), 0) / small
    misfit = np.log1p(excess)
    free = np.minimum(_get(front, "perimeter") - table_front[:, 0], _get(back, "perimeter") - table_back[:, 0])
    bottom_front, top_front = _range(front)
    bottom_back, top_back = _range(back)
    higher = np.clip((top_front - top_back) * 10, -1, 1)
    rim = np.exp(-(((top_front - top_back) / 0.015) ** 2))
    bend_front, bend_back = _get(front, "bend") / n_front, _get(back, "bend") / n_back
    strength = mean[:, BORDER["strength"]]
    step = np.log1p(np.abs(mean[:, BORDER["step"]]))
    gap = front[:, REGION["ground"]] / n_front[:, None] - back[:, REGION["ground"]] / n_back[:, None]
    extent = np.sqrt(_variance(front, n_front)) + np.sqrt(_variance(back, n_back)) + 1e-3
    distance = np.minimum(np.hypot(gap[:, 0], gap[:, 1]) / extent, 4)
    hollow, convex = mean[:, BORDER["hollow"]], mean[:, BORDER["convex"]]
    log_small = np.log(small / scale**2)
    on_front, drop_front = _table(table_front, front)
    on_back, drop_back = _table(table_back, back)
    columns = [
        np.ones(len(small)),
        strength,
        strength**2,
        hollow,
        convex,
        step,
        mean[:, BORDER["clear"]],
        np.minimum(np.abs(lab[:, 0]) / 20, 3),
        np.minimum(np.hypot(lab[:, 1], lab[:, 2]) / 10, 4),
        _texture(front, back, n_front, n_back),
        misfit,
        np.log1p(joint / (n_front + n_back)),
        np.minimum(length / np.minimum(_get(front, "perimeter"), _get(back, "perimeter")), 1),
        np.minimum(length / np.maximum(free, 1), 1),
        log_small,
        np.abs(np.log(n_front / n_back)),
        np.maximum(higher, 0),
        np.maximum(-higher, 0),
        np.minimum(bottom_front * 10, 2),
        np.minimum(bottom_back * 10, 2),
        bend_front,
        bend_back,
        distance,
        on_front,
        on_back,
        drop_front,
        drop_back,
        rim,
        rim * bend_back,
        rim * step,
        rim * np.exp(-(distance**2)) * step,
        step * misfit,
        hollow * misfit,
        strength * log_small,
        hollow * log_small,
        convex * strength,
    ]
    return np.stack(columns, axis=1)


def _texture(a: np.ndarray, b: np.ndarray, n_a: np.ndarray, n_b: np.ndarray) -> np.ndarray:
    """Bhattacharyya distance of normal Lab colours, channel by channel, at most 4."""
    mean_a, mean_b = a[:, REGION["lab"]] / n_a[:, None], b[:, REGION["lab"]] / n_b[:, None]
    var_a = np.maximum(a[:, REGION["lab2"]] / n_a[:, None] - mean_a**2, 0) + 4
    var_b = np.maximum(b[:, REGION["lab2"]] / n_b[:, None] - mean_b**2, 0) + 4
    total = var_a + var_b
    distance = (mean_a - mean_b) ** 2 / (4 * total) + 0.5 * np.log(total / (2 * np.sqrt(var_a * var_b)))
    return np.minimum(distance.sum(axis=1), 4)


def _get(sums: np.ndarray, name: str) -> np.ndarray:
    column: np.ndarray = sums[:, REGION[name].start]
    return np.maximum(column, 1) if name in ("pixels", "perimeter") else column


def _variance(sums: np.ndarray, n: np.ndarray) -> np.ndarray:
    mean = sums[:, REGION["ground"]] / n[:, None]
    return np.maximum(_get(sums, "spread") / n - (mean**2).sum(axis=1), 0)


def _range(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heights in metres below which 3 and 97 % of a region lie."""
    share = np.cumsum(sums[:, REGION["heights"]], axis=1) / _get(sums, "pixels")[:, None]
    return (share < 0.03).sum(axis=1) * HEIGHT_BIN, ((share < 0.97).sum(axis=1) + 1) * HEIGHT_BIN


def _table(border: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share of the outline that stands on the table, and that drops to it with a clear step."""
    clear = border[:, BORDER["clear"]]
    outline = _get(sums, "perimeter")
    return (border[:, 0] - clear) / outline, clear / outline

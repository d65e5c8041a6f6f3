"""Measurements of pairs of regions: how different two neighbouring regions of an image are.

>>> x = pair_features(a, b, border, table_a, table_b, scale)        # (k, f), from the rows of `Regions`
>>> FEATURES["misfit"](PairMeasures(a, b, border, table_a, table_b, scale))

Features that depend on the size of a region are in pixels of a 640 px wide image. Disparity is in sensor units (1/8
px at f = 525 px), and lengths are in metres. The "front" region of a pair is nearer to the camera at the border.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from mstfilter.mst.segmentation.regions import BORDER, HEIGHT_BIN, REGION

_MOST_GAP = 4.0

NO_BORDER = np.zeros(len(BORDER))  #: The row of a pair of regions without a common border.


def quadric_residual(sums: np.ndarray) -> np.ndarray:
    """Squared residual (k,) of a quadric fitted to the disparity of each region (k, C), in squared sensor units."""
    gram = sums[:, REGION["gram"]].reshape(-1, 6, 6)
    moment = sums[:, REGION["moment"]]
    n = sums[:, REGION["pixels"].start]
    ridge = (1e-9 * n + 1e-9)[:, None, None] * np.eye(6)
    fit = np.linalg.solve(gram + ridge, moment[..., None])[..., 0]
    return np.maximum(sums[:, REGION["square"].start] - (moment * fit).sum(axis=1), 0)


class _RegionMeans:
    """Measurements of k regions, from their rows (k, C) of `Regions.sums` and their borders (k, B) with the table."""

    def __init__(self, sums: np.ndarray, table: np.ndarray) -> None:
        self.n = np.maximum(sums[:, REGION["pixels"].start], 1)
        lab, lab2, self.ground, self.centre = (
            sums[:, REGION[name]] / self.n[:, None] for name in ("lab", "lab2", "ground", "centre")
        )
        self.lab, self.lab_variance = lab, np.maximum(lab2 - lab**2, 0) + 4
        # Standard deviation of the ground coordinates, metres.
        spread = sums[:, REGION["spread"].start] / self.n
        self.extent = np.sqrt(np.maximum(spread - (self.ground**2).sum(axis=1), 0))
        self.bend = sums[:, REGION["bend"].start] / self.n
        # 3rd and 97th percentile of the heights, metres.
        share = np.cumsum(sums[:, REGION["heights"]], axis=1) / self.n[:, None]
        self.bottom = (share < 0.03).sum(axis=1) * HEIGHT_BIN
        self.top = ((share < 0.97).sum(axis=1) + 1) * HEIGHT_BIN
        # Shares of the outline that touch the table, and that border on it with a clear step.
        clear = table[:, BORDER["clear"]]
        self.outline = np.maximum(sums[:, REGION["perimeter"].start], 1)
        self.on_table, self.drop = (table[:, 0] - clear) / self.outline, clear / self.outline
        self.free = self.outline - table[:, 0]


class PairMeasures:
    """Measurements of k pairs of regions. The parameters are the same as in `pair_features`."""

    def __init__(
        self, a: np.ndarray, b: np.ndarray, border: np.ndarray, table_a: np.ndarray, table_b: np.ndarray, scale: float
    ) -> None:
        flip = (border[:, BORDER["step"]] < 0)[:, None]
        sums_front, sums_back = np.where(flip, b, a), np.where(flip, a, b)
        self.front = front = _RegionMeans(sums_front, np.where(flip, table_b, table_a))
        self.back = back = _RegionMeans(sums_back, np.where(flip, table_a, table_b))
        small = np.minimum(front.n, back.n)
        self.log_small = np.log(small / scale**2)
        self.lab = front.lab - back.lab
        joint = quadric_residual(sums_front + sums_back)
        excess = joint - quadric_residual(sums_front) - quadric_residual(sums_back)
        self.misfit = np.log1p(np.maximum(excess, 0) / small)
        self.residual = np.log1p(joint / (front.n + back.n))
        self.higher = np.clip((front.top - back.top) * 10, -1, 1)
        self.rim = np.exp(-(((front.top - back.top) / 0.015) ** 2))
        gap = front.ground - back.ground
        self.distance = np.minimum(np.hypot(gap[:, 0], gap[:, 1]) / (front.extent + back.extent + 1e-3), 4)
        self.length = np.maximum(border[:, BORDER["length"]], 1)
        mean = border / self.length[:, None]
        self.strength, self.hollow, self.convex, self.clear, self.seen = (
            mean[:, BORDER[name]] for name in ("strength", "hollow", "convex", "clear", "seen")
        )
        self.step = np.log1p(np.abs(mean[:, BORDER["step"]]))
        # Distance of the centres of the objects that a network sees, relative to the size of the smaller region.
        self.centre_gap = np.linalg.norm(front.centre - back.centre, axis=1)
        self.centre_gap = np.minimum(self.centre_gap / np.sqrt(small), _MOST_GAP)

    def texture(self) -> np.ndarray:
        """Bhattacharyya distances between normal distributions of Lab colour: sum over the channels, limited to 4."""
        a, b = self.front, self.back
        total = a.lab_variance + b.lab_variance
        distance = (a.lab - b.lab) ** 2 / (4 * total)
        distance += 0.5 * np.log(total / (2 * np.sqrt(a.lab_variance * b.lab_variance)))
        return np.minimum(distance.sum(axis=1), 4)


#: Features of pairs of regions by name, (k,) each. Those of `EVIDENCE_FEATURES` are 0 without a border network.
FEATURES: dict[str, Callable[[PairMeasures], np.ndarray]] = {
    "bias": lambda p: np.ones(len(p.length)),
    "strength": lambda p: p.strength,
    "strength^2": lambda p: p.strength**2,
    "hollow": lambda p: p.hollow,
    "convex": lambda p: p.convex,
    "step": lambda p: p.step,
    "clear step share": lambda p: p.clear,
    "lightness": lambda p: np.minimum(np.abs(p.lab[:, 0]) / 20, 3),
    "chroma": lambda p: np.minimum(np.hypot(p.lab[:, 1], p.lab[:, 2]) / 10, 4),
    "texture": PairMeasures.texture,
    "misfit": lambda p: p.misfit,
    "residual": lambda p: p.residual,
    "border share": lambda p: np.minimum(p.length / np.minimum(p.front.outline, p.back.outline), 1),
    "free border share": lambda p: np.minimum(p.length / np.maximum(np.minimum(p.front.free, p.back.free), 1), 1),
    "log pixels": lambda p: p.log_small,
    "log ratio": lambda p: np.abs(np.log(p.front.n / p.back.n)),
    "front higher": lambda p: np.maximum(p.higher, 0),
    "back higher": lambda p: np.maximum(-p.higher, 0),
    "front bottom": lambda p: np.minimum(p.front.bottom * 10, 2),
    "back bottom": lambda p: np.minimum(p.back.bottom * 10, 2),
    "front bend": lambda p: p.front.bend,
    "back bend": lambda p: p.back.bend,
    "ground distance": lambda p: p.distance,
    "front on table": lambda p: p.front.on_table,
    "back on table": lambda p: p.back.on_table,
    "front drop": lambda p: p.front.drop,
    "back drop": lambda p: p.back.drop,
    "rim": lambda p: p.rim,
    "rim * back bend": lambda p: p.rim * p.back.bend,
    "rim * step": lambda p: p.rim * p.step,
    "rim * inside": lambda p: p.rim * np.exp(-(p.distance**2)) * p.step,
    "step * misfit": lambda p: p.step * p.misfit,
    "hollow * misfit": lambda p: p.hollow * p.misfit,
    "strength * log pixels": lambda p: p.strength * p.log_small,
    "hollow * log pixels": lambda p: p.hollow * p.log_small,
    "convex * strength": lambda p: p.convex * p.strength,
    "seen": lambda p: p.seen,
    "seen * log pixels": lambda p: p.seen * p.log_small,
    "centre gap": lambda p: p.centre_gap,
    "centre gap * seen": lambda p: p.centre_gap * p.seen,
}
EVIDENCE_FEATURES = tuple(FEATURES)[-4:]  #: Features of what a border network sees.
PAIR_FEATURES = tuple(FEATURES)[:-4]  #: The other features.


def pair_features(
    a: np.ndarray,
    b: np.ndarray,
    border: np.ndarray,
    table_a: np.ndarray,
    table_b: np.ndarray,
    scale: float,
    names: Iterable[str] = PAIR_FEATURES,
) -> np.ndarray:
    """The named features (k, f) of k pairs of regions, from their rows `a` and `b` (k, C) of `Regions.sums`.

    `border` (k, B) has the common borders of the pairs, with `a` first. `table_a` and `table_b` (k, B) are the
    borders of `a` and `b` with the table, or zeros. `scale` is the image width / 640.
    """
    pair = PairMeasures(a, b, border, table_a, table_b, scale)
    return np.stack([FEATURES[name](pair) for name in names], axis=1)

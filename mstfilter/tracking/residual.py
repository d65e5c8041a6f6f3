"""How well a motion explains the last frame: depth and colour where the moved surface should be.

Per point, with z the predicted and m the measured depth:

- ``min(|z - m| / s, cap)^2 + min(|colour difference| / c, cap)^2``, s from the sensor's noise at that range;
- predicted well BEHIND what is measured: something is in front, a constant;
- outside the image: a larger constant;  no reading there, or robot: not counted.

The score S is the mean over counted points, plus a share for visible points that land where flow says
something else came from: depth and colour alone cannot tell an object from its twin. Lower is better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mstfilter.scene import depth_sigma
from mstfilter.tracking import rigid
from mstfilter.tracking.track import Track

__all__ = ["Residual"]


@dataclass(frozen=True)
class Residual:
    """Robust residual of a motion.

    Parameters
    ----------
    depth_scale : float
        Depth differences are measured in this many standard deviations of a difference of two readings.
    colour_scale : float
        Colour differences (length of the RGB difference) are measured in this many grey levels.
    cap : float
        Largest normalised difference.
    occluded_margin : float
        Metres behind the measured surface from which a point counts as hidden.
    occluded_cost, outside_cost : float
        Constant cost of a hidden point and of one outside the image.
    least_share : float
        Share of the points that must be counted, or the motion is not comparable (infinite).
    n_points : int
        At most so many points of a segment are used, evenly spread.
    track_weight : float
        Added to S where all visible points land on pixels that flow traces back to another object.
    """

    depth_scale: float = 1.5
    colour_scale: float = 25.0
    cap: float = 4.0
    occluded_margin: float = 0.015
    occluded_cost: float = 5.6
    outside_cost: float = 16.0
    least_share: float = 0.3
    n_points: int = 1200
    track_weight: float = 1.0

    def score(self, track: Track, T: NDArray[np.float64]) -> float:
        """S of a motion (4, 4) of a segment; infinite where too little can be compared."""
        return float(self.scores(track, T[None])[0])

    def scores(self, track: Track, motions: NDArray[np.float64], n_points: int | None = None) -> NDArray[np.float64]:
        """S of many motions (K, 4, 4) of a segment, (K,), on at most ``n_points`` points."""
        points, colours = track.sample(n_points or self.n_points)
        if not len(points):
            return np.full(len(motions), np.inf)
        after = track.clip.after
        height, width = after.depth.shape
        uv, z = after.camera.project(rigid.apply(motions, points))
        pixel = np.rint(np.where(np.isfinite(uv), uv, -1.0))
        inside = (pixel >= 0).all(axis=-1) & (pixel[..., 0] < width) & (pixel[..., 1] < height)
        u, v = np.moveaxis(np.where(inside[..., None], pixel, 0.0).astype(np.int64), -1, 0)
        measured = after.depth[v, u].astype(np.float64)
        counted = inside & after.valid[v, u]
        behind = z - measured
        scale = self.depth_scale * np.sqrt(2.0) * depth_sigma(measured)
        colour = np.linalg.norm(track.colour_after[v, u] - colours, axis=-1)
        with np.errstate(invalid="ignore"):
            hidden = behind > self.occluded_margin
            cost = np.minimum(np.abs(behind) / scale, self.cap) ** 2
            cost = cost + np.minimum(colour / self.colour_scale, self.cap) ** 2
        cost = np.where(hidden, self.occluded_cost, cost)
        n_outside = (~inside).sum(axis=-1)
        n = n_outside + counted.sum(axis=-1)
        total = np.where(counted, cost, 0.0).sum(axis=-1) + self.outside_cost * n_outside
        # Of the visible points, the share that lands where flow says that something else came from.
        source = track.flow.source[v, u]
        traced = counted & ~hidden & (source >= 0)
        foreign = (traced & ~track.mask.ravel()[source]).sum(axis=-1) / np.maximum(traced.sum(axis=-1), 1)
        mean = total / np.maximum(n, 1)
        return np.where(n >= max(self.least_share * len(points), 1), mean + self.track_weight * foreign, np.inf)

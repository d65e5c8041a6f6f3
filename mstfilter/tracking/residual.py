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

from mstfilter.scene.depth_noise import depth_sigma
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
        points, colours = track.sample(self.n_points)
        if not len(points):
            return float("inf")
        after = track.clip.after
        height, width = after.depth.shape
        uv, z = after.camera.project(rigid.apply(T, points))
        inside = np.isfinite(uv).all(axis=1)
        pixel = np.rint(np.where(inside[:, None], uv, -1.0))
        inside &= (pixel >= 0).all(axis=1) & (pixel[:, 0] < width) & (pixel[:, 1] < height)
        u, v = pixel[inside].astype(np.int64).T
        measured = after.depth[v, u].astype(np.float64)
        counted = after.valid[v, u]
        behind = z[inside] - measured
        scale = self.depth_scale * np.sqrt(2.0) * depth_sigma(measured)
        colour = np.linalg.norm(track.colour_after[v, u] - colours[inside], axis=1)
        with np.errstate(invalid="ignore"):
            cost = np.minimum(np.abs(behind) / scale, self.cap) ** 2
            cost = cost + np.minimum(colour / self.colour_scale, self.cap) ** 2
            cost = np.where(behind > self.occluded_margin, self.occluded_cost, cost)
        n_outside = int((~inside).sum())
        n = n_outside + int(counted.sum())
        if n < self.least_share * len(points):
            return float("inf")
        mean = float((cost[counted].sum() + self.outside_cost * n_outside) / n)
        with np.errstate(invalid="ignore"):
            visible = counted & ~(behind > self.occluded_margin)
        source = track.flow.source[v[visible], u[visible]]
        from_here = track.mask.ravel()[source[source >= 0]]
        return mean + self.track_weight * float(1.0 - from_here.mean() if len(from_here) else 0.0)

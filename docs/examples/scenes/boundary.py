"""A boundary model: where one object ends and another begins, in one image.

mstfilter check ./boundary.py:MyBoundary
mstfilter run demo/recording proposal.boundary=./boundary.py:MyBoundary --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.mst.segmentation import BoundaryModel
from mstfilter.scene import Frame


@dataclass(frozen=True)
class MyBoundary(BoundaryModel):
    """Steps of depth and of brightness between neighbouring pixels. Fields need an annotation and a default.

    Parameters
    ----------
    depth_step : float
        Step of depth that is a certain boundary, relative to the depth.
    grey_step : float
        Step of brightness that is a certain boundary, in grey levels (of 255).
    """

    depth_step: float = 0.02
    grey_step: float = 100.0

    def boundary(self, frame: Frame) -> np.ndarray:
        """(H, W) float32 in 0 .. 1: boundary strength of each pixel."""
        grey = frame.rgb.mean(axis=2)
        log_depth = np.log(np.where(frame.valid, frame.depth, np.nan))
        grey_edges = np.hypot(*np.gradient(grey)) / self.grey_step
        depth_edges = np.hypot(*np.gradient(log_depth)) / self.depth_step
        strength = np.fmax(grey_edges, depth_edges)  # fmax ignores pixels without depth
        return np.clip(strength, 0, 1).astype(np.float32)

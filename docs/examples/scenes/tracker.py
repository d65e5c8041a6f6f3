"""A mask tracker: where the visible part of each object is at the end of a clip.

mstfilter check ./tracker.py:MyTracker
mstfilter run demo/recording transition.tracker=./tracker.py:MyTracker --out runs/mine --replace
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from mstfilter.mst.tracking import DenseFlow, MaskTracker
from mstfilter.scene import Clip


@dataclass(frozen=True)
class MyTracker(MaskTracker):
    """Masks follow the optical flow; specks are removed. Fields need an annotation and a default.

    Parameters
    ----------
    smooth : int
        Structures thinner than about twice this number of pixels are removed.
    flow : DenseFlow
        The optical flow.
    """

    smooth: int = 1
    flow: DenseFlow = field(default_factory=DenseFlow)

    def track(self, clip: Clip, masks: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Masks (H, W) bool of the last frame, one for each mask of the first; without pixels if it is lost."""
        tracks = self.flow.track(clip)
        moved = [tracks.warp(mask.astype(np.uint8)) > 0 for mask in masks]
        if self.smooth:
            moved = [ndimage.binary_opening(mask, iterations=self.smooth) for mask in moved]
        return moved

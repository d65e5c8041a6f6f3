"""A division: which pixels of the last image belong to different objects, as far as the clip shows it.

mstfilter check ./division.py:MyDivision
mstfilter run demo/recording update.division=./division.py:MyDivision --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from mstfilter.partition import Division
from mstfilter.scene import Clip


@dataclass(frozen=True)
class MyDivision(Division):
    """Pixels that moved, and pixels far from them that rested. Fields need an annotation and a default.

    Parameters
    ----------
    step : float
        Change of depth that shows a motion, in metres.
    far : int
        Distance to the moved pixels, in pixels, from which a pixel that did not change counts as resting.
    """

    step: float = 0.02
    far: int = 15

    def divide(self, clip: Clip) -> np.ndarray | None:
        """(H, W) int32 numbers of the pixels of the last frame, -1 is unknown; None if the clip shows nothing.

        Pixels with different numbers >= 0 belong to different objects.
        """
        if len(clip) < 2:
            return None
        known = clip.before.valid & clip.after.valid
        change = np.where(known, np.abs(clip.after.depth - clip.before.depth), np.nan)
        moved = np.nan_to_num(change) > self.step
        near = ndimage.binary_dilation(moved, iterations=self.far)
        return np.where(moved, 1, np.where(near | ~known, -1, 0)).astype(np.int32)

"""A division: which pixels of the last image belong to different objects, as far as the clip shows it.

mstfilter check ./division.py:MyDivision
mstfilter run demo/recording update.division=./division.py:MyDivision --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.fusion import Division
from mstfilter.scene import Clip


@dataclass(frozen=True)
class MyDivision(Division):
    """Pixels whose depth changed, and pixels whose depth did not. Fields need an annotation and a default.

    Parameters
    ----------
    step : float
        Change of depth that shows a motion, in metres.
    """

    step: float = 0.01

    def divide(self, clip: Clip) -> np.ndarray | None:
        """(H, W) int32 numbers of the pixels of the last frame, -1 is unknown; None if the clip shows nothing.

        Pixels with different numbers >= 0 belong to different objects.
        """
        if len(clip) < 2:
            return None
        known = clip.before.valid & clip.after.valid
        change = np.where(known, np.abs(clip.after.depth - clip.before.depth), np.nan)
        return np.where(known, np.nan_to_num(change) > self.step, -1).astype(np.int32)

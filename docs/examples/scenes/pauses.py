"""A rule for pauses: at which frames of a video nothing moves.

mstfilter run demo/recording --pauses ./pauses.py:MyPauses --out runs/mine --replace
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mstfilter.formats import PauseRule


@dataclass(frozen=True)
class MyPauses(PauseRule):
    """The first and the last frame, and a frame at regular times. Fields need an annotation and a default.

    Parameters
    ----------
    every_s : float
        Time between two pauses, in seconds.
    """

    every_s: float = 3.0

    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        """Ascending indices of frames. `times` are in seconds; read_rgb(index) is (H, W, 3) uint8."""
        wanted = np.arange(times[0], times[-1], self.every_s)
        nearest = [int(np.abs(np.array(times) - t).argmin()) for t in wanted]
        return tuple(sorted({0, len(times) - 1, *nearest}))

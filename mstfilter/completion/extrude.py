"""Completion without weights: the visible surface, extruded down to what carries it.

Most things on a table stand on it: below a visible top or side there is more of the object.

>>> completions = Extrude().complete(rng, frame, masks, grid)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.completion.completer import Completer, Evidence

__all__ = ["Extrude", "SurfaceOnly"]


@dataclass(frozen=True)
class SurfaceOnly(Completer):
    """No completion: the visible surface (the floor of any comparison)."""

    def fill(self, rng: np.random.Generator, seen: Evidence) -> np.ndarray:
        """1 on the visible surface."""
        return seen.own.astype(np.float32)


@dataclass(frozen=True)
class Extrude(Completer):
    """The visible surface and all below it, down to the table or another object's surface.

    Parameters
    ----------
    below : float
        Probability of a hidden voxel under the surface (precision measured on procedural scenes: .8).
    floor : float
        Nothing below this height in metres.
    """

    below: float = 0.8
    floor: float = 0.0

    def fill(self, rng: np.random.Generator, seen: Evidence) -> np.ndarray:
        """1 on the visible surface, `below` under it until another surface is met; gaps seen as free stay free."""
        state = np.zeros(seen.own.shape[:2], dtype=bool)
        p = np.zeros(seen.own.shape, dtype=np.float32)
        for k in range(seen.own.shape[2] - 1, -1, -1):
            # Another surface ends the column; own surface (re)starts it.
            state = (state & ~seen.other[:, :, k]) | seen.own[:, :, k]
            p[:, :, k] = np.where(seen.own[:, :, k], 1.0, np.where(state, self.below, 0.0))
        p[:, :, seen.height < self.floor] = 0
        return p

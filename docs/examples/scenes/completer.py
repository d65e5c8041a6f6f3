"""A completer: from the visible part of an object to the space that it fills.

mstfilter check ./completer.py:MyCompleter
mstfilter run demo/recording update.completer=./completer.py:MyCompleter --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.mst.completion import Completer, ObservedBox


@dataclass(frozen=True)
class MyCompleter(Completer):
    """Extrudes the visible surface down to the table. Fields need an annotation and a default.

    Parameters
    ----------
    below : float
        Probability of a hidden voxel below the surface. Voxels of at least 0.5 are occupied.
    """

    below: float = 0.7

    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        """(a, b, c) probability that the object occupies each voxel of the box; the last axis is the height."""
        # From the top down: True at the highest surface voxel of each column and at all voxels below it.
        hidden = np.maximum.accumulate(seen.surface[:, :, ::-1], axis=2)[:, :, ::-1]
        return np.where(seen.surface, 1.0, np.where(hidden & ~seen.other_surface, self.below, 0.0))

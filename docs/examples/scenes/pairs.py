"""Odds of pairs: how likely two cells of the image belong to one object.

mstfilter check ./pairs.py:MyPairs
mstfilter run demo/recording update.pairs=./pairs.py:MyPairs --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.mst.partition import Cells, PairOdds
from mstfilter.scene import Clip


@dataclass(frozen=True)
class MyPairs(PairOdds):
    """By the samples and by colour; predictions are not used. Fields need an annotation and a default.

    Parameters
    ----------
    image : float
        Log odds if all samples agree.
    colour : float
        Log odds for a unit of distance between the mean colours, of which each channel is from 0 to 1.
    typical : float
        Distance of colours that says nothing.
    """

    image: float = 3.0
    colour: float = 5.0
    typical: float = 0.2

    def log_odds(self, cells: Cells, weights: np.ndarray, clip: Clip) -> np.ndarray:
        """Log odds (e,) of "one object" for `cells.pairs` (e, 2).

        `cells.samples` and `cells.predictions` have the label of each cell, 0 is none; `weights` are those of the
        predictions.
        """
        inside = cells.of_reading >= 0
        cell, rgb = cells.of_reading[inside], clip.after.rgb.reshape(-1, 3)[cells.readings.pixels[inside]] / 255
        n = cells.samples.shape[1]
        sums = np.stack([np.bincount(cell, rgb[:, k], n) for k in range(3)], axis=1)
        mean = sums / np.bincount(cell, minlength=n)[:, None]
        a, b = cells.pairs.T
        distance = np.linalg.norm(mean[a] - mean[b], axis=1)
        share = np.mean((cells.samples[:, a] == cells.samples[:, b]) & (cells.samples[:, a] > 0), axis=0)
        return self.image * (2 * share - 1) + self.colour * (self.typical - distance)

"""Which voxels each parent may claim in a crossover, where the last frame says which of the two to believe.

>>> claims = Claims(surface="sample", max_cleared=0.03)
>>> prediction = claims.limited(sample, prediction, exposed, doubtful)

The sample has seen the surface that the frame measures; the prediction may have seen what lies behind. A prediction
of which free space had to clear much was moved wrongly, and so were its hidden voxels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Clip, Hypothesis, frame_geometry

__all__ = ["Claims"]

SURFACE_VOXELS = 1.5  # how far behind the reading a voxel still counts as surface, as in completion


@dataclass(frozen=True)
class Claims:
    """What the parents of a candidate may claim.

    Parameters
    ----------
    surface : {"both", "sample"}
        Whose objects may fill voxels at the surface that the last frame measures: those of both, or of the
        sample alone. What a prediction has there and a sample has not is mostly a voxel or two of misplacement.
    hidden : {"order", "prediction"}
        Whose objects get voxels behind that surface which both claim: the one painted later, or the prediction.
    max_cleared : float
        A predicted object that lost more than this share of its voxels to free space adds no hidden voxels to
        those of the sample. 1 lets all of them.
    """

    surface: Literal["both", "sample"] = "both"
    hidden: Literal["order", "prediction"] = "order"
    max_cleared: float = 1.0

    def __post_init__(self) -> None:
        if self.surface not in ("both", "sample"):
            raise InputError(f'surface is {self.surface!r}, expected "both" or "sample"')
        if self.hidden not in ("order", "prediction"):
            raise InputError(f'hidden is {self.hidden!r}, expected "order" or "prediction"')
        if not 0 <= self.max_cleared <= 1:
            raise InputError(f"max_cleared is {self.max_cleared}, expected a share from 0 to 1")

    def exposed(self, clip: Clip) -> np.ndarray | None:
        """(X, Y, Z) bool: voxels at or before the measured surface, which nothing hides; None if not needed."""
        if self.surface == "both" and self.hidden == "order":
            return None
        with np.errstate(invalid="ignore"):
            signed = frame_geometry(clip.after, clip.grid).signed
            return np.asarray(signed < SURFACE_VOXELS * clip.grid.voxel_size)

    def doubtful(self, predicted: Hypothesis, refined: Hypothesis) -> np.ndarray | None:
        """(X, Y, Z) bool: voxels of objects that free space cleared too much of; None if there are none."""
        if self.max_cleared >= 1:
            return None
        left = refined.volumes()
        lost = [k for k, n in predicted.volumes().items() if left.get(k, 0) < (1 - self.max_cleared) * n]
        return np.isin(refined.labels, lost) if any(k in left for k in lost) else None

    def limited(
        self, sample: Hypothesis, prediction: Hypothesis, exposed: np.ndarray | None, doubtful: np.ndarray | None
    ) -> Hypothesis:
        """The prediction without the voxels that it must not add to a sample. An empty sample limits nothing."""
        if not sample.n_objects:
            return prediction
        barred = np.zeros(prediction.labels.shape, bool)
        if self.surface == "sample" and exposed is not None:
            barred |= exposed
        if doubtful is not None:
            barred |= doubtful
        barred &= (sample.labels == 0) & (prediction.labels != 0)
        if not barred.any():
            return prediction
        return prediction.with_labels(np.where(barred, 0, prediction.labels).astype(np.uint16))

    def predicted_wins(self, exposed: np.ndarray | None, doubtful: np.ndarray | None) -> np.ndarray | None:
        """(X, Y, Z) bool: voxels in which the prediction is painted last; None where the order decides."""
        if self.hidden == "order" or exposed is None:
            return None
        return ~exposed if doubtful is None else ~exposed & ~doubtful

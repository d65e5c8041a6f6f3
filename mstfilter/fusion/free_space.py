"""What the sensor looked through cannot be occupied: projection of a hypothesis onto known free space.

>>> refined, quality = FreeSpace().project(hypothesis, frame)

The share of voxels that a hypothesis keeps is its quality Q (paper, section IV-D): a prediction that has put
objects where there is nothing loses voxels and weight.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene.arrays import component_key, read_only
from mstfilter.scene.depth_noise import depth_sigma
from mstfilter.scene.frame import Frame
from mstfilter.scene.frame_geometry import frame_geometry
from mstfilter.scene.memo import memo
from mstfilter.scene.voxels import Hypothesis, VoxelGrid

__all__ = ["FreeSpace", "NoFreeSpace", "Projection"]


class Projection(ABC):
    """Moves a hypothesis onto the set of those that agree with a frame."""

    @abstractmethod
    def project(self, hypothesis: Hypothesis, frame: Frame) -> tuple[Hypothesis, float]:
        """The nearest agreeing hypothesis, and the share of voxels that it keeps, in [0, 1]."""


@dataclass(frozen=True)
class NoFreeSpace(Projection):
    """Every hypothesis is kept as it is, with quality 1."""

    def project(self, hypothesis: Hypothesis, frame: Frame) -> tuple[Hypothesis, float]:
        """The hypothesis itself."""
        return hypothesis, 1.0


@dataclass(frozen=True)
class FreeSpace(Projection):
    """Clears voxels that the depth image sees through.

    A voxel is known to be free where its centre lies in front of the measured surface by more than a margin for
    its own extent and for the sensor's noise at that range. What was not measured (no reading, the robot,
    outside the image, behind a surface) is unknown and stays. A voxel with a measured point inside it stays.

    Parameters
    ----------
    margin_voxels : float
        Margin for the extent of a voxel, in voxels.
    margin_sigmas : float
        Margin for the noise, in standard deviations of a depth reading at that range.
    table_height : float
        Voxels whose centre is below it (metres above the table) are cleared as well.
    """

    margin_voxels: float = 0.5
    margin_sigmas: float = 3.0
    table_height: float = 0.0

    def __post_init__(self) -> None:
        margins = (self.margin_voxels, self.margin_sigmas)
        if not (np.isfinite([*margins, self.table_height]).all() and min(margins) >= 0):
            raise InputError(
                f"free space has margin_voxels {self.margin_voxels}, margin_sigmas {self.margin_sigmas} and "
                f"table_height {self.table_height}, expected finite numbers, margins >= 0"
            )

    def known_free(self, frame: Frame, grid: VoxelGrid) -> np.ndarray:
        """(X, Y, Z) bool: voxels that cannot be occupied. Memoised by content."""
        key = (frame.key, grid.key, component_key(self))
        return memo("known_free", key, lambda: read_only(self._known_free(frame, grid)))

    def _known_free(self, frame: Frame, grid: VoxelGrid) -> np.ndarray:
        geometry = frame_geometry(frame, grid)
        # The noise belongs to the reading, so its range is that of the measured surface.
        margin = self.margin_voxels * grid.voxel_size + self.margin_sigmas * depth_sigma(geometry.z - geometry.signed)
        with np.errstate(invalid="ignore"):
            free = geometry.signed < -margin
        seen = grid.index_of(frame.points[frame.valid])
        seen = seen[grid.contains(seen)]
        free[tuple(seen.T)] = False
        below = grid.origin[2] + (np.arange(grid.shape[2]) + 0.5) * grid.voxel_size < self.table_height
        free[:, :, below] = True
        return free

    def project(self, hypothesis: Hypothesis, frame: Frame) -> tuple[Hypothesis, float]:
        """Clear known free voxels; the quality of a hypothesis without voxels is 1."""
        occupied = hypothesis.labels != 0
        hit = occupied & self.known_free(frame, hypothesis.grid)
        n_hit = int(hit.sum())
        if n_hit == 0:
            return hypothesis, 1.0
        quality = 1.0 - n_hit / int(occupied.sum())
        return hypothesis.with_labels(np.where(hit, 0, hypothesis.labels).astype(np.uint16)), quality

"""What the sensor looked through cannot be occupied: projection of a hypothesis onto known free space.

>>> refined, quality = FreeSpace().project(hypothesis, frame)           # one frame, all its cameras
>>> refined, quality = FreeSpace().refine(hypotheses, clip)             # many, at the end of a clip

The share of voxels that a hypothesis keeps is its quality Q (paper, section IV-D): a prediction that has put
objects where there is nothing loses voxels and weight. `mstfilter.fusion.projection` makes an update of it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, is_dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import (
    Clip,
    Frame,
    Hypothesis,
    VoxelGrid,
    content_key,
    depth_sigma,
    frame_geometry,
    memo,
    read_only,
)

__all__ = ["SMALLEST_QUALITY", "FreeSpace", "NoFreeSpace", "Projection", "Voxels"]

SMALLEST_QUALITY = 1e-3
"""What Q counts as in a weight at least: if all predictions lost every voxel, all weights would be zero."""


class Voxels(Protocol):
    """What a particle needs to be projected: labels on a grid. A `Hypothesis`, or any dataclass with these fields."""

    @property
    def labels(self) -> np.ndarray:
        """(X, Y, Z): 0 is free."""

    @property
    def grid(self) -> VoxelGrid:
        """Where the voxels are."""


P = TypeVar("P", bound=Voxels)


class Projection(ABC):
    """Moves a hypothesis onto the set of those that agree with what was seen."""

    @abstractmethod
    def project(self, hypothesis: Any, frame: Frame) -> tuple[Any, float]:
        """The nearest hypothesis that agrees with a frame, and the share of voxels that it keeps, in [0, 1]."""

    def refine(self, hypotheses: Sequence[Any], clip: Clip) -> tuple[tuple[Any, ...], np.ndarray]:
        """Hypotheses about the end of a clip, projected, and their qualities (n,).

        By default onto the last frame alone; one that looks at more overrides this.
        """
        pairs = [self.project(hypothesis, clip.after) for hypothesis in hypotheses]
        return tuple(h for h, _ in pairs), np.array([q for _, q in pairs])


@dataclass(frozen=True)
class NoFreeSpace(Projection):
    """Every hypothesis is kept as it is, with quality 1."""

    def project(self, hypothesis: Any, frame: Frame) -> tuple[Any, float]:
        """The hypothesis itself."""
        return hypothesis, 1.0


@dataclass(frozen=True)
class FreeSpace(Projection):
    """Clears voxels that the depth image sees through.

    A voxel is known to be free where its centre lies in front of the measured surface by more than a margin for
    its own extent and for the sensor's noise at that range. What was not measured (no reading, the robot,
    outside the image, behind a surface) is unknown and stays. A voxel with a measured point inside it stays.

    Several cameras (`Frame.views`) clear what any of them sees through; a measured point of any protects a voxel.

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
        """Voxels (X, Y, Z) bool that a frame observes as free. Memoised by content."""
        key = content_key("free space", self.margin_voxels, self.margin_sigmas, self.table_height)
        return memo("known_free", (frame.key, grid.key, key), lambda: read_only(self._known_free(frame, grid)))

    def _known_free(self, frame: Frame, grid: VoxelGrid) -> np.ndarray:
        free, hit = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
        for view in frame.all_views:
            geometry = frame_geometry(view, grid)
            # The noise belongs to the reading, so its range is that of the measured surface.
            noise = depth_sigma(geometry.z - geometry.signed)
            margin = self.margin_voxels * grid.voxel_size + self.margin_sigmas * noise
            with np.errstate(invalid="ignore"):
                free |= geometry.signed < -margin
            points = grid.index_of(view.points[view.valid])
            hit[tuple(points[grid.contains(points)].T)] = True
        free &= ~hit
        below = grid.origin[2] + (np.arange(grid.shape[2]) + 0.5) * grid.voxel_size < self.table_height
        free[:, :, below] = True
        return free

    def project(self, hypothesis: P, frame: Frame) -> tuple[P, float]:
        """Clear voxels that the frame observes as free. A hypothesis without voxels has quality 1."""
        return _cleared(hypothesis, self.known_free(frame, hypothesis.grid))


def _cleared(particle: P, free: np.ndarray) -> tuple[P, float]:
    """The particle without free voxels, and the share that it keeps."""
    occupied = particle.labels != 0
    hit = occupied & free
    n_hit = int(hit.sum())
    if n_hit == 0:
        return particle, 1.0
    labels = np.where(hit, 0, particle.labels).astype(particle.labels.dtype)
    quality = 1.0 - n_hit / int(occupied.sum())
    cleared: Any = particle.with_labels(labels) if isinstance(particle, Hypothesis) else _with(particle, labels)
    return cleared, quality


def _with(particle: Any, labels: np.ndarray) -> Any:
    """The same particle with other labels."""
    if not is_dataclass(particle):
        raise InputError(
            f"a particle is a {type(particle).__name__}, and free space cannot clear it",
            "it takes a Hypothesis, or a dataclass with fields labels and grid",
        )
    return replace(particle, labels=labels)  # type: ignore[type-var]

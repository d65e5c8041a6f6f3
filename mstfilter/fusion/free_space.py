"""What the sensor looked through cannot be occupied: projection of a hypothesis onto known free space.

>>> refined, quality = FreeSpace().project(hypothesis, frame)           # one frame, all its cameras
>>> refined, quality = FreeSpace().refine(hypotheses, clip)             # many, at the end of a clip, with memory

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
from mstfilter.fusion.scene_memory import SceneMemory, Seen
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
    memory : SceneMemory
        What was seen to be free at earlier pauses and is hidden now; by default nothing is remembered.
    """

    margin_voxels: float = 0.5
    margin_sigmas: float = 3.0
    table_height: float = 0.0
    memory: SceneMemory = SceneMemory()  # noqa: RUF009 (frozen)

    def __post_init__(self) -> None:
        margins = (self.margin_voxels, self.margin_sigmas)
        if not (np.isfinite([*margins, self.table_height]).all() and min(margins) >= 0):
            raise InputError(
                f"free space has margin_voxels {self.margin_voxels}, margin_sigmas {self.margin_sigmas} and "
                f"table_height {self.table_height}, expected finite numbers, margins >= 0"
            )

    def known_free(self, frame: Frame, grid: VoxelGrid) -> np.ndarray:
        """(X, Y, Z) bool: voxels that cannot be occupied, by this frame alone. Memoised by content."""
        return self._look(frame, grid).free

    def hidden(self, frame: Frame, grid: VoxelGrid) -> np.ndarray:
        """(X, Y, Z) bool: voxels of which this frame says nothing: well behind a surface, or without a reading."""
        return self._look(frame, grid).hidden

    def known_free_after(self, clip: Clip) -> np.ndarray:
        """(X, Y, Z) bool on the clip's grid: voxels that cannot be occupied at its end, memory included."""
        return self.memory.free(self._look, self._key, clip)

    @property
    def _key(self) -> bytes:
        """Names how a frame is looked at; memory plays no part in it."""
        return content_key("free space", self.margin_voxels, self.margin_sigmas, self.table_height)

    def _look(self, frame: Frame, grid: VoxelGrid) -> Seen:
        return memo("seen", (frame.key, grid.key, self._key), lambda: self._seen(frame, grid))

    def _seen(self, frame: Frame, grid: VoxelGrid) -> Seen:
        free, hit, hidden = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool), np.ones(grid.shape, bool)
        for view in frame.all_views:
            geometry = frame_geometry(view, grid)
            # The noise belongs to the reading, so its range is that of the measured surface.
            noise = depth_sigma(geometry.z - geometry.signed)
            margin = self.margin_voxels * grid.voxel_size + self.margin_sigmas * noise
            with np.errstate(invalid="ignore"):
                free |= geometry.signed < -margin
                hidden &= ~(geometry.signed <= margin)  # no reading, or well behind one
            points = grid.index_of(view.points[view.valid])
            hit[tuple(points[grid.contains(points)].T)] = True
        free &= ~hit
        below = grid.origin[2] + (np.arange(grid.shape[2]) + 0.5) * grid.voxel_size < self.table_height
        free[:, :, below], hit[:, :, below] = True, False
        return Seen(read_only(free), read_only(hit), read_only(hidden & ~hit & ~free))

    def project(self, hypothesis: P, frame: Frame) -> tuple[P, float]:
        """Clear what this frame shows to be free; the quality of a hypothesis without voxels is 1."""
        return _cleared(hypothesis, self.known_free(frame, hypothesis.grid))

    def refine(self, hypotheses: Sequence[P], clip: Clip) -> tuple[tuple[P, ...], np.ndarray]:
        """Clear what is known to be free at the end of a clip."""
        if not self.memory.pauses:
            return super().refine(hypotheses, clip)
        if any(hypothesis.grid != clip.grid for hypothesis in hypotheses):
            raise InputError(f"clip {clip.index} and a hypothesis about it have different grids")
        free = self.known_free_after(clip)
        pairs = [_cleared(hypothesis, free) for hypothesis in hypotheses]
        return tuple(h for h, _ in pairs), np.array([q for _, q in pairs])


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

"""Clears voxels that the depth image observes as free (paper, section IV-D).

>>> refined, quality = FreeSpace().project(hypothesis, frame)           # one hypothesis, one frame
>>> refined, quality = FreeSpace().refine(hypotheses, clip)             # several, at the end of a clip

The quality of a prediction is Q = 1 - (occupied voxels that are cleared) / (occupied voxels). The update adds
lambda log Q to its log weight; lambda is `quality_exponent`. So a prediction with objects in free space loses voxels
and weight.

`ProjectionUpdate` is an update that consists of this projection alone. If only a thin set of states agrees with an
observation, hardly any prediction lies in it. So a projection moves every particle into it (the manifold filter of
Koval, Pollard and Srinivasa 2015; for vectors `mstfilter.smc.ProjectOnto`). Here it is the set of scenes without
voxels in observed free space.

>>> filter = ParticleFilter(proposal=None, initial=..., transition=..., update=ProjectionUpdate(), ...)
"""

from __future__ import annotations

from dataclasses import dataclass, is_dataclass, replace
from typing import Any, ClassVar

import numpy as np

from mstfilter.errors import InputError, check_component, check_number
from mstfilter.fusion.interfaces import Projection
from mstfilter.scene import (
    Clip,
    Frame,
    Hypothesis,
    VoxelGrid,
    component_key,
    depth_sigma,
    frame_geometry,
    memo,
    read_only,
)
from mstfilter.smc import Population, Update, union

_SMALLEST_QUALITY = 1e-3


@dataclass(frozen=True)
class NoFreeSpace(Projection):
    """Leaves every hypothesis unchanged, with quality 1."""

    def project(self, hypothesis: Any, frame: Frame) -> tuple[Any, float]:
        return hypothesis, 1.0


@dataclass(frozen=True)
class FreeSpace(Projection):
    """Clears voxels that the depth image observes as free.

    A voxel is free if its centre lies in front of the measured surface by more than the sum of two margins: for the
    extent of the voxel, and for the noise of the sensor at that range (`mstfilter.scene.depth_sigma`). Voxels without
    a measurement (no reading, the robot, outside the image, behind a surface) are unknown and stay. A voxel with a
    measured point inside stays.

    With several cameras (`Frame.views`) a voxel is free if one of them observes it as free and none has a measured
    point in it.

    Parameters
    ----------
    margin_voxels : float
        Margin for the extent of a voxel, in voxels.
    margin_sigmas : float
        Margin for the noise, in standard deviations of a depth reading at that range.
    table_height : float
        Voxels with centres below this height (metres above the table) are cleared as well, whatever was measured.
    """

    margin_voxels: float = 0.5
    margin_sigmas: float = 3.0
    table_height: float = 0.0

    def __post_init__(self) -> None:
        check_number("margin_voxels", self.margin_voxels, at_least=0)
        check_number("margin_sigmas", self.margin_sigmas, at_least=0)
        check_number("table_height", self.table_height)

    def known_free(self, frame: Frame, grid: VoxelGrid) -> np.ndarray:
        """Voxels (X, Y, Z) bool that a frame observes as free. Cached by content."""
        key = (frame.key, grid.key, component_key(self))
        return memo("known_free", key, lambda: read_only(self._known_free(frame, grid)))

    def _known_free(self, frame: Frame, grid: VoxelGrid) -> np.ndarray:
        free, hit = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
        for view in frame.all_views:
            geometry = frame_geometry(view, grid)
            # The noise is that of the reading, so it is computed at the range of the measured surface.
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

    def project(self, hypothesis: Any, frame: Frame) -> tuple[Any, float]:
        """Clear voxels that the frame observes as free. A hypothesis without voxels has quality 1.

        `hypothesis` is a `Hypothesis`, or any dataclass with ``labels`` (X, Y, Z), 0 is free, and their ``grid``.
        """
        occupied = hypothesis.labels != 0
        hit = occupied & self.known_free(frame, hypothesis.grid)
        n_hit = int(hit.sum())
        if isinstance(hypothesis, Hypothesis) and hypothesis.occupancy is not None:
            hit = (hypothesis.occupancy.probability > 0) & self.known_free(frame, hypothesis.grid)
        if not hit.any():
            return hypothesis, 1.0
        labels = np.where(hit, 0, hypothesis.labels).astype(hypothesis.labels.dtype)
        quality = 1.0 - n_hit / max(int(occupied.sum()), 1)
        if isinstance(hypothesis, Hypothesis):
            return hypothesis.without(hit), quality
        if not is_dataclass(hypothesis) or isinstance(hypothesis, type):
            raise InputError(
                f"a particle is a {type(hypothesis).__name__}, and free space cannot clear it",
                "it takes a Hypothesis, or a dataclass with fields labels and grid",
            )
        return replace(hypothesis, labels=labels), quality


def log_quality(quality: np.ndarray) -> np.ndarray:
    """log max(Q, 1e-3) (n,) of qualities Q (n,), so that a prediction that loses all voxels has positive weight."""
    return np.log(np.maximum(quality, _SMALLEST_QUALITY))


@dataclass(frozen=True)
class ProjectionUpdate(Update):
    """Projects every particle, and adds lambda log Q to its log weight, lambda the `quality_exponent`.

    Q is the share of voxels that a particle keeps. Proposed particles join the predicted ones.
    """

    free_space: Projection = FreeSpace()
    quality_exponent: float = 3.0

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_component("free_space", self.free_space, Projection)
        check_number("quality_exponent", self.quality_exponent, at_least=0)

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        population = union(predicted, proposed)
        refined, quality = self.free_space.refine(population.particles, observation)
        log_weights = population.log_weights + self.quality_exponent * log_quality(quality)
        return Population(refined, log_weights, population.parents, {"quality": quality.tolist()})

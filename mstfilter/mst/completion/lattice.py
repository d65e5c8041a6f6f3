"""Completers that work on voxels of 1 cm, in a crop around the object, whatever the voxels of the workspace.

If the voxels of the workspace have another size, an `OnLattice` completer completes the object in voxels of 1 cm (the
lattice), and the result is interpolated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from mstfilter.base.fields import Bounds
from mstfilter.mst.completion.completer import Completer, Completion, finish
from mstfilter.mst.completion.crops import LATTICE, crop_box
from mstfilter.mst.completion.observed import observed_in
from mstfilter.scene import Frame, ObjectView, VoxelGrid


@dataclass(frozen=True)
class OnLattice(Completer):
    """A completer that works on a lattice of 1 cm.

    Parameters
    ----------
    log_odds : float
        Added to the log odds of every voxel with a probability between 0 and 1.
    """

    log_odds: Annotated[float, Bounds()] = 0.0

    def box(self, voxels: np.ndarray, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
        return crop_box(voxels, grid)

    def complete_each(
        self,
        rngs: Sequence[np.random.Generator],
        frame: Frame,
        masks: Sequence[np.ndarray],
        grid: VoxelGrid,
        views: Sequence[tuple[ObjectView, ...]] | None = None,
    ) -> list[Completion]:
        lattice = grid  # over the workspace; views have boxes of it
        if abs(grid.voxel_size - LATTICE) >= 1e-6:
            lattice = VoxelGrid.from_bounds(grid.origin, grid.upper, LATTICE)
        found = super().complete_each(rngs, frame, masks, lattice, views)
        if lattice is not grid:
            found = [self._on_grid(one, frame, m, grid, lattice) for one, m in zip(found, masks, strict=True)]
        return [one.shifted(self.log_odds).with_surface() for one in found]

    def _on_grid(
        self, one: Completion, frame: Frame, mask: np.ndarray, grid: VoxelGrid, lattice: VoxelGrid
    ) -> Completion:
        """A completion on the lattice, interpolated at the voxels of the grid."""
        from scipy.ndimage import map_coordinates

        corners = np.array([one.offset, one.offset + one.probability.shape]) * LATTICE / grid.voxel_size
        low, high = np.floor(corners[0] + 1e-6).astype(np.int64), np.ceil(corners[1] - 1e-6).astype(np.int64)
        high = np.maximum(np.minimum(high, grid.shape), low)
        seen = observed_in(frame, np.asarray(mask, dtype=bool), grid, self, low, high)
        p = np.zeros(seen.surface.shape, np.float32)
        if p.size:
            index = np.indices(p.shape).reshape(3, -1).T + low
            at = (grid.centre_of(index) - np.asarray(lattice.origin)) / LATTICE - 0.5 - one.offset
            p = map_coordinates(one.probability, at.T, order=1, mode="nearest").reshape(p.shape)
        return replace(finish(low, seen, p, one.key), views=one.views)

"""Completion without learned weights: the visible surface, extruded down to the table.

>>> completions = Extrude().complete(rng, frame, masks, grid)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, Delaunay, QhullError

from mstfilter.mst.completion.completer import Completer
from mstfilter.mst.completion.observed import ObservedBox


@dataclass(frozen=True)
class SurfaceOnly(Completer):
    """A completer that returns the visible surface alone."""

    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        return seen.surface.astype(np.float32)


@dataclass(frozen=True)
class Extrude(Completer):
    """The visible surface, extruded down to the table or to the surface of another object.

    Most objects stand on the table, so the space below a visible top or side belongs to the object.

    Parameters
    ----------
    below : float
        Probability of an occluded voxel below the surface. The default is the precision on simulated scenes.
    floor : float
        Voxels below `floor` metres are free.
    """

    below: float = 0.8
    floor: float = 0.0

    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        """Probability 1 on the visible surface, and `below` for the voxels below the surface."""
        filled = extruded_down(seen.surface, seen.other_surface)
        p = np.where(seen.surface, 1.0, np.where(filled, self.below, 0.0)).astype(np.float32)
        p[:, :, seen.height < self.floor] = 0
        return p


def extruded_down(surface: Any, other_surface: Any) -> Any:
    """A surface (..., Z) bool and the voxels below, down to another surface; an array or a torch tensor."""
    filled = surface | False  # a copy
    for k in range(surface.shape[-1] - 2, -1, -1):
        filled[..., k] |= filled[..., k + 1] & ~other_surface[..., k]
    return filled


@dataclass(frozen=True)
class Hull(Extrude):
    """The convex hull of the extruded surface, without voxels observed as free."""

    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        p = super().fill(rng, seen)
        voxels = np.argwhere(p > 0)
        try:
            corners = voxels[ConvexHull(voxels).vertices]
            inside = Delaunay(corners).find_simplex(np.indices(p.shape).reshape(3, -1).T) >= 0
        except (QhullError, ValueError):  # fewer than four voxels, or all in one plane
            return p
        return np.maximum(p, self.below * (inside.reshape(p.shape) & ~seen.other_surface))

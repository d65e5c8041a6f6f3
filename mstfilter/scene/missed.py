"""A workspace that misses the scene: nothing would be found in it, so it is told beforehand.

>>> warn_if_missed(frames_at_the_pauses, grid, "recording table-7")

Objects are sought inside the voxel grid only. A grid in other units, around another place, or below a pose that is
upside down gives hypotheses without objects and no error.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import numpy as np

from mstfilter.errors import InputWarning
from mstfilter.scene.frame import Frame
from mstfilter.scene.voxels import VoxelGrid

__all__ = ["warn_if_missed"]

ABOVE = 0.01
"""Metres above the table from which a reading may show an object."""
FEW = 30
"""Fewer readings than this show none: single ones occur by noise."""


def warn_if_missed(frames: Iterable[Frame], grid: VoxelGrid, where: str) -> None:
    """Warn where no frame has readings inside the grid and above the table.

    Parameters
    ----------
    frames : iterable of Frame
        With poses, at the pauses. Looked at until one has such readings.
    grid : VoxelGrid
        Workspace.
    where : str
        For the message.
    """
    spans = []
    for frame in frames:
        points = frame.points[frame.valid]
        inside = points[grid.contains(grid.index_of(points))]
        if (inside[:, 2] > ABOVE).sum() >= FEW:
            return
        if len(points):
            spans.append(np.percentile(points, (2, 98), axis=0))
    if not spans:
        return
    low, high = np.min(spans, axis=0)[0], np.max(spans, axis=0)[1]
    seen = ", ".join(f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", low, high, strict=True))
    held = ", ".join(f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", grid.origin, grid.upper, strict=True))
    warnings.warn(
        InputWarning(
            f"the workspace of {where} holds nothing above the table, so no object can be found: it spans {held} m, "
            f"depth readings span {seen} m",
            "give a workspace around the objects, or none: it is then laid around what stands on the table",
            "the world's z is up and the table at z = 0: is the pose right?",
        ),
        stacklevel=3,
    )

"""Trivial baselines that every quality is shown beside.

>>> one_blob(labels), components(labels)        # label grids of the same shape

Both keep the occupied voxels of a hypothesis and only change which object they belong to. A filter that is not
better than these has found out where something is, not what belongs together.
"""

from __future__ import annotations

import numpy as np

__all__ = ["components", "one_blob"]


def one_blob(labels: np.ndarray) -> np.ndarray:
    """All occupied voxels as one object, (X, Y, Z) uint16."""
    return (labels > 0).astype(np.uint16)


def components(labels: np.ndarray) -> np.ndarray:
    """Connected components of the occupied voxels (sharing a face), (X, Y, Z) int32."""
    from scipy.ndimage import label

    return label(labels > 0)[0]

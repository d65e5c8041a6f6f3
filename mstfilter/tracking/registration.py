"""Registration of a segment's surface before and after, by small_gicp with one thread.

>>> target = prepare(after_points)                                    # doctest: +SKIP
>>> register(prepare(before_points), target, init, reach=0.02).T      # doctest: +SKIP

One thread, always: the order of a parallel sum changes the last digits and so, in time, everything else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mstfilter.tracking import rigid

__all__ = ["Fit", "Surface", "centroid_shift", "prepare", "register"]

Array = NDArray[np.float64]

MIN_POINTS = 12


@dataclass(frozen=True, eq=False)
class Surface:
    """A downsampled point cloud made ready for registration.

    Attributes
    ----------
    points : (N, 3) metres.
    cloud, tree : small_gicp's own structures (normals and covariances estimated).
    """

    points: Array
    cloud: Any
    tree: Any


@dataclass(frozen=True)
class Fit:
    """Result of a registration.

    Attributes
    ----------
    T : (4, 4) motion.
    rms : root mean square distance from each moved source point to its nearest target point, metres.
    median : median of the same distances, metres.
    overlap : share of the moved source points with a target point within the reach.
    """

    T: Array
    rms: float
    median: float
    overlap: float


def prepare(points: Array, spacing: float = 0.004) -> Surface | None:
    """Downsample points (N, 3) to ``spacing`` metres and estimate covariances; None for too few points."""
    import small_gicp

    if len(points) < MIN_POINTS:
        return None
    cloud, tree = small_gicp.preprocess_points(
        np.ascontiguousarray(points, dtype=np.float64),
        downsampling_resolution=spacing,
        num_neighbors=12,
        num_threads=1,
    )
    if cloud.size() < MIN_POINTS:
        return None
    return Surface(np.asarray(cloud.points())[:, :3].copy(), cloud, tree)


def register(
    source: Surface, target: Surface, init: Array, reach: float, method: str = "GICP", iterations: int = 30
) -> Fit | None:
    """Align source to target from an initial motion.

    Parameters
    ----------
    source, target : Surface
    init : (4, 4) motion to start from.
    reach : largest correspondence distance, metres.
    method : "GICP", "PLANE_ICP" or "ICP" (point to point).
    iterations : at most.

    Returns
    -------
    Fit, or None where the result is not a finite rigid motion.
    """
    import small_gicp

    result = small_gicp.align(
        target.cloud,
        source.cloud,
        target.tree,
        init,
        registration_type=method,
        max_correspondence_distance=reach,
        num_threads=1,
        max_iterations=iterations,
    )
    T = np.array(result.T_target_source, dtype=np.float64)
    if not np.isfinite(T).all():
        return None
    T[:3, :3] = _orthogonal(T[:3, :3])
    return assess(source, target, T, reach)


def assess(source: Surface, target: Surface, T: Array, reach: float) -> Fit:
    """How well a motion brings source onto target."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(target.points).query(rigid.apply(T, source.points))
    return Fit(
        T,
        float(np.sqrt((distance**2).mean())),
        float(np.median(distance)),
        float((distance <= reach).mean()),
    )


def centroid_shift(source: Array, target: Array) -> Array:
    """Motion (4, 4) that carries the component-wise median of source (N, 3) onto that of target (M, 3)."""
    T = np.eye(4)
    T[:3, 3] = np.median(target, axis=0) - np.median(source, axis=0)
    return T


def _orthogonal(R: Array) -> Array:
    """The nearest rotation: repeated products drift by rounding."""
    U, _, Vt = np.linalg.svd(R)
    return U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt

"""Registration (ICP) of a segment's surfaces before and after a clip.

>>> source, target = prepare(points_before), prepare(points_after)                 # doctest: +SKIP
>>> result = SmallGicp().register(source, target, np.eye(4), reach=0.02)           # doctest: +SKIP
>>> result.T, result.overlap                                                       # doctest: +SKIP

A `Surface` is a downsampled cloud with normals, covariances and a search tree, prepared once for all registrations of
a segment. small_gicp runs on one thread, because with several, the order of a sum changes the last digits of the
result.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from mstfilter.base.fields import PositiveInt
from mstfilter.base.results import Checked, check_array, check_rigid, check_type, returns
from mstfilter.mst.tracking.rigid import move_points

_MIN_POINTS = 12
_SPACING = 0.004  # metres between the points of a downsampled cloud
_N_NEIGHBOURS = 12  # for normals and covariances


@dataclass(frozen=True, eq=False)
class Surface:
    """A point cloud prepared for registration by `prepare`."""

    points: np.ndarray  #: (N, 3) downsampled points, metres
    cloud: Any  #: small_gicp's cloud (with normals and covariances) and search tree
    tree: Any

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Distance of points (M, 3) to the nearest point of the surface, (M,) metres."""
        homogeneous = np.hstack([points, np.ones((len(points), 1))])
        nearest, _ = self.tree.batch_nearest_neighbor_search(homogeneous, num_threads=1)
        return np.linalg.norm(points - self.points[np.asarray(nearest)], axis=1)


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """Result of a registration."""

    T: np.ndarray  #: (4, 4) motion of the source
    rms: float  #: root mean square distance from each moved source point to its nearest target point, metres
    overlap: float  #: fraction of the moved source points with a target point within the reach


def prepare(points: np.ndarray) -> Surface | None:
    """Prepare points (N, 3), world metres, for registration; None for fewer than 12 points."""
    import small_gicp

    if len(points) < _MIN_POINTS:
        return None
    cloud, tree = small_gicp.preprocess_points(
        np.ascontiguousarray(points, dtype=np.float64),
        downsampling_resolution=_SPACING,
        num_neighbors=_N_NEIGHBOURS,
        num_threads=1,
    )
    if cloud.size() < _MIN_POINTS:
        return None
    return Surface(np.asarray(cloud.points())[:, :3].copy(), cloud, tree)


def _check_registration(self: Registration, found: RegistrationResult | None, *_: Any, **__: Any) -> Any:
    if found is not None:
        check_type(found, RegistrationResult, "a RegistrationResult or None")
        check_rigid(check_array(found.T, (4, 4)), "a motion")
        check_array(np.array([found.rms, found.overlap], dtype=np.float64), (2,), at_least=0)
    return found


class Registration(Checked, ABC):
    """Aligns two surfaces from an initial motion."""

    @returns(_check_registration)
    @abstractmethod
    def register(self, source: Surface, target: Surface, init: np.ndarray, reach: float) -> RegistrationResult | None:
        """Align the source to the target; None if the result is not finite.

        `init` (4, 4) is the initial motion of the source in world metres, `reach` the largest distance of a
        correspondence in metres.
        """


@dataclass(frozen=True)
class SmallGicp(Registration):
    """small_gicp (Koide 2024), one thread, at most `iterations` iterations.

    `method` is generalised, point-to-plane or point-to-point ICP.
    """

    method: Literal["GICP", "PLANE_ICP", "ICP"] = "GICP"
    iterations: PositiveInt = 30

    def register(self, source: Surface, target: Surface, init: np.ndarray, reach: float) -> RegistrationResult | None:
        import small_gicp

        found = small_gicp.align(
            target.cloud,
            source.cloud,
            target.tree,
            init,
            registration_type=self.method,
            max_correspondence_distance=reach,
            num_threads=1,
            max_iterations=self.iterations,
        )
        T = np.array(found.T_target_source, dtype=np.float64)
        if not np.isfinite(T).all():
            return None
        # The nearest rotation removes the rounding errors of repeated products.
        U, _, Vt = np.linalg.svd(T[:3, :3])
        T[:3, :3] = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        distance = target.distances(move_points(T, source.points))
        return RegistrationResult(T, float(np.sqrt((distance**2).mean())), float((distance <= reach).mean()))


def centroid_shift(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Motion (4, 4) that moves the component-wise median of source (N, 3) to that of target (M, 3)."""
    T = np.eye(4)
    T[:3, 3] = np.median(target, axis=0) - np.median(source, axis=0)
    return T

"""Registration of the surface of a segment before and after, by small_gicp or open3d.

>>> source, target = prepare(points_before), prepare(points_after)                 # doctest: +SKIP
>>> result = SmallGicp().register(source, target, np.eye(4), reach=0.02)           # doctest: +SKIP
>>> result.T, result.overlap, result.iterations                                    # doctest: +SKIP

A `Surface` holds the downsampled cloud with normals, covariances and search tree. It is prepared once and used by all
registrations of the segment. All methods run on one thread: with several threads the order of a sum changes the last
digits of the result.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mstfilter.errors import InputError, check_choice, check_number
from mstfilter.open3d_import import import_open3d
from mstfilter.results import Checked, check_array, check_rigid, check_type, returns
from mstfilter.tracking.rigid import move_points

_MIN_POINTS = 12
_SPACING = 0.004  # metres between the points of a downsampled cloud
_N_NEIGHBOURS = 12  # for normals and covariances


@dataclass(frozen=True, eq=False)
class Surface:
    """A point cloud prepared for registration; make one with `prepare`."""

    points: np.ndarray  #: (N, 3) downsampled points, metres
    cloud: Any  #: small_gicp's cloud (with normals and covariances) and search tree
    tree: Any
    raw_points: np.ndarray  #: (M, 3) points before downsampling, metres
    raw_colours: np.ndarray | None  #: (M, 3) their colours, grey levels 0 .. 255, or None

    @cached_property
    def open3d_cloud(self) -> Any:
        """open3d's cloud, downsampled, with normals and colours; made on first use."""
        o3d = import_open3d()
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(self.raw_points)))
        if self.raw_colours is not None:
            cloud.colors = o3d.utility.Vector3dVector(np.asarray(self.raw_colours, dtype=np.float64) / 255)
        cloud = cloud.voxel_down_sample(_SPACING)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=3 * _SPACING, max_nn=30))
        return cloud

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
    #: Objective of the method (small_gicp), or root mean square distance of the inliers in metres (open3d).
    error: float
    inliers: int  #: number of correspondences within the reach
    converged: bool | None = None  #: whether the method converged; None for open3d
    iterations: int | None = None  #: index of the last iteration; None for open3d
    H: np.ndarray | None = None  #: (6, 6) Gauss-Newton matrix of the objective, rotation first; None for open3d


def prepare(points: np.ndarray, colours: np.ndarray | None = None) -> Surface | None:
    """Prepare points (N, 3) with colours (N, 3) in 0 .. 255 for registration; None if there are fewer than 12."""
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
    return Surface(np.asarray(cloud.points())[:, :3].copy(), cloud, tree, points, colours)


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
        """Align source to target; None if the result is not finite.

        `init` (4, 4) is the initial motion of the source in world metres, `reach` the largest distance of a
        correspondence in metres.
        """


@dataclass(frozen=True)
class SmallGicp(Registration):
    """small_gicp (Koide 2024), one thread, at most `iterations` iterations.

    `method` is "GICP", "PLANE_ICP" or "ICP": generalised, point-to-plane or point-to-point ICP.
    """

    method: str = "GICP"
    iterations: int = 30

    def __post_init__(self) -> None:
        check_choice("method", self.method, ("GICP", "PLANE_ICP", "ICP"))

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
        statistics = (found.error, found.num_inliers, found.converged, found.iterations, found.H)
        return _result(found.T_target_source, source, target, reach, *statistics)


@dataclass(frozen=True)
class PointToPlaneIcp(Registration):
    """open3d's point-to-plane ICP (Chen and Medioni 1991), at most `iterations` iterations."""

    iterations: int = 30

    def register(self, source: Surface, target: Surface, init: np.ndarray, reach: float) -> RegistrationResult | None:
        icp = import_open3d().pipelines.registration
        estimation = icp.TransformationEstimationPointToPlane()
        return _by_open3d(icp.registration_icp, estimation, self.iterations, source, target, init, reach)


@dataclass(frozen=True)
class ColouredIcp(Registration):
    """open3d's coloured ICP (Park et al., ICCV 2017). Colour determines motions along a surface; depth does not.

    Minimises the sum of ``w d^2 + (1 - w) c^2`` over the correspondences, with d the point-to-plane distance in
    metres, c the difference of grey values 0 .. 1, and w such that `distance_scale` metres and `colour_scale` grey
    levels (0 .. 255) have equal cost. Both surfaces need colours. It takes at most `iterations` iterations.
    """

    distance_scale: float = 0.002
    colour_scale: float = 25.0
    iterations: int = 30

    def __post_init__(self) -> None:
        check_number("distance_scale", self.distance_scale, above=0)
        check_number("colour_scale", self.colour_scale, above=0)

    def register(self, source: Surface, target: Surface, init: np.ndarray, reach: float) -> RegistrationResult | None:
        if source.raw_colours is None or target.raw_colours is None:
            raise InputError("coloured ICP needs the colours of both surfaces", "prepare(points, colours)")
        c, d = self.colour_scale / 255, self.distance_scale
        icp = import_open3d().pipelines.registration
        estimation = icp.TransformationEstimationForColoredICP(c**2 / (c**2 + d**2))
        return _by_open3d(icp.registration_colored_icp, estimation, self.iterations, source, target, init, reach)


def _by_open3d(
    method: Callable,
    estimation: Any,
    iterations: int,
    source: Surface,
    target: Surface,
    init: np.ndarray,
    reach: float,
) -> RegistrationResult | None:
    criteria = import_open3d().pipelines.registration.ICPConvergenceCriteria(max_iteration=iterations)
    found = method(source.open3d_cloud, target.open3d_cloud, reach, init, estimation, criteria)
    inliers = len(np.asarray(found.correspondence_set))
    return _result(found.transformation, source, target, reach, float(found.inlier_rmse), inliers)


def _result(
    motion: np.ndarray, source: Surface, target: Surface, reach: float, *statistics: Any
) -> RegistrationResult | None:
    """The result of a registration, with the nearest rotation; None if the motion (4, 4) is not finite."""
    T = np.array(motion, dtype=np.float64)
    if not np.isfinite(T).all():
        return None
    # The nearest rotation removes the rounding errors of repeated products.
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    distance = target.distances(move_points(T, source.points))
    rms, overlap = float(np.sqrt((distance**2).mean())), float((distance <= reach).mean())
    return RegistrationResult(T, rms, overlap, *statistics)


def centroid_shift(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Motion (4, 4) that moves the component-wise median of source (N, 3) to that of target (M, 3)."""
    T = np.eye(4)
    T[:3, 3] = np.median(target, axis=0) - np.median(source, axis=0)
    return T

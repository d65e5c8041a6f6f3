"""Geometry of a depth image: voxels in the image, the support plane, the workspace.

>>> frame_geometry(frame, grid).known_free(0.005)         # voxels observed as free
>>> plane = fit_support_plane(frame)                      # if the camera pose is not known
>>> camera = frame.camera.at(plane.T_world_camera)        # z up, table at z = 0
>>> grid = workspace(frame_with_that_camera)              # voxels around the objects on the table
>>> plane_of(frame)                                       # against the pose of the frame

On a plane, disparity D = 8 f b / z (f focal length, b baseline, z depth) is an affine function of the pixel (u, v).
The noise of disparity does not depend on depth, so the support plane is found by a least-squares fit of an affine
function to disparity. Its unit is 1/8 pixel of a Kinect (f = 525 pixels, b = 0.075 m) for every image size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError, check_number
from mstfilter.scene.arrays import read_only
from mstfilter.scene.cache import memo
from mstfilter.scene.camera import Camera
from mstfilter.scene.frame import Frame, depth_sigma
from mstfilter.scene.voxels import VoxelGrid


@dataclass(frozen=True, eq=False)
class FrameGeometry:
    """Projection of the voxel centres of a grid into the image of a frame."""

    #: (X, Y, Z) int32: flat index of the pixel of the centre; -1 outside the image or behind the camera.
    pixel: np.ndarray
    z: np.ndarray  #: (X, Y, Z) float32, z-depth of the centre in metres
    #: (X, Y, Z) float32, `z` minus the measured depth of the pixel: negative in front of the surface, positive
    #: behind; NaN if it is unknown (outside the image, no reading, robot).
    signed: np.ndarray

    def known_free(self, margin: float | np.ndarray) -> np.ndarray:
        """(X, Y, Z) bool: voxel centres more than `margin` metres in front of the measured surface."""
        with np.errstate(invalid="ignore"):
            return self.signed < -np.asarray(margin, dtype=np.float32)


def frame_geometry(frame: Frame, grid: VoxelGrid) -> FrameGeometry:
    """The projection of the voxel centres of a grid into the image of a frame. The result is cached."""
    return memo("frame_geometry", (frame.key, grid.key), lambda: _frame_geometry(frame, grid))


def _frame_geometry(frame: Frame, grid: VoxelGrid) -> FrameGeometry:
    camera = frame.camera
    exact = camera.pose.as_matrix().tobytes()  # the camera's key is rounded
    pixel, z, z64 = memo("voxels in image", (camera.key, exact, grid.key), lambda: _projected(camera, grid))
    inside = pixel >= 0
    measured = np.where(frame.valid, frame.depth, np.nan).ravel()
    signed = np.full(grid.shape, np.nan, np.float32)
    signed[inside] = z64[inside] - measured[pixel[inside]]
    return FrameGeometry(pixel, z, read_only(signed))


def _projected(camera: Camera, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel of every voxel centre in the images of a camera, and its z-depth in single and in double precision."""
    u, v, z, inside = camera.pixels_of(grid.centres())
    pixel = np.where(inside & (z > 1e-6), v * camera.width + u, -1).astype(np.int32)
    return read_only(pixel), read_only(z.astype(np.float32)), read_only(z)


def frame_points(frame: Frame, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices (k,) of the pixels with a reading inside the grid, and the voxels (k, 3) of these readings."""

    def compute() -> tuple[np.ndarray, np.ndarray]:
        index = grid.index_of(frame.points)
        pixels = np.flatnonzero(frame.valid & grid.contains(index))
        return read_only(pixels), read_only(index.reshape(-1, 3)[pixels].astype(np.int32))

    return memo("frame_points", (frame.key, grid.key), compute)


BASELINE = 0.075  # metres between projector and camera of a Kinect v1; sets the unit of disparity
_FOCAL = 525.0  # focal length of a Kinect v1 in pixels; sets the unit of disparity only
#: Readings up to this much above the table are table, in sensor disparity units.
TABLE_TOLERANCE = 2.0


@dataclass(frozen=True, eq=False)
class SupportPlane:
    """The plane on which the objects stand."""

    #: Camera pose in world axes of the plane: the plane is at z = 0, z is its normal; the origin is at the
    #: median of its pixels, y points away from the camera.
    T_world_camera: RigidTransform
    #: (H, W) float32, measured minus plane disparity, in 1/8 pixels; positive is in front of the plane (above it),
    #: NaN is unknown.
    residual: np.ndarray


def disparity(depth: np.ndarray) -> np.ndarray:
    """Disparity (H, W) float64 in 1/8 pixel of a Kinect, from depth in metres. NaN depth gives NaN disparity."""
    return 8.0 * _FOCAL * BASELINE / np.asarray(depth, dtype=np.float64)


_N_TRIALS = 400  # minimal sets of RANSAC
_INLIER = 1.5  # largest residual of an inlier, in 1/8 pixels
_MIN_SHARE = 0.1  # smallest share of inliers among the readings


def fit_support_plane(frame: Frame) -> SupportPlane:
    """Find the plane with the most depth readings, by RANSAC and least squares. The result is cached.

    The pose of the frame is not used. RANSAC uses a constant random seed, so the same frame gives the same plane.
    Raises InputError if there are too few readings or too few inliers.
    """
    return memo("support_plane", frame.key, lambda: _fit(frame))


def _fit(frame: Frame) -> SupportPlane:
    D = disparity(np.where(frame.valid, frame.depth, np.nan))
    v, u = np.nonzero(np.isfinite(D))
    if len(v) < 100:
        raise InputError(
            f"no support plane: the depth image has {len(v)} readings of {D.size} pixels",
            "give a camera pose (T_world_camera), or check the depth image and its scale",
        )
    d = D[v, u]
    design = np.stack([u, v, np.ones(len(u))], axis=1).astype(np.float64)

    rng = np.random.default_rng(20210927)
    subset = rng.choice(len(d), size=min(len(d), 4000), replace=False)
    triples = rng.integers(0, len(subset), size=(_N_TRIALS, 3))
    A = design[subset][triples]
    proper = np.abs(np.linalg.det(A)) > 3e-3 * D.size  # twice the area of the triangle in pixels
    planes = np.linalg.solve(A[proper], d[subset][triples[proper]][..., None])[..., 0]
    if len(planes) == 0:
        raise InputError("no support plane: all readings are on one line of the image")
    counts = (np.abs(design[subset] @ planes.T - d[subset][:, None]) < _INLIER).sum(axis=0)
    plane = planes[counts.argmax()]
    for _ in range(3):
        close = np.abs(design @ plane - d) < _INLIER
        plane = np.linalg.lstsq(design[close], d[close], rcond=None)[0]
    close = np.abs(design @ plane - d) < _INLIER
    share = float(close.mean())
    if share < _MIN_SHARE:
        raise InputError(
            f"no support plane: the best plane has {100 * share:.1f} % of the readings",
            "give a camera pose (T_world_camera) if the table is not visible",
        )
    rows, columns = np.mgrid[: D.shape[0], : D.shape[1]]
    residual = (D - (plane[0] * columns + plane[1] * rows + plane[2])).astype(np.float32)
    pose = _pose(frame.camera, plane, np.stack([u, v], axis=1)[close])
    return SupportPlane(pose, read_only(residual))


def _pose(camera: Camera, plane: np.ndarray, pixels: np.ndarray) -> RigidTransform:
    """Camera pose in world axes with z up and the plane at z = 0. `plane` is (a, b, c) of disparity a u + b v + c."""
    scale = 8.0 * _FOCAL * BASELINE
    # D = p . (u, v, 1) and (u, v, 1) = K X / z  =>  scale = p K X: the plane in camera axes.
    normal = plane @ camera.K
    offset = scale / np.linalg.norm(normal)
    normal = normal / np.linalg.norm(normal)  # p K X > 0 in front: the normal points away from the camera
    up = -normal
    middle = np.linalg.inv(camera.K) @ np.append(np.median(pixels, axis=0), 1.0)
    middle = middle * (offset / (normal @ middle))
    away = np.array([0.0, 0.0, 1.0]) - up * up[2]
    if np.linalg.norm(away) < 1e-6:  # the camera looks straight down: use the top of the image
        away = np.array([0.0, -1.0, 0.0])
    away /= np.linalg.norm(away)
    R = np.stack([np.cross(away, up), away, up])
    matrix = np.eye(4)
    matrix[:3, :3] = R
    matrix[:3, 3] = -R @ middle
    return RigidTransform.from_matrix(matrix)


_NEAR_TABLE = 0.1  # metres from z = 0, where the table of a given pose is searched
_OTHER_PLANE = 30.0  # degrees: a plane that is tilted by more is a wall or the side of a box, not the table
_LEVEL = 2.5  # degrees: tilt of a table in the world of a pose of which only the height differs
_LEAST_SHIFT = 0.01  # metres: a table that is farther from z = 0 is shifted there
ON_TABLE = 0.025  #: metres from z = 0 within which a reading is on the table


@dataclass(frozen=True)
class Plane:
    """A plane that was fitted to a depth image, compared with the pose of the frame."""

    tilt: float  #: degrees between its normal and z of the world
    height: float  #: metres above z = 0 where it is nearest to the camera
    normal: np.ndarray  #: (3,) in camera axes


def plane_of(frame: Frame, chosen: np.ndarray | None = None) -> Plane | None:
    """The largest plane of a frame, or of its `chosen` readings (n,) bool; None if no plane is found."""
    given = frame.camera.pose
    try:
        if chosen is not None:
            valid = np.zeros_like(frame.valid)
            valid[frame.valid] = chosen
            frame = Frame(frame.rgb, np.where(valid, frame.depth, np.nan), frame.camera)
        fitted = fit_support_plane(frame).T_world_camera.inv()
    except InputError:  # too few readings, or most are beyond 30 m
        return None
    normal = fitted.rotation.apply([0.0, 0.0, 1.0])
    tilt = np.degrees(np.arccos(np.clip(given.rotation.apply(normal)[2], -1, 1)))
    return Plane(float(tilt), float((given * fitted).apply(np.zeros(3))[2]), normal)


def table_of(frame: Frame) -> Plane | None:
    """The plane of the table; None if no plane is found near z = 0."""
    near = np.abs(frame.points[frame.valid][:, 2]) < _NEAR_TABLE
    plane = plane_of(frame, near) if near.sum() > 0.03 * near.size else None
    return None if plane is None or plane.tilt > _OTHER_PLANE else plane


def table_height(frame: Frame) -> float:
    """Height (m) of the table in a world in which it is not at z = 0, as in the world of a robot's base; else 0.

    The table is the largest level plane near z = 0 or, if none is there, the largest plane of the image. It is at
    z = 0 if at least half as many readings are there as on the plane.
    """
    frame = sampled(frame, 160)
    plane = table_of(frame) or plane_of(frame)
    if plane is None or plane.tilt > _LEVEL or abs(plane.height) < _LEAST_SHIFT:
        return 0.0
    heights, reach = frame.points[frame.valid][:, 2], min(abs(plane.height) / 2, ON_TABLE)
    there, here = ((np.abs(heights - z) < reach).sum() for z in (plane.height, 0.0))
    return plane.height if here < there / 2 else 0.0


def sampled(frame: Frame, width: int) -> Frame:
    """The frame reduced to every k-th pixel, with about `width` columns."""
    step = max(1, round(frame.camera.width / width))
    part = slice(step // 2, None, step)
    rgb, depth = frame.rgb[part, part], frame.depth[part, part]
    K = frame.camera.K.copy()
    K[:2, 2] -= step // 2
    K[:2] /= step
    mask = None if frame.robot_mask is None else frame.robot_mask[part, part]
    return Frame(rgb, depth, Camera(K, depth.shape[1], depth.shape[0], frame.camera.T_world_camera), mask)


def table_residual(frame: Frame) -> np.ndarray:
    """Measured disparity minus the disparity of the table, (H, W) float32 in 1/8 pixels. The result is cached.

    The table is the plane z = 0 of the world. Positive values mean readings above the table. Pixels without a reading
    have the value NaN. Readings on rays that do not meet the table have the value +inf.
    """

    def compute() -> np.ndarray:
        camera = frame.camera
        direction = camera.rays() @ camera.pose.as_matrix()[2, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -camera.position[2] / direction
            table = np.where((direction < 0) & (depth > 0), disparity(depth), -np.inf)
        residual = disparity(np.where(frame.valid, frame.depth, np.nan)) - table
        return read_only(residual.astype(np.float32))

    return memo("table_residual", frame.key, compute)


def in_columns(grid: VoxelGrid, points: np.ndarray) -> np.ndarray:
    """(...) bool: whether x and y of points (..., 3) are inside the grid."""
    index = grid.index_of(points)[..., :2]
    return np.asarray(((index >= 0) & (index < np.array(grid.shape[:2]))).all(axis=-1))


_MIN_HEIGHT = 0.01  # metres above the table beyond which a reading may show an object

_CELL, _STRIP = 0.1, 0.02  # metres: gap between a table and another surface; standard deviation across a strip
_FAR = 10.0  # metres from the camera, beyond which no table is expected
_BORDER = 0.03  # metres: a wall may stand at the border of the visible table
_MARGIN = 0.05  # metres of the workspace around the visible table
_LEAST_SIDE, _LARGEST_SIDE, _HEIGHT = 1.0, 2.0, 0.5  # metres


def workspace(frame: Frame, voxel_size: float = 0.01) -> VoxelGrid:
    """A grid with voxels of `voxel_size` metres around the visible part of the table. The table is at z = 0.

    The grid is .5 m high and 1 to 2 m long and wide. The grid covers as much of the table as possible. If the
    table is shorter or longer than the grid along an axis, the grid is shifted towards the depth readings that are
    more than 1 cm above the table. Readings outside the visible table, for example on a wall, are ignored.
    """
    check_number("voxel size", voxel_size, above=0, at_most=0.5, unit="number of metres")
    points = frame.points[frame.valid]
    table = _without_strips(points[np.abs(points[:, 2]) < _MIN_HEIGHT, :2], frame.camera.position[:2])
    raised = points[(points[:, 2] > _MIN_HEIGHT) & (points[:, 2] < _HEIGHT), :2]
    if len(table):
        low, high = np.percentile(table, (1, 99), axis=0)
        raised = raised[((raised > low + _BORDER) & (raised < high - _BORDER)).all(axis=1)]
    elif len(raised):
        low, high = np.percentile(raised, (2, 98), axis=0)
    chosen = raised if len(raised) >= 200 else table
    if len(chosen) == 0:
        raise InputError(
            "no workspace: no depth reading is on or above the table",
            "check the pose (z is up, the table is at z = 0) and the depth scale",
            "or give the grid: VoxelGrid(origin, voxel_size, shape)",
        )
    side = np.clip(np.ceil((high - low + 2 * _MARGIN) * 10) / 10, _LEAST_SIDE, _LARGEST_SIDE)
    reach = np.sort([low - _MARGIN + side / 2, high + _MARGIN - side / 2], axis=0)  # of the centre
    centre = np.clip(np.percentile(chosen, (2, 98), axis=0).mean(axis=0), *reach)
    origin = np.append(np.round((centre - side / 2) / voxel_size) * voxel_size, 0.0)
    return VoxelGrid(origin, voxel_size, (*map(round, side / voxel_size), round(_HEIGHT / voxel_size)))


def _without_strips(points: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Table readings (N, 2) without those of a wall behind the table, which form a thin separate strip at z = 0.

    `camera` (2,) is the position of the camera in the plane of the table.
    """
    from scipy import ndimage

    near = points[np.linalg.norm(points - camera, axis=1) < _FAR]
    if not len(near):
        return points
    cell = np.floor((near - near.min(axis=0)) / _CELL).astype(np.int64)
    occupied = np.zeros(cell.max(axis=0) + 1, bool)
    occupied[tuple(cell.T)] = True
    group = ndimage.label(occupied, np.ones((3, 3)))[0][tuple(cell.T)] - 1
    n = np.bincount(group)
    mean = np.stack([np.bincount(group, axis) / n for axis in near.T], axis=1)
    x, y = (near - mean[group]).T
    xx, yy, xy = (np.bincount(group, product) / n for product in (x * x, y * y, x * y))
    across = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)  # the smaller eigenvalue of the covariance
    noise = 2 * depth_sigma(np.linalg.norm(mean - camera, axis=1))
    keep = (n >= 3) & (across > np.maximum(_STRIP, noise) ** 2)
    keep[n.argmax()] = True
    return near[keep[group]]

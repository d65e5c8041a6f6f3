"""Planes in a depth image: the table on which the objects stand, the floor, walls.

>>> plane = fit_support_plane(frame)                      # if the camera pose is not known
>>> camera = frame.camera.at(plane.T_world_camera)        # z up, table at z = 0
>>> table_residual(frame_with_that_camera)                # (H, W) readings above the table, in sensor units
>>> walls(frame_with_that_camera)                         # (H, W) pixels of walls
>>> plane_of(frame)                                       # the largest plane, against the pose of the frame

On a plane, disparity D = 8 f b / z (f focal length, b baseline, z depth) is an affine function of the pixel (u, v).
The noise of disparity does not depend on depth, so a plane is found by a least-squares fit of an affine function to
disparity. Its unit is 1/8 pixel of a Kinect (f = 525 pixels, b = 0.075 m) for every image size.

The table is the plane with the most readings, unless this plane is a wall or the floor. Both lie behind the table,
so the table is searched among the readings in front of them. A plane at a right angle to the largest one is the table
if its normal points up in the image and the normal of the largest plane does not. A parallel plane is the table if it
is higher than objects are, and if something stands on it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError
from mstfilter.scene.arrays import read_only
from mstfilter.scene.cache import memo
from mstfilter.scene.camera import Camera
from mstfilter.scene.frame import Frame, depth_sigma

BASELINE = 0.075  # metres between projector and camera of a Kinect v1; sets the unit of disparity
_FOCAL = 525.0  # focal length of a Kinect v1 in pixels; sets the unit of disparity only
_SCALE = 8.0 * _FOCAL * BASELINE
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
    return _SCALE / np.asarray(depth, dtype=np.float64)


_N_TRIALS = 400  # minimal sets of RANSAC
_INLIER = 1.5  # largest residual of an inlier, in 1/8 pixels
_MIN_SHARE = 0.1  # smallest share of inliers among the readings


def fit_support_plane(frame: Frame) -> SupportPlane:
    """Find the table: the plane with the most readings or, if that is a wall or the floor, one in front of it.

    The pose of the frame is not used. RANSAC uses a constant random seed, so the same frame gives the same plane. The
    result is cached. Raises InputError if there are too few readings or too few inliers.
    """
    return memo("support_plane", frame.key, lambda: _supporting(frame, _table(frame)))


def _supporting(frame: Frame, plane: np.ndarray) -> SupportPlane:
    D, (rows, columns) = _disparity_of(frame), np.mgrid[: frame.camera.height, : frame.camera.width]
    residual = D - (plane[0] * columns + plane[1] * rows + plane[2])
    with np.errstate(invalid="ignore"):
        close = np.abs(residual) < _INLIER
    pose = _pose(frame.camera, plane, np.stack([columns[close], rows[close]], axis=1))
    return SupportPlane(pose, read_only(residual.astype(np.float32)))


def _disparity_of(frame: Frame) -> np.ndarray:
    return disparity(np.where(frame.valid, frame.depth, np.nan))


def _largest(frame: Frame) -> np.ndarray:
    """Coefficients (a, b, c) of the plane D = a u + b v + c with the most readings. The result is cached."""
    return memo("largest_plane", frame.key, lambda: read_only(_fit_largest(frame)))


def _fit_largest(frame: Frame) -> np.ndarray:
    """The largest plane by RANSAC and least squares."""
    D = _disparity_of(frame)
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
    plane = _refined(planes[counts.argmax()], design, d, _INLIER)
    share = float((np.abs(design @ plane - d) < _INLIER).mean())
    if share < _MIN_SHARE:
        raise InputError(
            f"no support plane: the best plane has {100 * share:.1f} % of the readings",
            "give a camera pose (T_world_camera) if the table is not visible",
        )
    return plane


def _refined(plane: np.ndarray, design: np.ndarray, d: np.ndarray, inlier: float) -> np.ndarray:
    """The least-squares plane (3,) of the readings `d` (n,) that are near a plane."""
    for _ in range(3):
        close = np.abs(design @ plane - d) < inlier
        plane = np.linalg.lstsq(design[close], d[close], rcond=None)[0]
    return plane


# The planes beside the largest one are searched in an image of about 160 columns.
_COLUMNS = 160
_WINDOWS = (20, 10)  # pixels: sides of the windows that suggest planes
_FLAT = 3.0  # largest residual of an inlier, in 1/8 pixels
_MOST = 5  # planes
_LEAST_TABLE = 0.05  # share of the readings that are on a table with fewer than the largest plane
_IN_FRONT = 0.025  # metres: readings farther in front of a plane are not on it
_TALL = 0.35  # metres: objects are not higher; the table is higher above the floor, and extends farther from a wall
_PARALLEL, _RIGHT = 15.0, 60.0  # degrees between the normals of parallel planes, and of planes at a right angle
_MORE_UPRIGHT = 0.4  # difference of the upward parts of the normals of a table and of a wall, in the image
_ON_TABLE = 0.01  # metres
_LEAST_PART = 0.1  # share of the largest part of a table in a separate part
_FEW_ON_TABLE = 100  # readings of the table in the reduced image
_BESIDE_TABLE = 0.1  # metres beyond the readings of the table, where an object can still stand
_AT_WALL = 0.01  # metres
_UPRIGHT = 75.0  # degrees between the normals of a wall and of the table
_LEAST_WALL = 0.02  # share of the readings
_FEW_BEHIND = 0.02  # share of the readings of the table behind a wall
_AT_RIM = 0.5  # pixels of a wall at the end of the image, relative to the root of its area
_STANDING = 0.01  # share of the readings that are things on the table


@dataclass(frozen=True, eq=False)
class _Found:
    """A plane in camera axes: ``q @ X`` is 8 f b at its points X, so ``q @ (x, y, 1)`` is the disparity of a ray."""

    q: np.ndarray  #: (3,)
    inliers: np.ndarray  #: (n,) bool, the readings on the plane

    @property
    def up(self) -> np.ndarray:
        """The unit normal (3,) towards the camera, in camera axes."""
        return np.asarray(-self.q / np.linalg.norm(self.q))

    def above(self, points: np.ndarray) -> np.ndarray:
        """Heights (n,) in metres of points (n, 3) in camera axes above the plane."""
        return np.asarray((_SCALE - points @ self.q) / np.linalg.norm(self.q))


def _planes(rays: np.ndarray, D: np.ndarray, used: np.ndarray) -> Iterator[_Found]:
    """The planes of the `used` (h, w) bool pixels of a disparity image (h, w), the largest first.

    `rays` (h, w, 3) are directions in camera axes with z = 1. Least-squares planes of windows of the image are
    compared by the number of pixels near them. The inliers of a plane are not used for the next one.
    """
    q = _of_windows(rays, np.where(used, D, 0.0), used)
    rays, D = rays[used], D[used]
    free = np.ones(len(D), bool)
    for _ in range(_MOST):
        if len(q) == 0 or free.sum() < _MIN_SHARE * len(D):
            return
        some = np.flatnonzero(free)[:: max(1, int(free.sum()) // 2000)]
        counts = (np.abs(rays[some] @ q.T - D[some, None]) < _FLAT).sum(axis=0)
        best = _refined(q[counts.argmax()], rays[free], D[free], _FLAT)
        inliers = free & (np.abs(rays @ best - D) < _FLAT)
        yield _Found(best, inliers)
        free &= ~inliers
        q = np.delete(q, counts.argmax(), axis=0)


def _of_windows(rays: np.ndarray, D: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Least-squares planes (m, 3) of the flat windows of a disparity image (h, w)."""
    columns = np.concatenate([rays, D[..., None]], axis=-1) * used[..., None]
    products = columns[..., :, None] * columns[..., None, :]  # of x, y, 1, D
    found = []
    for side in _WINDOWS:
        half = side // 2
        h, w = (n // half for n in used.shape)
        if min(h, w) < 2:
            continue
        sums = products[: h * half, : w * half].reshape(h, half, w, half, 4, 4).sum(axis=(1, 3))
        sums = (sums[:-1, :-1] + sums[1:, :-1] + sums[:-1, 1:] + sums[1:, 1:]).reshape(-1, 4, 4)
        sums = sums[sums[:, 2, 2] > side * side / 2]
        q = np.linalg.solve(sums[:, :3, :3] + 1e-9 * np.eye(3), sums[:, :3, 3:])[..., 0]
        squares = sums[:, 3, 3] - (q * sums[:, :3, 3]).sum(axis=1)
        found.append(q[squares < _FLAT**2 * sums[:, 2, 2]])
    return np.concatenate(found) if found else np.zeros((0, 3))


def _table(frame: Frame) -> np.ndarray:
    """Coefficients (a, b, c) of the plane of the table: see the module."""
    plane = _largest(frame)
    small = sampled(frame, _COLUMNS)
    D, rays = _disparity_of(small), small.camera.rays()
    points = (rays * small.depth[..., None])[small.valid]
    first = current = _Found(plane @ frame.camera.K, np.zeros(len(points), bool))
    for _ in range(2):  # from a wall to the floor, from the floor to the table
        in_front = current.above(points) > _IN_FRONT
        used = small.valid.copy()
        used[small.valid] = in_front
        if in_front.mean() < _LEAST_TABLE:
            break
        for found in _planes(rays, D, used):
            inliers = in_front.copy()
            inliers[in_front] = found.inliers
            if _holds(other := _Found(found.q, inliers), current, points):
                current = other
                break
    if current is first:
        return plane
    v, u = np.nonzero(frame.valid)
    design = np.stack([u, v, np.ones(len(u))], axis=1).astype(np.float64)
    d = _disparity_of(frame)[v, u]
    near = _refined(current.q @ np.linalg.inv(frame.camera.K), design, d, _FLAT)
    return _refined(near, design, d, _INLIER)


def _holds(plane: _Found, largest: _Found, points: np.ndarray) -> bool:
    """Whether a plane in front of the `largest` one is the table. `points` (n, 3) are the readings in camera axes."""
    angle = np.degrees(np.arccos(np.clip(plane.up @ largest.up, -1, 1)))
    own = points[plane.inliers]
    away = largest.above(own)
    if _RIGHT < angle < 180 - _RIGHT:
        more_upright = largest.up[1] - plane.up[1] > _MORE_UPRIGHT
        return bool(more_upright and np.percentile(away, 98) > _TALL and plane.inliers.mean() > _LEAST_TABLE)
    if angle > _PARALLEL or np.median(away) < _TALL or plane.inliers.mean() < _LEAST_TABLE:
        return False
    return bool(_standing(plane, points) > _STANDING)


def _standing(plane: _Found, points: np.ndarray) -> float:
    """Share of the readings `points` (n, 3) that are things of up to `_TALL` metres on a plane."""
    height = plane.above(points)
    across = np.linalg.svd(plane.up[None])[2][1:]  # two directions in the plane
    low, high = np.percentile(points[plane.inliers] @ across.T, (2, 98), axis=0)
    over = ((points @ across.T > low) & (points @ across.T < high)).all(axis=1)
    return float((over & (height > _IN_FRONT / 2) & (height < _TALL)).mean())


def beyond_table(frame: Frame) -> np.ndarray:
    """Pixels (H, W) bool with readings of walls, or of other things that do not stand on the table at z = 0.

    A wall is an upright plane that bounds the table, and either is higher than objects are or extends beyond the
    image. Things beside the table are outside the convex hull of the readings of the table. The result is cached.
    """
    return memo("beyond_table", frame.key, lambda: read_only(_beyond(frame)))


def _beyond(frame: Frame) -> np.ndarray:
    small = sampled(frame, _COLUMNS)
    points = small.points[small.valid]
    table = without_strips(points[np.abs(points[:, 2]) < _ON_TABLE, :2], small.camera.position[:2], _LEAST_PART)
    if len(table) < _FEW_ON_TABLE:
        return np.zeros(frame.valid.shape, bool)
    found = np.zeros(frame.valid.shape, bool)
    with np.errstate(invalid="ignore"):
        found[frame.valid] = _outside(frame.points[frame.valid], table)
        for plane in _walls(small, table):
            rays = frame.camera.rays()
            distance = (_SCALE - frame.depth * (rays @ plane.q)) / np.linalg.norm(plane.q)
            found |= frame.valid & (distance < _AT_WALL + 2 * depth_sigma(frame.depth))
    return found


def _outside(points: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Whether points (n, 3) are outside the convex hull of readings (m, 2) of the table, by more than a margin."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        normal, offset = np.split(ConvexHull(table).equations, [2], axis=1)
    except QhullError:
        return np.zeros(len(points), bool)
    return np.asarray((points[:, :2] @ normal.T + offset[:, 0] > _BESIDE_TABLE).any(axis=1))


def _walls(frame: Frame, table: np.ndarray) -> Iterator[_Found]:
    """The walls of a small image. `table` (m, 2) are the readings of the table in world axes."""
    height, up = frame.points[..., 2], frame.camera.pose.rotation.inv().apply([0.0, 0.0, 1.0])
    with np.errstate(invalid="ignore"):
        raised = frame.valid & (height > _IN_FRONT)
    if raised.sum() < _LEAST_WALL * frame.valid.sum():
        return
    rim = ~_inner(frame.valid)[raised]
    ground = frame.camera.pose.inv().apply(np.column_stack([table, np.zeros(len(table))]))
    for plane in _planes(frame.camera.rays(), _disparity_of(frame), raised):
        own = height[raised][plane.inliers]
        area = int(plane.inliers.sum())
        upright = abs(plane.up @ up) < np.cos(np.radians(_UPRIGHT)) and area > _LEAST_WALL * frame.valid.sum()
        if upright and (plane.above(ground) < -_AT_WALL).mean() < _FEW_BEHIND:
            at_rim = int((rim & plane.inliers).sum())
            if np.percentile(own, 98) > _TALL or at_rim > _AT_RIM * np.sqrt(area):
                yield plane


def _inner(valid: np.ndarray) -> np.ndarray:
    """Pixels (h, w) bool that are not at the left, right or upper end of the readings of an image."""
    inner = valid.copy()
    columns, rows = np.flatnonzero(valid.any(axis=0)), np.flatnonzero(valid.any(axis=1))
    inner[: rows[0] + 3] = inner[:, : columns[0] + 3] = inner[:, columns[-1] - 2 :] = False
    return inner


def _pose(camera: Camera, plane: np.ndarray, pixels: np.ndarray) -> RigidTransform:
    """Camera pose in world axes with z up and the plane at z = 0. `plane` is (a, b, c) of disparity a u + b v + c."""
    # D = p . (u, v, 1) and (u, v, 1) = K X / z  =>  8 f b = p K X: the plane in camera axes.
    normal = plane @ camera.K
    offset = _SCALE / np.linalg.norm(normal)
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
    """The table of a frame, or the largest plane of its `chosen` readings (n,) bool; None if no plane is found."""
    given = frame.camera.pose
    try:
        if chosen is not None:
            valid = np.zeros_like(frame.valid)
            valid[frame.valid] = chosen
            chosen_frame = Frame(frame.rgb, np.where(valid, frame.depth, np.nan), frame.camera)
            fitted = _supporting(chosen_frame, _largest(chosen_frame)).T_world_camera.inv()
        else:
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


_CELL, _STRIP = 0.1, 0.02  # metres: gap between a table and another surface; standard deviation across a strip
_FAR = 10.0  # metres from the camera, beyond which no table is expected


def without_strips(points: np.ndarray, camera: np.ndarray, least: float = 0.0) -> np.ndarray:
    """Table readings (N, 2) without those of a wall behind the table, which form a thin separate strip at z = 0.

    `camera` (2,) is the position of the camera in the plane of the table. Separate parts with less than the share
    `least` of the readings of the largest part are left out too: they are of a chair, for example.
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
    keep = (n >= max(3, least * n.max())) & (across > np.maximum(_STRIP, noise) ** 2)
    keep[n.argmax()] = True
    return near[keep[group]]

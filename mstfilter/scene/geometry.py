"""Geometry of a depth image: voxels in the image, the support plane, the workspace, edges of depth and colour.

>>> frame_geometry(frame, grid).known_free(0.005)         # voxels observed as free
>>> plane = fit_support_plane(frame)                      # if the camera pose is not known
>>> camera = frame.camera.at(plane.T_world_camera)        # z up, table at z = 0
>>> grid = workspace(frame_with_that_camera)              # voxels around the objects on the table
>>> edge_agreement([Edges(frame)])                        # whether depth is registered to colour

On a plane, disparity D = 8 f b / z (f focal length, b baseline, z depth) is an affine function of the pixel (u, v).
The noise of disparity does not depend on depth, so the support plane is found by a least-squares fit of an affine
function to disparity. Its unit is 1/8 pixel of a Kinect (f = 525 pixels, b = 0.075 m) for every image size.
"""

from __future__ import annotations

from collections.abc import Sequence
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


def shares_with_depth(frame: Frame, grid: VoxelGrid) -> tuple[float, float]:
    """Share of the pixels with a depth reading: of the image, and of the part that shows the table of the workspace.

    Pixels of the robot are not counted.
    """
    camera, known = frame.camera, np.isfinite(frame.depth)
    down = camera.rays() @ camera.pose.as_matrix()[2, :3]
    with np.errstate(divide="ignore"):
        table = camera.unproject(np.where(down < 0, -camera.position[2] / down, np.nan))
    image = np.ones_like(known) if frame.robot_mask is None else ~frame.robot_mask
    shown = image & in_columns(grid, table)
    return float(known[image].mean()), float(known[shown].mean()) if shown.any() else 1.0


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


_SHIFTS = 16  # pixels of an image of 320 columns
_MIN_EDGES = 120  # pixels of depth edges; fewer are taken for noise
_BOX = np.ones((3, 3), np.uint8)


class Edges:
    """Image of depth edges (H, W) float32, 0 or 1, and ranks (H, W) of the colour gradients of all pixels, 0 to 1."""

    def __init__(self, frame: Frame) -> None:
        import cv2

        depth = np.where(frame.valid, frame.depth, np.nan)
        near, far = cv2.erode(np.nan_to_num(depth, nan=9.0), _BOX), cv2.dilate(np.nan_to_num(depth, nan=0.0), _BOX)
        known = cv2.erode(frame.valid.astype(np.uint8), _BOX) > 0
        self.depth = (known & (far - near > 0.03 + 0.02 * near)).astype(np.float32)
        margin = np.zeros_like(self.depth)
        inner = slice(_SHIFTS, -_SHIFTS)
        margin[inner, inner] = self.depth[inner, inner]
        self.depth = margin
        self.rgb = frame.rgb
        self.rank = _gradient_ranks(cv2.GaussianBlur(frame.rgb, (3, 3), 0).astype(np.float32))

    def smoothed_rank(self, sigma: float) -> np.ndarray:
        """(H, W): ranks of the gradients of the colour image, smoothed by `sigma` pixels; 0 gives `rank`."""
        import cv2

        return _gradient_ranks(cv2.GaussianBlur(self.rgb.astype(np.float32), (0, 0), sigma)) if sigma else self.rank

    def under(self, rank: np.ndarray) -> np.ndarray:
        """(33, 33): sum of colour ranks (H, W) at the depth edges, for each shift of -16 to 16 pixels."""
        import cv2

        inner = slice(_SHIFTS, -_SHIFTS)
        return np.asarray(cv2.matchTemplate(rank, self.depth[inner, inner], cv2.TM_CCORR))


def _gradient_ranks(rgb: np.ndarray) -> np.ndarray:
    """Ranks (H, W) float32 of the gradients of a colour image (H, W, 3), 0 to 1."""
    across, down = np.abs(np.diff(rgb, axis=1, append=rgb[:, -1:])), np.abs(np.diff(rgb, axis=0, append=rgb[-1:]))
    gradient = np.maximum(across, down).max(axis=2)
    levels = np.sort(gradient, axis=None)
    return (np.searchsorted(levels, gradient) / gradient.size).astype(np.float32)


def edge_agreement(edges: Sequence[Edges], sigma: float = 0.0) -> tuple[float, float, tuple[int, int], float]:
    """Agreement of depth edges and colour edges at all pauses, for different shifts of the colour images.

    The first two values are the best agreement minus the median over all shifts, and its relative loss without a
    shift. The third is the best shift (rows, columns) in pixels of an image with 320 columns. The fourth is the
    increase of the agreement if the depth images of different pauses are exchanged. If `sigma` is not 0, the colour
    images are smoothed with this standard deviation in pixels, so that finer texture has no effect.
    """
    edges = [edge for edge in edges if min(edge.depth.shape) >= 4 * _SHIFTS]
    count = sum(float(edge.depth.sum()) for edge in edges)
    if count < _MIN_EDGES:
        return 0.0, 0.0, (0, 0), 0.0

    def agreement(order: Sequence[int]) -> np.ndarray:
        return np.sum([edges[i].under(ranks[j]) for i, j in enumerate(order)], axis=0) / count

    def unshifted(scores: np.ndarray) -> float:
        return float(scores[_SHIFTS - 1 : _SHIFTS + 2, _SHIFTS - 1 : _SHIFTS + 2].max())

    ranks = [edge.smoothed_rank(sigma) for edge in edges]
    n, scores = len(edges), agreement(range(len(edges)))
    row, column = np.unravel_index(scores.argmax(), scores.shape)
    base, top = float(np.median(scores)), float(scores.max())
    lost = (top - unshifted(scores)) / max(top - base, 1e-9)
    orders = [range(n - 1, -1, -1), [*range(1, n), 0], [n - 1, *range(n - 1)]] if n > 1 else []
    best = max((unshifted(agreement(order)) for order in orders), default=0.0)
    top = max(top, best)
    return top - base, lost, (int(row) - _SHIFTS, int(column) - _SHIFTS), best - unshifted(scores)

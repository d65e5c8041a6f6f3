"""Pinhole cameras.

>>> import numpy as np
>>> from mstfilter.scene import Camera
>>> camera = Camera(np.array([[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1.0]]), 640, 480)
>>> camera.project(np.array([0.0, 0.0, 1.0]))[0]
array([319.5, 239.5])

Camera axes follow OpenCV: x points right, y down, and z forward. A pixel is (u, v) = (column, row). The centre of the
first pixel is (0, 0). Without a pose (`T_world_camera=None`), the world axes are the camera axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError
from mstfilter.scene.arrays import content_key, frozen, read_only


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion.

    Parameters
    ----------
    K : (3, 3) array, or four numbers
        Intrinsics in pixels: ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``, or fx, fy, cx, cy. The field is the matrix.
    width, height : int
        Image size in pixels.
    T_world_camera : scipy RigidTransform, optional
        Pose that maps camera axes to world axes, in metres.
    """

    K: np.ndarray
    width: int
    height: int
    T_world_camera: RigidTransform | None = None

    def __repr__(self) -> str:
        at = "without a pose" if self.T_world_camera is None else f"at {np.round(self.position, 3).tolist()} m"
        return f"Camera {self.width} x {self.height}, focal length {self.K[0, 0]:.4g} pixels, {at}"

    def __post_init__(self) -> None:
        try:
            K = np.asarray(self.K, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"camera matrix K is not numeric: {self.K!r}") from error
        if K.shape == (4,):
            fx, fy, cx, cy = K
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise InputError(f"camera matrix K is {K.tolist()}, expected 3 x 3 finite numbers, or fx, fy, cx, cy")
        if K[0, 0] <= 0 or K[1, 1] <= 0 or abs(np.linalg.det(K)) < 1e-9:
            raise InputError(
                f"camera matrix K is not invertible: {K.tolist()}",
                "K is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0 in pixels",
            )
        if not np.allclose(K[2], (0, 0, 1)) or K[1, 0] != 0:
            raise InputError(
                f"camera matrix K is not upper triangular with last row 0 0 1: {K.tolist()}",
                "some tools store K transposed or row by row",
            )
        if int(self.width) < 1 or int(self.height) < 1:
            raise InputError(f"camera image size is {self.width} x {self.height}, expected at least 1 x 1")
        if self.T_world_camera is not None:
            if not isinstance(self.T_world_camera, RigidTransform):
                raise InputError(
                    f"T_world_camera is a {type(self.T_world_camera).__name__}, expected a scipy RigidTransform",
                    "convert a 4x4 matrix with mstfilter.scene.rigid_from_matrix",
                )
            if not np.isfinite(self.T_world_camera.as_matrix()).all():
                raise InputError("camera pose T_world_camera has a value that is not finite")
        object.__setattr__(self, "K", frozen(K))
        object.__setattr__(self, "width", int(self.width))
        object.__setattr__(self, "height", int(self.height))

    @classmethod
    def from_intrinsics(
        cls,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        width: int,
        height: int,
        T_world_camera: RigidTransform | None = None,
    ) -> Camera:
        """A camera from focal lengths and principal point in pixels."""
        return cls(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), width, height, T_world_camera)

    @cached_property
    def key(self) -> bytes:
        """Content key."""
        # To a nanometre: reading a pose from a file orthogonalises it again, which changes the last bits.
        pose = b"" if self.T_world_camera is None else np.round(self.T_world_camera.as_matrix(), 9) + 0.0
        return content_key("camera", self.K, self.width, self.height, pose)

    @cached_property
    def pose(self) -> RigidTransform:
        """`T_world_camera`, or the identity for a camera without a pose."""
        return RigidTransform.identity() if self.T_world_camera is None else self.T_world_camera

    @property
    def position(self) -> np.ndarray:
        """Centre of projection in world axes, (3,) metres."""
        return self.pose.translation

    @cached_property
    def _ray_grid(self) -> np.ndarray:
        v, u = np.mgrid[: self.height, : self.width].astype(np.float64)
        y = (v - self.K[1, 2]) / self.K[1, 1]
        x = (u - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
        return read_only(np.stack([x, y, np.ones_like(x)], axis=-1))

    def rays(self) -> np.ndarray:
        """(H, W, 3) directions through the pixel centres in camera axes, scaled to z = 1."""
        return self._ray_grid

    def unproject(self, depth: np.ndarray) -> np.ndarray:
        """World points (H, W, 3) in metres from a z-depth image (H, W) in metres; NaN where depth is NaN."""
        if depth.shape != (self.height, self.width):
            raise InputError(
                f"depth image is {depth.shape[1]} x {depth.shape[0]}, the camera is {self.width} x {self.height}"
            )
        matrix = self.pose.as_matrix()
        directions = self.rays() @ matrix[:3, :3].T
        return directions * depth[..., None].astype(np.float64) + matrix[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points (..., 3) in metres into the image.

        Returns
        -------
        uv : (..., 2) array
            Pixels (column, row), with NaN for points that are not in front of the camera.
        z : (...) array
            z-depth in metres.
        """
        matrix = self.pose.as_matrix()
        local = (np.asarray(points, dtype=np.float64) - matrix[:3, 3]) @ matrix[:3, :3]
        z = local[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = np.where(z > 1e-9, 1.0 / z, np.nan)
        y = local[..., 1] * inverse
        x = local[..., 0] * inverse
        u = self.K[0, 0] * x + self.K[0, 1] * y + self.K[0, 2]
        v = self.K[1, 1] * y + self.K[1, 2]
        return np.stack([u, v], axis=-1), z

    def pixels_of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Column, row and z-depth (...) of world points (..., 3), and whether each point projects into the image.

        Column and row are int64. Points that project outside the image have column 0 and row 0.
        """
        uv, z = self.project(points)
        u, v = np.moveaxis(np.rint(np.where(np.isfinite(uv), uv, -1.0)), -1, 0)
        inside: np.ndarray = (u >= 0) & (v >= 0) & (u < self.width) & (v < self.height)
        return np.where(inside, u, 0).astype(np.int64), np.where(inside, v, 0).astype(np.int64), z, inside

    def scaled(self, factor: float) -> Camera:
        """The camera for images resized by `factor`. The corner (-0.5, -0.5) of the first pixel does not move."""
        width, height = round(self.width * factor), round(self.height * factor)
        factors = np.array([width / self.width, height / self.height])  # of the rounded size
        K = self.K.copy()
        K[:2, :2] *= factors[:, None]
        K[:2, 2] = (self.K[:2, 2] + 0.5) * factors - 0.5
        return Camera(K, width, height, self.T_world_camera)

    def limited(self, max_pixels: int) -> Camera:
        """The camera of the image reduced to about `max_pixels` pixels, if it has more. 0 means no limit."""
        n = self.width * self.height
        return self.scaled(math.sqrt(max_pixels / n)) if 0 < max_pixels < n else self

    def at(self, T_world_camera: RigidTransform) -> Camera:
        """The same camera at another pose."""
        return replace(self, T_world_camera=T_world_camera)


#: Images of videos and streams are reduced to this number of pixels, which is above 848 x 480. A voxel of 1 cm still
#: has several pixels.
WORKING_PIXELS = 410_000
_WIDTH, _HEIGHT = 640, 480  # pixels: the image size in which numbers of pixels are given


def scaled_length(pixels: float, width: int) -> float:
    """Scale a length in pixels from an image of 640 columns to an image of `width` columns."""
    return pixels * width / _WIDTH


def scaled_area(pixels: float, n_pixels: int) -> float:
    """Scale an area in pixels from an image of 640 x 480 pixels to an image of `n_pixels` pixels."""
    return pixels * n_pixels / (_WIDTH * _HEIGHT)


def look_at(position: np.ndarray, target: np.ndarray, up: tuple[float, float, float] = (0, 0, 1)) -> RigidTransform:
    """Pose `T_world_camera` of a camera at `position` (m) that looks at `target` (m), with `up` at the image top.

    If the camera looks along `up`, the y axis of the world is at the image top.
    """
    position = np.asarray(position, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - position
    if not np.linalg.norm(forward) > 0:
        raise InputError(f"camera and target are both at {position.tolist()}", "give two different points")
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9 * np.linalg.norm(up):
        right = np.cross(forward, (0, 1, 0))
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    matrix[:3, 3] = position
    return RigidTransform.from_matrix(matrix)


def rigid_from_matrix(matrix: np.ndarray, where: str = "pose") -> RigidTransform:
    """A RigidTransform from a 4x4 matrix.

    Raises InputError if the matrix has scale or shear, because scipy would orthogonalise the matrix without an error.
    """
    try:
        matrix = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} is not numeric") from error
    if matrix.shape != (4, 4):
        raise InputError(f"{where} has shape {matrix.shape}, expected (4, 4)")
    if not np.isfinite(matrix).all():
        raise InputError(
            f"{where} has a value that is not finite (NaN or inf)",
            "leave the pose out to find it from the support plane",
        )
    R = matrix[:3, :3]
    away = np.abs(R @ R.T - np.eye(3)).max()
    if away > 1e-3 or np.linalg.det(R) < 0 or not np.allclose(matrix[3], (0, 0, 0, 1)):
        left_handed = bool(np.linalg.det(R) < 0)
        raise InputError(
            f"{where} is not a rigid transform{', its axes are left-handed' * left_handed}: {matrix.tolist()}",
            "expected a 4x4 matrix with a rotation R in its upper left and last row 0 0 0 1",
            f"R R^T differs from 1 by {away:.1g}, at most 0.001 is allowed: are its numbers rounded?",
        )
    return RigidTransform.from_matrix(matrix)

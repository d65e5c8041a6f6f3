"""One RGB-D image.

>>> frame = Frame(rgb, depth, camera)          # rgb (H, W, 3) uint8, depth (H, W) metres, NaN = no reading
>>> frame.points                               # (H, W, 3) world points in metres

Where several cameras look at the scene, one of them is segmented and tracked; what the others saw at the same instant
comes along as `views`, and free space is known from all:

>>> frame = Frame(rgb, depth, camera, views=(Frame(rgb_2, depth_2, camera_2),))
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene.arrays import content_key, frozen, read_only
from mstfilter.scene.camera import Camera

__all__ = ["Frame"]


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB-D image with its camera.

    Parameters
    ----------
    rgb : (H, W, 3) uint8
        Colour image.
    depth : (H, W) float
        z-depth in metres; NaN (or anything not positive and finite) where the sensor gave no reading.
    camera : Camera
        Intrinsics and pose.
    robot_mask : (H, W) bool, optional
        Pixels that show the robot. They are unknown: never background, never free space.
    views : tuple of Frame
        What further cameras saw at the same instant; all cameras need a pose in the same world. They have no views
        themselves.
    """

    rgb: np.ndarray
    depth: np.ndarray
    camera: Camera
    robot_mask: np.ndarray | None = None
    views: tuple[Frame, ...] = ()

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width)
        rgb, depth = np.asarray(self.rgb), np.asarray(self.depth)
        if rgb.shape != (*shape, 3) or rgb.dtype != np.uint8:
            raise InputError(
                f"colour image has shape {rgb.shape} and type {rgb.dtype}, expected {(*shape, 3)} uint8",
                "image and camera must have the same size; colour is RGB with 8 bits a channel",
            )
        if depth.shape != shape:
            raise InputError(f"depth image has shape {depth.shape}, expected {shape} as the camera says")
        if not np.issubdtype(depth.dtype, np.floating):
            raise InputError(
                f"depth image has type {depth.dtype}, expected metres as float",
                "multiply raw readings by the depth scale, for example 0.001 for millimetres",
            )
        depth = depth.astype(np.float32, copy=True)
        with np.errstate(invalid="ignore"):
            depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
        object.__setattr__(self, "rgb", frozen(rgb))
        object.__setattr__(self, "depth", read_only(depth))
        if self.robot_mask is not None:
            robot = np.asarray(self.robot_mask, dtype=bool)
            if robot.shape != shape:
                raise InputError(f"robot mask has shape {robot.shape}, expected {shape}")
            object.__setattr__(self, "robot_mask", frozen(robot))
        object.__setattr__(self, "views", tuple(self.views))
        if any(view.views for view in self.views):
            raise InputError("a further view has views of its own", "list all cameras as views of one frame")
        if self.views and any(view.camera.T_world_camera is None for view in self.all_views):
            raise InputError(
                f"of {len(self.all_views)} cameras that see the same instant, at least one has no pose",
                "give every camera its T_world_camera, calibrated to one world",
            )

    @cached_property
    def key(self) -> bytes:
        """Name by content."""
        robot = b"" if self.robot_mask is None else self.robot_mask
        own = content_key("frame", self.rgb, self.depth, self.camera.key, robot)
        return content_key("views", own, *(view.key for view in self.views)) if self.views else own

    @property
    def all_views(self) -> tuple[Frame, ...]:
        """This image and those of the further cameras."""
        return (self, *self.views)

    @cached_property
    def valid(self) -> np.ndarray:
        """(H, W) bool: a depth reading that does not show the robot."""
        valid = np.isfinite(self.depth)
        if self.robot_mask is not None:
            valid &= ~self.robot_mask
        return read_only(valid)

    @cached_property
    def points(self) -> np.ndarray:
        """(H, W, 3) float64 world points in metres, NaN where there is no reading."""
        return read_only(self.camera.unproject(self.depth))

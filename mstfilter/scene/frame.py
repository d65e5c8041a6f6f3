"""RGB-D images: frames, clips, depth noise, and colours of parts of an image.

>>> frame = Frame(rgb, depth, camera)          # rgb (H, W, 3) uint8, depth (H, W) metres, NaN = no reading
>>> frame.points                               # (H, W, 3) world points in metres
>>> clip = Clip([frame, frame_2], grid, 1)     # the frames from pause 0 to pause 1
>>> clip.before, clip.after                    # its first and its last frame

If several cameras see the scene, one of them is the main camera, and only its images are segmented and tracked. The
others help to see what is free. Their simultaneous frames are the `views` of the main camera's frame:

>>> frame = Frame(rgb, depth, camera, views=(Frame(rgb_2, depth_2, camera_2),))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from mstfilter.base.errors import InputError
from mstfilter.base.lazy import late
from mstfilter.scene.arrays import content_key, frozen, read_only
from mstfilter.scene.camera import Camera
from mstfilter.scene.voxels import VoxelGrid

_SIGMA_AT_ONE_METRE = 0.00185


def depth_sigma(z: ArrayLike) -> np.ndarray:
    """Standard deviation (m) of a depth reading at z-depth `z` (m), in the shape of `z`.

    The sensor measures disparity, so the standard deviation grows with the square of depth: sigma = 0.00185 m (z /
    m)^2. The factor 0.00185 m was fitted to image patches of tables in 45 Kinect v1 and Xtion frames (0.6 to 1.5 m).
    Up to a depth of 1.2 m, the formula is within 10 % of the measured values.
    """
    z = np.asarray(z)
    return _SIGMA_AT_ONE_METRE * z * z


_IN_METRES = "floating-point depth is read in metres, whatever the depth scale is: multiply millimetres by 0.001"


def check_depth(depth: np.ndarray, where: str, hint: str = _IN_METRES) -> None:
    """Raise InputError if the median of a depth image (H, W) is not plausible in metres. It may have no reading."""
    with np.errstate(invalid="ignore"):
        metres = depth[np.isfinite(depth) & (depth > 0)]
    median = float(np.median(metres)) if metres.size else 1.0
    if not 0.05 < median < 30:
        raise InputError(f"{where} has a median of {median:g} m, expected between 0.05 and 30 m", hint)


def without_alpha(rgb: np.ndarray) -> np.ndarray:
    """Colour images (..., 3), from those or from images with an alpha channel (..., 4)."""
    return np.ascontiguousarray(rgb[..., :3]) if rgb.ndim > 2 and rgb.shape[-1] == 4 else rgb


_BLOCKS_ACROSS = 80


def grey_blocks(rgb: np.ndarray) -> np.ndarray:
    """Mean grey levels (h, w) float32 of the square blocks of an image (H, W, 3), with about 80 blocks per row."""
    grey = np.asarray(rgb, dtype=np.float32).mean(axis=2)
    side = max(1, grey.shape[1] // _BLOCKS_ACROSS)
    h, w = grey.shape[0] // side, grey.shape[1] // side
    return grey[: h * side, : w * side].reshape(h, side, w, side).mean(axis=(1, 3))


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB-D image with its camera: colour, and depth in metres that is registered to it.

    Parameters
    ----------
    rgb : (H, W, 3) uint8
        Colour image. A fourth channel (alpha) is dropped.
    depth : (H, W) float
        z-depth in metres, that is, along the optical axis. NaN, 0 and whatever is not positive and finite means that
        the pixel has no reading.
    camera : Camera
        Intrinsics and pose.
    robot_mask : (H, W) bool, optional
        Pixels that show the robot. What is behind them is unknown, not free.
    views : tuple of Frame
        Simultaneous frames of other cameras, which add free space. All cameras then need a pose in one world.
    estimated : (H, W) bool, optional
        Pixels whose depth is an estimate, not a reading (`mstfilter.scene.foreground`).
    """

    rgb: np.ndarray
    depth: np.ndarray
    camera: Camera
    robot_mask: np.ndarray | None = None
    views: tuple[Frame, ...] = ()
    estimated: np.ndarray | None = None

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width)
        rgb, depth = without_alpha(np.asarray(self.rgb)), np.ma.filled(self.depth, 0)
        if rgb.shape != (*shape, 3) or rgb.dtype != np.uint8:
            raise InputError(
                f"colour image has shape {rgb.shape} and type {rgb.dtype}, expected {(*shape, 3)} uint8",
                "image and camera must have the same size; colour is RGB with 8 bits per channel",
            )
        if depth.shape != shape:
            raise InputError(f"depth image has shape {depth.shape}, expected {shape}, the size of the camera")
        if not np.issubdtype(depth.dtype, np.floating):
            raise InputError(
                f"depth image has type {depth.dtype}, expected metres as float",
                "multiply raw readings by the depth scale, for example 0.001 for millimetres",
            )
        depth = depth.astype(np.float32, copy=True)
        with np.errstate(invalid="ignore"):
            depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
        check_depth(depth[::4, ::4], "depth image of the frame")
        object.__setattr__(self, "rgb", frozen(rgb))
        object.__setattr__(self, "depth", read_only(depth))
        for name in ("robot_mask", "estimated"):
            if (given := getattr(self, name)) is not None:
                mask = np.asarray(given, dtype=bool)
                if mask.shape != shape:
                    raise InputError(f"{name} of the frame has shape {mask.shape}, expected {shape}")
                object.__setattr__(self, name, frozen(mask))
        object.__setattr__(self, "views", tuple(self.views))
        if any(view.views for view in self.views):
            raise InputError("a view has views", "list all cameras as views of one frame")
        if self.views and any(view.camera.T_world_camera is None for view in self.all_views):
            raise InputError(
                f"at least one of {len(self.all_views)} cameras of a frame has no pose",
                "give every camera its T_world_camera in one world",
            )

    def __repr__(self) -> str:
        known = self.depth[np.isfinite(self.depth)]
        depth = "no depth"
        if len(known):
            share = known.size / self.depth.size
            depth = f"depth {known.min():.2f} to {known.max():.2f} m in {share:.0%} of the pixels"
        more = "" if self.robot_mask is None else ", robot mask"
        more += f", {len(self.views)} more views" if self.views else ""
        return f"Frame: {depth}{more}\n  {self.camera!r}"

    _repr_html_ = late("mstfilter.app.report.display:to_html", "What a notebook shows.")

    @cached_property
    def key(self) -> bytes:
        """Content key."""
        robot = b"" if self.robot_mask is None else self.robot_mask
        estimated = () if self.estimated is None else (self.estimated,)
        key = content_key("frame", self.rgb, self.depth, self.camera.key, robot, *estimated)
        return content_key("views", key, *(view.key for view in self.views)) if self.views else key

    def resized(self, camera: Camera, centred: bool = True) -> Frame:
        """The frame in the image size of a camera, without views.

        Depth is taken from the pixel at the centre of the new pixel, or at its upper left corner if not `centred`.
        """
        if camera is self.camera:
            return self
        import cv2

        size = camera.width, camera.height
        if size == (self.camera.width, self.camera.height):
            return Frame(self.rgb, self.depth, camera, self.robot_mask)
        robot, rule = self.robot_mask, cv2.INTER_NEAREST_EXACT if centred else cv2.INTER_NEAREST
        if robot is not None:
            robot = cv2.resize(robot.astype(np.uint8), size, interpolation=rule) > 0
        depth = cv2.resize(self.depth, size, interpolation=rule)
        return Frame(cv2.resize(self.rgb, size, interpolation=cv2.INTER_AREA), depth, camera, robot)

    @property
    def all_views(self) -> tuple[Frame, ...]:
        """The frame itself and its views."""
        return (self, *self.views)

    @cached_property
    def valid(self) -> np.ndarray:
        """(H, W) bool: pixels with a depth reading that do not show the robot."""
        valid = np.isfinite(self.depth)
        if self.robot_mask is not None:
            valid &= ~self.robot_mask
        return read_only(valid)

    @cached_property
    def points(self) -> np.ndarray:
        """(H, W, 3) float64 world points in metres, NaN at pixels without a reading."""
        return read_only(self.camera.unproject(self.depth))


@dataclass(frozen=True, eq=False)
class Clip:
    """What a filter observes in one step: the frames from one pause to the next, and the workspace.

    At a pause nothing moves, so the first frame (`before`) and the last one (`after`) can be segmented; those between
    show the action, through which objects are tracked. The first clip of a recording has a single frame.

    Parameters
    ----------
    frames : sequence of Frame
        The frames in time order. The first and the last show the scene at rest. They may be read on access.
    grid : VoxelGrid
        The workspace.
    index : int
        Number of the pause at the end of the clip, counted from 0. It is a part of the identities of new objects, so
        the numbers of successive clips have to ascend.
    times : tuple of float, optional
        Time of each frame in seconds.
    """

    frames: Sequence[Frame]
    grid: VoxelGrid
    index: int = 0
    times: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.frames) == 0:
            raise InputError(f"clip {self.index} has no frames")
        if self.times and len(self.times) != len(self.frames):
            raise InputError(f"clip {self.index} has {len(self.frames)} frames and {len(self.times)} times")

    def __repr__(self) -> str:
        seconds = f" over {self.times[-1] - self.times[0]:.1f} s" if self.times else ""
        frames = "1 frame" if len(self) == 1 else f"{len(self)} frames"
        return f"Clip {self.index}: {frames}{seconds}\n  {self.grid.text}"

    _repr_html_ = late("mstfilter.app.report.display:to_html", "What a notebook shows.")

    @cached_property
    def key(self) -> bytes:
        """Content key of all frames and the grid. The first access reads every image."""
        return content_key("frames", self.grid.key, *(frame.key for frame in self.frames))

    @property
    def before(self) -> Frame:
        """The frame at the previous pause."""
        return self.frames[0]

    @property
    def after(self) -> Frame:
        """The frame at the pause that ends the clip."""
        return self.frames[-1]

    def __len__(self) -> int:
        return len(self.frames)


_BINS, _LOWEST, _WIDTH = (4, 6, 6), (0.0, -48.0, -48.0), (25.0, 16.0, 16.0)  # of Lab colours


def areas_of_colours(frame: Frame, mask: np.ndarray) -> np.ndarray:
    """Visible area (144,) float32 in square metres of each colour in a mask (H, W) bool of a frame.

    The colours are 4 x 6 x 6 bins of Lab colours. A pixel is divided between the nearest bins. The area is that of a
    surface that faces the camera.
    """
    import cv2

    areas = np.zeros(_BINS)
    rgb, depth = frame.rgb[mask], frame.depth[mask & frame.valid]
    if not len(depth):
        return areas.ravel().astype(np.float32)
    lab = cv2.cvtColor(rgb[None].astype(np.float32) / 255, cv2.COLOR_RGB2Lab)[0]
    at = np.clip((lab - _LOWEST) / _WIDTH - 0.5, 0, np.array(_BINS) - 1)
    low = np.minimum(at.astype(np.int64), np.array(_BINS) - 2)
    for corner in np.ndindex(2, 2, 2):
        np.add.at(areas, tuple((low + corner).T), np.where(corner, at - low, 1 - (at - low)).prod(axis=1))
    pixel = float(np.median(depth)) ** 2 / (frame.camera.K[0, 0] * frame.camera.K[1, 1])
    return (pixel * areas.ravel()).astype(np.float32)


def main_colour(areas: np.ndarray) -> tuple[int, int, int]:
    """The colour (r, g, b) around which most of the visible area lies, from `areas_of_colours` (144,).

    It is the mean colour of the bin with the largest area and of its neighbours.
    """
    import cv2

    table = np.asarray(areas, dtype=np.float64).reshape(_BINS)
    best = np.array(np.unravel_index(table.argmax(), _BINS))
    low = np.maximum(best - 1, 0)
    near = table[tuple(slice(a, b + 2) for a, b in zip(low, best, strict=True))]
    at = np.indices(near.shape).reshape(3, -1).T + low + 0.5
    lab = _LOWEST + np.asarray(_WIDTH) * (near.ravel() @ at / max(near.sum(), 1e-12))
    rgb = cv2.cvtColor(lab[None, None].astype(np.float32), cv2.COLOR_Lab2RGB)[0, 0]
    r, g, b = np.clip(np.rint(255 * rgb), 0, 255).astype(int).tolist()
    return r, g, b

"""Plausibility checks of a recording before a run, and of the first hypotheses.

>>> for finding in examine(recording.frames, recording.pauses, recording.grid):
...     print(finding.stop, finding.message, finding.hints)

Some faults of the input give confident wrong hypotheses and no error: wrong units, a camera matrix of another image
size, a moved camera, or unregistered depth. `examine` tests whether the frames at the pauses are plausible for a
camera above a table. A finding stops the run if the hypotheses cannot be correct. Other findings are warnings. The
limits of the checks were chosen in ``experiments/plausibility``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mstfilter.base.errors import InputError, warn_user
from mstfilter.scene.arrays import content_key
from mstfilter.scene.camera import Camera
from mstfilter.scene.frame import Frame, depth_sigma, grey_blocks
from mstfilter.scene.geometry import (
    TABLE_TOLERANCE,
    Edges,
    SupportPlane,
    edge_agreement,
    fit_support_plane,
    in_columns,
    shares_with_depth,
)
from mstfilter.scene.voxels import Hypothesis, VoxelGrid

_Limits = tuple[float, float]
_FIELDS, _POSSIBLE_FIELDS = (12.0, 130.0), (3.0, 160.0)  # degrees: horizontal field of view; warning and stop
_ASPECTS, _ANY = (0.8, 1.25), (-np.inf, np.inf)  # ratio of the focal lengths; warning
_OFF_CENTRE = (0.2, 0.4)  # of the image size: principal point from the middle; warning and stop
_VOXELS, _POSSIBLE_VOXELS = (0.001, 0.05), (0.0002, 0.3)  # metres; warning and stop
_DISTANCES = (0.25, 2.0)  # metres from the camera to the table; warning
_VOXELS_IN_DISTANCE = 25  # a camera nearer than this many voxels stops the run
_NOISE_IN_VOXELS = 1.3  # depth noise at the table in voxels beyond which the run stops
_MIN_HEIGHT = 0.01  # metres above the table beyond which a reading may show an object
_ON_TABLE, _NEAR_TABLE = 0.025, 0.1  # metres from z = 0: on the table; where the table is searched
_MAX_TILT, _MAX_HEIGHT = 2.5, 0.025  # degrees and metres between the table and z = 0: warning; twice: stop
_LEAST_SHIFT = 0.01  # metres: a table that is farther from z = 0 is shifted there
_OTHER_PLANE = 30.0  # degrees: a plane that is tilted by more is a wall or the side of a box, not the table
_MIN_ON_TABLE = 0.1  # share of the readings on the table, as `fit_support_plane` demands
_MAX_INTERVAL = 10.0  # seconds between frames; warning
_MIN_KNOWN = 0.25  # share of the pixels with readings; warning
_MIN_READINGS = 30  # of an image of 160 columns; fewer are taken for noise
_TALL, _UPRIGHT = 0.35, 0.5  # metres, cosine: see `_other_support`
# Tilt in degrees, height and shift in metres of the camera between pauses: warning; twice: stop.
_DRIFT = (2.0, 0.02, 0.015)
_TABLE_LEFT = 0.3  # of the readings on the table at the first pause, below which a pause shows no table
_MIN_MOVED = 15  # matched corners that agree with a moved camera
_PEAK, _EXCESS, _ORDER = 0.15, 0.2, 0.015  # of the rank of colour edges below depth edges: see `_registration`
_COARSE_EXCESS = 0.05  # as _EXCESS, in smoothed colour images
_SMOOTHING = (2.0, 4.0)  # pixels of an image of 320 columns; removes texture of up to about 5 and 10 pixels


@dataclass(frozen=True)
class Finding:
    """A property of the input that the user probably did not intend."""

    stop: bool  #: whether the hypotheses cannot be correct
    message: str
    hints: tuple[str, ...]


def _stop(message: str, *hints: str) -> Finding:
    return Finding(True, message, hints)


def _warning(message: str, *hints: str) -> Finding:
    return Finding(False, message, hints)


_CHECK_POSE = "check the pose: z of the world is up, the table is at z = 0"
_CHECK_SCALE = "check the depth scale: millimetres need 0.001, TUM images 0.0002, RealSense L515 0.00025"
_GIVE_POSE = "give the pose T_world_camera of the camera over the table"
_GIVE_WORKSPACE = "give a workspace around the objects, or none: it is then placed around the objects on the table"


def examine(
    frames: Sequence[Frame], pauses: Sequence[int], grid: VoxelGrid, times: Sequence[float] = ()
) -> list[Finding]:
    """Findings about the frames of a recording at its pauses, about the workspace and the times in seconds.

    Findings that stop a run come first. The frames are read one by one, and are not kept in memory.
    """
    found = [*_intrinsics(frames[pauses[0]].camera), *_voxels(grid), *_interval(times, len(pauses))]
    if not any(finding.stop for finding in found):
        looks = [Look(frames[p], grid, p) for p in pauses]
        found += [finding for look in looks for finding in unreadable(look.frame, f"frame {look.index}")]
    if not any(finding.stop for finding in found):
        found += [*_support(looks[0]), *_scale(looks[0]), *_missing(looks), *_constant(looks[0])]
        found += [*_workspace(looks), *_moved(looks)]
        found += [*_registration(looks), *_repeated(looks), *_one_pause(frames, pauses)]
        for view in frames[pauses[0]].views:
            doubts = [*_intrinsics(view.camera), *unreadable(view, "the image")]
            doubts = doubts or [*_support(look := Look(view, grid)), *_scale(look)]
            found += [_warning(f"one of the views: {doubt.message}", *doubt.hints) for doubt in doubts]
    return sorted(found, key=lambda finding: not finding.stop)


def examine_next(first: Look, look: Look, times: Sequence[float]) -> list[Finding]:
    """Findings about a later pause of a stream, and about the times of its clip: those of `examine`."""
    found = [*_interval(times, 2), *unreadable(look.frame, f"frame {look.index}")]
    return [*found, *_missing([look]), *_moved([first, look])]


def report_findings(findings: Iterable[Finding], where: str) -> None:
    """Raise InputError for a finding that stops a run; warn of the other findings. Messages begin with `where`."""
    for finding in sorted(findings, key=lambda finding: not finding.stop):
        if finding.stop:
            raise InputError(f"{where}: {finding.message}", *finding.hints)
        warn_user(f"{where}: {finding.message}", *finding.hints)


def examine_hypotheses(hypotheses: Sequence[Hypothesis], frame: Frame) -> list[Finding]:
    """Findings from a comparison of the hypotheses of a step with the frame at the end of the step."""
    grid, points = hypotheses[0].grid, _sampled(frame, 160).points
    raised = grid.contains(grid.index_of(points)) & (points[..., 2] > 2 * _MIN_HEIGHT)
    if raised.mean() > 0.005 and not any(h.n_objects for h in hypotheses):
        text = f"no hypothesis has an object, but {raised.mean():.1%} of the pixels show readings above the table"
        return [_warning(text, _CHECK_SCALE, _CHECK_POSE, "objects of a few voxels need smaller voxels")]
    largest = max((max(h.volumes().values(), default=0) for h in hypotheses), default=0)
    share = largest / np.prod(grid.shape)
    if share > 0.1:
        text = f"an object has {largest} voxels, {share:.0%} of the workspace"
        table = "is it the table? check that the camera stands still and that the table is at z = 0"
        return [_warning(text, table, f"is it a wall or a person? {_GIVE_WORKSPACE}")]
    return []


class Look:
    """Measurements in the frame at a pause, which the plausibility checks use."""

    def __init__(self, frame: Frame, grid: VoxelGrid, index: int = 0) -> None:
        self.index, self.grid = index, grid
        self.frame, self.edges = _sampled(frame, 160), Edges(_sampled(frame, 320))
        self.corners = _Corners(_sampled(frame, 640), grid)
        self.points = self.frame.points[self.frame.valid]
        self.known = shares_with_depth(self.frame, grid)

    @cached_property
    def on_table(self) -> np.ndarray:
        """(n,) bool: whether each depth reading is on the table."""
        return np.asarray(np.abs(self.points[:, 2]) < _ON_TABLE)

    @cached_property
    def in_columns(self) -> np.ndarray:
        """(n,) bool: whether each depth reading is inside, above or below the workspace."""
        return in_columns(self.grid, self.points)

    def plane(self, chosen: np.ndarray | None = None) -> tuple[float, float, np.ndarray] | None:
        """Tilt (degrees), height (m) and normal (3,) in camera axes of a plane fitted to `chosen` readings (n,)."""
        return _plane(self.frame, chosen)

    @cached_property
    def table(self) -> tuple[float, float] | None:
        """Tilt (degrees) and height (m) of the plane of the table; None if no plane is found near z = 0."""
        return _table(self.frame)


def _plane(frame: Frame, chosen: np.ndarray | None = None) -> tuple[float, float, np.ndarray] | None:
    """Tilt (degrees), height (m) and normal (3,) in camera axes of a plane fitted to `chosen` readings (n,)."""
    given = frame.camera.pose
    try:
        if chosen is not None:
            valid = np.zeros_like(frame.valid)
            valid[frame.valid] = chosen
            frame = Frame(frame.rgb, np.where(valid, frame.depth, np.nan), frame.camera)
        plane: SupportPlane = fit_support_plane(frame)
    except InputError:  # too few readings, or most are beyond 30 m
        return None
    fitted = plane.T_world_camera.inv()
    normal = fitted.rotation.apply([0.0, 0.0, 1.0])
    tilt = np.degrees(np.arccos(np.clip(given.rotation.apply(normal)[2], -1, 1)))
    return float(tilt), float((given * fitted).apply(np.zeros(3))[2]), normal


def _table(frame: Frame) -> tuple[float, float] | None:
    """Tilt (degrees) and height (m) of the plane of the table; None if no plane is found near z = 0."""
    near = np.abs(frame.points[frame.valid][:, 2]) < _NEAR_TABLE
    plane = _plane(frame, near) if near.sum() > 0.03 * near.size else None
    return None if plane is None or plane[0] > _OTHER_PLANE else plane[:2]


def table_height(frame: Frame) -> float:
    """Height (m) of the table in a world in which it is not at z = 0, as in the world of a robot's base; else 0.

    The table is the largest level plane near z = 0 or, if none is there, the largest plane of the image. It is at
    z = 0 if at least half as many readings are there as on the plane.
    """
    frame = _sampled(frame, 160)
    plane = _table(frame) or _plane(frame)
    if plane is None or plane[0] > _MAX_TILT or abs(plane[1]) < _LEAST_SHIFT:
        return 0.0
    heights, reach = frame.points[frame.valid][:, 2], min(abs(plane[1]) / 2, _ON_TABLE)
    there, here = ((np.abs(heights - z) < reach).sum() for z in (plane[1], 0.0))
    return plane[1] if here < there / 2 else 0.0


def _sampled(frame: Frame, width: int) -> Frame:
    """The frame reduced to every k-th pixel, with about `width` columns."""
    step = max(1, round(frame.camera.width / width))
    part = slice(step // 2, None, step)
    rgb, depth = frame.rgb[part, part], frame.depth[part, part]
    K = frame.camera.K.copy()
    K[:2, 2] -= step // 2
    K[:2] /= step
    mask = None if frame.robot_mask is None else frame.robot_mask[part, part]
    return Frame(rgb, depth, Camera(K, depth.shape[1], depth.shape[0], frame.camera.T_world_camera), mask)


def _limited(value: float, usual: _Limits, possible: _Limits, text: str, *hints: str) -> Iterator[Finding]:
    """A finding for a value outside the `usual` limits. A value outside the `possible` limits stops the run."""
    if not usual[0] <= value <= usual[1]:
        yield Finding(not possible[0] <= value <= possible[1], text, hints)


def _intrinsics(camera: Camera) -> Iterator[Finding]:
    """Findings about unusual focal lengths and principal points."""
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    width, height = camera.width, camera.height
    hint = "check K: it is in pixels of these images; scale it if they were resized"
    angle = float(np.degrees(2 * np.arctan(width / (2 * fx))))
    text = f"a focal length of {fx:.4g} pixels gives images of {width} pixels a field of view of {angle:.3g} degrees"
    yield from _limited(angle, _FIELDS, _POSSIBLE_FIELDS, text, hint)
    text = f"the focal lengths are {fx:.4g} and {fy:.4g} pixels, expected nearly equal ones"
    yield from _limited(fx / fy, _ASPECTS, _ANY, text, hint)
    x, y = cx / width - 0.5, cy / height - 0.5
    off = max(abs(x), abs(y))
    if off > _OFF_CENTRE[0]:
        text = f"the principal point ({cx:.4g}, {cy:.4g}) is far from the middle of images of {width} x {height}"
        fits = f"K fits images of about {2 * cx:.0f} x {2 * cy:.0f} pixels"
        crop = "K is that of the whole image and these are a part? subtract the left and upper border from cx and cy"
        yield Finding(off > _OFF_CENTRE[1] or abs(x - y) < 0.03, text, (hint, fits, crop))
    elif max(abs(cx / height - 0.5), abs(cy / width - 0.5)) < min(0.03, off / 2):
        text = f"K fits images of {height} x {width} pixels, the images have {width} x {height}"
        yield Finding(False, text, ("were the images turned by 90 degrees? turn K too: cx and cy change places",))


def _voxels(grid: VoxelGrid) -> Iterator[Finding]:
    size = grid.voxel_size
    text = f"the voxels have edges of {size:g} m, expected {_VOXELS[0]} to {_VOXELS[1]} m"
    hint = "check the workspace: its bounds and its voxel size are in metres"
    yield from _limited(size, _VOXELS, _POSSIBLE_VOXELS, text, hint)


def _interval(times: Sequence[float], n_pauses: int) -> Iterator[Finding]:
    """A finding if the frames between the pauses are far apart, as milliseconds are that are taken for seconds."""
    apart = float(np.median(np.diff(times))) if len(times) > n_pauses + 2 else 0.0
    if apart > _MAX_INTERVAL:
        text = f"the frames are {apart:.4g} s apart, so motion cannot be tracked: are their times in milliseconds?"
        hint = "times are in seconds: multiply milliseconds by 0.001, or rename the images by time in s"
        yield _warning(text, hint)


def unreadable(frame: Frame, which: str) -> Iterator[Finding]:
    """Findings about images that are empty, constant or fully masked. `which` names the frame in the messages."""
    depth = frame.depth[np.isfinite(frame.depth)]
    masked = 0.0 if frame.robot_mask is None else frame.robot_mask.mean()
    if not depth.size:
        hint = "0 and NaN are no reading; leave the frame out: another pause, or start_s and stop_s of a video"
        yield _stop(f"{which} has no reading at all in its depth image", hint)
    elif masked > 0.6 or not frame.valid.any():
        text = f"the robot mask of {which} covers {masked:.0%} of the image and most or all of its depth"
        yield Finding(masked > 0.95 or not frame.valid.any(), text, ("is the mask inverted? True is the robot",))
    elif np.ptp(depth) < 1e-6:
        text = f"all depth readings of {which} are {depth[0]:.3g} m"
        yield _stop(text, "check that the depth images are those of the camera, in metres")
    elif frame.rgb.mean(axis=2).std() < 4:
        text = f"the colour image of {which} is uniform"
        yield _warning(text, "check that the colour images are 8-bit RGB, 0 to 255, and not covered")


def _support(first: Look) -> Iterator[Finding]:
    """Findings if the depth readings at the first pause contradict the pose, intrinsics or support plane."""
    free, camera, table = first.plane(), first.frame.camera, first.table
    hints = (
        f"{_CHECK_POSE}; without a pose it is found from the table",
        "T_world_camera maps points of the camera to the world; is this the inverse?",
        f"check K: its focal length is {camera.K[0, 0] / camera.width:.3g} of the width of the images",
        _CHECK_SCALE,
    )
    middle = np.median(first.frame.depth[first.frame.valid])
    inverse = _share_on_plane(first.frame, middle**2 / first.frame.depth)
    if inverse > 0.3 and inverse > 0.1 + _share_on_plane(first.frame):
        text = "inverse depth has a larger plane than depth: the depth images seem to contain disparity or 1 / depth"
        yield _stop(text, "convert them to metres: focal length in pixels * baseline in metres / disparity in pixels")
    elif table is not None and (table[0] > _MAX_TILT or abs(table[1]) > _MAX_HEIGHT):
        text = f"the table in the depth image is tilted by {table[0]:.1f} degrees and at z = {table[1]:.3f} m"
        impossible = table[0] > 2 * _MAX_TILT or abs(table[1]) > 2 * _MAX_HEIGHT
        yield Finding(impossible, f"{text}, expected z = 0", hints)
    elif table is None and free is not None and (first.on_table.mean() < _MIN_ON_TABLE or free[0] > 150):
        text = f"the largest plane is tilted by {free[0]:.0f} degrees and at z = {free[1]:.3f} m, expected z = 0"
        yield _stop(f"no table is at z = 0: {text}", *hints)
    else:
        yield from _other_support(first)


def _share_on_plane(frame: Frame, depth: np.ndarray | None = None) -> float:
    """Share of the readings on the largest plane, of a frame or of its colour image with other depth (H, W)."""
    try:
        plane = fit_support_plane(frame if depth is None else Frame(frame.rgb, depth, frame.camera))
    except InputError:
        return 0.0
    return float((np.abs(plane.residual[frame.valid]) < TABLE_TOLERANCE).mean())


def _other_support(first: Look) -> Iterator[Finding]:
    """Findings if a wall or the floor is at z = 0 and another large plane is the table.

    A table is parallel to the floor, and its height above the floor is larger than the height of an object. A table
    is at a right angle to a wall and extends far from the wall. In the image, the normal of a table points up, and
    the normal of a wall does not.
    """
    raised = first.points[:, 2] > _ON_TABLE
    plane = first.plane(raised) if raised.mean() > _MIN_ON_TABLE else None
    if plane is None:
        return
    tilt, _, normal = plane
    heights = first.points[raised, 2]
    hint = "or remove the depth readings beyond the table (NaN or 0), or turn the camera towards the table"
    level = plane if tilt < 60 else _level(first)  # a wall may be larger than the table
    if level is not None and level[0] < 15 and level[1] > _TALL:
        on_plane = (np.abs(first.points[:, 2] - level[1]) < _ON_TABLE).mean()
        if on_plane > _MIN_ON_TABLE:
            text = f"the floor is taken for the table: a second plane is {level[1]:.2f} m above z = 0"
            yield _stop(text, _GIVE_POSE, hint)
    up = first.frame.camera.pose.rotation.inv().apply([0.0, 0.0, 1.0])
    if 60 < tilt < 120 and np.percentile(heights, 98) > _TALL and up[1] > -0.1 and -normal[1] > _UPRIGHT:
        text = f"a wall is taken for the table: another plane is tilted by {tilt:.0f} degrees"
        yield _stop(text, _GIVE_POSE, hint, "if the camera is upside down, turn the images by 180 degrees")


def _level(first: Look) -> tuple[float, float, np.ndarray] | None:
    """The plane of the most frequent height above `_TALL`, as `Look.plane` returns it."""
    heights = first.points[:, 2]
    counts, edges = np.histogram(heights, np.arange(_TALL, np.clip(heights.max(), _TALL, 30.0) + 0.1, 0.05))
    k = counts.argmax()
    return first.plane((heights > edges[k] - 0.05) & (heights < edges[k + 1] + 0.05))


def _scale(first: Look) -> Iterator[Finding]:
    """Findings about distances that are unusual for a camera over a table."""
    depth, size = first.frame.depth[first.frame.valid], first.grid.voxel_size
    z = float(np.median(depth[first.on_table] if first.on_table.mean() > _MIN_ON_TABLE else depth))
    possible = (_VOXELS_IN_DISTANCE * size, float(np.sqrt(_NOISE_IN_VOXELS * size / depth_sigma(1.0))))
    text = f"the table is {z:.3g} m from the camera, expected {_DISTANCES[0]:g} to {_DISTANCES[1]:g} m"
    hints = [_CHECK_SCALE]
    if not possible[0] <= z <= possible[1]:
        size_of = "larger" if z > possible[1] else "smaller"
        hints.append(f"if the distance is right, give a workspace with {size_of} voxels")
    yield from _limited(z, _DISTANCES, possible, text, *hints)
    raised = first.in_columns & (first.points[:, 2] > _MIN_HEIGHT)
    above = first.points[raised, 2] > first.grid.upper[2]
    if raised.sum() >= _MIN_READINGS and above.mean() > 0.5:
        text = f"most readings above the table are above the workspace, which ends at z = {first.grid.upper[2]:.2f} m"
        floor = f"is the plane of the table found on the floor or on a wall? {_GIVE_POSE}"
        yield _warning(text, _CHECK_SCALE, "or give a higher workspace", floor)


def _missing(looks: Sequence[Look]) -> Iterator[Finding]:
    """A finding if few pixels of a pause have depth readings."""
    least = min(looks, key=lambda look: min(look.known))
    if min(least.known) < _MIN_KNOWN:
        text = "frame {} has depth readings in {:.0%} of the image and {:.0%} of its part that shows the workspace"
        hint = "objects without readings are missed: check exposure, distance, glare, and the colour format of depth"
        yield _warning(text.format(least.index, *least.known), hint)


def _constant(look: Look) -> Iterator[Finding]:
    """A finding if many readings beside the table have one value, and few have a similar value."""
    depth = look.frame.depth[look.frame.valid]
    values, counts = np.unique(depth, return_counts=True)
    value, count = values[counts.argmax()], counts.max()
    similar = np.abs(depth - value) < 0.03 * value
    if count > 0.01 * look.frame.depth.size and similar.sum() < 1.2 * count and look.on_table[similar].mean() < 0.5:
        text = f"{count / look.frame.depth.size:.0%} of the pixels of frame {look.index} have the depth {value:.4g} m"
        yield _warning(text, "is this value the mark for missing depth? set these pixels to 0 or NaN")


def _workspace(looks: Sequence[Look]) -> Iterator[Finding]:
    """Findings if the workspace is beside the table, starts above it, or is below or above the objects."""
    grid, texts = looks[0].grid, []
    if grid.origin[2] > _ON_TABLE:
        text = f"the workspace starts at z = {grid.origin[2]:.3g} m, so the lower parts of objects are cut off"
        yield _warning(text, "start it at z = 0, the height of the table")
    inside = (look.points[grid.contains(grid.index_of(look.points)), 2] for look in looks)
    if any((heights > _MIN_HEIGHT).sum() >= _MIN_READINGS for heights in inside):
        return
    raised = max(int((look.in_columns & (look.points[:, 2] > _MIN_HEIGHT)).sum()) for look in looks)
    on_table = max(int((look.in_columns & look.on_table).sum()) for look in looks)
    if raised < _MIN_READINGS and on_table >= _MIN_READINGS:
        return  # an empty table
    spans = np.array([np.percentile(look.points, (2, 98), axis=0) for look in looks])
    for low, high in ((grid.origin, grid.upper), (spans[:, 0].min(axis=0), spans[:, 1].max(axis=0))):
        texts.append(", ".join(f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", low, high, strict=True)))
    text = f"it spans {texts[0]} m, depth readings span {texts[1]} m"
    images = "check that the images show objects on a table and not only a wall"
    text = f"the workspace has no reading above the table, so no object can be found: {text}"
    yield _stop(text, _GIVE_WORKSPACE, _CHECK_POSE, _CHECK_SCALE, images)


class _Corners:
    """Image corners (ORB) on static surfaces: on the table and outside the workspace."""

    def __init__(self, frame: Frame, grid: VoxelGrid) -> None:
        import cv2

        points = frame.points
        with np.errstate(invalid="ignore"):
            still = (np.abs(points[..., 2]) < _MIN_HEIGHT) | ~in_columns(grid, points)
        mask = cv2.erode((still & frame.valid).astype(np.uint8), np.ones((9, 9), np.uint8))
        grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        corners, self.features = cv2.ORB_create(1000, fastThreshold=4).detectAndCompute(grey, mask)  # type: ignore[attr-defined]
        self.pixels = np.array([corner.pt for corner in corners]).reshape(-1, 2)
        column, row = np.rint(self.pixels).astype(int).T
        self.points, self.camera = points[row, column], frame.camera

    def moved(self, other: _Corners) -> tuple[int, int, float]:
        """Number of corners at rest, number of corners that moved together, and median shift (m) of the latter."""
        import cv2

        if self.features is None or other.features is None:
            return 0, 0, 0.0
        matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(self.features, other.features)
        pairs = np.array([(m.queryIdx, m.trainIdx) for m in matches if m.distance < 50], int).reshape(-1, 2)
        expected, z = other.camera.project(self.points[pairs[:, 0]])
        pairs, expected, z = (part[np.isfinite(expected[:, 0])] for part in (pairs, expected, z))
        found, tolerance = other.pixels[pairs[:, 1]], other.camera.width / 160
        if len(pairs) < _MIN_MOVED:
            return len(pairs), 0, 0.0
        distance = np.linalg.norm(found - expected, axis=1)
        inlier = cv2.findHomography(expected, found, cv2.RANSAC, tolerance / 2, maxIters=500)[1]
        away = (np.zeros(len(pairs), bool) if inlier is None else inlier.ravel() > 0) & (distance > tolerance)
        metres = distance[away] * z[away] / other.camera.K[0, 0]
        return int((distance <= tolerance).sum()), int(away.sum()), float(np.median(metres)) if away.any() else 0.0


def drift(first: Look, look: Look) -> tuple[float, float, float]:
    """Tilt (degrees), height (m) and shift (m) of the camera relative to its given pose, between two pauses.

    Tilt and height are computed from a plane fitted to the table if few depth readings remain near z = 0, and are 0
    otherwise. The shift is measured at image corners on the table and outside the workspace.
    """
    tilt = height = shift = 0.0
    left = look.on_table.mean() / max(first.on_table.mean(), 1e-9)
    if first.table is not None and look.table is not None:
        tilt, height = look.table[0] - first.table[0], abs(look.table[1] - first.table[1])
        tilt, height = tilt if left < 0.8 else 0.0, height if left < 0.3 or tilt > 1 else 0.0
    still, moved, metres = first.corners.moved(look.corners)
    if moved >= _MIN_MOVED and moved > 2 * still:
        shift = metres
    return tilt, height, shift


def _moved(looks: Sequence[Look]) -> Iterator[Finding]:
    """A finding if the camera is not at its given pose at a pause: for the first that stops, or for the farthest."""
    hints = (
        "fix the camera, or give its pose in every frame: T_world_camera of shape (T, 4, 4)",
        "poses of the camera map its points to the world, in metres; check that they belong to these frames",
    )
    largest, moved = 1.0, ""
    for look in looks[1:]:
        if looks[0].table and not look.table and look.on_table.mean() < _TABLE_LEFT * looks[0].on_table.mean():
            text = f"frame {look.index} shows no table at z = 0, but frame {looks[0].index} does"
            yield _stop(f"{text}: the camera or its pose is wrong", *hints)
            return
        found = drift(looks[0], look)
        size = max(value / limit for value, limit in zip(found, _DRIFT, strict=True))
        if size > largest:
            largest = size
            moved = f"the camera moves from frame {looks[0].index} to {look.index}, but not its pose: the table is "
            moved += f"tilted by {found[0]:.1f} degrees and {found[1]:.3f} m higher, still corners are shifted by "
            moved += f"{found[2]:.3f} m"
        if size > 2:
            break
    if moved:
        yield Finding(largest > 2, moved, hints)


def _registration(looks: Sequence[Look]) -> Iterator[Finding]:
    """A finding if the edges of the depth image and of the colour image of a pause are not at the same pixels.

    The grain of a wooden table agrees with edges of depth by chance at some shift, or in other images. A finding must
    therefore hold in smoothed colour images too, in which the outlines of objects remain.
    """
    edges = [look.edges for look in looks]
    peak, lost, shift, rise = edge_agreement(edges)
    ordered, aligned = rise <= _ORDER, lost <= _EXCESS or max(map(abs, shift)) <= 2
    if peak < _PEAK or (ordered and aligned):
        return
    coarse = [edge_agreement(edges, sigma) for sigma in _SMOOTHING]
    if not ordered and all(one[3] > 0 for one in coarse):
        text = "edges of the depth images agree better with the colour images of other pauses than with their own"
        yield _warning(text, "check that colour and depth have the same order, and the same clock")
    elif not aligned and all(one[1] > _COARSE_EXCESS for one in coarse):
        down, right = (100 * s / looks[0].edges.depth.shape[1] for s in shift)
        text = (
            f"edges agree best {right:.1f} % of the image width further right and {down:.1f} % further down in colour"
        )
        hint = "align depth to colour when recording: each depth pixel belongs to the colour pixel above it"
        yield _warning(f"depth is not registered to colour: {text}", hint)


def _repeated(looks: Sequence[Look]) -> Iterator[Finding]:
    """A finding if the images at all pauses are identical."""
    if len(looks) > 1 and len({content_key(look.frame.rgb, look.frame.depth) for look in looks}) == 1:
        text = f"the images of all {len(looks)} pauses are identical, which no camera gives"
        yield _warning(text, "check that every frame is read from its own file")


def _one_pause(frames: Sequence[Frame], pauses: Sequence[int]) -> Iterator[Finding]:
    """A finding if the scene changes in a video with only one pause: frames that are not at a pause are not used."""
    if len(pauses) > 1 or len(frames) == 1:
        return
    change = np.abs(grey_blocks(frames[0].rgb) - grey_blocks(frames[len(frames) - 1].rgb))
    if (np.abs(change - np.median(change)) > 20).mean() > 0.01:
        text = f"there is one pause in {len(frames)} frames, but the scene changes: the video is not used"
        yield _warning(text, "give a pause before and after each action: pauses=(0, 40, 85)")

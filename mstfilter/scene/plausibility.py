"""Plausibility checks of a recording before a run.

>>> for finding in examine(recording.frames, recording.pauses, recording.grid):
...     print(finding.stop, finding.message, finding.hints)

Some faults of the input give confident wrong hypotheses and no error. `examine` looks for the six that people make:
depth in other units, a camera matrix of other images, a wrong pose, a camera that moved, depth that is not registered
to colour, and constant images. A finding stops the run if the hypotheses cannot be correct; other findings are
warnings. The limits of the checks were chosen in ``experiments/plausibility``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mstfilter.base.errors import InputError, warn_user
from mstfilter.scene.alignment import MIN_MOVED, Corners, Edges, edge_agreement
from mstfilter.scene.arrays import content_key
from mstfilter.scene.camera import Camera
from mstfilter.scene.frame import Frame, depth_sigma
from mstfilter.scene.planes import ON_TABLE, Plane, plane_of, sampled, table_of
from mstfilter.scene.voxels import VoxelGrid

_FIELDS, _POSSIBLE_FIELDS = (12.0, 130.0), (3.0, 160.0)  # degrees: horizontal field of view; warning and stop
_ASPECTS = (0.8, 1.25)  # ratio of the focal lengths; warning
_OFF_CENTRE = (0.2, 0.4)  # of the image size: principal point from the middle; warning and stop
_DISTANCES = (0.25, 2.0)  # metres from the camera to the table; warning
_VOXELS_IN_DISTANCE = 25  # a camera nearer than this many voxels stops the run
_NOISE_IN_VOXELS = 1.3  # depth noise at the table in voxels beyond which the run stops
_MAX_TILT, _MAX_HEIGHT = 2.5, 0.025  # degrees and metres between the table and z = 0: warning; twice: stop
_MIN_ON_TABLE = 0.1  # share of the readings on the table, as `fit_support_plane` demands
_TALL, _UPRIGHT = 0.35, 0.5  # metres, cosine: see `_other_support`
# Tilt in degrees, height and shift in metres of the camera between pauses: warning; twice: stop.
_DRIFT = (2.0, 0.02, 0.015)
_TABLE_LEFT = 0.3  # of the readings on the table at the first pause, below which a pause shows no table
_PEAK, _EXCESS, _COARSE_EXCESS = 0.15, 0.2, 0.05  # of the rank of colour edges below depth edges: see `_registration`
_SMOOTHING = (2.0, 4.0)  # pixels of an image of 320 columns; removes texture of up to about 5 and 10 pixels


@dataclass(frozen=True)
class Finding:
    """A property of the input that the user probably did not intend."""

    stop: bool  #: whether the hypotheses cannot be correct
    message: str
    hints: tuple[str, ...]


_CHECK_SCALE = "check the depth scale: millimetres need 0.001, TUM images 0.0002, RealSense L515 0.00025"
_GIVE_POSE = "give the pose T_world_camera of the camera over the table"


def examine(frames: Sequence[Frame], pauses: Sequence[int], grid: VoxelGrid) -> list[Finding]:
    """Findings about the frames of a recording at its pauses. Findings that stop a run come first.

    The frames are read one by one, and are not kept in memory.
    """
    found = list(_camera_matrix(frames[pauses[0]].camera))
    if not any(finding.stop for finding in found):
        looks = [Look(frames[p], grid, p) for p in pauses]
        found += [finding for look in looks for finding in unreadable(look.frame, f"frame {look.index}")]
    if not any(finding.stop for finding in found):
        found += [*_pose(looks[0]), *_units(looks[0]), *_outside(looks), *_moved(looks)]
        found += [*_registration(looks), *_repeated(looks)]
        for view in frames[pauses[0]].views:
            doubts = [*_camera_matrix(view.camera), *unreadable(view, "the image")]
            doubts = doubts or [*_pose(look := Look(view, grid)), *_units(look)]
            found += [Finding(False, f"one of the views: {doubt.message}", doubt.hints) for doubt in doubts]
    return sorted(found, key=lambda finding: not finding.stop)


def examine_next(first: Look, look: Look) -> list[Finding]:
    """Findings about a later pause of a stream: those of `examine`."""
    return [*unreadable(look.frame, f"frame {look.index}"), *_moved([first, look])]


def report_findings(findings: Iterable[Finding], where: str) -> None:
    """Raise InputError for a finding that stops a run; warn of the other findings. Messages begin with `where`."""
    for finding in sorted(findings, key=lambda finding: not finding.stop):
        if finding.stop:
            raise InputError(f"{where}: {finding.message}", *finding.hints)
        warn_user(f"{where}: {finding.message}", *finding.hints)


class Look:
    """Measurements in the frame at a pause, which the plausibility checks use."""

    def __init__(self, frame: Frame, grid: VoxelGrid, index: int = 0) -> None:
        self.index, self.grid, self.frame = index, grid, sampled(frame, 160)
        self.edges, self.corners = Edges(sampled(frame, 320)), Corners(sampled(frame, 640), grid)
        self.points = self.frame.points[self.frame.valid]

    @cached_property
    def on_table(self) -> np.ndarray:
        """(n,) bool: whether each depth reading is on the table."""
        return np.asarray(np.abs(self.points[:, 2]) < ON_TABLE)

    @property
    def everything(self) -> np.ndarray:
        """(n,) bool: all depth readings."""
        return np.ones(len(self.points), bool)

    @cached_property
    def table(self) -> Plane | None:
        """The plane of the table; None if no plane is found near z = 0."""
        return table_of(self.frame)


def _units(first: Look) -> Iterator[Finding]:
    """Findings about distances that are unusual for a camera over a table, in metres or in voxels."""
    depth, size = first.frame.depth[first.frame.valid], first.grid.voxel_size
    z = float(np.median(depth[first.on_table] if first.on_table.mean() > _MIN_ON_TABLE else depth))
    nearest, farthest = _VOXELS_IN_DISTANCE * size, float(np.sqrt(_NOISE_IN_VOXELS * size / depth_sigma(1.0)))
    text = f"the table is {z:.3g} m from the camera, expected {_DISTANCES[0]:g} to {_DISTANCES[1]:g} m"
    if not nearest <= z <= farthest:
        other = "larger" if z > farthest else "smaller"
        hint = f"if the distance is right, give a workspace with {other} voxels: theirs are {size:g} m"
        yield Finding(
            True, f"{text} and {nearest:.3g} to {farthest:.3g} m for voxels of {size:g} m", (_CHECK_SCALE, hint)
        )
    elif not _DISTANCES[0] <= z <= _DISTANCES[1]:
        yield Finding(False, text, (_CHECK_SCALE,))


def _camera_matrix(camera: Camera) -> Iterator[Finding]:
    """Findings about unusual focal lengths and principal points."""
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    width, height = camera.width, camera.height
    hint = "check K: it is in pixels of these images; scale it if they were resized"
    angle = float(np.degrees(2 * np.arctan(width / (2 * fx))))
    if not _FIELDS[0] <= angle <= _FIELDS[1]:
        text = (
            f"a focal length of {fx:.4g} pixels gives images of {width} pixels a field of view of {angle:.3g} degrees"
        )
        yield Finding(not _POSSIBLE_FIELDS[0] <= angle <= _POSSIBLE_FIELDS[1], text, (hint,))
    if not _ASPECTS[0] <= fx / fy <= _ASPECTS[1]:
        text = f"the focal lengths are {fx:.4g} and {fy:.4g} pixels, expected nearly equal ones"
        yield Finding(False, text, (hint,))
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


def unreadable(frame: Frame, which: str) -> Iterator[Finding]:
    """Findings about images that are empty, constant or fully masked. `which` names the frame in the messages."""
    depth = frame.depth[np.isfinite(frame.depth)]
    masked = 0.0 if frame.robot_mask is None else frame.robot_mask.mean()
    if not depth.size:
        hint = "0 and NaN are no reading; leave the frame out: another pause, or start_s and stop_s of a video"
        yield Finding(True, f"{which} has no reading at all in its depth image", (hint,))
    elif masked > 0.6 or not frame.valid.any():
        text = f"the robot mask of {which} covers {masked:.0%} of the image and most or all of its depth"
        yield Finding(masked > 0.95 or not frame.valid.any(), text, ("is the mask inverted? True is the robot",))
    elif np.ptp(depth) < 1e-6:
        text = f"all depth readings of {which} are {depth[0]:.3g} m"
        yield Finding(True, text, ("check that the depth images are those of the camera, in metres",))
    elif frame.rgb.mean(axis=2).std() < 4:
        text = f"the colour image of {which} is uniform"
        yield Finding(False, text, ("check that the colour images are 8-bit RGB, 0 to 255, and not covered",))


def _repeated(looks: Sequence[Look]) -> Iterator[Finding]:
    """A finding if the images at all pauses are identical."""
    if len(looks) > 1 and len({content_key(look.frame.rgb, look.frame.depth) for look in looks}) == 1:
        text = f"the images of all {len(looks)} pauses are identical, which no camera gives"
        yield Finding(False, text, ("check that every frame is read from its own file",))


def _pose(first: Look) -> Iterator[Finding]:
    """Findings if the depth readings at the first pause contradict the pose: their table is not at z = 0."""
    camera, table, free = first.frame.camera, first.table, plane_of(first.frame, first.everything)
    hints = (
        "check the pose: z of the world is up, the table is at z = 0; without a pose it is found from the table",
        "T_world_camera maps points of the camera to the world; is this the inverse?",
        f"check K: its focal length is {camera.K[0, 0] / camera.width:.3g} of the width of the images",
        _CHECK_SCALE,
    )
    if table is not None and (table.tilt > _MAX_TILT or abs(table.height) > _MAX_HEIGHT):
        text = f"the table in the depth image is tilted by {table.tilt:.1f} degrees and at z = {table.height:.3f} m"
        impossible = table.tilt > 2 * _MAX_TILT or abs(table.height) > 2 * _MAX_HEIGHT
        yield Finding(impossible, f"{text}, expected z = 0", hints)
    elif table is None and free is not None and (first.on_table.mean() < _MIN_ON_TABLE or free.tilt > 150):
        text = f"the largest plane is tilted by {free.tilt:.0f} degrees and at z = {free.height:.3f} m"
        yield Finding(True, f"no table is at z = 0: {text}, expected z = 0", hints)
    else:
        yield from _other_support(first)


def _other_support(first: Look) -> Iterator[Finding]:
    """Findings if a wall or the floor is at z = 0, and another plane is the table.

    The table of the depth image, found without the pose, is then not at z = 0 either. A table is parallel to the
    floor, and its height above the floor is larger than the height of an object. A table is at a right angle to a
    wall and extends far from the wall. In the image, the normal of a table points up, and that of a wall does not.
    """
    raised = first.points[:, 2] > ON_TABLE
    if raised.mean() < _MIN_ON_TABLE:
        return
    found = plane_of(first.frame)
    if found is not None and found.tilt < 2 * _MAX_TILT and abs(found.height) < 2 * _MAX_HEIGHT:
        return
    plane = plane_of(first.frame, raised)
    if plane is None:
        return
    hint = "or remove the depth readings beyond the table (NaN or 0), or turn the camera towards the table"
    level = plane if plane.tilt < 60 else _level(first)  # a wall may be larger than the table
    large = level is not None and (np.abs(first.points[:, 2] - level.height) < ON_TABLE).mean() > _MIN_ON_TABLE
    if level is not None and large and level.tilt < 15 and level.height > _TALL:
        text = f"the floor is taken for the table: a second plane is {level.height:.2f} m above z = 0"
        yield Finding(True, text, (_GIVE_POSE, hint))
    up = first.frame.camera.pose.rotation.inv().apply([0.0, 0.0, 1.0])
    tall = np.percentile(first.points[raised, 2], 98) > _TALL
    if 60 < plane.tilt < 120 and tall and up[1] > -0.1 and -plane.normal[1] > _UPRIGHT:
        text = f"a wall is taken for the table: another plane is tilted by {plane.tilt:.0f} degrees"
        yield Finding(True, text, (_GIVE_POSE, hint, "if the camera is upside down, turn the images by 180 degrees"))


def _level(first: Look) -> Plane | None:
    """The plane of the most frequent height above `_TALL`."""
    heights = first.points[:, 2]
    counts, edges = np.histogram(heights, np.arange(_TALL, np.clip(heights.max(), _TALL, 30.0) + 0.1, 0.05))
    k = counts.argmax()
    return plane_of(first.frame, (heights > edges[k] - 0.05) & (heights < edges[k + 1] + 0.05))


def _outside(looks: Sequence[Look]) -> Iterator[Finding]:
    """A finding if no reading at any pause is in the workspace, which the pose places."""
    grid = looks[0].grid
    if not any(grid.contains(grid.index_of(look.points)).any() for look in looks):
        low, high = grid.origin.round(2).tolist(), grid.upper.round(2).tolist()
        text = f"no depth reading is in the workspace from {low} to {high} m, so no object can be found"
        hint = "give a workspace around the objects, or none: it is then placed around the objects on the table"
        yield Finding(True, text, (hint, "check the pose: z of the world is up, the table is at z = 0"))


def drift(first: Look, look: Look) -> tuple[float, float, float]:
    """Tilt (degrees), height (m) and shift (m) of the camera relative to its given pose, between two pauses.

    Tilt and height are computed from a plane fitted to the table if few depth readings remain near z = 0, and are 0
    otherwise. The shift is measured at image corners on the table and outside the workspace.
    """
    tilt = height = shift = 0.0
    left = look.on_table.mean() / max(first.on_table.mean(), 1e-9)
    if first.table is not None and look.table is not None:
        tilt, height = look.table.tilt - first.table.tilt, abs(look.table.height - first.table.height)
        tilt, height = tilt if left < 0.8 else 0.0, height if left < 0.3 or tilt > 1 else 0.0
    still, moved, metres = first.corners.moved(look.corners)
    if moved >= MIN_MOVED and moved > 2 * still:
        shift = metres
    return tilt, height, shift


def _moved(looks: Sequence[Look]) -> Iterator[Finding]:
    """A finding if the camera is not at its given pose at a pause: for the first that stops, or for the farthest."""
    hints = (
        "fix the camera, or give its pose in every frame: T_world_camera of shape (T, 4, 4)",
        "poses of the camera map its points to the world, in metres; check that they belong to these frames",
    )
    first, largest, moved = looks[0], 1.0, ""
    for look in looks[1:]:
        if first.table and not look.table and look.on_table.mean() < _TABLE_LEFT * first.on_table.mean():
            text = f"frame {look.index} shows no table at z = 0, but frame {first.index} does"
            yield Finding(True, f"{text}: the camera or its pose is wrong", hints)
            return
        tilt, height, shift = found = drift(first, look)
        size = max(value / limit for value, limit in zip(found, _DRIFT, strict=True))
        if size > largest:
            largest = size
            moved = f"the camera moves from frame {first.index} to {look.index}, but not its pose: the table is "
            moved += (
                f"tilted by {tilt:.1f} degrees and {height:.3f} m higher, still corners are shifted by {shift:.3f} m"
            )
        if size > 2:
            break
    if moved:
        yield Finding(largest > 2, moved, hints)


def _registration(looks: Sequence[Look]) -> Iterator[Finding]:
    """A finding if the edges of the depth image and of the colour image of a pause are not at the same pixels.

    The grain of a wooden table agrees with edges of depth by chance at some shift. A finding must therefore hold in
    smoothed colour images too, in which the outlines of objects remain.
    """
    edges = [look.edges for look in looks]
    peak, lost, shift = edge_agreement(edges)
    if peak < _PEAK or lost <= _EXCESS or max(map(abs, shift)) <= 2:
        return
    if all(edge_agreement(edges, sigma)[1] > _COARSE_EXCESS for sigma in _SMOOTHING):
        down, right = (100 * pixels / edges[0].width for pixels in shift)
        text = (
            f"edges agree best {right:.1f} % of the image width further right and {down:.1f} % further down in colour"
        )
        hint = "align depth to colour when recording: each depth pixel belongs to the colour pixel above it"
        yield Finding(False, f"depth is not registered to colour: {text}", (hint,))

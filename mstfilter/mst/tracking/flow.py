"""Dense optical flow through a clip, computed once for all hypotheses.

Flow from the first frame directly to the last one fails for long motions, so it is accumulated over the frames of the
clip, in two forms:

- a grid of points of the first frame, followed forward, for rigid fits;
- a pull map, which has for every pixel of the last frame its position in the first one. A label image of
  ``clip.before``, indexed by the pull map, becomes that of ``clip.after``.

>>> tracks = DenseFlow().track(clip)                     # doctest: +SKIP
>>> labels_after = tracks.warp(project(hypothesis, clip.before.camera))   # doctest: +SKIP

A point or pixel is valid if the backward flow returns it to its start, its depth and colour do not jump, and it is
not on the robot.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from functools import cached_property
from typing import Literal
from weakref import WeakValueDictionary

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mstfilter.base.fields import Bounded
from mstfilter.base.processes import together
from mstfilter.mst.tracking.features import matched_colour, same_depth, smooth_colour
from mstfilter.scene import Clip, Frame, depth_sigma, fill_from_nearest, max_of_three, memo, scaled_length

_PRESETS = ("ultrafast", "fast", "medium")
# Lengths in pixels of an image of 640 columns, scaled by the width of the image.
_GRID = 2  # pixels between the rows and columns of the followed points
_ISOLATED = 3  # pixels, side of the smallest square of changed pixels of an object that is not noise
_N_VOTERS = 5
#: Frames are skipped until the motion since the last used frame reaches this fraction of the image width: errors
#: accumulate with the number of frames, but flow fails for long motions.
_FRAME_MOTION = 0.03
# Other lengths in pixels are those of an image of any size: noise, errors of the flow and its patches are per pixel.
_ROUND_TRIP = 1.0  # pixels, largest forward-backward error of a track
_DEPTH_JUMP = 0.03  # metres, largest change of depth of a track between consecutive frames
_COLOUR_JUMP = 30.0  # grey levels per channel, largest change of colour of a track between consecutive frames
_CHANGE_SIGMAS = 5.7  # smallest change of depth that is motion, in standard deviations of the noise of one reading
_COLOUR_CHANGE = 12.0  # smallest change of colour that is motion, grey levels in any channel
#: Pixels. Margin of the box beside the changed pixels. The corners of the box are multiples of the second number, so
#: that the patches of DIS are those of the whole image.
_MARGIN, _STEP = 24, 48


@dataclass(frozen=True, eq=False)
class ClipTracks:
    """Points and pixels followed through a clip."""

    start: np.ndarray  #: (N, 2) int32, pixel (column, row) of each point in the first frame
    end: np.ndarray  #: (N, 2) float32, its position in the last frame; undefined for lost points
    alive: np.ndarray  #: (N,) bool, whether the point was followed to the end and is not on the robot there
    #: (H, W) int32, flat pixel of the first frame for each pixel of the last frame; -1 for robot pixels.
    source: np.ndarray
    unchanged: np.ndarray  #: (H, W) bool, whether depth and colour agree between first and last frame

    def warp(self, labels: np.ndarray) -> np.ndarray:
        """A label image (H, W) of the first frame, moved to the last frame; 0 for robot pixels."""
        flat = np.append(labels.ravel(), labels.dtype.type(0))
        return flat[self.source]

    @cached_property
    def coherently_unchanged(self) -> np.ndarray:
        """(H, W) bool: `unchanged`, also True at isolated changed pixels, which are treated as noise."""
        return ~_opened(~self.unchanged, max(2, round(scaled_length(_ISOLATED, self.unchanged.shape[1]))))

    def points_in(self, mask: np.ndarray) -> np.ndarray:
        """Indices of the points that start inside a mask (H, W) and are valid until the end."""
        return np.flatnonzero(mask[self.start[:, 1], self.start[:, 0]] & self.alive)


@dataclass(frozen=True)
class DenseFlow(Bounded):
    """Dense inverse search flow (Kroeger et al., ECCV 2016; OpenCV's DIS), forward and backward.

    `preset` is that of OpenCV. With the region "changed", the flow between two frames is computed in a box around the
    pixels that changed, and is zero outside; with "image", it is computed in the whole image. It depends on the
    number of OpenCV's threads, so this becomes 1 in the whole process.
    """

    preset: Literal["ultrafast", "fast", "medium"] = "medium"
    region: Literal["changed", "image"] = "changed"

    def track(self, clip: Clip) -> ClipTracks:
        """Follow points and pixels through the clip, with the tracker of `begin` if it exists. Cached by content."""
        frames = list(clip.frames)
        keys = [f.key for f in frames]

        def compute() -> ClipTracks:
            tracker = _begun.pop((keys[0], self), None)
            if tracker is None or tracker.keys != keys[: len(tracker.keys)]:
                tracker = FlowTracker(frames[0], self)
            for frame in frames[len(tracker.keys) :]:
                tracker.add(frame)
            return tracker.finish()

        return memo("clip tracks", (tuple(keys), astuple(self)), compute, shared=True)

    def begin(self, first: Frame) -> FlowTracker:
        """A tracker for frames that arrive one by one. `track` uses it as long as the caller keeps a reference."""
        tracker = _begun[first.key, self] = FlowTracker(first, self)
        return tracker


class FlowTracker:
    """Computes the tracks of a clip while its frames arrive.

    Frames with little motion since the last used frame are skipped, except the last frame.
    """

    def __init__(self, first: Frame, settings: DenseFlow) -> None:
        height, width = first.depth.shape
        columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        self.keys, self.used = [first.key], [0]  #: content keys of the added frames; indices of the used ones
        self._settings = settings
        self._first = self._used = self._last = first
        self._small, self._moved = _small(first), 0.0
        step = max(1, round(scaled_length(_GRID, width)))
        followed = np.s_[::step, ::step]
        self._start = np.stack([columns[followed].ravel(), rows[followed].ravel()], axis=1)
        self._end = self._start.copy()
        self._alive = ~_robot(first)[followed].ravel()
        self._grid = np.stack([columns, rows], axis=-1)
        self._pull = self._grid.copy()  # position in the first frame of every pixel of the last used frame
        self._known = ~_robot(first)

    def add(self, frame: Frame) -> None:
        """Add the next frame. The previously added frame is used if the motion since the last used frame is large."""
        small, dis = _small(frame), cv2.DISOpticalFlow_create(_PRESETS.index("ultrafast"))  # type: ignore[attr-defined]
        _one_thread()
        flow = dis.calc(self._small, small, None)
        # The robot is excluded: it moves fast and is not tracked.
        speed = _speed(flow, self._last) / _SMALL_WIDTH
        if len(self.keys) > 1 and self._moved + speed > _FRAME_MOTION:
            self._use(self._last)
            self.used.append(len(self.keys) - 1)
            self._moved = 0.0
        self._moved += speed
        self._last, self._small = frame, small
        self.keys.append(frame.key)

    def finish(self) -> ClipTracks:
        """The tracks from the first to the last added frame. No frame can be added afterwards."""
        if len(self.keys) > 1:
            self._use(self._last)
        height, width = self._first.depth.shape
        u, v = _pixel(self._pull, width, height)
        source = np.where(self._known, v * width + u, -1).astype(np.int32)
        unchanged = _unchanged_pixels(self._first, self._last)
        return ClipTracks(self._start.astype(np.int32), self._end, self._alive, source, unchanged)

    def _use(self, current: Frame) -> None:
        """Follow points and pixels from the last used frame to the frame `current`."""
        previous, grid = self._used, self._grid
        height, width = current.depth.shape
        box, settled = np.s_[0:height, 0:width], np.zeros((height, width), bool)
        if self._settings.region == "changed":
            box, settled = _changed(previous, current)
        # Outside the box, points and pixels keep their positions.
        in_box = np.zeros((height, width), bool)
        in_box[box] = True
        flows = _flow(previous, current, self._settings.preset, box)
        u, v = _pixel(self._end, width, height)
        self._alive &= settled[v, u] | in_box[v, u]
        followed = np.flatnonzero(self._alive & in_box[v, u])
        self._end[followed], ok = _advance(self._end[followed], flows, box, previous, current)
        self._alive[followed] = ok
        # One step back to the previous frame, then the accumulated map.
        at = grid[box].reshape(-1, 2)
        back, ok = _advance(at, flows[::-1], box, current, previous)
        u, v = _pixel(back, width, height)
        pull, known = self._pull.copy(), settled & self._known
        pull[box] = (self._pull[v, u] + (back - grid[v, u])).reshape(pull[box].shape)  # keeps the subpixel part
        known[box] = (ok & self._known[v, u]).reshape(known[box].shape)
        same, robot = _unchanged_pixels(self._first, current), _robot(current)
        pull[same] = grid[same]
        uncertain = np.flatnonzero(~(known | same | robot))
        self._known = ~robot
        pull.reshape(-1, 2)[uncertain] = _vote(current, pull.reshape(-1, 2), (known | same).ravel(), uncertain)
        self._pull, self._used = pull, current


_begun: WeakValueDictionary[tuple[bytes, DenseFlow], FlowTracker] = WeakValueDictionary()
_SMALL_WIDTH = 160  # pixels per row of the images that decide which frames are used


def _small(frame: Frame) -> np.ndarray:
    """Grey image of `_SMALL_WIDTH` pixels per row."""
    factor = _SMALL_WIDTH / frame.depth.shape[1]
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def _speed(flow: np.ndarray, frame: Frame) -> float:
    """99.5th percentile of the flow length of pixels off the robot."""
    length = np.hypot(flow[..., 0], flow[..., 1])
    robot = cv2.resize(_robot(frame).astype(np.uint8), length.shape[::-1], interpolation=cv2.INTER_AREA)
    seen = length[cv2.dilate(robot, np.ones((5, 5), np.uint8)) == 0]
    return float(np.quantile(seen, 0.995)) if len(seen) else 0.0


def _one_thread() -> None:
    """Limit OpenCV to one thread, because the flow depends on the number of threads.

    The limit stays. To restore the number after each call would end and start OpenCV's threads again and again.
    """
    if cv2.getNumThreads() != 1:
        cv2.setNumThreads(1)


def _robot(frame: Frame) -> np.ndarray:
    return np.zeros(frame.depth.shape, bool) if frame.robot_mask is None else frame.robot_mask


def _changed(a: Frame, b: Frame) -> tuple[tuple[slice, slice], np.ndarray]:
    """Rows and columns of the box of the changed pixels, and the pixels (H, W) bool with a valid flow of zero.

    Isolated changed pixels are noise. Pixels of the robot are not considered.
    """
    seen = ~(_robot(a) | _robot(b))
    jump, colour = np.abs(b.depth - a.depth), max_of_three(np.abs(smooth_colour(b) - smooth_colour(a)))
    # At edges, depth has more noise than colour.
    changed = _opened(seen & (jump > _CHANGE_SIGMAS * depth_sigma(a.depth)), 3)
    changed |= seen & (colour > _COLOUR_CHANGE)
    changed = _opened(changed, 2)
    settled = seen & ~(jump > _DEPTH_JUMP) & (colour <= _COLOUR_JUMP)
    # In a shorter box, DIS uses fewer scales than in the whole image, and long motions are lost.
    longest = max(changed.shape)
    least = 32 * 2 ** (int(np.log2(longest / 32) + 0.5) - 0.5)
    sides = []
    for axis, n in enumerate(changed.shape):
        where = np.flatnonzero(changed.any(axis=1 - axis))
        if not len(where):
            return np.s_[0:0, 0:0], settled
        side = int(np.ceil(least if n == longest else 0.36 * least))
        lower = max(min(int(where[0]) - _MARGIN, n - side), 0) // _STEP * _STEP
        upper = max(int(where[-1]) + 1 + _MARGIN, lower + side)
        sides.append(slice(lower, min(-(-upper // _STEP) * _STEP, n)))
    return (sides[0], sides[1]), settled


def _opened(mask: np.ndarray, side: int) -> np.ndarray:
    """The parts of a mask (H, W) bool that contain a square of `side` pixels."""
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)) > 0


def _flow(a: Frame, b: Frame, preset: str, box: tuple[slice, slice]) -> tuple[np.ndarray, np.ndarray]:
    """The flow a -> b and the flow b -> a in a box of rows and columns, (h, w, 2) pixels."""
    grey = [np.ascontiguousarray(cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY)[box]) for f in (a, b)]
    if not grey[0].size:
        return (np.zeros((1, 1, 2), np.float32),) * 2

    def between(first: int, second: int) -> np.ndarray:
        dis = cv2.DISOpticalFlow_create(_PRESETS.index(preset))  # type: ignore[attr-defined]
        return np.asarray(dis.calc(grey[first], grey[second], None))

    _one_thread()
    return together(lambda: between(0, 1), lambda: between(1, 0))


def _sample(field: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Bilinear samples (N, 2) of a field (H, W, 2) at points (N, 2); the border is repeated."""
    # OpenCV's images have at most 32767 rows: reshape the list of points to an image.
    folded = np.zeros((len(at) // 1024 + 1, 1024, 2), np.float32)
    folded.reshape(-1, 2)[: len(at)] = at
    sampled = cv2.remap(field, folded, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled.reshape(-1, 2)[: len(at)]


def _advance(
    at: np.ndarray, flows: tuple[np.ndarray, ...], box: tuple[slice, slice], a: Frame, b: Frame
) -> tuple[np.ndarray, np.ndarray]:
    """Move points in a box from frame a to frame b. Returns their positions (N, 2) and whether they are valid (N,).

    `flows` are the flow a -> b and the flow b -> a in the box.
    """
    height, width = a.depth.shape
    corner = np.array([box[1].start, box[0].start], np.float32)
    moved = at + _sample(flows[0], at - corner)
    returned = moved + _sample(flows[1], moved - corner)
    # Operations over columns are several times faster than reductions over axes of two or three elements.
    x, y = moved.T
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    dx, dy = (returned - at).T
    ok = inside & (dx**2 + dy**2 < _ROUND_TRIP**2)
    ua, va = _pixel(at, width, height)
    ub, vb = _pixel(moved, width, height)
    jump = np.abs(b.depth[vb, ub] - a.depth[va, ua])
    ok &= ~(jump > _DEPTH_JUMP)  # a missing reading (NaN) is not a jump
    ok &= max_of_three(np.abs(smooth_colour(b)[vb, ub] - smooth_colour(a)[va, ua])) <= _COLOUR_JUMP
    ok &= ~_robot(b)[vb, ub] & ~_robot(a)[va, ua]
    return moved, ok


def _pixel(at: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    u = np.clip(np.rint(at[..., 0]), 0, width - 1).astype(np.int32)
    v = np.clip(np.rint(at[..., 1]), 0, height - 1).astype(np.int32)
    return u, v


def _unchanged_pixels(first: Frame, last: Frame) -> np.ndarray:
    """Whether each pixel has the same content in the first and last frame, (H, W) bool.

    The content is the same if two conditions hold. Depth differs by at most four standard deviations of the
    difference. After blur and exposure matching, colour differs by at most 12 grey levels in every channel. Pixels
    that show the robot or have no depth count as changed.
    """
    change = max_of_three(np.abs(smooth_colour(first) - matched_colour(last, first)))
    return same_depth(first, last) & (change <= 12.0)


def _vote(frame: Frame, pull: np.ndarray, known: np.ndarray, uncertain: np.ndarray) -> np.ndarray:
    """Positions in the first frame (D, 2) of pixels without valid flow.

    Each pixel takes the position of one of its five nearest valid pixels, the one whose motion is most similar to the
    other four. The nearest pixels have the smallest combined distance in space and colour. A distance of 12 mm, or of
    6 pixels in a frame without depth, equals 20 grey levels.
    """
    height, width = frame.depth.shape
    if not len(uncertain) or not known.any():
        return pull[uncertain]
    # Only valid pixels within 12 pixels of an uncertain one are voters.
    image = np.zeros((height, width), np.uint8)
    image.ravel()[uncertain] = 1
    nearby = cv2.dilate(image, np.ones((25, 25), np.uint8)) > 0
    candidates = np.flatnonzero(nearby.ravel() & known)
    if len(candidates) > 20000:  # every other row and column is sufficient
        rows, columns = np.divmod(candidates, width)
        candidates = candidates[(rows % 2 == 0) & (columns % 2 == 0)]
    if len(candidates) < _N_VOTERS:
        candidates = np.flatnonzero(known)
    pixels = np.concatenate([candidates, uncertain])
    rows, columns = np.divmod(pixels, width)
    finite = np.isfinite(frame.depth)
    if finite.any():
        depth, pose = fill_from_nearest(frame.depth, ~finite), frame.camera.pose.as_matrix()
        rays = frame.camera.rays()[rows, columns] @ pose[:3, :3].T
        place = (rays * depth[rows, columns, None] + pose[:3, 3]) / 0.012
    else:
        place = np.stack([columns, rows], axis=1) / 6.0
    features = np.hstack([place, smooth_colour(frame)[rows, columns] / 20.0])
    tree = cKDTree(features[: len(candidates)], balanced_tree=False, compact_nodes=False)
    _, found = tree.query(features[len(candidates) :], k=min(_N_VOTERS, len(candidates)), eps=0.5)
    voters = candidates[np.asarray(found).reshape(len(uncertain), -1)]
    # The voter whose motion is closest to the others (distances capped at 4 pixels). The pixel takes the position of
    # that voter in the first frame, not the motion: at an uncovered pixel of the resting table the first frame shows
    # the object.
    rows, columns = np.divmod(voters.T, width)
    offsets = list(zip(pull[voters.T, 0] - columns, pull[voters.T, 1] - rows, strict=True))
    # Operations over long axes are several times faster than those over axes of five elements.
    apart = [sum(np.minimum(np.abs(a - x) + np.abs(b - y), 4.0) for x, y in offsets) for a, b in offsets]
    return pull[voters[np.arange(len(uncertain)), np.argmin(apart, axis=0)]]

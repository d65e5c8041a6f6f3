"""Frames of a camera, filtered while they arrive.

>>> with mstfilter.Stream(K) as stream:
...     for rgb, depth in camera:
...         stream.push(rgb, depth)                 # returns within milliseconds
...     stream.wait()
...     stream.hypotheses, stream.belief

`push` only queues a frame. One thread looks for pauses and follows the optical flow of the clip that is being
recorded; another filters the last complete clip. The hypotheses are the same as those of a run on the recorded frames
with the same pauses.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time as clock
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError, check_component, check_integer, warn_user
from mstfilter.base.processes import parallel
from mstfilter.base.registry import nested_components
from mstfilter.formats import Settled
from mstfilter.mst.belief import Belief, ObjectTable
from mstfilter.mst.tracking import DenseFlow
from mstfilter.runs.presets import preset
from mstfilter.scene import (
    WORKING_PIXELS,
    Camera,
    Clip,
    Frame,
    Hypothesis,
    Look,
    VoxelGrid,
    check_depth,
    examine,
    examine_next,
    find_world,
    render_hypothesis,
    report_findings,
    rigid_from_matrix,
    scene_cache,
)
from mstfilter.smc import Info, ParticleFilter, State


@dataclass(frozen=True, eq=False)
class Pause:
    """The result at one pause of a stream."""

    index: int  #: number of the pause, from 0
    clip: Clip  #: the frames since the previous pause
    frames: tuple[int, ...]  #: numbers of these frames among all pushed frames
    state: State  #: the state of the filter
    info: Info  #: the record of the step
    latency_s: float  #: seconds from the push of the last frame to the result
    #: Numbers of frames so far: "pushed"; dropped for the reasons "late", "ahead" (a stamp far ahead), "no depth" or
    #: "overflow" (the queue is full); "thinned", which are removed from a long clip.
    counts: dict[str, int]

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """The hypotheses at this pause."""
        assert self.state.population is not None
        return tuple(self.state.population.particles)


_FAR_BEHIND_S = 1.0  # a frame that is later than this is not late: the clock was set, or a stamp is wrong
_FAR_AHEAD_S = 86_400.0  # no camera skips a day, unless the program waits as long


@dataclass(frozen=True, eq=False)
class _Item:
    number: int
    frame: Frame
    time: float
    pause: bool | None
    arrived: float


class Stream:
    """Filters the frames of a camera while they arrive. After every pause, it has new hypotheses.

    Parameters
    ----------
    camera : Camera, (3, 3) array or four numbers
        The camera, or its intrinsics in pixels: the matrix, or fx, fy, cx, cy.
    filter : ParticleFilter or str
        The filter, or the name of a preset.
    pauses : Settled or None
        The rule that finds the pauses. With None, only frames that are pushed with ``pause=True`` are pauses.
    grid : VoxelGrid or float
        Workspace, or the size of its voxels in metres. With a size, the workspace is found at the first pause, as for
        a recording. A camera without a pose gets one from the support plane of the first pause.
    seed : int
        Seed of all random streams.
    on_pause : callable, optional
        Called with a `Pause` after each step, in the thread of the filter.
    max_frames : int
        Most frames that wait in the queue, and most frames of a clip. See Notes.
    max_pixels : int
        Images with more pixels are reduced to this number. 0 means no limit.
    threads : int
        Number of threads of one step; the results do not depend on it.

    Notes
    -----
    A filter that is slower than the camera loses frames instead of falling behind: if `max_frames` frames are queued,
    new ones are dropped, and from a clip that reaches `max_frames`, frames with little motion are removed. `counts`
    says how many. At most four times `max_frames` frames are in memory.

    If an exception such as Ctrl-C leaves the ``with`` block, the step that is being computed is completed, and the
    queued frames are dropped. An error in a thread is raised by the next call of `push`, `wait` or `close`.
    """

    def __init__(
        self,
        camera: Camera | np.ndarray,
        filter: ParticleFilter | str = "mst",
        *,
        pauses: Settled | None = Settled(),  # noqa: B008
        grid: VoxelGrid | float = 0.01,
        seed: int = 0,
        on_pause: Callable[[Pause], Any] | None = None,
        max_frames: int = 150,
        max_pixels: int = WORKING_PIXELS,
        threads: int = 2,
    ) -> None:
        check_integer("max_frames", max_frames, at_least=4)
        check_integer("max_pixels", max_pixels, at_least=0)
        check_integer("threads", threads, at_least=1)
        check_component("pauses of a stream", pauses, Settled, optional=True)
        self._camera, self._grid = camera, grid
        self._filter = preset(filter) if isinstance(filter, str) else filter
        self._flows = [part for part in nested_components(self._filter) if isinstance(part, DenseFlow)]
        self._found = pauses.watch() if pauses is not None else lambda time, rgb: False
        self._state, self._on_pause = self._filter.start(seed), on_pause
        self._max, self._threads, self._max_pixels = max_frames, threads, max_pixels
        self._world: Camera | None = None  # the camera of the first pause
        self._shift: RigidTransform | None = None  # of the world of given poses, so that its table is at z = 0
        self._first: Look | None = None  # what the first pause shows
        self._reported: set[tuple[str, ...]] = set()
        self._clip: list[_Item] = []
        self._trackers: list[Any] = []
        self._n_pauses = 0
        self._last_time, self._last_arrived = -np.inf, 0.0
        self._clock_change = 0.0  # seconds from stamps to times of the stream
        self._strange: float | None = None  # the stamp of the frame before, if it was far from the last time
        self._posed: bool | None = None  # whether the frames have poses
        self._closing, self._closed = threading.Lock(), False
        self._abandoned = False  # whether an error or Ctrl-C ends the stream: queued frames are not filtered
        self._step: Future[None] | None = None
        self._error: BaseException | None = None
        self._table: tuple[int | None, ObjectTable] | None = None  # the last one that was asked for, and its pause
        self.last: Pause | None = None  #: the result at the last pause
        self.counts: Counter[str] = Counter()  #: see `Pause.counts`
        self._queue: queue.Queue[_Item | None] = queue.Queue(max_frames)
        self._pool = ThreadPoolExecutor(1, f"mstfilter-step-{id(self)}")
        self._watcher = threading.Thread(target=self._watch, name="mstfilter-stream", daemon=True)
        self._watcher.start()

    def push(
        self,
        rgb: np.ndarray,
        depth: np.ndarray | None,
        time: float | None = None,
        pose: np.ndarray | RigidTransform | None = None,
        robot_mask: np.ndarray | None = None,
        pause: bool | None = None,
        wait: bool = False,
    ) -> bool:
        """Add a frame. The images are copied.

        Parameters
        ----------
        rgb : (H, W, 3) uint8
            Colour image.
        depth : (H, W) float or None
            Depth in metres, registered to the colour image.
        time : float, optional
            Time stamp in seconds. The default is the time of the call.
        pose : (4, 4) array or RigidTransform, optional
            T_world_camera of this frame, if the camera moves.
        robot_mask : (H, W) bool, optional
            Pixels that show the robot.
        pause : bool, optional
            Whether the frame is a pause, which ends a clip. By default, the rule `pauses` decides.
        wait : bool
            If the queue is full, wait for a place instead of dropping the frame.

        Returns
        -------
        bool
            Whether the frame was accepted. It is dropped, and counted in `counts`, if it has no depth, if its time
            stamp is not later than the one before, or if the queue is full. If a stamp is far ahead or the clock was
            set, one frame is dropped, and the times of the stream continue from the last one.

        Raises
        ------
        InputError
            If the images are invalid, the stream is closed, or a thread of the stream has failed.
        """
        arrived = clock.perf_counter()
        if wait:
            self._check_caller("push(wait=True)")
        self._check()
        self._check_open()
        number, stamp = self.counts["pushed"], arrived if time is None else float(time)
        self.counts["pushed"] += 1
        if not np.isfinite(stamp):
            raise InputError(f"time of frame {number} is {stamp}, expected seconds")
        if np.ndim(rgb) != 3:
            raise InputError(f"colour image of frame {number} has shape {np.shape(rgb)}, expected (H, W, 3)")
        if depth is None or not np.any(np.isfinite(depth) & (np.asarray(depth) > 0)):
            return self._dropped("no depth", number, pause)
        ascending, why = self._ascending(number, stamp, arrived)
        if why:
            return self._dropped(why, number, pause)
        if self._queue.full() and not wait:  # before the images are copied
            return self._dropped("overflow", number, pause)
        known = self._camera
        if not isinstance(known, Camera):
            known = Camera(known, np.shape(rgb)[1], np.shape(rgb)[0])
        camera = known
        if self._posed not in (None, pose is not None):
            text = f"frame {number} has {'a' if self._posed is False else 'no'} pose, unlike the frames before"
            raise InputError(text, "give the pose of every frame, or of none; leave out a frame without a known pose")
        if pose is not None:
            rigid = pose if isinstance(pose, RigidTransform) else rigid_from_matrix(pose, f"pose of frame {number}")
            camera = camera.at(rigid)
        elif camera.T_world_camera is None:
            camera = camera if self._world is None else camera.at(self._world.pose)
        frame = Frame(np.array(rgb), depth, camera, None if robot_mask is None else np.array(robot_mask))
        check_depth(frame.depth, f"depth image of frame {number}")
        frame = frame.resized(camera.limited(self._max_pixels))
        while True:
            with self._closing:  # which is never held while a thread waits for a place in the queue
                self._check_open()
                if not self._queue.full():
                    self._queue.put(_Item(number, frame, ascending, pause, arrived))
                    break
            if not wait:
                return self._dropped("overflow", number, pause)
            clock.sleep(0.002)
        self._last_time, self._last_arrived = ascending, arrived
        self._camera, self._posed = known, pose is not None
        return True

    def _ascending(self, number: int, stamp: float, arrived: float) -> tuple[float, str]:
        """The time of a frame in the stream, and why the frame is dropped, if it is.

        A stamp that is far from the last one is wrong, or the clock was set. The next frame tells: if its stamp
        follows, the times of the stream continue from the last one.
        """
        before, self._strange = self._strange, None
        step = stamp + self._clock_change - self._last_time
        if 0 < step <= max(_FAR_AHEAD_S, 2 * (arrived - self._last_arrived)) or self._last_time == -np.inf:
            return stamp + self._clock_change, ""
        if -_FAR_BEHIND_S <= step <= 0:
            return 0.0, "late"
        if before is None or not 0 < stamp - before <= _FAR_AHEAD_S:
            self._strange = stamp
            return 0.0, "late" if step < 0 else "ahead"
        warn_user(
            f"the times jump by {step:.6g} s at frame {number}: the clock was set, or an earlier time was wrong",
            "the times of the stream continue after the last frame; times of a clock that is not set are safer",
        )
        self._clock_change = self._last_time - before
        return self._last_time + (stamp - before), ""

    def _dropped(self, why: str, number: int, pause: bool | None = None) -> bool:
        if pause or (why != "no depth" and not self.counts[why]):
            hint = "every frame needs a depth image, and times have to ascend"
            if why == "overflow":
                hint = "the frames arrive faster than they are processed: push fewer, or push(..., wait=True)"
            text = f"frame {number} is dropped: {why}{', a given pause is lost' * bool(pause)}"
            warn_user(text, f"{hint}; the counts of dropped frames are in `counts`")
        self.counts[why] += 1
        return False

    @property
    def state(self) -> State:
        """The state of the filter after the last step."""
        return self._state

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """The hypotheses at the last pause; empty before the first pause."""
        return () if self.last is None else self.last.hypotheses

    @property
    def belief(self) -> Belief:
        """The belief at the last pause: weighted hypotheses, and all weighted segmentations of its image."""
        if self.last is None or self.last.state.population is None:
            raise InputError("the stream has had no pause yet", "push frames until nothing moves, and call wait()")
        return Belief.of_step(self.last.state, self.last.info)

    @property
    def objects(self) -> ObjectTable:
        """The table of objects at the last pause (`Belief.objects`), in which objects keep their numbers."""
        belief = self.belief
        if self._table is None or self._table[0] != belief.pause:
            previous = None if self._table is None else self._table[1]
            self._table = (belief.pause, belief.objects(previous=previous))
        return self._table[1]

    def wait(self) -> None:
        """Wait until all pushed frames are processed. Raises InputError in `on_pause`, which it would wait for."""
        self._check_caller("wait()")
        self._queue.join()
        if self._step is not None:
            with contextlib.suppress(Exception):  # raised by `_check`
                self._step.result()
        self._check()

    def close(self) -> None:
        """Process the queued frames, and end the threads. Raises InputError in `on_pause`."""
        self._check_caller("close()")
        with self._closing:
            first, self._closed = not self._closed, True
        if first:
            self._queue.put(None)
        self._watcher.join()
        self._pool.shutdown(cancel_futures=self._abandoned)
        self._check()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: Any) -> None:
        if kind is None:
            self.close()
        else:
            self._abandoned = True
            with contextlib.suppress(Exception):  # the first error is raised
                self.close()

    def _check_caller(self, name: str) -> None:
        if threading.current_thread().name.startswith(f"mstfilter-step-{id(self)}"):
            raise InputError(f"{name} of a stream is called in on_pause", "call it in the thread that pushes")

    def _check_open(self) -> None:
        if self._closed:
            raise InputError("the stream is closed", "make a new Stream")

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    # --- thread of the frames -----------------------------------------------------------------------------------
    def _watch(self) -> None:
        while (item := self._queue.get()) is not None:
            try:
                if self._error is None and not self._abandoned:
                    self._take(item)
            except BaseException as error:
                self._error = self._error or error
            finally:
                self._queue.task_done()
        self._queue.task_done()

    def _take(self, item: _Item) -> None:
        """Add a frame to the clip, and filter the clip if the frame is a pause."""
        found = self._found(item.time, item.frame.rgb)
        rests = found if item.pause is None else item.pause
        if self._world is None:
            if not rests:  # the first clip is the first pause alone
                return
            self._world, self._grid, self._shift = find_world(item.frame, self._grid)
        camera = item.frame.camera
        if camera.T_world_camera is None:
            item = replace(item, frame=replace(item.frame, camera=self._world))
        elif self._shift is not None:
            item = replace(item, frame=replace(item.frame, camera=camera.at(self._shift * camera.pose)))
        if rests and not self._clip:
            self._examine(item)  # an error ends the stream before the first step
        self._clip.append(item)
        for tracker in self._trackers:
            tracker.add(item.frame)
        if rests:
            first = len(self._clip) == 1
            self._end_clip()
            if not first:
                self._examine(item)
        elif len(self._clip) >= self._max:
            self._thin()

    def _examine(self, item: _Item) -> None:
        """Compare the frame of a pause with the first pause. A fault gives one warning, not one at every pause."""
        grid = self._grid
        assert isinstance(grid, VoxelGrid)
        look, first = Look(item.frame, grid, item.number), self._first
        found = examine([item.frame], [0], grid) if first is None else examine_next(first, look)
        self._first = first or look
        found = [one for one in found if one.stop or one.hints not in self._reported]
        self._reported.update(one.hints for one in found)
        report_findings(found, "stream")

    def _thin(self) -> None:
        """Remove the frames with little motion from the clip, then every second frame while the clip is too long."""
        used = self._trackers[0].used if self._trackers else range(0, len(self._clip), 2)
        kept = [self._clip[k] for k in used]
        while len(kept) > self._max // 2:
            kept = kept[::2]
        kept = kept if kept[-1] is self._clip[-1] else [*kept, self._clip[-1]]
        self.counts["thinned"] += len(self._clip) - len(kept)
        self._clip = kept
        self._track()

    def _track(self) -> None:
        """Restart the optical-flow trackers at the first frame of the current clip."""
        self._trackers = [flow.begin(self._clip[0].frame) for flow in self._flows]
        for tracker in self._trackers:
            for item in self._clip[1:]:
                tracker.add(item.frame)

    def _end_clip(self) -> None:
        if self._step is not None:
            self._step.result()  # at most one complete clip waits
        if self._abandoned:
            return
        items, trackers = tuple(self._clip), tuple(self._trackers)
        frames, times = tuple(item.frame for item in items), tuple(item.time for item in items)
        assert isinstance(self._grid, VoxelGrid)
        clip = Clip(frames, self._grid, self._n_pauses, times)
        self._n_pauses += 1
        self._step = self._pool.submit(self._filter_clip, clip, items, trackers)
        self._clip = [items[-1]]
        self._track()

    # --- thread of the filter -----------------------------------------------------------------------------------
    def _filter_clip(self, clip: Clip, items: tuple[_Item, ...], trackers: tuple[Any, ...]) -> None:
        """Filter a clip. The argument `trackers` keeps the tracked flow in memory until the filter uses the flow."""
        try:
            with parallel(self._threads):
                self._state, info = self._filter.step(self._state, clip)
            scene_cache.forget()
            latency = clock.perf_counter() - items[-1].arrived
            numbers = tuple(item.number for item in items)
            self.last = Pause(clip.index, clip, numbers, self._state, info, latency, dict(self.counts))
            if self._on_pause is not None:
                self._on_pause(self.last)
            if self._flows:
                for hypothesis in self.hypotheses:  # cached, since the next step tracks what is visible now
                    render_hypothesis(hypothesis, clip.after.camera)
        except BaseException as error:
            self._error = self._error or error

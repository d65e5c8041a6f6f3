"""Pauses of a video (times at which nothing moves), and rules that find pauses.

>>> pauses_from_text("still"), pauses_from_text("0,40,85"), pauses_from_text("0s,4.2s")

A clip goes from one pause to the next. At a pause, neither the robot nor a hand should be in the image. Only
recording folders in the layout of mstfilter store their pauses. For other layouts, a rule of this module finds the
pauses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from numbers import Integral
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import NonNegativeFloat, PositiveInt
from mstfilter.scene import PauseRule, grey_blocks


@dataclass(frozen=True)
class Ends(PauseRule):
    """The first and the last frame are the pauses, with one clip between the two pauses."""

    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        return tuple(sorted({0, len(times) - 1}))


@dataclass(frozen=True)
class EveryNth(PauseRule):
    """Every n-th frame is a pause, for single images of a scene that changes between the images."""

    n: PositiveInt = 1

    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        return tuple(range(0, len(times), self.n))


@dataclass(frozen=True)
class At(PauseRule):
    """Pauses at given frame indices (negative: from the end) or at given times in seconds since the first frame."""

    frames: tuple[int, ...] = ()
    seconds: tuple[float, ...] = ()

    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        n, since = len(times), np.asarray(times) - times[0]
        if not self.frames and not self.seconds:
            raise InputError("no pause is given", "give frames or seconds")
        wrong = [i for i in self.frames if not (isinstance(i, Integral) and -n <= i < n)]
        if wrong:
            raise InputError(f"pause at frame {wrong[0]}: the video has {n} frames, 0 to {n - 1}")
        late = [s for s in self.seconds if not -0.5 <= s <= since[-1] + 0.5]
        if late:
            raise InputError(f"pause at {late[0]:g} s: the video lasts from 0 to {since[-1]:.1f} s")
        nearest = [int(np.abs(since - s).argmin()) for s in self.seconds]
        return tuple(sorted({*(i % n for i in self.frames), *nearest}))


def _numbers(words: list[str]) -> dict[str, Any]:
    try:
        return {
            "frames": tuple(int(w) for w in words if not w.endswith("s")),
            "seconds": tuple(float(w.removesuffix("s")) for w in words if w.endswith("s")),
        }
    except ValueError as error:
        raise InputError(
            f"pauses are {' '.join(words)!r}: {error}", "frame indices 0,40,85 or seconds 0s,4.2s"
        ) from error


def pauses_from_text(text: str) -> dict[str, Any]:
    """The configuration of a pause rule, from a text with the frames or times of pauses or the name of a rule."""
    words = text.replace(",", " ").split()
    if words and ".py:" not in text and all(w[0].isdigit() or w[0] in "-." for w in words):
        return {"component": "at", **{k: v for k, v in _numbers(words).items() if v}}
    return {"component": text}


_SHARE = 0.001  # largest share of blocks that differ without motion
_MAX_LEVELS = 4.0  # largest threshold of a block in units of `levels`, also if the block never rests


def _changes(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Absolute difference between the change of each block from `a` to `b` and the median change of all blocks."""
    difference = b - a
    return np.abs(difference - np.median(difference))


@dataclass(frozen=True)
class Still(PauseRule):
    """Middle frames of the intervals in which the image does not change, for a camera that does not move.

    Images are reduced to blocks of grey levels. Two images differ if more than 0.1 % of the blocks change by more
    than their noise. A still interval is a sequence of frames that do not differ from the first frame of the
    sequence, so slow motion also ends an interval. Each interval of at least `hold_s` seconds gives one pause at its
    middle frame. Changes that all blocks share (exposure, flicker) are ignored. The noise of each block is measured
    in the video, so the scene must be at rest for a quarter of the video.

    An interval also gives a pause if a robot waits in the image, or moves and changes the image by less than a grey
    level. Check the pauses, and replace wrong pauses by explicit frame numbers.

    Parameters
    ----------
    hold_s : float
        Length in seconds of the shortest still interval that gives a pause.
    levels : float
        A block differs if its grey level (0 to 255) changes by more than `levels` and by more than 6 times the noise.
    region : tuple of 4 float
        Part of the image that is used: left, top, right, bottom as shares of width and height. The selected part can
        exclude people behind the table.
    """

    hold_s: NonNegativeFloat = 0.5
    levels: NonNegativeFloat = 3.0
    region: tuple[float, ...] = (0.0, 0.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        left, top, right, bottom = self.region if len(self.region) == 4 else (1, 1, 0, 0)
        if not (0 <= left < right <= 1 and 0 <= top < bottom <= 1):
            raise InputError(f"region is {self.region}, expected left, top, right, bottom from 0 to 1")

    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        found = self._found(times, read_rgb)
        if not found:
            raise InputError(
                f"no pause found: in {len(times)} frames ({times[-1] - times[0]:.1f} s) the image is never still for "
                f"{self.hold_s:g} s",
                "if the camera moves, give the pauses: --pauses 0,40,85 (frames) or 0s,4.2s",
                "if people or shadows move, use a part of the image: -o pauses.region=0.2,0.1,0.8,0.9",
                "accept shorter intervals: -o pauses.hold_s=0.2; or use the first and last frame: --pauses ends",
                'in Python pauses=(0, 40, 85), pauses="ends" or a rule, pauses=Still(hold_s=0.2)',
            )
        return found

    def _found(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        return tuple((first + last) // 2 for first, last in self.intervals(times, read_rgb))

    def intervals(
        self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]
    ) -> tuple[tuple[int, int], ...]:
        """First and last frame of each still interval."""
        images = [self._part(grey_blocks(read_rgb(index))) for index in range(len(times))]
        if len({image.shape for image in images}) > 1:
            raise InputError(f"images differ in size: {sorted({image.shape for image in images})} blocks")
        if len(images) == 1:
            return ((0, 0),)
        changes = np.stack([_changes(a, b) for a, b in pairwise(images)])
        limit, allowed = self._limit(changes), _SHARE * images[0].size
        runs, first = [], 0
        for index in range(1, len(images) + 1):
            if index < len(images) and (_changes(images[first], images[index]) > limit).sum() <= allowed:
                continue
            runs.append((first, index - 1))
            first = index
        return tuple((a, b) for a, b in runs if b > a and times[b] - times[a] >= self.hold_s - 1e-9)

    def _part(self, blocks: np.ndarray) -> np.ndarray:
        """The blocks (h, w) inside `region`."""
        h, w = blocks.shape
        left, top, right, bottom = self.region
        return blocks[int(top * h) : int(np.ceil(bottom * h)), int(left * w) : int(np.ceil(right * w))]

    def _limit(self, changes: np.ndarray) -> np.ndarray:
        """Change (h, w) in grey levels above which a block differs: a multiple of the block's noise at rest.

        `changes` (n, h, w) are the changes between consecutive images.
        """
        quarter = np.quantile(changes, 0.25, axis=0) / 0.3186  # the quartile of |x| for a standard normal x is 0.3186
        overall = 1.4826 * np.quantile(np.median(changes, axis=(1, 2)), 0.25)
        limit = np.clip(6 * np.maximum(quarter, overall), self.levels, None)
        bounded: np.ndarray = np.minimum(limit, max(_MAX_LEVELS * self.levels, 6 * overall))
        return bounded


@dataclass(frozen=True)
class Settled(Still):
    """Frames at which the image has been still for `hold_s` seconds. They are found while frames arrive.

    The parameters are the same as in `Still`. Each pause is the frame at which a still interval reaches a length of
    `hold_s` seconds. The noise is measured in the last hundred frames. A pause depends on earlier frames only, so a
    stream and its recording have the same pauses.
    """

    def watch(self) -> Callable[[float, np.ndarray], bool]:
        """A function of time and colour image of the next frame, which returns whether this frame is a pause."""
        changes = deque[np.ndarray](maxlen=_RECENT)
        first = last = None  # images of the first frame of the interval and of the last frame
        began, found = 0.0, False

        def add(time: float, rgb: np.ndarray) -> bool:
            nonlocal first, last, began, found
            image = self._part(grey_blocks(rgb))
            if last is not None and image.shape != last.shape:
                raise InputError(f"images differ in size: {last.shape} and {image.shape} blocks")
            if last is not None:
                changes.append(_changes(last, image))
            last = image
            if first is None or (_changes(first, image) > self._limit(np.stack(changes))).sum() > _SHARE * image.size:
                first, began, found = image, time, False
                return False
            if found or time - began < self.hold_s - 1e-9:
                return False
            found = True
            return True

        return add

    def _found(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        add = self.watch()
        return tuple(index for index, time in enumerate(times) if add(time, read_rgb(index)))


_RECENT = 100  # changes between frames in which `Settled` measures the noise

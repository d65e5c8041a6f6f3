"""Pauses found by image motion.

>>> Still(hold_s=0.5).find(times, read_rgb)
(7, 64, 131)

The rule, for a camera that stands still: images become grey blocks; two images differ where a block changes by more
than its noise, and there is motion where more than a small share of the blocks differ. A still interval is a run of
frames in which none differs from the first, so slow motion adds up. Each interval of at least `hold_s` seconds gives
one pause, its middle frame. Changes that all blocks share (exposure, flicker of the light) do not count. The noise of
each block is measured on the video itself (edges shimmer more than planes): a quarter of it has to be at rest.

A robot that holds still within the picture, or that works slower than a grey level in a whole interval, looks like a
pause too: look at the pauses found, and name them yourself where they are wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mstfilter.errors import InputError
from mstfilter.formats.pauses import PauseRule

__all__ = ["Still", "grey_blocks"]

_ACROSS = 80  # blocks
_MOST = 4.0  # times `levels`: a block that never rests must not hide motion


def grey_blocks(rgb: np.ndarray) -> np.ndarray:
    """Mean grey level of square blocks, about 80 across: (h, w) float32 of an image (H, W, 3)."""
    grey = np.asarray(rgb, dtype=np.float32).mean(axis=2)
    side = max(1, grey.shape[1] // _ACROSS)
    h, w = grey.shape[0] // side, grey.shape[1] // side
    return grey[: h * side, : w * side].reshape(h, side, w, side).mean(axis=(1, 3))


def _changes(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(...) absolute change of each block from a to b less what all share."""
    difference = b - a
    return np.abs(difference - np.median(difference))


@dataclass(frozen=True)
class Still(PauseRule):
    """Middle frames of the intervals in which the image does not change.

    Parameters
    ----------
    hold_s : float
        Shortest interval, in seconds.
    share : float
        More blocks than this share that differ are motion.
    levels : float
        A block differs from here on, in grey levels of 255, or from six times its noise if that is more.
    region : tuple of 4 float
        Part of the image that is looked at: left, top, right, bottom as shares of its width and height. Leaves out
        people behind the table.
    """

    hold_s: float = 0.5
    share: float = 0.001
    levels: float = 3.0
    region: tuple[float, ...] = (0.0, 0.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if len(self.region) != 4:
            raise InputError(f"region has {len(self.region)} numbers, expected left, top, right, bottom from 0 to 1")

    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        """See `PauseRule`."""
        intervals = self.intervals(times, read_rgb)
        if not intervals:
            raise InputError(
                f"no pause found: nowhere in {len(times)} frames ({times[-1] - times[0]:.1f} s) does the image hold "
                f"still for {self.hold_s:g} s",
                "does the camera move? name the pauses: --pauses 0,40,85 (frames) or --pauses 0s,4.2s",
                "does something else move (people, shadows)? look at a part: -o pauses.region=0.2,0.1,0.8,0.9",
                "a shorter interval: -o pauses.hold_s=0.2; first and last frame only: --pauses ends",
            )
        return tuple((first + last) // 2 for first, last in intervals)

    def intervals(
        self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]
    ) -> tuple[tuple[int, int], ...]:
        """First and last frame of each still interval."""
        images = [self._part(grey_blocks(read_rgb(index))) for index in range(len(times))]
        if len({image.shape for image in images}) > 1:
            raise InputError(f"images differ in size: {sorted({image.shape for image in images})} blocks")
        if len(images) == 1:
            return ((0, 0),)
        limit, allowed = self._limit(images), self.share * images[0].size
        runs, first = [], 0
        for index in range(1, len(images) + 1):
            if index < len(images) and (_changes(images[first], images[index]) > limit).sum() <= allowed:
                continue
            runs.append((first, index - 1))
            first = index
        return tuple((a, b) for a, b in runs if b > a and times[b] - times[a] >= self.hold_s - 1e-9)

    def _part(self, blocks: np.ndarray) -> np.ndarray:
        """The blocks of the region."""
        h, w = blocks.shape
        left, top, right, bottom = self.region
        part = blocks[int(top * h) : int(np.ceil(bottom * h)), int(left * w) : int(np.ceil(right * w))]
        if part.size == 0:
            raise InputError(f"region {self.region} of the image is empty", "left, top, right, bottom from 0 to 1")
        return part

    def _limit(self, images: list[np.ndarray]) -> np.ndarray:
        """Change (h, w) in grey levels from which a block differs: some multiples of its own noise at rest."""
        changes = np.stack([_changes(a, b) for a, b in pairwise(images)])
        quarter = np.quantile(changes, 0.25, axis=0) / 0.3186  # of |x| for x normal with deviation 1
        whole = 1.4826 * np.quantile(np.median(changes, axis=(1, 2)), 0.25)
        limit = np.clip(6 * np.maximum(quarter, whole), self.levels, None)
        most: np.ndarray = np.minimum(limit, max(_MOST * self.levels, 6 * whole))
        return most

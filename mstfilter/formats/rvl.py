"""RVL, the lossless code of depth images in the ROS transport ``compressedDepth``.

>>> pixels = decode_rvl(data, 640, 480, "a message")        # (480, 640) uint16

The stream alternates between runs of zeros and runs of readings: the length of each, then the differences between
readings that follow one another, also over the zeros between them. A difference d is stored as 2 d, or as -2 d - 1
if it is negative. Each of these numbers is a sequence of groups of 3 bits, the lowest group first, with a fourth bit
that is set if another group follows. Words of 32 bits hold 8 of them, the first one in the highest bits (Wilson,
"Fast lossless depth image compression", 2017).
"""

from __future__ import annotations

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.formats.images import MAX_PIXELS


def decode_rvl(data: bytes, width: int, height: int, where: str) -> np.ndarray:
    """The pixels (height, width) uint16 of an RVL stream."""
    fault = InputError(f"{where} is damaged: RVL of {width} x {height} pixels in {len(data)} bytes", "copy it again")
    n = width * height
    if not 0 < n <= MAX_PIXELS:
        raise fault
    values = _numbers(np.frombuffer(data, "<u4", len(data) // 4))
    shown, differences, pixel, k = np.zeros(n, dtype=bool), [], 0, 0
    while pixel < n:
        if k + 1 >= len(values):
            raise fault
        zeros, readings = int(values[k]), int(values[k + 1])
        begin, k = pixel + zeros, k + 2
        pixel = begin + readings
        if pixel > n or k + readings > len(values) or zeros + readings == 0:
            raise fault
        shown[begin:pixel] = True
        differences.append(values[k : k + readings])
        k += readings
    coded = np.concatenate(differences)
    pixels = np.zeros(n, np.uint16)
    pixels[shown] = np.cumsum((coded >> 1) ^ -(coded & 1)).astype(np.uint16)
    return pixels.reshape(height, width)


def _numbers(words: np.ndarray) -> np.ndarray:
    """The numbers (n,) int64 in words of 32 bits."""
    groups = (words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)).ravel() & 15
    ends = np.flatnonzero(groups < 8)
    if not len(ends):
        return np.zeros(0, np.int64)
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends + 1 - starts
    place = np.arange(ends[-1] + 1) - np.repeat(starts, lengths)
    parts = (groups[: ends[-1] + 1].astype(np.int64) & 7) << (3 * np.minimum(place, 20))
    return np.add.reduceat(parts, starts)

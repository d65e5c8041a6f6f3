"""Frames of a video file, such as rgb.mp4.

>>> movie = Movie(Path("scan/rgb.mp4"))
>>> movie[12]                                       # (H, W, 3) uint8, RGB, as stored: not turned
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.files import reading
from mstfilter.base.reading import open_regular


class Movie:
    """The frames of a video file, decoded in order. To go back, the file is decoded again from its beginning."""

    def __init__(self, path: Path) -> None:
        import cv2

        with reading(path, "a video"), open_regular(path, 2**63 - 1):
            self.path, self._next = path, 0
        self._last: tuple[int, Any] = -1, None
        self._open()
        self._n = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))

    def _open(self) -> None:
        import cv2

        self._capture, self._next = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG), 0
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # the depth images are not turned either
        if not self._capture.isOpened():
            hint = f"extract the frames: mkdir rgb; ffmpeg -i {self.path.name} -start_number 0 rgb/%06d.png"
            raise InputError(f"video cannot be decoded: {self.path}", hint)

    def __len__(self) -> int:
        return self._n

    def __getitem__(self, index: int) -> np.ndarray:
        if index == self._last[0]:
            return np.array(self._last[1])
        if index < self._next:
            self._open()
        done = True
        while done and self._next < index:
            done, self._next = self._capture.grab(), self._next + 1
        done, image = self._capture.read() if done else (False, None)
        if not done:
            hint = "copy it again; or, if it is complete, leave its end out: stop_s"
            raise InputError(f"video ends before frame {index}: {self.path} announces {self._n} frames", hint)
        self._next = index + 1
        self._last = index, np.ascontiguousarray(image[..., ::-1])
        return np.array(self._last[1])

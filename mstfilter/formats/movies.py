"""Frames of a video file, such as rgb.mp4.

>>> movie = Movie(Path("scan/rgb.mp4"))
>>> movie[12]                                       # (H, W, 3) uint8, RGB, as stored: not turned
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.files import reading
from mstfilter.base.reading import open_regular

_MOST = 10**7  # frames


class Movie:
    """The frames of a video file, decoded in order. To go back, the file is decoded again from its beginning."""

    def __init__(self, path: Path) -> None:
        import cv2

        with reading(path, "a video"), open_regular(path, 2**63 - 1):
            self.path = path
        self._open()
        self._n = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if not 0 < self._n < _MOST:
            raise InputError(f"video cannot be decoded: {path} announces {self._n} frames", "copy it again")

    def _open(self) -> None:
        import cv2

        self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # the depth images are not turned either
        self._position, self._image = -1, np.zeros(0)  # the last image that was decoded
        if not self._capture.isOpened():
            hint = f"extract the frames: mkdir rgb; ffmpeg -i {self.path.name} -start_number 0 rgb/%06d.png"
            raise InputError(f"video cannot be decoded: {self.path}", hint)

    def __len__(self) -> int:
        return self._n

    def __getitem__(self, index: int) -> np.ndarray:
        if index < self._position:
            self._open()
        while self._position < index:
            if not self._capture.grab():
                text = f"video ends before frame {index}: {self.path} announces {self._n} frames"
                raise InputError(text, "copy it again; or, if it is complete, leave its end out: stop_s")
            self._position += 1
            if self._position == index:
                self._image = self._capture.retrieve()[1][..., ::-1]
        return np.ascontiguousarray(self._image)

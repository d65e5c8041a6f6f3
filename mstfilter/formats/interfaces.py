"""What a reader of a layout is.

>>> reader = Tum(K=(525, 525, 319.5, 239.5))
>>> if reader.detects(path):
...     recording = reader.open(path)

To read a layout of your own, subclass `Format` in a file and name it: ``mstfilter convert IN OUT --format
./mine.py:Mine``. Its fields are options of the command line. A video is best built with
`mstfilter.formats.video.Video`, which does all checks; from arrays in memory `Recording.from_arrays` does so.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

from mstfilter.scene import Recording

__all__ = ["Format"]


class Format(ABC):
    """A layout of RGB-D data on disk. Subclasses are frozen dataclasses; their fields say what the files do not."""

    @classmethod
    @abstractmethod
    def detects(cls, path: Path) -> bool:
        """Whether a file or folder looks like this layout; looks at names only, raises nothing."""

    @abstractmethod
    def open(self, path: Path) -> Recording:
        """The recording. Images may be read when they are looked at; what is wrong raises one `InputError`."""

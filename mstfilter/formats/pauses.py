"""Where a video pauses: the rules that cut it into clips.

>>> pauses_from_text("still"), pauses_from_text("0,40,85"), pauses_from_text("0s,4.2s")

A clip goes from one pause to the next. At a pause nothing moves and, if possible, neither robot nor hand is in the
picture. Layouts other than our own do not say where that is. The rules: ``still`` (found by image motion, see
`mstfilter.formats.still`), ``at`` (given frames or seconds), ``listed`` (a text file of them), ``ends`` (first
and last frame), ``every`` (every frame is a pause: single shots of a scene that was changed in between).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.errors import InputError

__all__ = ["At", "Ends", "Every", "Listed", "PauseRule", "pauses_from_text"]


class PauseRule(ABC):
    """Finds the pauses of a video."""

    @abstractmethod
    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        """Ascending frame indices of the pauses.

        Parameters
        ----------
        times : tuple of float
            Seconds, one a frame.
        read_rgb : callable
            Colour image (H, W, 3) uint8 of a frame index.
        """


@dataclass(frozen=True)
class Ends(PauseRule):
    """First and last frame: one clip."""

    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        """See `PauseRule`."""
        return tuple(sorted({0, len(times) - 1}))


@dataclass(frozen=True)
class Every(PauseRule):
    """Every n-th frame is a pause: shots of a scene that was changed in between.

    Parameters
    ----------
    n : int
        1 is every frame.
    """

    n: int = 1

    def __post_init__(self) -> None:
        if self.n < 1:
            raise InputError(f"n is {self.n}, expected at least 1")

    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        """See `PauseRule`."""
        return tuple(range(0, len(times), self.n))


@dataclass(frozen=True)
class At(PauseRule):
    """Given frames or given times.

    Parameters
    ----------
    frames : tuple of int
        Indices from 0; negative ones count from the end.
    seconds : tuple of float
        Times since the first frame; the nearest frame is the pause.
    """

    frames: tuple[int, ...] = ()
    seconds: tuple[float, ...] = ()

    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        """See `PauseRule`."""
        n, since = len(times), np.asarray(times) - times[0]
        if not self.frames and not self.seconds:
            raise InputError("no pause is given", "give frames or seconds")
        wrong = [i for i in self.frames if not -n <= i < n]
        if wrong:
            raise InputError(f"pause at frame {wrong[0]}: the video has {n} frames, 0 to {n - 1}")
        late = [s for s in self.seconds if not -0.5 <= s <= since[-1] + 0.5]
        if late:
            raise InputError(f"pause at {late[0]:g} s: the video lasts from 0 to {since[-1]:.1f} s")
        nearest = [int(np.abs(since - s).argmin()) for s in self.seconds]
        return tuple(sorted({*(i % n for i in self.frames), *nearest}))


@dataclass(frozen=True)
class Listed(PauseRule):
    """A text file of frame indices, or of seconds with an ``s`` behind; ``#`` starts a comment.

    Parameters
    ----------
    file : str
        Path of the file.
    """

    file: str = "pauses.txt"

    def find(self, times: tuple[float, ...], read_rgb: Callable[[int], np.ndarray]) -> tuple[int, ...]:
        """See `PauseRule`."""
        try:
            lines = Path(self.file).read_text().splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"file of pauses cannot be read: {self.file} ({error})") from error
        words = [word for line in lines for word in line.partition("#")[0].replace(",", " ").split()]
        try:
            rule = At(**_numbers(words))
        except InputError as error:
            raise InputError(f"{self.file}: {error.message}", *error.hints) from error
        return rule.find(times, read_rgb)


def _numbers(words: list[str]) -> dict[str, Any]:
    """Fields of `At`."""
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
    """The configuration of a rule from what a user types: a rule's name, numbers, or the path of a file."""
    words = text.replace(",", " ").split()
    if words and all(w[0].isdigit() or w[0] in "-." for w in words):
        return {"component": "at", **{k: v for k, v in _numbers(words).items() if v}}
    if Path(text).is_file():
        return {"component": "listed", "file": text}
    return {"component": text}

"""A ROS 1 bag, ROS 2 bag or MCAP file with its messages at hand.

>>> bag = BagFile(Path("session.mcap"))
>>> bag.topics["/camera/color/image_raw"].count
>>> entries = bag.index("/camera/color/image_raw")      # stamp of each message, and where it is
>>> message = bag.message("/camera/color/image_raw", entries[3])

rosbags (extra ``bags``) reads them without ROS. Whatever it cannot read is one `InputError` with the file's name.
"""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError, MissingLibraryError

__all__ = ["BagFile", "Entry", "Topic"]


@dataclass(frozen=True)
class Topic:
    """A topic: its name, message type and number of messages."""

    name: str
    kind: str
    count: int

    @property
    def compressed(self) -> bool:
        """Whether its images are compressed."""
        return self.kind.endswith("/CompressedImage")


@dataclass(frozen=True)
class Entry:
    """A message: stamp of its header (s), when it was logged (ns), which of those logged then."""

    stamp: float
    logged: int
    ordinal: int


class BagFile:
    """An open bag. It is closed when nothing refers to it.

    Parameters
    ----------
    path : Path
        A .bag, .mcap or .db3 file, or the folder of a ROS 2 bag.
    """

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise MissingLibraryError(
                "bags and MCAP need rosbags, which is not installed", "pip install 'mstfilter[bags]'"
            ) from error
        self.path = path
        if not path.exists():
            raise InputError(f"bag does not exist: {path}")
        with self._reading():
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
            self._reader.open()
        weakref.finalize(self, _close, self._reader)
        self.is_ros2: bool = self._reader.is2
        self.topics: dict[str, Topic] = {
            c.topic: Topic(
                c.topic, str(c.msgtype), sum(x.msgcount for x in self._reader.connections if x.topic == c.topic)
            )
            for c in self._reader.connections
        }

    @contextlib.contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except InputError:
            raise
        except Exception as error:  # rosbags lets errors of storage and compression libraries through
            said = " ".join(str(error).split())[:160]  # one line
            raise InputError(
                f"bag cannot be read: {self.path} ({type(error).__name__}: {said})",
                "was it closed properly? copy it again, or mend it: rosbag reindex, ros2 bag reindex, mcap recover",
            ) from error

    def _messages(self, topic: str, start: int | None = None, stop: int | None = None) -> Iterator[tuple[int, Any]]:
        connections = [c for c in self._reader.connections if c.topic == topic]
        with self._reading():
            for connection, logged, raw in self._reader.messages(connections, start=start, stop=stop):
                yield logged, self._reader.deserialize(raw, connection.msgtype)

    def first(self, topic: str) -> Any:
        """The first message of a topic."""
        for _, message in self._messages(topic):
            return message
        raise InputError(f"bag {self.path} says it holds messages of {topic}, and there are none", "is it damaged?")

    def index(self, topic: str) -> list[Entry]:
        """Every message of a topic with a header, in the order of the file. Reads all of them once."""
        entries: list[Entry] = []
        for logged, message in self._messages(topic):
            stamp = message.header.stamp
            seconds = stamp.sec + stamp.nanosec * 1e-9
            ordinal = entries[-1].ordinal + 1 if entries and entries[-1].logged == logged else 0
            entries.append(Entry(seconds if seconds > 0 else logged * 1e-9, logged, ordinal))
        return entries

    def message(self, topic: str, entry: Entry) -> Any:
        """A message of a topic again."""
        for k, (_, message) in enumerate(self._messages(topic, entry.logged, entry.logged + 1)):
            if k == entry.ordinal:
                return message
        raise InputError(f"bag {self.path} changed while it was read: a message of {topic} is gone")


def _close(reader: Any) -> None:
    with contextlib.suppress(Exception):
        reader.close()

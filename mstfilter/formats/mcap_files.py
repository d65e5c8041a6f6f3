"""MCAP files that ROS 2 has not written: messages of Foxglove (protobuf or JSON), and of ROS 1.

>>> if is_foreign(path):
...     reader = McapMessages(path)                     # used by `BagFile` as the reader of rosbags is

`foxglove.RawImage`, `CompressedImage` and `CameraCalibration` get the fields of the ROS messages with the same
content. The library mcap reads the file, mcap-protobuf-support decodes protobuf by the schemas in the file, and
rosbags decodes messages of ROS.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from mstfilter.base.errors import InputError, missing_library
from mstfilter.base.reading import open_regular

#: Schemas of Foxglove, and the ROS message with the same content.
_FOXGLOVE = {
    "foxglove.RawImage": "sensor_msgs/msg/Image",
    "foxglove.CompressedImage": "sensor_msgs/msg/CompressedImage",
    "foxglove.CameraCalibration": "sensor_msgs/msg/CameraInfo",
}
_VIDEO = "foxglove.CompressedVideo"


def is_foreign(path: Path) -> bool:
    """Whether a file is an MCAP file with another profile than that of ROS 2."""
    if path.suffix != ".mcap":
        return False
    with open_regular(path, 2**63 - 1) as file:
        start = file.read(64)
    length = int.from_bytes(start[17:21], "little")  # after the magic bytes, the opcode and the length of the header
    return start.startswith(b"\x89MCAP0\r\n\x01") and start[21 : 21 + length] != b"ros2"


@dataclass(frozen=True)
class McapConnection:
    """A channel with images or a calibration; `msgtype` is that of the ROS message with the same content."""

    id: int
    topic: str
    msgtype: str
    msgcount: int
    decode: Callable[[bytes], Any]


class McapMessages:
    """A reader of an MCAP file with the methods of rosbags' `AnyReader` that `BagFile` calls."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[McapConnection] = []

    def open(self) -> None:
        """Open the file and find the channels."""
        try:
            from mcap.reader import make_reader
        except ImportError as error:
            raise missing_library(error, "an MCAP file that ROS 2 has not written", library="mcap") from error
        self._file = self.path.open("rb")
        self._reader = make_reader(self._file)
        summary = self._reader.get_summary()
        if summary is None or summary.statistics is None:
            raise InputError(f"bag cannot be read: {self.path} has no summary", "repair it: mcap recover")
        counts = summary.statistics.channel_message_counts
        other = set()
        for channel in summary.channels.values():
            schema = summary.schemas.get(channel.schema_id)
            name = "" if schema is None else schema.name.replace("/msg/", "/")
            kind = _FOXGLOVE.get(name) or name.replace("/", "/msg/")
            if kind not in (*_FOXGLOVE.values(), _VIDEO):
                continue
            decode = _decoder(channel.message_encoding, schema)
            if decode is None or kind == _VIDEO:
                other.add(f"{channel.topic} ({name}, {channel.message_encoding})")
                continue
            count = counts.get(channel.id, 0)
            self.connections.append(McapConnection(channel.id, channel.topic, kind, count, decode))
        if other and all(c.msgtype == _FOXGLOVE["foxglove.CameraCalibration"] for c in self.connections):
            raise InputError(
                f"{self.path}: images are in a form that is not read: {', '.join(sorted(other))}",
                "read are RawImage and CompressedImage as protobuf or JSON, and Image messages of ROS 1 and ROS 2",
                "record images, not video; or extract PNG images of colour and depth to rgb/ and depth/",
            )

    def messages(
        self, connections: Sequence[McapConnection], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[McapConnection, int, Any]]:
        """Channel, log time in ns, and data of the messages from `start` to `stop`."""
        of_id = {c.id: c for c in connections}
        topics = [c.topic for c in connections]
        for _, channel, message in self._reader.iter_messages(topics, starting_at=start, ending_before=stop):
            if channel.id in of_id:
                connection = of_id[channel.id]
                yield connection, message.log_time, connection.decode(message.data)

    def deserialize(self, message: Any, msgtype: str) -> Any:
        """The message, which `messages` has decoded."""
        return message

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _decoder(encoding: str, schema: Any) -> Callable[[bytes], Any] | None:
    """A function that decodes the messages of a channel to those of ROS; None for an unknown encoding."""
    if encoding == "json":
        return lambda data: _as_ros(schema.name, json.loads(data))
    if encoding == "protobuf":
        try:
            from mcap_protobuf.decoder import DecoderFactory
        except ImportError as error:
            raise missing_library(error, "an MCAP file of protobuf", library="mcap_protobuf") from error
        decode = DecoderFactory().decoder_for(encoding, schema)
        return None if decode is None else lambda data: _as_ros(schema.name, decode(data))
    if (encoding, schema.encoding) not in (("ros1", "ros1msg"), ("cdr", "ros2msg")):
        return None
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store, name = get_typestore(Stores.EMPTY), schema.name.replace("/msg/", "/").replace("/", "/msg/")
    store.register(get_types_from_msg(schema.data.decode(), name))
    deserialize = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return lambda data: deserialize(data, name)


def _as_ros(schema: str, message: Any) -> Any:
    """A message of Foxglove (protobuf, or a mapping of JSON) with the fields of the ROS message."""
    plain = isinstance(message, dict)
    field: Callable[[str], Any] = message.__getitem__ if plain else lambda name: getattr(message, name)
    stamp = field("timestamp")
    seconds, nanoseconds = (stamp["sec"], stamp["nsec"]) if plain else (stamp.seconds, stamp.nanos)
    time = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
    made: dict[str, Any] = {"header": SimpleNamespace(stamp=time, frame_id=field("frame_id"))}
    names = {
        "foxglove.RawImage": ("width", "height", "encoding", "step"),
        "foxglove.CompressedImage": ("format",),
        "foxglove.CameraCalibration": ("width", "height", "distortion_model", "D", "K", "P"),
    }[schema]
    made.update({name: field(name) for name in names})
    if "K" in made:  # empty matrices are allowed
        made.update(K=list(made["K"]) or [0.0] * 9, P=list(made["P"]) or [0.0] * 12)
    else:
        data = field("data")
        made.update(data=memoryview(base64.b64decode(data) if plain else data), is_bigendian=False)
    return SimpleNamespace(**made)

"""Reads ROS 1 bags, ROS 2 bags and MCAP files with colour, depth and calibration topics.

>>> Bag(colour="/camera/color/image_raw", depth="/camera/aligned_depth_to_color/image_raw").open(Path("session.bag"))

The parameters `colour` and `depth` are needed only if several topics are suitable. The camera matrix is K (P for
rectified images) in the ``camera_info`` topic that belongs to the colour topic, or in the only calibration topic with
the frame of the colour images. A frame consists of a colour and a
depth image whose header time stamps are mutually nearest and differ by at most `tolerance_s` seconds. If a message
has no stamp, all messages have the times of the log. Depth must be registered to colour, and both images must have
the same size and ``frame_id``. Transforms (tf) are not read. The camera is assumed not to move, and its pose is
computed from the table.

`mstfilter.formats.ros_images` describes the encodings. The library rosbags (extra ``bags``) reads the files without
ROS, and `mstfilter.formats.mcap_files` reads MCAP files that ROS 2 has not written.
"""

from __future__ import annotations

import contextlib
import re
import weakref
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, missing_library, warn_user
from mstfilter.base.files import reading
from mstfilter.base.reading import MAX_TEXT, open_regular
from mstfilter.formats.mcap_files import McapMessages, is_foreign
from mstfilter.formats.ros_images import DEPTH, GREY, colour_image, depth_image, image_encoding
from mstfilter.formats.video import Video, VideoFormat, pair_stamps


@dataclass(frozen=True)
class Entry:
    """Reference to a message: time (s), log time (ns), and index among messages with the same log time.

    The time is the stamp of the header, 0 if the header has none.
    """

    stamp: float
    logged: int
    ordinal: int


class BagFile:
    """An open bag (.bag, .mcap or .db3 file, or the folder of a ROS 2 bag). Garbage collection closes the bag.

    >>> bag = BagFile(Path("session.mcap"))
    >>> entries = bag.index("/camera/color/image_raw")
    >>> message = bag.message("/camera/color/image_raw", entries[3])
    """

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise missing_library(error, "a bag", library="rosbags") from error
        self.path = path
        if not path.exists():
            raise InputError(f"bag does not exist: {path}")
        files = [path] if path.is_file() or (path / "metadata.yaml").is_file() else _parts(path)
        for file in sorted(file for file in path.iterdir() if not file.is_dir()) if path.is_dir() else [path]:
            limit = MAX_TEXT if file.suffix == ".yaml" else 2**63
            with reading(file, "a bag"), open_regular(file, limit) as opened:
                if file.suffix == ".bag" and opened.read(13) != b"#ROSBAG V2.0\n":
                    raise InputError(f"bag cannot be read: {file} does not begin with #ROSBAG V2.0")
        with self._reading():
            store = get_typestore(Stores.LATEST)
            if any(map(is_foreign, files)) and len(files) > 1:
                text = f"{path} has {len(files)} MCAP files that ROS 2 has not written"
                raise InputError(text, "give one of them, or join them: mcap merge *.mcap --output-file joined.mcap")
            foreign = is_foreign(files[0])
            self._reader: Any = McapMessages(files[0]) if foreign else AnyReader(files, default_typestore=store)
            try:
                self._reader.open()
            except KeyError:  # rosbags meets a schema of another kind beside those of ROS 2
                if files[0].suffix != ".mcap" or len(files) > 1:
                    raise
                self._reader = McapMessages(files[0])
                self._reader.open()
        weakref.finalize(self, _close, self._reader)

    def topics(self, *kinds: str) -> dict[str, int]:
        """Number of messages of each topic with a message type in `kinds`. Topics without messages are omitted."""
        counts: Counter[str] = Counter()
        for connection in self._reader.connections:
            if connection.msgtype in kinds:
                counts[connection.topic] += connection.msgcount
        return {name: n for name, n in counts.items() if n}

    @contextlib.contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except InputError:
            raise
        except Exception as error:  # rosbags passes on errors of storage and compression libraries
            reason = " ".join(str(error).split())[:160]  # one line
            hint = "copy it again, or repair it: rosbag reindex, ros2 bag reindex, mcap recover"
            raise InputError(f"bag cannot be read: {self.path} ({type(error).__name__}: {reason})", hint) from error

    def _messages(self, topic: str, start: int | None = None, stop: int | None = None) -> Iterator[tuple[int, Any]]:
        connections = [c for c in self._reader.connections if c.topic == topic]
        with self._reading():
            for connection, logged, raw in self._reader.messages(connections, start=start, stop=stop):
                yield logged, self._reader.deserialize(raw, connection.msgtype)

    def first(self, topic: str) -> Any:
        """The first message of a topic."""
        for _, message in self._messages(topic):
            return message
        raise InputError(f"bag {self.path} lists messages of {topic} but holds none", "copy it again")

    def index(self, topic: str) -> list[Entry]:
        """Entries of all messages of a topic, in the order of the log. The call reads every message."""
        entries: list[Entry] = []
        for logged, message in self._messages(topic):
            stamp = message.header.stamp
            seconds = stamp.sec + stamp.nanosec * 1e-9
            ordinal = entries[-1].ordinal + 1 if entries and entries[-1].logged == logged else 0
            entries.append(Entry(max(seconds, 0.0), logged, ordinal))
        return entries

    def message(self, topic: str, entry: Entry) -> Any:
        """The message to which an `Entry` refers."""
        for k, (_, message) in enumerate(self._messages(topic, entry.logged, entry.logged + 1)):
            if k == entry.ordinal:
                return message
        raise InputError(f"bag {self.path} changed while it was read: a message of {topic} is missing")


def _parts(path: Path) -> list[Path]:
    """The files of a ROS 2 bag without its metadata.yaml."""
    files = [file for ending in _PARTS for file in sorted(path.glob(f"*{ending}"))]
    kinds = {file.suffix for file in files}
    if len(kinds) != 1:
        text = f"{path} has no metadata.yaml, and {len(files)} files of {' and '.join(sorted(kinds)) or 'a bag'}"
        raise InputError(text, "write the file again: ros2 bag reindex; or give one of the files")
    return files


def _close(reader: Any) -> None:
    with contextlib.suppress(Exception):
        reader.close()


_PARTS = (".mcap", ".db3")
_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO = "sensor_msgs/msg/CameraInfo"
_REGISTERED = "record the aligned depth; or, if it is registered: registered=true"
#: Topics of the RealSense Viewer, rs-record and pyrealsense2's `enable_record_to_file`, which write unaligned depth.
_RECORDED_RAW = re.compile(r"/device_\d+/sensor_\d+/\w+/image/data$")
_ALIGN_RAW = (
    "align it with Open3D: RSBagReader, open('session.bag') and save_frames('frames'); then convert frames/",
    "or play the bag with align_depth.enable in ROS and record the aligned depth; or, if it is registered: "
    "registered=true",
)
_ORDER_S = 1.0  # stamps may be this much out of the order of the log: messages wait in queues


@dataclass(frozen=True)
class _Stream:
    """An image topic with its name, number of messages, and properties of the first message."""

    name: str
    count: int
    compressed: bool
    encoding: str
    frame_id: str
    size: tuple[int, int]

    def __str__(self) -> str:
        width, height = self.size
        return f"{self.name} ({self.count} x {self.encoding}, {width} x {height}, frame {self.frame_id!r})"

    @property
    def _parts(self) -> list[str]:
        """The parts of the name, without the transport."""
        parts = self.name.split("/")
        return parts[:-1] if parts[-1] in ("compressed", "compressedDepth") else parts

    @property
    def info(self) -> str:
        """The name of the CameraInfo topic of the images, by the convention of image_transport or of the recorder."""
        if self.recorded_raw:
            return "/".join([*self._parts[:-2], "info", "camera_info"])
        return "/".join([*self._parts[:-1], "camera_info"])

    @property
    def recorded_raw(self) -> bool:
        """Whether the images are those of a sensor of a RealSense, not aligned with another sensor."""
        return _RECORDED_RAW.search(self.name) is not None

    @property
    def rectified(self) -> bool:
        """Whether the images are rectified, by the convention of image_proc: ``image_rect``, ``image_rect_color``."""
        return any(re.search(r"(^|_)rect(_|ified|$)", part) for part in self._parts)


@dataclass(frozen=True)
class Bag(VideoFormat):
    """Reader of ROS 1 bags, ROS 2 bags and MCAP: image, compressed image, depth and CameraInfo topics.

    The method `open` and further parameters are those of `VideoFormat`. The parameter `K` replaces the camera matrix
    of the CameraInfo messages, and `distortion` their distortion.

    Parameters
    ----------
    colour : str
        Colour topic. By default, the only colour topic is used.
    depth : str
        Depth topic. By default, the only depth topic that is registered to colour is used.
    registered : bool
        Treat depth as registered to colour even if its topic, frame_id or camera matrix says that it is not.
    log_times : bool
        Use the times at which the messages were logged, not the stamps of their headers.
    """

    colour: str = ""
    depth: str = ""
    registered: bool = False
    log_times: bool = False

    @classmethod
    def detects(cls, path: Path) -> bool:
        if path.is_file():
            return path.suffix in (".bag", *_PARTS)
        if (path / "metadata.yaml").is_file() or not path.is_dir():
            return (path / "metadata.yaml").is_file()
        entries = [entry for entry in path.iterdir() if not entry.name.startswith(".")]
        return any(entry.suffix in _PARTS for entry in entries) and not any(entry.is_dir() for entry in entries)

    def video(self, path: Path) -> Video:
        bag = BagFile(path)
        kinds = ((_IMAGE, False), (_COMPRESSED, True))
        streams = [_stream(bag, name, n, packed) for kind, packed in kinds for name, n in bag.topics(kind).items()]
        pictures = [s for s in streams if s.encoding not in DEPTH]
        if not pictures and any(s.encoding != "mono16" for s in streams):
            pictures = [s for s in streams if s.encoding == "mono16"]  # grey, since the depth is another one
        # Grey images may be those of an infrared camera.
        pictures = [s for s in pictures if s.encoding not in GREY] or pictures
        colour = _choose(path, "colour", self.colour, pictures, streams)
        depth = self._depth(path, colour, streams)
        K, distortion = self._intrinsics(bag, colour, depth)
        entries = self._entries(bag, colour.name, depth.name)
        stamps = [[e.stamp for e in listed] for listed in entries]
        pairs = pair_stamps(stamps[0], stamps[1], self.tolerance_s, f"{path}: {colour.name}")

        def read_rgb(index: int) -> np.ndarray:
            k = pairs[index][0]
            message = bag.message(colour.name, entries[0][k])
            return colour_image(message, colour.compressed, f"message {k} of {colour.name}")

        def read_depth(index: int) -> np.ndarray:
            k = pairs[index][1]
            message, where = bag.message(depth.name, entries[1][k]), f"depth message {k} of {depth.name}"
            return depth_image(message, depth.compressed, self.depth_scale, where)

        return Video(
            path.resolve().stem,
            tuple(stamps[0][i] for i, _ in pairs),
            read_rgb,
            read_depth,
            K,
            path,
            self.depth_scale if depth.encoding != "32FC1" else 0.00025,
            distortion=distortion,
        )

    def _entries(self, bag: BagFile, *topics: str) -> list[list[Entry]]:
        """The entries of each topic, with the stamps of the headers as times for all messages or for none."""
        listed = [bag.index(topic) for topic in topics]
        logged = [[replace(entry, stamp=entry.logged * 1e-9) for entry in entries] for entries in listed]
        if self.log_times:
            return logged
        for topic, entries in zip(topics, listed, strict=True):
            _check_order(bag.path, topic, entries)
        missing = [_without_stamp(entries) for entries in listed]
        for topic, entries, n in zip(topics, listed, missing, strict=True):
            if 0 < n < len(entries):
                text = f"{bag.path}: {n} of {len(entries)} messages of {topic} have no time stamp in their headers"
                warn_user(f"{text}: the times of the log are used for all images")
        return logged if any(missing) else listed

    def _depth(self, path: Path, colour: _Stream, streams: list[_Stream]) -> _Stream:
        found = [s for s in streams if s.encoding in DEPTH and s != colour]
        fitting = [s for s in found if s.size == colour.size and (self.registered or s.frame_id == colour.frame_id)]
        depth = _choose(path, "depth", self.depth, fitting if fitting and not self.depth else found, streams)
        if depth.recorded_raw and not (self.registered and depth.size == colour.size):
            text = f"{path}: depth {depth} was recorded as the sensor gives it: it is not registered to colour"
            raise InputError(text, *_ALIGN_RAW)
        if depth.size != colour.size:
            text = f"{path}: depth {depth} and colour {colour} differ in size: depth is not registered to colour"
            drivers = "RealSense: align_depth.enable, Azure Kinect: depth_to_rgb, Kinect: depth_registered"
            raise InputError(text, f"record the aligned depth ({drivers})")
        if depth.frame_id != colour.frame_id and not self.registered:
            text = f"{path}: depth {depth} has another frame than colour {colour}: it is not registered"
            raise InputError(text, _REGISTERED)
        return depth

    def _intrinsics(
        self, bag: BagFile, colour: _Stream, depth: _Stream
    ) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """fx, fy, cx, cy and the distortion of the colour image."""
        infos = bag.topics(_INFO)
        name = colour.info if colour.info in infos else _info_by_frame(bag, infos, colour) or colour.info

        def stored(stream: _Stream, topic: str) -> _Info | None:
            try:
                return _camera_info(bag, topic, stream.rectified) if topic in infos else None
            except InputError:
                if self.K:
                    return None
                raise

        own = stored(colour, name)
        if own is None:
            if self.K:
                return self.K, self.distortion
            raise InputError(
                f"{bag.path}: intrinsics are missing, there is no {name} for {colour.name}",
                "give them: K=fx,fy,cx,cy, and distortion=k1,k2,p1,p2,k3 if the images are distorted",
            )
        matrix, distortion, size = own
        if not self.K and size[0] and size != colour.size:
            raise InputError(
                f"{bag.path}: {name} is of images of {size[0]} x {size[1]}, {colour} is not",
                "give the matrix of these images: K=fx,fy,cx,cy",
            )
        other = None if self.registered or depth.info == name else stored(depth, depth.info)
        if other is not None and other[2][0] and not np.allclose(other[0], matrix, atol=1.0):
            text = f"{bag.path}: camera matrices of {name} and {depth.info} differ: depth is not registered to colour"
            raise InputError(text, _REGISTERED)
        return self.K or (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]), self.distortion or distortion


def _info_by_frame(bag: BagFile, infos: Iterable[str], colour: _Stream) -> str | None:
    """The only calibration topic whose messages have the frame and the size of the colour images."""
    found = []
    for name in infos:
        message = bag.first(name)
        size = int(message.width), int(message.height)
        if str(message.header.frame_id).lstrip("/") == colour.frame_id and size in ((0, 0), colour.size):
            found.append(name)
    return found[0] if len(found) == 1 else None


def _check_order(path: Path, topic: str, entries: list[Entry]) -> None:
    """Raise InputError if a stamp of a topic is more than a second earlier than one that was logged before."""
    latest, at = 0.0, 0
    for k, entry in enumerate(entries):
        if 0 < entry.stamp < latest - _ORDER_S:
            text = (
                f"{path}: the stamp of message {k} of {topic} is {latest - entry.stamp:.1f} s earlier than that of "
            )
            text += f"message {at}, which was logged before: the clock was changed, or the bag has two recordings"
            raise InputError(
                text, "cut the bag there; or use the times at which messages were logged: log_times=true"
            )
        if entry.stamp > latest:
            latest, at = entry.stamp, k


def _without_stamp(entries: list[Entry]) -> int:
    """How many messages of a topic have the stamp 0 although 0 is not their time.

    Simulated time may start at 0. Then the first messages alone have this stamp, and the next ones follow as in the
    log, if the simulation is at most ten times as fast as the clock of the log.
    """
    n = sum(entry.stamp == 0 for entry in entries)
    first = next((k for k, entry in enumerate(entries) if entry.stamp > 0), 0)
    if n != first or n == 0:
        return n
    gap = (entries[first].logged - entries[first - 1].logged) * 1e-9
    return 0 if entries[first].stamp <= 10 * gap + _ORDER_S else n


def _stream(bag: BagFile, name: str, count: int, compressed: bool) -> _Stream:
    message = bag.first(name)
    encoding = image_encoding(message, compressed)
    where = f"first message of {name} in {bag.path.name}"
    if not compressed:
        size = int(message.width), int(message.height)
    else:
        read = depth_image(message, True, 1.0, where) if encoding in DEPTH else colour_image(message, True, where)
        size = read.shape[1], read.shape[0]
    return _Stream(name, count, compressed, encoding, str(message.header.frame_id).lstrip("/"), size)


def _choose(path: Path, what: str, name: str, candidates: list[_Stream], streams: list[_Stream]) -> _Stream:
    """The stream of the topic `name`, or the only candidate if `name` is empty."""
    listed = [f"  {s}" for s in sorted(streams, key=lambda s: s.name)]
    if name:
        chosen = next((s for s in streams if s.name == name), None)
        if chosen is None:
            raise InputError(f"{path}: no image topic {name!r} for {what}", "image topics are:", *listed)
        if chosen.encoding != "mono16" and (chosen.encoding in DEPTH) != (what == "depth"):
            raise InputError(f"{path}: {chosen} has no {what} images", "image topics are:", *listed)
        return chosen
    if not candidates:
        raise InputError(f"{path}: there is no {what} topic", *(["image topics are:", *listed] if listed else []))
    if len(candidates) > 1:
        raise InputError(
            f"{path}: {len(candidates)} topics could be {what}: {', '.join(s.name for s in candidates)}",
            f"choose one: {what}=TOPIC, of",
            *listed,
        )
    return candidates[0]


_Info = tuple[np.ndarray, tuple[float, ...], tuple[int, int]]


def _camera_info(bag: BagFile, name: str, rectified: bool) -> _Info:
    """Camera matrix (3, 3), distortion, and width and height of the images."""
    message = bag.first(name)
    lower = hasattr(message, "k")  # of ROS 2; ROS 1 and Foxglove have capitals
    D, K, P = (message.d, message.k, message.p) if lower else (message.D, message.K, message.P)
    raw, projection = np.reshape(np.asarray(K, float), (3, 3)), np.reshape(np.asarray(P, float), (3, 4))[:, :3]
    if raw[0, 0] <= 0:
        raise InputError(
            f"{bag.path}: {name} has an empty camera matrix: the camera is not calibrated", "give it: K=fx,fy,cx,cy"
        )
    model, distortion = str(message.distortion_model), tuple(float(v) for v in D)
    if rectified and projection[0, 0] > 0:
        raw, distortion = projection, ()
    if any(distortion) and model not in ("plumb_bob", "rational_polynomial", ""):
        raise InputError(
            f"{bag.path}: {name} has distortion model {model!r}, which is not supported",
            "rectify the images (image_proc), or give K=fx,fy,cx,cy to ignore the distortion",
        )
    return raw, distortion, (int(message.width), int(message.height))

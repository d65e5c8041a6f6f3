"""ROS 1 and ROS 2 bags and MCAP files: colour, depth and CameraInfo topics.

>>> Bag(colour="/camera/color/image_raw", depth="/camera/aligned_depth_to_color/image_raw").open(Path("session.bag"))

Topics need to be named only where several would do. The camera matrix comes from the ``camera_info`` beside the
colour topic (of a rectified image, from its P). A colour and a depth image are one frame where each is the other's
nearest by the time stamp of the header, at most `tolerance_s` apart. Depth has to be registered to colour: same size
and same ``frame_id``. Transforms (tf) are not read: the camera stands still, its pose is found from the table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.formats.bag_file import BagFile, Topic
from mstfilter.formats.bag_images import DEPTH, GREY, colour_of, depth_of, encoding_of
from mstfilter.formats.interfaces import Format
from mstfilter.formats.pauses import PauseRule
from mstfilter.formats.still import Still
from mstfilter.formats.video import Images, Video, World, pair_stamps
from mstfilter.scene import Recording

__all__ = ["Bag"]

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO = "sensor_msgs/msg/CameraInfo"


@dataclass(frozen=True)
class _Stream:
    """An image topic and what its first message says."""

    topic: Topic
    encoding: str
    frame_id: str
    size: tuple[int, int]

    def __str__(self) -> str:
        width, height = self.size
        return (
            f"{self.topic.name} ({self.topic.count} x {self.encoding}, {width} x {height}, frame {self.frame_id!r})"
        )


@dataclass(frozen=True)
class Bag(Format):
    """ROS 1 bag, ROS 2 bag or MCAP: image, compressed image, depth and CameraInfo topics.

    Parameters
    ----------
    colour : str
        Colour topic. Default: the only one.
    depth : str
        Depth topic. Default: the only one that is registered to colour.
    info : str
        CameraInfo topic. Default: ``camera_info`` beside the colour topic.
    K : tuple of 4 float
        fx, fy, cx, cy in pixels, instead of a CameraInfo.
    depth_scale : float
        Metres a unit of 16-bit depth.
    tolerance_s : float
        A colour and a depth image at most this far apart are one frame.
    registered : bool
        Take depth as registered to colour although its frame_id or camera matrix differs.
    start_s, stop_s : float
        Part of the video that is used, in seconds after its first frame.
    pauses : PauseRule
        Where the video is cut.
    world : World
        Pose and workspace, where known.
    """

    colour: str = ""
    depth: str = ""
    info: str = ""
    K: tuple[float, ...] = ()
    depth_scale: float = 0.001
    tolerance_s: float = 0.02
    registered: bool = False
    start_s: float = 0.0
    stop_s: float = math.inf
    pauses: PauseRule = field(default_factory=Still)
    world: World = field(default_factory=World)

    @classmethod
    def detects(cls, path: Path) -> bool:
        """See `Format`."""
        if path.is_file():
            return path.suffix in (".bag", ".mcap", ".db3")
        return (path / "metadata.yaml").is_file()

    def open(self, path: Path) -> Recording:
        """See `Format`."""
        bag = BagFile(path)
        streams = [_stream(bag, t) for t in bag.topics.values() if t.kind in _IMAGES and t.count]
        pictures = [s for s in streams if s.encoding not in DEPTH]
        pictures = [s for s in pictures if s.encoding not in GREY] or pictures  # infrared beside a colour camera
        colour = _choose(path, "colour", self.colour, pictures, streams)
        depth = self._depth(path, colour, streams)
        K, distortion = self._intrinsics(bag, colour, depth)
        entries = [bag.index(s.topic.name) for s in (colour, depth)]
        stamps = [[e.stamp for e in listed] for listed in entries]
        pairs = pair_stamps(stamps[0], stamps[1], self.tolerance_s, f"{path}: {colour.topic.name}")

        def read_rgb(index: int) -> np.ndarray:
            k, topic = pairs[index][0], colour.topic
            return colour_of(bag.message(topic.name, entries[0][k]), topic.compressed, f"message {k} of {topic.name}")

        def read(index: int) -> Images:
            k, topic = pairs[index][1], depth.topic
            where = f"depth message {k} of {topic.name} in {path.name}"
            metres = depth_of(bag.message(topic.name, entries[1][k]), topic.compressed, self.depth_scale, where)
            return Images(read_rgb(index), metres, f"colour message {pairs[index][0]} of {colour.topic.name}", where)

        return (
            Video(
                path.resolve().stem,
                tuple(stamps[0][i] for i, _ in pairs),
                read,
                K,
                path,
                self.depth_scale if depth.encoding != "32FC1" else 0.00025,
                read_rgb=read_rgb,
                distortion=distortion,
            )
            .part(self.start_s, self.stop_s)
            .recording(self.pauses, self.world)
        )

    def _depth(self, path: Path, colour: _Stream, streams: list[_Stream]) -> _Stream:
        found = [s for s in streams if s.encoding in DEPTH]
        fitting = [s for s in found if s.size == colour.size and (self.registered or s.frame_id == colour.frame_id)]
        depth = _choose(path, "depth", self.depth, fitting if fitting and not self.depth else found, streams)
        if depth.size != colour.size:
            raise InputError(
                f"{path}: depth {depth} and colour {colour} differ in size: depth is not registered to colour",
                "record the aligned depth (RealSense: align_depth.enable, Azure Kinect: depth_to_rgb, Kinect: "
                "depth_registered)",
            )
        if depth.frame_id != colour.frame_id and not self.registered:
            raise InputError(
                f"{path}: depth {depth} is seen from another frame than colour {colour}: it is not registered",
                "record the aligned depth; or, if it is registered after all: registered=true",
            )
        return depth

    def _intrinsics(
        self, bag: BagFile, colour: _Stream, depth: _Stream
    ) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """fx, fy, cx, cy and the distortion of the colour image."""
        if self.K:
            return self.K, ()
        infos = [t.name for t in bag.topics.values() if t.kind == _INFO and t.count]
        beside = _info_beside(colour.topic)
        if self.info and self.info not in infos:
            raise InputError(
                f"{bag.path}: no CameraInfo topic {self.info!r}", f"there are: {', '.join(infos) or 'none'}"
            )
        name = self.info or (beside if beside in infos else "")
        if not name:
            raise InputError(
                f"{bag.path}: intrinsics are missing, there is no {beside} beside {colour.topic.name}",
                f"choose one: info=TOPIC, of {', '.join(infos)}" if infos else "give them: K=fx,fy,cx,cy",
            )
        info = _camera_info(bag, name, "rect" in colour.topic.name)
        if (info["width"], info["height"]) != colour.size and info["width"]:
            raise InputError(
                f"{bag.path}: {name} is of images of {info['width']} x {info['height']}, {colour} is not",
                "choose the CameraInfo of the colour camera: info=TOPIC",
            )
        other = _info_beside(depth.topic)
        if not self.registered and not self.info and other in infos and other != name:
            theirs = _camera_info(bag, other, "rect" in depth.topic.name)
            if not np.allclose(theirs["matrix"], info["matrix"], atol=1.0) and theirs["width"]:
                raise InputError(
                    f"{bag.path}: camera matrices of {name} and {other} differ: depth is not registered to colour",
                    "record the aligned depth; or, if it is registered after all: registered=true",
                )
        matrix = info["matrix"]
        return (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]), info["distortion"]


def _stream(bag: BagFile, topic: Topic) -> _Stream:
    message = bag.first(topic.name)
    encoding = encoding_of(message, topic.compressed)
    where = f"first message of {topic.name} in {bag.path.name}"
    if not topic.compressed:
        size = int(message.width), int(message.height)
    else:
        read = depth_of(message, True, 1.0, where) if encoding in DEPTH else colour_of(message, True, where)
        size = read.shape[1], read.shape[0]
    return _Stream(topic, encoding, str(message.header.frame_id).lstrip("/"), size)


def _choose(path: Path, what: str, name: str, candidates: list[_Stream], streams: list[_Stream]) -> _Stream:
    """The stream of a name, or the only candidate."""
    listed = [f"  {s}" for s in sorted(streams, key=lambda s: s.topic.name)]
    if name:
        chosen = next((s for s in streams if s.topic.name == name), None)
        if chosen is None:
            raise InputError(f"{path}: no image topic {name!r} for {what}", "image topics are:", *listed)
        if (chosen.encoding in DEPTH) != (what == "depth"):
            raise InputError(f"{path}: {chosen} holds no {what} images", "image topics are:", *listed)
        return chosen
    if not candidates:
        raise InputError(f"{path}: there is no {what} topic", *(["image topics are:", *listed] if listed else []))
    if len(candidates) > 1:
        raise InputError(
            f"{path}: {len(candidates)} topics could be {what}: {', '.join(s.topic.name for s in candidates)}",
            f"choose one: {what}=TOPIC, of",
            *listed,
        )
    return candidates[0]


def _info_beside(topic: Topic) -> str:
    """Where image_transport puts the CameraInfo of an image topic."""
    parts = topic.name.split("/")
    if parts[-1] in ("compressed", "compressedDepth"):
        parts = parts[:-1]
    return "/".join([*parts[:-1], "camera_info"])


def _camera_info(bag: BagFile, name: str, rectified: bool) -> dict[str, Any]:
    """Camera matrix of what the images show, distortion still in them, and their size."""
    message = bag.first(name)
    D, K, P = (message.d, message.k, message.p) if bag.is_ros2 else (message.D, message.K, message.P)
    raw, projection = np.reshape(np.asarray(K, float), (3, 3)), np.reshape(np.asarray(P, float), (3, 4))[:, :3]
    if raw[0, 0] <= 0:
        raise InputError(
            f"{bag.path}: {name} has an empty camera matrix: the camera is not calibrated", "K=fx,fy,cx,cy"
        )
    model, distortion = str(message.distortion_model), tuple(float(v) for v in D)
    if rectified and projection[0, 0] > 0:
        raw, distortion = projection, ()
    if any(distortion) and model not in ("plumb_bob", "rational_polynomial", ""):
        raise InputError(
            f"{bag.path}: {name} has distortion model {model!r}, which is not read",
            "rectify the images (image_proc), or give K=fx,fy,cx,cy to leave the distortion in",
        )
    return {
        "matrix": raw,
        "distortion": distortion,
        "width": int(message.width),
        "height": int(message.height),
    }

"""Bags and MCAP files of the known scene, written by rosbags' own writers."""

from __future__ import annotations

import struct

import numpy as np

from tests.formats.layouts import FPS, SHIFTS, K, units, video

COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
KINDS = ("bag", "db3", "mcap")


def topic_info(topic):
    return topic.rsplit("/", 1)[0] + "/camera_info"


class Messages:
    """Builds messages of ROS 1 or ROS 2."""

    def __init__(self, ros1):
        from rosbags.typesys import Stores, get_typestore

        self.ros1, self.store = ros1, get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        self.types = self.store.types

    def header(self, seconds, frame):
        whole = int(seconds)
        stamp = self.types["builtin_interfaces/msg/Time"](sec=whole, nanosec=round((seconds - whole) * 1e9))
        extra = {"seq": 0} if self.ros1 else {}
        return self.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **extra)

    def image(self, seconds, pixels, encoding, frame="camera_color_optical_frame", padding=0):
        height, width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        return "sensor_msgs/msg/Image", self.types["sensor_msgs/msg/Image"](
            header=self.header(seconds, frame),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.reshape(-1),
        )

    def compressed(self, seconds, data, form, frame="camera_color_optical_frame"):
        return "sensor_msgs/msg/CompressedImage", self.types["sensor_msgs/msg/CompressedImage"](
            header=self.header(seconds, frame), format=form, data=np.frombuffer(data, np.uint8)
        )

    def info(
        self, seconds, k=K, size=(160, 120), d=(0.0,) * 5, model="plumb_bob", frame="camera_color_optical_frame"
    ):
        fx, fy, cx, cy = k
        big = {
            "D": np.array(d),
            "K": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]),
            "R": np.eye(3).ravel(),
            "P": np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0]),
        }
        fields = big if self.ros1 else {k.lower(): v for k, v in big.items()}
        roi = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        return "sensor_msgs/msg/CameraInfo", self.types["sensor_msgs/msg/CameraInfo"](
            header=self.header(seconds, frame),
            height=size[1],
            width=size[0],
            distortion_model=model,
            binning_x=0,
            binning_y=0,
            roi=roi,
            **fields,
        )


def png(pixels):
    import cv2

    return cv2.imencode(".png", pixels)[1].tobytes()


def rvl(pixels):
    """Width, height and RVL stream of an image, written bit by bit as Wilson (2017) describes it."""
    bits, last, k, flat = [], 0, 0, pixels.ravel().tolist()

    def number(value):
        while True:
            value, part = value >> 3, value & 7
            bits.append(f"{part + 8 * (value > 0):04b}")
            if not value:
                return

    while k < len(flat):
        for reading in (False, True):
            begin = k
            while k < len(flat) and (flat[k] > 0) == reading:
                k += 1
            number(k - begin)
        for value in flat[begin:k]:
            number(2 * (value - last) if value >= last else 2 * (last - value) - 1)
            last = value
    text = "".join(bits)
    text += "0" * (-len(text) % 32)
    words = [int(text[i : i + 32], 2) for i in range(0, len(text), 32)]
    return struct.pack(f"<II{len(words)}I", *pixels.shape[::-1], *words)


def compressed_depth(depth, floats, pack=png):
    """Data of the compressedDepth transport: 16UC1, or 32FC1 quantised in inverse depth."""
    if not floats:
        return struct.pack("<iff", 0, 0.0, 0.0) + pack(units(depth, 0.001))
    a, b = 10100.0, -1009.0  # the transport's defaults: quantisation 100, largest depth 10 m
    return struct.pack("<iff", 0, a, b) + pack(np.rint(a / depth + b).astype(np.uint16))


def write(path, kind, messages):
    """Write (topic, seconds, (type, message)) of one `Messages` kind into a file; its path."""
    ros1 = kind == "bag"
    path.parent.mkdir(parents=True, exist_ok=True)
    if ros1:
        from rosbags.rosbag1 import Writer

        target, writer = path.with_suffix(".bag"), Writer(path.with_suffix(".bag"))
    else:
        from rosbags.rosbag2 import StoragePlugin, Writer

        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        target, writer = path, Writer(path, version=9, storage_plugin=plugin)
    store = Messages(ros1).store
    connections = {}
    with writer:
        for topic, seconds, (typename, message) in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, typename, typestore=store)
            raw = (store.serialize_ros1 if ros1 else store.serialize_cdr)(message, typename)
            writer.write(connections[topic], round(seconds * 1e9), raw)
    return target


def scene_messages(
    ros1, shifts=SHIFTS, *, depth="16UC1", colour="rgb8", info=True, lag=0.003, depth_topic=DEPTH, **more
):
    """The video as messages; `more` goes to the depth images."""
    make = Messages(ros1)
    rgb, metres, _ = video(shifts)
    found = []
    for k in range(len(rgb)):
        t = 1700000000.0 + k / FPS
        if info:
            found.append((topic_info(COLOUR), t, make.info(t)))
        if colour == "compressed":
            found.append(
                (COLOUR + "/compressed", t, make.compressed(t, png(rgb[k][..., ::-1]), "rgb8; png compressed bgr8"))
            )
        elif colour is not None:
            pixels = rgb[k][..., ::-1] if colour == "bgr8" else rgb[k]
            found.append((COLOUR, t, make.image(t, pixels, colour, padding=7)))
        if depth in ("16UC1", "mono16"):
            found.append((depth_topic, t + lag, make.image(t + lag, units(metres[k], 0.001), depth, **more)))
        elif depth == "32FC1":
            found.append((depth_topic, t + lag, make.image(t + lag, metres[k].astype(np.float32), depth, **more)))
        elif depth is not None:
            code = "rvl" if "rvl" in depth else "png"
            data = compressed_depth(metres[k], "32FC1" in depth, rvl if code == "rvl" else png)
            form = f"{'32FC1' if '32FC1' in depth else '16UC1'}; compressedDepth {code}"
            found.append((depth_topic + "/compressedDepth", t + lag, make.compressed(t + lag, data, form)))
    return found

"""A node of ROS 2: image topics in; a label image and the belief out.

The node is started by ``python ros_node.py --ros-args -p colour:=/camera/color/image_raw``. Parameters:

- ``colour``, ``depth``, ``camera_info``: topics of the camera. Colour is rectified, depth is registered to colour.
- ``depth_scale``: metres per unit of 16-bit depth (0.001). ``tolerance_s``: largest difference of two stamps (0.02).
- ``filter``: name of a preset. ``hold_s``: see `mstfilter.formats.Settled`.

Published at every pause: ``~/labels`` (sensor_msgs/Image, mono16), the objects of the estimate
(`Belief.estimate`), and ``~/belief`` (std_msgs/String), the JSON of `belief_json`. rclpy is imported when the node is
started. Everything else works on messages of any library that has their fields, such as rosbags.
"""

from __future__ import annotations

import json
import time
from collections import deque
from contextlib import ExitStack
from typing import Any

import numpy as np

from mstfilter.base.errors import missing_library, warn_user
from mstfilter.formats import Settled
from mstfilter.formats.ros_images import colour_image, depth_image
from mstfilter.mst.belief import Belief
from mstfilter.runs.live import Pause, Stream
from mstfilter.scene import outlined

_WAITING = 30  # images of each topic that wait for a partner


def stamp_of(message: Any) -> float:
    """Time stamp of a message in seconds."""
    stamp = message.header.stamp
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def camera_matrix(info: Any, colour: str = "") -> np.ndarray:
    """The matrix (3, 3) in a CameraInfo message of ROS 2 for the images of the topic `colour`.

    Rectified images, whose topic contains "rect", have the matrix in P. Other images must have no distortion.
    """
    if "rect" in colour and info.p[0] > 0:
        return np.reshape(np.asarray(info.p, float), (3, 4))[:, :3]
    if any(info.d):
        text = f"images of {colour or 'the colour topic'} have the distortion {[round(float(v), 4) for v in info.d]}"
        warn_user(f"{text}, which is ignored", "use the topic of rectified images, for example image_rect_color")
    return np.reshape(np.asarray(info.k, float), (3, 3))


class ImagePairs:
    """Pushes pairs of colour and depth messages into a stream.

    A colour image is paired with the first depth image whose stamp differs by at most `tolerance_s`. Images without a
    partner are dropped when a later pair is complete. If a driver leaves the stamps 0, images are paired in the order
    of their arrival, and the time of a pair is that of its arrival, in seconds since the first pair.
    """

    def __init__(self, stream: Stream, depth_scale: float = 0.001, tolerance_s: float = 0.02) -> None:
        self.stream, self.depth_scale, self.tolerance_s = stream, depth_scale, tolerance_s
        self.n_pairs, self._start = 0, 0.0
        self._colour: deque[Any] = deque(maxlen=_WAITING)
        self._depth: deque[Any] = deque(maxlen=_WAITING)

    def add_colour(self, message: Any) -> None:
        """Add a sensor_msgs/Image with colour."""
        self._colour.append(message)
        self._push()

    def add_depth(self, message: Any) -> None:
        """Add a sensor_msgs/Image with depth."""
        self._depth.append(message)
        self._push()

    def _push(self) -> None:
        for colour in tuple(self._colour):
            for depth in tuple(self._depth):
                if abs(stamp_of(colour) - stamp_of(depth)) > self.tolerance_s:
                    continue
                while self._colour.popleft() is not colour:
                    pass
                while self._depth.popleft() is not depth:
                    pass
                rgb = colour_image(colour, False, "colour message")
                metres = depth_image(depth, False, self.depth_scale, "depth message")
                now = time.monotonic()
                self._start = self._start or now
                self.stream.push(rgb, metres, stamp_of(colour) or now - self._start)
                self.n_pairs += 1
                break


def label_image(pause: Pause) -> np.ndarray:
    """Labels (H, W) uint16 of the objects of the estimate in the image of the pause."""
    assert pause.state.population is not None
    return outlined(Belief(pause.state.population).estimate(), pause.clip.after)


def belief_json(pause: Pause) -> str:
    """The hypotheses of a pause: weights, and for each object id, voxels, centre and oriented box in metres."""
    assert pause.state.population is not None
    found = []
    for hypothesis, weight in zip(pause.hypotheses, pause.state.population.weights, strict=True):
        objects = []
        for record in hypothesis.objects:
            T, sides = hypothesis.box(record.label)
            points = hypothesis.points(record.label)
            objects.append(
                {
                    "label": record.label,
                    "id": record.id,
                    "voxels": len(points),
                    "centre": points.mean(axis=0).round(4).tolist(),
                    "T_world_box": T.as_matrix().round(4).tolist(),
                    "sides": sides.round(4).tolist(),
                }
            )
        found.append({"weight": round(float(weight), 6), "objects": objects})
    last = pause.clip.times[-1]
    return json.dumps({"pause": pause.index, "time": last, "counts": pause.counts, "hypotheses": found})


def main() -> None:
    """Run the node until it is interrupted."""
    try:
        import rclpy
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import CameraInfo, Image
        from std_msgs.msg import String
    except ImportError as error:
        raise missing_library(error, "the node of ROS 2", "rclpy is part of ROS 2: source its setup file") from error

    rclpy.init()
    node = rclpy.create_node("mstfilter")

    def parameter(name: str, default: Any) -> Any:
        return node.declare_parameter(name, default).value

    colour = parameter("colour", "/camera/color/image_raw")
    depth = parameter("depth", "/camera/aligned_depth_to_color/image_raw")
    info = parameter("camera_info", "/camera/color/camera_info")
    settings = parameter("depth_scale", 0.001), parameter("tolerance_s", 0.02)
    name, rule = parameter("filter", "mst"), Settled(hold_s=parameter("hold_s", 0.5))
    labels, belief = node.create_publisher(Image, "~/labels", 1), node.create_publisher(String, "~/belief", 1)
    ends = ExitStack()
    streams: list[Stream] = []

    def publish(pause: Pause) -> None:
        image = label_image(pause)
        message = Image(height=image.shape[0], width=image.shape[1], encoding="mono16", step=2 * image.shape[1])
        message.header.frame_id, message.data = "camera", image.astype("<u2").tobytes()
        labels.publish(message)
        belief.publish(String(data=belief_json(pause)))

    def start(message: Any) -> None:
        if not streams:
            stream = Stream(camera_matrix(message, colour), name, pauses=rule, on_pause=publish)
            streams.append(ends.enter_context(stream))
            pairs = ImagePairs(streams[0], *settings)
            node.create_subscription(Image, colour, pairs.add_colour, qos_profile_sensor_data)
            node.create_subscription(Image, depth, pairs.add_depth, qos_profile_sensor_data)

    node.create_subscription(CameraInfo, info, start, qos_profile_sensor_data)
    try:
        with ends:  # Ctrl-C drops the frames that wait
            rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()


if __name__ == "__main__":
    main()

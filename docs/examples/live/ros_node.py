"""A node of ROS 2: image topics in; the objects of the scene out, at every pause.

The node is started by ``python ros_node.py --ros-args -p colour:=/camera/color/image_raw``. Parameters:

- ``colour``, ``depth``, ``camera_info``: topics of the camera. Colour is rectified, depth is registered to colour.
- ``depth_scale``: metres per unit of 16-bit depth (0.001). ``tolerance_s``: largest difference of two stamps (0.02).
- ``filter``: name of a preset. ``hold_s``: see `mstfilter.formats.Settled`.
- ``base_frame``: frame of all results, by default that of the colour images. ``T_base_camera``: pose of the colour
  camera (z forward, y down) in it, ``x y z qx qy qz qw``; by default, tf2_ros is asked at every pause.
- ``least_existence``: least probability of existence of a collision object (0.5).

Published at every pause, if the packages of the messages are installed:

- ``~/labels`` (sensor_msgs/Image, mono16): the number of the object at each pixel.
- ``~/objects`` (std_msgs/String): the table of objects and the open borders as JSON, see `pause_document`.
- ``~/markers`` (visualization_msgs/MarkerArray): meshes, translucent if hidden, with number and probability.
- ``collision_object`` (moveit_msgs/CollisionObject): meshes for the planning scene of MoveIt.

`ros_messages.py` beside this file makes the messages. rclpy is imported when the node is started. Everything else
works on messages of any library that has their fields, such as rosbags.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from typing import Any

import numpy as np
from ros_messages import (
    believed,
    collision_objects,
    image_message,
    make_header,
    marker_array,
    message_types,
    objects_message,
    transform_of,
    transform_of_message,
)
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError, missing_library, warn_user
from mstfilter.formats import Settled
from mstfilter.formats.ros_images import colour_image, depth_image
from mstfilter.mst.belief import Belief, BelievedObject, ObjectTable
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


def numbers_of_pixels(pause: Pause, belief: Belief, table: ObjectTable) -> np.ndarray:
    """The number (H, W) in the table of the object of the estimate at each pixel of the image of the pause."""
    labels = outlined(belief.estimate(), pause.clip.after)
    number = np.zeros(int(labels.max()) + 1, np.uint16)
    for one in table:
        if one.in_estimate and one.label < len(number):
            number[one.label] = one.number
    return number[labels]


class Publishers:
    """Publishes what is known at a pause, with the types of messages that are installed."""

    def __init__(self, node: Any, types: Any, least_existence: float = 0.5) -> None:
        self.types, self.least = types, least_existence
        self.labels = node.create_publisher(types.Image, "~/labels", 1)
        self.objects = node.create_publisher(types.String, "~/objects", 1)
        self.markers = self.scene = None
        if hasattr(types, "MarkerArray"):
            self.markers = node.create_publisher(types.MarkerArray, "~/markers", 1)
        if hasattr(types, "CollisionObject") and hasattr(types, "Mesh"):
            self.scene = node.create_publisher(types.CollisionObject, "collision_object", 100)
        self._shown: set[int] = set()  # numbers of the objects with markers
        self._planned: set[int] = set()  # and in the planning scene

    def publish(
        self,
        pause: Pause,
        belief: Belief,
        table: ObjectTable,
        of_camera: str,
        frame: str,
        T_base_camera: RigidTransform,
    ) -> None:
        """Publish the table of a pause in a `frame`, in which the camera has the pose T_base_camera."""
        camera, time_s = pause.clip.after.camera, pause.clip.times[-1]
        T_base_world = T_base_camera * camera.pose.inv()
        header = make_header(self.types, time_s, of_camera)
        self.labels.publish(image_message(self.types, header, numbers_of_pixels(pause, belief, table)))
        header = make_header(self.types, time_s, frame)
        known = {"pause": pause.index, "time": time_s, "frame": frame, "counts": pause.counts}
        self.objects.publish(objects_message(self.types, table, belief.open_borders(camera), T_base_world, **known))
        if self.markers is not None:
            gone, self._shown = _gone(self._shown, table)
            self.markers.publish(marker_array(self.types, header, table, T_base_world, gone))
        if self.scene is not None:
            sure = believed(table, self.least)
            gone, self._planned = _gone(self._planned, sure)
            for message in collision_objects(self.types, header, sure, T_base_world, gone):
                self.scene.publish(message)


def _gone(before: set[int], objects: Iterable[BelievedObject]) -> tuple[list[int], set[int]]:
    """The numbers that were there before and are not now, and those that are there now."""
    now = {one.number for one in objects}
    return sorted(before - now), now


def main() -> None:
    """Run the node until it is interrupted."""
    try:
        import rclpy
        from rclpy.qos import qos_profile_sensor_data
    except ImportError as error:
        raise missing_library(error, "the node of ROS 2", "rclpy is part of ROS 2: source its setup file") from error

    rclpy.init()
    node, types = rclpy.create_node("mstfilter"), message_types()

    def parameter(name: str, default: Any) -> Any:
        return node.declare_parameter(name, default).value

    colour = parameter("colour", "/camera/color/image_raw")
    depth = parameter("depth", "/camera/aligned_depth_to_color/image_raw")
    info = parameter("camera_info", "/camera/color/camera_info")
    settings = parameter("depth_scale", 0.001), parameter("tolerance_s", 0.02)
    name, rule = parameter("filter", "mst"), Settled(hold_s=parameter("hold_s", 0.5))
    base_of = base_finder(node, parameter("base_frame", ""), parameter("T_base_camera", ""))
    publishers = Publishers(node, types, parameter("least_existence", 0.5))
    ends = ExitStack()
    streams: list[Stream] = []
    frames: list[str] = []

    def publish(pause: Pause) -> None:
        table, base = streams[0].objects, base_of(frames[0])  # asked at every pause, so objects keep their numbers
        if base is None:
            node.get_logger().error(f"pause {pause.index} is not published: tf has no pose of {frames[0]}")
        else:
            publishers.publish(pause, streams[0].belief, table, frames[0], *base)

    def start(message: Any) -> None:
        if not streams:
            frames.append(message.header.frame_id)
            stream = Stream(camera_matrix(message, colour), name, pauses=rule, on_pause=publish)
            streams.append(ends.enter_context(stream))
            pairs = ImagePairs(streams[0], *settings)
            node.create_subscription(types.Image, colour, pairs.add_colour, qos_profile_sensor_data)
            node.create_subscription(types.Image, depth, pairs.add_depth, qos_profile_sensor_data)

    node.create_subscription(types.CameraInfo, info, start, qos_profile_sensor_data)
    try:
        with ends:  # Ctrl-C drops the frames that wait
            rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()


def base_finder(node: Any, base_frame: str, given: str) -> Callable[[str], tuple[str, RigidTransform] | None]:
    """A function from the frame of the camera to the frame of the results and T_base_camera; None if tf lacks it."""
    if given:
        T_base_camera = transform_of(given)
        if not base_frame:
            raise InputError("T_base_camera is given without base_frame", "-p base_frame:=base_link")
        return lambda camera: (base_frame, T_base_camera)
    if not base_frame:
        return lambda camera: (camera, RigidTransform.identity())
    try:
        import tf2_ros
        from rclpy.time import Time
    except ImportError as error:
        raise missing_library(
            error, "base_frame", "or give T_base_camera: -p T_base_camera:='x y z qx qy qz qw'"
        ) from error
    buffer = tf2_ros.Buffer()
    listener = tf2_ros.TransformListener(buffer, node)

    def find(camera: str) -> tuple[str, RigidTransform] | None:
        assert listener is not None  # it fills the buffer as long as it exists
        try:
            found = buffer.lookup_transform(base_frame, camera, Time())
        except tf2_ros.TransformException:
            return None
        return base_frame, transform_of_message(found.transform)

    return find


if __name__ == "__main__":
    main()

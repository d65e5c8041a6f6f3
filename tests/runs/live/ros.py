"""Message classes that are as strict as those of rclpy, on top of the types of rosbags; and a node without ROS."""

from __future__ import annotations

import array
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

_MOVEIT = {
    "object_recognition_msgs/msg/ObjectType": "string key\nstring db",
    "moveit_msgs/msg/CollisionObject": """
std_msgs/Header header
geometry_msgs/Pose pose
string id
object_recognition_msgs/ObjectType type
shape_msgs/SolidPrimitive[] primitives
geometry_msgs/Pose[] primitive_poses
shape_msgs/Mesh[] meshes
geometry_msgs/Pose[] mesh_poses
shape_msgs/Plane[] planes
geometry_msgs/Pose[] plane_poses
string[] subframe_names
geometry_msgs/Pose[] subframe_poses
byte ADD=0
byte REMOVE=1
byte APPEND=2
byte MOVE=3
byte operation
""",
}
STORE = get_typestore(Stores.ROS2_HUMBLE)
for _name, _text in _MOVEIT.items():
    STORE.register(get_types_from_msg(_text, _name))
_BITS = {f"{sign}int{n}": (sign == "", n) for sign in ("", "u") for n in (8, 16, 32, 64)}


def _dtype(base):
    return np.dtype("u1" if base in ("byte", "octet", "char") else base)


def _scalar(base, value, where):
    if base == "string":
        assert isinstance(value, str), where
    elif base == "bool":
        assert isinstance(value, bool), where
    elif base.startswith("float"):
        assert isinstance(value, float) and (base == "float64" or np.isnan(value) or abs(value) < 3.4e38), where
    elif base in ("byte", "octet"):
        assert isinstance(value, bytes) and len(value) == 1, where
        return value[0]
    else:
        signed, n = _BITS[base]
        assert isinstance(value, int) and not isinstance(value, bool), where
        assert -(signed << (n - 1)) <= value < 1 << (n - signed), where
    return value


def _checked(kind, value, where):
    """A value as rosbags wants it; AssertionError where the setters of rclpy have one."""
    node, inner = kind
    if node.name == "BASE":
        return _scalar(inner[0], value, where)
    if node.name == "NAME":
        assert type(value) is STORE.types[inner], where
        return value
    (item, what), size = inner
    if item.name == "NAME":
        assert isinstance(value, list) and all(type(one) is STORE.types[what] for one in value), where
        assert node.name == "SEQUENCE" or len(value) == size, where
        return value
    base = what[0]
    if node.name == "ARRAY":
        assert isinstance(value, np.ndarray) and value.dtype == _dtype(base) and value.shape == (size,), where
        return value
    if base == "string":
        assert isinstance(value, list) and all(isinstance(one, str) for one in value), where
        return value
    assert isinstance(value, (array.array, list, tuple, bytes)), where
    return np.array(
        [_scalar(base, one, where) for one in value] if not isinstance(value, array.array) else value, _dtype(base)
    )


def _default(kind):
    node, inner = kind
    if node.name == "NAME":
        return Message(inner)()
    if node.name == "BASE":
        base = inner[0]
        return {"string": "", "bool": False, "byte": b"\0", "octet": b"\0"}.get(base, 0.0 if "float" in base else 0)
    (item, what), size = inner
    if node.name == "ARRAY" and item.name == "BASE":
        return np.zeros(size, _dtype(what[0]))
    return [_default((item, what)) for _ in range(size)] if node.name == "ARRAY" else []


class Message:
    """A message class: its constants, and keyword arguments that are checked; the others have default values."""

    def __init__(self, name):
        self.name = name
        constants, self.fields = STORE.fielddefs[name]
        for constant, base, value in constants:
            setattr(self, constant, bytes([value]) if base in ("byte", "octet") else value)

    def __call__(self, **values):
        kinds = dict(self.fields)
        assert not values.keys() - kinds.keys(), f"{self.name} has no {values.keys() - kinds.keys()}"
        return STORE.types[self.name](
            **{k: _checked(kind, values.get(k, _default(kind)), f"{self.name}.{k}") for k, kind in kinds.items()}
        )


def install(monkeypatch, classes, without=()):
    """Make ``from package.msg import Name`` work for {package: names}, but not for packages in `without`."""
    for package, names in classes.items():
        module = ModuleType(f"{package}.msg")
        for name in names:
            setattr(module, name, Message(f"{package}/msg/{name}"))
        monkeypatch.setitem(sys.modules, package, None if package in without else ModuleType(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", None if package in without else module)


def round_trip(message):
    """The message after it was serialised as CDR and read again."""
    name = message.__msgtype__
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, name), name)


class Node:
    """What the example uses of rclpy; `spin` gives (topic, seconds, (type, message)) to the subscriptions."""

    def __init__(self, parameters, messages):
        self.parameters, self.messages = parameters, messages
        self.published, self.errors, self.callbacks, self.topics = [], [], {}, {}

    def install(self, monkeypatch):
        rclpy = ModuleType("rclpy")
        rclpy.init, rclpy.create_node, rclpy.spin = lambda: None, lambda name: self, self.spin
        rclpy.qos, rclpy.time = ModuleType("rclpy.qos"), ModuleType("rclpy.time")
        rclpy.qos.qos_profile_sensor_data, rclpy.time.Time = "sensor", lambda: "latest"
        for name, module in (("rclpy", rclpy), ("rclpy.qos", rclpy.qos), ("rclpy.time", rclpy.time)):
            monkeypatch.setitem(sys.modules, name, module)

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=self.parameters.pop(name, default))

    def create_publisher(self, kind, topic, depth):
        self.topics[topic] = kind.name

        def publish(message):
            assert message.__msgtype__ == kind.name
            self.published.append((topic, message))

        return SimpleNamespace(publish=publish)

    def create_subscription(self, kind, topic, callback, qos):
        self.callbacks[topic] = callback

    def get_logger(self):
        return SimpleNamespace(error=self.errors.append)

    def destroy_node(self):
        self.destroyed = True

    def spin(self, node):
        for topic, _, (_, message) in self.messages:
            if topic in self.callbacks:
                self.callbacks[topic](message)

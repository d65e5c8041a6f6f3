"""Messages of ROS 2 from a table of objects (`Belief.objects`): JSON, markers for RViz, collision objects for MoveIt.

>>> types = message_types()                                       # the classes of the installed packages
>>> header = make_header(types, 12.5, "base_link")
>>> marker_array(types, header, table, T_base_world)              # types.MarkerArray
>>> collision_objects(types, header, believed(table, 0.9), T_base_world)

The functions take the message classes, so they work without ROS on any classes with these fields. Objects are named
by their numbers in the table, which last from pause to pause. Every mesh is in the frame of the oriented box of its
object, whose pose in the frame of the header is the pose of the message.
"""

from __future__ import annotations

import json
from array import array
from collections.abc import Iterable
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.base.errors import InputError
from mstfilter.mst.belief import BelievedObject, Border, ObjectTable, pause_document

_CLASSES = {
    "builtin_interfaces": ("Time",),
    "std_msgs": ("Header", "String", "ColorRGBA"),
    "sensor_msgs": ("CameraInfo", "Image"),
    "geometry_msgs": ("Point", "Pose", "Quaternion", "Vector3"),
    "visualization_msgs": ("Marker", "MarkerArray"),
    "shape_msgs": ("Mesh", "MeshTriangle"),
    "moveit_msgs": ("CollisionObject",),
}
_GREY = (150, 150, 150)  # of an object without known colour
_HIDDEN, _VISIBLE = 0.35, 0.95  # opacity
_LETTERS = 0.03  # metres: height of a text, and its distance from the object


def message_types() -> SimpleNamespace:
    """The message classes of the packages that are installed, by name."""
    found: dict[str, Any] = {}
    for package, names in _CLASSES.items():
        try:
            module = import_module(f"{package}.msg")
        except ImportError:
            continue
        found |= {name: getattr(module, name) for name in names}
    return SimpleNamespace(**found)


def transform_of(text: str) -> RigidTransform:
    """The transform in the parameter ``x y z qx qy qz qw``, as in ``static_transform_publisher``."""
    try:
        x, y, z, *quaternion = map(float, text.split())
        return RigidTransform.from_components([x, y, z], Rotation.from_quat(quaternion))
    except ValueError as error:
        raise InputError(f"T_base_camera is {text!r} ({error})", "seven numbers: x y z qx qy qz qw") from error


def transform_of_message(message: Any) -> RigidTransform:
    """The transform in a geometry_msgs/Transform."""
    p, q = message.translation, message.rotation
    return RigidTransform.from_components([p.x, p.y, p.z], Rotation.from_quat([q.x, q.y, q.z, q.w]))


def make_header(types: Any, seconds: float, frame: str) -> Any:
    """A std_msgs/Header."""
    whole, rest = divmod(seconds, 1.0)
    stamp = types.Time(sec=int(whole), nanosec=min(round(rest * 1e9), 999_999_999))
    return types.Header(stamp=stamp, frame_id=frame)


def image_message(types: Any, header: Any, numbers: np.ndarray) -> Any:
    """A sensor_msgs/Image (mono16) of the number of the object (H, W) that each pixel shows."""
    size = {"height": numbers.shape[0], "width": numbers.shape[1], "step": 2 * numbers.shape[1]}
    data = array("B", numbers.astype("<u2").tobytes())
    return types.Image(header=header, encoding="mono16", is_bigendian=0, data=data, **size)


def objects_message(
    types: Any, table: ObjectTable, borders: Iterable[Border], T_base_world: RigidTransform, **entries: Any
) -> Any:
    """A std_msgs/String with the JSON of `pause_document`: entries, objects in the base frame, open borders."""
    return types.String(data=json.dumps(pause_document(table, borders, T_base_world, **entries)))


def believed(table: ObjectTable, at_least: float) -> list[BelievedObject]:
    """The objects that exist with this probability or a larger one."""
    return [one for one in table if one.existence >= at_least]


def marker_array(
    types: Any,
    header: Any,
    objects: Iterable[BelievedObject],
    T_base_world: RigidTransform,
    gone: Iterable[int] = (),
) -> Any:
    """A visualization_msgs/MarkerArray: mesh and text of each object, deletions of the objects that are `gone`."""
    kind, found = types.Marker, []
    for number in gone:
        found += [kind(header=header, ns=ns, id=number, action=kind.DELETE) for ns in ("objects", "texts")]
    for one in objects:
        T_box_world = one.T_world_box.inv()
        corners, triangles = one.mesh()
        top = np.append(one.centre[:2], corners[:, 2].max() + _LETTERS)
        common = {"header": header, "id": one.number, "action": kind.ADD}
        mesh = {
            "ns": "objects",
            "type": kind.TRIANGLE_LIST,
            "pose": _pose(types, T_base_world * one.T_world_box),
            "scale": types.Vector3(x=1.0, y=1.0, z=1.0),
            "color": _colour(types, one.colour or _GREY, _VISIBLE if one.visible else _HIDDEN),
            "points": _points(types, T_box_world.apply(corners)[triangles.ravel()]),
        }
        text = {
            "ns": "texts",
            "type": kind.TEXT_VIEW_FACING,
            "pose": _pose(types, RigidTransform.from_translation(T_base_world.apply(top))),
            "scale": types.Vector3(x=0.0, y=0.0, z=_LETTERS),
            "color": _colour(types, (255, 255, 255), 1.0),
            "text": f"{one.number}: {one.existence:.2f}",
        }
        found += [kind(**common, **mesh), kind(**common, **text)]
    return types.MarkerArray(markers=found)


def collision_objects(
    types: Any,
    header: Any,
    objects: Iterable[BelievedObject],
    T_base_world: RigidTransform,
    gone: Iterable[int] = (),
) -> list[Any]:
    """moveit_msgs/CollisionObject messages: ADD for each object, which replaces an earlier one; REMOVE if `gone`."""
    kind = types.CollisionObject
    found = [kind(header=header, id=_name(number), operation=kind.REMOVE) for number in gone]
    for one in objects:
        corners, triangles = one.mesh()
        mesh = types.Mesh(
            triangles=[types.MeshTriangle(vertex_indices=indices) for indices in triangles.astype(np.uint32)],
            vertices=_points(types, one.T_world_box.inv().apply(corners)),
        )
        found.append(
            kind(
                header=header,
                pose=_pose(types, T_base_world * one.T_world_box),
                id=_name(one.number),
                meshes=[mesh],
                mesh_poses=[_pose(types, RigidTransform.identity())],
                operation=kind.ADD,
            )
        )
    return found


def _name(number: int) -> str:
    return f"mstfilter_{number}"


def _pose(types: Any, T: RigidTransform) -> Any:
    at, turn = T.translation.tolist(), T.rotation.as_quat().tolist()
    position = types.Point(**dict(zip("xyz", at, strict=True)))
    return types.Pose(position=position, orientation=types.Quaternion(**dict(zip("xyzw", turn, strict=True))))


def _points(types: Any, points: np.ndarray) -> list[Any]:
    return [types.Point(x=x, y=y, z=z) for x, y, z in points.tolist()]


def _colour(types: Any, rgb: Iterable[int], opacity: float) -> Any:
    r, g, b = (value / 255 for value in rgb)
    return types.ColorRGBA(r=r, g=g, b=b, a=opacity)

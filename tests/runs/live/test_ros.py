"""The example of ROS 2: every message is serialised and read again; the node, with the messages of a known scene."""

from __future__ import annotations

import json
import sys
import warnings
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import ros_messages
import ros_node
from scipy.spatial.transform import RigidTransform, Rotation

import mstfilter
from mstfilter.base.errors import InputError, InputWarning
from mstfilter.scene import outlined
from tests.formats.bags import scene_messages
from tests.formats.layouts import video
from tests.mst.belief.test_objects import CAMERA as VIEW, FAR, GRID, HIDDEN, LEFT, at, belief_of, scene, two_readings
from tests.runs.live.ros import STORE, Node, install, round_trip
from tests.runs.live.test_stream import QUICK
from tests.scene.scenes import CAMERA, GRID as TRUE_GRID

#: Base: x of the world is y, y is -x; then the world's origin is at (1, 2, 0.7).
T_BASE_WORLD = RigidTransform.from_components([1.0, 2.0, 0.7], Rotation.from_euler("z", 90, degrees=True))


def in_base(box):
    """Corners of a box of voxels in the frame of the base, by hand."""
    low, high = (np.array([(getattr(s, end) or 0) * 0.01 for s in box]) + GRID.origin for end in ("start", "stop"))
    return np.array([1 - high[1], 2 + low[0], 0.7 + low[2]]), np.array([1 - low[1], 2 + high[0], 0.7 + high[2]])


@pytest.fixture
def types(monkeypatch):
    install(monkeypatch, ros_messages._CLASSES)
    return ros_messages.message_types()


@pytest.fixture
def header(types):
    return ros_messages.make_header(types, 1700000000.25, "base_link")


def triangles_of(marker):
    """The triangles (n, 3, 3) of a marker in the frame of its header."""
    points = np.array([[p.x, p.y, p.z] for p in marker.points])
    return moved(marker.pose, points).reshape(-1, 3, 3)


def moved(pose, points):
    p, q = pose.position, pose.orientation
    return Rotation.from_quat([q.x, q.y, q.z, q.w]).apply(points) + [p.x, p.y, p.z]


def volume(triangles):
    a, b, c = np.moveaxis(triangles - triangles.mean(axis=(0, 1)), 1, 0)
    return (a * np.cross(b, c)).sum() / 6


def test_markers_are_the_objects_in_the_base_frame(types, header):
    table = two_readings().objects()
    far, hidden = at(table, FAR), at(table, HIDDEN)
    found = round_trip(ros_messages.marker_array(types, header, table, T_BASE_WORLD, gone=[9])).markers
    kind = types.Marker
    assert [(m.ns, m.id, m.action) for m in found[:2]] == [("objects", 9, kind.DELETE), ("texts", 9, kind.DELETE)]
    shapes = {m.id: m for m in found if m.type == kind.TRIANGLE_LIST}
    texts = {m.id: m for m in found if m.type == kind.TEXT_VIEW_FACING}
    assert set(shapes) == set(texts) == {one.number for one in table}
    for one, box in ((far, FAR), (hidden, HIDDEN)):
        drawn = triangles_of(shapes[one.number])
        low, high = in_base(box)
        np.testing.assert_allclose(drawn.min(axis=(0, 1)), low, atol=1e-6)
        np.testing.assert_allclose(drawn.max(axis=(0, 1)), high, atol=1e-6)
        assert 0.75 * np.prod(high - low) < volume(drawn) <= np.prod(high - low)  # positive: seen from outside
        at_text = moved(texts[one.number].pose, np.zeros(3))
        np.testing.assert_allclose(at_text, [*((low + high) / 2)[:2], high[2] + 0.03], atol=1e-6)
    assert shapes[far.number].color.a > 0.9 and shapes[hidden.number].color.a < 0.5
    assert texts[hidden.number].text == f"{hidden.number}: 0.60" and texts[hidden.number].color.a == 1
    for m in found:
        assert (m.header.frame_id, m.header.stamp.sec, m.header.stamp.nanosec) == ("base_link", 1700000000, 250000000)
        assert m.action == kind.DELETE or min(m.scale.x, m.scale.z) >= 0 < m.scale.z


def test_the_main_colour_is_that_of_the_marker(types, header):
    [one] = belief_of((1.0, scene(FAR))).objects()
    for colour, want in (((255, 0, 51), (1, 0, 0.2)), (None, (150 / 255,) * 3)):
        object.__setattr__(one, "colour", colour)
        made = ros_messages.marker_array(types, header, [one], T_BASE_WORLD).markers[0].color
        np.testing.assert_allclose((made.r, made.g, made.b), want)


def test_collision_objects_are_what_is_believed(types, header):
    table = two_readings().objects()
    far, hidden = at(table, FAR), at(table, HIDDEN)
    sure = ros_messages.believed(table, 0.9)
    assert hidden not in sure and far in sure and len(sure) == 3
    made = ros_messages.collision_objects(types, header, sure, T_BASE_WORLD, gone=[hidden.number])
    read = {one.id: one for one in map(round_trip, made)}
    gone = read.pop(f"mstfilter_{hidden.number}")
    assert (gone.operation, gone.meshes) == (1, [])
    assert set(read) == {f"mstfilter_{one.number}" for one in sure}
    one = read[f"mstfilter_{far.number}"]
    assert one.operation == 0 and one.header.frame_id == "base_link" and len(one.mesh_poses) == 1
    [mesh] = one.meshes
    corners = moved(one.pose, moved(one.mesh_poses[0], np.array([[p.x, p.y, p.z] for p in mesh.vertices])))
    indices = np.array([t.vertex_indices for t in mesh.triangles])
    low, high = in_base(FAR)
    np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [low, high], atol=1e-6)
    assert 0.75 * np.prod(high - low) < volume(corners[indices]) <= np.prod(high - low)
    middle = moved(one.pose, np.zeros(3))
    np.testing.assert_allclose(middle, (low + high) / 2, atol=1e-6)  # the pose is that of the box


def test_json_is_in_the_base_frame(types):
    belief = two_readings(p_one=0.25)
    table = belief.objects()
    made = ros_messages.objects_message(
        types, table, belief.open_borders(VIEW), T_BASE_WORLD, pause=3, time=2.5, frame="base_link"
    )
    found = json.loads(round_trip(made).data)
    assert (found["pause"], found["time"], found["frame"]) == (3, 2.5, "base_link")
    far = next(row for row in found["objects"] if row["object"] == at(table, FAR).number)
    low, high = in_base(FAR)
    np.testing.assert_allclose(far["centre"], (low + high) / 2, atol=1e-5)
    [border] = found["open_borders"]
    assert border["one_object"] == pytest.approx(0.25, abs=1e-4) and border["middle"] in border["pixels"]
    # The boxes touch in the plane x = -0.04 m of the world.
    x = VIEW.project(np.array([[-0.04, -0.05, 0.0], [-0.04, 0.02, 0.09]]))[0][:, 0]
    columns = np.array(border["pixels"])[:, 0]
    assert x.min() - 3 < columns.min() and columns.max() < x.max() + 3


def test_the_image_has_the_numbers(types, header):
    numbers = np.arange(12, dtype=np.uint16).reshape(3, 4) * 100
    image = round_trip(ros_messages.image_message(types, header, numbers))
    assert (image.height, image.width, image.step, image.encoding) == (3, 4, 8, "mono16")
    np.testing.assert_array_equal(image.data.view("<u2").reshape(3, 4), numbers)


def test_wrong_types_are_noticed(types, header):
    """The strict classes reject what rclpy rejects, or the tests above would show nothing."""
    for wrong in ({"id": np.int64(1)}, {"ns": 3}, {"scale": (1.0, 1.0, 1.0)}, {"points": np.zeros((3, 3))}, {"x": 1}):
        with pytest.raises(AssertionError):
            types.Marker(**wrong)
    for cls, wrong in (
        (types.Point, {"x": 1}),
        (types.MeshTriangle, {"vertex_indices": np.arange(3)}),
        (types.CollisionObject, {"operation": 0}),
    ):
        with pytest.raises(AssertionError):
            cls(**wrong)


def test_a_bag_of_all_messages(types, header, tmp_path):
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer

    belief = two_readings()
    table = belief.objects()
    messages = {
        "/labels": [ros_messages.image_message(types, header, np.ones((4, 4), np.uint16))],
        "/objects": [ros_messages.objects_message(types, table, [], T_BASE_WORLD)],
        "/markers": [ros_messages.marker_array(types, header, table, T_BASE_WORLD)],
        "/collision_object": ros_messages.collision_objects(types, header, table, T_BASE_WORLD),
    }
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, many in messages.items():
            name = many[0].__msgtype__
            connection = writer.add_connection(topic, name, typestore=STORE)
            for k, one in enumerate(many):
                writer.write(connection, k, STORE.serialize_cdr(one, name))
    with Reader(tmp_path / "bag") as reader:
        read = [(c.topic, STORE.deserialize_cdr(raw, c.msgtype)) for c, _, raw in reader.messages()]
    assert sorted(topic for topic, _ in read) == sorted(topic for topic, many in messages.items() for _ in many)
    assert {one.id for topic, one in read if topic == "/collision_object"} == {f"mstfilter_{k}" for k in (1, 2, 3, 4)}


def test_transforms():
    T = ros_messages.transform_of("0.4 0 0.7 0 0 1 0")
    np.testing.assert_allclose(T.apply([1, 0, 0]), [-0.6, 0, 0.7], atol=1e-12)
    message = SimpleNamespace(
        translation=SimpleNamespace(x=0.4, y=0.0, z=0.7), rotation=SimpleNamespace(x=0.0, y=0.0, z=1.0, w=0.0)
    )
    np.testing.assert_allclose(ros_messages.transform_of_message(message).as_matrix(), T.as_matrix(), atol=1e-12)
    for wrong in ("0.4 0 0.7", "0 0 0 0 0 0 0", "a b c d e f g"):
        with pytest.raises(InputError, match=r"(?s)T_base_camera is .*x y z qx qy qz qw"):
            ros_messages.transform_of(wrong)


# --- the node ---------------------------------------------------------------------------------------------------
def text_of(T):
    return " ".join(str(x) for x in (*T.translation, *T.rotation.as_quat()))


def started(monkeypatch, parameters, without=()):
    """The node after it has had all messages of the known scene, and the pauses of its stream."""
    found = []

    def stream(K, name, pauses, on_pause):
        assert name == "floor"
        return mstfilter.Stream(K, QUICK, pauses=pauses, on_pause=lambda p: (on_pause(p), found.append(p)))

    install(monkeypatch, ros_messages._CLASSES, without)
    monkeypatch.setattr(ros_node, "Stream", stream)
    node = Node({"filter": "floor", "hold_s": 0.3, **parameters}, scene_messages(False))
    node.install(monkeypatch)
    ros_node.main()
    assert not node.parameters and node.destroyed
    return node, found


def test_the_node_publishes_the_scene_in_the_base_frame(monkeypatch):
    T_base_camera = T_BASE_WORLD * CAMERA.pose  # so the base sees the known world from T_BASE_WORLD
    node, found = started(monkeypatch, {"base_frame": "base_link", "T_base_camera": text_of(T_base_camera)})
    assert len(found) == 2 and not node.errors
    of = {topic: [round_trip(m) for t, m in node.published if t == topic] for topic in node.topics}
    assert [len(of[t]) for t in ("~/labels", "~/objects", "~/markers")] == [2, 2, 2]
    known = json.loads(of["~/objects"][1].data)
    assert known["pause"] == 1 and known["frame"] == "base_link" and known["counts"]["pushed"] > 10
    [row] = known["objects"]  # this filter has one object: all that is there
    image = of["~/labels"][1].data.view("<u2").reshape(120, 160)
    estimate = mstfilter.Belief(found[1].state.population).estimate()
    np.testing.assert_array_equal(image, row["object"] * (outlined(estimate, found[1].clip.after) > 0))
    assert {m.header.frame_id for m in of["collision_object"]} == {"base_link"}
    assert {m.header.frame_id for m in of["~/labels"]} == {"camera_color_optical_frame"}
    assert of["~/labels"][1].header.stamp.sec == 1700000001
    points = T_BASE_WORLD.apply(TRUE_GRID.centre_of(np.argwhere(video()[2][-1])))  # the true voxels
    [mesh] = of["collision_object"][-1].meshes
    corners = moved(of["collision_object"][-1].pose, np.array([[p.x, p.y, p.z] for p in mesh.vertices]))
    drawn = triangles_of(next(m for m in of["~/markers"][1].markers if m.ns == "objects"))
    for made in (corners, drawn.reshape(-1, 3)):
        np.testing.assert_allclose(made.min(axis=0), points.min(axis=0), atol=0.03)
        np.testing.assert_allclose(made.max(axis=0), points.max(axis=0), atol=0.03)


def test_without_a_base_the_frame_is_that_of_the_camera(monkeypatch):
    node, found = started(monkeypatch, {}, without=("moveit_msgs",))
    assert "collision_object" not in node.topics and set(node.topics) == {"~/labels", "~/objects", "~/markers"}
    known = json.loads(next(m.data for t, m in node.published if t == "~/objects"))
    assert known["frame"] == "camera_color_optical_frame"
    [row] = known["objects"]
    belief = mstfilter.Belief(found[0].state.population)
    camera = found[0].clip.after.camera
    np.testing.assert_allclose(row["centre"], camera.pose.inv().apply(belief.objects()[0].centre), atol=1e-4)
    assert row["centre"][2] > 0.3  # in front of the camera


def test_markers_of_objects_that_are_gone_are_deleted(types, monkeypatch):
    node = Node({}, [])
    publishers = ros_node.Publishers(node, types, least_existence=0.7)
    monkeypatch.setattr(ros_node, "numbers_of_pixels", lambda *pause: np.zeros((2, 2), np.uint16))
    clip = SimpleNamespace(after=SimpleNamespace(camera=VIEW), times=(0.0,))
    first = two_readings()
    before = first.objects()
    far = at(before, FAR)
    later = belief_of((0.6, scene(FAR)), (0.4, scene(FAR, LEFT)))
    now = later.objects(previous=before)
    for belief, table in ((first, before), (later, now)):
        pause = SimpleNamespace(index=0, clip=clip, counts={})
        publishers.publish(pause, belief, table, "camera", "base_link", RigidTransform.identity())
    markers = [m for t, m in node.published if t == "~/markers"][1].markers
    deleted = {m.id for m in markers if m.action == types.Marker.DELETE}
    assert deleted == {one.number for one in before} - {one.number for one in now} and deleted
    scene_of = {}
    for topic, message in node.published:
        if topic == "collision_object":
            scene_of[message.id] = message.operation
    assert {k for k, operation in scene_of.items() if operation == 0} == {f"mstfilter_{far.number}"}


@pytest.mark.parametrize("known", [True, False])
def test_the_pose_of_the_camera_is_asked_of_tf(monkeypatch, known):
    T = T_BASE_WORLD * CAMERA.pose
    tf2 = ModuleType("tf2_ros")
    tf2.TransformException = LookupError
    p, q = T.translation.tolist(), T.rotation.as_quat().tolist()
    transform = SimpleNamespace(
        translation=SimpleNamespace(**dict(zip("xyz", p, strict=True))),
        rotation=SimpleNamespace(**dict(zip("xyzw", q, strict=True))),
    )

    def lookup(base, camera, time):
        assert (base, camera, time) == ("base_link", "camera_color_optical_frame", "latest")
        if not known:
            raise LookupError
        return SimpleNamespace(transform=transform)

    tf2.Buffer = lambda: SimpleNamespace(lookup_transform=lookup)
    tf2.TransformListener = lambda buffer, node: object()
    monkeypatch.setitem(sys.modules, "tf2_ros", tf2)
    node, found = started(monkeypatch, {"base_frame": "base_link"})
    assert len(found) == 2
    if known:
        centre = json.loads(next(m.data for t, m in node.published if t == "~/objects"))["objects"][0]["centre"]
        assert centre[2] == pytest.approx(0.75, abs=0.06)  # the table is at .7 m
    else:
        assert not node.published and node.errors[0].endswith("tf has no pose of camera_color_optical_frame")


def test_a_base_frame_needs_a_pose(monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    monkeypatch.setitem(sys.modules, "rclpy.time", ModuleType("rclpy.time"))
    with pytest.raises(InputError, match=r"(?s)base_frame needs tf2_ros.*T_base_camera"):
        ros_node.base_finder(None, "base_link", "")
    with pytest.raises(InputError, match=r"(?s)without base_frame.*base_link"):
        ros_node.base_finder(None, "", "0 0 0 0 0 0 1")


def test_a_table_at_any_height_is_known_in_the_base_frame():
    """As on the page on robots: a stream without poses, and one whose poses are those in the base."""
    rgb, depth, truth = video()
    T_base_camera = T_BASE_WORLD * CAMERA.pose
    points = T_BASE_WORLD.apply(TRUE_GRID.centre_of(np.argwhere(truth[0])))
    for pose in (None, T_base_camera):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)  # the world of the poses is shifted to the table
            with mstfilter.Stream(CAMERA.K, QUICK, pauses=None) as stream:
                stream.push(rgb[0], depth[0], 0.0, pose=pose, pause=True)
                stream.wait()
                [one] = stream.objects
                camera = stream.last.clip.after.camera
        T_base_world = T_base_camera * camera.pose.inv()
        corners = T_base_world.apply(one.mesh()[0])
        np.testing.assert_allclose(corners.min(axis=0), points.min(axis=0), atol=0.03)
        np.testing.assert_allclose(corners.max(axis=0), points.max(axis=0), atol=0.03)
        np.testing.assert_allclose(one.row(T_base_world)["centre"][2], points[:, 2].mean(), atol=0.02)

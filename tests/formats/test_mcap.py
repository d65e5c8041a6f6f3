"""MCAP files of Foxglove's schemas and of ROS 1, written by the libraries of MCAP; and bags without metadata.yaml."""

from __future__ import annotations

import base64
import json
import sys

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.formats import open_recording
from mstfilter.formats.bag import Bag
from mstfilter.formats.pauses import Ends
from tests.formats.bags import Messages, png, scene_messages, write
from tests.formats.layouts import FPS, PAUSES, SHIFTS, K, units, video
from tests.formats.test_layouts import WORLD, same_frames

pytest.importorskip("rosbags", reason="rosbags absent: pip install -e '.[bags]'")
pytest.importorskip("mcap", reason="mcap absent: pip install -e '.[bags]'")

START = 1700000000
SCHEMAS = ("CompressedImage", "RawImage", "CameraCalibration")


def matrices(k=K):
    fx, fy, cx, cy = k
    return {"K": [fx, 0, cx, 0, fy, cy, 0, 0, 1], "P": [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]}


def foxglove(shifts=SHIFTS, depth="16UC1", lag_ns=3_000_000):
    """(topic, schema, stamp in ns, fields) of the video: PNG colour, depth and one calibration with another name."""
    rgb, metres, _ = video(shifts)
    for k in range(len(shifts)):
        t = START * 10**9 + round(k / FPS * 1e9)
        shared = {"frame_id": "camera_color_optical_frame"}
        size = {"width": 160, "height": 120}
        if k == 0:
            calibration = {**shared, **size, "distortion_model": "plumb_bob", "D": [0.0] * 5, **matrices()}
            yield "/calibration/front", "CameraCalibration", t, calibration
        yield "/front", "CompressedImage", t, {**shared, "data": png(rgb[k][..., ::-1]), "format": "png"}
        if depth == "png":
            fields = {**shared, "data": png(units(metres[k], 0.001)), "format": "png"}
            yield "/front/depth", "CompressedImage", t + lag_ns, fields
        else:
            pixels = units(metres[k], 0.001) if depth == "16UC1" else metres[k].astype(np.float32)
            data = pixels.astype(pixels.dtype.newbyteorder("<")).tobytes()
            fields = {**shared, **size, "encoding": depth, "step": 160 * pixels.itemsize, "data": data}
            yield "/front/depth", "RawImage", t + lag_ns, fields


def write_json(path, messages):
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer, channels = Writer(file), {}
        writer.start()
        for topic, name, t, fields in messages:
            if topic not in channels:
                schema = writer.register_schema(f"foxglove.{name}", "jsonschema", b'{"type": "object"}')
                channels[topic] = writer.register_channel(topic, "json", schema)
            stored = {"timestamp": {"sec": t // 10**9, "nsec": t % 10**9}, **fields}
            if "data" in stored:
                stored["data"] = base64.b64encode(stored["data"]).decode()
            writer.add_message(channels[topic], t, json.dumps(stored).encode(), t)
        writer.finish()
    return path


def write_protobuf(path, messages):
    pytest.importorskip("mcap_protobuf", reason="mcap-protobuf-support absent: pip install -e '.[bags]'")
    reason = "foxglove-schemas-protobuf absent: pip install -e '.[dev]'"
    pytest.importorskip("foxglove_schemas_protobuf", reason=reason)
    from importlib import import_module

    from google.protobuf.timestamp_pb2 import Timestamp
    from mcap_protobuf.writer import Writer

    kinds = {n: getattr(import_module(f"foxglove_schemas_protobuf.{n}_pb2"), n) for n in SCHEMAS}
    with path.open("wb") as file, Writer(file) as writer:
        for topic, name, t, fields in messages:
            message = kinds[name](timestamp=Timestamp(seconds=t // 10**9, nanos=t % 10**9), **fields)
            writer.write_message(topic, message, log_time=t, publish_time=t)
    return path


def write_ros1(path, messages):
    """Messages of ROS 1, with the definitions that rosbags generates."""
    from mcap.writer import Writer

    store = Messages(True).store
    with path.open("wb") as file:
        writer, channels = Writer(file), {}
        writer.start(profile="ros1")
        for topic, seconds, (name, message) in messages:
            if topic not in channels:
                text = store.generate_msgdef(name)[0].encode()
                schema = writer.register_schema(name.replace("/msg/", "/"), "ros1msg", text)
                channels[topic] = writer.register_channel(topic, "ros1", schema)
            t = round(seconds * 1e9)
            writer.add_message(channels[topic], t, bytes(store.serialize_ros1(message, name)), t)
        writer.finish()
    return path


@pytest.mark.parametrize("depth", ["16UC1", "32FC1", "png"])
@pytest.mark.parametrize("writer", [write_json, write_protobuf])
def test_messages_of_foxglove(tmp_path, writer, depth):
    path = writer(tmp_path / "session.mcap", foxglove(depth=depth))
    recording = Bag(world=WORLD).open(path)
    same_frames(recording, SHIFTS)
    assert recording.pauses == PAUSES
    np.testing.assert_allclose(recording.times, np.arange(len(SHIFTS)) / FPS, atol=1e-6)


def test_messages_of_ros_1_in_an_mcap_file(tmp_path):
    path = write_ros1(tmp_path / "session.mcap", scene_messages(True, depth="compressed 16UC1", colour="bgr8"))
    recording = open_recording(path)
    assert recording.pauses == PAUSES
    same_frames(Bag(world=WORLD).open(path), SHIFTS)


def test_a_calibration_of_another_frame_is_not_used(tmp_path):
    messages = [[*m] for m in foxglove((0, 1))]
    messages[0][3]["frame_id"] = "other"
    path = write_json(tmp_path / "session.mcap", messages)
    with pytest.raises(InputError, match="intrinsics are missing"):
        Bag().open(path)
    same_frames(Bag(K=K, pauses=Ends(), world=WORLD).open(path), (0, 1))


def test_what_is_not_read_is_named(tmp_path, monkeypatch):
    from mcap.writer import Writer

    path = tmp_path / "video.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedVideo", "jsonschema", b"{}")
        writer.add_message(writer.register_channel("/film", "json", schema), 1, b"{}", 1)
        writer.finish()
    with pytest.raises(InputError, match=r"not read: /film \(foxglove.CompressedVideo, json\)") as caught:
        Bag().open(path)
    assert "record images" in caught.value.hints[1]
    monkeypatch.setitem(sys.modules, "mcap.reader", None)
    with pytest.raises(InputError, match="needs mcap") as caught:
        Bag().open(path)
    assert "mstfilter[bags]" in caught.value.hints[0]


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_a_folder_without_metadata(tmp_path, kind):
    """Also in two files, as ros2 bag divides long recordings."""
    messages = scene_messages(False)
    half = len(messages) // 2 + 1
    write(tmp_path / "a", kind, messages[:half])
    write(tmp_path / "b", kind, messages[half:])
    folder = tmp_path / "session"
    folder.mkdir()
    for name in "ab":
        (file,) = (tmp_path / name).glob(f"*.{kind}")
        file.rename(folder / f"session_{name}.{kind}")
    assert Bag.detects(folder)
    recording = Bag(world=WORLD).open(folder)
    same_frames(recording, SHIFTS)
    assert recording.pauses == PAUSES
    (folder / "other.mcap").write_bytes(b"")
    (folder / "other.db3").write_bytes(b"")
    with pytest.raises(InputError, match=r"no metadata.yaml, and \d files of .db3 and .mcap") as caught:
        Bag().open(folder)
    assert "ros2 bag reindex" in caught.value.hints[0]


def test_other_schemas_beside_those_of_ros_2(tmp_path):
    """The profile is that of ROS 2, and one channel has JSON."""
    from mcap.writer import Writer

    store, path = Messages(False).store, tmp_path / "session.mcap"
    with path.open("wb") as file:
        writer, channels = Writer(file), {}
        writer.start(profile="ros2")
        other = writer.register_channel("/notes", "json", writer.register_schema("notes", "jsonschema", b"{}"))
        writer.add_message(other, 1, b"{}", 1)
        for topic, seconds, (name, message) in scene_messages(False, (0, 1)):
            if topic not in channels:
                text = store.generate_msgdef(name, ros_version=2)[0].encode()
                channels[topic] = writer.register_channel(topic, "cdr", writer.register_schema(name, "ros2msg", text))
            t = round(seconds * 1e9)
            writer.add_message(channels[topic], t, bytes(store.serialize_cdr(message, name)), t)
        writer.finish()
    same_frames(Bag(pauses=Ends(), world=WORLD).open(path), (0, 1))


def test_several_files_that_ros_2_has_not_written(tmp_path):
    for name in "ab":
        write_json(tmp_path / f"{name}.mcap", foxglove((0, 1)))
    with pytest.raises(InputError, match="has 2 MCAP files that ROS 2 has not written") as caught:
        open_recording(tmp_path)
    assert "mcap merge" in caught.value.hints[0]
    (tmp_path / "depth").mkdir()
    assert not Bag.detects(tmp_path)

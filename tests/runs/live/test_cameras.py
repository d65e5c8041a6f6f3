"""The ROS node on messages of rosbags, and the examples of cameras on simulated frames."""

from __future__ import annotations

import runpy
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import ros_node as NODE

import mstfilter
from mstfilter.base.errors import InputError, InputWarning
from mstfilter.scene import Recording, outlined
from tests.conftest import REPOSITORY
from tests.formats.bags import COLOUR, DEPTH, scene_messages, topic_info
from tests.formats.layouts import FPS, SHIFTS, units, video
from tests.runs.live.test_stream import QUICK, RULE, arrays
from tests.scene.scenes import CAMERA

EXAMPLES = REPOSITORY / "docs" / "examples" / "live"


def test_the_node_has_the_results_of_the_frames_in_its_messages():
    messages, found, lost = scene_messages(False), [], 1
    K = next(NODE.camera_matrix(message) for topic, _, (_, message) in messages if topic == topic_info(COLOUR))
    np.testing.assert_allclose(K, CAMERA.K)
    with mstfilter.Stream(K, QUICK, seed=4, pauses=RULE, on_pause=found.append) as stream:
        pairs = NODE.ImagePairs(stream)
        for number, (topic, _, (_, message)) in enumerate(messages):
            if topic == COLOUR and number // 3 != lost:  # info, colour and depth of each frame
                pairs.add_colour(message)
            elif topic == DEPTH:
                pairs.add_depth(message)
    assert pairs.n_pairs == len(SHIFTS) - 1 and len(found) == 2
    rgb, depth, _ = video()
    kept = [k for k in range(len(SHIFTS)) if k != lost]
    metres = units(depth[kept], 0.001) * np.float32(0.001)
    recording = Recording.from_arrays(rgb[kept], metres, K, times=np.array(kept) / FPS, pauses=RULE)
    states = [state for state, _ in QUICK.iterate(recording.clips(), 4)]
    assert [arrays(pause.state) for pause in found] == [arrays(state) for state in states]
    belief = mstfilter.Belief.of_step(found[1].state, found[1].info)
    [one] = table = belief.objects().renumbered([7])
    shown = outlined(belief.estimate(), found[1].clip.after)
    np.testing.assert_array_equal(NODE.numbers_of_pixels(found[1], belief, table), 7 * (shown == one.label))


@pytest.mark.parametrize("start", [None, 0.0])
def test_the_node_uses_all_frames_whose_stamps_are_0(start):
    """Stamps that a driver leaves 0, and the first stamp of simulated time, which is 0 too."""
    messages = [message for topic, _, (_, message) in scene_messages(False) if topic in (COLOUR, DEPTH)]
    pushed = []
    stream = SimpleNamespace(push=lambda rgb, depth, when: pushed.append(when))
    pairs = NODE.ImagePairs(stream)
    first = NODE.stamp_of(messages[0])
    for message in messages[:8]:
        seconds = 0.0 if start is None else round(NODE.stamp_of(message) - first, 3)
        stamp = SimpleNamespace(sec=int(seconds), nanosec=round(seconds % 1 * 1e9))
        fields = {
            name: getattr(message, name) for name in ("height", "width", "encoding", "is_bigendian", "step", "data")
        }
        image = SimpleNamespace(header=SimpleNamespace(stamp=stamp), **fields)
        (pairs.add_colour if message.encoding == "rgb8" else pairs.add_depth)(image)
    assert len(pushed) == pairs.n_pairs == 4
    assert pushed[0] == 0 and (np.diff(pushed) > 0).all()
    if start is not None:
        np.testing.assert_allclose(pushed, np.arange(4) / FPS, atol=1e-6)


def test_the_matrix_of_rectified_images_is_that_of_their_projection():
    raw, projection = [500, 0, 320, 0, 500, 240, 0, 0, 1], [480, 0, 310, 0, 0, 480, 236, 0, 0, 0, 1, 0]
    info = SimpleNamespace(k=raw, p=projection, d=[0.1, -0.2, 0, 0, 0])
    rectified = NODE.camera_matrix(info, "/camera/color/image_rect_color")
    np.testing.assert_allclose(rectified, [[480, 0, 310], [0, 480, 236], [0, 0, 1]])
    with pytest.warns(InputWarning, match=r"image_raw have the distortion \[0.1, -0.2, 0.0, 0.0, 0.0\]"):
        np.testing.assert_allclose(NODE.camera_matrix(info, "/camera/color/image_raw").ravel(), raw)


def test_the_node_says_that_ros_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(InputError, match="ROS 2 needs rclpy"):
        NODE.main()


@pytest.fixture
def results(monkeypatch):
    """The results at the pauses of an example, which uses a fast filter and a rule for this video."""
    found, make = [], mstfilter.Stream

    def stream(K, name, on_pause):
        assert name == "mst"
        both = lambda pause: (found.append(pause), on_pause(pause))  # noqa: E731
        return make(CAMERA.K, QUICK, pauses=RULE, on_pause=both)

    monkeypatch.setattr(mstfilter, "Stream", stream, raising=False)
    return found


def images(results):
    """Colour and millimetres of the frames, then, after two results, the interruption by the user."""
    rgb, depth, _ = video()
    for k in range(len(SHIFTS)):
        yield rgb[k], np.rint(1000 * depth[k]).astype(np.uint16), k / FPS
    deadline = time.perf_counter() + 300
    while len(results) < 2 and time.perf_counter() < deadline:
        time.sleep(0.05)
    raise KeyboardInterrupt


def test_the_example_of_a_realsense_camera(monkeypatch, results, capsys):
    frames, stopped = images(results), []

    def wait_for_frames():
        rgb, depth, t = next(frames)
        return SimpleNamespace(
            get_color_frame=lambda: SimpleNamespace(get_data=lambda: rgb),
            get_depth_frame=lambda: SimpleNamespace(get_data=lambda: depth),
            get_timestamp=lambda: 1000 * t,
        )

    lens = SimpleNamespace(fx=131.0, fy=131.0, ppx=79.5, ppy=59.5)
    video_profile = SimpleNamespace(get_intrinsics=lambda: lens)
    profile = SimpleNamespace(
        get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: SimpleNamespace(get_depth_scale=lambda: 0.001)),
        get_stream=lambda kind: SimpleNamespace(as_video_stream_profile=lambda: video_profile),
    )
    pipeline = SimpleNamespace(
        start=lambda config: profile, wait_for_frames=wait_for_frames, stop=lambda: stopped.append(True)
    )
    module = SimpleNamespace(
        pipeline=lambda: pipeline,
        config=lambda: SimpleNamespace(enable_stream=lambda *settings: None),
        stream=SimpleNamespace(color=1, depth=2),
        format=SimpleNamespace(rgb8=1, z16=2),
        align=lambda kind: SimpleNamespace(process=lambda frames: frames),
    )
    monkeypatch.setitem(sys.modules, "pyrealsense2", module)
    runpy.run_path(str(EXAMPLES / "realsense.py"))
    assert len(results) == 2 and stopped
    assert "pause 1: " in capsys.readouterr().out


def test_the_example_of_an_open3d_sensor(monkeypatch, results, capsys):
    frames = images(results)
    times = iter(np.arange(len(SHIFTS)) / FPS)

    def capture_frame(aligned):
        rgb, depth, _ = next(frames)
        return SimpleNamespace(color=rgb, depth=depth)

    sensor = SimpleNamespace(connect=lambda k: True, capture_frame=capture_frame, disconnect=lambda: None)
    io = SimpleNamespace(AzureKinectSensorConfig=lambda: None, AzureKinectSensor=lambda settings: sensor)
    monkeypatch.setitem(sys.modules, "open3d", SimpleNamespace(io=io))
    monkeypatch.setattr("time.monotonic", lambda: float(next(times)))
    runpy.run_path(str(EXAMPLES / "open3d_recorder.py"))
    assert len(results) == 2
    assert "pause 1: " in capsys.readouterr().out

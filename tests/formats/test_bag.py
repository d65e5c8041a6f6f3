"""Reading of ROS 1 bags, ROS 2 bags and MCAP files, and errors of invalid ones."""

from __future__ import annotations

import re
import sys
import warnings

import cv2
import numpy as np
import pytest

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.formats import open_recording
from mstfilter.formats.bag import Bag
from mstfilter.formats.folder import save_recording
from mstfilter.formats.pauses import Ends
from mstfilter.formats.ros_images import colour_image, depth_image
from mstfilter.formats.rvl import decode_rvl
from tests.formats.bags import COLOUR, DEPTH, KINDS, Messages, png, scene_messages, topic_info, write
from tests.formats.layouts import FPS, PAUSES, SHIFTS, K, units, video
from tests.formats.test_layouts import WORLD, same_frames

pytest.importorskip("rosbags", reason="rosbags absent: pip install -e '.[bags]'")


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag(tmp_path, kind):
    path = write(tmp_path / "session", kind, scene_messages(kind == "bag"))
    if kind == "mcap":  # the file itself, without the folder that ROS 2 puts around it
        (path,) = path.glob("*.mcap")
    assert Bag.detects(path)
    recording = Bag(world=WORLD).open(path)
    same_frames(recording, SHIFTS)
    assert recording.pauses == PAUSES
    np.testing.assert_allclose(recording.times, np.arange(len(SHIFTS)) / FPS, atol=1e-6)
    assert open_recording(save_recording(recording, tmp_path / "out")).key == recording.key


@pytest.mark.parametrize(
    ("depth", "colour"),
    [
        ("32FC1", "bgr8"),
        ("mono16", "compressed"),
        ("compressed 16UC1", "bgr8"),
        ("compressed 32FC1", "compressed"),
        ("compressed rvl 16UC1", "bgr8"),
        ("compressed rvl 32FC1", "bgr8"),
    ],
)
def test_encodings(tmp_path, depth, colour):
    path = write(tmp_path / "s", "db3", scene_messages(False, (0, 3), depth=depth, colour=colour))
    recording = Bag(pauses=Ends(), world=WORLD).open(path)
    # 32FC1 is compressed in steps of 1 / 10100 of the inverse depth: rounded by less than z^2 / 20200 m.
    atol = 5e-4 if depth.endswith("32FC1") and "compressed" in depth else 2e-7
    same_frames(recording, (0, 3), atol)


def test_pixels_of_other_encodings():
    """Grey, four channels, packed YUV, big-endian depth; each against numbers made here."""
    make = Messages(False)
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 255, (4, 6), dtype=np.uint8)
    np.testing.assert_array_equal(colour_image(make.image(0, grey, "mono8")[1], False, "m")[..., 1], grey)
    four = rng.integers(0, 255, (4, 6, 4), dtype=np.uint8)
    np.testing.assert_array_equal(colour_image(make.image(0, four, "bgra8")[1], False, "m"), four[..., 2::-1])
    np.testing.assert_array_equal(colour_image(make.image(0, four, "rgba8")[1], False, "m"), four[..., :3])
    # UYVY with neutral chroma is grey: Y 16..235 to 0..255.
    packed = np.dstack([np.full((4, 6), 128, np.uint8), np.full((4, 6), 235, np.uint8)])
    np.testing.assert_allclose(colour_image(make.image(0, packed, "yuv422")[1], False, "m"), 255, atol=1)
    np.testing.assert_allclose(colour_image(make.image(0, packed[..., ::-1], "yuyv")[1], False, "m"), 255, atol=1)
    millimetres = np.array([[0, 700], [1500, 65535]], np.uint16)
    message = make.image(0, millimetres.byteswap(), "16UC1")[1]
    message.is_bigendian = 1
    np.testing.assert_allclose(depth_image(message, False, 0.001, "m"), [[np.nan, 0.7], [1.5, np.nan]], rtol=1e-6)
    for form, data in (("16UC1; compressedDepth", b"0" * 12 + png(millimetres)), ("16UC1; png", png(millimetres))):
        packed = make.compressed(0, data, form)[1]
        np.testing.assert_allclose(depth_image(packed, True, 0.001, "m"), [[np.nan, 0.7], [1.5, np.nan]], rtol=1e-6)
    metres = np.array([[np.nan, 0.7], [np.inf, -1.0]], np.float32)
    found = depth_image(make.image(0, metres, "32FC1")[1], False, 0.001, "m")
    np.testing.assert_allclose(found, [[np.nan, 0.7], [np.nan, np.nan]], rtol=1e-6)
    message.data = message.data[:5]
    for wrong in (message, make.image(0, millimetres, "bayer_rggb8")[1]):
        with pytest.raises(InputError, match="bytes|encoding"):
            depth_image(wrong, False, 0.001, "m")


def test_rvl_of_another_encoder():
    """The stream that the library rvl 1.0.4 writes; damaged streams are refused."""
    stream, pixels = bytes.fromhex("23d28f230193a8120050fe19"), [[0, 0, 700, 701, 699], [0, 1500, 1500, 0, 65535]]
    np.testing.assert_array_equal(decode_rvl(stream, 5, 2, "m"), pixels)
    for width, height, data in (
        (5, 3, stream),
        (5, 2, stream[:4]),
        (5, 2, b""),
        (0, 2, stream),
        (2**20, 2**20, stream),
    ):
        with pytest.raises(InputError, match="m is damaged: RVL"):
            decode_rvl(data, width, height, "m")
    with pytest.raises(InputError, match="too few for RVL"):
        depth_image(Messages(False).compressed(0, b"0" * 15, "16UC1; compressedDepth rvl")[1], True, 0.001, "m")


@pytest.mark.parametrize("bits", [8, 16])
def test_colour_of_bayer_sensors_and_of_16_bits(bits):
    """Three areas of one colour each: the mosaic has the named colours in the first two rows and columns."""
    make, kind = Messages(False), np.uint8 if bits == 8 else np.uint16
    rgb = np.repeat(np.array([[[200, 20, 40], [30, 180, 60], [10, 50, 220]]], np.uint8), 8, axis=1).repeat(12, axis=0)
    wide = rgb.astype(kind) * (1 if bits == 8 else 257)
    inside = np.arange(24) % 8 % 7 > 1  # not at a border of two colours
    for pattern in ("rggb", "bggr", "gbrg", "grbg"):
        mosaic = np.zeros(wide.shape[:2], kind)
        for k, letter in enumerate(pattern):
            mosaic[k // 2 :: 2, k % 2 :: 2] = wide[k // 2 :: 2, k % 2 :: 2, "rgb".index(letter)]
        found = colour_image(make.image(0, mosaic, f"bayer_{pattern}{bits}")[1], False, "m")
        np.testing.assert_allclose(found[2:-2, inside].astype(int), rgb[2:-2, inside], atol=1)
    if bits == 16:
        four = np.dstack([wide, wide[..., 0]])
        images = {"rgb16": wide, "bgr16": wide[..., ::-1], "rgba16": four, "bgra16": four[..., [2, 1, 0, 3]]}
        for encoding, pixels in images.items():
            found = colour_image(make.image(0, pixels, encoding)[1], False, "m")
            np.testing.assert_array_equal(found, rgb)


@pytest.mark.parametrize("order", [("nv12", 1), ("nv21", -1)])
def test_colour_with_half_the_resolution_of_chroma(order):
    """Full-range JPEG numbers do not apply: brightness 16 to 235, chroma 128 +- 112 (BT.601)."""
    encoding, step = order
    y, u, v = 81, 90, 240  # red
    planes = np.full((6, 8), y, np.uint8), np.tile(np.array([u, v][::step], np.uint8), (3, 4))
    _, message = Messages(False).image(0, np.vstack(planes), encoding)
    message.height = 6
    np.testing.assert_allclose(colour_image(message, False, "m").astype(int), np.full((6, 8, 3), (255, 0, 0)), atol=2)


def test_a_grey_image_of_16_bits_is_colour_if_there_is_other_depth(tmp_path):
    """Without a name, and by its name beside a colour image."""
    messages = scene_messages(False, (0, 1), colour=None)
    make, rgb = Messages(False), video((0, 1))[0]
    for k in range(2):
        t = START + k / FPS
        messages.append((COLOUR, t, make.image(t, rgb[k][..., 1].astype(np.uint16) * 257, "mono16")))
    recording = Bag(pauses=Ends(), world=WORLD).open(write(tmp_path / "one", "db3", messages))
    np.testing.assert_array_equal(recording.frames[1].rgb, np.repeat(rgb[1][..., 1:2], 3, axis=2))
    other = "/other/image_raw"
    messages += [(other, START + k / FPS, make.image(START + k / FPS, rgb[k], "rgb8")) for k in range(2)]
    path = write(tmp_path / "two", "db3", messages)
    named = Bag(colour=COLOUR, depth=DEPTH, pauses=Ends(), world=WORLD).open(path)
    np.testing.assert_array_equal(named.frames[1].rgb, recording.frames[1].rgb)


def test_registered_depth_is_the_default(tmp_path):
    """The aligned depth is chosen if there are also raw depth of another frame and an infrared image."""
    make, messages = Messages(False), scene_messages(False, (0, 0))
    for k in range(2):
        t = 1700000000.0 + k / FPS
        raw = np.full((100, 128), 900, np.uint16)
        messages.append(
            ("/camera/depth/image_rect_raw", t, make.image(t, raw, "16UC1", "camera_depth_optical_frame"))
        )
        messages.append(("/camera/infra1/image_raw", t, make.image(t, raw.astype(np.uint8), "mono8", "infra1")))
    path = write(tmp_path / "s", "mcap", messages)
    same_frames(Bag(pauses=Ends(), world=WORLD).open(path), (0, 0))
    with pytest.raises(InputError, match="differ in size"):
        Bag(depth="/camera/depth/image_rect_raw").open(path)
    other = with_messages(frame="camera_depth_optical_frame")(tmp_path / "other")
    same_frames(Bag(registered=True, pauses=Ends(), world=WORLD).open(other), (0, 1))


def test_the_lens_of_the_camera_info_is_used(tmp_path):
    """A raw image is undistorted; for a rectified image the camera matrix is read from P.

    A given camera matrix does not change the distortion.
    """
    make = Messages(True)
    topics = (COLOUR, False), ("/camera/color/image_rect_color", True), ("/direct_drive/camera/image_raw", False)
    for k, (topic, same) in enumerate(topics):
        messages = []
        for name, t, message in scene_messages(True, (0, 0), info=False):
            messages.append((topic if name == COLOUR else name, t, message))
            messages.append((topic_info(topic), t, make.info(t, d=(0.3, 0.0, 0.0, 0.0, 0.0))))
        path = write(tmp_path / f"s{k}", "bag", messages)
        for given in ((), K):
            frame = Bag(pauses=Ends(), world=WORLD, K=given).open(path).frames[0]
            assert np.array_equal(frame.rgb, video((0,))[0][0]) == same
        frame = Bag(pauses=Ends(), world=WORLD, K=K, distortion=(0.0,) * 4).open(path).frames[0]
        assert np.array_equal(frame.rgb, video((0,))[0][0])


def with_messages(**change):
    return lambda path: write(path, "db3", scene_messages(False, (0, 1), **change))


def two_colours(path):
    messages = scene_messages(False, (0, 1))
    again = [("/left" + topic, t, message) for topic, t, message in messages if topic == COLOUR]
    return write(path, "db3", messages + again)


def with_info(topic, **change):
    """The scene with another CameraInfo of a topic."""

    def make(path):
        messages = [m for m in scene_messages(False, (0, 1)) if m[0] != topic_info(topic)]
        info = Messages(False).info(0.0, **change)
        return write(path, "db3", [*messages, (topic_info(topic), 1700000000.0, info)])

    return make


def truncated(kind, share):
    def make(path):
        target = write(path, kind, scene_messages(kind == "bag"))
        file = target if kind == "bag" else next(p for p in target.iterdir() if p.suffix == f".{kind}")
        file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
        return target

    return make


def small_depth(path):
    make, messages = Messages(False), scene_messages(False, (0, 1), depth=None)
    images = [(DEPTH, m[1], make.image(m[1], np.full((60, 80), 700, np.uint16), "16UC1")) for m in messages]
    return write(path, "db3", messages + images)


FAULTS = {
    "no depth at all": (with_messages(depth=None), Bag(), "no depth topic"),
    "no colour": (with_messages(colour=None), Bag(), "no colour topic"),
    "no intrinsics": (with_messages(info=False), Bag(), "intrinsics are missing"),
    "wrong topic": (with_messages(), Bag(colour="/camera/colour"), "no image topic '/camera/colour'"),
    "depth for colour": (with_messages(), Bag(colour=DEPTH), "has no colour images"),
    "two colours": (two_colours, Bag(), "2 topics could be colour"),
    "sizes differ": (small_depth, Bag(), "differ in size: depth is not registered"),
    "other frame": (with_messages(frame="camera_depth_optical_frame"), Bag(), "not registered"),
    "other matrix": (with_info(DEPTH, k=(100.0, 100.0, 80.0, 60.0)), Bag(), "camera matrices .* differ"),
    "fisheye": (with_info(COLOUR, d=(0.1,) * 4, model="equidistant"), Bag(), "'equidistant'"),
    "not calibrated": (with_info(COLOUR, k=(0, 0, 0, 0)), Bag(), "not calibrated"),
    "1 km away": (with_messages(), Bag(depth_scale=1.2), "median of"),
    "never together": (with_messages(lag=0.05), Bag(), "0.05 s apart"),
    "truncated bag": (truncated("bag", 0.6), Bag(), "bag cannot be read"),
    "truncated mcap": (truncated("mcap", 0.6), Bag(), "bag cannot be read"),
    "truncated db3": (truncated("db3", 0.6), Bag(), "bag cannot be read"),
    "empty file": (truncated("bag", 0.0), Bag(), "bag cannot be read"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_invalid_data_raise_an_error(tmp_path, fault):
    make, reader, message = FAULTS[fault]
    path = make(tmp_path / "session")
    with pytest.raises(InputError, match=message) as caught:
        reader.open(path).check()
    assert "\n" not in caught.value.message
    assert caught.value.hints or "could be" not in caught.value.message


def test_ambiguous_topics_are_listed(tmp_path):
    """The error names every image topic with count, encoding, size and frame."""
    path = two_colours(tmp_path / "session")
    with pytest.raises(InputError) as caught:
        Bag().open(path)
    listed = "\n".join(caught.value.hints)
    for topic in (COLOUR, "/left" + COLOUR, DEPTH):
        assert re.search(rf"{topic} \(2 x \w+, 160 x 120, frame 'camera_color_optical_frame'\)", listed), listed
    same_frames(Bag(colour="/left" + COLOUR, K=K, pauses=Ends(), world=WORLD).open(path), (0, 1))


def test_images_are_paired_by_the_stamps_of_their_headers(tmp_path):
    """Also if messages were logged late; lost messages give a warning."""
    rng = np.random.default_rng(1)
    messages = [(topic, t + float(rng.uniform(0, 0.3)), m) for topic, t, m in scene_messages(False)]
    messages.sort(key=lambda m: m[1])
    path = write(tmp_path / "late", "mcap", messages)
    same_frames(Bag(world=WORLD).open(path), SHIFTS)
    lost = [m for k, m in enumerate(scene_messages(False)) if m[0] != DEPTH or k % 2]
    with pytest.warns(InputWarning, match="are omitted"):
        recording = Bag(pauses=Ends()).open(write(tmp_path / "lost", "mcap", lost))
    assert len(recording) < len(SHIFTS)
    recording.check()


def test_without_rosbags(tmp_path, monkeypatch):
    path = with_messages()(tmp_path / "session")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(InputError, match="needs rosbags") as caught:
        Bag().open(path)
    assert "mstfilter[bags]" in caught.value.hints[0]


def test_a_folder_inside_a_bag_is_skipped(tmp_path):
    path = write(tmp_path / "s", "db3", scene_messages(False, (0, 1)))
    (path / "notes").mkdir()
    same_frames(Bag(pauses=Ends(), world=WORLD).open(path), (0, 1))


def test_the_orientation_of_a_compressed_image_is_ignored():
    """An EXIF entry would turn the colour image by 180 degrees, but not the depth image."""
    rgb = np.zeros((40, 60, 3), np.uint8)
    rgb[:20] = 200
    jpeg = cv2.imencode(".jpg", rgb)[1].tobytes()
    tag = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x03\0\0\0\0\0\0\0"
    turned = jpeg[:2] + b"\xff\xe1" + (len(tag) + 2).to_bytes(2, "big") + tag + jpeg[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR)[0, 0, 0] < 50
    message = Messages(False).compressed(0, turned, "jpeg")[1]
    assert colour_image(message, True, "m")[0, 0, 0] > 150


def stamped(change, kind="db3", **more):
    """The scene whose headers have other stamps: ``change(stamp)`` of each image, in the order of the log."""

    def make(path, shifts=SHIFTS):
        messages = scene_messages(kind == "bag", shifts, **more)
        for topic, t, (_, message) in messages:
            stamp = change(topic, t) if "info" not in topic else t
            message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), round((stamp % 1) * 1e9)
        return write(path, kind, messages)

    return make


START = 1700000000.0


@pytest.mark.parametrize("kind", ["bag", "db3"])
@pytest.mark.parametrize("which", [COLOUR, DEPTH])
@pytest.mark.parametrize("k", [0, 4, len(SHIFTS) - 1])
def test_a_header_without_a_stamp_gives_all_images_the_times_of_the_log(tmp_path, kind, which, k):
    missing = START + k / FPS + (0.003 if which == DEPTH else 0.0)
    make = stamped(lambda topic, t: 0.0 if (topic, t) == (which, missing) else t, kind)
    with pytest.warns(InputWarning, match=f"1 of 17 messages of {which} have no time stamp"):
        recording = Bag(world=WORLD).open(make(tmp_path / "s"))
    same_frames(recording, SHIFTS)
    np.testing.assert_allclose(recording.times, np.arange(len(SHIFTS)) / FPS, atol=1e-6)
    assert recording.pauses == PAUSES


@pytest.mark.parametrize("speed", [0.2, 1.0, 4.0])
def test_simulated_time_may_start_at_zero(tmp_path, speed):
    """The log has the time of the wall clock, and the simulation is slower or faster."""
    make = stamped(lambda topic, t: speed * (t - START) if topic == COLOUR else speed * max(t - START - 0.003, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = Bag(world=WORLD, pauses=Ends()).open(make(tmp_path / "s"))
    same_frames(recording, SHIFTS)
    np.testing.assert_allclose(recording.times, speed * np.arange(len(SHIFTS)) / FPS, atol=1e-6)


def test_images_without_any_stamp_have_the_times_of_the_log(tmp_path):
    recording = Bag(world=WORLD).open(stamped(lambda topic, t: 0.0)(tmp_path / "s"))
    same_frames(recording, SHIFTS)
    np.testing.assert_allclose(recording.times, np.arange(len(SHIFTS)) / FPS, atol=1e-6)


@pytest.mark.parametrize("start", [START, 0.0])
def test_stamps_that_jump_back_are_refused(tmp_path, start):
    """The second half would come first. The times of the log are the way out."""
    middle = START + 8 / FPS
    path = stamped(lambda topic, t: start + (t - START) + (5.0 if t < middle else 0.0))(tmp_path / "s")
    with pytest.raises(
        InputError, match=r"stamp of message 8 of .* is 4\.9 s earlier than that of message 7"
    ) as caught:
        Bag(world=WORLD).open(path)
    assert "log_times=true" in caught.value.hints[-1]
    recording = Bag(world=WORLD, log_times=True).open(path)
    same_frames(recording, SHIFTS)
    assert recording.pauses == PAUSES


def viewer(path, size=(160, 120), frame="0", k=(100.0, 100.0, 80.0, 60.0), matrix=True):
    """A bag as the RealSense Viewer writes it: raw depth, frame 0 for all images, its own names of topics."""
    make, messages = Messages(True), []
    rgb, metres, _ = video((0, 1))
    of_colour, of_depth = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
    for j in range(2):
        t = START + j / FPS
        if matrix:
            messages.append((f"{of_colour}/info/camera_info", t, make.info(t)))
            messages.append((f"{of_depth}/info/camera_info", t, make.info(t, k=k, size=size)))
        messages.append((f"{of_colour}/image/data", t, make.image(t, rgb[j], "rgb8", frame)))
        depth = cv2.resize(units(metres[j], 0.001), size, interpolation=cv2.INTER_NEAREST)
        messages.append((f"{of_depth}/image/data", t, make.image(t, depth, "mono16", frame)))
    return write(path, "bag", messages)


@pytest.mark.parametrize("given", [(), K])
@pytest.mark.parametrize("change", [{}, {"k": K}, {"matrix": False}, {"size": (212, 120)}])
def test_depth_of_the_realsense_viewer_is_refused_as_unaligned(tmp_path, given, change):
    """With images of equal size too, with a given camera matrix, and with equal camera matrices."""
    with pytest.raises(InputError, match="not registered to colour") as caught:
        Bag(K=given, world=WORLD).open(viewer(tmp_path / "s", **change))
    assert any("RSBagReader" in hint for hint in caught.value.hints)
    if not change:
        same_frames(Bag(registered=True, pauses=Ends(), world=WORLD).open(tmp_path / "s.bag"), (0, 1))


def test_a_given_matrix_does_not_hide_that_the_stored_ones_differ(tmp_path):
    path = with_info(DEPTH, k=(100.0, 100.0, 80.0, 60.0))(tmp_path / "s")
    with pytest.raises(InputError, match="camera matrices .* differ"):
        Bag(K=K, world=WORLD).open(path)
    same_frames(Bag(K=K, registered=True, pauses=Ends(), world=WORLD).open(path), (0, 1))

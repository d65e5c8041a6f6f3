"""Which format it is, and its options."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.formats import PairedImages, Redwood, write_image
from mstfilter.formats.sources import detect_format, format_settings, open_recording
from mstfilter.runs.presets import REGISTRY
from mstfilter.scene import render
from tests.formats import layouts
from tests.scene.scenes import CAMERA, GRID, table_scene
from tests.scene.test_recording import write

WRITERS = {
    "tum": layouts.write_tum,
    "redwood": layouts.write_redwood,
    "recording": write,
}


def write_pairs(path, names=("a", "b")):
    path.mkdir()
    for shift, name in enumerate(names):
        rgb, depth, _ = table_scene(5 * shift)
        write_image(path / f"{name}_rgb.png", rgb)
        write_image(path / f"{name}_depth.png", layouts.units(depth, 0.001))
    (path / "info.json").write_text(json.dumps({"K": [131, 131, 79.5, 59.5], "depth_scale_m": 0.001}))
    return path


@pytest.mark.parametrize("name", WRITERS)
def test_formats_are_detected(tmp_path, name):
    """Each by exactly one reader; every registered format has a test here or among the bags, pairs and layouts."""
    path = WRITERS[name](tmp_path / "data")
    assert detect_format(path) == name
    assert set(REGISTRY.known("format")) == {*WRITERS, "bag", "pairs", "layout"}


def test_unknown_and_ambiguous(tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("x")
    (tmp_path / "data.bin").write_bytes(b"x")
    for name in ("notes", "data.bin"):
        with pytest.raises(InputError, match="has no known format") as caught:
            open_recording(tmp_path / name)
        assert "tum, redwood, bag" in caught.value.hints[0]
        assert "RGB-D camera" in caught.value.hints[1]
    path = layouts.write_redwood(layouts.write_tum(tmp_path / "both") / "x").rename(tmp_path / "both2")
    for part in ("rgb.txt", "depth.txt"):
        (path / part).write_text("0 a.png\n")
    with pytest.raises(InputError, match="looks like tum and like redwood"):
        open_recording(path)
    assert len(open_recording(path, "redwood", ["fps=10"])) == len(layouts.SHIFTS)
    with pytest.raises(InputError, match="there is no format 'tom'"):
        open_recording(path, "tom")
    with pytest.raises(InputError, match="does not exist"):
        open_recording(tmp_path / "none")


@pytest.mark.parametrize(
    ("name", "tool"),
    [
        ("a.mkv", "azure_kinect_mkv_reader.py"),
        ("a.sens", "SensReader"),
        ("a.svo2", "its SDK"),
        ("a.mp4", "folder"),
    ],
)
def test_files_that_are_not_read_name_the_tool_that_converts_them(tmp_path, name, tool):
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(InputError, match="has no known format") as caught:
        open_recording(tmp_path / name)
    assert tool in caught.value.hints[0] and len(caught.value.hints) == 1


def test_a_folder_of_recordings_is_told_which(tmp_path):
    for name in ("000001", "000048"):
        layouts.write_bop(tmp_path / "test" / name, (0,))
    with pytest.raises(InputError, match="no known format, but folders and files in it have") as caught:
        open_recording(tmp_path / "test")
    assert caught.value.hints == ("give 000001 or 000048",)


def test_depth_that_ffmpeg_took_from_an_azure_kinect(tmp_path):
    path = layouts.write_redwood(tmp_path / "frames", (0,))
    write_image(path / "depth" / "00000.png", np.full((576, 640), 700, np.uint16))
    with pytest.raises(InputError, match="depth of 640 x 576, colour of 160 x 120") as caught:
        open_recording(path)
    assert "azure_kinect_mkv_reader.py" in caught.value.hints[-1]


def test_options_as_text():
    fields = format_settings(["K=525,525,319.5,.5", "world.workspace=-1,-1,0,1,1,.5", "start_s=2"])
    reader = REGISTRY.make(Redwood, fields)
    assert (reader.K, reader.world.workspace, reader.start_s) == ((525, 525, 319.5, 0.5), (-1, -1, 0, 1, 1, 0.5), 2)
    assert REGISTRY.make(PairedImages, format_settings(["frames=a,007,8"])).frames == ("a", "007", "8")


def test_a_single_number_is_a_list_of_one():
    for option, frames in (("pauses.frames=0", (0,)), ("pauses.frames=0,1", (0, 1))):
        assert REGISTRY.make(Redwood, format_settings(["pauses=at", option])).pauses.frames == frames
    with pytest.raises(InputError, match="frames is"):
        REGISTRY.make(Redwood, format_settings(["pauses=at", "pauses.frames=x"]))


def test_options_reach_the_reader(tmp_path):
    path = layouts.write_tum(tmp_path / "tum")
    options = ["K=131,131,79.5,59.5", "world.workspace=-0.3,-0.3,0,0.3,0.3,0.2", "world.voxel_size=0.02"]
    recording = open_recording(path, options=options, pauses="0,8,16")
    assert recording.pauses == (0, 8, 16)
    assert recording.grid.shape == (30, 30, 10)
    assert open_recording(path, options=options, pauses="0s,0.52s").pauses == (0, 5)
    assert open_recording(path, options=[*options, "pauses.hold_s=0.6"], pauses="still").pauses == (13,)
    assert open_recording(path, options=[*options, "pauses.hold_s=0.6"]).pauses == (13,)
    for wrong, message in (
        (["K=1,2,x,4"], "K is"),
        (["k=1,2,3,4"], "no field 'k'"),
        (["pauses=never"], "no pauses 'never'"),
        (["depth_scale"], "path=value"),
    ):
        with pytest.raises(InputError, match=message):
            open_recording(path, options=wrong)


def test_pairs_have_the_options_of_the_other_layouts(tmp_path):
    path = write_pairs(tmp_path / "pairs", "abcd")
    pose = ",".join(str(v) for v in CAMERA.pose.as_matrix().ravel())
    options = [f"world.T_world_camera={pose}", "world.workspace=-0.3,-0.3,0,0.3,0.3,0.2", "max_pixels=5000"]
    recording = open_recording(path, options=options, pauses="0,-1")
    assert recording.pauses == (0, 3) and recording.grid.shape == (60, 60, 20)
    np.testing.assert_allclose(recording.frames[3].camera.pose.as_matrix(), CAMERA.pose.as_matrix(), atol=1e-12)
    write_image(path / "b_robot.png", np.where(np.arange(160) < 40, 255, np.zeros((120, 160))).astype(np.uint8))
    write_image(path / "b_label.png", np.full((120, 160), 7, np.uint8))
    masks = [frame.robot_mask for frame in open_recording(path).frames]
    assert masks[0] is None and masks[1].mean() == 0.25
    assert open_recording(path, options=options).instance(1).shape == (61, 82)
    (path / "info.json").write_text(json.dumps({"K": [131, 131, 79.5, 59.5], "depth_scale": 1000}))
    with (
        pytest.warns(InputWarning, match="not read: depth_scale"),
        pytest.raises(InputError, match="depth_scale_m is"),
    ):
        open_recording(path)


def test_label_images_beside_pairs_are_true_instances(tmp_path):
    """The label of the table is no object."""
    rgb, depth, labels = table_scene(noise=np.random.default_rng(0))
    objects = render(labels, GRID, CAMERA).labels
    write_image(tmp_path / "a_rgb.png", rgb)
    write_image(tmp_path / "a_depth.png", np.rint(1000 * depth).astype(np.uint16))
    write_image(tmp_path / "a_label.png", np.where(np.arange(160) < 5, 0, objects + 1).astype(np.uint8))
    info = {"K": [131, 131, 79.5, 59.5], "depth_scale_m": 0.001}
    (tmp_path / "info.json").write_text(json.dumps(info))
    expected = np.where((objects > 0) & (np.arange(160) >= 5), objects + 1, 0)
    np.testing.assert_array_equal(open_recording(tmp_path).instance(0), expected)
    write_image(tmp_path / "a_label.png", objects[:50].astype(np.uint8))
    with pytest.raises(InputError, match=r"instance image of frame 0 of .* has shape \(50, 160\)"):
        open_recording(tmp_path).instance(0)
    (tmp_path / "a_label.png").unlink()
    assert open_recording(tmp_path).instance(0) is None
    (tmp_path / "info.json").write_text('{"depth_scale_m": 0.001}')
    with pytest.raises(InputError, match="'K' is missing"):
        open_recording(tmp_path)


def test_a_folder_with_nearly_the_right_names_is_told_which(tmp_path):
    for k, (part, wrong) in enumerate((("depth", "Depth"), ("depth", "depths"), ("color", "color_frames"))):
        path = layouts.write_redwood(tmp_path / str(k), (0,))
        (path / part).rename(path / wrong)
        with pytest.raises(InputError, match="has no known format") as caught:
            open_recording(path)
        assert caught.value.hints[0] == f"{wrong} is there: is it {part}? rename it"


@pytest.mark.parametrize(
    ("write_layout", "lost", "message"),
    [
        (layouts.write_tum, "depth.txt", "depth.txt is missing"),
        (layouts.write_redwood, "depth", "depth is missing"),
        (write_pairs, "a_rgb.png", "a_rgb.png missing"),
        (write_pairs, "info.json", "info.json: depth_scale_m is None"),
        (write_pairs, "a_depth.png", "a_depth.png missing"),
    ],
)
def test_what_is_missing_is_named_in_the_words_of_the_layout(tmp_path, write_layout, lost, message):
    path = write_layout(tmp_path / "data")
    (path / lost).rename(tmp_path / lost)
    with pytest.raises(InputError, match=message) as caught:
        open_recording(path, options=["K=131,131,79.5,59.5"])
    assert not any("manifest" in hint for hint in caught.value.hints)

"""Every command of the pages on own data runs on data of its layout, every wrong input gives its message.

The settings of docs/troubleshooting.md exist.
"""

from __future__ import annotations

import inspect
import json
import re
import shlex
import shutil
import warnings

import numpy as np
import pytest

import mstfilter
from mstfilter.base.errors import InputError, InputWarning
from mstfilter.formats import PairedImages, open_recording, read_depth, read_labels, read_rgb, write_image
from mstfilter.scene import Recording
from tests.app.test_cli import call
from tests.conftest import REPOSITORY
from tests.formats import layouts
from tests.formats.bags import scene_messages, write as write_bag
from tests.scene.test_recording import write
from tests.wrong_inputs import WRONG, right

NAMES = ("own-data", "formats", "scores", "real-images", "troubleshooting")
PAGES = {name: (REPOSITORY / "docs" / f"{name}.md").read_text() for name in NAMES}
PAGE = "\n".join(PAGES.values())
COMMANDS = [
    line.partition("  #")[0].strip()
    for block in re.findall(r"```sh\n(.*?)```", PAGE, flags=re.DOTALL)
    for line in block.splitlines()
    if line.startswith("mstfilter ")
]


FEW = ("n=2", "n_proposed=2")  # so that the runs are short


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with the data that the page uses."""
    path = tmp_path_factory.mktemp("data")
    write(path / "table-7")
    shutil.copytree(path / "table-7", path / "table-9")
    write_bag(path / "session", "bag", scene_messages(True))
    mcap = write_bag(path / "s", "mcap", scene_messages(False))
    shutil.move(next(mcap.glob("*.mcap")), path / "session.mcap")
    for file in layouts.write_tum(path / "rgbd_dataset", (0,) * 6).rglob("*.png"):  # 640 x 480
        image = read_rgb(file) if file.parent.name == "rgb" else np.rint(read_depth(file, 1)).astype(np.uint16)
        write_image(file, image.repeat(4, axis=0).repeat(4, axis=1))
    layouts.write_redwood(path / "bedroom")
    layouts.write_stray(path / "scan")
    layouts.write_bop(path / "000048", (0, 4))
    (path / "frames").mkdir()
    for k in (0, 4):
        for part in ("rgb", "depth"):
            shutil.copy(path / f"table-7/{part}/{k:06d}.png", path / f"frames/v{k}_{part}.png")
    (path / "frames" / "info.json").write_text(json.dumps({"K": layouts.K, "depth_scale_m": 0.001}))
    shutil.copytree(path / "frames", path / "osd")
    example = next(b for b in re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL) if "class Mine" in b)
    (path / "mine.py").write_text(example)
    rgb, depth, _ = layouts.video((0, 2))
    K = np.array([[131, 0, 79.5], [0, 131, 59.5], [0, 0, 1]])
    np.savez(path / "mine.npz", rgb=rgb, depth=depth, K=K)
    return path


@pytest.fixture
def here(data, tmp_path, monkeypatch):
    """A copy of it to work in."""
    path = tmp_path / "work"
    shutil.copytree(data, path)
    monkeypatch.chdir(path)
    return path


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_run(here, command, capsys):
    words = shlex.split(command)[1:]
    if words[0] == "convert" and (here / words[2]).exists():
        shutil.rmtree(here / words[2])
    if words[0] == "run":
        words += ["--no-report", *FEW]
    if words[0] == "quality":
        call("run", words[1].replace("run", "table"), "--out", words[1], "--no-report", *FEW, capsys=capsys)
    code, out, err = call(*words, capsys=capsys)
    assert code == 0, err
    assert words[0] != "convert" or re.search(r"pauses +\d+ of \d+ frames: ", out)
    made = {"convert": f"{words[2]}/manifest.json", "view": words[-1]} if len(words) > 2 else {}
    assert (here / made.get(words[0], ".")).exists()


def test_point_clouds_of_the_data_set_become_pairs(tmp_path, monkeypatch):
    """Two organised clouds with the fields of the data set, written by the test."""
    pytest.importorskip("open3d", reason="open3d absent or without its system libraries", exc_type=ImportError)
    (example,) = re.findall(r"```py\n(.*?)```", PAGE, flags=re.DOTALL)
    header = "VERSION 0.7\nFIELDS x y z rgb label\nSIZE 4 4 4 4 4\nTYPE F F F F U\nCOUNT 1 1 1 1 1\n"
    header += f"WIDTH 640\nHEIGHT 480\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {640 * 480}\nDATA binary\n"
    rng = np.random.default_rng(0)
    label = rng.choice([0, 1, 3, 20, 31], (480, 640)).astype(np.uint32)
    z = np.where(label > 0, rng.uniform(0.5, 1.5, label.shape), np.nan).astype(np.float32)
    rgb = rng.integers(0, 256, (480, 640, 3), dtype=np.uint32)
    packed = (rgb << np.uint32([16, 8, 0])).sum(axis=-1, dtype=np.uint32)
    columns = [np.zeros_like(z), np.zeros_like(z), z, packed.view(np.float32), label.view(np.float32)]
    monkeypatch.chdir(tmp_path)
    for k in (17, 18):
        (tmp_path / f"learn{k}.pcd").write_bytes(header.encode() + np.stack(columns, axis=-1).tobytes())
    exec(compile(example.replace("range(17, 25)", "range(17, 19)"), "real-images.md", "exec"), {})
    assert (read_rgb(tmp_path / "osd/learn18_rgb.png") == rgb).all()
    assert np.nanmax(np.abs(read_depth(tmp_path / "osd/learn18_depth.png", 0.001) - z)) < 0.00051
    expected = np.select([label == 0, label < 10, label < 30], [0, 1, 2], 3)
    assert (read_labels(tmp_path / "osd/learn18_label.png") == expected).all()


def test_every_format_has_a_command():
    """Data of each registered format is converted or run by a command of the pages."""
    from mstfilter import formats

    data = {"recording": "table-7", "pairs": "frames", "tum": "rgbd_dataset"}
    data |= {"redwood": "bedroom", "bag": "session.bag", "layout": "scan"}
    assert set(data) == set(formats.__components__["format"])
    assert all(any(name in command.split() for command in COMMANDS) for name in data.values())


TABLE = PAGES["troubleshooting"].partition("## When the input is wrong")[2]
ROWS = re.findall(r"^\| ([^|]+) \| (error|warning) \| `([^|]+)` \|$", TABLE, flags=re.MULTILINE)


def test_every_wrong_input_of_the_page_is_tried():
    assert [name for name, _, _ in ROWS] == list(WRONG)


@pytest.mark.parametrize(("name", "kind", "text"), ROWS)
def test_wrong_input_gives_the_message_of_the_page(name, kind, text):
    made = WRONG[name]()
    pattern = ".*".join(map(re.escape, text.split("...")))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            Recording.from_arrays(**made)
            errors = []
        except InputError as error:
            errors = [error]
    found = [one.message for one in caught if isinstance(one.message, InputWarning)]
    said = errors if kind == "error" else found
    assert any(re.search(pattern, one.message) for one in said), (errors, found)
    assert all(one.hints or "no reading" in one.message for one in said)
    assert bool(errors) == (kind == "error")


def test_the_right_recording_of_the_table_is_silent():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        arrays, pose = right()
        Recording.from_arrays(**arrays)
        Recording.from_arrays(**arrays, T_world_camera=pose)


@pytest.mark.parametrize("name", ["jack", "hots/table_7", "hots/office_6", "osd_learn"])
def test_right_real_recordings_are_silent(name, shared_data):
    path = shared_data(f"real/{name}")
    frames = ("learn33", "learn34", "learn35") if name == "osd_learn" else ()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = PairedImages(frames=frames).open(path) if name != "jack" else open_recording(path)
        recording.clips()


@pytest.mark.parametrize("setting", sorted(set(re.findall(r"`([\w.]+=[\w.-]+)`", PAGES["troubleshooting"]))))
def test_the_settings_of_the_page_exist(setting):
    name = setting.partition("=")[0]
    if name == "threads":
        assert name in inspect.signature(mstfilter.Stream).parameters
    else:
        assert mstfilter.preset("mst", setting) != mstfilter.preset("mst")

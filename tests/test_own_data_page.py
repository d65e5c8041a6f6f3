"""Every command of docs/own-data.md runs on data of its layout."""

from __future__ import annotations

import json
import re
import shlex
import shutil

import numpy as np
import pytest

from mstfilter.scene import read_depth, read_rgb, write_image
from tests.conftest import REPOSITORY
from tests.formats import layouts
from tests.formats.bags import scene_messages, write as write_bag
from tests.scene.test_recording import write
from tests.test_cli import call

PAGE = (REPOSITORY / "docs" / "own-data.md").read_text()
COMMANDS = [
    line.partition("  #")[0].strip()
    for block in re.findall(r"```sh\n(.*?)```", PAGE, flags=re.DOTALL)
    for line in block.splitlines()
    if line.startswith("mstfilter ")
]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with the data that the page uses."""
    path = tmp_path_factory.mktemp("data")
    write(path / "table-7")
    write_bag(path / "session", "bag", scene_messages(True))
    mcap = write_bag(path / "s", "mcap", scene_messages(False))
    shutil.move(next(mcap.glob("*.mcap")), path / "session.mcap")
    for file in layouts.write_tum(path / "rgbd_dataset", (0,) * 6).rglob("*.png"):  # 640 x 480
        image = read_rgb(file) if file.parent.name == "rgb" else np.rint(read_depth(file, 1)).astype(np.uint16)
        write_image(file, image.repeat(4, axis=0).repeat(4, axis=1))
    layouts.write_redwood(path / "bedroom")
    layouts.write_bop(path / "000048")
    layouts.write_dsr(layouts.write_dsr(path / "real_test_data"), sequence="8")
    (path / "frames").mkdir()
    for k in (0, 4):
        for part in ("rgb", "depth"):
            shutil.copy(path / f"table-7/{part}/{k:06d}.png", path / f"frames/v{k}_{part}.png")
    (path / "frames" / "info.json").write_text(json.dumps({"K": layouts.K, "depth_scale_m": 0.001}))
    example = next(b for b in re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL) if "class Mine" in b)
    (path / "mine.py").write_text(example.partition("\n\nnp.savez")[0])
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
    if words[:3] == ["convert", "session.mcap", "table-7"]:
        shutil.rmtree(here / "table-7")
    if words[0] == "run":
        words += ["--no-report", "n=2"]
    if words[0] == "quality":
        call("run", "table-7", "--out", "run-7", "--no-report", "n=2", capsys=capsys)
    code, _, err = call(*words, capsys=capsys)
    assert code == 0, err
    if words[0] == "convert":
        assert (here / words[2] / "manifest.json").is_file()


def test_every_format_has_a_command():
    """Data of each registered format is converted or run by a command of the page."""
    from mstfilter import formats

    data = {
        "recording": "table-7",
        "pairs": "frames",
        "tum": "rgbd_dataset",
        "bop": "000048",
        "redwood": "bedroom",
        "dsr": "real_test_data",
        "bag": "session.bag",
    }
    assert set(data) == set(formats.__components__["format"])
    assert all(any(name in command.split() for command in COMMANDS) for name in data.values())

"""Folders of trained networks: what is written is read back, and damaged files give one clear error."""

from __future__ import annotations

import hashlib
import struct

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.base.trained import DESCRIPTION, WEIGHTS, open_model, write_model
from mstfilter.mst.completion import NetworkCompleter

TENSORS = {"a.weight": np.arange(6, dtype=np.float32).reshape(2, 3) / 4, "b": np.float32([0.5])}


@pytest.fixture
def folder(tmp_path):
    write_model(tmp_path / "model", {"architecture": "test", "network": {"width": 8, "names": ["x", 'y"']}}, TENSORS)
    return tmp_path / "model"


def test_what_is_written_is_read_back(folder):
    model = open_model(str(folder), "test")
    assert model.description["network"] == {"width": 8, "names": ["x", 'y"']}
    assert {k: v.tolist() for k, v in model.tensors.items()} == {k: v.tolist() for k, v in TENSORS.items()}
    model.check_tensors({"a.weight": (2, 3), "b": (1,)})
    assert open_model(str(folder)).key == model.key


def test_the_key_follows_the_contents(folder, tmp_path):
    write_model(tmp_path / "other", {"architecture": "test"}, {**TENSORS, "b": np.float32([0.25])})
    assert open_model(str(folder)).key != open_model(str(tmp_path / "other")).key


def test_a_model_that_is_not_there(tmp_path):
    for name in ("no_such_model", str(tmp_path)):
        with pytest.raises(InputError, match=r"there is no model\.toml"):
            open_model(name)


def test_a_folder_of_the_name_of_a_model_of_the_package_does_not_hide_it(tmp_path, monkeypatch):
    shipped = open_model("border").key
    monkeypatch.chdir(tmp_path)
    write_model(tmp_path / "border", {"architecture": "test"}, TENSORS)
    assert open_model("border").key == shipped
    assert open_model("./border").key == open_model(str(tmp_path / "border")).key != shipped


@pytest.mark.parametrize("damage", ["truncated", "changed", "pickle", "huge header"])
def test_damaged_weights(folder, damage):
    path = folder / WEIGHTS
    data = path.read_bytes()
    changes = {"truncated": data[:-5], "changed": data[:-1] + b"\x01", "pickle": b"\x80\x04cos\nsystem\n."}
    broken = changes.get(damage, struct.pack("<Q", 2**62) + b"{}")
    path.write_bytes(broken)
    with pytest.raises(InputError, match="SHA-256"):
        open_model(str(folder))
    # With a matching hash the contents are still checked, and nothing is unpickled.
    text = (folder / DESCRIPTION).read_text()
    before = hashlib.sha256(data).hexdigest()
    (folder / DESCRIPTION).write_text(text.replace(before, hashlib.sha256(broken).hexdigest()))
    if damage != "changed":
        with pytest.raises(InputError, match="not a safetensors file"):
            open_model(str(folder))


def test_wrong_descriptions(folder):
    with pytest.raises(InputError, match="architecture is 'test', expected 'other'"):
        open_model(str(folder), "other")
    with pytest.raises(InputError, match=r"tensor 'b' is \(1,\), the architecture has \(2,\)"):
        open_model(str(folder)).check_tensors({"a.weight": (2, 3), "b": (2,)})
    with pytest.raises(InputError, match="tensor 'c' is missing"):
        open_model(str(folder)).check_tensors({"a.weight": (2, 3), "b": (1,), "c": (1,)})
    (folder / DESCRIPTION).write_text("architecture = [")
    with pytest.raises(InputError, match="not valid TOML"):
        open_model(str(folder))


@pytest.mark.parametrize("size", [-1, 0, 10**9, 2**70, 1.5, True, "x", 4096])
@pytest.mark.parametrize("name", ["completion", "border"])
def test_sizes_that_no_network_has(tmp_path, name, size):
    """No memory is used for a network whose tensors are not those of the file."""
    pytest.importorskip("torch")
    from mstfilter.mst.completion.unet import load_network
    from mstfilter.mst.segmentation.border_network import load_border_network

    model = open_model(name)
    network = {**model.description["network"], "width": size}
    write_model(tmp_path / "mine", {**model.description, "network": network}, model.tensors)
    message = "the architecture has" if size == 4096 else r"model.toml: network.width is .*, expected an integer"
    with pytest.raises(InputError, match=message):
        (load_network if name == "completion" else load_border_network)(str(tmp_path / "mine"))


def test_links_to_themselves_are_no_files(tmp_path):
    pytest.importorskip("torch")
    model = open_model("completion")
    write_model(tmp_path / "mine", model.description, model.tensors)
    (tmp_path / "mine" / "loop").symlink_to("loop")
    assert NetworkCompleter(weights=str(tmp_path / "mine")).weights_key  # another file of the folder
    for name in (WEIGHTS, DESCRIPTION):
        (tmp_path / "mine" / name).unlink()
        (tmp_path / "mine" / name).symlink_to(name)
        with pytest.raises(InputError, match=f"there is no {name} in the folder"):
            _ = NetworkCompleter(weights=str(tmp_path / "mine")).network


def test_a_network_that_is_written_again_is_read_again(tmp_path):
    pytest.importorskip("torch")
    model = open_model("completion")
    keys = []
    for factor in (1.0, 0.5):
        write_model(tmp_path / "mine", model.description, {k: factor * v for k, v in model.tensors.items()})
        keys.append(NetworkCompleter(weights=str(tmp_path / "mine")).weights_key)
        assert keys[-1] == open_model(str(tmp_path / "mine")).key
    assert keys[0] != keys[1]

"""Networks of users as completers: torch weights in a folder with an architecture of the user, and ONNX files."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import mstfilter
from mstfilter.base.errors import InputError, MissingLibraryError
from mstfilter.base.resources import examples_folder
from mstfilter.base.trained import write_model
from mstfilter.mst.completion import CHANNELS, Architecture, NetworkCompleter, observed_box
from mstfilter.mst.completion.crops import channels, crop_box
from mstfilter.mst.completion.observed import encode_box
from mstfilter.mst.completion.unet import load_network
from mstfilter.runs.presets import REGISTRY
from tests.conftest import REPOSITORY
from tests.mst.completion.test_completion import masks_of
from tests.mst.segmentation.scenes import GRID, TWO, clip_of, frame_of

FRAME = frame_of(TWO, width=160)
MASK = masks_of(TWO, FRAME)[0]


@dataclass(frozen=True)
class Convolution(Architecture):
    """A convolution with a number of outputs, or a module that is given."""

    outputs: int = 1
    stride: int = 1
    given: type | None = None

    def build(self) -> nn.Module:
        if self.given is not None:
            return self.given()
        return nn.Conv3d(len(CHANNELS), self.outputs, 3, padding=1, stride=self.stride)


class Renamed(Convolution):
    """The same under another name."""


def save(folder: Path, architecture: Architecture, name: str = "", seed: int = 0) -> nn.Module:
    """Random weights, exact in half precision, in a folder; returns the network."""
    torch.manual_seed(seed)
    net = architecture.build().half().float()
    description = {
        "architecture": name or type(architecture).__name__,
        "network": {"channels": CHANNELS},
        "calibration": {"scale": 0.8, "shift": 0.3},
    }
    write_model(folder, description, {key: t.numpy() for key, t in net.state_dict().items()})
    return net


def expected(net: nn.Module, scale: float, shift: float) -> np.ndarray:
    """The probabilities of the crop of the mask, computed without the completer."""
    index = GRID.index_of(FRAME.points)
    low, high = crop_box(index[FRAME.valid & GRID.contains(index) & MASK], GRID)
    _, seen = observed_box(FRAME, MASK, GRID, NetworkCompleter())
    shape = tuple((high - low).tolist())
    assert seen.surface.shape == shape
    bits, signed = (np.zeros((1, 32, 32, 32), array.dtype) for array in encode_box(seen))
    a, b, c = shape
    bits[0, :a, :b, :c], signed[0, :a, :b, :c] = encode_box(seen)
    height = torch.arange(32) * 0.01 + 0.005 + float(GRID.origin[2])
    with torch.inference_mode():
        logits = net(channels(torch.from_numpy(bits), torch.from_numpy(signed), height)).reshape(32, 32, 32)
    p = torch.sigmoid(scale * logits + shift).numpy()[:a, :b, :c]
    return np.where(seen.free, 0, p)


def completed(completer: NetworkCompleter, seed: int = 0) -> np.ndarray:
    (one,) = completer.complete(np.random.default_rng(seed), FRAME, [MASK], GRID)
    return one.probability


def test_a_network_in_torch_gives_its_logits(tmp_path):
    net = save(tmp_path / "mine", Convolution())
    folder = str(tmp_path / "mine")
    completer = NetworkCompleter(weights=folder, architecture=Convolution(), least_surface=0, log_odds=0)
    np.testing.assert_allclose(completed(completer), expected(net, scale=0.8, shift=0.3), atol=1e-6)
    save(tmp_path / "other", Convolution(), seed=1)
    other = replace(completer, weights=str(tmp_path / "other"))
    assert other.weights_key != completer.weights_key
    assert not np.array_equal(completed(other), completed(completer))


def test_an_architecture_of_a_file_is_named_in_a_preset(tmp_path):
    """The starting file, with another width, in a filter."""
    file = examples_folder() / "scenes" / "architecture.py"
    spec = {"component": f"{file}:MyArchitecture", "width": 4}
    save(tmp_path / "mine", REGISTRY.build("architecture", spec, allow_files=True))
    overrides = [
        "proposal.completer=network",
        f"proposal.completer.weights={tmp_path / 'mine'}",
        f"proposal.completer.architecture={file}:MyArchitecture",
    ]
    with pytest.raises(InputError, match=r"tensor 'inner.bias' is \(4,\), the architecture has \(8,\)"):
        mstfilter.preset("mst", *overrides).proposal.completer.check_files(None)
    mst = mstfilter.preset("mst", *overrides, "proposal.completer.architecture.width=4")
    population = mst.proposal.sample(np.random.default_rng(0), clip_of(TWO, width=160), 2)
    assert all(h.n_objects > 0 for h in population.particles)


@pytest.fixture
def onnx_page(monkeypatch, tmp_path):
    """The example of docs/completion.md that exports `net` to mine.onnx, as a function; works in `tmp_path`."""
    for module in ("onnxruntime", "onnxscript"):
        pytest.importorskip(module, reason=f"{module} absent: pip install -e '.[dev]'")
    monkeypatch.chdir(tmp_path)
    page = (REPOSITORY / "docs" / "completion.md").read_text()
    (example,) = re.findall(r"```py\n(.*?)```", page, flags=re.DOTALL)
    return lambda net: exec(compile(example, "completion.md", "exec"), {"net": net.eval(), "torch": torch})


def test_a_network_in_onnx_equals_the_one_in_torch(onnx_page, tmp_path):
    net = save(tmp_path / "mine", Convolution())
    onnx_page(net)
    completer = NetworkCompleter(weights="mine.onnx", least_surface=0, log_odds=0)
    np.testing.assert_allclose(completed(completer), expected(net, scale=1, shift=0), atol=1e-5)
    with pytest.raises(InputError, match="contains its architecture"):
        completed(replace(completer, architecture=Convolution()))


class Fails(nn.Module):
    def forward(self, x):
        raise RuntimeError("first line\nsecond line")


class Infinite(nn.Module):
    def forward(self, x):
        return x[:, 0] / 0


WRONG = {
    "missing folder": (None, Convolution(), "there is no model.toml"),
    "wrong architecture": (Renamed(), Convolution(), "architecture is 'Renamed', expected 'Convolution'"),
    "wrong tensors": (Convolution(), Convolution(2), "is (1,), the architecture has (2,)"),
    "two outputs": (
        Convolution(2),
        Convolution(2),
        "the output of the network is (1, 2, 32, 32, 32), expected (1, 32",
    ),
    "half size": (Convolution(stride=2), Convolution(stride=2), "is (1, 1, 16, 16, 16), expected (1, 32, 32, 32)"),
    "fails": (
        Convolution(given=Fails),
        Convolution(given=Fails),
        "shape (1, 8, 32, 32, 32): RuntimeError: first line",
    ),
    "infinite": (Convolution(given=Infinite), Convolution(given=Infinite), "is not finite"),
    "no module": (Convolution(), Convolution(given=list), "build of Convolution returns list"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_network_that_cannot_be_used_is_one_error(tmp_path, case):
    stored, given, message = WRONG[case]
    if stored is not None:
        save(tmp_path / "mine", stored)
    with pytest.raises(InputError) as caught:
        NetworkCompleter(weights=str(tmp_path / "mine"), architecture=given).check_files(None)
    assert message in caught.value.message and "\n" not in caught.value.message


def test_an_endless_loop_in_onnx_is_stopped(tmp_path, monkeypatch):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    make, kind = onnx.helper, onnx.TensorProto
    inner = [make.make_tensor_value_info("i", kind.INT64, [])]
    for name in "cv":
        inner.append(make.make_tensor_value_info(name, kind.BOOL if name == "c" else kind.FLOAT, None))
    outer = [make.make_tensor_value_info(f"{one.name}2", one.type.tensor_type.elem_type, None) for one in inner[1:]]
    body = make.make_graph([make.make_node("Identity", [n], [f"{n}2"]) for n in "cv"], "body", inner, outer)
    nodes = [
        make.make_node("Constant", [], ["true"], value=make.make_tensor("t", kind.BOOL, [], [1])),
        make.make_node("ReduceMean", ["x"], ["mean"], axes=[1], keepdims=0),
        make.make_node("Loop", ["", "true", "mean"], ["y"], body=body),
    ]
    x = make.make_tensor_value_info("x", kind.FLOAT, ["n", len(CHANNELS), "a", "b", "c"])
    y = make.make_tensor_value_info("y", kind.FLOAT, ["n", "a", "b", "c"])
    model = make.make_model(make.make_graph(nodes, "g", [x], [y]), opset_imports=[make.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, tmp_path / "loop.onnx")
    monkeypatch.setattr("mstfilter.mst.completion.unet._LONGEST_S", 0.5)
    with pytest.raises(InputError, match=r"it has not ended after 0\.5 s, as in an endless loop"):
        load_network(str(tmp_path / "loop.onnx"))


def test_onnx_files_that_cannot_be_used(onnx_page, tmp_path, monkeypatch):
    net = Convolution(2).build()
    onnx_page(net)
    x = torch.zeros(1, len(CHANNELS), 32, 32, 32)
    torch.onnx.export(net, (x,), "fixed.onnx", external_data=False, verbose=False)
    Path("text.onnx").write_text("x", encoding="utf-8")
    for name, message in (
        ("none", "does not exist"),
        ("text", "is no network that onnxruntime"),
        ("mine", r"the output of the network is \(1, 2, 32, 32, 32\)"),
        ("fixed", r"inputs of the network are \[\[1, 8, 32, 32, 32\]\], expected \[\[n, 8, x, y, z\]\]"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            load_network(f"{name}.onnx")
        assert "\n" not in caught.value.message
    monkeypatch.setitem(sys.modules, "onnxruntime", None)  # an import of it fails
    with pytest.raises(MissingLibraryError, match="needs onnxruntime") as caught:
        load_network("absent.onnx")
    assert caught.value.hints == ("pip install 'mstfilter[onnx]'",)

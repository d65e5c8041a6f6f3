"""COB with random weights in the format of Caffe: layers against plain references, the tree, broken files."""

from __future__ import annotations

import pickle
import struct
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from mstfilter.base.errors import InputError
from mstfilter.base.resources import models_folder
from mstfilter.base.user_files import load_file
from mstfilter.mst.segmentation import OptimalCut, SceneCutObjectness, TreeCutProposal
from tests.mst.segmentation.scenes import TWO, clip_of, frame_of

torch = pytest.importorskip("torch")
functional = pytest.importorskip("torch.nn.functional")

cob, caffe, network_file = (
    load_file(models_folder() / "published" / name) for name in ("cob.py", "caffe.py", "cob_network.py")
)
CobBoundary, CobTree, CobNetwork = cob.CobBoundary, cob.CobTree, network_file.CobNetwork

LEVELS = {"conv1": (64, 1), "res2c": (256, 2), "res3d": (512, 4), "res4f": (1024, 8), "res5c": (2048, 16)}


def varint(n: int) -> bytes:
    out = b""
    while n > 127:
        out, n = out + bytes([n & 127 | 128]), n >> 7
    return out + bytes([n])


def field(number: int, content: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(content)) + content


def encode(layers: dict[str, list[np.ndarray]]) -> bytes:
    """A NetParameter with these blobs, as protoc would write it."""
    out = [field(1, b"COB")]
    for name, blobs in layers.items():
        parts = []
        for blob in blobs:
            shape = field(7, field(1, b"".join(map(varint, blob.shape))))
            parts.append(shape + field(5, blob.astype("<f4").tobytes()))
        content = field(1, name.encode()) + field(2, b"Convolution") + b"".join(field(7, p) for p in parts)
        out.append(field(100, content))
    return b"".join(out)


@pytest.fixture(scope="module")
def blobs():
    """Weights of all layers, small enough that outputs are neither 0 nor 1."""
    rng = np.random.default_rng(0)
    blobs = {}
    for c in network_file.cob_convolutions():
        size = (c.outputs, c.inputs, c.kernel, c.kernel)
        scale = 1.2 / np.sqrt(c.inputs * c.kernel**2) * (0.02 if c.name.startswith("conv1") and c.kernel == 7 else 1)
        blobs[c.name] = [np.float32(scale) * rng.standard_normal(size, np.float32)]
        if c.bias:
            blobs[c.name].append(0.1 * rng.standard_normal(c.outputs).astype(np.float32))
    return blobs


@pytest.fixture(scope="module")
def model(blobs, tmp_path_factory):
    """A file of random weights with the deconvolutions and the unused layer of the training network."""
    extra = {"new-score-weighting": [np.ones((1, 5, 1, 1), np.float32), np.zeros(1, np.float32)]}
    for stride in (2, 4, 8, 16):
        kernel = np.outer(*[1 - np.abs(np.arange(2 * stride) + 0.5 - stride) / stride] * 2).astype(np.float32)
        extra[f"upsample_{stride}"] = [kernel[None, None], np.zeros(1, np.float32)]
        extra[f"upsample_{stride}_or8_1"] = [np.eye(4, dtype=np.float32)[:, :, None, None] * kernel, np.zeros(4)]
    path = tmp_path_factory.mktemp("cob") / "random.caffemodel"
    path.write_bytes(encode({**blobs, **extra}))
    return path


def conv(x: np.ndarray, layer: list[np.ndarray], stride: int = 1) -> np.ndarray:
    """Convolution (C, H, W) in double precision, with a padding that keeps the size at stride 1."""
    weights, bias = (*(torch.from_numpy(np.asarray(blob, np.float64)) for blob in layer), None)[:2]
    padding = weights.shape[-1] // 2
    return functional.conv2d(torch.from_numpy(x), weights, bias, stride, padding).numpy()


def deconv(x: np.ndarray, stride: int, size: tuple[int, int]) -> np.ndarray:
    """Bilinear enlargement of a level that is 0 outside; it is aligned by the centres of the receptive fields."""
    if stride == 1:
        return x
    # The pooling takes pixels 2 i and 2 i + 1, later steps take pixel 2 i: pixel i of a level lies at s i + 0.5.
    at = np.meshgrid(*((np.arange(n) - 0.5) / stride for n in size), indexing="ij")
    return np.stack([ndimage.map_coordinates(one, at, order=1, mode="grid-constant") for one in x])


def reference(layers: dict[str, list[np.ndarray]], x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The network, written from the names of the layers in the published prototxt, in double precision."""
    size = x.shape[1:]
    relu = lambda y: np.maximum(y, 0)  # noqa: E731
    x = relu(conv(x, layers["conv1"]))
    found = {"conv1": x}
    x = functional.max_pool2d(torch.from_numpy(x), 2, ceil_mode=True).numpy()
    for stage, blocks in (("2", "abc"), ("3", "abcd"), ("4", "abcdef"), ("5", "abc")):
        for block in blocks:
            name = f"res{stage}{block}"
            stride = 2 if block == "a" and stage != "2" else 1
            y = relu(conv(x, layers[f"{name}_branch2a"], stride))
            y = relu(conv(y, layers[f"{name}_branch2b"]))
            y = conv(y, layers[f"{name}_branch2c"])
            x = relu(y + (conv(x, layers[f"{name}_branch1"], stride) if block == "a" else x))
            found[name] = x
    sides = [
        deconv(conv(found[name], layers[f"score-dsn{k}"]), stride, size)
        for k, (name, (_, stride)) in enumerate(LEVELS.items(), start=1)
    ]
    fine = conv(np.concatenate(sides[:4]), layers["new-score-weighting1"])
    coarse = conv(np.concatenate(sides[1:]), layers["new-score-weighting3"])
    bins = []
    for k in range(1, 9):
        parts = [
            deconv(conv(conv(found[n], layers[f"{n}_or8_{k}"]), layers[f"{n}_4_or8_{k}"]), stride, size)
            for n, (_, stride) in LEVELS.items()
        ]
        bins.append(conv(np.concatenate(parts), layers[f"score-or8_{k}"]))
    sigmoid = lambda y: 1 / (1 + np.exp(-y))  # noqa: E731
    return sigmoid(fine)[0], sigmoid(coarse)[0], sigmoid(np.concatenate(bins))


def test_the_network_equals_a_plain_reference(blobs):
    size = 37, 45
    image = np.random.default_rng(1).integers(0, 256, (*size, 3)).astype(np.uint8)
    network = CobNetwork().eval()
    assert len(network.layers) == 148
    network.load_caffe({name: tuple(b) for name, b in blobs.items()})
    data = network_file.cob_input(image)
    means = np.array([104.00698793, 116.66876762, 122.67891434])
    expected_input = image[..., ::-1].astype(np.float64) - means
    np.testing.assert_allclose(data.numpy(), expected_input.transpose(2, 0, 1), atol=1e-4)
    with torch.inference_mode():
        single = network(data)
        found = network.double()(data.double())
    expected = reference(blobs, expected_input.transpose(2, 0, 1))
    assert found.orientations.shape == (8, *size)
    assert min(expected[0].std(), expected[2].std()) > 0.01
    for one, rounded, other in zip(found, single, expected, strict=True):
        np.testing.assert_allclose(one.numpy(), other, atol=1e-5)
        np.testing.assert_allclose(rounded.numpy(), other, atol=1e-4)  # rounding of 32 bits through 53 layers


def angle_of(confidence: np.ndarray) -> float:
    """The published rule for one pixel: the two best bins, their mean if they are neighbours; or nan."""
    best, second = np.argsort(-confidence, kind="stable")[:2]
    if confidence[best] < 0.5:
        return np.nan
    step = (second - best + 4) % 8 - 4  # bins 7 and 0 are neighbours
    near = abs(step) == 1 and confidence[second] >= 0.01
    share = confidence[second] / (confidence[best] + confidence[second]) if near else 0.0
    return (best + share * step) * np.pi / 8


def test_orientation_bins():
    rng = np.random.default_rng(0)
    confidence = rng.random((8, 30, 40)).astype(np.float32) ** 4
    confidence[:, 0, :5] = np.eye(8)[:, :5]
    confidence[[0, 7], 1, 1] = 0.9, 0.8
    confidence[[0, 7], 1, 2] = 0.7, 0.8
    found = cob.decode_orientation(confidence)
    expected = np.apply_along_axis(angle_of, 0, confidence)
    np.testing.assert_allclose(np.mod(found, np.pi), np.mod(expected, np.pi), atol=1e-5)
    assert 0.2 < np.isnan(found).mean() < 0.9


def test_a_file_is_read_name_by_name_and_shape_by_shape(model, blobs, tmp_path):
    found = caffe.read_caffemodel(model)
    for name, expected in blobs.items():
        for one, other in zip(found[name], expected, strict=True):
            assert one.dtype == np.float32
            assert (one == other).all()
    single = field(100, field(1, b"a") + field(7, b"".join(varint(5 << 3 | 5) + struct.pack("<f", v) for v in (1, 2))
                                               + field(7, varint(1 << 3) + varint(2))))  # fmt: skip
    other = tmp_path / "other.caffemodel"
    other.write_bytes(varint(3 << 3) + varint(7) + varint(9 << 3 | 1) + bytes(8) + single)
    assert caffe.read_caffemodel(other)["a"][0].tolist() == [1, 2]


def test_the_component_runs_on_a_frame(model):
    frame = frame_of(TWO, width=64)
    boundary = CobBoundary(str(model))
    fine, coarse, angle = boundary.contours(frame)
    assert boundary.boundary(frame).shape == frame.depth.shape
    for one in (fine, coarse):
        assert 0 < one.min() <= one.max() < 1
    assert np.nanmin(angle) >= 0
    assert np.nanmax(angle) <= np.pi
    assert (replace(boundary, scale="mean").boundary(frame) == (fine + coarse) / 2).all()
    assert (replace(boundary, scale="coarse").boundary(frame) == coarse).all()
    proposal = TreeCutProposal(tree=CobTree(boundary), value=SceneCutObjectness(), sampler=OptimalCut())
    tree, _ = proposal.tree_of(frame)
    assert (tree.start[: tree.n_leaves] == 0).all()
    assert (tree.start <= tree.start[tree.parent]).all()
    assert len(proposal.sample(np.random.default_rng(0), clip_of(TWO, width=64), 2)) == 2
    with pytest.raises(InputError, match="needs the frame"):
        CobTree(boundary).build(fine)


def test_large_images_are_resized_as_published(model, monkeypatch):
    monkeypatch.setattr(cob, "_MAX_PIXELS", 2000)
    shapes = []

    def watched(self, image):
        shapes.append(tuple(image.shape))
        return network_file.CobOutput(image[0].sigmoid(), image[1].sigmoid(), image[:1].repeat(8, 1, 1))

    monkeypatch.setattr(CobNetwork, "forward", watched)
    assert CobBoundary(str(model)).boundary(frame_of(TWO, width=80)).shape == (60, 80)
    assert shapes == [(3, 500, 500)]


def discs(size: int = 64) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P(contour) of a circle and of a chord of it, and the angle of their normals."""
    rows, columns = np.indices((size, size), dtype=float)
    y, x = rows - size / 2 + 0.5, columns - size / 2 + 0.5
    r = np.hypot(x, y)
    circle, chord = np.exp(-(((r - 20) / 1.5) ** 2)), np.exp(-((x / 1.5) ** 2)) * (r < 20)
    angle = np.where(circle > chord, np.mod(np.arctan2(y, x), np.pi), 0.0)
    return circle, 0.5 * chord, angle


def test_the_oriented_watershed_keeps_borders_of_the_right_orientation():
    """With true normals the circle is stronger than with normals turned by 90 degrees."""
    circle, chord, angle = discs()
    contours = np.maximum(circle, chord)
    heights = {}
    for name, turned in (("true", angle), ("turned", angle + np.pi / 2), ("unknown", np.full_like(angle, np.nan))):
        parent, height, leaves = cob.combine_scales(contours, contours, turned, 0.05, 1.5)
        heights[name] = height.max()
        assert leaves.shape == contours.shape
        assert (height[parent] >= height - 1e-12).all()
    assert heights["true"] > 0.9 * contours.max() * 0.8
    assert heights["turned"] < 0.35 * heights["true"]
    assert heights["unknown"] == pytest.approx(heights["true"] * 2 / np.pi, rel=0.1)


def test_the_combined_tree_has_the_regions_of_both_scales():
    """The circle is seen at both scales, the chord at the fine one only: it is merged first, at half its height."""
    circle, chord, angle = discs()
    _, height, leaves = cob.combine_scales(np.maximum(circle, chord), circle, angle, 0.05, 1.5)
    inner = height[height > 0]
    both = height.max()
    fine_only = inner[inner < 0.8 * both].max()
    _, single_height, _ = cob.combine_scales(np.maximum(circle, chord), np.maximum(circle, chord), angle, 0.05, 1.5)
    alone = single_height[(single_height > 0) & (single_height < 0.8 * single_height.max())].max()
    assert fine_only == pytest.approx(alone / 2, rel=0.1)
    centre, left, right = leaves[2, 2], leaves[32, 25], leaves[32, 38]
    assert len({int(k) for k in (centre, left, right)}) == 3


def test_polygons_of_a_chain():
    points = np.array([(0, k) for k in range(10)] + [(k, 9) for k in range(1, 10)], float)
    assert sorted(cob._segments(points, 1.5)) == [(0, 9), (9, 18)]
    stairs = np.array([(k // 2, (k + 1) // 2) for k in range(20)], float)
    assert cob._segments(stairs, 1.5) == [(0, 19)]


def test_presets_name_the_components_without_importing_torch():
    code = (
        "import sys, mstfilter\n"
        "f = mstfilter.preset('mst', 'proposal.boundary=cob', 'proposal.boundary.weights=a', 'proposal.tree=cob',\n"
        "    'transition.tracker=siammask', 'transition.tracker.weights=b')\n"
        "assert (f.proposal.boundary.weights, f.transition.tracker.weights) == ('a', 'b')\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


FEW = {"a": [np.ones((2, 3, 1, 1)), np.zeros(2)], "b": [np.ones(5)]}
HOSTILE = {
    "truncated": (encode(FEW)[:-30], "is not a complete Caffe model"),
    "pickle": (pickle.dumps(print), "is not a complete Caffe model"),
    "empty": (b"", "has no layer with weights"),
    "huge length": (varint(100 << 3 | 2) + varint(2**62), "is not a complete Caffe model"),
    "twice": (encode({"a": [np.ones(1)]}) * 2, "two layers are named 'a'"),
    "shape and data": (
        field(100, field(1, b"a") + field(7, field(7, field(1, varint(9))) + field(5, bytes(8)))),
        "has 2 values and shape (9,)",
    ),
    "another network": (encode(FEW), "lacks 148 of 148 layers, the first is 'conv1'"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_files_that_are_broken_are_one_clear_error(tmp_path, case):
    content, message = HOSTILE[case]
    path = tmp_path / "x.caffemodel"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        CobBoundary(str(path)).boundary(frame_of(TWO, width=48))
    assert message in caught.value.message
    assert str(path) in caught.value.message
    assert "\n" not in caught.value.message


def test_weights_of_other_networks_are_one_clear_error(blobs):
    network = CobNetwork()
    first = blobs["res2a_branch1"][0]
    cases = {
        "lacks 1 of 148 layers, the first is 'score-or8_3'": {"score-or8_3": None},
        "'res2a_branch1' has blobs of shape": {"res2a_branch1": (first[:, :32],)},
        "layer 'conv1' has blobs of shape": {"conv1": (blobs["conv1"][0],)},
        "not finite": {"res2a_branch1": (first * np.nan,)},
        "is not bilinear": {"upsample_2": (np.ones((1, 1, 4, 4), np.float32),)},
    }
    for message, changes in cases.items():
        changed = {k: v for k, v in {**blobs, **changes}.items() if v is not None}
        with pytest.raises(InputError) as caught:
            network.load_caffe(changed)
        assert message in caught.value.message

"""Trackers of masks: SiamMask with random weights (shapes, references, geometry), SAM 2 with a stand-in."""

from __future__ import annotations

import sys
import types
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from mstfilter.base.errors import InputError, MissingLibraryError
from mstfilter.base.resources import models_folder
from mstfilter.base.user_files import load_file
from mstfilter.formats import read_rgb
from mstfilter.mst.testing import scene_example
from mstfilter.mst.testing.scenes import _labels
from mstfilter.mst.tracking import MaskTracker, PaperRule, StaticTest, TrackingTransition
from mstfilter.scene import Camera, Clip, Frame, Hypothesis, render
from mstfilter.smc import Population
from tests.mst.segmentation.scenes import GRID

torch = pytest.importorskip("torch")
functional = pytest.importorskip("torch.nn.functional")

siammask, network_file, sam2 = (
    load_file(models_folder() / "published" / f"{name}.py")
    for name in ("siammask", "siammask_network", "sam2_tracker")
)
SiamMaskTracker, SiamMaskNetwork = siammask.SiamMaskTracker, network_file.SiamMaskNetwork
Sam2Tracker = sam2.Sam2Tracker


def branches() -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors of the branches, written from the modules of the published program.

    The plain reference below names the tensors of the backbone and of the refinement.
    """
    found: dict[str, tuple[int, ...]] = {}
    for name, outputs in (("rpn_model.cls", 10), ("rpn_model.loc", 20), ("mask_model.mask", 63 * 63)):
        for part, kernel in (("conv_kernel", 3), ("conv_search", 3), ("head", 1)):
            found[f"{name}.{part}.0.weight"] = (256, 256, kernel, kernel)
            for one in ("weight", "bias", "running_mean", "running_var"):
                found[f"{name}.{part}.1.{one}"] = (256,)
        found[f"{name}.head.3.weight"], found[f"{name}.head.3.bias"] = (outputs, 256, 1, 1), (outputs,)
    return found


def shapes(network) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors of a checkpoint of a network."""
    state = network.state_dict().items()
    return {name: tuple(tensor.shape) for name, tensor in state if not name.endswith("num_batches_tracked")}


@pytest.fixture(scope="module")
def tensors():
    """Random weights of all tensors; variances are positive."""
    generator = torch.Generator().manual_seed(0)
    found = {}
    for name, shape in shapes(SiamMaskNetwork()).items():
        if name.endswith("running_var") or (len(shape) == 1 and name.endswith("weight")):
            found[name] = 0.5 + torch.rand(shape, generator=generator)
        else:
            fan = int(np.prod(shape[1:])) if len(shape) > 1 else 100
            found[name] = torch.randn(shape, generator=generator) / np.sqrt(fan)
    return found


@pytest.fixture(scope="module")
def checkpoint(tensors, tmp_path_factory):
    """A checkpoint as the training program writes it."""
    path = tmp_path_factory.mktemp("siammask") / "random.pth"
    state = {f"module.{name}": t for name, t in tensors.items()}
    torch.save({"epoch": 20, "arch": "Custom", "best_acc": 0.5, "state_dict": state}, path)
    return path


def test_names_and_shapes_are_the_published_ones(tensors, checkpoint):
    network = SiamMaskNetwork()
    own = shapes(network)
    assert len(own) == 303 and branches().items() <= own.items()
    assert sum(p.numel() for p in network.parameters()) == 21_482_052
    network.load_state(network_file.read_checkpoint(checkpoint))
    for name, tensor in tensors.items():
        assert torch.equal(network.state_dict()[name], tensor)


def test_depthwise_correlation():
    rng = np.random.default_rng(0)
    x, kernel = rng.standard_normal((6, 9, 10)), rng.standard_normal((6, 3, 4))
    windows = np.lib.stride_tricks.sliding_window_view(x, (3, 4), axis=(1, 2))
    found = network_file.depthwise_correlation(torch.from_numpy(x)[None], torch.from_numpy(kernel)[None])
    np.testing.assert_allclose(found[0].numpy(), np.einsum("chwij,cij->chw", windows, kernel), atol=1e-5)


@torch.inference_mode()
def test_features_and_masks_equal_a_plain_reference(tensors):
    """The backbone for a template, and the refinement of a position, in double precision."""
    t = {name: tensor.double() for name, tensor in tensors.items()}
    network = SiamMaskNetwork()
    network.load_state(tensors)
    network.double()
    generator = torch.Generator().manual_seed(0)
    image = 255 * torch.rand(3, 127, 127, generator=generator, dtype=torch.float64)

    def layer(x, name, norm, **options):
        x = functional.conv2d(x, t[f"{name}.weight"], **options)
        mean, variance, scale, shift = (t[f"{norm}.{k}"] for k in ("running_mean", "running_var", "weight", "bias"))
        return functional.batch_norm(x[None], mean, variance, scale, shift)[0]

    base = "features.features"
    stem = layer(image, f"{base}.conv1", f"{base}.bn1", stride=2).relu()
    x = functional.max_pool2d(stem, 3, stride=2, padding=1)
    stages = [stem]
    for stage, blocks in ((1, 3), (2, 4), (3, 6)):
        for block in range(blocks):
            name = f"{base}.layer{stage}.{block}"
            first = block == 0
            options = {"stride": 2, "padding": 0} if stage == 2 and first else {"padding": 1}
            if stage == 3 and not first:
                options = {"padding": 2, "dilation": 2}
            y = layer(x, f"{name}.conv1", f"{name}.bn1").relu()
            y = layer(y, f"{name}.conv2", f"{name}.bn2", **options).relu()
            y = layer(y, f"{name}.conv3", f"{name}.bn3")
            if first:
                shortcut = [{}, {"stride": 2}, {"padding": 1}][stage - 1]
                x = layer(x, f"{name}.downsample.0", f"{name}.downsample.1", **shortcut)
            x = (x + y).relu()
        stages.append(x)
    reduced = layer(x, "features.downsample.downsample.0", "features.downsample.downsample.1")[:, 4:-4, 4:-4]
    found, found_reduced = network.features(image[None])
    for one, other in zip([*found, found_reduced], [*stages, reduced], strict=True):
        torch.testing.assert_close(one[0], other, rtol=1e-5, atol=1e-5 * float(other.abs().max()))

    sizes = ((64, 125, 125), (256, 63, 63), (512, 31, 31), (256, 25, 25))
    *levels, correlation = (torch.randn(size, generator=generator, dtype=torch.float64) for size in sizes)
    row, column = 3, 20

    def conv(x, name):
        return functional.conv2d(x, t[f"refine_model.{name}.weight"], t[f"refine_model.{name}.bias"], padding=1)

    def two(x, name):
        return conv(conv(x, f"{name}.0").relu(), f"{name}.2").relu()

    def window(level, margin, step, size):
        x = functional.pad(levels[level], [margin] * 4)
        return x[:, step * row : step * row + size, step * column : step * column + size]

    def post(x, k, size):
        at = (torch.arange(size) * x.shape[1]) // size  # nearest neighbour of the original program
        return conv(x[:, at][:, :, at], f"post{k}")

    x = torch.einsum("c,cohw->ohw", correlation[:, row, column], t["refine_model.deconv.weight"])
    x = x + t["refine_model.deconv.bias"][:, None, None]
    x = post(two(x, "h2") + two(window(2, 4, 1, 15), "v2"), 0, 31)
    x = post(two(x, "h1") + two(window(1, 8, 2, 31), "v1"), 1, 61)
    x = post(two(x, "h0") + two(window(0, 16, 4, 61), "v0"), 2, 127)
    inputs = tuple(level[None] for level in levels)
    mask = network.refine(((*inputs, inputs[2]), correlation[None]), row, column)
    torch.testing.assert_close(mask, x[0].sigmoid(), rtol=0, atol=1e-5)


def test_anchors():
    """The five published shapes, centred on a grid with a step of 8 pixels."""
    anchors = siammask.anchor_boxes().reshape(4, 5, 25, 25)
    sizes = [tuple(anchors[2:, k, 0, 0].astype(int).tolist()) for k in range(5)]
    assert sizes == [(104, 32), (88, 40), (64, 64), (40, 80), (32, 96)]
    assert (anchors[:2, :, 12, 12] == 0).all()
    assert anchors[0, 2, 5, 0] == -96
    assert anchors[1, 2, 24, 3] == 96


@pytest.mark.parametrize("position", [(30.0, 20.0), (2.0, 3.0), (78.0, 58.0), (200.0, 200.0)])
def test_crops_are_filled_with_the_mean_colour(position):
    image = np.random.default_rng(0).integers(0, 256, (60, 80, 3)).astype(np.uint8)
    crop = siammask.crop_around(image, np.array(position), 21, 21, np.array([10.7, 20.2, 30.9]))
    around = np.full((460, 480, 3), [10, 20, 30])
    around[200:260, 200:280] = image
    column, row = (200 + int(np.round(p - 11)) for p in position)
    assert (crop == around[row : row + 21, column : column + 21]).all()


class Ideal:
    """A network that sees red pixels: full score at the nearest position, their box, and their mask."""

    def template(self, crop):
        return crop

    def search(self, template, crop):
        red = (crop[0, 2] > 150) & (crop[0, 0] < 100)
        rows, columns = torch.nonzero(red, as_tuple=True)
        middle = torch.stack([columns.float().mean(), rows.float().mean()]) - 127
        j, i = (torch.round(middle / 8).long().clamp(-12, 12) + 12).tolist()
        score, boxes = torch.zeros(2, 5, 25, 25), torch.zeros(4, 5, 25, 25)
        score[0], score[1, 2, i, j] = 5.0, 30.0
        size = torch.tensor([columns.max() - columns.min() + 1.0, rows.max() - rows.min() + 1.0])
        offset = middle - torch.tensor([(j - 12) * 8.0, (i - 12) * 8.0])
        boxes[:, 2, i, j] = torch.cat([offset / 64, torch.log(size / 64)])
        return score, boxes, red

    def refine(self, red, row, column):
        # The mask of a position covers 127 pixels; position 12 is in the middle of the crop.
        padded = functional.pad(red.float(), [32] * 4)
        return padded[8 * row : 8 * row + 127, 8 * column : 8 * column + 127]


def video(n: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """BGR images of a red box that moves and grows, and its masks."""
    images, masks = [], []
    for k in range(n):
        mask = np.zeros((120, 160), bool)
        mask[40 + 5 * k : 60 + 6 * k, 30 + 10 * k : 60 + 11 * k] = True
        image = np.full((120, 160, 3), 120, np.uint8)
        image[mask] = [30, 40, 200]
        images.append(image)
        masks.append(mask)
    return images, masks


@pytest.mark.parametrize("rule", [SiamMaskTracker(), SiamMaskTracker(threshold=0.3, window=0.42, rate=0.25)])
def test_the_mask_follows_a_moving_box(rule):
    """With an ideal network the pasted mask is the true one, displaced by at most a pixel as in the original."""
    images, masks = video(8)
    found = siammask.follow(rule, Ideal(), images, masks[0])
    assert (found & masks[-1]).sum() / (found | masks[-1]).sum() > 0.85
    assert (siammask.follow(rule, Ideal(), images[:1], masks[0]) == masks[0]).all()
    assert not siammask.follow(rule, Ideal(), images, masks[0] & False).any()


def clip_of(images: list[np.ndarray]) -> Clip:
    camera = Camera.from_intrinsics(131, 131, 79.5, 59.5, 160, 120)
    frames = [Frame(image[..., ::-1].copy(), np.ones((120, 160), np.float32), camera) for image in images]
    return Clip(tuple(frames), GRID, 1)


def test_the_component_runs_and_shares_work(checkpoint, monkeypatch):
    images, masks = video(4)
    seen = []
    template = SiamMaskNetwork.template
    monkeypatch.setattr(SiamMaskNetwork, "template", lambda self, crop: seen.append(1) or template(self, crop))
    tracker = SiamMaskTracker(str(checkpoint), step=3)
    found = tracker.track(clip_of(images), [masks[0], masks[0], ~masks[0]])
    assert len(seen) == 2  # equal masks are tracked once
    assert all(mask.shape == (120, 160) and mask.dtype == bool for mask in found)
    again = tracker.track(clip_of(images), masks[:1])
    assert (again[0] == found[0]).all()
    assert len(seen) == 2


@dataclass(frozen=True)
class Stored(MaskTracker):
    """Returns what it was given to return, and records its calls."""

    answer: tuple = ()
    calls: list = field(default_factory=list)

    def track(self, clip, masks):
        self.calls.append([mask.copy() for mask in masks])
        return [self.answer[0] if self.answer else mask & False for mask in masks]


def test_the_transition_asks_once_for_all_distinct_moving_segments():

    population, clip = scene_example(np.random.default_rng(0), 6)
    tracker = Stored()
    transition = TrackingTransition(tracker=tracker)
    moved = transition.predict(np.random.default_rng(0), population, clip)
    assert len(tracker.calls) == 1
    keys = {mask.tobytes() for mask in tracker.calls[0]}
    assert len(keys) == len(tracker.calls[0]) >= 1
    assert len(keys) < sum(h.n_objects for h in population.particles)
    assert moved.notes["motions"]["static"] > 0  # objects at rest are not followed
    everything = TrackingTransition(tracker=(asked := Stored()), static=StaticTest(False))
    everything.predict(np.random.default_rng(0), population, clip)
    assert len(asked.calls[0]) > len(keys)


def test_the_rules_look_where_the_tracker_saw_the_object():
    """Registration to the surface in a wrong mask leaves the box where it is; in the true one it follows."""

    _, clip = scene_example(np.random.default_rng(0), 1)
    h = Hypothesis.from_labels(_labels(0), clip.grid)
    after = render(_labels(2), clip.grid, clip.after.camera).labels == 1

    rule = PaperRule(min_inliers=10**6, max_error=0.02)
    results = {}
    for name, mask in (("true", after), ("lost", after & False)):
        transition = TrackingTransition(rule, tracker=Stored((mask,)))
        moved = transition.predict(np.random.default_rng(0), Population((h,)), clip)
        results[name] = moved.particles[0].labels == 1
    truth = _labels(2) == 1
    assert (results["lost"] == (_labels(0) == 1)).all()
    assert (results["true"] & truth).sum() / (results["true"] | truth).sum() > 0.7


def test_checkpoints_that_cannot_be_used_are_one_clear_error(checkpoint, tensors, tmp_path):
    images, masks = video(2)
    clip = clip_of(images)
    path = tmp_path / "x.pth"

    class Payload:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "executed",))

    few, lacking = {"a": torch.zeros(1)}, {k: v for k, v in tensors.items() if k != "refine_model.post2.bias"}
    bias = "features.features.bn1.bias"
    cases = (
        (checkpoint.read_bytes()[:100_000], "cannot be read"),
        ({"state_dict": few, "x": Payload()}, "cannot be read"),
        ([1, 2], "is no dictionary of tensors"),
        (few, "tensors, the first is 'features.features.conv1.weight'"),
        (lacking, "lacks 1 of"),
        ({**tensors, bias: torch.zeros(3)}, "expected (64,)"),
        ({**tensors, bias: torch.full((64,), torch.nan)}, "not finite"),
    )
    for content, message in cases:
        path.write_bytes(content) if isinstance(content, bytes) else torch.save(content, path)
        with pytest.raises(InputError) as caught:
            SiamMaskTracker(str(path)).track(clip, masks[:1])
        assert message in caught.value.message and str(path) in caught.value.message
        assert "\n" not in caught.value.message
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(("make", "name"), [(SiamMaskTracker, "SiamMask"), (Sam2Tracker, "SAM 2")])
def test_weights_that_are_missing(make, name):
    images, masks = video(2)
    for arguments, message in (((), f"of {name} are not given"), (("nowhere",), f"of {name} do not exist: nowhere")):
        with pytest.raises(InputError, match=message):
            make(*arguments).track(clip_of(images), masks[:1])


class Predictor:
    """The part of SAM 2's video predictor that the adapter uses; objects move 10 pixels to the right in a frame."""

    def __init__(self, config, checkpoint, device):
        self.built = (config, checkpoint, device)
        self.encoded = 0

    def init_state(self, video_path):
        names = sorted(path.name for path in Path(video_path).iterdir())
        images = [read_rgb(Path(video_path) / name) for name in names]
        self.encoded += len(images)
        return {"names": names, "images": images, "masks": {}}

    def add_new_mask(self, inference_state, frame_idx, obj_id, mask):
        assert frame_idx == 0
        inference_state["masks"][obj_id] = mask

    def propagate_in_video(self, state):
        for k in range(len(state["images"])):
            masks = [np.roll(mask, 10 * k, axis=1) for mask in state["masks"].values()]
            logits = torch.from_numpy(np.array(masks)[:, None]).float() * 20 - 10
            yield k, list(state["masks"]), logits


def test_sam2_tracks_all_masks_with_one_pass_over_the_frames(tmp_path, monkeypatch):
    built = []

    def build(config, checkpoint, device):
        built.append(Predictor(config, checkpoint, device))
        return built[-1]

    monkeypatch.setitem(sys.modules, "sam2", types.ModuleType("sam2"))
    monkeypatch.setitem(sys.modules, "sam2.build_sam", types.SimpleNamespace(build_sam2_video_predictor=build))
    path = tmp_path / "sam2.pt"
    path.write_bytes(b"")
    images, masks = video(6)
    tracker = Sam2Tracker(str(path), step=2)
    first, empty, second = tracker.track(clip_of(images), [masks[0], masks[0] & False, masks[2]])
    assert (first == np.roll(masks[0], 30, axis=1)).all()  # frames 0, 2, 4 and the last one
    assert not empty.any()
    assert (second == np.roll(masks[2], 30, axis=1)).all()
    assert built[0].encoded == 4
    assert built[0].built == ("configs/sam2.1/sam2.1_hiera_t.yaml", str(path), "cpu")
    assert (tracker.track(clip_of(images[:1]), masks[:1])[0] == masks[0]).all()

    def fails(config, checkpoint, device):
        raise RuntimeError("missing keys\nand more")

    monkeypatch.setitem(sys.modules, "sam2.build_sam", types.SimpleNamespace(build_sam2_video_predictor=fails))
    with pytest.raises(InputError, match=r"sam2 cannot load .*sam2\.pt: RuntimeError: missing keys") as caught:
        replace(tracker, device="cuda").track(clip_of(images), masks[:1])
    assert "\n" not in caught.value.message
    monkeypatch.setitem(sys.modules, "sam2.build_sam", None)
    with pytest.raises(MissingLibraryError, match="cannot be imported"):
        replace(tracker, device="cuda").track(clip_of(images), masks[:1])

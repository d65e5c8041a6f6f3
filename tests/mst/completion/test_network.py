"""The completion network as a completer, with random weights: what must hold for any weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import expit, logit

from mstfilter.base.errors import InputError
from mstfilter.base.trained import open_model, write_model
from mstfilter.mst.completion import (
    Completion,
    Extrude,
    NetworkCompleter,
    Posterior,
    arbitrate,
    observed_box,
)
from mstfilter.mst.completion.crops import CHANNELS, PRIOR, channels, crop_box, extruded
from mstfilter.mst.completion.kinds import BoxKind, EllipsoidKind, ShapeKind
from mstfilter.mst.completion.observed import encode_box, observed_again
from mstfilter.mst.completion.unet import ARCHITECTURE, CompletionNet
from mstfilter.scene import Camera, Frame, VoxelGrid, frame_geometry, look_at, render, scene_cache
from tests.mst.completion.test_completion import masks_of, placed
from tests.mst.segmentation.scenes import GRID, TWO, boxes, frame_of

STACK = boxes(((22, 22, 0), (38, 38, 6)), ((26, 26, 6), (34, 34, 14)))


def describe(**network) -> dict:
    values = {"channels": list(CHANNELS), "width": 8, "n_globals": 4, **network}
    return {"architecture": ARCHITECTURE, "network": values, "calibration": {"scale": 0.9, "shift": 0.1}}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A network with random weights that uses its global features."""
    torch.manual_seed(0)
    net = CompletionNet(len(CHANNELS), 8, 4)
    torch.nn.init.normal_(net.head.weight, std=0.5)
    folder = tmp_path_factory.mktemp("model")
    write_model(folder, describe(), {name: t.numpy() for name, t in net.state_dict().items()})
    return str(folder)


@pytest.fixture(scope="module")
def completer(weights):
    return NetworkCompleter(weights=weights, log_odds=0.0)


@pytest.fixture(scope="module")
def frame():
    return frame_of(STACK, width=320, noise=0.3)


def test_crops_equal_the_rules_of_extrusion(frame):
    """What the network starts from is what `Extrude` gives, but for the floor."""
    for mask in masks_of(STACK, frame):
        _, seen = observed_box(frame, mask, GRID, Extrude())
        expected = (Extrude().fill(np.random.default_rng(0), seen) > 0.5) & ~seen.free
        bits, signed = encode_box(seen)
        assert np.array_equal(extruded(bits[None])[0], expected)
        x = channels(torch.from_numpy(bits[None]), torch.from_numpy(signed[None]), torch.zeros(bits.shape[2]))
        assert np.array_equal(x[0, 0].numpy() > 0, seen.surface) and np.array_equal(x[0, 2].numpy() > 0, seen.free)
        assert np.array_equal(x[0, 7].numpy() > 0, expected)
        known = np.isfinite(seen.signed)
        assert np.abs(4 * x[0, 5].numpy() - np.clip(seen.signed, -4, 4))[known].max() < 0.02


def test_a_prior_is_a_channel(weights, completer, frame, tmp_path):
    """With weights 0 for it, the network is the one without; with others, the kinds of the prior count."""
    tensors = dict(open_model(weights, ARCHITECTURE).tensors)
    masks, rng = masks_of(STACK, frame), np.random.default_rng(0)

    def completed(weight: float, kinds: tuple[ShapeKind, ...]) -> list[np.ndarray]:
        folder = tmp_path / str(weight)
        stem = tensors["stem.weight"]
        more = np.full((len(stem), 8, 3, 3, 3), weight, stem.dtype)
        write_model(
            folder,
            describe(channels=[*CHANNELS, PRIOR]),
            {**tensors, "stem.weight": np.concatenate([stem, more], axis=1)},
        )
        of = NetworkCompleter(weights=str(folder), log_odds=0.0, prior=Posterior(kinds=kinds, n=32))
        return [one.probability for one in of.complete(rng, frame, masks, GRID)]

    for found, one in zip(completed(0, (BoxKind(),)), completer.complete(rng, frame, masks, GRID), strict=True):
        np.testing.assert_allclose(found, one.probability, atol=1e-5)
    boxes, balls = (completed(0.1, (kind,)) for kind in (BoxKind(), EllipsoidKind()))
    assert all(np.abs(a - b).max() > 0.01 for a, b in zip(boxes, balls, strict=True))


def test_crops_stand_on_the_table_and_stay_in_the_grid():
    voxels = np.argwhere(np.ones((10, 10, 12), bool)) + (20, 20, 0)
    for lowest, first, top in ((0, 0, 32), (6, 0, 32), (-7, 7, 39), (-40, 40, 60)):
        grid = VoxelGrid((-0.3, -0.3, 0.01 * lowest), 0.01, (60, 60, 60))
        low, high = crop_box(voxels + (0, 0, first), grid)
        assert (low[2], high[2]) == (first, top)
    grid = VoxelGrid(np.zeros(3), 0.01, (100, 100, 50))
    for low, high, edge in (
        ((40, 50, 0), (50, 60, 9), 32),
        ((20, 20, 0), (60, 60, 9), 48),
        ((2, 50, 3), (9, 60, 9), 32),
    ):
        voxels = np.argwhere(np.ones(np.subtract(high, low))) + low
        first, last = crop_box(voxels, grid)
        assert first[2] == 0 and (first >= 0).all() and (last <= grid.shape).all()
        assert (last - first).max() == edge
        assert (voxels >= first).all() and (voxels < last).all()


def test_free_space_and_order(completer, frame):
    """No voxel that the frame saw as free; the result of a mask does not depend on the others or on the cache."""
    rng = np.random.default_rng(0)
    masks = masks_of(STACK, frame)
    free = frame_geometry(frame, GRID).known_free(0.01)
    scene_cache.clear()
    together = completer.complete(rng, frame, masks * 5, GRID)
    for k, mask in enumerate(masks):
        scene_cache.clear()
        alone = completer.complete(rng, frame, [mask], GRID)[0]
        assert np.array_equal(alone.probability, together[k].probability)
        assert not ((placed(alone) > 0) & free).any()
        assert (placed(alone) >= 0.5).any()


@pytest.mark.parametrize("log_odds", [-200.0, -20.0, -2.0, 0.0, 0.2, 0.5, 100.0])
def test_added_log_odds_leave_certain_voxels(log_odds):
    p = np.array([0, 0.25, 0.5, 1], np.float32).reshape(1, 1, 4)
    found = Completion(np.zeros(3, int), p, np.zeros(p.shape, np.int32), "key").shifted(log_odds).probability.ravel()
    assert found.dtype == np.float32 and found[0] == 0 and found[-1] == 1
    np.testing.assert_allclose(found[1:3], expit(np.log([1 / 3, 1]) + log_odds), rtol=1e-5, atol=1e-30)


@pytest.mark.parametrize("size", [0.01, 0.02])
def test_log_odds_are_added_to_every_completion(completer, frame, size):
    grid = VoxelGrid.from_bounds((-0.3, -0.3, 0), (0.3, 0.3, 0.3), size)
    mask = masks_of(STACK, frame)[0]
    as_is, added = (
        replace(completer, log_odds=x).complete(np.random.default_rng(0), frame, [mask], grid)[0] for x in (0.0, 1.5)
    )
    uncertain = (as_is.probability > 0) & (as_is.probability < 1)
    expected = expit(logit(as_is.probability[uncertain].astype(float)) + 1.5)
    assert uncertain.sum() > 20
    np.testing.assert_allclose(added.probability[uncertain], expected, rtol=1e-4, atol=1e-6)
    assert np.array_equal(added.probability[~uncertain], as_is.probability[~uncertain])


@pytest.mark.parametrize("size", [0.02, 0.008])
def test_other_voxel_sizes(completer, size):
    """The network works on its own lattice; the volume hardly depends on the voxels of the workspace."""
    frame = frame_of(TWO, width=320)
    upper = np.asarray(GRID.origin) + np.array(GRID.shape) * GRID.voxel_size
    other = VoxelGrid.from_bounds(np.asarray(GRID.origin), upper, size)
    rng = np.random.default_rng(0)
    for mask in masks_of(TWO, frame):
        fine, coarse = (completer.complete(rng, frame, [mask], grid)[0] for grid in (GRID, other))
        volumes = [(one.probability >= 0.5).sum() * g.voxel_size**3 for one, g in ((fine, GRID), (coarse, other))]
        assert volumes[1] == pytest.approx(volumes[0], rel=0.35)
        [same] = completer.complete_each([rng], frame, [mask], other, [()])
        assert np.array_equal(same.probability, coarse.probability) and len(same.views) == 1
        blind = Frame(frame.rgb, np.full_like(frame.depth, np.nan), frame.camera)
        [hidden] = completer.complete_each([rng], blind, [np.zeros_like(mask)], other, [same.views])
        assert hidden.views == same.views and (hidden.probability >= 0.5).sum() * size**3 == pytest.approx(
            volumes[0], rel=0.5
        )


def test_empty_masks_and_large_objects(completer):
    frame = frame_of(TWO)
    nothing = np.zeros(frame.depth.shape, bool)
    one = completer.complete(np.random.default_rng(0), frame, [nothing], GRID)[0]
    assert one.probability.size == 0
    wide = frame_of(boxes(((8, 10, 0), (52, 50, 4))), width=320)
    mask = masks_of(boxes(((8, 10, 0), (52, 50, 4))), wide)
    assert arbitrate(completer.complete(np.random.default_rng(0), wide, mask, GRID), GRID).any()


@pytest.mark.parametrize("size", [0.01, 0.02])
def test_objects_larger_than_all_crops_are_extruded_whole(completer, size):
    """A bar of 84 cm, also where the frame shows nothing of it any more."""
    rng, grid = np.random.default_rng(0), VoxelGrid((-0.6, -0.3, 0.0), size, (int(1.2 / size), int(0.6 / size), 20))
    bar = np.zeros(grid.shape, np.uint16)
    bar[tuple(slice(round(a / size), round(b / size)) for a, b in ((0.18, 1.02), (0.2, 0.4), (0, 0.12)))] = 1
    view = Camera.from_intrinsics(
        200, 200, 159.5, 119.5, 320, 240, look_at(np.array([0, -0.75, 0.75]), np.array([0, 0, 0.05]))
    )
    seen = render(bar, grid, view)
    frame = Frame(np.zeros((*seen.depth.shape, 3), np.uint8), seen.depth, view)
    [now] = completer.complete_each([rng], frame, [seen.labels == 1], grid, [()])
    blind = Frame(frame.rgb, np.full_like(seen.depth, np.nan), view)
    [later] = completer.complete_each([rng], blind, [np.zeros(seen.labels.shape, bool)], grid, [now.views])
    for one in (now, later):
        assert np.median(one.probability[one.probability >= 0.5]) == pytest.approx(0.8)
        full = np.zeros(grid.shape, bool)
        full[one.box] = one.probability >= 0.5
        assert (full & (bar > 0)).sum() > 0.85 * (full | (bar > 0)).sum()


def test_crops_do_not_depend_on_the_size_of_the_image(completer):
    """Of a long box whose right part is hidden now, as much is remembered whatever the number of its pixels."""
    long, occluder = ((8, 34, 0), (53, 42, 8)), ((26, 22, 0), (56, 25, 24))
    found = []
    for width in (320, 960):
        frames = [frame_of(boxes(long), width), frame_of(boxes(long, occluder), width)]
        masks = [masks_of(boxes(*shown), f)[0] for shown, f in (((long,), frames[0]), ((long, occluder), frames[1]))]
        views = completer.complete_each([None], frames[0], [masks[0]], GRID, [()])[0].views
        low, now, seen, known = observed_again(frames[1], masks[1], views, GRID, completer)
        last = [low[0] + np.nonzero(one.surface.any(axis=(1, 2)))[0].max() for one in (seen, now)]
        assert known == views and last[0] > last[1] + 10
        found.append([*low, *now.surface.shape])
    assert np.abs(np.array(found) - found[0]).max() <= 1


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (describe(width=16), "the architecture has"),
        (describe(channels=["a"]), "channels"),
        ({"architecture": ARCHITECTURE}, r"model\.toml"),
    ],
)
def test_wrong_models(tmp_path, model, message):
    tensors = CompletionNet(len(CHANNELS), 8, 4).state_dict()
    write_model(tmp_path / "model", model, {name: t.numpy() for name, t in tensors.items()})
    with pytest.raises(InputError, match=message):
        NetworkCompleter(weights=str(tmp_path / "model")).check_files(None)


def test_a_grid_may_start_below_the_table(completer, frame, below=7):
    """The same completions as on a grid that starts at the table, and nothing below it."""
    low = VoxelGrid((-0.3, -0.3, -0.01 * below), 0.01, (60, 60, 30 + below))
    masks, rngs = masks_of(STACK, frame), [np.random.default_rng(0)] * 2
    for one, other in zip(*(completer.complete_each(rngs, frame, masks, grid) for grid in (GRID, low)), strict=True):
        found = placed(other, low)
        assert not found[:, :, :below].any()
        # Readings on the border of two voxels can change sides by rounding.
        assert (np.abs(found[:, :, below:] - placed(one)) > 1e-3).mean() < 1e-2


def test_a_visible_object_remains_with_negative_log_odds(completer, frame):
    masks = masks_of(STACK, frame)
    found = replace(completer, log_odds=-30.0).complete_each(
        [np.random.default_rng(0)] * len(masks), frame, masks, GRID
    )
    assert all((one.probability >= 0.5).sum() == (one.points > 0).sum() > 10 for one in found)

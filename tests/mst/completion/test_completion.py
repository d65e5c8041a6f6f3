"""Completers and arbitration: promises that hold for any completer, and what extrusion gives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError
from mstfilter.mst.completion import (
    Completer,
    Completion,
    Extrude,
    Hull,
    ObservedBox,
    SurfaceOnly,
    arbitrate,
    observed_box,
    occupancy_of,
)
from mstfilter.mst.completion.observed import observed_again, recall, view_surface
from mstfilter.scene import Frame, VoxelGrid, frame_geometry, render, scene_cache
from tests.mst.segmentation.scenes import GRID, TWO, boxes, frame_of

RNG = np.random.default_rng(0)


@dataclass(frozen=True)
class Greedy(Completer):
    """Claims its whole box: what it gets is what the veto leaves."""

    padding: ClassVar[int] = 3

    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        return np.ones(seen.points.shape)


COMPLETERS = [Extrude(), SurfaceOnly(), Greedy(), Hull()]
STACK = boxes(((22, 22, 0), (38, 38, 6)), ((26, 26, 6), (34, 34, 14)))


def masks_of(scene: np.ndarray, frame: Frame) -> list[np.ndarray]:
    seen = render(scene, GRID, frame.camera).labels
    return [seen == k for k in range(1, int(scene.max()) + 1)]


def placed(one: Completion, grid: VoxelGrid = GRID) -> np.ndarray:
    full = np.zeros(grid.shape, np.float32)
    full[one.box] = one.probability
    return full


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


AT_THE_BORDER = boxes(((0, 0, 0), (9, 9, 9)), ((25, 25, 10), (35, 35, 16)))


@pytest.mark.parametrize("completer", COMPLETERS)
@pytest.mark.parametrize("scene", [TWO, STACK, AT_THE_BORDER])
def test_promises_of_every_completer(completer, scene):
    """Nothing where the frame saw free space or outside the grid, and each object shows in its own mask."""
    frame = frame_of(scene, width=320, noise=0.3)
    free = frame_geometry(frame, GRID).known_free(0.01)
    masks = masks_of(scene, frame)
    completions = completer.complete(RNG, frame, masks, GRID)
    for mask, one in zip(masks, completions, strict=True):
        assert (one.offset >= 0).all() and (one.offset + one.probability.shape <= GRID.shape).all()
        assert not ((placed(one) > 0) & free).any()
        assert one.points.sum() == GRID.contains(GRID.index_of(frame.points))[mask & frame.valid].sum()
    shown = render(arbitrate(completions, GRID), GRID, frame.camera).labels
    for k, mask in enumerate(masks, start=1):
        assert (shown[mask] == k).mean() > 0.8


def test_extrusion_recovers_boxes():
    frame = frame_of(TWO, width=640)
    for k, one in enumerate(Extrude().complete(RNG, frame, masks_of(TWO, frame), GRID), start=1):
        assert iou(placed(one) >= 0.5, k == TWO) > 0.8
        assert 0.8 < (placed(one) >= 0.5).sum() / (k == TWO).sum() < 1.2
        surface = SurfaceOnly().complete(RNG, frame, [masks_of(TWO, frame)[k - 1]], GRID)[0]
        assert iou(placed(surface) >= 0.5, k == TWO) < 0.6


def test_extrusion_stops_at_another_surface():
    """The upper box of a stack must not claim the front of the lower one, nor the space below that."""
    frame = frame_of(STACK, width=640)
    lower, upper = Extrude().complete(RNG, frame, masks_of(STACK, frame), GRID)
    seen_lower = np.zeros(GRID.shape, bool)
    seen_lower[lower.box] = lower.points >= 20
    below = placed(upper)[:, :, :6] > 0
    assert (below & seen_lower[:, :, :6]).sum() < 0.05 * seen_lower.sum()
    assert below[STACK[:, :, :6] == 1].mean() < 0.3  # at most what is hidden under the upper box


def test_the_answer_depends_on_frame_and_mask_alone():
    frame = frame_of(TWO, noise=0.3)
    a, b = masks_of(TWO, frame)
    for completer in COMPLETERS:
        together = completer.complete(RNG, frame, [a, b], GRID)
        scene_cache.clear()
        alone = completer.complete(RNG, frame, [b], GRID) + completer.complete(RNG, frame, [a], GRID)
        for x, y in zip(together, alone[::-1], strict=True):
            assert np.array_equal(x.probability, y.probability)
            assert np.array_equal(x.offset, y.offset)
            assert x.key == y.key


@pytest.mark.parametrize("turns", [1, 2])
def test_extrusion_turns_with_its_evidence(turns):
    rng = np.random.default_rng(5)
    points = rng.integers(0, 3, (7, 6, 5)).astype(np.int32) * (rng.random((7, 6, 5)) < 0.2)
    nothing = points < -1
    fields = [points, points > 1, (rng.random(points.shape) < 0.1) & (points < 2), *[nothing] * 3, points * 0.0]
    height = np.arange(5) * 0.01 + 0.005
    for completer in (Extrude(), SurfaceOnly()):
        straight = completer.fill(rng, ObservedBox(*fields, height))
        turned = completer.fill(rng, ObservedBox(*(np.rot90(f, turns) for f in fields), height))
        assert np.array_equal(np.rot90(straight, turns), turned)


def test_masks_without_anything():
    """Empty, one pixel, without depth, outside the grid: no error, at most one voxel."""
    frame = frame_of(TWO)
    nothing = np.zeros(frame.depth.shape, bool)
    pixel = nothing.copy()
    row, column = np.argwhere(masks_of(TWO, frame)[0])[40]
    pixel[row, column] = True
    depth = frame.depth.copy()
    depth[row, column] = np.nan
    far = VoxelGrid((5.0, 5.0, 0.0), 0.01, (10, 10, 10))
    for completer in COMPLETERS:
        assert completer.complete(RNG, frame, [nothing], GRID)[0].probability.size == 0
        assert completer.complete(RNG, frame, [], GRID) == []
        assert (completer.complete(RNG, frame, [pixel], GRID)[0].probability == 1).any()
        holed = Frame(frame.rgb, depth, frame.camera)
        assert completer.complete(RNG, holed, [pixel], GRID)[0].probability.size == 0
        robot = Frame(frame.rgb, frame.depth, frame.camera, pixel)
        assert completer.complete(RNG, robot, [pixel], GRID)[0].probability.size == 0
        assert completer.complete(RNG, frame, [pixel], far)[0].probability.size == 0


def test_wrong_mask_size():
    frame = frame_of(TWO)
    with pytest.raises(InputError, match="mask has shape"):
        Extrude().complete(RNG, frame, [np.zeros((3, 3), bool)], GRID)


SMALL = VoxelGrid((0, 0, 0), 1.0, (6, 6, 4))


def random_completions(rng: np.random.Generator, n: int) -> list[Completion]:
    made = []
    for k in range(n):
        low = rng.integers(0, 4, 3) % np.array([4, 4, 2])
        shape = rng.integers(1, np.array(SMALL.shape) - low + 1)
        p = rng.choice([0.0, 0.3, 0.6, 0.6, 1.0], shape).astype(np.float32)
        points = (rng.integers(0, 3, shape) * (rng.random(shape) < 0.2)).astype(np.int32)
        made.append(Completion(low, p, points, f"{rng.integers(1 << 30)}-{k}"))
    return made


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(1, 6))
def test_renumbering_objects_renumbers_the_result(seed, n):
    assert not arbitrate([], SMALL).any()
    rng = np.random.default_rng(seed)
    completions = random_completions(rng, n)
    order = rng.permutation(n)
    straight = arbitrate(completions, SMALL)
    shuffled = arbitrate([completions[k] for k in order], SMALL)
    assert np.array_equal(np.concatenate([[0], order + 1])[shuffled], straight)


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(1, 5))
def test_arbitration_by_its_definition(seed, n):
    """Voxel by voxel: readings first, then probability; ties only by distance to the visible surface."""
    completions = random_completions(np.random.default_rng(seed), n)
    labels = arbitrate(completions, SMALL)
    for voxel in np.ndindex(SMALL.shape):
        rank = []
        for k, one in enumerate(completions):
            at = np.array(voxel) - one.offset
            if (at >= 0).all() and (at < one.probability.shape).all() and one.probability[tuple(at)] >= 0.5:
                surface = np.argwhere(one.points > 0) + one.offset
                gap = np.sqrt(((surface - voxel) ** 2).sum(axis=1)).min() if len(surface) else np.inf
                rank.append((one.points[tuple(at)], one.probability[tuple(at)], -round(gap, 6), k + 1))
        assert (labels[voxel] > 0) == bool(rank)
        if rank:
            best = max(r[:3] for r in rank)
            assert labels[voxel] in {r[3] for r in rank if r[:3] == best}


@pytest.mark.parametrize("seed", range(5))
def test_occupancy_is_that_of_one_owner_or_free_space(seed):
    """By enumeration at each voxel: at most one of the objects is there, given independent claims."""
    grid, rng, made = VoxelGrid((0, 0, 0), 0.01, (12, 12, 12)), np.random.default_rng(seed), []
    for k in range(4):
        low, size = rng.integers(0, 6, 3), rng.integers(3, 7, 3)
        p = rng.choice([0.0, 0.01, 1.0, *rng.random(5)], size).astype(np.float32)
        made.append(Completion(low, p, np.zeros(size, np.int32), f"{k}"))
    labels = arbitrate(made, grid)
    occupancy = occupancy_of(made, labels, grid)
    claims = np.clip([placed(one, grid) for one in made], 0, 0.999).astype(float)
    claims[claims < 0.02] = 0
    for voxel in np.argwhere((claims > 0).any(axis=0)):
        p = claims[(slice(None), *voxel)]
        alone = [np.prod(np.where(np.arange(len(p)) == k, p, 1 - p)) for k in range(len(p))]
        law = np.array(alone) / (sum(alone) + np.prod(1 - p))
        owner, found = int(occupancy.owner[tuple(voxel)]), float(occupancy.probability[tuple(voxel)])
        assert found == pytest.approx(law[owner - 1], abs=1e-3)
        if not labels[tuple(voxel)]:
            assert law[owner - 1] == pytest.approx(law.max(), abs=1e-9)
    np.testing.assert_array_equal(occupancy.owner[labels > 0], labels[labels > 0])
    assert not occupancy.probability[~(claims > 0).any(axis=0)].any()
    sure = [replace(one, probability=np.rint(one.probability)) for one in made]
    assert occupancy_of(sure, arbitrate(sure, grid), grid) is None


CLAIMS = {
    "only the object with most readings": ([[0.6, 0.6], [0.9, 0.9]], [[30, 0], [2, 0]], [1, 2], [0.6, 9 / 11.5]),
    "an object without a voxel claims nothing": ([[0.6, 0.0], [0.4, 0.4]], [[0, 0], [0, 0]], [1, 0], [0.6, 0]),
}


@pytest.mark.parametrize("case", CLAIMS)
def test_claims_of_voxels(case):
    """Odds of two voxels in two completions: 1.5 and 9 against free space."""
    p, points, owner, expected = CLAIMS[case]
    grid, first = VoxelGrid((0, 0, 0), 0.01, (2, 1, 1)), np.zeros(3, np.int64)
    values = zip(np.array(p, np.float32), np.array(points, np.int32), strict=True)
    made = [Completion(first, a[:, None, None], n[:, None, None], str(k)) for k, (a, n) in enumerate(values)]
    found = occupancy_of(made, arbitrate(made, grid), grid)
    np.testing.assert_array_equal(found.owner.ravel(), owner)
    np.testing.assert_allclose(found.probability.ravel(), expected, rtol=1e-3)


def surface_and_free(seen: ObservedBox) -> tuple[np.ndarray, ...]:
    return seen.surface, seen.free, seen.behind, seen.hidden, seen.other_surface


def test_space_before_an_estimated_depth_is_not_free():
    frame = frame_of(TWO)
    mask = masks_of(TWO, frame)[0]
    offset, seen = observed_box(frame, mask, GRID, Extrude())
    _, found = observed_box(replace(frame, estimated=mask), mask, GRID, Extrude())
    box = tuple(slice(a, a + n) for a, n in zip(offset, found.free.shape, strict=True))
    pixel = frame_geometry(frame, GRID).pixel[box]
    inside = (pixel >= 0) & mask.ravel()[pixel]
    assert (seen.free & inside).any()
    assert np.array_equal(found.free, seen.free & ~inside)
    assert np.array_equal(found.surface, seen.surface)


def test_views_are_recalled_where_the_object_is_now():
    """A box that moved by whole voxels, seen again: its evidence moves with it; other objects stay behind."""
    before, after = TWO, np.roll(TWO, 6, axis=1)
    frames = [frame_of(scene, noise=0) for scene in (before, after)]
    rule = Extrude()
    mask, empty = masks_of(before, frames[0])[0], np.zeros(frames[0].depth.shape, bool)
    rng = [np.random.default_rng(0)]
    (view,) = rule.complete_each(rng, frames[0], [mask], GRID, [()])[0].views
    voxels = view_surface(view, GRID)
    assert len(voxels) > 50 and (before[tuple(voxels.T)] == 1).mean() > 0.9
    moved = view.moved(RigidTransform.from_translation([0, 6 * GRID.voxel_size, 0]))
    assert (after[tuple(view_surface(moved, GRID).T)] == 1).mean() > 0.9
    # The same object in the second frame: what the first one showed is added.
    again = masks_of(after, frames[1])[0]
    low, now = observed_box(frames[1], again, GRID, rule)
    both = recall(now, low, GRID, [moved])
    assert (both.surface >= now.surface).all() and (both.free >= now.free).all()
    assert not (both.free & both.surface).any() and not (both.other_surface > now.other_surface).any()
    # The same view once more, from a motion that is wrong by a voxel, does not make the surface thicker.
    (latest,) = rule.complete_each(rng, frames[1], [again], GRID, [()])[0].views
    off = latest.moved(RigidTransform.from_translation([0, GRID.voxel_size, 0]))
    assert not (view_surface(off, GRID)[:, None] == np.argwhere(now.surface) + low).all(axis=2).any(axis=1).all()
    assert (recall(now, low, GRID, [off]).surface <= now.surface).all()
    # Moved back to where it was, all of the evidence about the object is what it was.
    start, first = observed_box(frames[0], mask, GRID, rule)
    blind = replace(first, **{k: np.zeros_like(getattr(first, k)) for k in ("surface", "free", "behind", "hidden")})
    blind = replace(blind, signed=np.full_like(first.signed, np.nan))
    there_and_back = moved.moved(RigidTransform.from_translation([0, -6 * GRID.voxel_size, 0]))
    found = recall(blind, start, GRID, [there_and_back])
    np.testing.assert_array_equal(found.surface, first.surface & ~found.free)
    assert (found.free <= first.free).all() and found.free.sum() > 0.8 * (first.free & (first.signed < -1)).sum() > 0
    # Out of sight it is completed from its views alone.
    dark = Frame(frames[1].rgb, np.full_like(frames[1].depth, np.nan), frames[1].camera)
    [hidden] = rule.complete_each(rng, dark, [empty], GRID, [(moved,)])
    assert hidden.views == (moved,) and iou(placed(hidden) >= 0.5, after == 1) > 0.5
    # What is measured as the surface of another object now is not its surface.
    _, other, seen, known = observed_again(frames[1], empty, (moved,), GRID, rule)
    assert known == (moved,) and other.other_surface.any() and not (seen.surface & other.other_surface).any()
    # A view that the frame refutes is neither used nor remembered: the object did not move there.
    wrong = view.moved(RigidTransform.from_translation([0, 0, 0.1]))
    _, _, seen, known = observed_again(frames[1], again, (wrong, moved), GRID, rule)
    assert known == (moved,)
    for a, b in zip(surface_and_free(seen), surface_and_free(both), strict=True):
        np.testing.assert_array_equal(a, b)
    known = rule.complete_each(rng, frames[1], [again], GRID, [(wrong, moved)])[0].views
    assert len(known) == 2 and known[0] is moved

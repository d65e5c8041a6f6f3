"""Unusual hypotheses and label grids: crossover, mode filter and free space work or raise one clear error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.mst.crossover import Crossover, CrossoverUpdate, ModeFilter, RandomOrder, SpanningTree, conflict_graph
from mstfilter.scene import MAX_LABEL, Clip, Frame, FreeSpace, Hypothesis, VoxelGrid
from mstfilter.smc import Population
from tests.scene.scenes import CAMERA, GRID, table_scene

SMALL = VoxelGrid((0, 0, 0), 0.01, (9, 8, 7))
A, B = (np.random.default_rng(k).choice([0, 0, 1, 2, 3], SMALL.shape).astype(np.uint16) for k in (1, 2))
FILTER = ModeFilter(3, 2, 24)
RGB, DEPTH, LABELS = table_scene()
CLIP = Clip((Frame(RGB, DEPTH, CAMERA),), GRID, 1)


def on(labels, grid=SMALL, birth=0):
    return Hypothesis.from_labels(labels, grid, birth)


def mixed(proposed, predicted, seed=0, **fields):
    return Crossover(**{"mode_filter": FILTER, **fields}).cross(np.random.default_rng(seed), proposed, predicted)


@pytest.mark.parametrize(
    ("grid", "found"),
    [
        (VoxelGrid((0, 0, 0), 0.01, (9, 8, 6)), r"\(9, 8, 6\)"),
        (VoxelGrid((0, 0, 0), 0.02, SMALL.shape), "0.02 m"),
        (VoxelGrid((0, 0, 0.07), 0.01, SMALL.shape), "0.07"),
    ],
    ids=["shape", "voxel size", "origin"],
)
def test_grids_that_differ(grid, found):
    other = on(np.ones(grid.shape, int), grid)
    for parents in ((on(A), other), (other, on(A)), (on(0 * A), other)):  # an empty one too
        with pytest.raises(InputError, match=f"grid of the proposed hypothesis is .*{found}") as caught:
            mixed(*parents)
        assert caught.value.hints


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (-A.astype(int), "from -3 to 0"),
        (np.where(A > 0, np.nan, 0), "type float64"),
        (A.astype(object), "type object"),
        (A.astype(np.int64) + MAX_LABEL, "65538"),
        (A[:3], r"shape"),
        (A[0], r"shape"),
    ],
    ids=["negative", "nan", "object", "too large", "shape", "axes"],
)
def test_invalid_labels_raise_an_error(wrong, message):
    good = on(A)
    calls = [
        lambda: on(wrong),
        lambda: good.with_labels(wrong),
        lambda: conflict_graph(wrong, B),
        lambda: conflict_graph(B, wrong),
    ]
    if wrong.shape != A[:3].shape:
        calls.append(lambda: ModeFilter().apply(wrong))
    for call in calls:
        with pytest.raises(InputError, match=message):
            call()


def test_labels_without_a_record():
    good = on(A)
    with pytest.raises(InputError, match=r"no record for 1 labels \[2\], no voxel for 0 \[\]") as caught:
        Hypothesis(A, SMALL, tuple(o for o in good.objects if o.label != 2))
    assert caught.value.hints
    with pytest.raises(InputError, match=r"no record for 0 labels \[\], no voxel for 1 \[2\]"):
        Hypothesis(np.where(A == 2, 0, A), SMALL, good.objects)
    with pytest.raises(InputError, match=r"no record for 1 labels \[77\]"):
        good.with_labels(np.where(A == 2, 77, A))
    many = np.arange(A.size).reshape(A.shape)
    with pytest.raises(InputError, match=r"no record for 503 labels \[1, 2, 3, 4, 5\]"):
        Hypothesis(many, SMALL)


@pytest.mark.parametrize("structure", [RandomOrder(), SpanningTree()])
def test_parents_without_objects(structure):
    nothing, something = on(0 * A), on(A)
    assert mixed(nothing, something, structure=structure) is something
    assert mixed(something, nothing, structure=structure) is something
    assert mixed(nothing, nothing, structure=structure).n_objects == 0
    for n in (0, 3):
        free = np.zeros((n, 4, 5), np.uint16)
        graph = conflict_graph(free, free)
        assert (len(graph), graph.edges.shape, graph.components()) == (0, (0, 2), [])
        assert ModeFilter().apply(free).shape == free.shape


LAYOUTS = {
    "fortran": np.asfortranarray,
    "reversed": lambda a: np.ascontiguousarray(a[::-1, :, ::-1])[::-1, :, ::-1],
    "strided": lambda a: a.repeat(2, axis=1)[:, ::2],
    "transposed": lambda a: np.ascontiguousarray(a.transpose(2, 0, 1)).transpose(1, 2, 0),
    "big endian": lambda a: a.astype(">u2"),
    "int64": lambda a: a.astype(np.int64),
    "list": lambda a: a.tolist(),
}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("writeable", [True, False])
def test_memory_layout_changes_nothing(layout, writeable):
    a, b = layout(A), layout(B)
    before = [np.array(a), np.array(b)]
    if isinstance(a, np.ndarray):
        a.flags.writeable = b.flags.writeable = writeable
        plain, other = conflict_graph(A, B), conflict_graph(a, b)
        for name in ("side", "label", "size", "edges", "intersection"):
            np.testing.assert_array_equal(getattr(plain, name), getattr(other, name))
        np.testing.assert_array_equal(FILTER.apply(a), FILTER.apply(A))
        assert not np.array_equal(FILTER.apply(A), A), "the filter has work to do"
    child, expected = mixed(on(a, birth=1), on(b)), mixed(on(A, birth=1), on(B))
    assert child.key == expected.key and [o.id for o in child.objects] == [o.id for o in expected.objects]
    assert not child.labels.flags.writeable
    np.testing.assert_array_equal(before, [np.array(a), np.array(b)])


def test_a_caller_s_array_written_later_changes_nothing():
    own = A.copy()
    hypothesis = on(own[:, :, :])
    own[:] = 0
    np.testing.assert_array_equal(hypothesis.labels, A)


def test_the_largest_labels():
    """A table of all pairs of labels would take 34 GB; more objects than labels are refused, not wrapped around."""
    fields = {"mode_filter": ModeFilter(window=1), "structure": RandomOrder(), "merge": "never"}
    labels = (np.arange(504) * 130).reshape(SMALL.shape) + MAX_LABEL - 503 * 130  # the last one is 65,535
    child = mixed(on(labels, birth=1), on(MAX_LABEL + 1 - labels), **fields)
    assert child.n_objects == 504 == len({o.id for o in child.objects})
    grid = VoxelGrid((0, 0, 0), 0.01, (41, 40, 40))
    many, few = np.zeros((2, *grid.shape), np.uint16)
    many.reshape(-1)[:MAX_LABEL] = np.arange(1, MAX_LABEL + 1)  # 65,535 objects of a voxel each
    few.reshape(-1)[-3:] = 1, 2, 3
    with pytest.raises(InputError, match="of 65535 proposed and 3 predicted objects gives 65538, at most 65535"):
        mixed(on(many, grid, 1), on(few, grid), **fields)


def test_the_mode_filter_with_the_largest_labels():
    labels = np.where(A > 0, A + np.uint16(MAX_LABEL - 3), A)
    np.testing.assert_array_equal(FILTER.apply(labels) % (MAX_LABEL - 3), FILTER.apply(A))


def test_free_space_of_unusual_grids():
    """Free space uses the grid of the hypothesis. Empty hypotheses and hypotheses of single voxels are allowed."""
    project = FreeSpace().project
    frame = CLIP.after
    expected = FreeSpace().known_free(frame, GRID)
    part = VoxelGrid(GRID.origin + 0.1, 0.01, (20, 20, 10))
    refined, quality = project(on(np.ones(part.shape, int), part), frame)
    np.testing.assert_array_equal(refined.labels == 0, expected[10:30, 10:30, 10:20])
    assert quality == pytest.approx(1 - expected[10:30, 10:30, 10:20].mean())
    away = VoxelGrid((100.0, 0, 0), 0.01, (3, 3, 3))
    assert project(on(np.ones(away.shape, int), away), frame)[1] == 1.0
    labels = np.zeros(GRID.shape, np.uint16)
    labels.reshape(-1)[-MAX_LABEL:] = np.arange(1, MAX_LABEL + 1)
    refined, quality = project(on(labels, GRID), frame)
    assert refined.n_objects == round(quality * MAX_LABEL) < MAX_LABEL


@pytest.mark.parametrize("wrong", ["predicted", "proposed"])
def test_an_update_of_hypotheses_on_another_grid(wrong):
    """Grids of the same shape with another origin raise an error as well."""
    good, moved = on(LABELS, GRID), on(LABELS, replace(GRID, origin=GRID.origin + 0.05))
    sides = {name: Population((good, moved if name == wrong else good)) for name in ("predicted", "proposed")}
    found = f"grid of {wrong} hypothesis 1 is .* at .-0.25.* expected .* at .-0.3,"
    with pytest.raises(InputError, match=found) as caught:
        CrossoverUpdate().update(np.random.default_rng(0), **sides, observation=CLIP)
    assert caught.value.hints

"""Every metric against a simple reference that counts voxel by voxel."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from mstfilter.base.errors import InputError
from mstfilter.scoring import diversity, least_loss, overlap, pairwise_quality, pause_metrics, weighted_coverage
from mstfilter.scoring.metrics import coverage_of, object_metrics

SMALL = hnp.arrays(np.uint16, (3, 3, 2), elements=st.integers(0, 3))
WORLDS = st.tuples(st.lists(SMALL, min_size=1, max_size=4), SMALL)


def regions(labels):
    """Object -> set of voxels."""
    found = {}
    for where, k in np.ndenumerate(labels):
        if k:
            found.setdefault(int(k), set()).add(where)
    return found


def plain_metrics(hypothesis, truth):
    """One hypothesis, by sets."""
    A, B = regions(hypothesis), regions(truth)
    iou = {(a, b): len(A[a] & B[b]) / len(A[a] | B[b]) for a in A for b in B}
    all_a, all_b = set().union(*A.values()), set().union(*B.values())
    lies = {(a, b) for a in A for b in B if 2 * len(A[a] & B[b]) > len(A[a])}
    holds = {(a, b) for a in A for b in B if 2 * len(A[a] & B[b]) > len(B[b])}
    return {
        "occupancy": len(all_a & all_b) / len(all_a | all_b) if all_a | all_b else 1.0,
        "object_f": 2 * sum(v > 0.5 for v in iou.values()) / (len(A) + len(B)) if A or B else 1.0,
        "split": sum(sum((a, b) in lies and 10 * len(A[a]) >= len(B[b]) for a in A) >= 2 for b in B),
        "merged": sum(sum((a, b) in holds for b in B) >= 2 for a in A),
        "missed": sum(not any((a, b) in lies | holds for a in A) for b in B),
        "invented": sum(not any((a, b) in lies | holds for b in B) for a in A),
        "coverage": {b: (len(B[b]), max([iou[a, b] for a in A], default=0.0)) for b in B},
    }


@settings(max_examples=60, deadline=None, derandomize=True)
@given(WORLDS)
def test_against_sets(world):
    labels, truth = world
    for one in labels:
        table, expected = overlap(one, truth), plain_metrics(one, truth)
        found = object_metrics(table)
        assert {name: found[name] for name in expected if name != "coverage"} == pytest.approx(
            {name: value for name, value in expected.items() if name != "coverage"}
        )
        some = [b for b in expected["coverage"] if b != 2]
        if some:
            sizes, best = np.array([expected["coverage"][b] for b in some]).T
            assert coverage_of(table, some) == pytest.approx((sizes * best).sum() / sizes.sum())
        else:
            assert math.isnan(coverage_of(table, some))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(WORLDS, st.integers(0, 1000))
def test_pairs_of_hypotheses(world, seed):
    labels, _ = world
    weights = np.random.default_rng(seed).dirichlet(np.ones(len(labels)))
    expected = [[weighted_coverage(a, b) for b in labels] for a in labels]
    np.testing.assert_allclose(pairwise_quality(labels), expected)
    pairs = [1 - weighted_coverage(a, b) for a, b in itertools.combinations(labels, 2)]
    assert diversity(pairwise_quality(labels)) == pytest.approx(np.mean(pairs) if pairs else math.nan, nan_ok=True)
    losses = [sum(w * (1 - q) for w, q in zip(weights, row, strict=True)) for row in expected]
    assert losses[least_loss(labels, weights)] == pytest.approx(min(losses))


def test_metrics_of_a_population():
    truth = np.zeros((6, 6, 3), int)
    truth[:2], truth[3:5], truth[5] = 1, 2, 3
    worse = np.where(truth == 2, 1, truth)
    row, _ = pause_metrics(
        [truth, truth, worse], np.array([0.2, 0.2, 0.6]), truth, {1: "visible", 2: "hidden", 3: "unseen"}
    )
    q = weighted_coverage(worse, truth)
    assert row["quality"] == pytest.approx((2 + q) / 3)
    assert row["quality_top"] == q
    assert row["quality_best"] == 1.0
    assert row["quality_weighted"] == pytest.approx(0.4 + 0.6 * q)
    assert (row["quality_visible"], row["quality_hidden"]) == (pytest.approx((2 + 0.5) / 3), pytest.approx(2.5 / 3))
    assert row["quality_unseen"] == 1.0
    assert row["merged"] == pytest.approx(1 / 3)
    assert row["quality_estimate"] == q  # the wrong hypotheses have .6 of the weight
    assert (row["volume_missed"], row["volume_invented"]) == (0, 0)
    assert row["quality_one_blob"] == pytest.approx(weighted_coverage((truth > 0).astype(int), truth))
    assert (row["n_visible"], row["n_hidden"], row["n_unseen"], row["true_objects"]) == (1, 1, 1, 3)
    one, _ = pause_metrics([truth], np.ones(1), truth, {})
    assert math.isnan(one["diversity"]) and math.isnan(one["quality_hidden"])


@settings(max_examples=40, deadline=None, derandomize=True)
@given(WORLDS, st.sampled_from([0, 1, 3]))
def test_free_space_around_changes_no_more_than_it_should(world, margin):
    """Figures of grids with room around are those of the whole grids, the paper's form included."""
    small, true = world
    labels, truth = [np.pad(one, margin) for one in small], np.pad(true, margin)
    n = len(labels)
    row, _ = pause_metrics(labels, np.full(n, 1 / n), truth, dict.fromkeys(range(1, 4), "visible"))
    for form, name in (("objects", "quality"), ("paper", "quality_paper"), ("authors", "quality_authors")):
        assert row[name] == pytest.approx(np.mean([weighted_coverage(one, truth, form) for one in labels])), name
    tight, _ = pause_metrics(small, np.full(n, 1 / n), true, dict.fromkeys(range(1, 4), "visible"))
    for name in set(row) - {"quality_paper"}:
        assert row[name] == pytest.approx(tight[name], nan_ok=True), name


def test_empty_worlds():
    nothing, some = np.zeros((2, 2, 2), int), np.ones((2, 2, 2), int)
    assert pause_metrics([nothing], np.ones(1), nothing, {})[0]["quality"] == 1.0
    assert pause_metrics([nothing], np.ones(1), some, {1: "visible"})[0]["missed"] == 1
    assert pause_metrics([some], np.ones(1), nothing, {})[0]["invented"] == 1


def test_invalid_segmentations_are_named():
    one = np.array([0, 1, 1, 2])
    for bad, message in ((np.array([0, -1, 1, 2]), "from -1 to 2"), (one / 2, "float64"), (one[:2], "shapes")):
        with pytest.raises(InputError, match=message):
            pairwise_quality([one, bad])
        with pytest.raises(InputError, match=message):
            pause_metrics([bad], np.ones(1), one, {})


def test_the_volume_has_no_share_of_nothing():
    row, _ = pause_metrics([np.ones((2, 2, 2), int)], np.ones(1), np.zeros((2, 2, 2), int), {})
    assert math.isnan(row["volume_missed"]) and math.isnan(row["volume_invented"])

"""Belief queries: every figure by brute force on small grids, what nothing may depend on, errors."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.special import entr

from mstfilter import Belief, InputError
from mstfilter.mst.belief.information import hamming, outcome_information
from mstfilter.scene import Camera, Hypothesis, Occupancy, VoxelGrid, look_at, render
from mstfilter.smc import Population

SHAPE = (4, 3, 2)
GRID = VoxelGrid(np.array([-0.02, -0.015, 0.0]), 0.01, SHAPE)
CAMERA = Camera.from_intrinsics(60, 60, 9.5, 7.5, 20, 16, look_at((0.02, -0.1, 0.1), (0, 0, 0.01)))
VOXELS = list(itertools.product(*(range(k) for k in SHAPE)))


def scenes(seed, n=5):
    """n label grids that agree in part, and log weights with a large common constant."""
    rng = np.random.default_rng(seed)
    base = rng.integers(0, 4, SHAPE)
    grids = [np.where(rng.random(SHAPE) < 0.25, rng.integers(0, 5, SHAPE), base) for _ in range(n)]
    grids[-1] = np.where(base == 3, 2, base)  # one that merges, and whose occupancy is the common one
    return [g.astype(np.uint16) for g in grids], rng.normal(size=n) + 700.0


def belief_of(grids, log_weights, grid=GRID):
    return Belief(Population(tuple(Hypothesis.from_labels(g, grid) for g in grids), np.asarray(log_weights)))


@pytest.fixture(params=range(3))
def case(request):
    grids, lw = scenes(request.param)
    w = np.exp(lw - lw.max())
    return belief_of(grids, lw), grids, w / w.sum()


def information(w, outcomes):
    """Mutual information of hypothesis and outcome, by its definition, from the joint table."""
    kinds = sorted(set(outcomes), key=repr)
    joint = np.array([[w[i] * (o == k) for k in kinds] for i, o in enumerate(outcomes)])
    product = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    return sum(p * np.log(p / q) for p, q in zip(joint.ravel(), product.ravel(), strict=True) if p > 0)


def parts(values):
    """A partition without names: the set of the sets of places of each label but 0."""
    groups: dict[int, set[int]] = {}
    for place, label in enumerate(np.ravel(values).tolist()):
        if label:
            groups.setdefault(label, set()).add(place)
    return frozenset(frozenset(g) for g in groups.values())


def regions():
    mask = np.zeros(SHAPE, bool)
    mask[1:3, :2] = True
    return [mask, np.ones(SHAPE, bool), [(0, 0, 0), (3, 2, 1), (0, 0, 0)], (2, 1, 0)]


def voxels_of(region):
    region = np.asarray(region)
    chosen = np.argwhere(region) if region.dtype == bool else region.reshape(-1, 3)
    return sorted({tuple(v) for v in chosen.tolist()})


def test_occupancy_and_same_object(case):
    belief, grids, w = case
    p = np.zeros(SHAPE)
    for v in VOXELS:
        p[v] = sum(wi for wi, g in zip(w, grids, strict=True) if g[v] > 0)
    np.testing.assert_allclose(belief.occupancy(), p, atol=1e-12)
    every = np.array(VOXELS)
    found = belief.same_object(every[:, None], every[None])
    for a, u in enumerate(VOXELS):
        for b, v in enumerate(VOXELS):
            want = sum(wi for wi, g in zip(w, grids, strict=True) if g[u] == g[v] > 0)
            assert found[a, b] == pytest.approx(want, abs=1e-12)


def test_pixels(case):
    belief, grids, w = case
    images = [render(g, GRID, CAMERA).labels for g in grids]
    pixels = [(5, 5), (9, 7), (10, 9), (12, 8), (0, 0), (14, 11)]
    found = belief.same_object_at_pixels(CAMERA, np.array(pixels)[:, None], np.array(pixels)[None])
    seen = 0
    for a, (c, r) in enumerate(pixels):
        for b, (k, s) in enumerate(pixels):
            want = sum(wi for wi, one in zip(w, images, strict=True) if one[r, c] == one[s, k] > 0)
            assert found[a, b] == pytest.approx(want, abs=1e-12)
            seen += 0.01 < want < 0.99
    assert seen > 4


def test_disagreement_in_an_image(case):
    belief, grids, w = case
    images = [render(g, GRID, CAMERA).labels for g in grids]
    found = belief.disagreement(CAMERA)
    for row, column in itertools.product(range(0, CAMERA.height, 3), range(0, CAMERA.width, 3)):
        shown = [set(np.flatnonzero(i == i[row, column])) if i[row, column] else set() for i in images]
        agree = [[len(a & b) / len(a | b) if a | b else 1.0 for b in shown] for a in shown]
        assert found[row, column] == pytest.approx(1 - w @ agree @ w, abs=1e-9)


def test_open_borders_of_touching_boxes():
    # Three boxes in a row. The first two are one object with weight .3; the last one is never joined.
    camera = Camera.from_intrinsics(600, 600, 99.5, 99.5, 200, 200, look_at((0.001, 0, 0.5), (0, 0, 0)))
    grid = VoxelGrid(np.array([-0.06, -0.06, 0.0]), 0.01, (12, 12, 4))
    apart = np.zeros(grid.shape, np.uint16)
    apart[1:4, 3:9, :2], apart[4:7, 3:9, :2], apart[7:10, 3:9, :2] = 1, 2, 3
    joined = np.where(apart == 2, 1, apart).astype(np.uint16)
    belief = belief_of([apart, joined], np.log([0.7, 0.3]), grid)
    (border,) = belief.open_borders(camera)
    assert border.one_object == pytest.approx(0.3)
    image = render(apart, grid, camera).labels
    for column, row in border.pixels:
        around = image[row : row + 2, column : column + 2]
        assert {1, 2} <= set(around.ravel().tolist())
    assert (
        len(border.pixels) >= (image == 1).any(axis=0).sum() or len(border.pixels) >= (image == 1).any(axis=1).sum()
    )
    assert image[tuple(border.middle[::-1])] in (1, 2)
    assert belief.open_borders(camera, at_least=0.4) == []
    assert belief_of([apart], [0.0], grid).open_borders(camera) == []
    with pytest.raises(InputError, match="at_least is 0.7"):
        belief.open_borders(camera, at_least=0.7)


def test_object_count(case):
    belief, grids, w = case
    counts = [len(set(g.ravel().tolist()) - {0}) for g in grids]
    want = [sum(w[i] for i, c in enumerate(counts) if c == k) for k in range(max(counts) + 1)]
    np.testing.assert_allclose(belief.object_count(), want, atol=1e-12)


def test_boundaries(case):
    belief, grids, w = case
    unsure = np.zeros(SHAPE)
    for axis, v in itertools.product(range(3), VOXELS):
        u = tuple(k + (a == axis) for a, k in enumerate(v))
        if u not in VOXELS:
            continue
        # H(S | B) = H(S, B) - H(B), from the table of both.
        joint = {}
        for wi, g in zip(w, grids, strict=True):
            both = bool(g[v] > 0 and g[u] > 0)
            key = (both, both and bool(g[v] == g[u]))
            joint[key] = joint.get(key, 0) + wi
        p_both = sum(p for (both, _), p in joint.items() if both)
        h = -sum(p * np.log(p) for p in joint.values()) + sum(
            q * np.log(q) for q in (p_both, 1 - p_both) if q > 1e-12
        )
        unsure[v], unsure[u] = max(unsure[v], h), max(unsure[u], h)
    np.testing.assert_allclose(belief.boundary_entropy(), unsure, atol=1e-7)
    assert unsure.max() > 0.1


def test_informations_are_mutual_informations(case):
    belief, grids, w = case
    for region in regions():
        where = voxels_of(region)
        touched = [{int(g[v]) for v in where} - {0} for g in grids]
        moved = [frozenset(v for v in VOXELS if g[v] in t) for g, t in zip(grids, touched, strict=True)]
        assert belief.push_information(region) == pytest.approx(information(w, moved), abs=1e-9)
    views = [render(g, GRID, CAMERA) for g in grids]
    depths = [np.nan_to_num(v.depth, nan=-1).round(6).tobytes() for v in views]
    assert belief.view_information(CAMERA) == pytest.approx(information(w, depths), abs=1e-9)
    assert belief.partition_entropy() == pytest.approx(information(w, [parts(g) for g in grids]), abs=1e-9)


@pytest.mark.parametrize("tolerance", [0, 0.5, 3, 40])
def test_map_of_pushes(case, tolerance):
    belief = case[0]
    found = belief.push_map(tolerance)
    for v in VOXELS:
        assert found[v] == pytest.approx(belief.push_information(v, tolerance), abs=1e-9)


def test_tolerance_by_its_formula(case):
    belief, grids, w = case
    for v in VOXELS:  # each voxel counts once
        assert belief.push_information([v] * 3, 5) == belief.push_information(v, 5)

    def soft(distance, tau):
        d = np.array([[distance(a, b) for b in grids] for a in grids], float)
        return -sum(wi * np.log(sum(wj * np.exp(-d[i, j] / tau) for j, wj in enumerate(w))) for i, wi in enumerate(w))

    def fewest_moves(a, b):
        names = range(1, 5)  # all one-to-one matchings of at most four objects
        occupied = ((a > 0) | (b > 0)).sum()
        kept = (sum(((a == k) & (b == m[k - 1])).sum() for k in names) for m in itertools.permutations(names))
        return occupied - max(kept)

    for tau in (0.3, 2.0, 30.0):
        assert belief.partition_entropy(tolerance=tau) == pytest.approx(soft(fewest_moves, tau), abs=1e-9)
        v = (2, 1, 0)
        want = soft(lambda a, b: (((a == a[v]) & (a[v] > 0)) != ((b == b[v]) & (b[v] > 0))).sum(), tau)  # noqa: B023
        assert belief.push_information(v, tau) == pytest.approx(want, abs=1e-9)
        want = soft(
            lambda a, b: (
                (render(a, GRID, CAMERA).depth != render(b, GRID, CAMERA).depth)
                & ~(np.isnan(render(a, GRID, CAMERA).depth) & np.isnan(render(b, GRID, CAMERA).depth))
            ).sum(),
            tau,
        )
        assert belief.view_information(CAMERA, tau) == pytest.approx(want, abs=1e-9)


@pytest.mark.parametrize("error", [0.02, 0.1, 0.3, 0.45])
def test_tolerance_bounds_the_information_of_wrong_readings(error):
    """All 2^6 readings of six voxels, each wrong by itself: the exact information is not below the bound."""
    region = [(0, y, z) for y in range(3) for z in range(2)]
    tolerance = -1 / np.log(2 * np.sqrt(error * (1 - error)))
    readings = np.array(list(itertools.product((0, 1), repeat=6)))

    def channel(h):
        wrong = (readings != [h.labels[v] > 0 for v in region]).sum(axis=1)
        return error**wrong * (1 - error) ** (6 - wrong)

    positive = 0
    for seed in range(20):
        belief = belief_of(*scenes(seed))
        channels = np.array([channel(h) for h in belief.hypotheses])  # (hypotheses, readings)
        w = belief.weights
        exact = entr(w @ channels).sum() - w @ entr(channels).sum(axis=1)
        occupied = np.array([[h.labels[v] > 0 for v in region] for h in belief.hypotheses])
        bound, sharp = (outcome_information(w, occupied, hamming, np.ones(6), tau) for tau in (tolerance, 0.0))
        assert bound - 1e-12 <= exact <= sharp + 1e-12
        positive += bound > 0.2 * exact > 0
    assert positive > 5


def test_outcomes_of_the_user():
    grids, lw = scenes(1)
    belief = belief_of(grids, lw)
    w = belief.weights
    volumes = [int((g > 0).sum()) for g in grids]
    assert belief.information(lambda h: sum(h.volumes().values())) == pytest.approx(information(w, volumes))
    asked = []
    sure = Belief(belief.population.reweighted(np.where(np.arange(5) == 2, 0, -np.inf)))
    assert sure.information(lambda h: asked.append(h)) == 0
    assert len(asked) == 1 and asked[0] is belief.hypotheses[2]


def everything(belief, tolerance):
    """All answers of a belief that name no hypothesis, as one vector."""
    answers = [
        belief.occupancy(),
        belief.same_object(np.array(VOXELS)[:, None], np.array(VOXELS)[None]),
        np.pad(belief.object_count(), (0, 30 - len(belief.object_count()))),
        belief.boundary_entropy(),
        belief.push_map(tolerance),
        *informations(belief, tolerance),
    ]
    return np.concatenate([np.ravel(a) for a in answers])


def informations(belief, tolerance):
    mask = regions()[0]
    return [
        belief.partition_entropy(tolerance=tolerance),
        belief.view_information(CAMERA, tolerance),
        belief.push_information(mask, tolerance),
        belief.push_map(tolerance).max(),
        belief.information(lambda h: h.n_objects),
    ]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 2.0]))
def test_nothing_depends_on_names_order_constants_or_copies(seed, tolerance):
    grids, lw = scenes(seed)
    rng = np.random.default_rng(seed)
    want = everything(belief_of(grids, lw), tolerance)
    assert np.isfinite(want).all()

    def same(grids, lw):
        np.testing.assert_allclose(everything(belief_of(grids, lw), tolerance), want, atol=1e-7)

    names = [np.append(0, rng.choice(np.arange(1, 60000), 5, replace=False)) for _ in grids]
    same([name[g] for name, g in zip(names, grids, strict=True)], lw)
    order = rng.permutation(len(grids))
    same([grids[k] for k in order], lw[order])
    same(grids, lw - 2000.0)
    # One particle in two halves, the second under other names; a particle of weight 0 says nothing.
    halves = np.append(lw, lw[0] + np.log(0.3))
    halves[0] += np.log(0.7)
    same([*grids, names[0][grids[0]]], halves)
    same([*grids, np.ones(SHAPE, int)], np.append(lw, -np.inf))
    same([grids[0], *grids], np.append(lw[0], np.append(lw[0], lw[1:] + np.log(2))))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.1, 100))
def test_no_information_exceeds_that_of_the_whole_segmentation(seed, tolerance):
    belief = belief_of(*scenes(seed))
    exact, soft = informations(belief, 0.0), informations(belief, tolerance)
    assert exact[0] <= np.log(len(belief)) + 1e-12
    for sharp, blurred in zip(exact, soft, strict=True):
        assert 0 <= blurred <= sharp + 1e-12
        assert sharp <= exact[0] + 1e-12
    for more in (1.5, 10.0):
        assert all(b <= a + 1e-9 for a, b in zip(soft, informations(belief, more * tolerance), strict=True))


def test_one_hypothesis_has_no_entropy_and_empty_hypotheses_count():
    for grid in (scenes(0)[0][0], np.zeros(SHAPE, int)):
        belief = belief_of([grid, grid], [0.0, 1.0])
        assert informations(belief, 0.0) == informations(belief, 2.0) == [0.0] * 5
        np.testing.assert_array_equal(belief.occupancy(), grid > 0)
        assert not belief.boundary_entropy().any()
        assert belief.object_count()[len(set(grid.ravel().tolist()) - {0})] == pytest.approx(1)
        assert belief.push_information(np.zeros(SHAPE, bool)) == belief.push_map(tolerance=20).max() == 0


def test_probabilities_of_unsure_hypotheses():
    """Occupancy and "same object" by their definition, with hypotheses that say how sure they are of each voxel."""
    rng = np.random.default_rng(4)
    grids, log_weights = scenes(4, n=3)
    hypotheses = []
    for k, labels in enumerate(grids):
        made = Hypothesis.from_labels(labels, GRID)
        owner = np.where(labels > 0, labels, rng.choice(list(made.volumes()), SHAPE))
        sure = Occupancy(owner, rng.random(SHAPE))
        hypotheses.append(replace(made, occupancy=sure) if k else made)
    belief = Belief(Population(tuple(hypotheses), log_weights))
    w = np.exp(log_weights - log_weights.max())
    w /= w.sum()
    occupied, same = np.zeros(SHAPE), np.zeros((len(VOXELS),) * 2)
    for weight, one in zip(w, hypotheses, strict=True):
        occupied += weight * one.shares.probability.astype(float)
        for (i, a), (j, b) in itertools.product(enumerate(VOXELS), repeat=2):
            owner, p = one.shares.owner, one.shares.probability.astype(float)
            same[i, j] += weight * (owner[a] == owner[b] > 0) * min(p[a], p[b])
    np.testing.assert_allclose(belief.occupancy(), occupied, atol=1e-12)
    every = np.array(VOXELS)
    np.testing.assert_allclose(belief.same_object(every[:, None], every[None]), same, atol=1e-12)


def test_an_outcome_that_is_not_a_number_is_an_error():
    empty = Hypothesis.from_labels(np.zeros((2, 2, 2), int), VoxelGrid((0, 0, 0), 0.01, (2, 2, 2)))
    belief = Belief(Population((empty,) * 3))
    assert belief.information(lambda h: None) == 0
    with pytest.raises(InputError, match="NaN"):
        belief.information(lambda h: float("nan"))


def test_probabilities_above_one_are_an_error():
    with pytest.raises(InputError, match="expected 0 to 1"):
        Occupancy(np.ones((2, 2, 2), int), np.full((2, 2, 2), 3.0))

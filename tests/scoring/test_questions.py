"""The law of the questions by enumeration, and forecasts with noise at the border against sampled noise."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from mstfilter.base.errors import InputError
from mstfilter.scene import Hypothesis, Occupancy, Recording, VoxelGrid
from mstfilter.scoring import Questions, ask, draw_questions, in_question
from mstfilter.scoring.questions import DEPTH_BEHIND, REACH
from tests.scene.scenes import CAMERA, GRID, table_scene
from tests.scoring.test_log_loss import noisy_copies

SMALL = hnp.arrays(np.uint16, (4, 3, 2), elements=st.integers(0, 2))


def every_pair(shape):
    first, second = (k.ravel() for k in np.meshgrid(*[np.arange(np.prod(shape))] * 2, indexing="ij"))
    return Questions(shape, first[first != second], second[first != second])


def recording(n_pauses=2, shifts=(0, 3)):
    images = [table_scene(shift) for shift in shifts[:n_pauses]]
    return Recording.from_arrays(
        rgb=[rgb for rgb, _, _ in images],
        depth=[depth for _, depth, _ in images],
        K=CAMERA.K,
        T_world_camera=CAMERA.T_world_camera,
        pauses=list(range(n_pauses)),
        grid=GRID,
    )


def test_the_law_of_the_pairs():
    """u is uniform; v is uniform among the voxels within 8 of it; voxels without a partner are left out."""
    where = np.zeros((24, 3, 1), bool)
    where[[0, 3, 9], 0, 0] = where[23, 2, 0] = True  # 0-3 and 3-9 are near, 0-9 and 23 are not
    n = 30_000
    found = draw_questions(where, n, np.random.default_rng(0))
    assert len(found) == n
    names = {int(np.ravel_multi_index((x, 0, 0), where.shape)): x for x in (0, 3, 9)}
    pairs = [(names[a], names[b]) for a, b in zip(found.first, found.second, strict=True)]
    expected = {(0, 3): 1 / 3, (3, 0): 1 / 6, (3, 9): 1 / 6, (9, 3): 1 / 3}
    assert set(pairs) == set(expected)
    for pair, p in expected.items():  # 4 standard errors: 1 false alarm in 4,000 over the four
        assert abs(pairs.count(pair) / n - p) < 4 * np.sqrt(p * (1 - p) / n)


@pytest.mark.parametrize("n", [1, 20])
def test_voxels_without_a_partner_are_left_out(n):
    where = np.zeros((60,) * 3, bool)
    where[::20, ::20, ::20] = where[0, 0, 1] = True
    for seed in range(5):
        questions = draw_questions(where, n, np.random.default_rng(seed))
        assert len(questions) == n and set(questions.first) | set(questions.second) == {0, 1}
    assert where.sum() == 28


def test_no_two_near_voxels_give_no_questions():
    where = np.zeros((30, 1, 1), bool)
    assert len(draw_questions(where, 10, np.random.default_rng(0))) == 0
    where[[0, 20]] = True
    assert len(draw_questions(where, 10, np.random.default_rng(0))) == 0


@settings(max_examples=30, deadline=None)
@given(st.lists(SMALL, min_size=1, max_size=3), st.integers(0, 1000))
def test_forecasts_against_voxels(labels, seed):
    weights = np.random.default_rng(seed).dirichlet(np.ones(len(labels)))
    questions = every_pair(labels[0].shape)
    p = questions.forecasts(labels, weights)
    same = [
        [one.flat[a] == one.flat[b] > 0 for one in labels]
        for a, b in zip(questions.first, questions.second, strict=True)
    ]
    np.testing.assert_allclose(p, np.array(same) @ weights, atol=1e-12)
    np.testing.assert_array_equal(questions.forecasts(labels, weights, (0.0, 0.3))[0], p)


def test_noise_in_expectation_and_drawn():
    """The exact expectation equals the mean over draws of the noise, and the mean over all neighbours."""
    rng = np.random.default_rng(5)
    labels = np.zeros((5, 4, 3), np.uint16)
    labels[1:3, 1:, :2], labels[3:, :2] = 1, 2
    questions = every_pair(labels.shape)
    exact = questions.forecasts([labels], np.ones(1), (0.4,))[0]
    n = 4000
    drawn = np.mean([questions.outcomes(noisy_copies(labels, 0.4, rng)) for _ in range(n)], axis=0)
    # 5 standard errors of each of 3,540 pairs: 1 false alarm in 500
    assert (np.abs(drawn - exact) <= 5 * np.sqrt(np.maximum(exact * (1 - exact), 1 / n) / n)).all()
    assert np.abs(exact - questions.outcomes(labels)).max() > 0.3  # it changes something
    deep = np.ones((5, 5, 5), np.uint16)  # no border: no noise
    np.testing.assert_array_equal(every_pair(deep.shape).forecasts([deep], np.ones(1), (0.4,)), 1.0)


def test_forecasts_of_unsure_hypotheses():
    """Against all level sets, the voxels of probability U and more; then voxels take a neighbour's label."""
    rng = np.random.default_rng(6)
    owner = np.zeros((4, 3, 2), np.uint16)
    owner[:2], owner[2:, :2] = 1, 2
    p = rng.uniform(0, 1, owner.shape).astype(np.float16)
    grid = VoxelGrid((0, 0, 0), 0.01, owner.shape)
    one = replace(Hypothesis.from_labels(np.where(p > 0.5, owner, 0), grid), occupancy=Occupancy(owner, p))
    questions = every_pair(owner.shape)
    sure, noisy = questions.forecasts([one], np.ones(1), (0.0, 0.4))
    a, b = questions.first, questions.second
    levels = np.unique(np.append(p.astype(float), (0.0, 1.0)))
    plain, blurred = np.zeros(len(a)), np.zeros(len(a))
    for low, high in itertools.pairwise(levels):  # U in (low, high]
        labels = np.where(p.astype(float) >= high, owner, 0)
        plain += (high - low) * questions.outcomes(labels)
        # Given the level set, the two voxels are independent: each takes a neighbour's label with probability .4.
        share = np.stack([labels == k for k in (1, 2)]).astype(float)
        padded = np.pad(share, ((0, 0), (1, 1), (1, 1), (1, 1)), mode="edge")
        around = [np.roll(padded, s, axis)[:, 1:-1, 1:-1, 1:-1] for axis in (1, 2, 3) for s in (1, -1)]
        law = (0.6 * share + 0.4 * np.mean(around, axis=0)).reshape(2, -1)
        blurred += (high - low) * (law[:, a] * law[:, b]).sum(axis=0)
    np.testing.assert_allclose(sure, plain, atol=1e-12)
    np.testing.assert_allclose(noisy, blurred, atol=1e-12)
    mixed = questions.forecasts([one, owner], np.array([0.25, 0.75]))
    np.testing.assert_allclose(mixed, 0.25 * plain + 0.75 * questions.outcomes(owner), atol=1e-12)


def test_questions_depend_on_the_depth_images_alone():
    one, other = recording(), recording()
    assert np.array_equal(ask(one, 1).first, ask(other, 1).first)
    assert len(ask(one, 0, 50)) == 50
    assert not np.array_equal(ask(one, 0).first, ask(one, 1).first)
    with pytest.raises(InputError, match="no pause 2"):
        ask(one, 2)


def test_voxels_in_question_against_rays():
    """Each voxel by the rule of the module, from the depth images, one by one."""
    made = recording()
    for t in (0, 1):
        where = in_question(made, t)
        assert where.any()
        checked = 0
        rng = np.random.default_rng(t)
        for index in [*rng.permutation(np.argwhere(where))[:40], *rng.permutation(np.argwhere(~where))[:200]]:
            readings = []
            for frame in (made.frames[p] for p in made.pauses[: t + 1]):
                uv, z = CAMERA.project(GRID.centre_of(index))
                u, v = np.rint(uv).astype(int)
                inside = 0 <= u < CAMERA.width and 0 <= v < CAMERA.height
                depth = frame.depth[v, u] if inside else np.nan
                height = frame.points[v, u, 2] if inside else np.nan
                readings.append((float(z - depth), float(height)))
            margin = 0.5 * GRID.voxel_size
            slack = 0.01  # of the sensor's noise, which the rule adds to both margins
            behind = [-margin <= s <= DEPTH_BEHIND - slack and h > margin + slack for s, h in readings]
            never = [not (-margin - slack <= s <= DEPTH_BEHIND and h > margin) for s, h in readings]
            free, not_free = readings[-1][0] < -margin - slack, not readings[-1][0] < -margin
            if any(behind) and not_free:
                assert where[tuple(index)], index
                checked += 1
            elif free or all(never):
                assert not where[tuple(index)], index
                checked += 1
        assert checked > 100
    assert REACH == 8 and (in_question(made, 1) & ~in_question(recording(1), 0)).any()

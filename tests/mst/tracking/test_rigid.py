import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from mstfilter.mst.tracking import rigid


def random_motion(rng, size=0.3):
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform(-size, size, 3)
    return T


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(3, 40), noise=st.sampled_from([0.0, 0.003, 0.1]))
def test_kabsch_is_a_rotation_and_exact_without_noise(seed, n, noise):
    rng = np.random.default_rng(seed)
    T = random_motion(rng)
    p = rng.normal(size=(n, 3))
    q = rigid.move_points(T, p) + noise * rng.normal(size=(n, 3))
    found = rigid.kabsch(p, q)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-9)
    if noise == 0.0:
        np.testing.assert_allclose(rigid.move_points(found, p), q, atol=1e-7)


@pytest.mark.parametrize("flat", [np.diag([1.0, 1, 0]), np.diag([1.0, 0, 0]), np.zeros((3, 3))])
def test_degenerate_points_still_give_a_proper_rotation(flat):
    p = np.random.default_rng(0).normal(size=(9, 3)) @ flat
    T = rigid.kabsch(p, p + [0.1, 0, 0])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(rigid.move_points(T, p), p + [0.1, 0, 0], atol=1e-12)


def test_mirror_images_never_give_a_reflection():
    p = np.random.default_rng(1).normal(size=(20, 3))
    assert np.linalg.det(rigid.kabsch(p, p * [1, 1, -1])[:3, :3]) == pytest.approx(1.0)


def test_no_rotation_beats_kabsch():
    rng = np.random.default_rng(2)
    p = rng.normal(size=(15, 3))
    q = rigid.move_points(random_motion(rng), p) + 0.3 * rng.normal(size=p.shape)
    best = ((rigid.move_points(rigid.kabsch(p, q), p) - q) ** 2).sum()
    for _ in range(200):
        R = Rotation.random(random_state=rng).as_matrix()
        t = (q - p @ R.T).mean(0)
        assert ((p @ R.T + t - q) ** 2).sum() >= best - 1e-9


def test_ransac_finds_the_majority_among_outliers():
    rng = np.random.default_rng(3)
    T = random_motion(rng)
    p = rng.uniform(0, 0.1, (80, 3))
    q = rigid.move_points(T, p) + 0.001 * rng.normal(size=p.shape)
    q[50:] = rng.uniform(-0.3, 0.3, (30, 3))
    found = rigid.ransac(rng, p, q, 0.008)
    assert np.isin(np.arange(50), found.inliers).all()
    np.testing.assert_allclose(rigid.move_points(found.T, p[:50]), q[:50], atol=0.006)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_pairs_give_no_motion(n):
    p = np.zeros((n, 3))
    assert rigid.ransac(np.random.default_rng(0), p, p, 0.01) is None


def test_inverse_and_angle():
    T = random_motion(np.random.default_rng(4))
    np.testing.assert_allclose(rigid.invert(T) @ T, np.eye(4), atol=1e-12)
    assert rigid.angle(np.eye(4)) == 0.0
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, 0.7]).as_matrix()
    assert rigid.angle(turn) == pytest.approx(0.7)

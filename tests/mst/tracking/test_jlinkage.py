import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mstfilter.mst.tracking.rigid import cluster, jlinkage, move_points


def motions(k, rng):
    for _ in range(k):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
        T[:3, 3] = rng.uniform(-0.3, 0.3, 3)
        yield T


@pytest.mark.parametrize("k", [1, 2, 3, 4])
def test_k_exact_motions_give_k_clusters(k):
    rng = np.random.default_rng(k)
    truth = list(motions(k, rng))
    p = rng.uniform(0, 0.15, (15 * k, 3))
    q = np.concatenate([move_points(T, p[15 * i : 15 * (i + 1)]) for i, T in enumerate(truth)])
    found = jlinkage(rng, p, q, eps=1e-4, n_models=4000)
    assert len(found) == k
    for m in found:
        own = np.unique(m.inliers // 15)
        assert len(own) == 1 and len(m.inliers) == 15
        np.testing.assert_allclose(m.T, truth[own[0]], atol=1e-9)


def test_noise_and_outliers_leave_one_cluster_that_holds_all_inliers():
    rng = np.random.default_rng(7)
    (T,) = motions(1, rng)
    p = rng.uniform(0, 0.15, (100, 3))
    q = move_points(T, p) + 0.002 * rng.normal(size=p.shape)
    q[60:] = rng.uniform(-0.4, 0.4, (40, 3))
    found = jlinkage(rng, p, q, eps=0.010)
    assert len(found) == 1
    assert np.isin(np.arange(60), found[0].inliers).mean() > 0.95


def test_two_motions_under_one_mask_are_both_found():
    rng = np.random.default_rng(8)
    a, b = motions(2, rng)
    p = rng.uniform(0, 0.15, (64, 3))
    q = np.where(np.arange(64)[:, None] < 40, move_points(a, p), move_points(b, p)) + 0.001 * rng.normal(size=p.shape)
    found = jlinkage(rng, p, q, n_models=2000)
    assert [len(m.inliers) for m in found] == pytest.approx([40, 24], abs=2)


def test_clusters_are_disjoint_and_share_a_model():
    rng = np.random.default_rng(9)
    preference = rng.random((40, 60)) < 0.15
    groups = cluster(preference)
    members = np.concatenate(groups)
    assert len(members) == len(set(members.tolist())) == preference.any(axis=1).sum()
    shared = [preference[g].all(axis=0) for g in groups]
    assert all(s.any() for s in shared)
    for i, s in enumerate(shared):
        assert not any((s & t).any() for t in shared[i + 1 :])


@pytest.mark.parametrize("n", [0, 2, 4])
def test_too_few_matches_give_no_motion(n):
    assert jlinkage(np.random.default_rng(0), np.zeros((n, 3)), np.zeros((n, 3))) == []

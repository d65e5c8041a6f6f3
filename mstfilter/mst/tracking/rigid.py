"""Rigid motions from corresponding points: least squares, robust fits, and J-Linkage for several motions.

Motions are (..., 4, 4) float64 matrices T: a point p moves to ``q = R p + t`` with R = T[:3, :3] and t = T[:3, 3].
Components exchange single motions as scipy `RigidTransform`. `rigid_transform` converts a matrix without rounding.

>>> import numpy as np
>>> rng = np.random.default_rng(1)
>>> p = rng.uniform(size=(40, 3))
>>> T = kabsch(p, p + [0.1, 0.0, 0.0])
>>> bool(np.allclose(T[:3, 3], [0.1, 0.0, 0.0]))
True

J-Linkage (Toldo and Fusiello, ECCV 2008) finds an unknown number of rigid motions among point matches. Many motions
are sampled, and the preference set of a match contains those that explain it. Matches are merged bottom-up by the
Jaccard distance of their sets, until all sets are disjoint. A cluster has the intersection of its members' sets, so
at least one motion explains all of them.

>>> q = np.where(np.arange(40)[:, None] < 20, p + [0.5, 0, 0], p - [0, 0.5, 0])
>>> [len(m.inliers) for m in jlinkage(rng, p, q)]
[20, 20]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

_MAX_CLUSTERED = 300  # J-Linkage clusters a random subset of more matches: its cost grows with N^2


def rigid_transform(T: np.ndarray) -> RigidTransform:
    """A motion (4, 4) as RigidTransform without rounding: the rotation is not normalised."""
    return RigidTransform(T, normalize=False)


def move_points(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply motions (..., 4, 4) to points (..., N, 3)."""
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def invert(T: np.ndarray) -> np.ndarray:
    """Inverse of motions (..., 4, 4), with the transpose as the inverse rotation."""
    out = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = Rt
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", Rt, T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def angle(T: np.ndarray) -> np.ndarray:
    """Rotation angle of motions (..., 4, 4), radians in [0, pi]."""
    cosine = (np.trace(T[..., :3, :3], axis1=-2, axis2=-1) - 1.0) / 2.0
    return np.arccos(np.clip(cosine, -1.0, 1.0))


def displacement(T: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Distance by which motions (..., 4, 4) move the point ``centre`` (3,), metres."""
    return np.linalg.norm(T[..., :3, :3] @ centre + T[..., :3, 3] - centre, axis=-1)


def kabsch(p: np.ndarray, q: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Least-squares rigid motions (..., 4, 4) of points p to points q, both (..., N, 3), with det R = +1.

    The method is that of Kabsch (1976). `weights` (..., N) must not be negative or all zero.
    """
    p = np.asarray(p, dtype=np.float64)
    q = np.asarray(q, dtype=np.float64)
    w = np.ones(p.shape[:-1]) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w / np.maximum(w.sum(axis=-1, keepdims=True), 1e-300)
    mean_p = np.einsum("...n,...ni->...i", w, p)
    mean_q = np.einsum("...n,...ni->...i", w, q)
    covariance = np.einsum("...n,...ni,...nj->...ij", w, p - mean_p[..., None, :], q - mean_q[..., None, :])
    U, _, Vt = np.linalg.svd(covariance)
    d = np.where(np.linalg.det(U) * np.linalg.det(Vt) < 0.0, -1.0, 1.0)
    signs = np.ones(covariance.shape[:-1])
    signs[..., 2] = d
    R = np.swapaxes(Vt, -1, -2) @ (signs[..., :, None] * np.swapaxes(U, -1, -2))
    T = np.zeros((*covariance.shape[:-2], 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = mean_q - np.einsum("...ij,...j->...i", R, mean_p)
    T[..., 3, 3] = 1.0
    return T


def minimal_models(rng: np.random.Generator, p: np.ndarray, q: np.ndarray, eps: float, n_models: int) -> np.ndarray:
    """Motions (M, 4, 4) of random triples of point pairs that are consistent with a rigid motion; M <= n_models.

    A triple is rejected without a fit if it is nearly collinear, or if the length of a side changes by more than
    ``2 eps``. A rigid motion preserves lengths.
    """
    n = len(p)
    if n < 3:
        return np.empty((0, 4, 4))
    # The second index differs from the first by a non-zero shift; triples with an equal third index are dropped.
    first = rng.integers(0, n, n_models)
    second = (first + rng.integers(1, n, n_models)) % n
    third = rng.integers(0, n, n_models)
    distinct = (third != first) & (third != second)
    triples = np.stack([first, second, third], axis=1)[distinct]
    a, b = p[triples], q[triples]
    sides_a, sides_b = np.roll(a, -1, axis=1) - a, np.roll(b, -1, axis=1) - b
    length_a, length_b = np.linalg.norm(sides_a, axis=-1), np.linalg.norm(sides_b, axis=-1)
    same_length = (np.abs(length_a - length_b) <= 2.0 * eps).all(axis=1)
    area = np.linalg.norm(np.cross(sides_a[:, 0], sides_a[:, 1]), axis=-1)
    wide = area > 0.1 * np.maximum(length_a.max(axis=1), 1e-12) ** 2
    keep = same_length & wide
    return kabsch(a[keep], b[keep]) if keep.any() else np.empty((0, 4, 4))


def residuals(models: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Distances between ``R_k p_i + t_k`` and ``q_i``, (N, M), metres."""
    x, y, z = np.moveaxis(models[:, :3, :3] @ p.T + models[:, :3, 3:] - q.T, 1, 0)  # much faster than einsum and norm
    return np.asarray(np.sqrt(x * x + y * y + z * z).T)


@dataclass(frozen=True)
class MotionCluster:
    """A rigid motion and the matches that it explains."""

    T: np.ndarray  #: (4, 4) motion, world metres
    inliers: np.ndarray  #: (K,) int64, indices of the matches within eps of it
    rms: float  #: root mean square residual of the inliers, metres


def ransac(rng: np.random.Generator, p: np.ndarray, q: np.ndarray, eps: float) -> MotionCluster | None:
    """The motion with most pairs within ``eps`` metres, refitted to these pairs; None for fewer than 3 pairs."""
    models = minimal_models(rng, p, q, eps, 300)
    if not len(models):
        return None
    scoring = slice(None, None, max(1, len(p) // 400))  # 400 pairs are sufficient to rank the models
    return _refit(p, q, models[(residuals(models, p[scoring], q[scoring]) < eps).sum(axis=0).argmax()], eps)


def _refit(p: np.ndarray, q: np.ndarray, T: np.ndarray, eps: float) -> MotionCluster | None:
    """Two rounds of least squares on the inliers among all matches; None if there are fewer than three inliers."""
    inliers = np.flatnonzero(residuals(T[None], p, q)[:, 0] < eps)
    for _ in range(2):
        if len(inliers) < 3:
            return None
        T = kabsch(p[inliers], q[inliers])
        distance = residuals(T[None], p, q)[:, 0]
        inliers = np.flatnonzero(distance < eps)
    if len(inliers) < 3:
        return None
    return MotionCluster(T, inliers, float(np.sqrt((distance[inliers] ** 2).mean())))


def refine_robust(T: np.ndarray, p: np.ndarray, q: np.ndarray, scale: float) -> np.ndarray:
    """Reweighted least squares started at ``T``, with Geman-McClure weights (1 + r^2 / scale^2)^-2 (`scale` in m)."""
    for _ in range(10):
        squared = ((move_points(T, p) - q) ** 2).sum(axis=-1)
        weights = (1.0 + squared / scale**2) ** -2
        if weights.sum() < 1e-6 * len(p):
            break
        T = kabsch(p, q, weights)
    return T


def jlinkage(
    rng: np.random.Generator,
    p: np.ndarray,
    q: np.ndarray,
    *,
    eps: float = 0.010,
    n_models: int = 500,
    min_size: int = 5,
) -> list[MotionCluster]:
    """Find the rigid motions among matches (p_i, q_i).

    Parameters
    ----------
    rng : draws the minimal sets.
    p, q : (N, 3) world metres before and after.
    eps : metres; at least 5 standard deviations of a match, or true clusters are split.
    n_models : sampled triples. A motion that explains a fraction w of the matches is sampled n_models w^3 times.
    min_size : smallest cluster that counts (three matches always fit).

    Returns
    -------
    list of MotionCluster, with most inliers first (ties: smaller rms). A motion is omitted if a motion with more
    inliers explains more than half of its inliers.
    """
    p = np.ascontiguousarray(p, dtype=np.float64)
    q = np.ascontiguousarray(q, dtype=np.float64)
    if len(p) < max(3, min_size):
        return []
    chosen = np.arange(len(p))
    if len(p) > _MAX_CLUSTERED:
        chosen = np.sort(rng.permutation(len(p))[:_MAX_CLUSTERED])
    models = minimal_models(rng, p[chosen], q[chosen], eps, n_models)
    if not len(models):
        return []
    motions: list[MotionCluster] = []
    for members in cluster(residuals(models, p[chosen], q[chosen]) < eps):
        if len(members) >= min_size:
            rows = chosen[members]
            motion = _refit(p, q, kabsch(p[rows], q[rows]), eps)
            if motion is not None and len(motion.inliers) >= min_size:
                motions.append(motion)
    motions.sort(key=lambda m: (-len(m.inliers), m.rms))
    kept: list[MotionCluster] = []
    for motion in motions:
        if all(np.isin(motion.inliers, other.inliers).mean() <= 0.5 for other in kept):
            kept.append(motion)
    return kept


def cluster(preference: np.ndarray) -> list[np.ndarray]:
    """Merge rows of a preference matrix (N, M) until all preference sets are disjoint.

    Returns the rows of each cluster, largest cluster first. Rows with an empty set are in no cluster.
    """
    rows = np.flatnonzero(preference.any(axis=1))
    if not len(rows):
        return []
    B = preference[rows].astype(np.float32)
    members: list[list[int]] = [[int(r)] for r in rows]
    common = B @ B.T
    sizes = B.sum(axis=1)
    similarity = common / (sizes[:, None] + sizes[None, :] - common)  # 1 - Jaccard distance
    np.fill_diagonal(similarity, 0.0)
    best_at = similarity.argmax(axis=1)
    best = similarity[np.arange(len(rows)), best_at]
    while True:
        a = int(best.argmax())
        if best[a] <= 0.0:  # every pair is disjoint
            break
        a, b = sorted((a, int(best_at[a])))
        B[a] *= B[b]
        members[a] += members[b]
        members[b] = []
        B[b] = 0.0
        sizes[b] = 0.0
        sizes[a] = B[a].sum()
        shared = B @ B[a]
        row = shared / np.maximum(sizes + sizes[a] - shared, 1e-9)
        row[a] = 0.0
        similarity[a], similarity[:, a] = row, row
        similarity[b], similarity[:, b] = 0.0, 0.0
        # Update the best partner of rows whose partner was a or b, and of rows that are now closest to a.
        stale = np.flatnonzero((best_at == a) | (best_at == b))
        better = row > best
        best[better], best_at[better] = row[better], a
        for i in {*stale.tolist(), a, b}:
            best_at[i] = similarity[i].argmax()
            best[i] = similarity[i, best_at[i]]
    clusters = [np.array(sorted(m), dtype=np.int64) for m in members if m]
    return sorted(clusters, key=lambda m: (-len(m), int(m[0])))

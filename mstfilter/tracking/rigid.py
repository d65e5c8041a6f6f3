"""Rigid motions from corresponding points: batched, weighted, robust, and from merged statistics.

A motion is a (4, 4) float64 matrix T that takes points ``p`` to ``q = R p + t``.

>>> import numpy as np
>>> p = np.random.default_rng(0).normal(size=(10, 3))
>>> T = kabsch(p, p + [0.1, 0.0, 0.0])
>>> bool(np.allclose(T[:3, 3], [0.1, 0.0, 0.0]))
True

The statistics form writes everything a least-squares fit needs as 18 sums, which add: the fit of any
union of groups follows from the sums of its parts, without looking at a point again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

N_STATISTICS = 18  # n, sum p (3), sum q (3), sum p q^T (9), sum |p|^2, sum |q|^2

Array = NDArray[np.float64]


def apply(T: Array, points: Array) -> Array:
    """Move points (..., N, 3) by motions (..., 4, 4)."""
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def invert(T: Array) -> Array:
    """The inverse of motions (..., 4, 4), exact in structure (transpose of the rotation)."""
    out = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = Rt
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", Rt, T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def angle(T: Array) -> Array:
    """Rotation angle of motions (..., 4, 4), radians in [0, pi]."""
    cosine = (np.trace(T[..., :3, :3], axis1=-2, axis2=-1) - 1.0) / 2.0
    return np.arccos(np.clip(cosine, -1.0, 1.0))


def displacement(T: Array, centre: Array) -> Array:
    """How far motions (..., 4, 4) carry the point ``centre`` (3,), metres."""
    return np.linalg.norm(T[..., :3, :3] @ centre + T[..., :3, 3] - centre, axis=-1)


def kabsch(p: Array, q: Array, weights: Array | None = None) -> Array:
    """Least-squares rigid motions of corresponding points.

    Parameters
    ----------
    p, q : (..., N, 3) points before and after, metres.
    weights : (..., N) or None
        Non-negative weights, not all zero.

    Returns
    -------
    (..., 4, 4) motions with det R = +1 (Kabsch 1976; the sign correction keeps reflections out).
    """
    p = np.asarray(p, dtype=np.float64)
    q = np.asarray(q, dtype=np.float64)
    w = np.ones(p.shape[:-1]) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w / np.maximum(w.sum(axis=-1, keepdims=True), 1e-300)
    mean_p = np.einsum("...n,...ni->...i", w, p)
    mean_q = np.einsum("...n,...ni->...i", w, q)
    covariance = np.einsum("...n,...ni,...nj->...ij", w, p - mean_p[..., None, :], q - mean_q[..., None, :])
    return _from_covariance(covariance, mean_p, mean_q)[0]


def _from_covariance(covariance: Array, mean_p: Array, mean_q: Array) -> tuple[Array, Array]:
    """Motion and the sum s1 + s2 + d s3 from C = sum (p - mean p)(q - mean q)^T."""
    U, s, Vt = np.linalg.svd(covariance)
    d = np.where(np.linalg.det(U) * np.linalg.det(Vt) < 0.0, -1.0, 1.0)
    signs = np.ones(covariance.shape[:-1])
    signs[..., 2] = d
    R = np.swapaxes(Vt, -1, -2) @ (signs[..., :, None] * np.swapaxes(U, -1, -2))
    T = np.zeros((*covariance.shape[:-2], 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = mean_q - np.einsum("...ij,...j->...i", R, mean_p)
    T[..., 3, 3] = 1.0
    return T, (s * signs).sum(axis=-1)


def statistics(p: Array, q: Array, group: NDArray[np.int64], n_groups: int, weights: Array | None = None) -> Array:
    """The 18 additive sums of each group of point pairs.

    Parameters
    ----------
    p, q : (N, 3) points, metres, relative to ONE common origin near them (against cancellation).
    group : (N,) int, the group of each pair in 0..n_groups-1.
    weights : (N,) or None

    Returns
    -------
    (n_groups, 18) float64. The statistics of a union of groups are the sum of the rows.
    """
    w = np.ones(len(p)) if weights is None else np.asarray(weights, dtype=np.float64)
    columns = np.empty((len(p), N_STATISTICS))
    columns[:, 0] = 1.0
    columns[:, 1:4] = p
    columns[:, 4:7] = q
    columns[:, 7:16] = (p[:, :, None] * q[:, None, :]).reshape(len(p), 9)
    columns[:, 16] = np.einsum("ni,ni->n", p, p)
    columns[:, 17] = np.einsum("ni,ni->n", q, q)
    columns *= w[:, None]
    out = np.empty((n_groups, N_STATISTICS))
    for c in range(N_STATISTICS):
        out[:, c] = np.bincount(group, weights=columns[:, c], minlength=n_groups)
    return out


def fit_statistics(sums: Array) -> tuple[Array, Array]:
    """Least-squares motions and squared residuals from merged statistics (..., 18).

    Returns
    -------
    T : (..., 4, 4) motions; identity where the weight is zero.
    residual : (...,) sum of weighted squared distances |R p + t - q|^2, clipped at 0.
    """
    sums = np.asarray(sums, dtype=np.float64)
    n = sums[..., 0]
    safe = np.where(n > 0, n, 1.0)
    mean_p = sums[..., 1:4] / safe[..., None]
    mean_q = sums[..., 4:7] / safe[..., None]
    cross = sums[..., 7:16].reshape(*sums.shape[:-1], 3, 3)
    covariance = cross - n[..., None, None] * mean_p[..., :, None] * mean_q[..., None, :]
    T, trace = _from_covariance(covariance, mean_p, mean_q)
    spread = sums[..., 16] - n * (mean_p**2).sum(-1) + sums[..., 17] - n * (mean_q**2).sum(-1)
    T[n <= 0] = np.eye(4)
    return T, np.maximum(spread - 2.0 * trace, 0.0) * (n > 0)


def minimal_models(rng: np.random.Generator, p: Array, q: Array, eps: float, n_models: int) -> Array:
    """Motions of random triples of pairs that could be rigid.

    A triple is dropped where it is nearly collinear, or where a side's length differs by more than
    ``2 eps`` between before and after: a rigid motion keeps lengths, so mixed triples die unfitted.

    Returns
    -------
    (M, 4, 4) with M <= n_models; (0, 4, 4) for fewer than three pairs.
    """
    n = len(p)
    if n < 3:
        return np.empty((0, 4, 4))
    # Three different indices without a loop: shifts of one index by distinct amounts.
    first = rng.integers(0, n, n_models)
    second = (first + rng.integers(1, n, n_models)) % n
    third = rng.integers(0, n, n_models)
    distinct = (third != first) & (third != second)
    triples = np.stack([first, second, third], axis=1)[distinct]
    a, b = p[triples], q[triples]
    sides_a, sides_b = np.roll(a, -1, axis=1) - a, np.roll(b, -1, axis=1) - b
    length_a, length_b = np.linalg.norm(sides_a, axis=-1), np.linalg.norm(sides_b, axis=-1)
    rigid = (np.abs(length_a - length_b) <= 2.0 * eps).all(axis=1)
    area = np.linalg.norm(np.cross(sides_a[:, 0], sides_a[:, 1]), axis=-1)
    wide = area > 0.1 * np.maximum(length_a.max(axis=1), 1e-12) ** 2
    keep = rigid & wide
    return kabsch(a[keep], b[keep]) if keep.any() else np.empty((0, 4, 4))


def residuals(models: Array, p: Array, q: Array) -> Array:
    """Distances between ``R_k p_i + t_k`` and ``q_i``, (N, M), metres."""
    moved = np.einsum("kij,nj->nki", models[:, :3, :3], p) + models[None, :, :3, 3]
    return np.linalg.norm(moved - q[:, None, :], axis=-1)


def ransac(
    rng: np.random.Generator, p: Array, q: Array, eps: float, n_models: int = 300
) -> tuple[Array, NDArray[np.bool_]] | None:
    """The motion with the most pairs within ``eps`` metres, refitted to them; None where there is none."""
    models = minimal_models(rng, p, q, eps, n_models)
    if not len(models):
        return None
    scoring = slice(None, None, max(1, len(p) // 400))  # 400 pairs rank the models well enough
    T = models[(residuals(models, p[scoring], q[scoring]) < eps).sum(axis=0).argmax()]
    inliers = residuals(T[None], p, q)[:, 0] < eps
    for _ in range(2):
        if inliers.sum() < 3:
            return None
        T = kabsch(p[inliers], q[inliers])
        inliers = residuals(T[None], p, q)[:, 0] < eps
    return (T, inliers) if inliers.sum() >= 3 else None


def refine_robust(T: Array, p: Array, q: Array, scale: float, iterations: int = 10) -> Array:
    """Iteratively reweighted fit with the Geman-McClure weight (1 + r^2 / scale^2)^-2, from ``T``.

    ``scale`` in metres. Where all weights vanish the motion so far is returned.
    """
    for _ in range(iterations):
        squared = ((apply(T, p) - q) ** 2).sum(axis=-1)
        weights = (1.0 + squared / scale**2) ** -2
        if weights.sum() < 1e-6 * len(p):
            break
        T = kabsch(p, q, weights)
    return T

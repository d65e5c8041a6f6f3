"""J-Linkage: all the rigid motions among point matches, without knowing how many there are.

Each match is described by the set of sampled motions that explain it (its preference set). Matches are
merged bottom-up by the Jaccard distance of their sets; a merged cluster keeps the INTERSECTION, so a
cluster always owns a motion that explains every member. Merging ends when all sets are disjoint.
(Toldo and Fusiello, ECCV 2008; the authors of MST use it on SIFT matches.)

>>> import numpy as np
>>> rng = np.random.default_rng(1)
>>> p = rng.uniform(size=(40, 3))
>>> q = np.where(np.arange(40)[:, None] < 20, p + [0.5, 0, 0], p - [0, 0.5, 0])
>>> [len(m.inliers) for m in jlinkage(rng, p, q)]
[20, 20]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mstfilter.tracking import rigid

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """A rigid motion and the matches it explains.

    Attributes
    ----------
    T : (4, 4) motion, world metres.
    inliers : (K,) int64, indices of the matches within eps of it.
    rms : root mean square residual of the inliers, metres.
    """

    T: Array
    inliers: NDArray[np.int64]
    rms: float


def jlinkage(
    rng: np.random.Generator,
    p: Array,
    q: Array,
    *,
    eps: float = 0.010,
    n_models: int = 500,
    min_size: int = 5,
    max_matches: int = 300,
) -> list[Motion]:
    """Find the rigid motions among matches (p_i, q_i).

    Parameters
    ----------
    rng : draws the minimal sets.
    p, q : (N, 3) world metres before and after.
    eps : metres; at least 5 standard deviations of a match, or true clusters are split.
    n_models : sampled triples. A motion that holds a share w of the matches is hit n_models w^3 times.
    min_size : smallest cluster that counts (three matches always fit).
    max_matches : beyond this an evenly spread subset is clustered (cost grows with N^2); inliers are
        counted over all.

    Returns
    -------
    list of Motion, most inliers first (ties: smaller rms). Near-equal motions are merged.
    """
    p = np.ascontiguousarray(p, dtype=np.float64)
    q = np.ascontiguousarray(q, dtype=np.float64)
    if len(p) < max(3, min_size):
        return []
    chosen = np.arange(len(p))
    if len(p) > max_matches:
        chosen = np.sort(rng.permutation(len(p))[:max_matches])
    models = rigid.minimal_models(rng, p[chosen], q[chosen], eps, n_models)
    if not len(models):
        return []
    preference = rigid.residuals(models, p[chosen], q[chosen]) < eps
    motions: list[Motion] = []
    for members in cluster(preference):
        if len(members) >= min_size:
            rows = chosen[members]
            motion = _refit(p, q, rigid.kabsch(p[rows], q[rows]), eps)
            if motion is not None and len(motion.inliers) >= min_size:
                motions.append(motion)
    motions.sort(key=lambda m: (-len(m.inliers), m.rms))
    return _without_repeats(motions)


def cluster(preference: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Agglomerate rows of a preference matrix (N, M) until all sets are disjoint.

    Returns
    -------
    list of index arrays, largest first; rows with an empty set belong to none.
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
        # Only rows whose best partner was a or b, and those that now like a better, need a new look.
        stale = np.flatnonzero((best_at == a) | (best_at == b))
        better = row > best
        best[better], best_at[better] = row[better], a
        for i in {*stale.tolist(), a, b}:
            best_at[i] = similarity[i].argmax()
            best[i] = similarity[i, best_at[i]]
    found = [np.array(sorted(m), dtype=np.int64) for m in members if m]
    return sorted(found, key=lambda m: (-len(m), int(m[0])))


def _refit(p: Array, q: Array, T: Array, eps: float) -> Motion | None:
    """Least squares on the inliers over all matches, twice."""
    inliers = np.flatnonzero(rigid.residuals(T[None], p, q)[:, 0] < eps)
    for _ in range(2):
        if len(inliers) < 3:
            return None
        T = rigid.kabsch(p[inliers], q[inliers])
        distance = rigid.residuals(T[None], p, q)[:, 0]
        inliers = np.flatnonzero(distance < eps)
    if len(inliers) < 3:
        return None
    return Motion(T, inliers, float(np.sqrt((distance[inliers] ** 2).mean())))


def _without_repeats(motions: list[Motion]) -> list[Motion]:
    """Drop a motion more than half of whose inliers a better supported one already explains."""
    kept: list[Motion] = []
    for motion in motions:
        shares = [np.isin(motion.inliers, other.inliers).mean() for other in kept]
        if not shares or max(shares) <= 0.5:
            kept.append(motion)
    return kept

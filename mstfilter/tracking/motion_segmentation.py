"""Motion segmentation: the pixels of a clip's last frame, grouped by rigid motion.

>>> MotionSegmentation().labels(clip)        # (H, W) int32: 0 at rest, 1, 2, ... moving groups, -1 unknown

Points that the optical flow followed through the clip are binned into small cells of the last image. Neighbouring
cells are joined while one rigid motion explains both, the pair with the smallest misfit first (Ward's rule; with
`rigid.pair_sums` each trial is one 3 x 3 SVD). This separates touching objects of equal look when one has moved
relative to the other.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from heapq import heappop, heappush

import numpy as np
from scipy.spatial.distance import cdist

from mstfilter.scene import Clip, component_key, memo, read_only
from mstfilter.tracking.flow import DenseFlow
from mstfilter.tracking.rigid import fit_sums, move_points, pair_sums

_CELL = 10  # pixels, edge of a cell
_MOVED = 0.008  # metres; a cell whose points moved less on average is at rest
_MIN_POINTS = 40  # smallest number of points of a motion
_MAX_NOISE = 0.006  # metres; cells with a larger root mean square residual under one rigid motion are not used
_RIVAL_REACH = 0.15  # metres; largest distance of cells whose motions are compared


@dataclass(frozen=True, eq=False)
class FollowedPoints:
    """Points that were followed through a clip and have depth in the first and last frame."""

    p: np.ndarray  #: (n, 3) world metres, before and after
    q: np.ndarray
    column: np.ndarray  #: (n,) pixel of each point in the last frame
    row: np.ndarray


def followed_points(clip: Clip, flow: DenseFlow) -> FollowedPoints:
    """Points of the flow of a clip that are in the workspace in the last frame. Cached by content."""

    def compute() -> FollowedPoints:
        tracks = flow.track(clip)
        start, end = tracks.start[tracks.alive], np.rint(tracks.end[tracks.alive]).astype(np.int64)
        height, width = clip.after.depth.shape
        inside = ((end >= 0) & (end < [width, height])).all(axis=1)
        start, end = start[inside], end[inside]
        p = clip.before.points[start[:, 1], start[:, 0]]
        q = clip.after.points[end[:, 1], end[:, 0]]
        known = np.isfinite(p).all(axis=1) & np.isfinite(q).all(axis=1)
        known &= clip.after.valid[end[:, 1], end[:, 0]] & clip.before.valid[start[:, 1], start[:, 0]]
        known &= clip.grid.contains(clip.grid.index_of(q))
        return FollowedPoints(p[known], q[known], end[known, 0], end[known, 1])

    return memo("followed points", (clip.key, component_key(flow)), compute)


@dataclass(frozen=True)
class MotionSegmentation:
    """Joins cells of the image that follow one rigid motion.

    Parameters
    ----------
    misfit : float
        Largest misfit of two joined neighbours, metres: root mean square residual of the points of the smaller one
        under the common motion, in addition to the residual under its own motion.
    rival : float
        A point is ambiguous if another motion predicts its position in the last frame within `rival` (metres) as
        well, for instance near the axis of a rotation. The motions compared are rest and those of nearby cells;
        motions farther away coincide by chance.
    reach : float
        Largest distance in space (metres) of neighbouring cells.
    flow : DenseFlow
        Follows the points. The flow is shared with a transition that uses the same settings.
    """

    misfit: float = 0.015
    rival: float = 0.006
    reach: float = 0.04
    flow: DenseFlow = field(default_factory=DenseFlow)

    def labels(self, clip: Clip) -> np.ndarray | None:
        """Number of the motion of each pixel of the last frame, (H, W); None for a single frame. Cached."""
        if len(clip.frames) < 2:
            return None
        return memo("rigid motions", (clip.key, component_key(self)), lambda: read_only(self._labels(clip)))

    def _labels(self, clip: Clip) -> np.ndarray:
        points = followed_points(clip, self.flow)
        height, width = clip.after.depth.shape
        out = np.full((height, width), -1, np.int32)
        if not len(points.p):
            return out
        moved = np.linalg.norm(points.q - points.p, axis=1) >= _MOVED
        # Cells hold either points at rest (even number) or moved points (odd number).
        across, down = (-(-n // _CELL) for n in (width, height))
        place = (points.row // _CELL) * across + points.column // _CELL
        cells, cell = np.unique(2 * place + moved, return_inverse=True)
        origin = points.q.mean(axis=0)
        sums = pair_sums(points.p - origin, points.q - origin, cell, len(cells))
        _, error = fit_sums(sums)
        clean = error <= sums[:, 0] * _MAX_NOISE**2
        pairs = _neighbours(cells, across, down, sums, self.reach)
        near = np.zeros(len(cells), bool)  # cells at rest are used only next to moved cells
        touched = (cells[pairs] % 2 == 1).any(axis=1)
        near[pairs[touched].ravel()] = True
        used = clean & (near | (cells % 2 == 1))
        group = _join(sums, pairs[used[pairs].all(axis=1)], self.misfit)
        group[~used] = -1
        group[(cells % 2 == 0) & ~near] = -2  # at rest
        motions, group = _motions(sums, group)
        centre = sums[:, 4:7] / sums[:, :1]
        rivals = [cdist(centre, centre[group == k]).min(axis=1, initial=np.inf) for k in range(len(motions))]
        close = np.array(rivals) < _RIVAL_REACH
        close[0] = True
        number = _best(points, cell, pairs, group, motions, origin, 3 * self.misfit, self.rival, close)
        out[points.row, points.column] = number
        return out


def _motions(sums: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Motions (k, 4, 4), the identity first, and the number of each cell's motion; -1 for too few points."""
    motions, number = [np.eye(4)], np.full(len(group), -1)
    number[group == -2] = 0
    for g in np.unique(group[group >= 0]):
        members = group == g
        total = sums[members].sum(axis=0)
        T, _ = fit_sums(total)
        trace = total[7] + total[11] + total[15]
        if total[16] + total[17] - 2 * trace < total[0] * _MOVED**2:
            number[members] = 0
        elif total[0] >= _MIN_POINTS:
            number[members] = len(motions)
            motions.append(T)
    return np.array(motions), number


def _neighbours(cells: np.ndarray, across: int, down: int, sums: np.ndarray, reach: float) -> np.ndarray:
    """Pairs of cells (m, 2) that are adjacent in the image and close in space."""
    place, centre = cells // 2, sums[:, 4:7] / sums[:, :1]
    index = np.full((2, (down + 2) * (across + 2)), -1)
    padded = (place // across + 1) * (across + 2) + place % across + 1
    index[cells % 2, padded] = np.arange(len(cells))
    pairs_of_step = []
    for step in (0, 1, across + 1, across + 2, across + 3):
        for kind in (0, 1):
            other = index[kind, padded + step]
            here = np.flatnonzero(other >= 0)
            if step == 0:
                here = here[other[here] > here]
            pairs_of_step.append(np.stack([here, other[here]], axis=1))
    pairs = np.concatenate(pairs_of_step)
    close = np.linalg.norm(centre[pairs[:, 0]] - centre[pairs[:, 1]], axis=1) < reach
    return np.asarray(pairs[close], dtype=np.int64)


def _misfit(a: np.ndarray, b: np.ndarray, error_a: np.ndarray, error_b: np.ndarray) -> np.ndarray:
    """Misfit of two groups in metres: sqrt(increase of the squared error x (n_a + n_b) / (n_a n_b))."""
    _, error = fit_sums(a + b)
    na, nb = a[..., 0], b[..., 0]
    return np.sqrt(np.maximum(error - error_a - error_b, 0.0) * (na + nb) / (na * nb))


def _join(sums: np.ndarray, pairs: np.ndarray, limit: float) -> np.ndarray:
    """Group number of each cell after joining neighbours in order of misfit."""
    n = len(sums)
    group = np.arange(n)
    sums = sums.copy()
    _, error = fit_sums(sums)
    adjacent: list[set[int]] = [set() for _ in range(n)]
    for a, b in pairs.tolist():
        adjacent[a].add(b)
        adjacent[b].add(a)
    stamp = np.zeros(n, np.int64)
    heap: list[tuple[float, int, int, int, int]] = []

    def offer(a: int, others: list[int]) -> None:
        if not others:
            return
        d = _misfit(sums[a], sums[others], error[a], error[others])
        for b, value in zip(others, d.tolist(), strict=True):
            if value <= limit:
                heappush(heap, (value, a, b, int(stamp[a]), int(stamp[b])))

    for a in range(n):
        offer(a, sorted(b for b in adjacent[a] if b > a))
    members: list[list[int]] = [[k] for k in range(n)]
    while heap:
        _, a, b, sa, sb = heappop(heap)
        if stamp[a] != sa or stamp[b] != sb:
            continue
        if len(members[a]) < len(members[b]):
            a, b = b, a
        members[a] += members[b]
        group[members[b]] = a
        members[b] = []
        sums[a] += sums[b]
        error[a] = fit_sums(sums[a])[1]
        stamp[a] += 1
        stamp[b] = -1
        for c in adjacent[b] - {a}:
            adjacent[c].discard(b)
            adjacent[c].add(a)
            adjacent[a].add(c)
        adjacent[a].discard(b)
        adjacent[b] = set()
        offer(a, sorted(adjacent[a]))
    return np.asarray(group, dtype=np.int64)


def _best(
    points: FollowedPoints,
    cell: np.ndarray,
    pairs: np.ndarray,
    number: np.ndarray,
    motions: np.ndarray,
    origin: np.ndarray,
    limit: float,
    rival: float,
    rivals: np.ndarray,
) -> np.ndarray:
    """Motion (n,) of each point with the smallest residual, among those of its cell and of adjacent cells.

    -1 if the residual exceeds `limit`, or if the residual of another of the `rivals` (motions, cells) is larger by
    less than `rival`.
    """
    p, q = points.p - origin, points.q - origin
    n, every = len(number), np.arange(len(p))
    near = np.zeros((n, len(motions)), bool)
    a, b = pairs.T
    for here, there in ((np.arange(n), number), (a, number[b]), (b, number[a])):
        near[here[there >= 0], there[there >= 0]] = True
    distance = np.stack([np.linalg.norm(move_points(T, p) - q, axis=1) for T in motions], axis=1)
    best = np.where(near[cell], distance, np.inf).argmin(axis=1)
    least = np.where(near[cell, best], distance[every, best], np.inf)
    distance[every, best] = np.inf
    distance[~rivals.T[cell]] = np.inf
    ambiguous = distance.min(axis=1) < least + rival
    return np.where((least < limit) & ~ambiguous, best, -1).astype(np.int32)

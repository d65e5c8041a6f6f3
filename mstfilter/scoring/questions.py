"""Questions about a recording, and the answers of a weighted set of hypotheses.

A question asks whether two voxels belong to the same object. The recording alone determines the questions of a pause.
The questions depend neither on the ground truth nor on a hypothesis. So all methods answer the same questions, and no
answer has a better expected score than the true probabilities.

>>> questions = ask(recording, t=2)                            # 20,000 pairs of voxels
>>> p = questions.forecasts(labels, weights)                   # sum_i w_i [same object in hypothesis i]
>>> y = questions.outcomes(recording.truth(2))                 # bool
>>> float(np.mean((p - y) ** 2))                               # Brier score

**Questions.** A voxel is *in question* at pause t if three conditions hold. The voxel is above the table. The depth
images of pause t do not observe the voxel as free. The voxel contains a depth reading above the table at pause t or
earlier, or is up to 10 cm behind one along the camera's z axis. The first voxel u of a question is uniform among the
voxels in question that have another one within 8 voxels. The second voxel v is uniform among these others of u.

**Noise.** Labels do not state the uncertainty of a border. So `Questions.forecasts` also returns forecasts for labels
with noise. With probability e, each voxel independently takes the label of one of its six neighbours. Only
voxels at a border change. The expectation over the noise is computed exactly:

    ``p = sum_i w_i E[sum_{k > 0} min(o_i,u'(k), o_i,v'(k))]``

The voxel u' is u with probability 1 - e, and otherwise one of the six neighbours of u (u replaces neighbours beyond
the grid). The voxel v' is defined in the same way. The number o_i,v(k) is the probability that object k fills voxel v
according to hypothesis i. The probability comes from the occupancy, or is 1 for the label of a hypothesis without
probabilities. The minimum in the formula is the probability that the object contains both voxels, if the object is a
level set {v | o(v) >= U} with one uniform U.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mstfilter.base.errors import InputError, check_integer
from mstfilter.scene import Frame, Hypothesis, Recording, VoxelGrid, depth_sigma, frame_geometry

N_QUESTIONS = 20_000
REACH = 8  # voxels between the two voxels of a question, at most
DEPTH_BEHIND = 0.10  # metres behind a reading
NOISE_RATES = (0.0, 0.1, 0.2, 0.4)  # e of noise at the border

_STEPS = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])


@dataclass(frozen=True, eq=False)
class Questions:
    """Pairs of voxels of a grid.

    Parameters
    ----------
    shape : (3,) int
        Shape of the grid.
    first, second : (m,) int64
        Flat indices of the two voxels of each pair.
    """

    shape: tuple[int, ...]
    first: np.ndarray
    second: np.ndarray

    def __len__(self) -> int:
        return len(self.first)

    def outcomes(self, labels: np.ndarray) -> np.ndarray:
        """(m,) bool: whether the two voxels have the same label above 0 in `labels` (X, Y, Z)."""
        flat = self._flat(labels)
        a = flat[self.first]
        return np.asarray((a == flat[self.second]) & (a > 0))

    def forecasts(
        self, hypotheses: Sequence[np.ndarray | Hypothesis], weights: np.ndarray, rates: Sequence[float] = (0.0,)
    ) -> np.ndarray:
        """Forecasts (r, m) of hypotheses with noise of each rate (r,) at the border; (m,) for the default `rates`.

        Parameters
        ----------
        hypotheses : n hypotheses, or label grids (X, Y, Z) of int
        weights : (n,) float
            Sum 1.
        rates : sequence of float
            Probabilities e in [0, 1] of noise, as the module describes.
        """
        e = np.asarray(rates, dtype=np.float64)[:, None]
        found = np.zeros((len(e), len(self)))
        noisy = bool(e.any())
        if noisy:
            _, place, around = self._voxels
            u, v = around[:, place[: len(self)]], around[:, place[len(self) :]]
        for one, weight in zip(hypotheses, weights, strict=True):
            label, q = self._shares(one)
            a, b = label[self.first], label[self.second]
            both = np.ones(len(self)) if q is None else np.minimum(q[self.first], q[self.second])
            same = ((a == b) & (a > 0)) * both
            found += weight * same
            if not noisy:
                continue
            # Where all probabilities are 1, the noise changes nothing away from borders.
            near = ((label[u] != a) | (label[v] != b)).any(axis=0) if q is None else np.ones(len(self), bool)
            border = np.flatnonzero(near)
            if len(border):
                p = _noisy(label, q, self.first[border], self.second[border], u[:, border], v[:, border], e)
                found[:, border] += weight * (p - same[border])
        found = np.clip(found, 0.0, 1.0)  # sums of weights exceed 1 by rounding
        return found[0] if len(e) == 1 and not noisy else found

    def _shares(self, one: np.ndarray | Hypothesis) -> tuple[np.ndarray, np.ndarray | None]:
        """The object of each voxel, flat, and the object's probability; None if all probabilities are 1."""
        if not isinstance(one, Hypothesis):
            return self._flat(one), None
        if one.occupancy is None:
            return self._flat(one.labels), None
        return self._flat(one.occupancy.owner), self._flat(one.occupancy.probability).astype(np.float64)

    def _flat(self, labels: np.ndarray) -> np.ndarray:
        labels = np.asarray(labels)
        if labels.shape != tuple(self.shape):
            raise InputError(f"labels have shape {labels.shape}, the questions are about a grid {self.shape}")
        return labels.ravel()

    @cached_property
    def _voxels(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The k distinct voxels (k,) of the m pairs, an index (2 m,), and the neighbours (6, k) of the k voxels.

        The index has the positions of all first voxels, then of all second voxels, among the k voxels.
        """
        voxels, place = np.unique(np.concatenate([self.first, self.second]), return_inverse=True)
        return voxels, place, _neighbours(voxels, self.shape)


def _noisy(
    label: np.ndarray,
    q: np.ndarray | None,
    first: np.ndarray,
    second: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    e: np.ndarray,
) -> np.ndarray:
    """Forecasts (r, m) for noise of rates e (r, 1). u and v (6, m) are the neighbours of the two voxels."""
    q = np.ones(len(label)) if q is None else q
    a, b, near_a, near_b = label[first], label[second], label[u], label[v]
    q_a, q_b, q_near_a, q_near_b = q[first], q[second], q[u], q[v]
    same = ((a == b) & (a > 0)) * np.minimum(q_a, q_b)
    mixed = (((near_b == a) & (a > 0)) * np.minimum(q_a, q_near_b)).sum(axis=0)
    mixed = mixed + (((near_a == b) & (b > 0)) * np.minimum(q_near_a, q_b)).sum(axis=0)
    both = np.zeros(len(a))
    for row, q_row in zip(near_a, q_near_a, strict=True):
        both += (((near_b == row) & (row > 0)) * np.minimum(q_row, q_near_b)).sum(axis=0)
    return np.asarray((1 - e) ** 2 * same + (1 - e) * e / 6 * mixed + e**2 / 36 * both)


def _neighbours(flat: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    index = np.stack(np.unravel_index(flat, shape), axis=-1)
    moved = np.clip(index + _STEPS[:, None], 0, np.array(shape) - 1)
    return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(moved, -1, 0)), shape))


def ask(recording: Recording, t: int, n: int = N_QUESTIONS) -> Questions:
    """The questions of a pause.

    Parameters
    ----------
    recording : Recording
    t : int
        Number of the pause.
    n : int
        Number of questions. The seed for drawing the questions depends only on the depth images of the pause.

    Returns
    -------
    Questions
        Empty if no two voxels in question are near each other.
    """
    check_integer("number of questions", n)
    if not 0 <= t < len(recording.pauses):
        raise InputError(f"recording {recording.name} has no pause {t}, it has {len(recording.pauses)}")
    now = recording.frames[recording.pauses[t]]
    digest = hashlib.sha256(b"questions" + b"".join(view.depth.tobytes() for view in now.all_views)).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
    return draw_questions(in_question(recording, t), n, rng)


def in_question(recording: Recording, t: int) -> np.ndarray:
    """(X, Y, Z) bool: whether a voxel is in question at pause t."""
    grid, now = recording.grid, recording.frames[recording.pauses[t]]
    near = np.zeros(grid.shape, bool)
    for pause in recording.pauses[: t + 1]:
        near |= _behind_readings(recording.frames[pause], grid)
    above = grid.origin[2] + (np.arange(grid.shape[2]) + 0.5) * grid.voxel_size > 0
    return near & above & ~_seen_free(now, grid)


def _margin(depth: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Half a voxel, plus three standard deviations of a reading at this depth, in metres."""
    return 0.5 * grid.voxel_size + 3.0 * depth_sigma(depth)


def _seen_free(frame: Frame, grid: VoxelGrid) -> np.ndarray:
    """(X, Y, Z) bool: whether a view measures a surface behind the voxel."""
    free = np.zeros(grid.shape, bool)
    for view in frame.all_views:
        geometry = frame_geometry(view, grid)
        free |= geometry.known_free(_margin(geometry.z - geometry.signed, grid))
    return free


def _behind_readings(frame: Frame, grid: VoxelGrid) -> np.ndarray:
    """(X, Y, Z) bool: whether a voxel is at, or at most `DEPTH_BEHIND` behind, a depth reading above the table."""
    found = np.zeros(grid.shape, bool)
    for view in frame.all_views:
        geometry = frame_geometry(view, grid)
        with np.errstate(invalid="ignore"):
            raised = view.valid & (view.points[..., 2] > _margin(view.depth, grid))
            near = geometry.signed >= -_margin(geometry.z - geometry.signed, grid)
            near &= geometry.signed <= DEPTH_BEHIND
        found |= near & (geometry.pixel >= 0) & raised.ravel()[geometry.pixel]
    return found


def draw_questions(where: np.ndarray, n: int, rng: np.random.Generator) -> Questions:
    """Draw n pairs of near voxels of `where` (X, Y, Z) bool; none if no two voxels are near each other."""
    where = np.array(where, dtype=bool)
    voxels = np.argwhere(where)
    axis = np.arange(-REACH, REACH + 1)
    offsets = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    squared = (offsets**2).sum(axis=1)
    offsets = offsets[(squared > 0) & (squared <= REACH**2)] + REACH
    padded = np.pad(where, REACH)

    def partners(u: np.ndarray) -> np.ndarray:
        """Uniformly drawn partners (m, 3) of voxels u (m, 3); -1 for a voxel without a partner."""
        v, left = np.full(u.shape, -1), np.arange(len(u))
        for _ in range(32):  # rejection first: most voxels have many partners
            proposed = u[left] + offsets[rng.integers(len(offsets), size=len(left))]
            accepted = padded[tuple(proposed.T)]
            v[left[accepted]] = proposed[accepted] - REACH
            left = left[~accepted]
        for k in left:
            options = u[k] + offsets
            options = options[padded[tuple(options.T)]]
            if len(options):
                v[k] = options[rng.integers(len(options))] - REACH
        return v

    first = second = np.zeros((0, 3), np.int64)
    while len(first) < n and len(voxels) > 1:
        u = voxels[rng.integers(len(voxels), size=n - len(first))]
        v = partners(u)
        alone = v[:, 0] < 0
        first, second = np.concatenate([first, u[~alone]]), np.concatenate([second, v[~alone]])
        where[tuple(u[alone].T)] = False  # u is uniform among the voxels that have a partner
        voxels = voxels[where[tuple(voxels.T)]]
    flat = [np.asarray(np.ravel_multi_index(tuple(pair.T), where.shape)) for pair in (first, second)]
    return Questions(where.shape, *flat)

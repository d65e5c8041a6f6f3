"""Do the objects of a hypothesis move as rigid bodies do?

>>> MotionAgreement().log_score(hypotheses, clip)

Data used: the optical flow of the clip, and the depth of its first and last frame. Points that were followed
through the clip are given to the object that the hypothesis shows where they end. One rigid motion is fitted to
all points of an object; what is left over speaks against it: two things in one object leave a lot. Objects that
rest say nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mstfilter.scene import Clip, Evidence, Hypothesis, project
from mstfilter.tracking.flow import DenseFlow
from mstfilter.tracking.rigid import Array, apply, kabsch
from mstfilter.tracking.rigid_motions import followed_points

__all__ = ["MotionAgreement"]


@dataclass(frozen=True)
class MotionAgreement(Evidence):
    """Residual of the flow under one rigid motion an object.

    Parameters
    ----------
    strength : float
        Nats for a mean cost of 1 over all points that moved.
    scale : float
        Residual in metres that costs 1.
    cap : float
        Largest cost of a point; also that of a moved point that belongs to no object, halved.
    moved : float
        Points that went at least this far (metres) have moved.
    min_moved : int
        An object with fewer moved points rests.
    flow : DenseFlow
        Follows the points; the same as the transition's is computed once.
    """

    strength: float = 30.0
    scale: float = 0.006
    cap: float = 9.0
    moved: float = 0.01
    min_moved: int = 10
    flow: DenseFlow = DenseFlow()  # noqa: RUF009 (frozen)

    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        """Minus `strength` times the mean cost of the points of objects that moved; 0 where nothing moved."""
        if len(clip.frames) < 2:
            return np.zeros(len(hypotheses))
        points = followed_points(clip, self.flow)
        pixel = points.row * clip.after.depth.shape[1] + points.column
        return np.array([self._score(project(h, clip.after.camera), points.p, points.q, pixel) for h in hypotheses])

    def _score(self, labels: np.ndarray, p: Array, q: Array, pixel: NDArray[np.int64]) -> float:
        label = labels.ravel()[pixel].astype(np.int64)
        went = np.linalg.norm(q - p, axis=1) >= self.moved
        n_moved = np.bincount(label[went], minlength=int(label.max(initial=0)) + 1)
        total, count = 0.5 * self.cap * float(n_moved[0]), float(n_moved[0])
        for k in np.flatnonzero(n_moved >= self.min_moved):
            if k == 0:
                continue
            own = label == k
            total += float(self._costs(p[own], q[own]).sum())
            count += float(own.sum())
        return -self.strength * total / count if count else 0.0

    def _costs(self, p: Array, q: Array) -> Array:
        """Capped squared residuals of a robust rigid fit (Geman-McClure weights, six rounds)."""
        step = max(1, len(p) // 400)
        T, few_p, few_q = kabsch(p, q), p[::step], q[::step]
        for _ in range(6):
            error = np.linalg.norm(apply(T, few_p) - few_q, axis=1)
            T = kabsch(few_p, few_q, (1.0 + (error / self.scale) ** 2) ** -2)
        error = np.linalg.norm(apply(T, p) - q, axis=1)
        return np.minimum((error / self.scale) ** 2, self.cap)

"""The default motion rule: several candidate motions, judged by one residual.

No single estimator wins everywhere: flow fails on plain surfaces, registration does not see the spin of
a textured can, features need texture. So each proposes, the robust residual of depth and colour
(residual.py) decides, and rest is preferred unless a motion is clearly better.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mstfilter.errors import InputError
from mstfilter.tracking import rigid
from mstfilter.tracking.features import SiftMatching
from mstfilter.tracking.refinement import refine
from mstfilter.tracking.registration import centroid_shift, register
from mstfilter.tracking.residual import Residual
from mstfilter.tracking.rules import IDENTITY, Candidate, MotionRule, sift_motions
from mstfilter.tracking.track import Track

__all__ = ["MstRule"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MstRule(MotionRule):
    """Candidates from flow, registration and features; scored, gated, rest first.

    Parameters
    ----------
    select : "map" or "sample"
        Take the candidate of best score, or draw with probability ~ exp(-n_eff S / 2) for each particle.
    static_margin : float
        A motion must beat rest by this much in S.
    n_eff : float
        Independent observations that a segment's points are worth when drawing; residuals of neighbouring
        pixels are correlated, so far below their number.
    use_flow, use_icp, use_sift : bool
        Which estimators propose.
    max_shift : float
        Metres; a candidate that carries the segment's centre farther is dropped.
    max_angle : float
        Radians; a candidate that turns more is dropped.
    least_overlap : float
        Share of the moved surface that must meet the tracked surface, for candidates from registration.
    min_pairs : int
        Fewest flow tracks or SIFT matches behind a motion.
    max_sift : int
        At most so many SIFT motions are considered.
    n_refine : int
        So many of the best candidates are polished against the whole last frame (refine.py) and compete again.
    search_above : float
        Where every candidate scores worse, the object is looked for around its old place; negative: never.
    search_radius, search_step : float
        Metres; how far and how finely.
    sift : SiftMatching
    residual : Residual
    """

    select: str = "map"
    static_margin: float = 0.15
    n_eff: float = 20.0
    use_flow: bool = True
    use_icp: bool = True
    use_sift: bool = True
    max_shift: float = 0.6
    max_angle: float = 2.6
    least_overlap: float = 0.3
    min_pairs: int = 6
    max_sift: int = 3
    n_refine: int = 3
    search_above: float = 4.0
    search_radius: float = 0.14
    search_step: float = 0.01
    sift: SiftMatching = field(default_factory=SiftMatching)
    residual: Residual = field(default_factory=Residual)

    def __post_init__(self) -> None:
        if self.select not in ("map", "sample"):
            raise InputError(f"select {self.select!r} is unknown", "one of map, sample")

    def candidates(self, rng: np.random.Generator, track: Track) -> tuple[Candidate, ...]:
        """Scored motions; the identity comes first."""
        residual = self.residual
        identity = Candidate("identity", np.eye(4), score=residual.score(track, np.eye(4)) - self.static_margin)
        if not len(track.segment.support):
            return (identity,)
        found = [identity]
        centre = track.points.mean(axis=0)
        for kind, T, support in self._proposals(rng, track):
            if self._admissible(T, centre) and not any(_same(T, other.T, centre) for other in found[1:]):
                found.append(Candidate(kind, T, support, 0.0, residual.score(track, T)))
        if self.n_refine:
            ranked = sorted(found[1:], key=lambda c: c.score)[: self.n_refine]
            for c in ranked:
                T = refine(track, c.T, residual.depth_scale, residual.colour_scale)
                if self._admissible(T, centre):
                    found.append(Candidate(c.kind, T, c.support, 0.0, residual.score(track, T)))
        if self.search_above >= 0 and min(c.score for c in found) > self.search_above:
            found.extend(self._search(track, centre))
        return tuple(c for c in found if c is identity or np.isfinite(c.score))

    def _search(self, track: Track, centre: Array) -> list[Candidate]:
        """Where else on the table could it be? Shifts and turns on a lattice, the best ones polished."""
        n = round(self.search_radius / self.search_step)
        shifts = self.search_step * np.stack(np.meshgrid(*[np.arange(-n, n + 1)] * 2), axis=-1).reshape(-1, 2)
        shifts = shifts[np.hypot(*shifts.T) <= self.search_radius]
        found = []
        for yaw in (-0.35, 0.0, 0.35):
            motions = np.tile(np.eye(4), (len(shifts), 1, 1))
            c, s = np.cos(yaw), np.sin(yaw)
            motions[:, :2, :2] = [[c, -s], [s, c]]
            motions[:, :3, 3] = centre - motions[0, :3, :3] @ centre
            motions[:, :2, 3] += shifts
            scores = self.residual.scores(track, motions, 150)
            for k in np.argsort(scores, kind="stable")[:2]:
                T = refine(track, motions[k], self.residual.depth_scale, self.residual.colour_scale)
                if np.isfinite(scores[k]) and self._admissible(T, centre):
                    found.append(Candidate("search", T, 0, 0.0, self.residual.score(track, T)))
        return found

    def _admissible(self, T: Array, centre: Array) -> bool:
        """Finite, and no farther or more turned than an object can be in a clip."""
        if not np.isfinite(T).all():
            return False
        return bool(rigid.displacement(T, centre) <= self.max_shift and rigid.angle(T) <= self.max_angle)

    def choose(self, rng: np.random.Generator, candidates: tuple[Candidate, ...]) -> Candidate:
        """The best, or one drawn by score."""
        scores = np.array([c.score for c in candidates])
        if not np.isfinite(scores).any():
            return IDENTITY
        if self.select == "map":
            return candidates[int(scores.argmin())]
        weights = np.exp(-0.5 * self.n_eff * (scores - scores.min()))
        return candidates[int(rng.choice(len(candidates), p=weights / weights.sum()))]

    def _proposals(self, rng: np.random.Generator, track: Track) -> list[tuple[str, Array, int]]:
        """Motions (kind, T, support) from every estimator, each also refined by registration."""
        proposals: list[tuple[str, Array, int]] = []
        starts: list[tuple[str, Array, int, float]] = []  # kind, motion, support, reach of the refinement
        if self.use_flow:
            p, q = track.flow_pairs
            fit = rigid.ransac(rng, p, q, 0.008) if len(p) >= self.min_pairs else None
            if fit is not None and fit[1].sum() >= self.min_pairs:
                T = rigid.refine_robust(fit[0], p, q, 0.004)
                proposals.append(("flow", T, int(fit[1].sum())))
                starts.append(("icp", T, int(fit[1].sum()), 0.020))
        if self.use_sift:
            for m in sift_motions(rng, track, self.sift, False, 0.010, self.min_pairs, 500)[: self.max_sift]:
                proposals.append(("sift", m.T, len(m.inliers)))
                starts.append(("sift", m.T, len(m.inliers), 0.015))
        source, target = track.surface, track.target_surface
        if self.use_icp and source is not None and target is not None:
            starts.append(("icp", centroid_shift(source.points, target.points), len(source.points), 0.030))
            for kind, start, support, reach in starts:
                refined = register(source, target, start, reach)
                if refined is not None and refined.overlap >= self.least_overlap:
                    proposals.append((kind, refined.T, support))
        return proposals


def _same(a: Array, b: Array, centre: Array) -> bool:
    """Closer than 0.2 mm and 0.1 degrees: not worth a second score."""
    change = rigid.invert(a) @ b
    return bool(rigid.displacement(change, centre) < 2e-4 and rigid.angle(change) < 2e-3)

"""Motion rules: the rigid motion of one object in a clip.

A rule has two stages, because hypotheses share most of their segments. `candidates` computes motions once for each
distinct segment; `choose` then selects one of them for each particle, possibly at random.

================  ===========================================================================
`PaperRule`       paper, Algorithm 2: SIFT if it has more than 5 inliers, else ICP if its error
                  is below 1 mm, else identity
`AuthorsRule`     authors' program: a SIFT cluster drawn by size and used with a probability
                  that grows with it, else ICP with mean squared distance <= 0.002 m^2
`MstRule`         candidates from flow, registration and SIFT, ranked by one robust residual
================  ===========================================================================

`MstRule` combines several estimators because each fails on some objects: flow on uniform surfaces, registration on
symmetric objects that rotate, and SIFT without texture.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from numbers import Integral, Real
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.base.errors import InputError
from mstfilter.base.results import Checked, check_rigid, check_type, describe_value, returns, warn_once
from mstfilter.mst.tracking import rigid
from mstfilter.mst.tracking.features import SiftMatching
from mstfilter.mst.tracking.registration import Registration, SmallGicp, centroid_shift
from mstfilter.mst.tracking.residual import OUTSIDE_COST, MotionResidual, refine_motion
from mstfilter.mst.tracking.rigid import MotionCluster, jlinkage, rigid_transform
from mstfilter.mst.tracking.segments import Track

# Limits of `MstRule`.
_MIN_OVERLAP = 0.3  # fraction of the moved surface that has a correspondence after registration
_MIN_PAIRS = 6  # flow tracks or SIFT matches of a motion
_MAX_SIFT = 3  # SIFT motions of a segment
_REST_BONUS = 0.15  # in S of `MotionResidual`; a motion must be better than rest by this much
_MAX_SHIFT, _MAX_ANGLE = 0.6, 2.6  # metres at the segment's centre, radians
_SEARCH_RADIUS, _SEARCH_STEP = 0.14, 0.01  # metres
_FEW_POINTS = 12  # in an image of any size; the best place for fewer points is often wrong, unless it fits well


@dataclass(frozen=True, eq=False)
class Candidate:
    """A possible motion of an object."""

    kind: str  #: "identity", "flow", "icp", "sift" or "search"
    T: RigidTransform  #: world metres
    support: int = 0  #: number of matches or points that determine it
    #: Criterion of the rule, lower is better: S of `MotionResidual`, or a root mean square residual in metres.
    score: float = 0.0


#: Kind, motion (4, 4) and support of a motion that is not scored yet.
_Estimate = tuple[str, np.ndarray, int]

#: Rest, the motion of objects that are not tracked.
IDENTITY = Candidate("identity", RigidTransform.identity())


def _check_candidates(
    self: MotionRule, found: Sequence[Candidate], rng: np.random.Generator, track: Track
) -> tuple[Candidate, ...]:
    hints = ("return (candidate,)",) if isinstance(found, Candidate) else _HOW_TO_MOVE
    check_type(found, (list, tuple), "a tuple of Candidate", *hints)
    if not found:
        raise InputError("returns no candidate, expected at least one", "rest is mstfilter.mst.tracking.IDENTITY")
    for candidate in found:
        _check_candidate(candidate)
    if fault := fault_of_motions(found, track):
        warn_once(self, "candidates", fault, "motions are in metres, in the frame of the world")
    return tuple(found)


def _check_choice(
    self: MotionRule, found: Candidate, rng: np.random.Generator, candidates: tuple[Candidate, ...]
) -> Candidate:
    if not any(found is one for one in candidates):
        _check_candidate(found)
    return found


_HOW_TO_MOVE = ("a motion T (4, 4) is Candidate('mine', RigidTransform.from_matrix(T))",)


def _check_candidate(one: Candidate) -> None:
    """Raise InputError unless a result is a candidate with a rigid motion, a support and a score."""
    check_type(one, Candidate, "a Candidate", *_HOW_TO_MOVE)
    if isinstance(one.T, RigidTransform) and not one.T.single:
        raise InputError(f"returns a candidate with {len(one.T)} motions, expected one", "make a candidate for each")
    for name, valid, expected in (
        ("T", isinstance(one.T, RigidTransform), "one RigidTransform"),
        ("kind", isinstance(one.kind, str), "a str"),
        ("support", isinstance(one.support, Integral) and one.support >= 0, "an int >= 0"),
        ("score", isinstance(one.score, Real) and not np.isnan(one.score), "a number"),
    ):
        if not valid:
            found = describe_value(getattr(one, name))
            raise InputError(f"returns a candidate whose {name} is {found}, expected {expected}", *_HOW_TO_MOVE)
    check_rigid(one.T.as_matrix(), f"a candidate {one.kind!r} with a motion")


def fault_of_motions(candidates: Sequence[Candidate], track: Track) -> str | None:
    """An error message if a candidate moves the object by more than the diagonal of the workspace, else None."""
    if not len(track.segment.support):
        return None
    grid, centre = track.clip.grid, track.points.mean(axis=0)
    diagonal = float(np.linalg.norm(np.multiply(grid.shape, grid.voxel_size)))
    farthest = max(rigid.displacement(one.T.as_matrix(), centre) for one in candidates)
    if farthest <= diagonal:
        return None
    return f"moves an object too far: by {farthest:.3g} m, the diagonal of the workspace is {diagonal:.3g} m"


class MotionRule(Checked, ABC):
    """Estimates the motion of an object."""

    @returns(_check_candidates)
    @abstractmethod
    def candidates(self, rng: np.random.Generator, track: Track) -> tuple[Candidate, ...]:
        """Possible motions of a segment, at least one; called once for all hypotheses that have it."""

    @returns(_check_choice)
    @abstractmethod
    def choose(self, rng: np.random.Generator, candidates: tuple[Candidate, ...]) -> Candidate:
        """The motion of the object in one particle. `rng` is the generator of this particle."""


def _sift_motions(
    rng: np.random.Generator, track: Track, sift: SiftMatching, in_target: bool, min_size: int, n_models: int
) -> list[MotionCluster]:
    """Rigid motions among the SIFT matches of a segment, most inliers first."""
    p, q = track.sift_pairs(sift, in_target)
    return jlinkage(rng, p, q, min_size=min_size, n_models=n_models)


def _registered(track: Track, from_centroid: bool, reach: float, registration: Registration) -> Candidate | None:
    """Registration of a segment to the surface of its tracked mask; None if a surface or the result is missing."""
    source, target = track.surface, track.target_surface
    if source is None or target is None:
        return None
    init = centroid_shift(source.points, target.points) if from_centroid else np.eye(4)
    fit = registration.register(source, target, init, reach)
    if fit is None:
        return None
    return Candidate("icp", rigid_transform(fit.T), len(track.points), fit.rms)


@dataclass(frozen=True)
class PaperRule(MotionRule):
    """Algorithm 2 of the paper.

    Parameters
    ----------
    min_inliers : int
        SIFT is accepted if it has more inliers than this number.
    max_error : float
        Largest root mean square distance in metres at which ICP is accepted. The published value of 1 mm is below the
        noise of a depth camera at 0.7 m, so ICP is almost never accepted.
    registration : Registration
        Performs the ICP, from a motion that aligns the centroids. (The paper names no initial motion.)
    """

    min_inliers: int = 5
    max_error: float = 0.001
    registration: Registration = field(default_factory=lambda: SmallGicp("ICP", 30))
    sift: SiftMatching = field(default_factory=SiftMatching)

    def candidates(self, rng: np.random.Generator, track: Track) -> tuple[Candidate, ...]:
        motions = _sift_motions(rng, track, self.sift, True, 3, 500)
        if motions and len(motions[0].inliers) > self.min_inliers:
            best = motions[0]
            return (Candidate("sift", rigid_transform(best.T), len(best.inliers), best.rms),)
        fit = _registered(track, True, 0.03, self.registration)
        return (fit if fit is not None and fit.score < self.max_error else IDENTITY,)

    def choose(self, rng: np.random.Generator, candidates: tuple[Candidate, ...]) -> Candidate:
        return candidates[0]


# `AuthorsRule` uses a drawn cluster of n matches with probability clip(slope n + offset, lowest, highest).
_SLOPE, _OFFSET, _LOWEST, _HIGHEST = 0.1, -0.25, 0.1, 0.9
_MAX_MEAN_SQUARE = 0.002  # square metres, of an accepted ICP: 4.5 cm rms

#: All pairs within the radii of the authors' program: descriptor distance 200, 1000 pixels, 1 m.
_ALL_PAIRS = SiftMatching(mutual=False, descriptor_radius=200.0, search_share=10.0, search_distance=1.0)


@dataclass(frozen=True)
class AuthorsRule(MotionRule):
    """The rule of the authors' program, a random choice between SIFT and ICP.

    A SIFT cluster of n matches is drawn, and used with probability clip(0.1 n - 0.25, 0.1, 0.9). Otherwise, ICP is
    used if its mean squared distance is at most 0.002 m^2 (4.5 cm rms).

    Parameters
    ----------
    registration : Registration
        Performs the ICP, starting from the identity.
    """

    registration: Registration = field(default_factory=lambda: SmallGicp("ICP", 20))
    sift: SiftMatching = _ALL_PAIRS

    def candidates(self, rng: np.random.Generator, track: Track) -> tuple[Candidate, ...]:
        clusters = _sift_motions(rng, track, self.sift, True, 3, 1000)
        candidates = [Candidate("sift", rigid_transform(m.T), len(m.inliers)) for m in clusters]
        fit = _registered(track, False, 10.0, self.registration)  # the authors' program has no limit of distance
        if fit is not None and fit.score**2 <= _MAX_MEAN_SQUARE:
            candidates.append(fit)
        return (*candidates, IDENTITY)

    def choose(self, rng: np.random.Generator, candidates: tuple[Candidate, ...]) -> Candidate:
        sift = [c for c in candidates if c.kind == "sift"]
        if sift:
            sizes = np.array([c.support for c in sift], dtype=np.float64)
            drawn = sift[rng.choice(len(sift), p=sizes / sizes.sum())]
            use = np.clip(_SLOPE * drawn.support + _OFFSET, _LOWEST, _HIGHEST)
            if rng.random() < use:
                return drawn
        return next(c for c in candidates if c.kind != "sift")


@dataclass(frozen=True)
class MstRule(MotionRule):
    """Candidates from flow, registration and SIFT, ranked by `MotionResidual`. Rest is preferred by a small margin.

    Parameters
    ----------
    select : "map" or "sample"
        Take the candidate with the best score ("map"), or draw one with probability proportional to exp(-n_eff S /
        2) for each particle ("sample").
    n_eff : float
        Effective number of independent observations per segment, for ``select="sample"``. It is much smaller than the
        number of pixels, because residuals of neighbouring pixels are correlated. The default has the largest
        likelihood on 124 objects of simulated tuning scenes.
    use_flow, use_icp, use_sift : bool
        Estimators to use.
    n_refine : int
        This number of the best candidates are refined against the whole last frame, and become further candidates.
    search_above : float
        If every score is larger than this, the object is searched for around its last position, upright and toppled.
        One with fewer than 12 points moves only to a place with a score up to this value, because the best place for
        so few is often wrong. A negative value disables the search.
    max_score : float
        A motion is refuted if its score reaches this value. The default is the score of a motion out of the image.
    registration : Registration
        Aligns the surfaces of the segment before and after.
    """

    select: Literal["map", "sample"] = "map"
    n_eff: float = 2.0
    use_flow: bool = True
    use_icp: bool = True
    use_sift: bool = True
    n_refine: int = 3
    search_above: float = 4.0
    max_score: float = OUTSIDE_COST
    sift: SiftMatching = field(default_factory=SiftMatching)
    residual: MotionResidual = field(default_factory=MotionResidual)
    registration: Registration = field(default_factory=SmallGicp)

    def candidates(self, rng: np.random.Generator, track: Track) -> tuple[Candidate, ...]:
        """Scored motions that the image does not refute, with the identity first."""
        rest = Candidate("identity", IDENTITY.T, score=self.residual.score(track, np.eye(4)) - _REST_BONUS)
        if not len(track.segment.support):
            return (rest,)
        centre = track.points.mean(axis=0)
        distinct: list[np.ndarray] = []
        moving: list[Candidate] = []
        for kind, T, support in self._estimates(rng, track):
            if _admissible(T, centre) and not any(_nearly_equal(T, other, centre) for other in distinct):
                distinct.append(T)
                moving.append(self._scored(track, kind, T, support))
        for best in sorted(moving, key=lambda c: c.score)[: self.n_refine]:
            T = refine_motion(track, best.T.as_matrix())
            if _admissible(T, centre):
                moving.append(self._scored(track, best.kind, T, best.support))
        if self.search_above >= 0 and min(c.score for c in [rest, *moving]) > self.search_above:
            worst = np.inf if len(track.points) >= _FEW_POINTS else self.search_above
            moving.extend(c for c in self._search(track, centre) if c.score <= worst)
        return (rest, *(c for c in moving if c.score < self.max_score))

    def choose(self, rng: np.random.Generator, candidates: tuple[Candidate, ...]) -> Candidate:
        scores = np.array([c.score for c in candidates])
        finite = np.flatnonzero(np.isfinite(scores))
        if not len(finite):
            return IDENTITY
        if self.select == "map":
            return candidates[int(scores.argmin())]
        weights = np.exp(-0.5 * self.n_eff * (scores[finite] - scores[finite].min()))
        return candidates[int(rng.choice(finite, p=weights / weights.sum()))]

    def _estimates(self, rng: np.random.Generator, track: Track) -> Iterator[_Estimate]:
        """Motions from every estimator, then the same motions refined by registration."""
        starts: list[tuple[str, np.ndarray, int, float]] = []  # kind, initial motion, support, reach in metres
        if self.use_flow:
            p, q = track.flow_pairs
            fit = rigid.ransac(rng, p, q, 0.008) if len(p) >= _MIN_PAIRS else None
            if fit is not None and len(fit.inliers) >= _MIN_PAIRS:
                T = rigid.refine_robust(fit.T, p, q, 0.004)
                yield "flow", T, len(fit.inliers)
                starts.append(("icp", T, len(fit.inliers), 0.020))
        if self.use_sift:
            for m in _sift_motions(rng, track, self.sift, False, _MIN_PAIRS, 500)[:_MAX_SIFT]:
                yield "sift", m.T, len(m.inliers)
                starts.append(("sift", m.T, len(m.inliers), 0.015))
        source, target = track.surface, track.target_surface
        if self.use_icp and source is not None and target is not None:
            shift = centroid_shift(source.points, target.points)
            starts.append(("icp", shift, len(source.points), 0.030))
            for kind, init, support, reach in starts:
                result = self.registration.register(source, target, init, reach)
                if result is not None and result.overlap >= _MIN_OVERLAP:
                    yield kind, result.T, support

    def _search(self, track: Track, centre: np.ndarray) -> list[Candidate]:
        """Search a grid of shifts on the table for several rotations. Refine the two best shifts of each rotation."""
        n = round(_SEARCH_RADIUS / _SEARCH_STEP)
        shifts = _SEARCH_STEP * np.stack(np.meshgrid(*[np.arange(-n, n + 1)] * 2), axis=-1).reshape(-1, 2)
        shifts = shifts[np.hypot(*shifts.T) <= _SEARCH_RADIUS]
        candidates = []
        for start in (*(_turn([0, 0, yaw], centre) for yaw in (-0.35, 0.0, 0.35)), *_topplings(track.points)):
            motions = np.tile(start, (len(shifts), 1, 1))
            motions[:, :2, 3] += shifts
            scores = self.residual.scores(track, motions, 150)
            for k in np.argsort(scores, kind="stable")[:2]:
                T = refine_motion(track, motions[k])
                if np.isfinite(scores[k]) and _admissible(T, centre):
                    candidates.append(self._scored(track, "search", T))
        return candidates

    def _scored(self, track: Track, kind: str, T: np.ndarray, support: int = 0) -> Candidate:
        return Candidate(kind, rigid_transform(T), support, self.residual.score(track, T))


def _turn(rotation: ArrayLike, point: np.ndarray) -> np.ndarray:
    """Rotation (4, 4) about a point (3,) by a rotation vector (3,) in radians."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    T[:3, 3] = point - T[:3, :3] @ point
    return T


def _topplings(points: np.ndarray) -> Iterator[np.ndarray]:
    """Rotations (4, 4) by 90 degrees that topple the box around points (N, 3) over each of its lower edges."""
    middle = points.mean(axis=0)
    corners = cv2.boxPoints(cv2.minAreaRect((points[:, :2] - middle[:2]).astype(np.float32))) + middle[:2]
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = np.append(b - a, 0.0) / max(float(np.linalg.norm(b - a)), 1e-9)
        side = np.sign(np.cross(along, [0.0, 0.0, 1.0])[:2] @ (a + b - corners[0] - corners[2]))
        yield _turn(np.pi / 2 * side * along, np.append(a, points[:, 2].min()))


def _admissible(T: np.ndarray, centre: np.ndarray) -> bool:
    """Whether a motion is finite and within the limits of displacement and angle."""
    if not np.isfinite(T).all():
        return False
    return bool(rigid.displacement(T, centre) <= _MAX_SHIFT and rigid.angle(T) <= _MAX_ANGLE)


def _nearly_equal(a: np.ndarray, b: np.ndarray, centre: np.ndarray) -> bool:
    """Whether two motions differ by less than 0.2 mm at the centre and 0.002 radians."""
    change = rigid.invert(a) @ b
    return bool(rigid.displacement(change, centre) < 2e-4 and rigid.angle(change) < 2e-3)

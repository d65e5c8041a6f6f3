"""Which rigid motion an object made: the published rules and our own.

A rule works in two stages. `candidates` gathers motions once per distinct segment, shared by all
hypotheses; `choose` picks one for each particle, which may draw.

================  ===========================================================================
`PaperRule`       paper, Algorithm 2: SIFT if it has more than 5 inliers, else ICP if its error
                  is below 1 mm, else identity; ``order="best"``: the better of the two (text)
`AuthorsRule`     authors' program: a SIFT cluster drawn by size and used with a probability
                  that grows with it, else ICP with mean squared distance <= 0.002 m^2
`MstRule`         many candidates, scored by one robust residual (mst_rule.py)
================  ===========================================================================
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mstfilter.errors import InputError
from mstfilter.tracking.features import SiftMatching
from mstfilter.tracking.jlinkage import Motion, jlinkage
from mstfilter.tracking.registration import Fit, centroid_shift, register
from mstfilter.tracking.track import Track

__all__ = ["AuthorsRule", "Candidate", "MotionRule", "PaperRule"]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A motion that an object may have made.

    Attributes
    ----------
    kind : "identity", "flow", "icp", "sift" or "search".
    T : (4, 4) motion, world metres.
    support : matches or points behind it.
    error : metres, how well it fits its own evidence (rms unless the rule says otherwise).
    score : what the rule compares; lower is better.
    """

    kind: str
    T: NDArray[np.float64]
    support: int = 0
    error: float = 0.0
    score: float = 0.0


IDENTITY = Candidate("identity", np.eye(4))


class MotionRule(ABC):
    """Decides the motion of an object."""

    @abstractmethod
    def candidates(self, rng: np.random.Generator, track: Track) -> tuple[Candidate, ...]:
        """Motions worth considering for a segment, at least one. Computed once for all hypotheses."""

    @abstractmethod
    def choose(self, rng: np.random.Generator, candidates: tuple[Candidate, ...]) -> Candidate:
        """The motion of one particle's object. `rng` is this particle's own."""


def sift_motions(
    rng: np.random.Generator,
    track: Track,
    sift: SiftMatching,
    in_target: bool,
    eps: float,
    min_size: int,
    n_models: int,
) -> list[Motion]:
    """Rigid motions among the SIFT matches of a segment, best supported first."""
    p, q = track.sift_pairs(sift, in_target)
    return jlinkage(rng, p, q, eps=eps, min_size=min_size, n_models=n_models)


def icp(track: Track, start: str, reach: float, iterations: int, method: str) -> Fit | None:
    """Registration of the segment to the surface under its tracked mask; None where there is none."""
    source, target = track.surface, track.target_surface
    if source is None or target is None:
        return None
    init = centroid_shift(source.points, target.points) if start == "centroid" else np.eye(4)
    return register(source, target, init, reach, method, iterations)


@dataclass(frozen=True)
class PaperRule(MotionRule):
    """Algorithm 2 of the paper.

    Parameters
    ----------
    order : "first" or "best"
        First of SIFT and ICP that passes its test (Algorithm 2), or the one of the smaller error (text).
    min_inliers : int
        SIFT is accepted with MORE inliers than this.
    max_error : float
        Metres; ICP is accepted with a smaller root mean square distance. 1 mm lies below the noise of a
        depth camera at 0.7 m, so that as printed ICP is next to never accepted.
    icp_start : "centroid" or "identity"
        Where ICP starts; the paper does not say.
    icp_reach : float
        Metres, largest correspondence distance.
    icp_iterations : int
    sift : SiftMatching
    eps : float
        Metres, J-Linkage's inlier distance.
    n_models : int
        J-Linkage's sampled motions.
    """

    order: str = "first"
    min_inliers: int = 5
    max_error: float = 0.001
    icp_start: str = "centroid"
    icp_reach: float = 0.03
    icp_iterations: int = 30
    sift: SiftMatching = field(default_factory=SiftMatching)
    eps: float = 0.010
    n_models: int = 500

    def __post_init__(self) -> None:
        if self.order not in ("first", "best"):
            raise InputError(f"order {self.order!r} is unknown", "one of first, best")
        if self.icp_start not in ("centroid", "identity"):
            raise InputError(f"icp_start {self.icp_start!r} is unknown", "one of centroid, identity")

    def candidates(self, rng: np.random.Generator, track: Track) -> tuple[Candidate, ...]:
        """What passed its test, in the order SIFT, ICP, identity."""
        passed = []
        motions = sift_motions(rng, track, self.sift, True, self.eps, 3, self.n_models)
        if motions and len(motions[0].inliers) > self.min_inliers:
            m = motions[0]
            passed.append(Candidate("sift", m.T, len(m.inliers), m.rms, m.rms))
        if self.order == "best" or not passed:
            fit = icp(track, self.icp_start, self.icp_reach, self.icp_iterations, "ICP")
            if fit is not None and fit.rms < self.max_error:
                passed.append(Candidate("icp", fit.T, len(track.points), fit.rms, fit.rms))
        return (*passed, IDENTITY)

    def choose(self, rng: np.random.Generator, candidates: tuple[Candidate, ...]) -> Candidate:
        """The first, or of those that passed the one of smallest error."""
        moving = [c for c in candidates if c.kind != "identity"]
        if self.order == "best" and moving:
            return min(moving, key=lambda c: c.score)
        return candidates[0]


def _one_to_many() -> SiftMatching:
    """All pairs within the radii of the authors' program (200, 1000 pixels, 1 m)."""
    return SiftMatching(mutual=False, descriptor_radius=200.0, search_share=10.0, search_distance=1.0)


@dataclass(frozen=True)
class AuthorsRule(MotionRule):
    """The rule of the authors' program: SIFT and ICP mixed at random.

    Parameters
    ----------
    min_size : int
        Smallest J-Linkage cluster.
    slope, offset, lowest, highest : float
        A drawn cluster of n matches is used with probability clip(slope n + offset, lowest, highest).
    max_mean_square : float
        Square metres; ICP is accepted up to this mean SQUARED distance (0.002 is 4.5 cm rms).
    icp_iterations : int
    icp_reach : float
        Metres; the program sets no limit, so this is far.
    sift : SiftMatching
    eps : float
        Metres, J-Linkage's inlier distance (not published).
    n_models : int
    """

    min_size: int = 3
    slope: float = 0.1
    offset: float = -0.25
    lowest: float = 0.1
    highest: float = 0.9
    max_mean_square: float = 0.002
    icp_iterations: int = 20
    icp_reach: float = 10.0
    sift: SiftMatching = field(default_factory=_one_to_many)
    eps: float = 0.010
    n_models: int = 1000

    def candidates(self, rng: np.random.Generator, track: Track) -> tuple[Candidate, ...]:
        """All SIFT clusters, ICP from the identity if accepted, identity."""
        found = [
            Candidate("sift", m.T, len(m.inliers), m.rms)
            for m in sift_motions(rng, track, self.sift, True, self.eps, self.min_size, self.n_models)
        ]
        fit = icp(track, "identity", self.icp_reach, self.icp_iterations, "ICP")
        if fit is not None and fit.rms**2 <= self.max_mean_square:
            found.append(Candidate("icp", fit.T, len(track.points), fit.rms))
        return (*found, IDENTITY)

    def choose(self, rng: np.random.Generator, candidates: tuple[Candidate, ...]) -> Candidate:
        """Draw a cluster, then whether to use it; else ICP; else identity."""
        sift = [c for c in candidates if c.kind == "sift"]
        if sift:
            sizes = np.array([c.support for c in sift], dtype=np.float64)
            drawn = sift[rng.choice(len(sift), p=sizes / sizes.sum())]
            use = np.clip(self.slope * drawn.support + self.offset, self.lowest, self.highest)
            if rng.random() < use:
                return drawn
        return next(c for c in candidates if c.kind != "sift")

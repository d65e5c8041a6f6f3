"""The motion model of MST: every hypothesis follows the video from one pause to the next (paper IV-C).

>>> moved = TrackingTransition().predict(rng, population, clip)      # doctest: +SKIP
>>> moved.notes["motions"]                                           # doctest: +SKIP
{'static': 52, 'icp': 9, ...}

Optical flow follows the visible part of each object, a rule decides on a rigid motion, and the voxels are moved. Flow
and features are computed once per clip. A segment that several hypotheses share is tracked once.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mstfilter.scene import Clip, Hypothesis
from mstfilter.smc import Population, Transition, child
from mstfilter.tracking.flow import ClipTracks, DenseFlow
from mstfilter.tracking.rules import IDENTITY, Candidate, MotionRule, MstRule
from mstfilter.tracking.segments import Segment, StaticTest, Track, segments_of
from mstfilter.tracking.warp import Moved, Warp

__all__ = ["IdentityTransition", "TrackingTransition"]


@dataclass(frozen=True)
class IdentityTransition(Transition):
    """The prediction is the previous population: a baseline for tracking."""

    properly_weighted: ClassVar[bool] = False

    def predict(self, rng: np.random.Generator, population: Population, observation: Clip | None) -> Population:
        """Return the same particles and weights."""
        return _successor(population, tuple(population.particles), {"motions": {"identity": 0}})


@dataclass(frozen=True)
class TrackingTransition(Transition):
    """Move hypotheses by tracking their objects through the clip.

    Parameters
    ----------
    rule : MotionRule
        Decides the rigid motion of each object.
    flow : DenseFlow
        Dense flow through the clip.
    static : StaticTest
        Objects that pass keep the identity exactly and are not tracked.
    warp : Warp
        Moves the voxels.
    min_support : int
        Objects with fewer pixels that agree with the depth image are not tracked.
    """

    rule: MotionRule = field(default_factory=MstRule)
    flow: DenseFlow = field(default_factory=DenseFlow)
    static: StaticTest = field(default_factory=StaticTest)
    warp: Warp = field(default_factory=Warp)
    min_support: int = 12

    properly_weighted: ClassVar[bool] = False

    def predict(self, rng: np.random.Generator, population: Population, observation: Clip | None) -> Population:
        """Move all hypotheses; weights do not change.

        Notes
        -----
        `notes` contains ``motions`` (number of objects per kind: static, identity, flow, icp, sift, search,
        invisible, unsupported, lost), ``segments`` (number of distinct segments), ``registrations`` (of candidates of
        distinct segments: number, iterations, inliers, not converged), ``voxels_left`` (the grid),
        ``voxels_contested`` and ``objects_dropped``. *invisible*: hidden in the first frame; *unsupported*: the depth
        image disagrees with the object; *lost*: not found in the last frame. Objects of these three kinds keep their
        position.
        """
        particles: tuple[Hypothesis, ...] = tuple(population.particles)
        if observation is None or len(observation.frames) < 2:
            return _successor(population, particles, {"motions": {}, "segments": 0})
        clip = observation
        tracks = self.flow.track(clip)  # all hypotheses share it
        cache: dict[bytes, tuple[str, tuple[Candidate, ...]]] = {}
        occurrences: Counter[bytes] = Counter()
        counts: Counter[str] = Counter()
        moved: list[Moved] = []
        for hypothesis in particles:
            # Streams are named by content, so the result does not depend on the order of hypotheses.
            stream = child(rng, "choose", _number(hypothesis.key), occurrences[hypothesis.key])
            occurrences[hypothesis.key] += 1
            segments = segments_of(hypothesis, clip.before) if hypothesis.n_objects else {}
            motions, scores = {}, {}
            for record in hypothesis.objects:
                kind, candidates = self._track(rng, clip, tracks, segments.get(record.label), cache)
                chosen = IDENTITY
                if candidates:
                    chosen = self.rule.choose(child(stream, "object", record.label), candidates)
                    if not (kind == "lost" and chosen.kind == "identity"):
                        kind = chosen.kind
                counts[kind] += 1
                motions[record.label], scores[record.label] = chosen.T, chosen.score
            moved.append(self.warp.move(hypothesis, motions, scores))
        notes = {
            "motions": dict(sorted(counts.items())),
            "segments": len(cache),
            "registrations": _registration_notes([c for _, found in cache.values() for c in found]),
            "voxels_left": sum(m.voxels_left for m in moved),
            "voxels_contested": sum(m.contested for m in moved),
            "objects_dropped": sum(len(m.dropped) for m in moved),
        }
        return _successor(population, tuple(m.hypothesis for m in moved), notes)

    def _track(
        self,
        rng: np.random.Generator,
        clip: Clip,
        tracks: ClipTracks,
        segment: Segment | None,
        cache: dict[bytes, tuple[str, tuple[Candidate, ...]]],
    ) -> tuple[str, tuple[Candidate, ...]]:
        """Kind of a segment and its candidate motions, from the cache if possible; no candidate means no motion."""
        if segment is None:
            return "invisible", ()
        if segment.key not in cache:
            cache[segment.key] = self._track_segment(rng, clip, tracks, segment)
        return cache[segment.key]

    def _track_segment(
        self, rng: np.random.Generator, clip: Clip, tracks: ClipTracks, segment: Segment
    ) -> tuple[str, tuple[Candidate, ...]]:
        if len(segment.support) < self.min_support:
            return "unsupported", ()
        track = Track(segment, clip, tracks)
        if self.static.rests(track):
            return "static", ()
        candidates = self.rule.candidates(child(rng, "segment", _number(segment.key)), track)
        return ("tracked" if track.target_mask.any() else "lost"), candidates


def _number(key: bytes) -> int:
    """Number of the random stream of a content key."""
    return int.from_bytes(key[:4], "little")


def _successor(population: Population, particles: tuple[Hypothesis, ...], notes: dict) -> Population:
    return Population(particles, population.log_weights, {"previous": np.arange(len(particles))}, notes)


def _registration_notes(candidates: list[Candidate]) -> dict[str, int]:
    """Statistics of the registrations of candidates."""
    results = [c.registration for c in candidates if c.registration is not None]
    return {
        "number": len(results),
        "iterations": sum(r.iterations or 0 for r in results),
        "inliers": sum(r.inliers for r in results),
        "not_converged": sum(r.converged is False for r in results),
    }

"""The motion model of MST: every hypothesis follows the video from one pause to the next.

>>> moved = TrackingTransition().predict(rng, population, clip)      # doctest: +SKIP
>>> moved.notes["motions"]                                           # doctest: +SKIP
{'static': 52, 'icp': 9, ...}

(paper IV-C.) The visible part of each object is followed by optical flow, a rule chooses a rigid
motion (rules.py, mst_rule.py), the voxels follow it (warp.py). Flow and features are computed once a
clip; a segment on which several hypotheses agree is tracked once.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mstfilter.scene import Clip, Hypothesis
from mstfilter.smc import Population, Transition, child
from mstfilter.tracking.flow import ClipTracks, DenseFlow
from mstfilter.tracking.mst_rule import MstRule
from mstfilter.tracking.rules import IDENTITY, Candidate, MotionRule
from mstfilter.tracking.segments import Segment, segments_of
from mstfilter.tracking.static import StaticTest
from mstfilter.tracking.track import Track
from mstfilter.tracking.warp import Moved, Warp

__all__ = ["IdentityTransition", "TrackingTransition"]


@dataclass(frozen=True)
class IdentityTransition(Transition):
    """Nothing moves: the baseline that every tracker must beat."""

    properly_weighted: ClassVar[bool] = False

    def predict(self, rng: np.random.Generator, population: Population, observation: Clip | None) -> Population:
        """The same particles and weights."""
        return _successor(population, tuple(population.particles), {"motions": {"identity": 0}})


@dataclass(frozen=True)
class TrackingTransition(Transition):
    """Move hypotheses by tracking their objects through the clip.

    Parameters
    ----------
    rule : MotionRule
        Chooses each object's rigid motion.
    flow : DenseFlow
        Follows pixels through the clip.
    static : StaticTest
        Objects that pass it keep the identity exactly and are not tracked.
    warp : Warp
        Moves the voxels.
    min_support : int
        Objects with fewer pixels that agree with the depth image are not tracked (they stay).
    """

    rule: MotionRule = field(default_factory=MstRule)
    flow: DenseFlow = field(default_factory=DenseFlow)
    static: StaticTest = field(default_factory=StaticTest)
    warp: Warp = field(default_factory=Warp)
    min_support: int = 12

    properly_weighted: ClassVar[bool] = False

    def predict(self, rng: np.random.Generator, population: Population, observation: Clip | None) -> Population:
        """Move all hypotheses; weights stay.

        Notes
        -----
        `notes` counts, over all hypotheses and objects: ``motions`` (static / identity / flow / icp / sift / search /
        invisible / unsupported / lost), ``segments`` (distinct ones tracked), ``voxels_left`` the grid,
        ``voxels_contested``, ``objects_dropped``. *invisible*: hidden in the first frame; *unsupported*: the
        depth image does not show it where the hypothesis has it; *lost*: nothing of it found in the last
        frame. All three stay where they were.
        """
        particles: tuple[Hypothesis, ...] = tuple(population.particles)
        if observation is None or len(observation.frames) < 2:
            return _successor(population, particles, {"motions": {}, "segments": 0})
        clip = observation
        tracks = self.flow.track(clip)  # once: asking reads every frame of a long clip
        cache: dict[bytes, tuple[str, tuple[Candidate, ...]]] = {}
        occurrences: Counter[bytes] = Counter()
        counts: Counter[str] = Counter()
        moved: list[Moved] = []
        for hypothesis in particles:
            # Streams are named by content, so the order of hypotheses changes nothing.
            own = child(rng, "choose", _number(hypothesis.key), occurrences[hypothesis.key])
            occurrences[hypothesis.key] += 1
            segments = segments_of(hypothesis, clip.before) if hypothesis.n_objects else {}
            motions, scores = {}, {}
            for record in hypothesis.objects:
                fate, candidates = self._track(rng, clip, tracks, segments.get(record.label), cache)
                chosen = IDENTITY
                if candidates:
                    chosen = self.rule.choose(child(own, "object", record.label), candidates)
                    fate = fate if fate == "lost" and chosen.kind == "identity" else chosen.kind
                counts[fate] += 1
                motions[record.label], scores[record.label] = chosen.T, chosen.score
            moved.append(self.warp.move(hypothesis, motions, scores))
        notes = {
            "motions": dict(sorted(counts.items())),
            "segments": len(cache),
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
        """What became of a segment, and its candidate motions (none: it stays)."""
        if segment is None:
            return "invisible", ()
        if segment.key not in cache:
            cache[segment.key] = self._track_anew(rng, clip, tracks, segment)
        return cache[segment.key]

    def _track_anew(
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
    """A stream number from a content key."""
    return int.from_bytes(key[:4], "little")


def _successor(population: Population, particles: tuple[Hypothesis, ...], notes: dict) -> Population:
    return Population(particles, population.log_weights, {"previous": np.arange(len(particles))}, notes)

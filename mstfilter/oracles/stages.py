"""Tracking, free space, fusion and selection replaced by the truth, and the overrides of all stages.

>>> transition = TrueMotions()                                     # the rigid motion of each object
>>> FusionUpdate(free_space=TrueFreeSpace())                       # exactly the free space that is visible
>>> FusionUpdate(evidence=(TrueQuality(),), n_scored=100)          # the best of fusion's own candidates
>>> TrueFusion()                                                   # the best that both parents allow
>>> filter = mstfilter.preset("mst", *STAGES["selection"])            # the n best of the candidates

The time of an observation is the index of its clip. A resampler gets no clip, so for true selection the candidates
are weighted by their true quality (`TrueQuality`), and `LargestWeights` selects the n best.

Replacing one stage shows what a perfect one would add to the present filter. Replacing all but one shows what that
stage costs a filter that is perfect elsewhere. The two differ because stages correct errors of each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import numpy as np

from mstfilter.fusion import Evidence, FreeSpace, Projection
from mstfilter.fusion.update import parents_of_pairs
from mstfilter.oracles.truth import Need, UsesTruth
from mstfilter.scene import Clip, Frame, Hypothesis, ObjectRecord, frame_geometry, render
from mstfilter.scoring import overlap, weighted_coverage
from mstfilter.smc import Candidates, Population, Transition, Update, union
from mstfilter.tracking import Warp, move_points, rigid_transform

_REST = 0.0005  # metres; objects that move less are not moved, since simulated objects settle a little
_NATS = 1e4  # log score of a true quality of 1


@dataclass(frozen=True)
class TrueMotions(UsesTruth, Transition):
    """Moves the objects of hypotheses by the true motions.

    Only the motion is true: the object of the hypothesis is moved by the ordinary warp. An object that covers two
    true objects moves as the one that it shares more voxels with.
    """

    warp: Warp = field(default_factory=lambda: Warp("smooth"))

    properly_weighted: ClassVar[bool] = False
    needs: ClassVar[tuple[Need, ...]] = ("voxels", "poses")

    def predict(self, rng: np.random.Generator, population: Population, observation: Clip | None) -> Population:
        """Move all hypotheses; weights are unchanged. Objects that overlap no true object are not moved."""
        parents = {"previous": np.arange(len(population))}
        particles: tuple[Hypothesis, ...] = tuple(population.particles)
        counts = {"true": 0, "rest": 0, "no object": 0}
        if observation is not None and len(observation) > 1:
            t = observation.index
            motions, labels = self.truth.motions(t), self.truth.labels(t - 1)
            particles = tuple(self._move(h, labels, motions, counts) for h in particles)
        return Population(particles, population.log_weights, parents, {"motions": counts})

    def _move(
        self, hypothesis: Hypothesis, labels: np.ndarray, motions: dict[int, np.ndarray], counts: dict[str, int]
    ) -> Hypothesis:
        table = overlap(hypothesis.labels, labels)
        shared = np.where(table.labels_b > 0, table.counts, 0)
        chosen = {}
        for row, label in enumerate(table.labels_a.tolist()):
            if label == 0:
                continue
            outcome = "no object"
            if shared[row].any():
                T = motions.get(int(table.labels_b[shared[row].argmax()]), np.eye(4))
                centres = hypothesis.grid.centre_of(np.argwhere(hypothesis.mask(label)))
                distance = np.linalg.norm(move_points(T, centres) - centres, axis=1).max()
                outcome = "true" if distance > _REST else "rest"
                if outcome == "true":
                    chosen[label] = rigid_transform(T)
            counts[outcome] += 1
        return self.warp.move(hypothesis, chosen).hypothesis


@dataclass(frozen=True)
class TrueFreeSpace(UsesTruth, Projection):
    """Clears voxels that are truly free; with `hidden`, also those that the camera does not see."""

    hidden: bool = False

    def project(self, hypothesis: Hypothesis, frame: Frame) -> tuple[Hypothesis, float]:
        """The hypothesis without these voxels, and the fraction of occupied voxels that it keeps."""
        labels = self.truth.labels(self.truth.pause_of(frame))
        free = labels == 0
        if not self.hidden:
            geometry = frame_geometry(frame, hypothesis.grid)
            depth = render(labels, hypothesis.grid, frame.camera).depth
            surface = np.where(np.isnan(depth), np.inf, depth).ravel()[np.maximum(geometry.pixel, 0)]
            free = free & (geometry.pixel >= 0) & (geometry.z < surface)
        occupied = hypothesis.labels != 0
        hit = occupied & free
        if not hit.any():
            return hypothesis, 1.0
        kept = hypothesis.with_labels(np.where(hit, 0, hypothesis.labels).astype(np.uint16))
        return kept, 1.0 - int(hit.sum()) / int(occupied.sum())


@dataclass(frozen=True)
class TrueQuality(UsesTruth, Evidence):
    """Scores hypotheses by their true quality, so strongly that practically all weight is on the best candidate."""

    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        labels = self.truth.labels(clip.index)
        return _NATS * np.array([weighted_coverage(h.labels, labels) for h in hypotheses])


@dataclass(frozen=True)
class TrueFusion(UsesTruth, Update):
    """The best hypothesis that the objects of two parents allow, without random draws.

    `free_space` projects the predicted hypotheses first. For every true object: the best object of either parent (by
    Jaccard index), merged with all objects that improve it. Better objects are painted over worse ones; other objects
    are dropped. Each pair makes one candidate. If there are terms of `evidence`, all candidates are built and
    weighted by them, else by the weights of the pairs.
    """

    free_space: Projection = FreeSpace()  # noqa: RUF009 (frozen)
    evidence: tuple[Evidence, ...] = ()

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """One candidate per pair; a single parent passes unchanged."""
        if predicted is None:
            return union(None, proposed)
        refined, _ = self.free_space.refine(predicted.particles, observation)
        if proposed is None:
            return Population(refined, predicted.log_weights, predicted.parents)
        labels, samples = self.truth.labels(observation.index), tuple(proposed.particles)
        i, j = np.divmod(np.arange(len(proposed) * len(predicted)), len(predicted))
        parents = parents_of_pairs(proposed, i, predicted, j)
        candidates = Candidates(lambda c: best_of_both(samples[i[c]], refined[j[c]], labels), len(i))
        fused = Population(candidates, proposed.log_weights[i] + predicted.log_weights[j], parents)
        if not self.evidence:
            return fused
        built = fused.realised()
        scores = [term.log_score(tuple(built.particles), observation) for term in self.evidence]
        return Population(built.particles, np.sum(scores, axis=0), parents)


class _Part(NamedTuple):
    """An object of a parent."""

    number: int  # among the objects of both parents, the predicted ones first
    record: ObjectRecord
    mask: np.ndarray
    jaccard: dict[int, float]  # with each true object that it overlaps

    @property
    def target(self) -> int:
        """The true object that it overlaps best."""
        return max(self.jaccard, key=lambda label: (self.jaccard[label], -label))


def best_of_both(proposed: Hypothesis, predicted: Hypothesis, true: np.ndarray) -> Hypothesis:
    """The candidate that `TrueFusion` builds from two hypotheses."""
    parts: list[_Part] = []
    for parent in (predicted, proposed):
        table = overlap(parent.labels, true)
        jaccard = table.jaccard()
        for record in parent.objects:
            row = int(np.searchsorted(table.labels_a, record.label))
            columns = np.flatnonzero((table.counts[row] > 0) & (table.labels_b > 0))
            overlaps = {int(table.labels_b[c]): float(jaccard[row, c]) for c in columns}
            mask = parent.mask(record.label)
            parts.append(_Part(len(parts), record, mask, overlaps))

    chosen: list[tuple[float, int, ObjectRecord, np.ndarray, bool]] = []
    for label in {k for part in parts for k in part.jaccard}:
        candidates = [part for part in parts if part.jaccard and part.target == label]
        if not candidates:
            continue
        candidates.sort(key=lambda part: -part.jaccard[label])
        first = candidates[0]
        record, mask, best, merged = first.record, first.mask, first.jaccard[label], False
        for part in candidates[1:]:
            joined = mask | part.mask
            score = float((joined & (true == label)).sum() / (joined | (true == label)).sum())
            if score > best + 1e-9:
                mask, best, merged = joined, score, True
        known = [part.record for part in candidates if part.number < predicted.n_objects]
        if known:  # the object keeps its identity
            record = replace(record, id=known[0].id, birth=known[0].birth)
        chosen.append((best, -first.number, record, mask, merged))

    chosen.sort(key=lambda entry: entry[:2])
    labels = np.zeros(true.shape, np.uint16)
    for number, (_, _, _, mask, _) in enumerate(chosen, start=1):
        labels[mask] = number
    records = []
    for number, (_, _, record, mask, merged) in enumerate(chosen, start=1):
        visible = labels == number
        if visible.any():
            record = replace(record, label=number)
            records.append(record if not merged and np.array_equal(visible, mask) else record.changed())
    return Hypothesis(labels, predicted.grid, tuple(records))


#: Overrides of the preset ``mst`` by stage. A new component keeps the fields of ``mst`` that it has too.
STAGES: dict[str, tuple[str, ...]] = {
    "boundary": ('proposal.boundary={component="true_boundary", form="cleaned"}',),
    "masks": ("proposal=true_masks", "proposal.completer=network"),
    "completion": ("proposal.completer=true_completion",),
    "motions": ("transition=true_motions",),
    "choice": ('update.evidence=["true_quality"]', "update.n_scored=100"),
    "fusion": ("update=true_fusion", "update.evidence=[]"),
    "free space": ("update.free_space=true_free_space",),
    "selection": ('update.evidence=["true_quality"]', "resampler=largest_weights"),
}


def overrides_of(*stages: str) -> tuple[str, ...]:
    """Overrides of ``mst`` that replace several stages, in an order in which no override undoes another."""
    return tuple(change for stage in STAGES if stage in stages for change in STAGES[stage])

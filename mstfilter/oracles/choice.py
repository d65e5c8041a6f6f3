"""Free space, fusion and selection by the truth.

>>> FusionUpdate(free_space=TrueFreeSpace())                       # exactly the free space that can be seen
>>> FusionUpdate(evidence=(TrueQuality(),), n_scored=100)          # the best of fusion's own candidates
>>> TrueFusion()                                                   # the best that can be made of both parents
>>> ParticleFilter(..., resampler=TrueBest())                      # the n best candidates
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.fusion import Evidence, FreeSpace, Projection
from mstfilter.oracles.truth import UsesTruth
from mstfilter.scene import Clip, Frame, Hypothesis, ObjectRecord, frame_geometry, render
from mstfilter.scoring import Form, overlap, weighted_coverage
from mstfilter.smc import Candidates, Key, Population, Resampler, Update, key_of, union

__all__ = ["TrueBest", "TrueFreeSpace", "TrueFusion", "TrueQuality"]


@dataclass(frozen=True)
class TrueFreeSpace(UsesTruth, Projection):
    """Clears voxels that are free in truth.

    Parameters
    ----------
    hidden : bool
        Also those that the camera does not see: more than any sensor could tell.
    """

    hidden: bool = False

    def project(self, hypothesis: Hypothesis, frame: Frame) -> tuple[Hypothesis, float]:
        """The hypothesis without these voxels, and the share that it keeps."""
        labels = self.truth.labels(self.truth.pause_of(frame))
        free = labels == 0
        if not self.hidden:
            geometry = frame_geometry(frame, hypothesis.grid)
            seen = render(labels, hypothesis.grid, frame.camera).depth
            surface = np.where(np.isnan(seen), np.inf, seen).ravel()[np.maximum(geometry.pixel, 0)]
            free = free & (geometry.pixel >= 0) & (geometry.z < surface)
        occupied = hypothesis.labels != 0
        hit = occupied & free
        if not hit.any():
            return hypothesis, 1.0
        kept = hypothesis.with_labels(np.where(hit, 0, hypothesis.labels).astype(np.uint16))
        return kept, 1.0 - int(hit.sum()) / int(occupied.sum())


@dataclass(frozen=True)
class TrueQuality(UsesTruth, Evidence):
    """Scores hypotheses by their true quality.

    Parameters
    ----------
    strength : float
        Nats for a quality of 1. The default leaves the best of all candidates alone with weight.
    form : {"objects", "paper", "authors"}
        Of quality.
    """

    strength: float = 1e4
    form: Form = "objects"

    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        """(n,) strength x quality."""
        labels = self.truth.labels(clip.index)
        return self.strength * np.array([weighted_coverage(h.labels, labels, self.form) for h in hypotheses])


@dataclass(frozen=True)
class TrueBest(UsesTruth, Resampler):
    """Keeps the n candidates of best true quality; draws nothing. All candidates are built.

    Parameters
    ----------
    form : {"objects", "paper", "authors"}
        Of quality.
    """

    form: Form = "objects"

    properly_weighted: ClassVar[bool] = False

    def select(
        self, rng: np.random.Generator, log_weights: np.ndarray, n: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """The n largest weights (in turn, where there are fewer): weights alone say nothing of the truth."""
        order = np.argsort(-np.asarray(log_weights), kind="stable")
        return order[np.arange(n) % len(order)], None

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Select by quality at the pause of the filter's step."""
        labels = self.truth.labels(step_of(rng))
        population = population.realised()
        quality = np.array([weighted_coverage(h.labels, labels, self.form) for h in population.particles])
        ancestors, _ = self.select(rng, quality, n)
        chosen = population.take(ancestors, np.full(n, population.log_mean_weight))
        return chosen.labelled({**chosen.parents, "ancestor": ancestors.astype(np.int64)}, chosen.notes)


def step_of(rng: np.random.Generator) -> int:
    """The step of the filter that a generator's stream belongs to: a resampler is told it by nothing else."""
    path, word = key_of(rng).path, Key(0).child("step").path[0]
    for k in range(len(path) - 2, -1, -1):
        if path[k] == word:
            return path[k + 1]
    raise InputError("this generator belongs to no step of a filter, so the pause to judge by is unknown")


@dataclass(frozen=True)
class TrueFusion(UsesTruth, Update):
    """The best hypothesis that the objects of two parents allow: fusion without its chances.

    For every true object, the best object of either parent (by Jaccard index) and what improves it when merged
    with it; better ones are painted over worse ones, all others are dropped. Each pair makes one candidate.

    Parameters
    ----------
    free_space : Projection
        Projects the predicted hypotheses first.
    """

    free_space: Projection = FreeSpace()  # noqa: RUF009 (frozen)

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Clip,
    ) -> Population:
        """One candidate for each pair, unbuilt; one parent alone is fused with nothing."""
        if predicted is None:
            return union(None, proposed)
        refined, _ = self.free_space.refine(predicted.particles, observation)
        if proposed is None:
            return Population(refined, predicted.log_weights, predicted.parents)
        labels, samples = self.truth.labels(observation.index), tuple(proposed.particles)
        i, j = np.divmod(np.arange(len(proposed) * len(predicted)), len(predicted))
        none_j, none_i = np.full(len(predicted), -1), np.full(len(proposed), -1)
        parents = {
            "previous": predicted.parents.get("previous", none_j)[j],
            "proposed": proposed.parents.get("proposed", none_i)[i],
        }
        candidates = Candidates(lambda c: best_of_both(samples[i[c]], refined[j[c]], labels), len(i))
        return Population(candidates, proposed.log_weights[i] + predicted.log_weights[j], parents)


def best_of_both(proposed: Hypothesis, predicted: Hypothesis, true: np.ndarray) -> Hypothesis:
    """What `TrueFusion` makes of two hypotheses."""
    masks: list[np.ndarray] = []
    records: list[ObjectRecord] = []
    claims: list[dict[int, float]] = []  # Jaccard index with each true object that an object meets
    for parent in (predicted, proposed):
        table = overlap(parent.labels, true)
        jaccard = table.jaccard()
        for record in parent.objects:
            row = int(np.searchsorted(table.labels_a, record.label))
            masks.append(parent.mask(record.label))
            records.append(record)
            met = np.flatnonzero((table.counts[row] > 0) & (table.labels_b > 0))
            claims.append({int(table.labels_b[c]): float(jaccard[row, c]) for c in met})
    n_predicted = predicted.n_objects
    chosen: list[tuple[float, int, np.ndarray, bool]] = []
    for k in sorted({k for claim in claims for k in claim}):
        able = [m for m in range(len(masks)) if claims[m] and max(claims[m], key=lambda o: (claims[m][o], -o)) == k]
        able.sort(key=lambda m: -claims[m][k])
        if not able:
            continue
        target, mask, best, merged = true == k, masks[able[0]], claims[able[0]][k], False
        for m in able[1:]:
            joined = mask | masks[m]
            jaccard_joined = float((joined & target).sum() / (joined | target).sum())
            if jaccard_joined > best + 1e-9:
                mask, best, merged = joined, jaccard_joined, True
        known = [m for m in able if m < n_predicted]
        if known:  # an object that was there before keeps its name
            old = records[known[0]]
            records[able[0]] = replace(records[able[0]], id=old.id, birth=old.birth)
        chosen.append((best, able[0], mask, merged))
    labels, kept = np.zeros(true.shape, np.uint16), {}
    for number, (_, m, mask, merged) in enumerate(sorted(chosen, key=lambda c: (c[0], -c[1])), start=1):
        labels[mask] = number
        kept[number] = (records[m], mask, merged)
    out = []
    for number in [int(k) for k in np.unique(labels) if k > 0]:
        record, mask, merged = kept[number]
        record = replace(record, label=number)
        out.append(record if not merged and np.array_equal(labels == number, mask) else record.changed())
    return Hypothesis(labels, predicted.grid, tuple(out))

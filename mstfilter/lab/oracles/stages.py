"""Oracles of tracking, free space, partition and selection, and the overrides for the oracles of all stages.

>>> transition = TrueMotions()                                     # the rigid motion of each object
>>> PartitionUpdate(free_space=TrueFreeSpace())                    # exactly the free space that is visible
>>> PartitionUpdate(evidence=(TrueQuality(),), n_scored=100)   # the best of the update's own candidates
>>> PartitionUpdate(pairs=TruePairs())                             # the best of the partitions that it considers
>>> filter = mstfilter.preset("mst", *STAGES["selection"])         # the n best of the candidates

Oracles find the time of an observation from the index of its clip. A resampler gets no clip. So for true selection,
`TrueQuality` weights the candidates by their true quality, and `LargestWeights` selects the n best candidates.

Replacing one stage by its oracle shows the gain if this stage were perfect. Replacing all other stages shows the loss
from this stage if all other stages were perfect. Gain and loss are not equal, because a stage can correct errors of
another stage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mstfilter.lab.oracles.truth import Need, UsesTruth
from mstfilter.mst.partition import Cells, PairOdds
from mstfilter.mst.tracking import Warp, move_points, rigid_transform
from mstfilter.scene import Clip, Evidence, Frame, Hypothesis, Projection, frame_geometry, render
from mstfilter.scene.evidence import cleared
from mstfilter.scoring import overlap, weighted_coverage
from mstfilter.smc import Population, Transition

_REST = 0.0005  # metres; objects that move less are not moved, since simulated objects settle a little
_NATS = 1e4  # log score of a true quality of 1


@dataclass(frozen=True)
class TrueMotions(UsesTruth, Transition):
    """Moves the objects of hypotheses by the true motions.

    Only the motions are true. The objects come from the hypothesis and are moved by the ordinary warp. An object that
    covers two true objects moves like the true object with which it shares more voxels.
    """

    warp: Warp = field(default_factory=Warp)

    properly_weighted: ClassVar[bool] = False
    needs: ClassVar[tuple[Need, ...]] = ("voxels", "poses")

    def predict(self, rng: np.random.Generator, population: Population, observation: Clip | None) -> Population:
        """Move all hypotheses; the weights do not change. Objects that overlap no true object are not moved."""
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
    """Clears voxels that are truly free and visible to the camera."""

    def project(self, hypothesis: Hypothesis, frame: Frame) -> tuple[Hypothesis, float]:
        """The hypothesis without truly free visible voxels, and the fraction of occupied voxels that remain."""
        labels = self.truth.labels(self.truth.pause_of(frame))
        geometry = frame_geometry(frame, hypothesis.grid)
        depth = render(labels, hypothesis.grid, frame.camera).depth
        surface = np.where(np.isnan(depth), np.inf, depth).ravel()[np.maximum(geometry.pixel, 0)]
        return cleared(hypothesis, (labels == 0) & (geometry.pixel >= 0) & (geometry.z < surface))


@dataclass(frozen=True)
class TrueQuality(UsesTruth, Evidence):
    """Scores hypotheses by their true quality, with nearly all weight on the best candidate."""

    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        labels = self.truth.labels(clip.index)
        return _NATS * np.array([weighted_coverage(h.labels, labels) for h in hypotheses])


@dataclass(frozen=True)
class TruePairs(UsesTruth, PairOdds):
    """Log odds that are nearly certain of the truth, so that the most probable partitions are close to the truth.

    A cell belongs to the true object of most of its readings.
    """

    needs: ClassVar[tuple[Need, ...]] = ("voxels", "instance")

    def log_odds(self, cells: Cells, weights: np.ndarray, clip: Clip) -> np.ndarray:
        true = cells.counts(cells.readings.of_image(self.truth.instance(clip.index))).argmax(axis=1)
        a, b = cells.pairs.T
        return np.where(true[a] == true[b], _NATS, -_NATS)


#: Overrides of the preset ``mst`` by stage. A new component keeps the fields of ``mst`` that it has too.
STAGES: dict[str, tuple[str, ...]] = {
    "boundary": ("proposal.boundary=true_boundary",),
    "masks": ("proposal=true_masks", "proposal.completer=surface"),
    "completion": ("update.completer=true_completion",),
    "motions": ("transition=true_motions",),
    "choice": ('update.evidence=["true_quality"]', "update.n_scored=100"),
    "partition": ("update.pairs=true_pairs",),
    "free space": ("update.free_space=true_free_space",),
    "selection": ('update.evidence=["true_quality"]', "resampler=largest_weights"),
}

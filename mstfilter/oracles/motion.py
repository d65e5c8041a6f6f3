"""Motions by the truth: every object of a hypothesis moves as the true object in it did.

>>> transition = TrueMotions()

Only the motion is true. What moves is the hypothesis's own object, by the ordinary warp: two true objects in one
object move as the larger part does.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mstfilter.oracles.truth import Need, UsesTruth
from mstfilter.scene import Clip, Hypothesis
from mstfilter.scoring import overlap
from mstfilter.smc import Population, Transition
from mstfilter.tracking import Array, Warp, apply

__all__ = ["TrueMotions"]


@dataclass(frozen=True)
class TrueMotions(UsesTruth, Transition):
    """Move the objects of hypotheses by true motions.

    Parameters
    ----------
    warp : Warp
        Moves the voxels.
    rest : float
        Objects none of whose voxels moves farther than this (metres) stay exactly: simulated objects settle a
        little.
    """

    warp: Warp = field(default_factory=lambda: Warp("smooth"))
    rest: float = 0.0005

    properly_weighted: ClassVar[bool] = False
    needs: ClassVar[tuple[Need, ...]] = ("voxels", "poses")

    def predict(self, rng: np.random.Generator, population: Population, observation: Clip | None) -> Population:
        """Move all hypotheses; weights stay. Objects that meet no true object stay."""
        parents = {"previous": np.arange(len(population))}
        particles: tuple[Hypothesis, ...] = tuple(population.particles)
        counts = {"true": 0, "rest": 0, "no object": 0}
        if observation is not None and len(observation) > 1:
            t = observation.index
            motions, labels = self.truth.motions(t), self.truth.labels(t - 1)
            particles = tuple(self._move(h, labels, motions, counts) for h in particles)
        return Population(particles, population.log_weights, parents, {"motions": counts})

    def _move(
        self, hypothesis: Hypothesis, labels: np.ndarray, motions: dict[int, Array], counts: dict[str, int]
    ) -> Hypothesis:
        table = overlap(hypothesis.labels, labels)
        shared = np.where(table.labels_b > 0, table.counts, 0)
        chosen = {}
        for row, label in enumerate(table.labels_a.tolist()):
            if label == 0:
                continue
            fate = "no object"
            if shared[row].any():
                T = motions.get(int(table.labels_b[shared[row].argmax()]), np.eye(4))
                centres = hypothesis.grid.centre_of(np.argwhere(hypothesis.mask(label)))
                went = np.linalg.norm(apply(T, centres) - centres, axis=1).max()
                fate = "true" if went > self.rest else "rest"
                if fate == "true":
                    chosen[label] = T
            counts[fate] += 1
        return self.warp.move(hypothesis, chosen).hypothesis

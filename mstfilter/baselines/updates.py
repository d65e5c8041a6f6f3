"""Updates without crossover: samples alone, predictions alone, or the union of both.

They replace `FusionUpdate` and leave all other parts of the filter, with their random streams, unchanged:

>>> mstfilter.preset("samples_only"), mstfilter.preset("tracking_only"), mstfilter.preset("union")

At the first pause there is no prediction, and all of them return the proposed samples, as fusion does.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mstfilter.fusion import FreeSpace, FusionUpdate, Projection, log_quality
from mstfilter.fusion.division import divided
from mstfilter.fusion.update import scored
from mstfilter.scene import Clip
from mstfilter.smc import Population, Update, union


@dataclass(frozen=True)
class SamplesOnly(Update):
    """The proposed samples alone."""

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """The proposed population; without a proposal, the predicted one."""
        return union(predicted if proposed is None else None, proposed)


@dataclass(frozen=True)
class TrackingOnly(Update):
    """The predicted hypotheses alone.

    `free_space` clears voxels that the latest image observes as free; ``none`` leaves predictions unchanged.
    """

    free_space: Projection = field(default_factory=FreeSpace)

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """The projected predictions with their weights; the proposed samples at the first pause."""
        if predicted is None:
            return union(None, proposed)
        refined, quality = self.free_space.refine(predicted.particles, observation)
        return Population(refined, predicted.log_weights, predicted.parents, {"quality": quality.tolist()})


@dataclass(frozen=True)
class Union(Update):
    """Predicted and proposed hypotheses together, with the weights of fusion but without crossover.

    A prediction has log weight ``log w + lambda log Q``, a sample ``log w``; both populations are first scaled to
    mean weight 1. Free space, division, weights and evidence are those of `fusion`; the evidence scores all
    hypotheses.
    """

    fusion: FusionUpdate = field(default_factory=FusionUpdate)

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        if predicted is None or proposed is None:
            return self.fusion.update(rng, predicted, proposed, observation)
        refined, quality = self.fusion.free_space.refine(predicted.particles, observation)
        refined = divided(self.fusion.division, self.fusion.parts, refined, observation, proposed=False)
        samples = divided(
            self.fusion.division, self.fusion.parts, tuple(proposed.particles), observation, proposed=True
        )
        log_q = self.fusion.quality_exponent * log_quality(quality)
        weighed = predicted.log_weights - predicted.log_mean_weight + log_q
        both = union(
            Population(refined, weighed, predicted.parents),
            Population(samples, proposed.log_weights - proposed.log_mean_weight, proposed.parents),
        )
        total, scores = scored(self.fusion.evidence, tuple(both.particles), observation)
        notes = {"quality": quality.tolist(), "scores": scores}
        return Population(both.particles, both.log_weights + total, both.parents, notes)

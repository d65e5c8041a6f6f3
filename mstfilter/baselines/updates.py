"""Updates without crossover: samples alone, predictions alone, both side by side.

They stand where `FusionUpdate` stands in MST and leave everything else, random streams included, as it is:

>>> mstfilter.preset("samples_only"), mstfilter.preset("tracking_only"), mstfilter.preset("union")

At the first pause there is no prediction, and all of them, like fusion, return the proposed samples.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.fusion import FreeSpace, FusionUpdate, Projection, log_quality
from mstfilter.scene import Clip
from mstfilter.smc import Population, Update, union

__all__ = ["SamplesOnly", "TrackingOnly", "Union"]


@dataclass(frozen=True)
class SamplesOnly(Update):
    """The proposed samples, as if there were no past."""

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Clip,
    ) -> Population:
        """The proposed population itself; where nothing was proposed, the last one stays."""
        return union(predicted if proposed is None else None, proposed)


@dataclass(frozen=True)
class TrackingOnly(Update):
    """The predicted hypotheses: objects of the first pause tracked on.

    Parameters
    ----------
    free_space : Projection
        Clears what the latest image shows to be free; ``none`` leaves predictions as they are.
    """

    free_space: Projection = field(default_factory=FreeSpace)

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Clip,
    ) -> Population:
        """The refined predictions with their weights; the proposed samples at the first pause."""
        if predicted is None:
            return union(None, proposed)
        refined, quality = self.free_space.refine(predicted.particles, observation)
        return Population(refined, predicted.log_weights, predicted.parents, {"quality": quality.tolist()})


@dataclass(frozen=True)
class Union(Update):
    """Predicted and proposed hypotheses side by side, weighted as fusion weighs, none crossed.

    A prediction has log weight ``log w + lambda log Q``, a sample ``log w``; both populations have mean weight 1
    before. Evidence, where fusion has some, scores all of them.

    Parameters
    ----------
    fusion : FusionUpdate
        Its free space, division, weights and evidence are used, its crossover is not.
    """

    fusion: FusionUpdate = field(default_factory=FusionUpdate)

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not isinstance(self.fusion, FusionUpdate):
            raise InputError(f"union weighs as a fusion does, and {type(self.fusion).__name__} is none")

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Clip,
    ) -> Population:
        """All predicted and proposed hypotheses."""
        if predicted is None or proposed is None:
            return self.fusion.update(rng, predicted, proposed, observation)
        refined, quality = self.fusion.free_space.refine(predicted.particles, observation)
        refined = self.fusion.divided(refined, observation, proposed=False)
        samples = self.fusion.divided(tuple(proposed.particles), observation, proposed=True)
        log_q = self.fusion.quality_exponent * log_quality(quality)
        weighed = predicted.log_weights - predicted.log_mean_weight + log_q
        both = union(
            Population(refined, weighed, predicted.parents),
            Population(samples, proposed.log_weights - proposed.log_mean_weight, proposed.parents),
        )
        total, scores = self.fusion.scored(tuple(both.particles), observation)
        notes = {"quality": quality.tolist(), "scores": scores}
        return Population(both.particles, both.log_weights + total, both.parents, notes)

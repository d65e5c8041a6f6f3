"""Updates without crossover: samples alone, predictions alone, or the union of samples and predictions.

Each class replaces the update of `mst`. All other components of the filter and their random streams are unchanged:

>>> mstfilter.preset("samples_only"), mstfilter.preset("tracking_only"), mstfilter.preset("union")

At the first pause there is no prediction, so all updates return the proposed samples, as the update of `mst` does.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from mstfilter.fields import NonNegativeFloat
from mstfilter.scene import Clip, FreeSpace, Projection, log_quality
from mstfilter.smc import Population, Update, union


@dataclass(frozen=True)
class SamplesOnly(Update):
    """Returns the proposed samples."""

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """Return the proposed population, or the predicted population if the filter has no proposal."""
        return union(predicted if proposed is None else None, proposed)


@dataclass(frozen=True)
class TrackingOnly(Update):
    """Returns the predicted hypotheses.

    `free_space` clears voxels that the latest image observes as free. With ``none``, predictions are unchanged.
    """

    free_space: Projection = field(default_factory=FreeSpace)

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """Return the projected predictions with their weights; at the first pause, the proposed samples."""
        if predicted is None:
            return union(None, proposed)
        refined, quality = self.free_space.refine(predicted.particles, observation)
        return Population(refined, predicted.log_weights, predicted.parents, {"quality": quality.tolist()})


@dataclass(frozen=True)
class Union(Update):
    """Returns predicted and proposed hypotheses together, with the weights of the crossover but without crossover.

    A prediction has log weight ``log w + lambda log Q``, and a sample ``log w``. Both populations are first scaled to
    mean weight 1. `free_space` projects the predictions and returns Q. `quality_exponent` is lambda.
    """

    free_space: Projection = field(default_factory=FreeSpace)
    quality_exponent: NonNegativeFloat = 3.0

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """Return predictions and samples together; at the first pause, the proposed samples with their weights."""
        if predicted is None:
            return union(None, proposed)
        refined, quality = self.free_space.refine(predicted.particles, observation)
        weights = predicted.log_weights - predicted.log_mean_weight + self.quality_exponent * log_quality(quality)
        if proposed is not None:
            proposed = replace(proposed, log_weights=proposed.log_weights - proposed.log_mean_weight)
        both = union(Population(refined, weights, predicted.parents), proposed)
        return replace(both, notes={"quality": quality.tolist()})

"""Updates without crossover, and proposals of trivial baselines (floors).

Each update replaces the update of `mst`. All other components of the filter and their random streams are unchanged:

>>> mstfilter.preset("samples_only"), mstfilter.preset("tracking_only"), mstfilter.preset("union")

At the first pause there is no prediction, so all updates return the proposed samples, as the update of `mst` does.

>>> FirstPause(TreeCutProposal())      # samples at the first pause, no objects afterwards
>>> OneBlob()                          # everything above the table is one object
>>> OccupiedComponents()               # connected components of the occupied space
>>> ImageComponents()                  # connected components of the image above the table

The trivial baselines use the completer and the pixels above the table, but no segmentation. A useful method must be
better than the trivial baselines.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from mstfilter.base.fields import NonNegativeFloat, Share
from mstfilter.mst.completion import Completer, Extrude
from mstfilter.mst.segmentation import ObjectRule, TreeCutProposal, complete_segments, connected_pixels, hypothesis_of
from mstfilter.scene import Clip, Frame, FreeSpace, Hypothesis, Projection, log_quality, scaled_area
from mstfilter.scoring import connected_components, one_blob
from mstfilter.smc import Population, Proposal, Update, child, union

_MIN_VOXELS = 8  # smallest component of the occupied space
_MAX_STEP = 0.02  # metres between the depths of connected pixels


@dataclass(frozen=True)
class SamplesOnly(Update):
    """Returns the proposed samples and ignores the predictions."""

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """Return the proposed population, or the predicted population if the filter has no proposal."""
        return union(predicted if proposed is None else None, proposed)


@dataclass(frozen=True)
class TrackingOnly(Update):
    """Returns the predicted hypotheses and ignores the samples.

    `free_space` clears voxels that the latest image observes as free. With ``none``, predictions are unchanged.
    """

    free_space: Projection = field(default_factory=FreeSpace)

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """Return the predictions after `free_space`, with their weights; at the first pause, the proposed samples."""
        if predicted is None:
            return union(None, proposed)
        refined, quality = self.free_space.refine(predicted.particles, observation)
        return Population(refined, predicted.log_weights, predicted.parents, {"quality": quality.tolist()})


@dataclass(frozen=True)
class Union(Update):
    """Returns all predicted and proposed hypotheses, weighted as in the crossover but not combined by crossover.

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


@dataclass(frozen=True)
class FirstPause(Proposal):
    """Samples of another proposal at the first pause, and hypotheses without objects at later pauses.

    The inner proposal draws the same random numbers with and without this wrapper.
    """

    proposal: Proposal = field(default_factory=TreeCutProposal)

    properly_weighted: ClassVar[bool] = False

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        if observation.index == 0:
            return self.proposal.sample(rng, observation, n)
        empty = Hypothesis(np.zeros(observation.grid.shape, np.uint16), observation.grid)
        return Population((empty,) * n)


@dataclass(frozen=True)
class Floor(Proposal):
    """Base class of the trivial baselines (floors).

    Parameters
    ----------
    completer : Completer
    objects : ObjectRule
        Rule that decides which pixels are above the table.
    threshold : float
        Voxels with at least this probability are occupied.
    """

    completer: Completer = field(default_factory=Extrude)
    objects: ObjectRule = field(default_factory=ObjectRule)
    threshold: Share = 0.45

    properly_weighted: ClassVar[bool] = False

    def occupied(self, rng: np.random.Generator, clip: Clip) -> np.ndarray:
        """Labels (X, Y, Z), 1 at all visible and completed voxels above the table."""
        found = self.objects.foreground(clip.after, clip.grid)
        completer = self.completer.at(Clip((found.frame,), clip.grid, clip.index))
        completed = completer.complete(child(rng, "completion"), found.frame, [found.pixels], clip.grid)
        return hypothesis_of(completed, clip.grid, clip.index, self.threshold).labels


@dataclass(frozen=True)
class OneBlob(Floor):
    """One object with all visible and completed voxels above the table. `Floor` describes the parameters."""

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        labels = one_blob(self.occupied(rng, observation))
        return Population((Hypothesis.from_labels(labels, observation.grid, observation.index),) * n)


@dataclass(frozen=True)
class OccupiedComponents(Floor):
    """Connected components of at least 8 voxels of the occupied space. `Floor` describes the parameters."""

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        labels = _largest(connected_components(self.occupied(rng, observation)), _MIN_VOXELS).astype(np.uint16)
        return Population((Hypothesis.from_labels(labels, observation.grid, observation.index),) * n)


@dataclass(frozen=True)
class ImageComponents(Floor):
    """Connected components of the image above the table. Each component is completed to a 3-D shape.

    A component has at least ``objects.min_points`` pixels. Neighbouring pixels with depths that differ by more
    than 2 cm are not connected. `Floor` describes the parameters.
    """

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        frame, grid = observation.after, observation.grid
        found = self.objects.foreground(frame, grid)
        observation = Clip((found.frame,), grid, observation.index)
        labels = self.label_image(found.frame, found.pixels)
        segments = np.arange(1, int(labels.max(initial=0)) + 1)
        particles, _ = complete_segments(
            rng, observation, [segments] * n, lambda k: labels == k, self.completer, self.threshold
        )
        return Population(particles)

    def label_image(self, frame: Frame, own: np.ndarray) -> np.ndarray:
        """Components (H, W) int32, numbered from 1, of the pixels `own` (H, W) bool; 0 elsewhere."""

        def joined(a: Any, b: Any) -> np.ndarray:
            with np.errstate(invalid="ignore"):
                near: np.ndarray = np.abs(frame.depth[a] - frame.depth[b]) <= _MAX_STEP
            return own[a] & own[b] & near

        part = connected_pixels(joined(np.s_[:, :-1], np.s_[:, 1:]), joined(np.s_[:-1], np.s_[1:]))
        return _largest(np.where(own, part + 1, 0), scaled_area(self.objects.min_points, own.size)).astype(np.int32)


def _largest(labels: np.ndarray, least: float) -> np.ndarray:
    """Labels with at least `least` elements, numbered from 1 in the same order; 0 elsewhere."""
    kept = np.bincount(labels.ravel()) >= max(1.0, least)
    kept[0] = False
    return np.where(kept, np.cumsum(kept), 0)[labels]

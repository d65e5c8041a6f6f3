"""Proposals of the baselines: three floors, and a proposal for the first pause only.

>>> FirstPause(TreeCutProposal())      # samples at the first pause, no objects afterwards
>>> OneBlob()                          # everything above the table is one object
>>> OccupiedComponents()               # connected components of the occupied space
>>> ImageComponents()                  # connected components of the image above the table

The floors use the pixels above the table and the completer, but no segmentation. A useful method is better than the
floors.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mstfilter.completion import Completer, Extrude
from mstfilter.scene import Clip, Frame, Hypothesis, scaled_area
from mstfilter.scoring import connected_components, one_blob
from mstfilter.segmentation import ObjectRule, TreeCutProposal, complete_segments, hypothesis_of
from mstfilter.smc import Population, Proposal, child


@dataclass(frozen=True)
class FirstPause(Proposal):
    """The samples of another proposal at the first pause, and later hypotheses without objects.

    The inner proposal keeps the random stream that it has without this wrapper.
    """

    proposal: Proposal = field(default_factory=TreeCutProposal)

    properly_weighted: ClassVar[bool] = False

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        if observation.index == 0:
            return self.proposal.sample(rng, observation, n)
        empty = Hypothesis(np.zeros(observation.grid.shape, np.uint16), observation.grid)
        return Population((empty,) * n)


@dataclass(frozen=True)
class OneBlob(Proposal):
    """One object of everything above the table, completed. Voxels of probability `threshold` or more are occupied."""

    completer: Completer = field(default_factory=Extrude)
    objects: ObjectRule = field(default_factory=ObjectRule)
    threshold: float = 0.5

    properly_weighted: ClassVar[bool] = False

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        labels = one_blob(_occupied(self, rng, observation))
        return Population((Hypothesis.from_labels(labels, observation.grid, observation.index),) * n)


@dataclass(frozen=True)
class OccupiedComponents(Proposal):
    """Connected components of the occupied space with at least `min_voxels` voxels; other fields as in `OneBlob`."""

    completer: Completer = field(default_factory=Extrude)
    objects: ObjectRule = field(default_factory=ObjectRule)
    threshold: float = 0.5
    min_voxels: int = 8

    properly_weighted: ClassVar[bool] = False

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        labels = connected_components(_occupied(self, rng, observation))
        kept = np.bincount(labels.ravel()) >= self.min_voxels
        kept[0] = False
        numbers = np.where(kept, np.cumsum(kept), 0)
        return Population(
            (Hypothesis.from_labels(numbers[labels].astype(np.uint16), observation.grid, observation.index),) * n
        )


@dataclass(frozen=True)
class ImageComponents(Proposal):
    """Connected components of the image above the support plane, each completed.

    ``objects.min_points`` is the size of the smallest component. Neighbouring pixels with depths that differ by more
    than `max_step` metres are not connected. Other fields are as in `OneBlob`.
    """

    completer: Completer = field(default_factory=Extrude)
    objects: ObjectRule = field(default_factory=ObjectRule)
    threshold: float = 0.5
    max_step: float = 0.02

    properly_weighted: ClassVar[bool] = False

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        frame, grid = observation.after, observation.grid
        labels = self.label_image(frame, self.objects.object_pixels(frame, grid))
        segments = np.arange(1, int(labels.max(initial=0)) + 1)
        particles, _ = complete_segments(
            rng, observation, [segments] * n, lambda k: labels == k, self.completer, self.threshold
        )
        return Population(particles)

    def label_image(self, frame: Frame, own: np.ndarray) -> np.ndarray:
        """Components (H, W) int32, numbered from 1, of the pixels `own` (H, W) bool; 0 elsewhere."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        pixel = np.arange(own.size).reshape(own.shape)
        first, second = [], []
        for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
            with np.errstate(invalid="ignore"):
                joined = own[a] & own[b] & (np.abs(frame.depth[a] - frame.depth[b]) <= self.max_step)
            first.append(pixel[a][joined])
            second.append(pixel[b][joined])
        edges = np.concatenate(first), np.concatenate(second)
        graph = coo_array((np.ones(len(edges[0]), bool), edges), shape=(own.size, own.size))
        part = connected_components(graph, directed=False)[1].reshape(own.shape)
        sizes = np.bincount(part[own], minlength=int(part.max()) + 1)
        kept = sizes >= max(1.0, scaled_area(self.objects.min_points, own.size))
        numbers = np.where(kept, np.cumsum(kept), 0)
        return np.where(own, numbers[part], 0).astype(np.int32)


def _occupied(rule: OneBlob | OccupiedComponents, rng: np.random.Generator, clip: Clip) -> np.ndarray:
    """Labels (X, Y, Z), 1 in the completed space above the table."""
    own = rule.objects.object_pixels(clip.after, clip.grid)
    completed = rule.completer.complete(child(rng, "completion"), clip.after, [own], clip.grid)
    return hypothesis_of(completed, clip.grid, clip.index, rule.threshold).labels

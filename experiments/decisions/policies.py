"""Policies: which of the candidate pushes comes next? Each sees the belief and the candidates, never the scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mstfilter import Belief
from mstfilter.simulation import FingerPush

TOLERANCE = 50  # voxels: 50 cm^3 of 1 cm voxels


def random(rng: np.random.Generator, belief: Belief, pushes: Sequence[FingerPush]) -> int:
    """Any candidate."""
    return int(rng.integers(len(pushes)))


def information(rng: np.random.Generator, belief: Belief, pushes: Sequence[FingerPush]) -> int:
    """The largest expected information about which voxels move; any candidate if the hypotheses agree."""
    regions = [push.swept(belief.grid) for push in pushes]
    best = belief.most_informative(range(len(pushes)), lambda k: belief.push_information(regions[k], TOLERANCE))
    return random(rng, belief, pushes) if best is None else best


def one_hypothesis(rng: np.random.Generator, belief: Belief, pushes: Sequence[FingerPush]) -> int:
    """By the hypothesis of least expected loss alone: the push of objects with the largest contact with others."""
    labels = belief.estimate().labels
    contact = np.zeros(int(labels.max()) + 1)
    for axis in range(3):
        a, b = (np.moveaxis(labels, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        meet = (a != b) & (a > 0) & (b > 0)
        np.add.at(contact, a[meet], 1)
        np.add.at(contact, b[meet], 1)
    return _largest(rng, [contact[_touched(labels, push.swept(belief.grid))].sum() for push in pushes])


def least_sure(rng: np.random.Generator, belief: Belief, pushes: Sequence[FingerPush]) -> int:
    """The push that touches the least sure object of the estimate: the lowest mean probability that two voxels of it
    belong together, given that both are occupied."""
    labels, occupancy = belief.estimate().labels, belief.occupancy()
    numbers = [k for k in np.unique(labels) if k > 0]
    doubt = {}
    for k in numbers:
        voxels = np.argwhere(labels == k)
        pairs = rng.integers(len(voxels), size=(2, 500))
        first, second = voxels[pairs]
        occupied = np.minimum(occupancy[tuple(first.T)], occupancy[tuple(second.T)])
        doubt[k] = 1 - float((belief.same_object(first, second) / occupied).mean())
    touched = [_touched(labels, push.swept(belief.grid)) for push in pushes]
    return _largest(rng, [max((doubt[k] for k in found), default=0.0) for found in touched])


POLICIES = {"random": random, "information": information, "one hypothesis": one_hypothesis, "least sure": least_sure}


def _touched(labels: np.ndarray, swept: np.ndarray) -> np.ndarray:
    """Objects that the finger meets if nothing moves."""
    found = np.unique(labels[swept])
    return found[found > 0]


def _largest(rng: np.random.Generator, values: Sequence[float]) -> int:
    """The index of the largest value, any of equal ones."""
    best = np.flatnonzero(np.asarray(values) == max(values))
    return int(rng.choice(best))

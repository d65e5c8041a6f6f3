"""Policies select the next push from candidates. A policy knows the belief and the candidates, but not the scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mstfilter import Belief
from mstfilter.lab.simulation import FingerPush

TOLERANCE = 50  # voxels: 50 cm^3 of 1 cm voxels


def random(rng: np.random.Generator, belief: Belief, pushes: Sequence[FingerPush]) -> int:
    """A random candidate."""
    return int(rng.integers(len(pushes)))


def information(rng: np.random.Generator, belief: Belief, pushes: Sequence[FingerPush]) -> int:
    """The push with the most expected information about which voxels move; a random one if all hypotheses agree."""
    found = expected_information(belief, pushes)
    best = belief.most_informative(range(len(pushes)), found.__getitem__)
    return random(rng, belief, pushes) if best is None else best


def one_hypothesis(rng: np.random.Generator, belief: Belief, pushes: Sequence[FingerPush]) -> int:
    """The push whose touched objects have the largest contact with other objects in the estimate."""
    return _largest(rng, contact(belief, pushes))


def least_sure(rng: np.random.Generator, belief: Belief, pushes: Sequence[FingerPush]) -> int:
    """The push with the largest `doubt`."""
    return _largest(rng, doubt(rng, belief, pushes))


def expected_information(belief: Belief, pushes: Sequence[FingerPush]) -> list[float]:
    """Expected information of each push about which voxels move, in nats."""
    return [belief.push_information(push.swept(belief.grid), TOLERANCE) for push in pushes]


def contact(belief: Belief, pushes: Sequence[FingerPush]) -> list[float]:
    """Faces of voxels between the objects that each push touches and other objects, in the estimate."""
    labels = belief.estimate().labels
    faces = np.zeros(int(labels.max()) + 1)
    for axis in range(3):
        a, b = (np.moveaxis(labels, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        meet = (a != b) & (a > 0) & (b > 0)
        np.add.at(faces, a[meet], 1)
        np.add.at(faces, b[meet], 1)
    return [faces[found].sum() for found in touched(labels, pushes, belief)]


def doubt(rng: np.random.Generator, belief: Belief, pushes: Sequence[FingerPush]) -> list[float]:
    """Largest doubt about an object of the estimate that each push touches; 0 if a push touches no object.

    The doubt about an object is 1 minus the mean probability that two of its voxels belong to one object, given that
    both are occupied.
    """
    labels, occupancy = belief.estimate().labels, belief.occupancy()
    found = {}
    for k in np.unique(labels[labels > 0]).tolist():
        voxels = np.argwhere(labels == k)
        first, second = voxels[rng.integers(len(voxels), size=(2, 500))]
        occupied = np.minimum(occupancy[tuple(first.T)], occupancy[tuple(second.T)])
        found[k] = 1 - float((belief.same_object(first, second) / occupied).mean())
    return [max((found[k] for k in objects), default=0.0) for objects in touched(labels, pushes, belief)]


def volume(belief: Belief, pushes: Sequence[FingerPush]) -> list[float]:
    """Voxels of the objects that each push touches, in the estimate."""
    labels = belief.estimate().labels
    sizes = np.bincount(labels.ravel())
    return [float(sizes[found].sum()) for found in touched(labels, pushes, belief)]


def touched(labels: np.ndarray, pushes: Sequence[FingerPush], belief: Belief) -> list[list[int]]:
    """Objects that the finger of each push meets if nothing moves."""
    return [[k for k in np.unique(labels[push.swept(belief.grid)]).tolist() if k > 0] for push in pushes]


POLICIES = {"random": random, "information": information, "one hypothesis": one_hypothesis, "least sure": least_sure}


def _largest(rng: np.random.Generator, values: Sequence[float]) -> int:
    """Index of the largest value; a random one of equal values."""
    best = np.flatnonzero(np.asarray(values) == max(values))
    return int(rng.choice(best))

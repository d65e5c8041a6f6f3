"""Similarity of hypotheses: weighted coverage of all pairs, and equality up to renamed labels.

>>> WeightedCoverage().matrix(population.particles)      # (n, n), 1 on the diagonal
>>> SameSegmentation().classes(population.particles)     # (n,) classes of equal segmentations

For the resamplers of `mstfilter.smc` that compare particles: ``KDpp(similarity=WeightedCoverage())``,
``Coalesced(equivalence=SameSegmentation())``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mstfilter.errors import InputError
from mstfilter.fusion.interfaces import Evidence
from mstfilter.scene import Clip, Hypothesis
from mstfilter.smc import Equivalence, Similarity, first_seen


def canonical(labels: np.ndarray) -> np.ndarray:
    """The same segmentation with labels 1, 2, ... in the order of their first voxel; 0 stays."""
    flat = np.asarray(labels).ravel()
    present, first = np.unique(flat, return_index=True)
    order = np.argsort(np.where(present == 0, -1, first), kind="stable")
    table = np.zeros(int(flat.max(initial=0)) + 1, np.uint16)
    table[present[order]] = np.arange(len(present)) + (0 if present[0] == 0 else 1)
    return table[flat].reshape(np.shape(labels))


@dataclass(frozen=True)
class SameSegmentation(Equivalence):
    """Hypotheses with the same regions are equal, also if their labels differ."""

    def classes(self, particles: Sequence[Hypothesis]) -> np.ndarray:
        """Classes (n,). A label grid that several particles share is compared once."""
        known: dict[int, bytes] = {}

        def key(hypothesis: Hypothesis) -> bytes:
            name = id(hypothesis.labels)
            if name not in known:
                known[name] = canonical(hypothesis.labels).tobytes()
            return known[name]

        return first_seen((key(h), h.grid.key) for h in particles)


@dataclass(frozen=True)
class WeightedCoverage(Similarity):
    """Quality of one hypothesis against the other (form ``objects`` of `mstfilter.scoring.quality`), for all pairs.

    Parameters
    ----------
    stride : int
        Uses every stride-th voxel along each axis: faster by stride^3.
    """

    stride: int = 1

    def __post_init__(self) -> None:
        if self.stride < 1:
            raise InputError(f"stride is {self.stride} voxels, expected at least 1")

    def matrix(self, particles: Sequence[Hypothesis]) -> np.ndarray:
        """Quality (n, n). Each row is one contingency table against the objects of all hypotheses."""
        step = slice(None, None, self.stride)
        grids = [h.labels[step, step, step] for h in particles]
        if len({g.shape for g in grids}) != 1:
            raise InputError("hypotheses have label grids of different shapes, expected the same for all")
        occupied = np.zeros(grids[0].shape, bool)
        for grid in grids:
            occupied |= grid > 0
        # (n, voxels) labels numbered over all hypotheses; number start[i] is the free space of i.
        flat = np.empty((len(grids), int(occupied.sum())), np.int64)
        start = np.zeros(len(grids) + 1, np.int64)
        for i, grid in enumerate(grids):
            present, compact = np.unique(np.append(grid[occupied], 0), return_inverse=True)
            flat[i] = compact[:-1] + start[i]
            start[i + 1] = start[i] + len(present)
        return _coverage(flat, start)


def _coverage(flat: np.ndarray, start: np.ndarray) -> np.ndarray:
    n, total = len(flat), int(start[-1])
    sizes = np.bincount(flat.ravel(), minlength=total)
    is_object = np.ones(total, bool)
    is_object[start[:-1]] = False
    volumes = np.add.reduceat(np.where(is_object, sizes, 0), start[:-1])
    side = np.zeros((n, n))  # side[i, j]: how well the objects of i are covered by those of j
    for i in range(n):
        own = int(start[i + 1] - start[i])
        pairs = (flat[i] - start[i])[None, :] * total + flat
        counts = np.bincount(pairs.ravel(), minlength=own * total).reshape(own, total)[1:]
        own_sizes = sizes[start[i] + 1 : start[i + 1]]
        jaccard = counts / np.maximum(own_sizes[:, None] + sizes[None, :] - counts, 1)
        jaccard[:, ~is_object] = 0.0
        best = np.maximum.reduceat(jaccard, start[:-1], axis=1) if own > 1 else np.zeros((0, n))
        side[i] = own_sizes @ best / max(int(volumes[i]), 1)
    quality = (side + side.T) / 2
    # Two empty hypotheses have quality 1; an empty and another one have 0.
    empty = volumes == 0
    quality[np.ix_(empty, empty)] = 1.0
    return quality


@dataclass(frozen=True)
class Agreement(Evidence):
    """Scores a candidate by its mean quality against the other candidates.

    It uses no data. The candidate with the largest mean quality against draws from a posterior has the least expected
    loss (minimum Bayes risk). The score concentrates the population.

    Parameters
    ----------
    strength : float
        Nats for a mean quality of 1 against the other candidates.
    similarity : Similarity
        Quality of one hypothesis against another.
    """

    strength: float = 30.0
    similarity: Similarity = WeightedCoverage()

    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        """`strength` times the mean quality (n,) against the other hypotheses."""
        n = len(hypotheses)
        if n < 2:
            return np.zeros(n)
        quality = np.asarray(self.similarity.matrix(hypotheses))
        return self.strength * (quality.sum(axis=1) - quality.diagonal()) / (n - 1)

"""Similarity of hypotheses: weighted coverage of all pairs, and equality up to renumbered labels.

>>> WeightedCoverage().matrix(population.particles)      # (n, n), 1 on the diagonal
>>> SameSegmentation().classes(population.particles)     # (n,) classes of equal segmentations

The resamplers of `mstfilter.smc` that compare particles use these components:
``Clusters(similarity=WeightedCoverage())``, ``Coalesced(equivalence=SameSegmentation())``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mstfilter.errors import InputError
from mstfilter.fields import PositiveInt
from mstfilter.scene import Hypothesis
from mstfilter.scene.partitions import canonical, common_refinement
from mstfilter.smc import Equivalence, Similarity, first_seen


@dataclass(frozen=True)
class SameSegmentation(Equivalence):
    """Hypotheses with the same regions are equal, even if their labels differ."""

    def classes(self, particles: Sequence[Hypothesis]) -> np.ndarray:
        distinct = {id(h.labels): h.labels for h in particles}
        segmentation = {k: canonical(labels).tobytes() for k, labels in distinct.items()}
        return first_seen((segmentation[id(h.labels)], h.grid.key) for h in particles)


@dataclass(frozen=True)
class WeightedCoverage(Similarity):
    """Weighted coverage (form ``objects`` of `mstfilter.scoring.quality`) of all pairs of hypotheses.

    `stride` is the step between the voxels that are used, along each axis. The time is proportional to 1 / stride^3.
    """

    stride: PositiveInt = 1

    def matrix(self, particles: Sequence[Hypothesis]) -> np.ndarray:
        step = slice(None, None, self.stride)
        grids = [h.labels[step, step, step] for h in particles]
        if len({g.shape for g in grids}) != 1:
            raise InputError("hypotheses have label grids of different shapes, expected the same for all")
        refined = common_refinement(grids)
        common = refined.overlaps()[1:, 1:]
        sizes = common.diagonal().copy()
        jaccard = common / (sizes[:, None] + sizes - common)
        objects = [slice(a, b) for a, b in pairwise(refined.first)]  # of each hypothesis
        best = np.stack([jaccard[:, k].max(axis=1, initial=0.0) for k in objects], axis=1)
        volumes = np.array([sizes[k].sum() for k in objects])
        covered = np.stack([sizes[k] @ best[k] for k in objects]) / np.maximum(volumes, 1)[:, None]
        quality = (covered + covered.T) / 2
        empty = volumes == 0
        quality[np.ix_(empty, empty)] = 1.0  # an empty and another hypothesis have quality 0
        return quality

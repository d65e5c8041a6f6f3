"""Similarity of hypotheses: weighted coverage of all pairs, and equality up to renumbered labels.

>>> WeightedCoverage().matrix(population.particles)      # (n, n), 1 on the diagonal
>>> SameSegmentation().classes(population.particles)     # (n,) classes of equal segmentations

They are for the resamplers of `mstfilter.smc` that compare particles, such as
``ClusterStratified(similarity=WeightedCoverage())`` and ``Coalesced(equivalence=SameSegmentation())``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mstfilter.base.fields import PositiveInt
from mstfilter.scene import Hypothesis
from mstfilter.scene.evidence import check_grid
from mstfilter.scene.partitions import canonical
from mstfilter.scoring import pairwise_quality
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
        for h in particles:
            check_grid("a hypothesis", h, particles[0].grid)
        return pairwise_quality([h.labels[step, step, step] for h in particles])

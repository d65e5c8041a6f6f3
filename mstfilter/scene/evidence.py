"""How well built hypotheses agree with one part of the data: the terms that score fusion's candidates.

>>> log_score = evidence.log_score(hypotheses, clip)       # (n,) nats, larger is better

Each term says which data it uses, so that none is counted twice without anyone knowing. The terms stand where
their data are computed: boundaries in `mstfilter.segmentation.evidence`, motions in `mstfilter.tracking.evidence`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from mstfilter.scene.clip import Clip
from mstfilter.scene.voxels import Hypothesis

__all__ = ["Division", "Evidence"]


class Evidence(ABC):
    """One term of a candidate's score."""

    @abstractmethod
    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        """(n,) log score of hypotheses about the end of a clip, in nats up to a common constant."""


class Division(ABC):
    """Tells apart what a clip has shown to be different things."""

    @abstractmethod
    def divide(self, clip: Clip) -> np.ndarray | None:
        """(H, W) int32 of the clip's last frame: pixels with different numbers >= 0 are not one thing; -1 unknown.

        None where it can say nothing at all.
        """

"""Interfaces of the parts of fusion that a user can replace.

- `Evidence` scores built candidates against one part of the data.
- `Division` groups the pixels of a frame by what a clip has shown to be different objects.

>>> log_score = evidence.log_score(hypotheses, clip)       # (n,) nats, larger is better
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from mstfilter.scene import Clip, Hypothesis

__all__ = ["Division", "Evidence"]


class Evidence(ABC):
    """One term of the score of a candidate.

    The documentation of a term states which data it uses, so that users see which data are counted twice.
    """

    @abstractmethod
    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        """Log score (n,) of hypotheses about the end of a clip, in nats, up to a common constant."""


class Division(ABC):
    """Groups the pixels of a frame by object, as far as the clip shows it."""

    @abstractmethod
    def divide(self, clip: Clip) -> np.ndarray | None:
        """Group the pixels of the last frame of a clip.

        Returns
        -------
        (H, W) int32 or None
            Pixels with different numbers >= 0 belong to different objects; -1 is unknown. None if the clip
            shows nothing, for example a single frame.
        """

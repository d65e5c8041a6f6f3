"""A term of the score of candidates, for the update of `mst`.

mstfilter check ./evidence.py:MyEvidence
mstfilter run demo/recording 'update.evidence=["./evidence.py:MyEvidence"]' --out runs/mine --replace
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mstfilter.mst.testing import scene_example
from mstfilter.scene import Clip, Evidence, Hypothesis


@dataclass(frozen=True)
class MyEvidence(Evidence):
    """Small objects are unlikely. It uses no image. Fields need an annotation and a default.

    Parameters
    ----------
    small : int
        Objects with fewer voxels are small.
    cost : float
        Log score of a small object, in nats.
    """

    small: int = 30
    cost: float = 2.0

    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        """(n,) log scores in nats of hypotheses about the end of the clip; finite, larger is better."""
        n_small = [sum(volume < self.small for volume in h.volumes().values()) for h in hypotheses]
        return -self.cost * np.array(n_small, dtype=np.float64)


#: Input for the contract: hypotheses of a scene, and a clip.
example = scene_example

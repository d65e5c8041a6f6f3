"""A similarity of scenes, for resamplers that compare hypotheses.

mstfilter check ./similarity.py:MySimilarity
mstfilter run demo/recording resampler=clusters resampler.similarity=./similarity.py:MySimilarity --replace
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mstfilter.mst.testing import scene_example
from mstfilter.scene import Hypothesis
from mstfilter.smc import Similarity


@dataclass(frozen=True)
class MySimilarity(Similarity):
    """Similarity of the numbers of objects. Fields need an annotation and a default.

    Parameters
    ----------
    scale : float
        Difference of the numbers of objects at which the similarity is 1/e.
    """

    scale: float = 2.0

    def matrix(self, particles: Sequence[Hypothesis]) -> np.ndarray:
        """(n, n) symmetric similarities in [0, 1], 1 on the diagonal."""
        n_objects = np.array([h.n_objects for h in particles])
        return np.exp(-np.abs(n_objects[:, None] - n_objects) / self.scale)


#: Input for the contract: hypotheses of a scene, and a clip (not used here).
example = scene_example

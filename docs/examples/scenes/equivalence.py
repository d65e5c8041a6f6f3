"""An equivalence of scenes: hypotheses that count as equal are merged by the resampler `coalesced`.

mstfilter check ./equivalence.py:MyEquivalence
mstfilter run demo/recording resampler=coalesced resampler.equivalence=./equivalence.py:MyEquivalence --replace
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mstfilter.mst.testing import scene_example
from mstfilter.scene import Hypothesis
from mstfilter.smc import Equivalence, first_seen


@dataclass(frozen=True)
class MyEquivalence(Equivalence):
    """Hypotheses with objects of about the same volumes are equal. Fields need an annotation and a default.

    Parameters
    ----------
    step : int
        Volumes are rounded to multiples of this number of voxels.
    """

    step: int = 50

    def classes(self, particles: Sequence[Hypothesis]) -> np.ndarray:
        """(n,) int: class of each particle, numbered from 0 in the order of first occurrence."""
        return first_seen(tuple(sorted(round(v / self.step) for v in h.volumes().values())) for h in particles)


#: Input for the contract: hypotheses of a scene, and a clip (not used here).
example = scene_example

"""A proposal of scenes: new hypotheses from the last image of a clip.

mstfilter check ./proposal.py:MyProposal
mstfilter run demo/recording proposal=./proposal.py:MyProposal --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from mstfilter.mst.testing import scene_example
from mstfilter.scene import Clip, Hypothesis
from mstfilter.smc import Population, Proposal


@dataclass(frozen=True)
class MyProposal(Proposal):
    """Connected components of the voxels above a random height. Fields need an annotation and a default.

    Parameters
    ----------
    lowest, highest : float
        Range of the height, in metres above the table. Touching objects come apart above the place where they touch.
    min_voxels : int
        Smaller components are no objects.
    """

    lowest: float = 0.01
    highest: float = 0.06
    min_voxels: int = 10

    # The weights are not those of draws from a model.
    properly_weighted = False

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        """Draw exactly n hypotheses about the end of the clip."""
        frame, grid = observation.after, observation.grid
        points = frame.points[frame.valid]  # (k, 3) world metres, z is the height above the table
        hypotheses = []
        # Random numbers come from rng only.
        for height in rng.uniform(self.lowest, self.highest, size=n):
            voxels = grid.index_of(points[points[:, 2] > height])
            voxels = voxels[grid.contains(voxels)]
            occupied = np.zeros(grid.shape, bool)
            occupied[tuple(voxels.T)] = True
            # The space below a visible surface belongs to the object.
            occupied = np.maximum.accumulate(occupied[:, :, ::-1], axis=2)[:, :, ::-1]
            labels, count = ndimage.label(occupied)
            sizes = np.bincount(labels.ravel(), minlength=count + 1)
            labels[sizes[labels] < self.min_voxels] = 0
            hypotheses.append(Hypothesis.from_labels(labels, grid, birth=observation.index))
        return Population(tuple(hypotheses), np.zeros(n))


#: Input for the contract: hypotheses of a scene (not used here), and a clip.
example = scene_example

"""A cut sampler: draws segmentations from a tree with node values.

mstfilter check ./sampler.py:MySampler
mstfilter run demo/recording proposal.sampler=./sampler.py:MySampler --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.mst.segmentation import CutSample, CutSampler, Tree, optimal_cut


@dataclass(frozen=True)
class MySampler(CutSampler):
    """The best cut for values with random noise. Fields need an annotation and a default.

    Parameters
    ----------
    noise : float
        Scale of the Gumbel noise that is added to the value of every node.
    """

    noise: float = 1.0

    def sample(self, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int) -> CutSample:
        """Draw n cuts; a cut is an ascending array of nodes that covers every leaf once."""
        # Random numbers come from rng only.
        cuts = tuple(optimal_cut(tree, w + self.noise * rng.gumbel(size=len(w))) for _ in range(n))
        # log_p is the log probability relative to the best cut, as far as it is known.
        return CutSample(cuts, np.zeros(n))

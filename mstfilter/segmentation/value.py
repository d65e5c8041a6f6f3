"""How much a region looks like one object: the node values w that the cuts maximise or sample.

>>> w = SceneCutObjectness().values(tree, frame)      # (N,), higher is better
>>> best = optimal_cut(tree, w)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Frame
from mstfilter.segmentation.background import above_table
from mstfilter.segmentation.interfaces import CutValue
from mstfilter.segmentation.tree import Tree

__all__ = ["MergeLogOdds", "SceneCutObjectness"]


@dataclass(frozen=True)
class SceneCutObjectness(CutValue):
    """SceneCut's objectness: regions that form early and end late (Pham et al. 2018, eq. 4-5).

    ``s = 0.5 exp(-(start / start_scale)^2) exp(-((1 - end) / end_scale)^2)``, ``w = ln(s) area^power``; a region
    outside the area limits gets ``s = floor``. SceneCut's second term, a model of planes the size of furniture,
    is left out: on a tabletop the support plane is found directly and taken away as background.

    Parameters
    ----------
    start_scale : float
        Tolerance for boundaries inside the region, in P(boundary).
    end_scale : float
        Tolerance for a weak outer boundary, in P(boundary).
    power : float
        Exponent of the area; below 1 favours larger regions.
    floor : float
        Objectness of a region outside the area limits.
    min_area, max_area : float
        Area limits as shares of the image. SceneCut's 1000 and 150,000 px at 640 x 480.
    background_weight : float
        What a pixel that is not above the table counts in areas. 1 is SceneCut's plain area. At 1 the table makes
        up most of v*, and since the width of the sampled law is set relative to v*, a larger table would mean
        wilder samples; at 0 cuts of the table would cost nothing and chains would waste their steps on them.
    table_tolerance : float
        Readings up to this much above the table are table, in sensor disparity units.
    """

    start_scale: float = 0.3
    end_scale: float = 0.7
    power: float = 0.95
    floor: float = 1e-3
    min_area: float = 1000 / 307200
    max_area: float = 150000 / 307200
    background_weight: float = 0.003
    table_tolerance: float = 2.0

    def __post_init__(self) -> None:
        for name in ("start_scale", "end_scale", "power", "floor"):
            if not getattr(self, name) > 0:
                raise InputError(f"objectness {name} is {getattr(self, name)!r}, expected a number > 0")

    def values(self, tree: Tree, frame: Frame) -> np.ndarray:
        """``ln(s) area^power`` of every node."""
        area = tree.area.astype(np.float64)
        if self.background_weight < 1:
            with np.errstate(invalid="ignore"):
                above = frame.valid & (above_table(frame) > self.table_tolerance)
            own = tree.accumulate_pixels(above).astype(np.float64)
            background = self.background_weight * (area - own)
            limited = own > background
            area = own + background
        else:
            limited = np.ones(len(area), dtype=bool)
        share = area / tree.leaves.size
        log_s = np.log(0.5) - (tree.start / self.start_scale) ** 2 - ((1 - tree.end) / self.end_scale) ** 2
        odd = limited & ((share < self.min_area) | (share > self.max_area))
        return np.where(odd, np.log(self.floor), log_s) * area**self.power


@dataclass(frozen=True)
class MergeLogOdds(CutValue):
    """Each merge of the tree judged by itself: the log likelihood of independent splits.

    ``w(n) = -sum of logit P(boundary) over the merges inside n``: exp(v(c)) is, up to a constant, the
    probability that exactly the merges above the cut join different objects. Additive, in natural units: cuts are
    sampled at a temperature, without a scale sigma. Where the tree carries log odds of its own (`LearnedTree`),
    they are taken; else the strength `start` counts as the probability.

    Parameters
    ----------
    clip : float
        Probabilities are kept in clip .. 1 - clip.
    """

    clip: float = 1e-3

    def values(self, tree: Tree, frame: Frame) -> np.ndarray:
        """Sums of minus the log odds of all merges inside each node."""
        if tree.odds is None:
            p = np.clip(tree.start, self.clip, 1 - self.clip)
            own = -(np.log(p) - np.log1p(-p))
        else:
            bound = np.log1p(-self.clip) - np.log(self.clip)
            own = -np.clip(tree.odds, -bound, bound)
        own[: tree.n_leaves] = 0.0
        total = own.tolist()
        parent = tree.parent.tolist()
        for i in range(tree.n_nodes - 1):
            total[parent[i]] += total[i]
        return np.array(total)

"""Cuts of a segmentation tree: node values, the optimal cut, and exact samples.

A `CutValue` gives every node a value w, and a cut has the sum of the values of its nodes, v(c) = sum w. `optimal_cut`
finds the cut of largest value; a `CutSampler` draws cuts at random.

>>> w = MergeLogOdds().values(tree, frame)                     # (N,), higher is better
>>> best = optimal_cut(tree, w)                                # ascending nodes
>>> sample = ExactCuts().sample(np.random.default_rng(0), tree, w, 10)

In a Gibbs distribution with inverse temperature b, a cut has a probability in proportion to exp(b v(c)). Trees allow
exact samples of it: one pass up the tree computes ``stop[n]``, the probability that a cut contains node n if it
contains no ancestor of n, and a random walk down from the root, which stops with these probabilities, draws a cut.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from math import exp, log1p
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import PositiveFloat
from mstfilter.base.results import Checked, check_array, check_list, check_type, returns
from mstfilter.mst.segmentation.tree import Tree
from mstfilter.scene import Frame, pixels_above_table, scaled_area

# Constants of `SceneCutObjectness`.
_START_SCALE = 0.3  # tolerance for boundaries inside the region, in P(boundary)
_END_SCALE = 0.7  # tolerance for a weak outer boundary, in P(boundary)
_POWER = 0.95  # exponent of the area; below 1 favours larger regions
_FLOOR = 1e-3  # objectness of a region outside the area limits
_MIN_AREA, _MAX_AREA = 1000, 150000  # pixels of a 640 x 480 image

_CLIP = 1e-3  # `MergeLogOdds` clips probabilities to _CLIP .. 1 - _CLIP


class CutValue(Checked, ABC):
    """Rates how well a region corresponds to one object."""

    @returns(lambda self, found, tree, frame: check_array(found, (tree.n_nodes,)))
    @abstractmethod
    def values(self, tree: Tree, frame: Frame) -> np.ndarray:
        """(N,) value w of every node."""


@dataclass(frozen=True)
class SceneCutObjectness(CutValue):
    """SceneCut's objectness: high for weak inner and strong outer boundaries (Pham et al. 2018, eq. 4-5).

    ``s = 0.5 exp(-(start / 0.3)^2) exp(-((1 - end) / 0.7)^2)`` and ``w = ln(s) area^0.95``. A region smaller than
    1000 or larger than 150,000 pixels of a 640 x 480 image gets ``s = 0.001``. SceneCut's second term, a model of
    planes with the size of furniture, is omitted. Pixels on the support plane are background.

    Parameters
    ----------
    background_weight : float
        Area of each pixel that is not above the table. With 1, as in SceneCut, the table contributes most of the
        optimal value v*. Since the width of the sampled distribution is relative to v*, a larger table then gives
        more random cuts. With 0, splits of the table do not change the value, and Markov chains waste steps on them.
    """

    background_weight: float = 0.003

    def values(self, tree: Tree, frame: Frame) -> np.ndarray:
        area = tree.area.astype(np.float64)
        if self.background_weight < 1:
            foreground = tree.accumulate_pixels(pixels_above_table(frame)).astype(np.float64)
            background = self.background_weight * (area - foreground)
            limited = foreground > background
            area = foreground + background
        else:
            limited = np.ones(len(area), dtype=bool)
        smallest, largest = (scaled_area(limit, tree.leaves.size) for limit in (_MIN_AREA, _MAX_AREA))
        log_s = np.log(0.5) - (tree.start / _START_SCALE) ** 2 - ((1 - tree.end) / _END_SCALE) ** 2
        outside = limited & ((area < smallest) | (area > largest))
        return np.where(outside, np.log(_FLOOR), log_s) * area**_POWER


@dataclass(frozen=True)
class MergeLogOdds(CutValue):
    """Log likelihood of independent merge decisions.

    ``w(n) = -sum of logit P(boundary) over the merges inside n``. The probability that exactly the merges above the
    cut join different objects is proportional to exp(v(c)). The values are log probabilities, so the sampler needs a
    `temperature` but no scale `sigma2`. The logits are the `odds` of the tree if it has them (`LearnedTree`), else
    those of its `start`. Probabilities are clipped to 0.001 .. 0.999.
    """

    def values(self, tree: Tree, frame: Frame) -> np.ndarray:
        if tree.odds is None:
            p = np.clip(tree.start, _CLIP, 1 - _CLIP)
            merge = -(np.log(p) - np.log1p(-p))
        else:
            bound = np.log1p(-_CLIP) - np.log(_CLIP)
            merge = -np.clip(tree.odds, -bound, bound)
        merge[: tree.n_leaves] = 0.0
        return tree.accumulate_nodes(merge)


@dataclass(frozen=True, eq=False)
class CutSample:
    """Cuts drawn from a tree."""

    cuts: tuple[np.ndarray, ...]  #: ascending nodes of each cut
    log_p: np.ndarray  #: (n,) log of the sampler's target law relative to the optimal cut
    diagnostics: dict[str, Any] = field(default_factory=dict)  #: statistics of the draw; JSON types only


def _check_cuts(
    self: CutSampler, found: CutSample, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int
) -> CutSample:
    check_type(found, CutSample, "a CutSample")
    check_array(found.log_p, (n,), at_most=np.inf)
    for k, cut in enumerate(check_list(found.cuts, n, np.ndarray, "an array of nodes")):
        covered = tree.area[cut].sum() if cut.dtype.kind in "iu" and cut.max(initial=-1) < tree.n_nodes else 0
        if covered != tree.leaves.size:
            raise InputError(
                f"returns as cut {k} no partition of the image: its nodes cover {covered} of "
                f"{tree.leaves.size} pixels"
            )
    return found


class CutSampler(Checked, ABC):
    """Draws segmentations from a tree with node values."""

    @returns(_check_cuts)
    @abstractmethod
    def sample(self, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int) -> CutSample:
        """Draw `n` cuts of the tree under node values `w` (N,)."""


def check_values(tree: Tree, w: np.ndarray) -> np.ndarray:
    """Node values as float64 (N,); raises InputError if the shape is wrong or a value is not finite."""
    w = np.asarray(w, dtype=np.float64)
    if w.shape != (tree.n_nodes,):
        raise InputError(f"node values have shape {w.shape}, the tree has {tree.n_nodes} nodes")
    if not np.isfinite(w).all():
        raise InputError(f"value of tree node {int(np.flatnonzero(~np.isfinite(w))[0])} is not finite")
    return w


def optimal_cut(tree: Tree, w: np.ndarray) -> np.ndarray:
    """The cut of largest value, as nodes (n,) in ascending order, for node values `w` (N,).

    If a node has the same value as the best cut of its subtree, the node is taken: fewer segments.
    """
    best = check_values(tree, w).tolist()
    keep = [True] * tree.n_nodes
    for node in range(tree.n_leaves, tree.n_nodes):
        split = sum(best[child] for child in tree.children[node])
        # The tolerance is larger than the rounding error of the sum.
        if split > best[node] + 1e-12 * abs(split):
            best[node], keep[node] = split, False
    cut, stack = [], [tree.root]
    while stack:
        node = stack.pop()
        if keep[node]:
            cut.append(node)
        else:
            stack.extend(tree.children[node])
    return np.sort(np.array(cut, dtype=np.int64))


@dataclass(frozen=True)
class OptimalCut(CutSampler):
    """The optimal cut `n` times, without randomness: the single-frame baseline (SceneCut)."""

    def sample(self, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int) -> CutSample:
        cut = optimal_cut(tree, w)
        return CutSample((cut,) * n, np.zeros(n), {"size_of_best": len(cut)})


@dataclass(frozen=True, eq=False)
class Gibbs:
    """A Gibbs distribution over the cuts of a tree and of its subtrees. Each list has one entry per node."""

    tree: Tree
    b: float  #: inverse temperature, per unit of value
    w: list[float]  #: node values
    log_z: list[float]  #: log normaliser of the subtree
    stop: list[float]  #: probability that a cut without an ancestor of the node contains the node

    def draw(self, random: Callable[[], float], node: int) -> list[int]:
        """Draw a cut of the subtree of `node`, with unordered nodes. ``random()`` is uniform in [0, 1)."""
        children, stop = self.tree.children, self.stop
        cut, stack = [], [node]
        while stack:
            node = stack.pop()
            if random() < stop[node]:
                cut.append(node)
            else:
                stack.extend(children[node])
        return cut

    def log_prob(self, cut: list[int], node: int) -> float:
        """Log probability of a cut of the subtree of `node`."""
        return self.b * sum(self.w[x] for x in cut) - self.log_z[node]


def gibbs(tree: Tree, w: np.ndarray, b: float) -> Gibbs:
    """The Gibbs distribution with inverse temperature `b` under node values `w` (N,)."""
    values, n = w.tolist(), tree.n_nodes
    log_z, stop = [b * value for value in values], [1.0] * n
    for node in range(tree.n_leaves, n):
        keep, split = log_z[node], sum(log_z[child] for child in tree.children[node])
        # log Z = log(exp(keep) + exp(split)), stable for either order of magnitude.
        log_z[node] = max(keep, split) + log1p(exp(-abs(keep - split)))
        stop[node] = exp(keep - log_z[node])
    return Gibbs(tree, b, values, log_z, stop)


@dataclass(frozen=True)
class ExactCuts(CutSampler):
    """Independent exact draws from the Gibbs distribution exp(v / temperature)."""

    temperature: PositiveFloat = 1.0

    def sample(self, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int) -> CutSample:
        w = check_values(tree, w)
        law = gibbs(tree, w, 1 / self.temperature)
        cuts = [np.sort(np.array(law.draw(rng.random, tree.root), dtype=np.int64)) for _ in range(n)]
        best = w[optimal_cut(tree, w)].sum()
        log_p = np.array([w[cut].sum() - best for cut in cuts]) / self.temperature
        distinct = len({cut.tobytes() for cut in cuts}) / max(n, 1)
        return CutSample(tuple(cuts), log_p, {"distinct": distinct})

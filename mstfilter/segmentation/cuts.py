"""Cuts of a segmentation tree: node values, the optimal cut, and exact samples.

A `CutValue` gives every node a value w; the value of a cut is the sum over its nodes, v(c) = sum w. `optimal_cut`
maximises it, a `CutSampler` draws cuts at random.

>>> w = MergeLogOdds().values(tree, frame)                     # (N,), higher is better
>>> best = optimal_cut(tree, w)                                # ascending nodes
>>> sample = ExactCuts().sample(np.random.default_rng(0), tree, w, 10)

Under a Gibbs law with inverse temperature b, a cut has probability proportional to exp(b v(c)). One pass up the tree
gives the probability ``stop[n]`` that a cut which reaches node n contains n itself. A walk down from the root with
these probabilities draws a cut exactly.

The law of the paper is exp(-d^2 / s2), where d = v* - v(c) is the difference to the value v* of the optimal cut.
`ExactCuts` draws from it by rejection, because a scaled Gibbs law bounds it for any b:
``exp(-d^2 / s2) <= exp(-b d + b^2 s2 / 4)``. A Gibbs draw is accepted with probability
``exp(-(d - b s2 / 2)^2 / s2)``; accepted draws are exact and independent. The acceptance rate is highest for the b
that solves ``b = 2 E_b[d] / s2``, with E_b the mean under the Gibbs law.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from math import exp, log1p
from typing import Any, TypeVar

import numpy as np

from mstfilter.errors import InputError, check_number
from mstfilter.results import Checked, check_array, check_list, check_type, returns
from mstfilter.scene import Frame
from mstfilter.segmentation.boundary import pixels_above_table
from mstfilter.segmentation.tree import Tree

_MAX_TRIES = 100000  # Gibbs draws of `ExactCuts` for each cut

# Constants of `SceneCutObjectness`.
_START_SCALE = 0.3  # tolerance for boundaries inside the region, in P(boundary)
_END_SCALE = 0.7  # tolerance for a weak outer boundary, in P(boundary)
_POWER = 0.95  # exponent of the area; below 1 favours larger regions
_FLOOR = 1e-3  # objectness of a region outside the area limits
_MIN_AREA, _MAX_AREA = 1000 / 307200, 150000 / 307200  # fractions of the image

_CLIP = 1e-3  # `MergeLogOdds` clips probabilities to _CLIP .. 1 - _CLIP

_Value = TypeVar("_Value", float, np.ndarray)


class CutValue(Checked, ABC):
    """Rates how well a region fits one object."""

    @returns(lambda self, found, tree, frame: check_array(found, (tree.n_nodes,)))
    @abstractmethod
    def values(self, tree: Tree, frame: Frame) -> np.ndarray:
        """(N,) value w of every node."""


@dataclass(frozen=True)
class SceneCutObjectness(CutValue):
    """SceneCut's objectness: regions that form early and end late (Pham et al. 2018, eq. 4-5).

    ``s = 0.5 exp(-(start / 0.3)^2) exp(-((1 - end) / 0.7)^2)``, ``w = ln(s) area^0.95``; a region smaller than 1000
    or larger than 150,000 pixels of a 640 x 480 image gets ``s = 0.001``. SceneCut's second term, a model of planes
    the size of furniture, is omitted: on a tabletop the support plane is found directly and removed as background.

    Parameters
    ----------
    background_weight : float
        Area of a pixel that is not above the table; 1 in SceneCut. With 1 the table contributes most of v*. The width
        of the sampled law is relative to v*, so a larger table gives more random samples. With 0 cuts of the
        table have no cost, and chains spend their steps on them.
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
        fraction = area / tree.leaves.size
        log_s = np.log(0.5) - (tree.start / _START_SCALE) ** 2 - ((1 - tree.end) / _END_SCALE) ** 2
        outside = limited & ((fraction < _MIN_AREA) | (fraction > _MAX_AREA))
        return np.where(outside, np.log(_FLOOR), log_s) * area**_POWER


@dataclass(frozen=True)
class MergeLogOdds(CutValue):
    """Log likelihood of independent merge decisions.

    ``w(n) = -sum of logit P(boundary) over the merges inside n``: exp(v(c)) is, up to a constant, the
    probability that exactly the merges above the cut join different objects. The values are log probabilities, so
    cuts are sampled at a temperature, without a scale sigma. The odds of the tree are used if it has any
    (`LearnedTree`); else `start` is the probability. Probabilities are clipped to 0.001 .. 0.999.
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
    values: np.ndarray  #: (n,) v(c) of each cut
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


def check_target_law(sigma2: float, temperature: float) -> None:
    """Raise InputError unless sigma2 > 0 and temperature >= 0."""
    check_number("sigma2", sigma2, above=0)
    check_number("temperature", temperature, at_least=0)


def optimal_cut(tree: Tree, w: np.ndarray) -> np.ndarray:
    """Ascending nodes (n,) of the cut of largest value, for node values `w` (N,), by one pass up the tree.

    If parent and children tie, the parent is kept.
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
    """The optimal cut, `n` times, without randomness. The single-frame baseline (SceneCut)."""

    def sample(self, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int) -> CutSample:
        cut = optimal_cut(tree, w)
        value = float(np.asarray(w, dtype=np.float64)[cut].sum())
        return CutSample((cut,) * n, np.full(n, value), np.zeros(n), {"size_of_best": len(cut)})


@dataclass(frozen=True, eq=False)
class Gibbs:
    """A Gibbs law over the cuts of a tree and of its subtrees; lists have one entry per node."""

    tree: Tree
    b: float  #: inverse temperature, per unit of value
    w: list[float]  #: node values
    log_z: list[float]  #: log normaliser of the subtree
    stop: list[float]  #: probability that a cut which reaches the node contains the node itself
    mean: list[float]  #: expected value of the part of a cut inside the subtree

    def draw(self, random: Callable[[], float], node: int) -> list[int]:
        """Draw a cut of the subtree of `node`, unordered; `random` returns uniform numbers in [0, 1)."""
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
    """The Gibbs law with inverse temperature `b` under node values `w` (N,)."""
    values, n = w.tolist(), tree.n_nodes
    log_z, stop, mean = [0.0] * n, [1.0] * n, [0.0] * n
    for node, children in enumerate(tree.children):
        keep = b * values[node]
        if not children:
            log_z[node], mean[node] = keep, values[node]
            continue
        split = inner = 0.0
        for child in children:
            split += log_z[child]
            inner += mean[child]
        # log Z = log(exp(keep) + exp(split)), stable for either order of magnitude.
        if keep >= split:
            log_z[node] = keep + log1p(exp(split - keep))
        else:
            log_z[node] = split + log1p(exp(keep - split))
        stop[node] = p = exp(keep - log_z[node])
        mean[node] = p * values[node] + (1 - p) * inner
    return Gibbs(tree, b, values, log_z, stop, mean)


def best_envelope(tree: Tree, w: np.ndarray, best: float, s2: float) -> Gibbs:
    """The Gibbs law with the highest acceptance rate: b = 2 E_b[best - v] / s2, by bisection in log b."""
    low = 0.0
    high = 2 * (best - gibbs(tree, w, 0.0).mean[-1]) / s2
    law = gibbs(tree, w, high)
    for _ in range(60):
        middle = (low * high) ** 0.5 if low > 0 else high / 64
        law = gibbs(tree, w, middle)
        if middle * s2 > 2 * (best - law.mean[-1]):
            high = middle
        else:
            low = middle
        # The sampler is exact for any b; a tolerance of 1 % does not change the acceptance rate.
        if high <= 0 or (low > 0 and high / low < 1.01):
            break
    return law


def proposal_law(tree: Tree, w: np.ndarray, best: float, s2: float, temperature: float) -> Gibbs:
    """The target itself if it is a Gibbs law (temperature > 0), else the best envelope of the law of the paper."""
    return gibbs(tree, w, 1 / temperature) if temperature > 0 else best_envelope(tree, w, best, s2)


def log_target(value: _Value, best: float, s2: float, temperature: float) -> _Value:
    """Log probability of cuts with these values relative to the optimal cut."""
    if temperature > 0:
        return (value - best) / temperature
    return -((best - value) ** 2) / s2


@dataclass(frozen=True)
class ExactCuts(CutSampler):
    """Independent exact draws from exp(-(v* - v)^2 / s2), or from exp(v / temperature).

    Parameters
    ----------
    sigma2 : float
        s2 relative to the squared value of the optimal cut: ``s2 = sigma2 v*^2``. No unit.
    temperature : float
        0: the law of the paper. > 0: the Gibbs law at this temperature, in units of value; no draw is rejected and
        sigma2 is not used.
    """

    sigma2: float = 1e-3
    temperature: float = 0.0

    def __post_init__(self) -> None:
        check_target_law(self.sigma2, self.temperature)

    def sample(self, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int) -> CutSample:
        best = float(check_values(tree, w)[optimal_cut(tree, w)].sum())
        s2 = max(self.sigma2 * best**2, 1e-300)
        law = proposal_law(tree, w, best, s2, self.temperature)
        cuts: list[np.ndarray] = []
        values: list[float] = []
        tries = 0
        while len(cuts) < n:
            tries += 1
            if tries > _MAX_TRIES * n:
                raise InputError(
                    f"exact cut sampler accepted {len(cuts)} of {tries - 1} draws, {n} are needed",
                    "use the `mh` sampler for this tree",
                )
            cut = law.draw(rng.random, tree.root)
            d = best - sum(law.w[x] for x in cut)
            if self.temperature > 0 or rng.random() < exp(-((d - law.b * s2 / 2) ** 2) / s2):
                cuts.append(np.sort(np.array(cut, dtype=np.int64)))
                values.append(best - d)
        v = np.array(values)
        diagnostics = {
            "acceptance": n / tries if tries else 1.0,
            "distinct": len({c.tobytes() for c in cuts}) / max(n, 1),
        }
        return CutSample(tuple(cuts), v, log_target(v, best, s2, self.temperature), diagnostics)

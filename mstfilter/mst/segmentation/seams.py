"""A segmentation tree in which both readings of an ambiguous region exist: one object, or two that touch.

A tree of merged regions follows the borders that can be seen. Two boxes side by side may show none, so such a tree
has no node for each of them, and no sample of it can be right if they are two. A box with two prints shows a border
that is none. `SeamTree` therefore looks again at the regions that its base tree joins, or divides without certainty.
It collects the ways to divide each (`mstfilter.mst.segmentation.divisions`), and a small network, the judge, gives
the probabilities of "one object" and of each division. The most probable division becomes the first of the tree
below this region, with the log odds of "not one" as its odds; the two sides are then examined in the same way. Where
the base tree has a clear division, this stays, and only its odds are those of the judge. What something nearer
divides is joined as by the base tree (`mstfilter.mst.segmentation.hidden`).

>>> tree = SeamTree().build(boundary, frame)
>>> w = MergeLogOdds().values(tree, frame)

**The prior.** The judge's odds are those where one object and several are equally frequent. How often what may be
several is one differs from table to table: office things have many parts, groceries in a row are many things. So the
share of "one" is unknown in each image, with a Beta distribution of mean `one_share` that is worth `prior_size`
regions, and the regions of the image tell more about it (`SharedPrior`). Where the share is known, give it with a
large `prior_size`:

>>> tree = SeamTree(one_share=0.3, prior_size=1000)     # seven of ten are several, whatever the image shows
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import log
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
from scipy.special import expit

from mstfilter.base.errors import InputError
from mstfilter.base.fields import Bounds, PositiveFloat, Share
from mstfilter.mst.segmentation.divisions import SeamImage, TreePart, division_overlap, divisions
from mstfilter.mst.segmentation.learned_tree import BorderTree, tree_of_merges
from mstfilter.mst.segmentation.regions import Regions, measure_regions
from mstfilter.mst.segmentation.seam_measures import SeamMeasures
from mstfilter.mst.segmentation.tree import Merge, Tree, TreeBuilder
from mstfilter.scene import Frame, pixels_above_table, scaled_area

if TYPE_CHECKING:
    from mstfilter.mst.segmentation.seam_network import SeamNetwork

_CERTAIN = 7.0  # log odds: merges of the base tree above this stay as they are
_CLEAR = 3.0  # log odds: above this the sides of a merge stay, and only its odds are judged
_KNOWN = -6.0  # log odds: merges of the base tree below this are no divisions to examine
_SURE = -5.0  # most log odds of merges inside a region that is judged to be one object
_LEAST_PIXELS = 400  # of a region that is examined, in an image of 640 x 480
_MOST_DEPTH = 4  # divisions of a region that follow one another
_FOLLOWED = -1.5  # log odds of a division above which its sides are examined
_SAME_DIVISION = 0.7  # overlap from which the most probable division is that of the base tree
_MOST_MERGES = 8  # of the base tree that are examined in a region
_SHARES = 200  # values of the share of "one"
_RARE = 1e-12  # least probability of one object, and of several


@dataclass(frozen=True)
class SeamTree(TreeBuilder):
    """A tree whose uncertain regions are divided along seams.

    Parameters
    ----------
    base : BorderTree
        The tree whose regions are examined.
    weights : str
        Name of a trained model of the package, or the path of a model folder: the judge.
    one_share : float
        Prior probability that what may be one object or several is one.
    prior_size : float
        Number of regions that the prior is worth. The default of both was fitted to simulated scenes and real images.
    least : float
        A region is divided in the tree if the probability that it is several objects is at least this.
    """

    base: BorderTree = field(default_factory=BorderTree)
    weights: str = "seams"
    one_share: Annotated[float, Bounds(above=0, below=1)] = 0.85
    prior_size: PositiveFloat = 3.5
    least: Share = 0.02

    @property
    def bound_key(self) -> bytes:
        """Hash of the models. The hash is part of the keys of cached values."""
        return self.base.bound_key + self._judge().key.encode()

    def build(self, boundary: np.ndarray, frame: Frame | None = None, pixels: np.ndarray | None = None) -> Tree:
        """The tree of merged regions with examined seams; `odds` as in `MergedTree.build`."""
        if frame is None:
            raise InputError(
                f"{type(self).__name__} needs the frame of the boundary map", "tree.build(boundary, frame)"
            )
        pixels = pixels_above_table(frame) if pixels is None else pixels
        seen = self.base.look(frame)
        regions = self.base.regions(boundary, frame, pixels, seen)
        image, merges = SeamImage.of(frame, boundary, seen), self.base.merges(regions)
        leaves, merges = _Examination(self, self._judge(), image, regions, merges).tree()
        divided = measure_regions(leaves, frame, boundary, seen)
        merges = self.base.joined(by_odds(merges, len(divided.sums)), divided, frame)
        return tree_of_merges(leaves, len(divided.sums), merges)

    def _judge(self) -> SeamNetwork:
        from mstfilter.mst.segmentation.seam_network import load_seam_network

        return load_seam_network(self.weights)


@dataclass(frozen=True, eq=False)
class SharedPrior:
    """What the regions of an image say of one another: the share of "one" among them is the same, and unknown.

    Given the share p, a region that is several objects with log odds l where both are equally frequent is one object
    with probability ``p (1 - s) / (p (1 - s) + (1 - p) s)``, s = expit(l). The share has a Beta distribution.
    """

    shares: np.ndarray  #: (k,) values of the share
    weights: np.ndarray  #: (k,) their probabilities, given the regions

    @classmethod
    def of(cls, log_odds: np.ndarray, mean: float, size: float) -> SharedPrior:
        """The share given regions with log odds (r,), and a prior mean that is worth `size` regions."""
        shares = (np.arange(_SHARES) + 0.5) / _SHARES
        several = expit(np.asarray(log_odds, float))
        likelihood = np.log(np.outer(shares, 1 - several) + np.outer(1 - shares, several)).sum(axis=1)
        log_p = likelihood + (size * mean - 1) * np.log(shares) + (size * (1 - mean) - 1) * np.log1p(-shares)
        weights = np.exp(log_p - log_p.max())
        return cls(shares, weights / weights.sum())

    def log_odds(self, log_odds: float) -> float:
        """Log odds of "several" of a region, from those where one object and several are equally frequent."""
        one = self.weights @ expit(np.log(self.shares) - np.log1p(-self.shares) - log_odds)
        one = np.clip(one, _RARE, 1 - _RARE)
        return float(np.log1p(-one) - np.log(one))


def least_examined(size: int) -> float:
    """Pixels of the smallest region that is examined, in an image of `size` pixels."""
    return scaled_area(_LEAST_PIXELS, size)


def within(parts: Sequence[TreePart], side: np.ndarray) -> list[TreePart]:
    """The parts of one side (n,) bool of a region."""
    return [TreePart(part.side[side], part.odds) for part in parts]


def by_odds(merges: Sequence[Merge], n: int) -> list[Merge]:
    """The merges of a tree with `n` leaves in ascending order of the largest log odds in a node."""
    largest = np.full(n + len(merges), -np.inf)
    for k, (a, b, odds) in enumerate(merges):
        largest[n + k] = max(odds, largest[a], largest[b])
    order = np.argsort(largest[n:], kind="stable")
    number = np.arange(n + len(merges))
    number[n + order] = n + np.arange(len(merges))
    return [(int(number[a]), int(number[b]), odds) for a, b, odds in (merges[k] for k in order)]


@dataclass(frozen=True, eq=False)
class BaseTree:
    """A tree of merges: the regions below each node, and its merge."""

    image: np.ndarray  #: (H, W) region of every pixel, 0 is the table
    n: int  #: number of regions
    merges: list[tuple[int, int, float]]

    def top(self) -> list[int]:
        """The nodes that no merge joins."""
        joined = {child for a, b, _ in self.merges for child in (a, b)}
        return [node for node in range(1, self.n + len(self.merges)) if node not in joined]

    def clear(self) -> list[int]:
        """The nodes with a clear division, of which only the odds are judged."""
        return [node for node in self._divided() if self.merges[node - self.n][2] <= _CERTAIN]

    def uncertain(self) -> list[int]:
        """The largest nodes without a clear division: the regions whose divisions are looked for."""
        divided = self._divided()
        below = [*self.top(), *(child for node in divided for child in self.merges[node - self.n][:2])]
        return sorted(set(below) - set(divided))

    def _divided(self) -> list[int]:
        """The nodes, from above, whose merge and all merges above are clear or certain to join different objects."""
        found, stack = [], self.top()
        while stack:
            merge = self.merge_of(node := stack.pop())
            if merge is not None and merge[2] > _CLEAR:
                found.append(node)
                stack += merge[:2]
        return found

    def region(self, node: int) -> tuple[np.ndarray, list[TreePart]]:
        """The flat pixels (n,) below a node, and the parts of it that the tree knows."""
        flat = self.image.ravel()
        pixels = np.flatnonzero(self.regions_of(node)[flat])
        return pixels, [TreePart(part.side[flat[pixels]], part.odds) for part in self.parts(node)]

    def merge_of(self, node: int) -> tuple[int, int, float] | None:
        """The merge that makes a node, None for a region."""
        return self.merges[node - self.n] if node >= self.n else None

    def regions_of(self, node: int) -> np.ndarray:
        """(n,) bool: the regions below a node."""
        found = np.zeros(self.n, bool)
        stack = [node]
        while stack:
            one = stack.pop()
            if one < self.n:
                found[one] = True
            else:
                stack += self.merges[one - self.n][:2]
        return found

    def parts(self, node: int) -> list[TreePart]:
        """The sides, as regions (n,) bool, of the merges below a node that may divide objects, most divided first."""
        found, stack = [], [node]
        while stack:
            if (merge := self.merge_of(stack.pop())) is not None:
                found.append(merge)
                stack += merge[:2]
        found = sorted(found, key=lambda merge: -merge[2])[:_MOST_MERGES]
        known = [merge for merge in found if merge[2] >= _KNOWN]
        return [TreePart(self.regions_of(child), odds) for *children, odds in known for child in children]


class _Judged(NamedTuple):
    """What the judge says of a region, where one object and several are equally frequent."""

    log_odds: float  #: of "several objects" against "one"
    side: np.ndarray | None  #: (n,) bool, the first side of the most probable division; None without divisions


class _Examination:
    """Builds the tree of one image."""

    def __init__(
        self,
        builder: SeamTree,
        judge: SeamNetwork,
        image: SeamImage,
        regions: Regions,
        merges: list[tuple[int, int, float]],
    ) -> None:
        self.builder, self.judge, self.image = builder, judge, image
        self.base = BaseTree(regions.image, len(regions.sums), merges)
        self.clear, self.uncertain = frozenset(self.base.clear()), frozenset(self.base.uncertain())
        self.flat = regions.image.ravel()
        self.least = least_examined(self.flat.size)
        self.measures = SeamMeasures.of(image, regions.image > 0)
        self.regions = {node: self.base.region(node) for node in self.clear | self.uncertain}
        self.judged = {node: self._judged(*region, False) for node, region in self.regions.items()}
        log_odds = np.array([one.log_odds for one in self.judged.values() if np.isfinite(one.log_odds)])
        self.prior = SharedPrior.of(log_odds, builder.one_share, builder.prior_size)
        self.least_odds = log(max(builder.least, 1e-9) / max(1 - builder.least, 1e-9))
        self.leaves = np.zeros_like(self.flat)  # of the new tree
        self.n_leaves = 1
        self.joins: list[tuple[tuple[str, int], tuple[str, int], float]] = []

    def tree(self) -> tuple[np.ndarray, list[Merge]]:
        """The leaf (H, W) of every pixel, and the merges."""
        for node in self.base.top():
            self._upper(node)
        n = self.n_leaves
        number = {"leaf": 0, "join": n}
        merges = [(number[a[0]] + a[1], number[b[0]] + b[1], odds) for a, b, odds in self.joins]
        return self.leaves.reshape(self.base.image.shape), merges

    def _join(self, a: tuple[str, int], b: tuple[str, int], odds: float) -> tuple[str, int]:
        self.joins.append((a, b, odds))
        return "join", len(self.joins) - 1

    def _leaf(self, pixels: np.ndarray) -> tuple[str, int]:
        self.leaves[pixels] = self.n_leaves
        self.n_leaves += 1
        return "leaf", self.n_leaves - 1

    def _upper(self, node: int) -> tuple[str, int]:
        if node in self.uncertain:
            return self._examined(node, *self.regions[node], self.judged[node], depth=0)
        merge = self.base.merge_of(node)
        assert merge is not None
        a, b, odds = merge
        judged = self.judged.get(node)
        if judged is not None and judged.side is not None:
            pixels, parts = self.regions[node]
            own = self.base.regions_of(a)[self.flat[pixels]]
            if division_overlap(own, judged.side) < _SAME_DIVISION:
                return self._examined(node, pixels, parts, judged, depth=0)
            odds = self.prior.log_odds(judged.log_odds)
        return self._join(self._upper(a), self._upper(b), odds)

    def _examined(
        self, node: int, pixels: np.ndarray, parts: Sequence[TreePart], judged: _Judged, depth: int
    ) -> tuple[str, int]:
        """The subtree of some pixels (n,) below a node of the base tree; `parts` are those of `divisions`."""
        if judged.side is None:
            return self._kept(node, pixels)
        odds = self.prior.log_odds(judged.log_odds)
        if odds <= self.least_odds:
            return self._kept(node, pixels)
        # The sides of an improbable division are seldom in a sample, so they are not examined.
        further = odds > _FOLLOWED and depth < _MOST_DEPTH
        sides = []
        for one in (judged.side, ~judged.side):
            own = within(parts, one)
            below = self._judged(pixels[one], own, True) if further else _Judged(-np.inf, None)
            sides.append(self._examined(node, pixels[one], own, below, depth + 1))
        return self._join(sides[0], sides[1], odds)

    def _judged(self, pixels: np.ndarray, parts: Sequence[TreePart], below: bool) -> _Judged:
        """What the judge says of a region."""
        found = divisions(self.image, pixels, parts) if len(pixels) >= self.least else []
        if not found:
            return _Judged(-np.inf, None)
        scores = self.judge.scores(*self.measures.describe(pixels, found, below))
        return _Judged(float(np.logaddexp.reduce(scores)), found[int(scores.argmax())].side)

    def _kept(self, node: int, pixels: np.ndarray) -> tuple[str, int]:
        """The base tree below a node, restricted to some pixels. Without merges that divide objects."""
        regions = self.flat[pixels]
        order = np.argsort(regions, kind="stable")
        names, start = np.unique(regions[order], return_index=True)
        leaf = {
            name: self._leaf(pixels[chosen])
            for name, chosen in zip(names.tolist(), np.split(order, start[1:]), strict=True)
        }
        made: dict[int, tuple[str, int] | None] = {}
        below, stack = [], [node]
        while stack:
            one = stack.pop()
            below.append(one)
            if (merge := self.base.merge_of(one)) is not None:
                stack += merge[:2]
        for one in reversed(below):  # children first
            merge = self.base.merge_of(one)
            if merge is None:
                made[one] = leaf.get(one)
                continue
            a, b = made[merge[0]], made[merge[1]]
            made[one] = self._join(a, b, min(merge[2], _SURE)) if a and b else a or b
        top = made[node]
        assert top is not None
        return top

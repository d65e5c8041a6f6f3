"""Segmentation trees that merge regions by learned log odds that two regions are different objects.

Watershed regions of a boundary map are merged pair by pair, always the pair with the lowest log odds. These are
linear in features of the border and of the union of the two regions (`pair_features`), which are recomputed when a
region grows; `BorderTree` adds the correction of a small network (`PairNetwork`). The weights of the features are in
a model file. They were fitted on simulated scenes only, the correction also on real frames.

>>> tree = LearnedTree().build(boundary, frame)
>>> tree = BorderTree().build(boundary, frame)         # also with what a trained border network sees
>>> w = MergeLogOdds().values(tree, frame)
"""

from __future__ import annotations

import hashlib
import heapq
import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.reading import read_json
from mstfilter.base.resources import models_folder
from mstfilter.base.trained import load_once
from mstfilter.mst.segmentation.hidden import with_joins
from mstfilter.mst.segmentation.pair_measures import FEATURES, NO_BORDER, PAIR_FEATURES, pair_features
from mstfilter.mst.segmentation.regions import REGION, Regions, SeenBorders, measure_regions, object_leaves
from mstfilter.mst.segmentation.tree import Merge, Tree, TreeBuilder, UcmTree
from mstfilter.scene import Frame, pixels_above_table, scaled_length

if TYPE_CHECKING:
    from mstfilter.mst.segmentation.border_network import BorderNetwork, PairNetwork

#: Log odds (k,) that the regions of k pairs belong to different objects:
#: (rows of a, rows of b, borders, table borders of a, of b).
PairLogOdds = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]

_ROOT_ODDS = 30.0  # the root joins the table and regions that never touched
_FIT = "python experiments/segmentation_fit/run.py"


def pair_log_odds(weights: Mapping[str, float], correction: PairNetwork | None, scale: float) -> PairLogOdds:
    """The function that computes the log odds of pairs in an image of `scale` times 640 pixels per row."""
    values = np.array(list(weights.values()))

    def log_odds(a: np.ndarray, b: np.ndarray, ab: np.ndarray, at: np.ndarray, bt: np.ndarray) -> np.ndarray:
        x = pair_features(a, b, ab, at, bt, scale, weights)
        return np.asarray(x @ values + (0.0 if correction is None else correction(x)))

    return log_odds


def check_weights(weights: Mapping[str, float], names: Iterable[str], where: object, hint: str) -> None:
    """Raise InputError unless every feature in `names` has one finite weight."""
    if not isinstance(weights, Mapping):
        raise InputError(f"{where} is no mapping from features to weights", f"fit them with: {hint}")
    for name in sorted(set(weights) ^ set(names)):
        found = "has a weight" if name in weights else "has no weight"
        raise InputError(f"{where} {found} of the feature {name!r}, unlike this version", f"fit them with: {hint}")
    for name, value in weights.items():
        if type(value) not in (int, float) or not math.isfinite(value):
            raise InputError(f"{where}: the weight of {name!r} is {value!r}, expected a finite number")


class Agglomeration:
    """Merges pairs of regions in ascending order of log odds. Region 0, the table, is never merged."""

    def __init__(self, regions: Regions, log_odds: PairLogOdds) -> None:
        n = len(regions.sums)
        self.log_odds = log_odds
        self.sums = np.zeros((2 * n, regions.sums.shape[1]))
        self.sums[:n] = regions.sums
        self.borders: list[dict[int, np.ndarray]] = [dict(near) for near in regions.borders]
        self.table = [near.pop(0, NO_BORDER) for near in self.borders]
        self.alive = set(range(1, n))
        self.merges: list[Merge] = []
        self.heap: list[tuple[float, int, int]] = []
        for i in range(1, n):
            self._push(i, [j for j in self.borders[i] if j > i])

    def _push(self, i: int, others: list[int]) -> None:
        if not others:
            return
        borders = np.array([self.borders[i][j] for j in others])
        table = np.array([self.table[j] for j in others])
        mine = np.broadcast_to(self.sums[i], (len(others), self.sums.shape[1]))
        odds = self.log_odds(mine, self.sums[others], borders, np.broadcast_to(self.table[i], table.shape), table)
        for j, value in zip(others, odds.tolist(), strict=True):
            heapq.heappush(self.heap, (value, min(i, j), max(i, j)))

    def pop(self) -> tuple[float, int, int] | None:
        """Remove the pair with the lowest log odds, and return (log odds, i, j); None if no pair is left."""
        while self.heap:
            odds, i, j = heapq.heappop(self.heap)
            if i in self.alive and j in self.alive and j in self.borders[i]:
                return odds, i, j
        return None

    def merge_all(self) -> None:
        """Merge until no two regions have a border."""
        while (pair := self.pop()) is not None:
            odds, i, j = pair
            self.merge(i, j, odds)

    def merge(self, i: int, j: int, odds: float) -> int:
        """Merge two regions and return the number of the new region."""
        new = len(self.borders)
        self.merges.append((i, j, odds))
        self.sums[new] = self.sums[i] + self.sums[j]
        common = self.borders[i].pop(j, NO_BORDER)
        self.borders[j].pop(i, None)
        self.sums[new, REGION["perimeter"].start] -= 2 * common[0]
        near = {k: row for k, row in self.borders[i].items() if k in self.alive}
        for k, row in self.borders[j].items():
            if k in self.alive:
                near[k] = near[k] + row if k in near else row
        self.borders.append(near)
        self.table.append(self.table[i] + self.table[j])
        self.alive -= {i, j}
        self.alive.add(new)
        for k in near:
            self.borders[k][new] = self.borders[k].pop(i, NO_BORDER) + self.borders[k].pop(j, NO_BORDER)
        self._push(new, list(near))
        return new


@dataclass(frozen=True)
class MergedTree(TreeBuilder):
    """Best-first merging of watershed regions by learned log odds.

    One leaf contains the table and all other background pixels; only the root joins it with other regions.
    """

    leaves: TreeBuilder = field(default_factory=UcmTree)

    @abstractmethod
    def model(self) -> tuple[Mapping[str, float], str]:
        """Weights of the features, and key of the model files. Raises InputError for unknown or missing features."""

    def look(self, frame: Frame) -> SeenBorders | None:
        """The output of the border network for a frame; None if the tree uses no network."""
        return None

    def correction(self) -> PairNetwork | None:
        """A network that is added to the linear log odds, or None."""
        return None

    @property
    def weights_key(self) -> str:
        """Hash of the contents of the model files."""
        return self.model()[1]

    @property
    def bound_key(self) -> bytes:
        """Hash of the model. The hash is part of the keys of cached values."""
        return self.weights_key.encode()

    def regions(
        self, boundary: np.ndarray, frame: Frame, pixels: np.ndarray, seen: SeenBorders | None = None
    ) -> Regions:
        """The leaves with their measurements, from the pixels (H, W) bool of objects and the result of `look`."""
        leaves = object_leaves(self.leaves.build(boundary, frame).leaves, pixels)
        return measure_regions(leaves, frame, boundary, self.look(frame) if seen is None else seen)

    def build(self, boundary: np.ndarray, frame: Frame | None = None, pixels: np.ndarray | None = None) -> Tree:
        """Build the tree of merged regions.

        The tree's `odds` are the log odds of each merge, and `start` is the largest P(boundary) inside a node.
        """
        if frame is None:
            raise InputError(
                f"{type(self).__name__} needs the frame of the boundary map", "tree.build(boundary, frame)"
            )
        regions = self.regions(boundary, frame, pixels_above_table(frame) if pixels is None else pixels)
        return tree_of_merges(regions.image, len(regions.sums), self.joined(self.merges(regions), regions, frame))

    def joined(self, merges: list[Merge], regions: Regions, frame: Frame) -> list[Merge]:
        """The merges of a tree, with nodes for segments that do not touch in the image. Here: no such nodes."""
        return merges

    def merges(self, regions: Regions) -> list[Merge]:
        """All merges of measured regions, in their order: (node, node, log odds), as in `tree_of_merges`."""
        scale = scaled_length(1, regions.image.shape[1])
        growing = Agglomeration(regions, pair_log_odds(self.model()[0], self.correction(), scale))
        growing.merge_all()
        return growing.merges


@dataclass(frozen=True)
class LearnedTree(MergedTree):
    """A `MergedTree` that uses features of the image only.

    Parameters
    ----------
    leaves : TreeBuilder
        Builds the leaves that are merged.
    weights : str
        Name of a model of the package, or the path of a JSON file with one weight for each of `PAIR_FEATURES`.
    """

    weights: str = "tree"

    def model(self) -> tuple[Mapping[str, float], str]:
        return read_tree_weights(self.weights)


@load_once
def read_tree_weights(name: str) -> tuple[Mapping[str, float], str]:
    """Weights of `PAIR_FEATURES` by name, and the hash of the file. A file is read again if it has changed."""
    path = Path(name) if name.endswith(".json") else models_folder() / name / "weights.json"
    weights = read_json(path, "weights of a tree", f"fit them with: {_FIT}")
    check_weights(weights, PAIR_FEATURES, path, _FIT)
    return weights, hashlib.sha256(path.read_bytes()).hexdigest()[:16]


@dataclass(frozen=True)
class BorderTree(MergedTree):
    """A `MergedTree` that uses features of the image and of the output of a border network.

    The network gives the log odds of a border between two regions, and the distance between the estimated centres of
    their objects. The weights were fitted on scenes on which the network was not trained.

    Parameters
    ----------
    leaves : TreeBuilder
        Builds the leaves that are merged.
    weights : str
        Name of a trained model of the package, or the path of a model folder.
    joins : bool
        Whether segments on both sides of something nearer can be one object (`mstfilter.mst.segmentation.hidden`).
    """

    weights: str = "border"
    joins: bool = True

    def model(self) -> tuple[Mapping[str, float], str]:
        network = self._network()
        check_weights(network.evidence, FEATURES, f"border model {self.weights!r}", f"{_FIT} --border FOLDER")
        return network.evidence, network.key

    def look(self, frame: Frame) -> SeenBorders:
        return self._network().look(frame)

    def correction(self) -> PairNetwork | None:
        return self._network().correction

    def joined(self, merges: list[Merge], regions: Regions, frame: Frame) -> list[Merge]:
        return with_joins(merges, regions, frame) if self.joins else merges

    def _network(self) -> BorderNetwork:
        from mstfilter.mst.segmentation.border_network import load_border_network

        return load_border_network(self.weights)


def tree_of_merges(image: np.ndarray, n_regions: int, merges: list[Merge]) -> Tree:
    """The tree of a list of merges. Merge k makes node n_regions + k, and a root joins what remains.

    `image` (H, W) int has the region of every pixel; region 0 is the table. A merge is (node, node, log odds).
    """
    if n_regions == 1:
        return Tree(np.zeros(1, np.int64), image, np.zeros(1), np.zeros(1))
    root = n_regions + len(merges)
    parent = np.full(root + 1, root)
    odds = np.zeros(root + 1)
    start = np.zeros(root + 1)
    odds[root], start[root] = _ROOT_ODDS, 1.0
    for node, (a, b, value) in enumerate(merges, start=n_regions):
        parent[[a, b]] = node
        odds[node] = value
        start[node] = max(1 / (1 + np.exp(-value)), start[a], start[b])
    return Tree(parent, image, start, odds)

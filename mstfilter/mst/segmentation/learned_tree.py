"""Segmentation trees that merge regions by learned log odds that two regions are different objects.

Watershed regions of a boundary map are merged pair by pair, always the pair with the lowest log odds. These are
linear in `FEATURES` of the border and of the union of the two regions, which are recomputed when a region grows;
`BorderTree` adds the correction of a small network (`PairNetwork`). The weights of the features are in a model file.
They were fitted on simulated scenes only, the correction also on real frames.

>>> tree = LearnedTree().build(boundary, frame)
>>> tree = BorderTree().build(boundary, frame)         # also with what a trained border network sees
>>> w = MergeLogOdds().values(tree, frame)

Features that depend on the size of a region are in pixels of a 640 px wide image. Disparity is in sensor units (1/8
px at f = 525 px), and lengths are in metres. The "front" region of a pair is nearer to the camera at the border.
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
from mstfilter.mst.segmentation.regions import (
    BORDER,
    HEIGHT_BIN,
    REGION,
    Regions,
    SeenBorders,
    measure_regions,
    object_leaves,
)
from mstfilter.mst.segmentation.tree import Tree, TreeBuilder, UcmTree
from mstfilter.scene import Frame, pixels_above_table, scaled_length

if TYPE_CHECKING:
    from mstfilter.mst.segmentation.border_network import BorderNetwork, PairNetwork

#: Log odds (k,) that the regions of k pairs belong to different objects:
#: (rows of a, rows of b, borders, table borders of a, of b).
PairLogOdds = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]

#: A merge of two nodes: their numbers, and the log odds of different objects against one.
Merge = tuple[int, int, float]
NO_BORDER = np.zeros(len(BORDER))  #: The row of a pair of regions without a common border.
_ROOT_ODDS = 30.0  # the root joins the table and regions that never touched
_MOST_GAP = 4.0
_FIT = "python experiments/segmentation_fit/run.py"


def quadric_residual(sums: np.ndarray) -> np.ndarray:
    """Squared residual (k,) of a quadric fitted to the disparity of each region (k, C), in squared sensor units."""
    gram = sums[:, REGION["gram"]].reshape(-1, 6, 6)
    moment = sums[:, REGION["moment"]]
    n = sums[:, REGION["pixels"].start]
    ridge = (1e-9 * n + 1e-9)[:, None, None] * np.eye(6)
    fit = np.linalg.solve(gram + ridge, moment[..., None])[..., 0]
    return np.maximum(sums[:, REGION["square"].start] - (moment * fit).sum(axis=1), 0)


class _RegionMeans:
    """Measurements of k regions, from their rows (k, C) of `Regions.sums` and their borders (k, B) with the table."""

    def __init__(self, sums: np.ndarray, table: np.ndarray) -> None:
        self.n = np.maximum(sums[:, REGION["pixels"].start], 1)
        lab, lab2, self.ground, self.centre = (
            sums[:, REGION[name]] / self.n[:, None] for name in ("lab", "lab2", "ground", "centre")
        )
        self.lab, self.lab_variance = lab, np.maximum(lab2 - lab**2, 0) + 4
        # Standard deviation of the ground coordinates, metres.
        spread = sums[:, REGION["spread"].start] / self.n
        self.extent = np.sqrt(np.maximum(spread - (self.ground**2).sum(axis=1), 0))
        self.bend = sums[:, REGION["bend"].start] / self.n
        # 3rd and 97th percentile of the heights, metres.
        share = np.cumsum(sums[:, REGION["heights"]], axis=1) / self.n[:, None]
        self.bottom = (share < 0.03).sum(axis=1) * HEIGHT_BIN
        self.top = ((share < 0.97).sum(axis=1) + 1) * HEIGHT_BIN
        # Shares of the outline that touch the table, and that border on it with a clear step.
        clear = table[:, BORDER["clear"]]
        self.outline = np.maximum(sums[:, REGION["perimeter"].start], 1)
        self.on_table, self.drop = (table[:, 0] - clear) / self.outline, clear / self.outline
        self.free = self.outline - table[:, 0]


class PairMeasures:
    """Measurements of k pairs of regions. The parameters are the same as in `pair_features`."""

    def __init__(
        self, a: np.ndarray, b: np.ndarray, border: np.ndarray, table_a: np.ndarray, table_b: np.ndarray, scale: float
    ) -> None:
        flip = (border[:, BORDER["step"]] < 0)[:, None]
        sums_front, sums_back = np.where(flip, b, a), np.where(flip, a, b)
        self.front = front = _RegionMeans(sums_front, np.where(flip, table_b, table_a))
        self.back = back = _RegionMeans(sums_back, np.where(flip, table_a, table_b))
        small = np.minimum(front.n, back.n)
        self.log_small = np.log(small / scale**2)
        self.lab = front.lab - back.lab
        joint = quadric_residual(sums_front + sums_back)
        excess = joint - quadric_residual(sums_front) - quadric_residual(sums_back)
        self.misfit = np.log1p(np.maximum(excess, 0) / small)
        self.residual = np.log1p(joint / (front.n + back.n))
        self.higher = np.clip((front.top - back.top) * 10, -1, 1)
        self.rim = np.exp(-(((front.top - back.top) / 0.015) ** 2))
        gap = front.ground - back.ground
        self.distance = np.minimum(np.hypot(gap[:, 0], gap[:, 1]) / (front.extent + back.extent + 1e-3), 4)
        self.length = np.maximum(border[:, BORDER["length"]], 1)
        mean = border / self.length[:, None]
        self.strength, self.hollow, self.convex, self.clear, self.seen = (
            mean[:, BORDER[name]] for name in ("strength", "hollow", "convex", "clear", "seen")
        )
        self.step = np.log1p(np.abs(mean[:, BORDER["step"]]))
        # Distance of the centres of the objects that a network sees, relative to the size of the smaller region.
        self.centre_gap = np.linalg.norm(front.centre - back.centre, axis=1)
        self.centre_gap = np.minimum(self.centre_gap / np.sqrt(small), _MOST_GAP)

    def texture(self) -> np.ndarray:
        """Bhattacharyya distances between normal distributions of Lab colour: sum over the channels, limited to 4."""
        a, b = self.front, self.back
        total = a.lab_variance + b.lab_variance
        distance = (a.lab - b.lab) ** 2 / (4 * total)
        distance += 0.5 * np.log(total / (2 * np.sqrt(a.lab_variance * b.lab_variance)))
        return np.minimum(distance.sum(axis=1), 4)


#: Features of pairs of regions by name, (k,) each. Those of `EVIDENCE_FEATURES` are 0 without a border network.
FEATURES: dict[str, Callable[[PairMeasures], np.ndarray]] = {
    "bias": lambda p: np.ones(len(p.length)),
    "strength": lambda p: p.strength,
    "strength^2": lambda p: p.strength**2,
    "hollow": lambda p: p.hollow,
    "convex": lambda p: p.convex,
    "step": lambda p: p.step,
    "clear step share": lambda p: p.clear,
    "lightness": lambda p: np.minimum(np.abs(p.lab[:, 0]) / 20, 3),
    "chroma": lambda p: np.minimum(np.hypot(p.lab[:, 1], p.lab[:, 2]) / 10, 4),
    "texture": PairMeasures.texture,
    "misfit": lambda p: p.misfit,
    "residual": lambda p: p.residual,
    "border share": lambda p: np.minimum(p.length / np.minimum(p.front.outline, p.back.outline), 1),
    "free border share": lambda p: np.minimum(p.length / np.maximum(np.minimum(p.front.free, p.back.free), 1), 1),
    "log pixels": lambda p: p.log_small,
    "log ratio": lambda p: np.abs(np.log(p.front.n / p.back.n)),
    "front higher": lambda p: np.maximum(p.higher, 0),
    "back higher": lambda p: np.maximum(-p.higher, 0),
    "front bottom": lambda p: np.minimum(p.front.bottom * 10, 2),
    "back bottom": lambda p: np.minimum(p.back.bottom * 10, 2),
    "front bend": lambda p: p.front.bend,
    "back bend": lambda p: p.back.bend,
    "ground distance": lambda p: p.distance,
    "front on table": lambda p: p.front.on_table,
    "back on table": lambda p: p.back.on_table,
    "front drop": lambda p: p.front.drop,
    "back drop": lambda p: p.back.drop,
    "rim": lambda p: p.rim,
    "rim * back bend": lambda p: p.rim * p.back.bend,
    "rim * step": lambda p: p.rim * p.step,
    "rim * inside": lambda p: p.rim * np.exp(-(p.distance**2)) * p.step,
    "step * misfit": lambda p: p.step * p.misfit,
    "hollow * misfit": lambda p: p.hollow * p.misfit,
    "strength * log pixels": lambda p: p.strength * p.log_small,
    "hollow * log pixels": lambda p: p.hollow * p.log_small,
    "convex * strength": lambda p: p.convex * p.strength,
    "seen": lambda p: p.seen,
    "seen * log pixels": lambda p: p.seen * p.log_small,
    "centre gap": lambda p: p.centre_gap,
    "centre gap * seen": lambda p: p.centre_gap * p.seen,
}
EVIDENCE_FEATURES = tuple(FEATURES)[-4:]  #: Features of what a border network sees.
PAIR_FEATURES = tuple(FEATURES)[:-4]  #: The other features.


def pair_features(
    a: np.ndarray,
    b: np.ndarray,
    border: np.ndarray,
    table_a: np.ndarray,
    table_b: np.ndarray,
    scale: float,
    names: Iterable[str] = PAIR_FEATURES,
) -> np.ndarray:
    """The named features (k, f) of k pairs of regions, from their rows `a` and `b` (k, C) of `Regions.sums`.

    `border` (k, B) has the common borders of the pairs, with `a` first. `table_a` and `table_b` (k, B) are the
    borders of `a` and `b` with the table, or zeros. `scale` is the image width / 640.
    """
    pair = PairMeasures(a, b, border, table_a, table_b, scale)
    return np.stack([FEATURES[name](pair) for name in names], axis=1)


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
        from mstfilter.mst.segmentation.hidden import with_joins

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

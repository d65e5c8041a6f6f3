"""A learned segmentation tree that also uses what a trained border network sees.

>>> tree = BorderTree(weights="border-model").build(boundary, frame)

The log odds of a merge are linear in `PAIR_FEATURES` and in `EVIDENCE_FEATURES`: the log odds that the network gives
to a border between the two regions, and how far apart it sees the centres of their objects. All weights were fitted
together, on simulated scenes that the network was not trained on, and are part of the model.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Frame
from mstfilter.segmentation.learned_tree import Agglomeration, tree_of_merges
from mstfilter.segmentation.regions import BORDER, PAIR_FEATURES, REGION, Regions, measure_regions, pair_features
from mstfilter.segmentation.tree import Tree, TreeBuilder, UcmTree

if TYPE_CHECKING:
    from mstfilter.segmentation.border_network import BorderNetwork

EVIDENCE_FEATURES = ("seen", "seen * log pixels", "centre gap", "centre gap * seen")
_MOST_GAP = 4.0


def evidence_features(a: np.ndarray, b: np.ndarray, border: np.ndarray, scale: float) -> np.ndarray:
    """Features (k, 4) of pairs of regions with rows `a`, `b` (k, C) and common borders (k, B); see `pair_features`.

    ``seen`` is the mean log odds of a border between them. ``centre gap`` is the distance of the centres of their
    objects as the network sees them, divided by the root of the number of pixels of the smaller region.
    """
    n_a, n_b = (np.maximum(rows[:, REGION["pixels"].start], 1) for rows in (a, b))
    small = np.minimum(n_a, n_b)
    seen = border[:, BORDER["seen"]] / np.maximum(border[:, BORDER["length"]], 1)
    gap = np.linalg.norm(a[:, REGION["centre"]] / n_a[:, None] - b[:, REGION["centre"]] / n_b[:, None], axis=1)
    gap = np.minimum(gap / np.sqrt(small), _MOST_GAP)
    return np.stack([seen, seen * np.log(small / scale**2), gap, gap * seen], axis=1)


def all_features(
    a: np.ndarray, b: np.ndarray, border: np.ndarray, table_a: np.ndarray, table_b: np.ndarray, scale: float
) -> np.ndarray:
    """`PAIR_FEATURES` and `EVIDENCE_FEATURES` of k pairs, (k, f); the parameters are those of `pair_features`."""
    features = pair_features(a, b, border, table_a, table_b, scale)
    return np.hstack([features, evidence_features(a, b, border, scale)])


@dataclass(frozen=True)
class BorderTree(TreeBuilder):
    """`LearnedTree` with the evidence of a border network.

    Parameters
    ----------
    leaves : TreeBuilder
        Its leaves are merged.
    weights : str
        Name of a trained model of the package, or the path of its folder.
    """

    leaves: TreeBuilder = field(default_factory=UcmTree)
    weights: str = "border"

    @property
    def network(self) -> BorderNetwork:
        """The network with its weights. Raises InputError if they are missing or damaged."""
        from mstfilter.segmentation.border_network import load_border_network

        return load_border_network(self.weights)

    @property
    def weights_key(self) -> str:
        """Key of the contents of the weights."""
        return self.network.key

    @property
    def bound_key(self) -> bytes:
        """What is cached depends on the weights."""
        return self.weights_key.encode()

    def regions(self, boundary: np.ndarray, frame: Frame) -> tuple[Tree, Regions]:
        """The initial tree and its measured leaves."""
        tree = self.leaves.build(boundary, frame)
        return tree, measure_regions(tree.leaves, frame, boundary, self.network.look(frame))

    def build(self, boundary: np.ndarray, frame: Frame | None = None) -> Tree:
        if frame is None:
            raise InputError("BorderTree needs the frame of the boundary map", "tree.build(boundary, frame)")
        names = (*PAIR_FEATURES, *EVIDENCE_FEATURES)
        if tuple(self.network.evidence) != names:
            raise InputError(
                f"border model {self.weights!r} has no weights of the features of this version",
                "fit them with: python experiments/segmentation_fit/run.py --border FOLDER",
            )
        tree, regions = self.regions(boundary, frame)
        weights, scale = np.array(list(self.network.evidence.values())), frame.camera.width / 640
        growing = Agglomeration(regions, lambda a, b, ab, at, bt: all_features(a, b, ab, at, bt, scale) @ weights)
        growing.merge_all()
        return tree_of_merges(regions.of_leaf[tree.leaves], len(regions.sums), growing.merges)

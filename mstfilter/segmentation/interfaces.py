"""What the parts of the segmentation must do: image -> boundaries -> tree -> node values -> cuts.

Each abstract class has one method; every other class of the package is a final, frozen dataclass that
implements one of them. Write your own part by subclassing:

>>> class Flat(BoundaryModel):
...     def boundary(self, frame):
...         return np.zeros(frame.depth.shape, np.float32)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mstfilter.scene import Frame
from mstfilter.segmentation.tree import Tree

__all__ = ["BoundaryModel", "CutSample", "CutSampler", "CutValue", "TreeBuilder"]


class BoundaryModel(ABC):
    """Where one object ends and another begins."""

    @abstractmethod
    def boundary(self, frame: Frame) -> np.ndarray:
        """(H, W) float32 in 0 .. 1: strength of a border between regions at each pixel."""


class TreeBuilder(ABC):
    """A hierarchy of regions from boundary strengths."""

    @abstractmethod
    def build(self, boundary: np.ndarray, frame: Frame | None = None) -> Tree:
        """The tree of a boundary map (H, W); some builders also look at the frame it was made from."""


class CutValue(ABC):
    """How good a region is as one object."""

    @abstractmethod
    def values(self, tree: Tree, frame: Frame) -> np.ndarray:
        """(N,) value w of every node. The value of a cut is the sum over its nodes, v(c) = sum w."""


@dataclass(frozen=True, eq=False)
class CutSample:
    """Cuts drawn from a tree.

    Parameters
    ----------
    cuts : tuple of int arrays
        Each an ascending array of nodes.
    values : (n,) float
        v(c) of each.
    log_p : (n,) float
        Log of the sampler's target law relative to the optimal cut.
    diagnostics : dict
        Numbers about the draw, fit for JSON.
    """

    cuts: tuple[np.ndarray, ...]
    values: np.ndarray
    log_p: np.ndarray
    diagnostics: dict[str, Any] = field(default_factory=dict)


class CutSampler(ABC):
    """Draws segmentations from a tree with node values."""

    @abstractmethod
    def sample(self, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int) -> CutSample:
        """`n` cuts of the tree under node values `w` (N,)."""

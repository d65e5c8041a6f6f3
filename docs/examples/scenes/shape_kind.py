"""A kind of whole shape, for the completers `posterior` and `pooled`.

mstfilter check ./shape_kind.py:MyKind
mstfilter run demo/recording update.completer=posterior 'update.completer.kinds=["box", "cylinder", \
"./shape_kind.py:MyKind"]' --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mstfilter.mst.completion import ShapeKind


@dataclass(frozen=True)
class MyKind(ShapeKind):
    """Wedges and roofs: a box whose top is an edge, which can be anywhere above the bottom."""

    n_shape: ClassVar[int] = 1  # numbers 0 .. 1 that say how a shape fills its box

    def distance(self, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Metres (m, n) from the surface, negative inside: of points x (3, m, n) in n boxes of half edges (3, n)."""
        edge = half[0] * (2 * shape[0] - 1)  # the ridge is at x[0] = edge
        up = (x[2] + half[2]) / (2 * half[2])  # 0 at the bottom, 1 at the ridge
        left, right = -half[0] + up * (half[0] + edge), half[0] - up * (half[0] - edge)
        sides = np.maximum(
            (left - x[0]) / _steep(half, half[0] + edge), (x[0] - right) / _steep(half, half[0] - edge)
        )
        return np.maximum(np.maximum(sides, np.abs(x[1]) - half[1]), np.abs(x[2]) - half[2])


def _steep(half: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Horizontal metres for a metre at right angles to a roof that goes in by `run` (n,)."""
    return np.sqrt(1 + (run / (2 * half[2])) ** 2)

"""Does everything that a hypothesis holds stand on something?

>>> Support().log_score(hypotheses, clip)

Data used: none but the table's height. Free space cuts objects off from below where the camera looks under them, and
completion fills them down to the table, so both have a part in what is found here. The scene is at rest at the end
of a clip: an object rests on the table or on others that do, and does not topple.

- **Support.** The underside of an object is the lowest voxel of each of its columns. It touches what is right below:
  the table or another object's voxel, at most `tolerance` voxels lower. An object is supported if it touches the
  table or a supported object; two that rest on one another alone hang in the air together. One that is not could
  fall by its *gap*.
- **Stability.** The vertical through the centre of mass (uniform density) must meet the convex hull of the columns
  that touch a support; what lies outside costs more the farther it is. Friction and leaning on a neighbour's side
  are left out.

An object that reaches the edge of the workspace may stand on something outside, and says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Clip, Evidence, Hypothesis

__all__ = ["Stand", "Support", "stands"]

_TABLE = 0  # among the supports; objects have their labels


class Stand(NamedTuple):
    """How an object stands.

    Parameters
    ----------
    volume : int
        Voxels.
    gap : float
        Voxels that it could fall before it meets the table or something supported, above the tolerance; 0: supported.
    overhang : float
        Voxels by which its centre of mass lies outside the hull of what carries it; 0: stable, or not supported.
    """

    volume: int
    gap: float
    overhang: float


@dataclass(frozen=True)
class Support(Evidence):
    """Share of the volume that floats or would topple.

    Parameters
    ----------
    strength : float
        Nats if all that is occupied floats.
    tolerance : int
        Free voxels between an object and what carries it that are put down to voxelisation.
    gap : float
        Voxels above the tolerance at which an object floats for certain; less costs in proportion.
    overhang : float
        Voxels outside the hull at which an object topples for certain; less costs in proportion.
    table_height : float
        Metres.
    """

    strength: float = 30.0
    tolerance: int = 1
    gap: float = 3.0
    overhang: float = 3.0
    table_height: float = 0.0

    def __post_init__(self) -> None:
        values = (self.strength, self.gap, self.overhang)
        if not (np.isfinite([*values, self.table_height]).all() and min(values) > 0 and self.tolerance >= 0):
            raise InputError(
                f"support has strength {self.strength}, tolerance {self.tolerance}, gap {self.gap}, overhang "
                f"{self.overhang} and table_height {self.table_height}, expected finite numbers, the first four "
                "above 0 (tolerance may be 0)"
            )

    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        """Minus `strength` times the share of the volume that floats or topples; 0 for an empty hypothesis."""
        known: dict[int, float] = {}
        for hypothesis in hypotheses:
            if id(hypothesis.labels) not in known:
                known[id(hypothesis.labels)] = self._score(hypothesis)
        return np.array([known[id(h.labels)] for h in hypotheses], dtype=float)

    def _score(self, hypothesis: Hypothesis) -> float:
        found = stands(hypothesis, self.tolerance, self.table_height).values()
        wrong = sum(s.volume * max(min(s.gap / self.gap, 1.0), min(s.overhang / self.overhang, 1.0)) for s in found)
        return 0.0 - self.strength * wrong / max(sum(s.volume for s in found), 1)


def stands(hypothesis: Hypothesis, tolerance: int = 1, table_height: float = 0.0) -> dict[int, Stand]:
    """How each object of a hypothesis stands, by label.

    Parameters
    ----------
    hypothesis : Hypothesis
    tolerance : int
        Free voxels between an object and what carries it.
    table_height : float
        Metres.
    """
    from scipy.ndimage import find_objects

    labels, grid = hypothesis.labels, hypothesis.grid
    # Nothing is known under the lowest layer: it carries as the table does where the workspace begins above that.
    table = max(0, round((table_height - float(grid.origin[2])) / grid.voxel_size))
    boxes = find_objects(labels.astype(np.int32))
    columns, middles, falls, cut = {}, {}, {}, set()
    for label in hypothesis.volumes():
        box = boxes[label - 1]
        start = np.array([s.start for s in box])
        own = labels[box] == label
        heights = own.sum(axis=2)
        x, y = np.nonzero(heights)
        columns[label] = np.stack([x, y], axis=1) + start[:2]
        middles[label] = heights[x, y] @ columns[label] / heights.sum()
        falls[label] = _falls(labels, columns[label], own.argmax(axis=2)[x, y] + start[2], table)
        if any(box[axis].start == 0 or box[axis].stop == labels.shape[axis] for axis in (0, 1)):
            cut.add(label)

    held = {_TABLE, *cut}
    while found := {k for k in falls if k not in held and _least(falls[k], held).min() <= tolerance}:
        held |= found
    out = {}
    for label, volume in hypothesis.volumes().items():
        fall = _least(falls[label], held)
        gap = overhang = 0.0
        if label not in held:
            gap = float(fall.min()) - tolerance
        elif label not in cut:
            overhang = _outside(middles[label], columns[label][fall <= tolerance])
        out[label] = Stand(volume, gap, overhang)
    return out


def _falls(labels: np.ndarray, columns: np.ndarray, bottom: np.ndarray, table: int) -> dict[int, np.ndarray]:
    """Free way down (voxels) of each column's lowest voxel to each thing below it; inf where it is not below."""
    below = labels[columns[:, 0], columns[:, 1]].copy()
    level = np.arange(below.shape[1])
    below[level >= bottom[:, None]] = 0
    falls = {_TABLE: np.maximum(bottom - table, 0).astype(float)}
    for other in np.flatnonzero(np.bincount(below.ravel()))[1:]:
        top = np.where(below == other, level, -1).max(axis=1)
        falls[int(other)] = np.where(top >= 0, bottom - 1.0 - top, np.inf)
    return falls


def _least(falls: dict[int, np.ndarray], supports: set[int]) -> np.ndarray:
    """(columns,) the least of the ways down to the supports."""
    return np.min([fall for thing, fall in falls.items() if thing in supports], axis=0)


def _outside(point: np.ndarray, cells: np.ndarray) -> float:
    """How far a point lies outside the convex hull of unit cells around their centres; 0 inside."""
    from scipy.spatial import ConvexHull

    corners = (cells[:, None] + np.array([(-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)])).reshape(-1, 2)
    hull = ConvexHull(corners)
    if (hull.equations[:, :2] @ point + hull.equations[:, 2] <= 0).all():
        return 0.0
    a = corners[hull.vertices]
    along = np.roll(a, -1, axis=0) - a
    share = np.clip(((point - a) * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(a + share[:, None] * along - point, axis=1).min())

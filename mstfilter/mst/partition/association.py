"""Which segment of a partition of the image continues which predicted object.

>>> overlaps = Overlaps.of(partition, counts, 60)   # segment (K,) and readings (K, objects + 1) of each cell
>>> for component in overlaps.components():         # of the conflict graph
...     overlaps.tracks(component)                  # segment -> predicted objects that it continues

A segment may show a predicted object if it shares more than a tenth of the readings of the smaller of the two. They
are then *in conflict*, and the conflicts are the edges of the conflict graph. (In the paper, section IV-D, edges join
objects that share voxels.) The predicted object with which a segment shares most readings is its *main object*.

Hidden objects catch a few stray readings of their neighbours. So an object that is the main object of no segment and
has fewer than about 60 readings is in no conflict; it counts as *occluded*, as does an object without readings.

In each connected component, a predicted object is continued by at most one segment: one that is in conflict with it
and has more than half of its readings. Readings outside all segments never count. Two rules are tried in order:

1. Only the segments whose main object it is are considered, and only its readings in these. So readings where another
   object now stands in front of it do not count against it.
2. If none of these has more than half, all segments are considered.

A predicted object that no segment continues, and that does not stay as an occluded one, is *lost*; a refuted one
always is. It may still be `recognised` elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import networkx as nx
import numpy as np
from scipy.optimize import linear_sum_assignment

from mstfilter.scene import ObjectRecord, ObjectView

_CONFLICT = 0.1  # a segment and an object are in conflict if they share more than this share of the smaller one
_CONTINUED = 0.5  # a segment continues an object if it has more than this share of the object's readings


_ALIKE = 0.5  # with less, the same object is less probable than another object (simulated scenes)


def recognised(lost: Sequence[ObjectRecord], new: Sequence[ObjectView]) -> dict[int, ObjectRecord]:
    """The lost objects that are the new objects with the most similar latest views, by the index of the new object.

    The similarity is the common share of the colours, times the square root of the ratio of the visible areas. The
    pairs have the largest sum of similarities. Pairs with a similarity below 0.5 are omitted.
    """
    lost = [one for one in lost if one.views and one.views[-1].colours.any()]
    if not lost or not new:
        return {}
    before, now = (np.array([view.colours for view in views]) for views in ([one.views[-1] for one in lost], new))
    areas, areas_now = before.sum(axis=1), np.maximum(now.sum(axis=1), 1e-12)
    common = np.minimum((before / areas[:, None])[:, None], now / areas_now[:, None]).sum(axis=2)
    ratio = np.minimum.outer(areas, areas_now) / np.maximum.outer(areas, areas_now)
    alike = common * np.sqrt(ratio)
    pairs = zip(*linear_sum_assignment(-alike), strict=True)
    return {int(k): lost[j] for j, k in pairs if alike[j, k] >= _ALIKE}


class ConflictComponent(NamedTuple):
    """A connected component of the conflict graph of segments and predicted objects."""

    segments: list[int]  #: ascending labels
    objects: list[int]  #: ascending labels; empty if the segment is in conflict with no object


@dataclass(frozen=True, eq=False)
class Overlaps:
    """The number of depth readings that each segment shares with each predicted object."""

    shared: np.ndarray  #: (segments + 1, objects + 1) int; row 0 (no segment) is 0, column 0 is no object
    least: float  #: an object that is the main object of no segment needs as many readings to be in conflict

    @classmethod
    def of(cls, partition: np.ndarray, counts: np.ndarray, least: float) -> Overlaps:
        """The overlaps of a partition, from the segment (K,) of each cell.

        `counts` (K, objects + 1): number of readings that each cell shares with each object; column 0 is no object.
        """
        shared = np.zeros((int(partition.max(initial=0)) + 1, counts.shape[1]), np.int64)
        np.add.at(shared, partition, counts)
        shared[0] = 0
        return cls(shared, least)

    @cached_property
    def in_conflict(self) -> np.ndarray:
        """Whether each segment is in conflict with each object: bool array, same shape as `shared`."""
        segments, objects = self.shared.sum(axis=1), self.shared.sum(axis=0)
        conflict = self.shared > _CONFLICT * np.minimum.outer(segments, objects)
        is_main = np.isin(np.arange(len(objects)), self.main_object)
        conflict[:, ~is_main & (objects < self.least)] = False
        conflict[0], conflict[:, 0] = False, False
        return conflict

    @cached_property
    def main_object(self) -> np.ndarray:
        """The predicted object (segments + 1,) that shares most readings with each segment; 0 is no object."""
        main = self.shared[:, 1:].argmax(axis=1) + 1 if self.shared.shape[1] > 1 else np.zeros(len(self.shared), int)
        return np.where(self.shared[:, 1:].any(axis=1), main, 0)

    @cached_property
    def visible(self) -> set[int]:
        """The predicted objects that are in conflict with a segment. All other predicted objects are occluded."""
        return set(np.flatnonzero(self.in_conflict.any(axis=0)).tolist())

    def components(self) -> list[ConflictComponent]:
        """Connected components of the conflict graph, in the order of their first segment."""
        graph = nx.Graph()
        graph.add_nodes_from(("segment", a) for a in np.flatnonzero(self.shared.any(axis=1)).tolist())
        graph.add_edges_from((("segment", a), ("object", b)) for a, b in np.argwhere(self.in_conflict).tolist())
        found = []
        for vertices in nx.connected_components(graph):
            labels = [sorted(k for kind, k in vertices if kind == wanted) for wanted in ("segment", "object")]
            found.append(ConflictComponent(*labels))
        return sorted(found)

    def tracks(self, component: ConflictComponent) -> dict[int, list[int]]:
        """The predicted objects that each segment of a component continues, by decreasing number of readings."""
        continued: dict[int, list[int]] = {segment: [] for segment in component.segments}
        for predicted in component.objects:
            segment = self.continued_by(predicted)
            if segment:
                continued[segment].append(predicted)
        return {a: sorted(objects, key=lambda k: -self.shared[a, k]) for a, objects in continued.items()}

    def continued_by(self, predicted: int) -> int:
        """The segment that continues a predicted object; 0 if there is none."""
        mainly_it = self.main_object == predicted
        return self._holder(predicted, mainly_it) or self._holder(predicted, np.ones_like(mainly_it))

    def _holder(self, predicted: int, segments: np.ndarray) -> int:
        """The segment that is in conflict with an object and has more than half of the object's readings, or 0.

        Only readings in the segments that `segments` (segments + 1,) bool selects are counted.
        """
        readings = np.where(segments, self.shared[:, predicted], 0)
        enough = self.in_conflict[:, predicted] & (readings > _CONTINUED * readings.sum())
        return int(enough.argmax())

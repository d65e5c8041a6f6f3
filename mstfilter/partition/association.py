"""Associates the segments of an image partition with the objects of a prediction.

>>> overlaps = Overlaps.of(partition, counts, 60)   # segment (K,) and readings (K, objects + 1) of each cell
>>> for component in overlaps.components():         # of the conflict graph
...     overlaps.tracks(component)                  # segment -> predicted objects that it continues

A segment and a predicted object are *in conflict* if they share more than a tenth of the depth readings of the
smaller of the two. The segment may then show the object. Conflicts are the edges of the conflict graph. (In the
paper, section IV-D, edges join objects that share voxels.) The *main object* of a segment is the predicted object
that shares most readings with the segment. An object that is the main object of no segment and has fewer than about
60 readings is in no conflict. The few depth readings of a hidden object measure nearby objects.

A predicted object is continued by at most one segment of its connected component. Two rules are applied in order:

1. The first rule considers only segments whose main object is the predicted object. A considered segment continues
   the object if it has more than 80 % of those readings of the object that lie in considered segments. The first rule
   ignores readings at which another object now occludes the predicted object.
2. The second rule considers all segments. A segment continues the object if it has more than 80 % of those readings
   of the object that lie in any segment.

In a component of one segment and one object, the share is 50 % instead of 80 %. The rules have consequences:

- If a predicted object is *split* and no segment has enough readings of the object, no segment continues the object.
  The track of a split object then ends, its views are deleted, and the segments are new objects.
- If several objects are *merged* into one segment, the segment continues all these objects.
- A segment that continues no object is a new object.

A predicted object in no conflict is *occluded*. Depth readings that belong to no segment are never counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import networkx as nx
import numpy as np

_CONFLICT = 0.1  # a segment and an object are in conflict if they share more than this share of the smaller one
_SAME = 0.5  # share of an object's readings in the segment that continues it, if both have no other conflict
_CONTAINED = 0.8  # the same, if they have other conflicts


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
            segment = self.continued_by(predicted, component)
            if segment:
                continued[segment].append(predicted)
        return {a: sorted(objects, key=lambda k: -self.shared[a, k]) for a, objects in continued.items()}

    def continued_by(self, predicted: int, component: ConflictComponent) -> int:
        """The segment of a component that continues a predicted object; 0 if there is none."""
        no_other_conflict = len(component.segments) == len(component.objects) == 1
        share = _SAME if no_other_conflict else _CONTAINED
        mainly_it = self.main_object == predicted
        return self._holder(predicted, mainly_it, share) or self._holder(predicted, np.ones_like(mainly_it), share)

    def _holder(self, predicted: int, segments: np.ndarray, share: float) -> int:
        """The segment that is in conflict with an object and has more than a `share` of the object's readings, or 0.

        Only readings in the segments that `segments` (segments + 1,) bool selects are counted.
        """
        readings = np.where(segments, self.shared[:, predicted], 0)
        enough = self.in_conflict[:, predicted] & (readings > share * readings.sum())
        return int(enough.argmax())

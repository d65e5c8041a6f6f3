"""Crossover of two hypotheses by their conflict graph (paper, section IV-D, figure 5).

>>> child = Crossover().cross(rng, proposed, predicted)

1. `graph_of` builds the conflict graph: two objects that share voxels are in conflict.
2. `resolve` draws, for each connected component of the graph, which objects are merged, and the order in which all
   of them are painted. A later object covers an earlier one.
3. `assign_labels` paints the objects. Objects without conflict are copied.
4. `ModeFilter` removes the speckle that painting leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mstfilter.crossover.conflicts import PREDICTED, PROPOSED, SIDES, ConflictGraph, OccupiedVoxels, graph_of
from mstfilter.crossover.mode_filter import ModeFilter
from mstfilter.crossover.resolution import ConflictResolution, MergeRule, SpanningTree, Structure, resolve
from mstfilter.errors import InputError
from mstfilter.fields import Bounded
from mstfilter.scene import MAX_LABEL, Hypothesis, ObjectRecord, Occupancy, as_labels, check_grid


@dataclass(frozen=True)
class Crossover(Bounded):
    """Conflict-graph crossover.

    Parameters
    ----------
    structure : Structure
        Painting order and candidate merges.
    merge : {"share", "printed", "always", "never"}
        Probability of a merge along a directed edge (`mstfilter.crossover.resolution`).
    mode_filter : ModeFilter
        Smooths the painted labels.
    drop_rule : bool
        Reproduces a fault of the authors' program: an object without conflict is lost if its vertex number exceeds
        that of every vertex in conflict.
    """

    structure: Structure = SpanningTree()  # noqa: RUF009 (frozen)
    merge: MergeRule = "share"
    mode_filter: ModeFilter = ModeFilter()  # noqa: RUF009 (frozen)
    drop_rule: bool = False

    def cross(self, rng: np.random.Generator, proposed: Hypothesis, predicted: Hypothesis) -> Hypothesis:
        """A hypothesis made of the objects of both parents.

        If one parent has no objects, the result is the other one. An object keeps the identity of the largest
        predicted object in it, and its motion history if its voxels are exactly those predicted.
        """
        check_grid("the proposed hypothesis", proposed, predicted.grid)
        if not predicted.objects:
            return proposed
        if not proposed.objects:
            return predicted
        voxels = OccupiedVoxels.of(proposed.labels, predicted.labels)
        graph = graph_of(voxels)
        resolution = self.resolve(rng, graph)
        groups, numbers = _renumbered(_painted(graph, resolution, voxels))
        if len(groups) > MAX_LABEL:
            raise InputError(
                f"crossover of {len(proposed.objects)} proposed and {len(predicted.objects)} predicted objects gives "
                f"{len(groups)}, at most {MAX_LABEL} have a label",
                "remove objects of one or two voxels before crossover",
            )
        labels = self.mode_filter.apply(voxels.spread(numbers.astype(np.uint16)))
        remaining, numbers = _renumbered(labels.reshape(-1)[voxels.at])
        child = _Child(voxels, graph, resolution.group, groups[remaining - 1] - 1, numbers)
        return child.hypothesis((proposed, predicted))

    def resolve(self, rng: np.random.Generator, graph: ConflictGraph) -> ConflictResolution:
        """Draw a resolution of all conflicts."""
        return resolve(rng, graph, self.structure, self.merge, self.drop_rule)


def assign_labels(
    graph: ConflictGraph, resolution: ConflictResolution, proposed: np.ndarray, predicted: np.ndarray
) -> np.ndarray:
    """Labels (X, Y, Z) uint16, with k + 1 for group k, from the label grids of both parents."""
    voxels = OccupiedVoxels.of(proposed, predicted)
    return as_labels(voxels.spread(_painted(graph, resolution, voxels)), "painted label grid")


def _painted(graph: ConflictGraph, resolution: ConflictResolution, voxels: OccupiedVoxels) -> np.ndarray:
    """Group + 1 of each occupied voxel (n,), 0 if its object was dropped. A later object covers an earlier one."""
    rank = np.zeros(len(graph), np.int64)
    rank[resolution.order] = np.arange(1, len(resolution.order) + 1)
    groups, ranks = (
        [graph.by_label(side, values)[voxels.labels[side]] for side in SIDES]
        for values in (resolution.group + 1, rank)
    )
    return np.where(ranks[PREDICTED] > ranks[PROPOSED], groups[PREDICTED], groups[PROPOSED])


def _renumbered(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The labels > 0 that occur, ascending, and the array with these labels renumbered to 1, 2, ..."""
    present, index = np.unique(np.append(labels, 0), return_inverse=True)
    return present[1:], index[:-1]


@dataclass(frozen=True, eq=False)
class _Child:
    """The labels of a child, and the objects of the parents from which they come."""

    voxels: OccupiedVoxels
    graph: ConflictGraph
    group: np.ndarray  #: (vertices,) group of each vertex
    groups: np.ndarray  #: (objects,) group of each object of the child
    numbers: np.ndarray  #: (n,) object of each voxel, 1, 2, ...; 0 is free

    def hypothesis(self, parents: tuple[Hypothesis, Hypothesis]) -> Hypothesis:
        """The child with records and occupancy of the parents."""
        labels = self.voxels.spread(self.numbers.astype(np.uint16))
        child = Hypothesis(labels, parents[0].grid, self._records(parents))
        if all(parent.occupancy is None for parent in parents):
            return child
        return replace(child, occupancy=self._occupancy(labels, parents))

    def _records(self, parents: tuple[Hypothesis, Hypothesis]) -> tuple[ObjectRecord, ...]:
        """The record of each object: that of its head. The motion history ends where the voxels are others."""
        heads = self._heads()
        record_of = [{record.label: record for record in parent.objects} for parent in parents]
        kinds = zip(self.graph.side[heads].tolist(), self.graph.label[heads].tolist(), strict=True)
        records = [replace(record_of[side][label], label=k) for k, (side, label) in enumerate(kinds, start=1)]
        unchanged = self._unchanged(heads).tolist()
        return tuple(r if same else r.changed() for r, same in zip(records, unchanged, strict=True))

    def _heads(self) -> np.ndarray:
        """The head (objects,) of each group: its largest predicted vertex, else its largest proposed vertex."""
        side, size = self.graph.side.tolist(), self.graph.size.tolist()
        ranking = sorted(range(len(self.graph)), key=lambda v: (side[v], size[v], -v))
        head_of = {int(self.group[v]): v for v in ranking}  # the last one of a group counts
        return np.array([head_of[group] for group in self.groups.tolist()], np.int64)

    def _unchanged(self, heads: np.ndarray) -> np.ndarray:
        """Whether each object (objects,) has exactly the voxels of its head in the parent."""
        side, label = self.graph.side[heads], self.graph.label[heads]
        inside = self.numbers > 0
        number = self.numbers[inside] - 1
        proposed, predicted = (labels[inside] for labels in self.voxels.labels)
        same = np.where(side[number] == PREDICTED, predicted, proposed) == label[number]
        size, kept = (np.bincount(n, minlength=len(heads)) for n in (number, number[same]))
        return (size == kept) & (size == self.graph.size[heads])

    def _occupancy(self, labels: np.ndarray, parents: tuple[Hypothesis, Hypothesis]) -> Occupancy:
        """The larger probability of the parents; at least one half where the child has a label, at most elsewhere."""
        owner, p = labels.copy(), np.where(labels > 0, np.float16(0.5), np.float16(0))
        heir = np.searchsorted(self.groups, self.group) + 1
        heir[~np.isin(self.group, self.groups)] = 0
        for side, parent in enumerate(parents):
            inherited = self.graph.by_label(side, heir.astype(np.uint16))[parent.shares.owner]
            probability = parent.shares.probability
            more = (inherited > 0) & (probability > p) & ((labels == 0) | (inherited == labels))
            owner[more], p[more] = inherited[more], probability[more]
        return Occupancy(owner, np.where(labels > 0, p, np.minimum(p, np.float16(0.5))))

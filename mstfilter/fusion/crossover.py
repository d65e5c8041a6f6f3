"""Two hypotheses into one: conflict-graph crossover (paper, section IV-D, figure 5).

>>> child = Crossover().mix(rng, proposed, predicted)

Objects of the two hypotheses that overlap are in conflict. In each component of the conflict graph a random
structure says along which conflicts objects may be merged, and in which order the rest is painted, later over
earlier. Whatever has no conflict is inserted as it is. Then a mode filter takes the speckle away.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mstfilter.errors import InputError
from mstfilter.fusion.conflict_graph import PREDICTED, PROPOSED, ConflictGraph, conflict_graph
from mstfilter.fusion.division import part_like, remember_like
from mstfilter.fusion.merging import MergeRule, merge_probability
from mstfilter.fusion.mode_filter import ModeFilter
from mstfilter.fusion.structure import SpanningTree, Structure
from mstfilter.scene.voxels import Hypothesis, ObjectRecord

__all__ = ["Crossover", "Draw"]

Strangers = Mapping[int, set[int]]
_NONE: set[int] = set()


class Draw(NamedTuple):
    """One resolution of all conflicts.

    order : vertices in painting order, first to last; group : representative vertex of each vertex's merge group
    (-1: the object is dropped).
    """

    order: list[int]
    group: np.ndarray


@dataclass(frozen=True)
class Crossover:
    """Conflict-graph crossover.

    Parameters
    ----------
    structure : Structure
        Painting order and candidate merges.
    merge : {"share", "printed", "iou", "always", "never"}
        Probability of a merge along a directed edge (`mstfilter.fusion.merging`).
    mode_filter : ModeFilter
        What is left is smoothed by it.
    drop_rule : bool
        A fault of the authors' program, on request: a conflict-free object is lost if its vertex number exceeds
        that of every conflicting vertex.
    """

    structure: Structure = SpanningTree()  # noqa: RUF009 (frozen)
    merge: MergeRule = "share"
    mode_filter: ModeFilter = ModeFilter(scope="disputed")  # noqa: RUF009 (frozen)
    drop_rule: bool = False

    def mix(
        self,
        rng: np.random.Generator,
        proposed: Hypothesis,
        predicted: Hypothesis,
        from_predicted: np.ndarray | None = None,
    ) -> Hypothesis:
        """A hypothesis made of both parents.

        In the voxels `from_predicted` (X, Y, Z) bool, predicted objects are painted last, whatever the order.
        A parent without objects leaves the other one unchanged. An object keeps the identity of the largest
        predicted object in it, and its motion history where its voxels are exactly those predicted.
        """
        if proposed.grid != predicted.grid:
            raise InputError(
                f"hypotheses lie on different grids: {proposed.grid.shape} at {proposed.grid.origin.tolist()} and "
                f"{predicted.grid.shape} at {predicted.grid.origin.tolist()}",
                "all hypotheses of a run share one workspace",
            )
        if not predicted.objects:
            return proposed
        if not proposed.objects:
            return predicted
        proposed = part_like(proposed, predicted)
        graph = conflict_graph(proposed.labels, predicted.labels)
        draw = self.draw(rng, graph, _strangers(graph, proposed, predicted))
        labels, disputed = self.paint(graph, draw, proposed.labels, predicted.labels, from_predicted)
        labels = self.mode_filter.apply(labels, disputed)
        return _with_records(labels, graph, draw, proposed, predicted)

    def draw(self, rng: np.random.Generator, graph: ConflictGraph, strangers: Strangers | None = None) -> Draw:
        """Draw a resolution of all conflicts of a graph.

        `strangers` names the vertices of each vertex' own side that it must not be merged with.
        """
        components = graph.components()
        conflicted = {v for component in components for v in component}
        group = np.arange(len(graph))
        loose = [v for v in range(len(graph)) if v not in conflicted]
        if self.drop_rule:
            last = max(conflicted, default=-1)
            group[[v for v in loose if v > last]] = -1
            loose = [v for v in loose if v <= last]
        order, neighbours = list(loose), graph.neighbours()
        intersection = {}
        for (a, b), count in zip(graph.edges.tolist(), graph.intersection.tolist(), strict=True):
            intersection[a, b] = intersection[b, a] = count
        for component in components:
            painted, edges = self.structure.draw(rng, component, neighbours)
            order.extend(painted)
            if not edges:
                continue
            child, parent = np.array(edges).T
            common = np.array([intersection[edge] for edge in edges])
            chance = merge_probability(self.merge, common, graph.size[child], graph.size[parent])
            merged = rng.random(len(edges)) < chance
            _unite(group, [e for e, yes in zip(edges, merged, strict=True) if yes], painted, strangers or {})
        return Draw(order, group)

    def paint(
        self,
        graph: ConflictGraph,
        draw: Draw,
        proposed: np.ndarray,
        predicted: np.ndarray,
        from_predicted: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Labels (X, Y, Z) uint16, group k painted as k + 1, and the voxels that stay disputed.

        Disputed are the voxels on which the parents still disagree after merging and whose object is part of
        such a disagreement: objects that both parents see alike, or only one sees, are not.
        """
        rank = np.empty(len(graph), np.int64)
        rank[draw.order] = np.arange(len(draw.order))
        group_of, rank_of = [], []
        for side, labels in ((PROPOSED, proposed), (PREDICTED, predicted)):
            mine = graph.side == side
            table = np.zeros(int(labels.max()) + 1, np.int32)
            ranks = np.full(int(labels.max()) + 1, -1, np.int32)
            table[graph.label[mine]] = draw.group[mine] + 1
            kept = mine & (draw.group >= 0)
            ranks[graph.label[kept]] = rank[kept]
            group_of.append(table[labels])
            rank_of.append(ranks[labels])
        later = rank_of[PREDICTED] > rank_of[PROPOSED]
        if from_predicted is not None:
            later |= from_predicted & (group_of[PREDICTED] > 0)
        out = np.where(later, group_of[PREDICTED], group_of[PROPOSED])
        differ = group_of[PROPOSED] != group_of[PREDICTED]
        clash = differ & (group_of[PROPOSED] > 0) & (group_of[PREDICTED] > 0)
        involved = np.zeros(len(graph) + 2, bool)
        involved[group_of[PROPOSED][clash]] = True
        involved[group_of[PREDICTED][clash]] = True
        return out.astype(np.uint16), differ & involved[out]


def _strangers(graph: ConflictGraph, proposed: Hypothesis, predicted: Hypothesis) -> Strangers:
    """For each vertex, those of its own side that it came apart from."""
    vertex: dict[tuple[int, int], int] = {}
    records = []
    for v in range(len(graph)):
        side = int(graph.side[v])
        record = (predicted if side == PREDICTED else proposed).record(int(graph.label[v]))
        vertex[side, record.id] = v
        records.append((side, record))
    return {
        v: {vertex[side, other] for other in record.apart if (side, other) in vertex}
        for v, (side, record) in enumerate(records)
        if record.apart
    }


def _unite(group: np.ndarray, merges: list[tuple[int, int]], order: list[int], strangers: Strangers) -> None:
    """Merge groups along child -> parent edges; the vertex painted last represents its group.

    A merge that would bring strangers together is left out.
    """
    place = {v: k for k, v in enumerate(order)}
    members = {v: {v} for v in order}

    def find(v: int) -> int:
        while group[v] != v:
            v = int(group[v])
        return v

    for child, parent in merges:
        a, b = find(child), find(parent)
        if a != b:
            low, high = sorted((a, b), key=place.__getitem__)
            if any(strangers.get(v, _NONE) & members[high] for v in members[low]):
                continue
            group[low] = high
            members[high] |= members.pop(low)
    for v in order:
        group[v] = find(v)


def _with_records(
    labels: np.ndarray, graph: ConflictGraph, draw: Draw, proposed: Hypothesis, predicted: Hypothesis
) -> Hypothesis:
    """Number the painted objects 1, 2, ... and give them the records of what they are made of."""
    sizes = np.bincount(labels.ravel())
    present = [int(k) for k in np.flatnonzero(sizes) if k > 0]
    compact = np.zeros(len(sizes), np.uint16)
    compact[present] = np.arange(1, len(present) + 1)
    parents, volumes = (proposed, predicted), (proposed.volumes(), predicted.volumes())
    records: list[ObjectRecord] = []
    number_of: dict[tuple[int, int], int] = {}  # side and label of a parent's object -> its number in the child
    for number, painted in enumerate(present, start=1):
        members = np.flatnonzero(draw.group == painted - 1)
        # The largest predicted member gives the identity; where there is none, the largest proposed one.
        best = max(members, key=lambda v: (graph.side[v], graph.size[v], -v))
        side, label = int(graph.side[best]), int(graph.label[best])
        parent = parents[side]
        record = parent.record(label)
        for v in members.tolist():
            number_of[int(graph.side[v]), int(graph.label[v])] = number
        whole = sizes[painted] == volumes[side][label]
        unchanged = whole and bool((labels[parent.labels == label] == painted).all())
        record = replace(record, label=number)
        records.append(record if unchanged else record.changed())
    child = Hypothesis(compact[labels], predicted.grid, tuple(replace(r, apart=frozenset()) for r in records))
    for side, parent in enumerate(parents):
        own = {label: number for (s, label), number in number_of.items() if s == side}
        child = remember_like(child, parent, own)
    return child

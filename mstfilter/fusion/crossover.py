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
from mstfilter.fusion.conflicts import PREDICTED, PROPOSED, Claimed, ConflictGraph, claimed, graph_of
from mstfilter.fusion.division import part_like, remember_like
from mstfilter.fusion.merging import MergeRule, merge_probability
from mstfilter.fusion.mode_filter import ModeFilter
from mstfilter.fusion.structure import SpanningTree, Structure
from mstfilter.scene import MAX_LABEL, Hypothesis, ObjectRecord, as_labels

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
            one, other = (
                f"{g.shape} voxels of {g.voxel_size:g} m at {g.origin.tolist()}"
                for g in (proposed.grid, predicted.grid)
            )
            raise InputError(
                f"hypotheses lie on different grids: the proposed one has {one}, the predicted one {other}",
                "all hypotheses of a run share one workspace",
            )
        if not predicted.objects:
            return proposed
        if not proposed.objects:
            return predicted
        proposed = part_like(proposed, predicted)
        voxels = claimed(proposed.labels, predicted.labels)
        graph = graph_of(voxels)
        draw = self.draw(rng, graph, _strangers(graph, proposed, predicted))
        painted, disputed = _painted(graph, draw, voxels, from_predicted)
        groups, numbers = _numbered(painted)
        if len(groups) > MAX_LABEL:
            raise InputError(
                f"crossover of {len(proposed.objects)} proposed and {len(predicted.objects)} predicted objects gives "
                f"{len(groups)}, at most {MAX_LABEL} can be told apart",
                "objects of a voxel or two are noise: drop them before fusion",
            )
        labels = self.mode_filter.apply(voxels.spread(numbers.astype(np.uint16)), voxels.spread(disputed))
        left, numbers = _numbered(labels.reshape(-1)[voxels.at])
        return _with_records(voxels, numbers, groups[left - 1] - 1, graph, draw, proposed, predicted)

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
        voxels = claimed(proposed, predicted)
        painted, disputed = _painted(graph, draw, voxels, from_predicted)
        return as_labels(voxels.spread(painted), "painted label grid"), voxels.spread(disputed)


def _painted(
    graph: ConflictGraph, draw: Draw, voxels: Claimed, from_predicted: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Group + 1 of each claimed voxel (n,), 0 where its object was dropped, and whether it stays disputed (n,)."""
    rank = np.empty(len(graph), np.int64)
    rank[draw.order] = np.arange(len(draw.order))
    group_of, rank_of = [], []
    for side, labels in ((PROPOSED, voxels.proposed), (PREDICTED, voxels.predicted)):
        mine = graph.side == side
        table = np.zeros(int(labels.max(initial=0)) + 1, np.int64)
        ranks = np.full(len(table), -1)
        table[graph.label[mine]] = draw.group[mine] + 1
        kept = mine & (draw.group >= 0)
        ranks[graph.label[kept]] = rank[kept]
        group_of.append(table[labels])
        rank_of.append(ranks[labels])
    later = rank_of[PREDICTED] > rank_of[PROPOSED]
    if from_predicted is not None:
        if from_predicted.shape != voxels.shape or from_predicted.dtype != bool:
            raise InputError(
                f"from_predicted is {from_predicted.dtype} of shape {from_predicted.shape}, expected bool of "
                f"shape {voxels.shape}"
            )
        later |= from_predicted.reshape(-1)[voxels.at] & (group_of[PREDICTED] > 0)
    out = np.where(later, group_of[PREDICTED], group_of[PROPOSED])
    differ = group_of[PROPOSED] != group_of[PREDICTED]
    clash = differ & (group_of[PROPOSED] > 0) & (group_of[PREDICTED] > 0)
    involved = np.zeros(len(graph) + 1, bool)
    involved[group_of[PROPOSED][clash]] = True
    involved[group_of[PREDICTED][clash]] = True
    return out, differ & involved[out]


def _numbered(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels that occur, ascending, 0 left out, and the array with their positions 1, 2, ... in their place."""
    counts = np.bincount(labels, minlength=1)
    counts[0] = 0
    present = np.flatnonzero(counts)
    table = np.zeros(len(counts), np.int64)
    table[present] = np.arange(1, len(present) + 1)
    return present, table[labels]


def _strangers(graph: ConflictGraph, proposed: Hypothesis, predicted: Hypothesis) -> Strangers:
    """For each vertex, those of its own side that it came apart from."""
    if not any(r.apart for h in (proposed, predicted) for r in h.objects):
        return {}
    record_of = {(side, r.label): r for side, h in ((PROPOSED, proposed), (PREDICTED, predicted)) for r in h.objects}
    records = [record_of[key] for key in zip(graph.side.tolist(), graph.label.tolist(), strict=True)]
    vertex = {(int(side), record.id): v for v, (side, record) in enumerate(zip(graph.side, records, strict=True))}
    return {
        v: {vertex[side, other] for other in record.apart if (side, other) in vertex}
        for v, (side, record) in enumerate(zip(graph.side.tolist(), records, strict=True))
        if record.apart
    }


def _unite(group: np.ndarray, merges: list[tuple[int, int]], order: list[int], strangers: Strangers) -> None:
    """Merge groups along child -> parent edges; the vertex painted last represents its group.

    A merge that would bring strangers together is left out.
    """
    place = {v: k for k, v in enumerate(order)}
    members = {v: {v} for v in order} if strangers else {}

    def find(v: int) -> int:
        root = v
        while group[root] != root:
            root = int(group[root])
        while group[v] != root:  # the next search is short
            group[v], v = root, int(group[v])
        return root

    for child, parent in merges:
        a, b = find(child), find(parent)
        if a != b:
            low, high = sorted((a, b), key=place.__getitem__)
            if strangers:
                if any(strangers.get(v, _NONE) & members[high] for v in members[low]):
                    continue
                members[high] |= members.pop(low)
            group[low] = high
    for v in order:
        group[v] = find(v)


def _with_records(
    voxels: Claimed,
    numbers: np.ndarray,
    groups: np.ndarray,
    graph: ConflictGraph,
    draw: Draw,
    proposed: Hypothesis,
    predicted: Hypothesis,
) -> Hypothesis:
    """The child, objects 1, 2, ... of `groups` (m,) at `numbers` (n,), with the records of what they are made of."""
    # The largest predicted member gives the identity; where there is none, the largest proposed one.
    order = np.lexsort((-np.arange(len(graph)), graph.size, graph.side, draw.group))
    last = np.append(np.diff(draw.group[order]) != 0, True)
    best_of = dict(zip(draw.group[order[last]].tolist(), order[last].tolist(), strict=True))
    best = np.array([-1, *(best_of[g] for g in groups.tolist())], np.int64)  # of each number, 0 free
    side, label = graph.side[best], graph.label[best]
    own = np.where(side[numbers] == PREDICTED, voxels.predicted, voxels.proposed) == label[numbers]
    sizes, kept = (np.bincount(n, minlength=len(best)) for n in (numbers, numbers[own]))
    unchanged = (sizes == graph.size[best]) & (kept == sizes)
    parents = (proposed, predicted)
    record_of = [{r.label: r for r in parent.objects} for parent in parents]
    records: list[ObjectRecord] = []
    for number in range(1, len(best)):
        record = replace(record_of[side[number]][int(label[number])], label=number, apart=frozenset())
        records.append(record if unchanged[number] else record.changed())
    child = Hypothesis(voxels.spread(numbers.astype(np.uint16)), predicted.grid, tuple(records))
    number_of = {g: number for number, g in enumerate(groups.tolist(), start=1)}
    for which, parent in enumerate(parents):
        mine = np.flatnonzero(graph.side == which)
        heirs = zip(graph.label[mine].tolist(), draw.group[mine].tolist(), strict=True)
        child = remember_like(child, parent, {k: number_of[g] for k, g in heirs if g in number_of})
    return child

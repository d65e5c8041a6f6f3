"""Crossover of two hypotheses by their conflict graph (paper, section IV-D, figure 5).

>>> child = Crossover().cross(rng, proposed, predicted)

1. `graph_of` builds the conflict graph: two objects that share voxels are in conflict.
2. `Crossover.resolve` draws, for each connected component of the graph, which objects are merged, and the order in
   which all of them are painted. A later object covers an earlier one.
3. `Crossover.assign_labels` writes the labels. Objects without conflict are copied.
4. `ModeFilter` removes the speckle that painting leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from mstfilter.crossover import PREDICTED, PROPOSED, ConflictGraph, SpanningTree, Structure, merge_probability
from mstfilter.crossover.conflicts import ClaimedVoxels, MergeRule, claimed_voxels, components_in_conflict, graph_of
from mstfilter.errors import InputError, check_choice, check_integer, check_number
from mstfilter.scene import MAX_LABEL, Hypothesis, ObjectRecord, Occupancy, as_labels, check_grid

_CHUNK = 2**19  # number of window cells processed together, so that they fit in the cache of the processor


class ConflictResolution(NamedTuple):
    """One resolution of all conflicts of a conflict graph."""

    #: Vertices in painting order, first to last.
    order: list[int]
    #: For each vertex, the vertex of its merge group that is painted last; -1 if the object is dropped.
    group: np.ndarray


@dataclass(frozen=True)
class ModeFilter:
    """Majority filter over label grids.

    The label of an occupied voxel is replaced by the most frequent other label in its window, if the count of this
    label exceeds that of its own by at least `margin`. Of equally frequent labels the larger one is used. Free cells
    are not counted as a label, but an occupied voxel with more than `isolation` free cells in its window becomes
    free. All voxels of a sweep change at the same time. Sweeps are repeated until no voxel changes.

    Parameters
    ----------
    window : int
        Edge of the cubic window in voxels, odd. 1 switches the filter off.
    margin : int
        Least difference of the counts of the other label and the voxel's own label.
    isolation : int
        Largest number of free cells in the window of an occupied voxel; with more it becomes free. No effect if at
        least ``window**3``.
    max_sweeps : int
        Largest number of sweeps.
    scope : {"everywhere", "disputed"}
        Voxels that may change: all, or disputed ones (see `Crossover.assign_labels`). "everywhere" removes objects
        that are thinner than half a window, for example a 2 cm book or a rod.
    """

    window: int = 5
    margin: int = 3
    isolation: int = 120
    max_sweeps: int = 100
    scope: Literal["everywhere", "disputed"] = "everywhere"

    def __post_init__(self) -> None:
        check_integer("mode filter window", self.window)
        check_integer("mode filter isolation", self.isolation, at_least=0)
        check_integer("mode filter max_sweeps", self.max_sweeps)
        check_number("mode filter margin", self.margin)
        if self.window % 2 == 0:
            raise InputError(f"mode filter window is {self.window}, expected an odd number of voxels")
        check_choice("mode filter scope", self.scope, ("everywhere", "disputed"))

    def apply(self, labels: np.ndarray, disputed: np.ndarray | None = None) -> np.ndarray:
        """Filtered labels (X, Y, Z) uint16, 0 is free.

        `disputed` (X, Y, Z) bool are the voxels that may change if `scope` is "disputed"; None is no voxel.
        """
        labels = as_labels(labels)
        if labels.ndim != 3:
            raise InputError(f"label grid has shape {labels.shape}, the mode filter expects three axes")
        if disputed is None:
            disputed = np.zeros(labels.shape, bool)
        if disputed.shape != labels.shape or disputed.dtype != bool:
            raise InputError(
                f"disputed is {disputed.dtype} of shape {disputed.shape}, expected bool of shape {labels.shape}"
            )
        may_change = labels != 0
        if self.scope == "disputed":
            may_change &= disputed
        if self.window == 1 or not may_change.any():
            return labels
        # Work inside the box that sweeps can reach, with a border of free cells so that every window is complete.
        half = self.window // 2
        where = np.nonzero(may_change)
        box = tuple(
            slice(max(int(w.min()) - half, 0), min(int(w.max()) + half + 1, n))
            for w, n in zip(where, labels.shape, strict=True)
        )
        padded = np.pad(np.ascontiguousarray(labels[box]), half)
        at = np.ravel_multi_index([w - b.start + half for w, b in zip(where, box, strict=True)], padded.shape)
        sides = [
            np.minimum(w + half + 1, n) - np.maximum(w - half, 0) for w, n in zip(where, labels.shape, strict=True)
        ]
        votes = _Votes(self, padded, at, np.prod(sides, axis=0))
        changed = votes.sweep(votes.unsettled())
        for _ in range(self.max_sweeps - 1):
            if not len(changed):
                break
            changed = votes.sweep(votes.near(changed))
        out = labels.copy()
        out[box] = padded[(slice(half, -half),) * 3]
        return out


@dataclass(frozen=True)
class Crossover:
    """Conflict-graph crossover.

    Parameters
    ----------
    structure : Structure
        Painting order and candidate merges.
    merge : {"share", "printed", "iou", "match", "covered", "always", "never"}
        Probability of a merge along a directed edge (`mstfilter.crossover.conflicts`).
    mode_filter : ModeFilter
        Smooths the painted labels.
    drop_rule : bool
        Reproduces a fault of the authors' program: an object without conflict is lost if its vertex number exceeds
        that of every vertex in conflict.
    """

    structure: Structure = SpanningTree()  # noqa: RUF009 (frozen)
    merge: MergeRule = "share"
    mode_filter: ModeFilter = ModeFilter(scope="disputed")
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
        voxels = claimed_voxels(proposed.labels, predicted.labels)
        graph = graph_of(voxels)
        resolution = self.resolve(rng, graph)
        painted, disputed = _painted(graph, resolution, voxels)
        groups, numbers = _numbered(painted)
        if len(groups) > MAX_LABEL:
            raise InputError(
                f"crossover of {len(proposed.objects)} proposed and {len(predicted.objects)} predicted objects gives "
                f"{len(groups)}, at most {MAX_LABEL} have a label",
                "remove objects of one or two voxels before fusion",
            )
        labels = self.mode_filter.apply(voxels.spread(numbers.astype(np.uint16)), voxels.spread(disputed))
        remaining, numbers = _numbered(labels.reshape(-1)[voxels.at])
        return _with_records(voxels, numbers, groups[remaining - 1] - 1, graph, resolution, proposed, predicted)

    def resolve(self, rng: np.random.Generator, graph: ConflictGraph) -> ConflictResolution:
        """Draw a resolution of all conflicts."""
        links = graph.networkx()
        components = components_in_conflict(links)
        conflicted = {v for component in components for v in component}
        group = np.arange(len(graph))
        order = [v for v in range(len(graph)) if v not in conflicted]
        if self.drop_rule:
            last = max(conflicted, default=-1)
            group[[v for v in order if v > last]] = -1
            order = [v for v in order if v <= last]
        for component in components:
            painted, edges = self.structure.draw(rng, links, component)
            order.extend(painted)
            if not edges:
                continue
            child, parent = np.array(edges).T
            common = np.array([links.edges[edge]["intersection"] for edge in edges])
            chance = merge_probability(self.merge, common, graph.size[child], graph.size[parent])
            merged = rng.random(len(edges)) < chance
            _unite(group, [e for e, yes in zip(edges, merged, strict=True) if yes], painted)
        return ConflictResolution(order, group)

    def assign_labels(
        self, graph: ConflictGraph, resolution: ConflictResolution, proposed: np.ndarray, predicted: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Labels (X, Y, Z) uint16, with k + 1 for group k, and the disputed voxels (X, Y, Z) bool.

        A voxel is disputed if the parents assign it to different groups, and its group overlaps another one. Objects
        that are equal in both parents, or that occur in one parent only, have no disputed voxels.
        """
        voxels = claimed_voxels(proposed, predicted)
        painted, disputed = _painted(graph, resolution, voxels)
        return as_labels(voxels.spread(painted), "painted label grid"), voxels.spread(disputed)


def _painted(
    graph: ConflictGraph, resolution: ConflictResolution, voxels: ClaimedVoxels
) -> tuple[np.ndarray, np.ndarray]:
    """Group + 1 of each claimed voxel (n,), 0 if its object was dropped, and whether it stays disputed (n,)."""
    rank = np.empty(len(graph), np.int64)
    rank[resolution.order] = np.arange(len(resolution.order))
    group_of, rank_of = [], []
    for side, labels in ((PROPOSED, voxels.proposed), (PREDICTED, voxels.predicted)):
        on_side = graph.side == side
        table = np.zeros(int(labels.max(initial=0)) + 1, np.int64)
        ranks = np.full(len(table), -1)
        table[graph.label[on_side]] = resolution.group[on_side] + 1
        kept = on_side & (resolution.group >= 0)
        ranks[graph.label[kept]] = rank[kept]
        group_of.append(table[labels])
        rank_of.append(ranks[labels])
    later = rank_of[PREDICTED] > rank_of[PROPOSED]
    out = np.where(later, group_of[PREDICTED], group_of[PROPOSED])
    differ = group_of[PROPOSED] != group_of[PREDICTED]
    clash = differ & (group_of[PROPOSED] > 0) & (group_of[PREDICTED] > 0)
    involved = np.zeros(len(graph) + 1, bool)
    involved[group_of[PROPOSED][clash]] = True
    involved[group_of[PREDICTED][clash]] = True
    return out, differ & involved[out]


def _numbered(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The labels > 0 that occur, ascending, and the array with these labels renumbered to 1, 2, ..."""
    counts = np.bincount(labels, minlength=1)
    counts[0] = 0
    present = np.flatnonzero(counts)
    table = np.zeros(len(counts), np.int64)
    table[present] = np.arange(1, len(present) + 1)
    return present, table[labels]


def _unite(group: np.ndarray, merges: list[tuple[int, int]], order: list[int]) -> None:
    """Merge groups along child -> parent edges, in place. The vertex painted last represents its group."""
    place = {v: k for k, v in enumerate(order)}
    members = {v: {v} for v in order}
    for edge in merges:
        low, high = sorted((int(group[v]) for v in edge), key=place.__getitem__)
        if low == high:
            continue
        group[list(members[low])] = high
        members[high] |= members.pop(low)


def _with_records(
    voxels: ClaimedVoxels,
    numbers: np.ndarray,
    groups: np.ndarray,
    graph: ConflictGraph,
    resolution: ConflictResolution,
    proposed: Hypothesis,
    predicted: Hypothesis,
) -> Hypothesis:
    """The child hypothesis: object k = 1, 2, ... is group ``groups[k - 1]`` and has the voxels ``numbers == k``."""
    # The largest predicted member of a group gives the record; without one, the largest proposed member.
    order = np.lexsort((-np.arange(len(graph)), graph.size, graph.side, resolution.group))
    last = np.append(np.diff(resolution.group[order]) != 0, True)
    best_of = dict(zip(resolution.group[order[last]].tolist(), order[last].tolist(), strict=True))
    best = np.array([-1, *(best_of[g] for g in groups.tolist())], np.int64)  # of each number, 0 free
    side, label = graph.side[best], graph.label[best]
    same = np.where(side[numbers] == PREDICTED, voxels.predicted, voxels.proposed) == label[numbers]
    sizes, kept = (np.bincount(n, minlength=len(best)) for n in (numbers, numbers[same]))
    unchanged = (sizes == graph.size[best]) & (kept == sizes)
    parents = (proposed, predicted)
    record_of = [{r.label: r for r in parent.objects} for parent in parents]
    records: list[ObjectRecord] = []
    for number in range(1, len(best)):
        record = replace(record_of[side[number]][int(label[number])], label=number)
        records.append(record if unchanged[number] else record.changed())
    child = Hypothesis(voxels.spread(numbers.astype(np.uint16)), predicted.grid, tuple(records))
    number_of = {g: number for number, g in enumerate(groups.tolist(), start=1)}
    claims: list[tuple[np.ndarray, np.ndarray]] = []
    for which, parent in enumerate(parents):
        on_side = graph.side == which
        heirs = zip(graph.label[on_side].tolist(), resolution.group[on_side].tolist(), strict=True)
        heir_of = {k: number_of[g] for k, g in heirs if g in number_of}
        table = np.zeros(MAX_LABEL + 1, np.uint16)
        table[list(heir_of)] = list(heir_of.values())
        claims.append((table[parent.shares.owner], parent.shares.probability))
    if all(parent.occupancy is None for parent in parents):
        return child
    return replace(child, occupancy=_crossed(child.labels, claims))


def _crossed(labels: np.ndarray, claims: Sequence[tuple[np.ndarray, np.ndarray]]) -> Occupancy:
    """The occupancy of a child with `labels` from owners (X, Y, Z), in its labels, and probabilities of its parents.

    The larger probability counts, and at least one half where the child has a label.
    """
    owner, p = labels.copy(), np.where(labels > 0, np.float16(0.5), np.float16(0))
    for claimed, probability in claims:
        more = (claimed > 0) & (probability > p) & ((labels == 0) | (claimed == labels))
        owner[more], p[more] = claimed[more], probability[more]
    return Occupancy(owner, np.where(labels > 0, p, np.minimum(p, np.float16(0.5))))


# The sweeps of the mode filter --------------------------------------------------------------------------------------


class _Votes:
    """A label grid under the filter, swept in place.

    A voxel can change only if a cell in its window has changed since the last sweep. So the first sweep processes the
    voxels whose window contains another object or much free space, and each later sweep those near a changed cell.

    `labels` (X, Y, Z) uint16 have a border of half a window and are in C order. `at` (n,) are flat indices of the
    voxels that may change, and `cells` (n,) the numbers of grid cells in their windows.
    """

    def __init__(self, filter: ModeFilter, labels: np.ndarray, at: np.ndarray, cells: np.ndarray) -> None:
        self.filter, self.labels, self.flat, self.at, self.cells = filter, labels, labels.reshape(-1), at, cells
        steps = np.indices((filter.window,) * 3).reshape(3, -1) - filter.window // 2
        self.offsets = np.array(labels.strides) // labels.itemsize @ steps
        self.count_type = np.min_scalar_type(len(self.offsets))
        self.chunk = max(1, _CHUNK // len(self.offsets))

    def unsettled(self) -> np.ndarray:
        """Positions in `at` of voxels that a sweep may change."""
        window, half = self.filter.window, self.filter.window // 2
        inner = self.labels[(slice(half, -half),) * 3]
        # Free wraps to the largest number, so the smallest one is the label of an object.
        below = self.labels - np.uint16(1)
        mixed = _over_window(np.maximum, self.labels, window) != inner
        mixed |= _over_window(np.minimum, below, window) != below[(slice(half, -half),) * 3]
        taken = _over_window(np.add, (self.labels != 0).astype(self.count_type), window)
        inside = np.zeros(self.labels.shape, bool)
        inside[(slice(half, -half),) * 3] = mixed
        counts = np.zeros(self.labels.shape, self.count_type)
        counts[(slice(half, -half),) * 3] = taken
        free = self.cells - counts.reshape(-1)[self.at]
        return np.flatnonzero(inside.reshape(-1)[self.at] | (free > self.filter.isolation))

    def near(self, changed: np.ndarray) -> np.ndarray:
        """Positions in `at` of occupied voxels whose window holds one of the cells `changed` (flat indices)."""
        touched = np.zeros(self.flat.shape, bool)
        for k in range(0, len(changed), self.chunk):
            touched[changed[k : k + self.chunk, None] + self.offsets] = True
        return np.flatnonzero(touched[self.at] & (self.flat[self.at] != 0))

    def sweep(self, positions: np.ndarray) -> np.ndarray:
        """All voxels at these positions vote at the same time. Returns the flat indices of those that changed."""
        at, cells = self.at[positions], self.cells[positions]
        new = np.empty(len(at), np.uint16)
        for k in range(0, len(at), self.chunk):
            new[k : k + self.chunk] = self._elected(at[k : k + self.chunk], cells[k : k + self.chunk])
        differ = new != self.flat[at]
        self.flat[at[differ]] = new[differ]
        return at[differ]

    def _elected(self, at: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Labels (m,) after the vote of voxels `at` (m,) with `cells` (m,) grid cells in their windows."""
        windows = self.flat[at + self.offsets[:, None]]
        own = self.flat[at]
        is_own = windows == own
        own_count = self._count(is_own)
        taken = self._count(windows != 0)
        out = own.copy()
        # Other labels are counted one by one only where all of them together would win.
        open_ = np.flatnonzero(taken - own_count >= own_count + self.filter.margin)
        others = windows[:, open_] * ~is_own[:, open_]
        left = (taken - own_count)[open_]
        best, winner = np.zeros(len(own), np.int64), np.zeros(len(own), np.uint16)
        while True:  # count the labels from the largest down; a tie goes to the larger label
            going = left > best[open_]
            open_, left, others = open_[going], left[going], others[:, going]
            if not len(open_):
                break
            top = others.max(axis=0)
            is_top = others == top
            count = self._count(is_top)
            ahead = count > best[open_]
            best[open_[ahead]], winner[open_[ahead]] = count[ahead], top[ahead]
            left = left - count
            others *= ~is_top
        wins = (best > own_count) | ((best == own_count) & (winner > own))
        wins &= best >= own_count + self.filter.margin
        out[wins] = winner[wins]
        out[cells - taken > self.filter.isolation] = 0
        return out

    def _count(self, hit: np.ndarray) -> np.ndarray:
        return hit.sum(axis=0, dtype=self.count_type).astype(np.int64)


def _over_window(function: np.ufunc, cells: np.ndarray, window: int) -> np.ndarray:
    """`function` over every window that lies in the grid: each axis gets shorter by ``window - 1``."""
    for axis in range(3):
        n = cells.shape[axis] - window + 1
        along = np.moveaxis(cells, axis, 0)
        out = along[:n].copy()
        for k in range(1, window):
            function(out, along[k : k + n], out=out)
        cells = np.moveaxis(out, 0, axis)
    return cells

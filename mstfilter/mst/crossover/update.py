"""The published measurement update: weighted candidates, each made of one prediction and one sample.

>>> fused = CrossoverUpdate().update(rng, predicted, proposed, clip)

1. Free-space projection clears the voxels of every prediction j that the frame observes as free, and leaves the share
   Q_j of its voxels.
2. Every sample i and every prediction j make `eta` candidates by crossover. The weight of a candidate depends only on
   the weights w_i and w_j of its parents (section IV-E; lambda is `quality_exponent`):

       ``log w = log w_i + log w_j + lambda log Q_j``

   So the weights are known in advance, candidates can be resampled first, and only the selected ones are built.

Without a proposal, the update only projects and weights the predictions. This is the manifold filter of Koval,
Pollard and Srinivasa (2015): if few states agree with an observation, hardly any prediction does, so every particle
is projected onto the set of those that agree.

A crossover has four steps (paper, figure 5):

>>> child = Crossover().cross(rng, proposed, predicted)

1. `graph_of` builds the conflict graph, in which two objects that share voxels are in conflict.
2. `resolve` draws, for each connected component of the graph, which objects are merged, and the order in which all
   objects are painted. Later ones cover earlier ones.
3. `assign_labels` paints the objects into one label grid. Those without conflict are copied.
4. `mstfilter.mst.crossover.ModeFilter` removes speckle from the painted labels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import Bounded, NonNegativeFloat, PositiveInt
from mstfilter.mst.crossover.conflicts import (
    PREDICTED,
    PROPOSED,
    SIDES,
    ConflictGraph,
    ConflictResolution,
    MergeRule,
    OccupiedVoxels,
    SpanningTree,
    Structure,
    graph_of,
    resolve,
)
from mstfilter.mst.crossover.mode_filter import ModeFilter
from mstfilter.scene import (
    MAX_LABEL,
    Clip,
    FreeSpace,
    Hypothesis,
    ObjectRecord,
    Occupancy,
    Projection,
    as_labels,
    check_grid,
    check_grids,
    free_id,
    log_quality,
)
from mstfilter.smc import Candidates, Population, Update, child, key_of, union


@dataclass(frozen=True)
class Crossover(Bounded):
    """Conflict-graph crossover.

    Parameters
    ----------
    structure : Structure
        Samples the painting order and the edges along which objects may be merged.
    merge : {"share", "printed", "always", "never"}
        Probability of a merge along a directed edge (`mstfilter.mst.crossover.conflicts`).
    mode_filter : ModeFilter
        Smooths the painted labels.
    drop_rule : bool
        Reproduces a fault of the authors' program, which `mstfilter.mst.crossover.conflicts.resolve` describes.
    """

    structure: Structure = SpanningTree()  # noqa: RUF009 (frozen)
    merge: MergeRule = "share"
    mode_filter: ModeFilter = ModeFilter()  # noqa: RUF009 (frozen)
    drop_rule: bool = False

    def cross(self, rng: np.random.Generator, proposed: Hypothesis, predicted: Hypothesis) -> Hypothesis:
        """A hypothesis from the objects of both parents.

        If one parent has no objects, the result is the other parent. Merged objects get the identity of the largest
        predicted object. A proposed object whose id is also the id of a predicted object gets another id. An object
        keeps its motion history if its voxels are exactly the predicted voxels.
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


@dataclass(frozen=True)
class CrossoverUpdate(Update):
    """Free-space projection and conflict-graph crossover.

    Parameters
    ----------
    free_space : Projection
        Projects predictions onto hypotheses that agree with the latest frame.
    crossover : Crossover
        Makes one hypothesis of two.
    eta : int
        Number of candidates of each pair of a sample and a prediction.
    quality_exponent : float
        Exponent lambda of Q in the weight.
    """

    free_space: Projection = FreeSpace()  # noqa: RUF009 (frozen)
    crossover: Crossover = Crossover()
    eta: PositiveInt = 5
    quality_exponent: NonNegativeFloat = 3.0

    properly_weighted: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """The candidates of all pairs of a sample and a prediction. Each candidate is built at its first access.

        Without a prediction, they are the samples, and without a proposal, the projected predictions.
        """
        if predicted is None:
            return union(None, proposed)
        refined, quality = self.free_space.refine(predicted.particles, observation)
        log_weights = predicted.log_weights + self.quality_exponent * log_quality(quality)
        notes = {"quality": quality.tolist()}
        prediction = Population(refined, log_weights, predicted.parents, notes)
        return prediction if proposed is None else self._crossed(rng, prediction, proposed, observation)

    def _crossed(
        self, rng: np.random.Generator, predicted: Population, proposed: Population, clip: Clip
    ) -> Population:
        """Candidates of all pairs of a sample and a prediction that `free_space` has changed."""
        check_grids("predicted", predicted.particles, predicted.particles[0].grid)
        check_grids("proposed", proposed.particles, predicted.particles[0].grid)
        i, j = _pairs(child(rng, "order"), len(proposed), len(predicted), self.eta)
        key = key_of(rng)

        def build(candidate: int) -> Hypothesis:
            stream = key.child("candidate", candidate).generator()
            sample, prediction = proposed.particles[i[candidate]], predicted.particles[j[candidate]]
            return self.crossover.cross(stream, sample.born_at(clip.index), prediction)

        sides = (("previous", predicted, j), ("proposed", proposed, i))
        parents = {name: side.parents.get(name, np.full(len(side), -1))[k] for name, side, k in sides}
        log_weights = proposed.log_weights[i] + predicted.log_weights[j]
        return Population(Candidates(build, len(i)), log_weights, parents, {**predicted.notes, "eta": self.eta})


def _pairs(rng: np.random.Generator, n_proposed: int, n_predicted: int, eta: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample i and prediction j of each candidate. Each pair occurs `eta` times in a row.

    Each sample is paired with the predictions in cyclic order, and their first predictions are drawn without
    replacement. Systematic resampling takes equal steps through nearly equal weights: if all samples began with the
    same prediction, it would often select that one.
    """
    rounds = -(-n_proposed // n_predicted)
    first = np.concatenate([rng.permutation(n_predicted) for _ in range(rounds)])[:n_proposed]
    i, k = np.divmod(np.arange(n_proposed * n_predicted), n_predicted)
    return i.repeat(eta), ((first[i] + k) % n_predicted).repeat(eta)


# The child of a crossover -------------------------------------------------------------------------------------------


def assign_labels(
    graph: ConflictGraph, resolution: ConflictResolution, proposed: np.ndarray, predicted: np.ndarray
) -> np.ndarray:
    """Labels (X, Y, Z) uint16, with k + 1 for group k, from the label grids of both parents."""
    voxels = OccupiedVoxels.of(proposed, predicted)
    return as_labels(voxels.spread(_painted(graph, resolution, voxels)), "painted label grid")


def _painted(graph: ConflictGraph, resolution: ConflictResolution, voxels: OccupiedVoxels) -> np.ndarray:
    """Group number + 1 of each occupied voxel (n,); 0 for dropped objects. Later objects cover earlier objects."""
    rank = np.zeros(len(graph), np.int64)
    rank[resolution.order] = np.arange(1, len(resolution.order) + 1)
    groups, ranks = (
        [graph.by_label(side, values)[voxels.labels[side]] for side in SIDES]
        for values in (resolution.group + 1, rank)
    )
    return np.where(ranks[PREDICTED] > ranks[PROPOSED], groups[PREDICTED], groups[PROPOSED])


def _renumbered(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The labels > 0 that occur, in ascending order, and the array with these labels renumbered to 1, 2, ..."""
    present, index = np.unique(np.append(labels, 0), return_inverse=True)
    return present[1:], index[:-1]


@dataclass(frozen=True, eq=False)
class _Child:
    """The labels of a child, and the objects of the parents from which the labels come."""

    voxels: OccupiedVoxels
    graph: ConflictGraph
    group: np.ndarray  #: (vertices,) group of each vertex
    groups: np.ndarray  #: (objects,) group of each object of the child
    numbers: np.ndarray  #: (n,) object of each voxel, 1, 2, ...; 0 is free

    def hypothesis(self, parents: tuple[Hypothesis, Hypothesis]) -> Hypothesis:
        """The child as a hypothesis, with each `ObjectRecord` and the occupancy from the parents."""
        labels = self.voxels.spread(self.numbers.astype(np.uint16))
        child = Hypothesis(labels, parents[0].grid, self._records(parents))
        if all(parent.occupancy is None for parent in parents):
            return child
        return replace(child, occupancy=self._occupancy(labels, parents))

    def _records(self, parents: tuple[Hypothesis, Hypothesis]) -> tuple[ObjectRecord, ...]:
        """The `ObjectRecord` of each object's head (`_heads`). If voxels have changed, the motion history ends.

        It was last seen when one of its parts was.
        """
        heads = self._heads()
        record_of = [{record.label: record for record in parent.objects} for parent in parents]
        kinds = zip(self.graph.side[heads].tolist(), self.graph.label[heads].tolist(), strict=True)
        seen: dict[int, int] = {}
        vertices = zip(self.group.tolist(), self.graph.side.tolist(), self.graph.label.tolist(), strict=True)
        for group, side, label in vertices:
            seen[group] = max(seen.get(group, 0), record_of[side][label].last_seen)
        taken = {record.id for record in parents[PREDICTED].objects}
        records = []
        for k, (side, label) in enumerate(kinds, start=1):
            record = record_of[side][label]
            identity = record.id if side == PREDICTED else free_id(record.id, taken)
            taken.add(identity)
            records.append(replace(record, label=k, id=identity, last_seen=seen[int(self.groups[k - 1])]))
        unchanged = self._unchanged(heads).tolist()
        return tuple(r if same else r.changed() for r, same in zip(records, unchanged, strict=True))

    def _heads(self) -> np.ndarray:
        """The largest predicted vertex (objects,) of each group, or the largest proposed one if none is predicted."""
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
        """The larger probability of both parents, at least .5 in labelled voxels and at most .5 in other voxels."""
        owner, p = labels.copy(), np.where(labels > 0, np.float16(0.5), np.float16(0))
        heir = np.searchsorted(self.groups, self.group) + 1
        heir[~np.isin(self.group, self.groups)] = 0
        for side, parent in enumerate(parents):
            inherited = self.graph.by_label(side, heir.astype(np.uint16))[parent.shares.owner]
            probability = parent.shares.probability
            more = (inherited > 0) & (probability > p) & ((labels == 0) | (inherited == labels))
            owner[more], p[more] = inherited[more], probability[more]
        return Occupancy(owner, np.where(labels > 0, p, np.minimum(p, np.float16(0.5))))

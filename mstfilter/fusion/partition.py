"""A measurement update that partitions the image, and completes every object from all that was seen of it.

>>> update = PartitionUpdate(completer=NetworkCompleter())
>>> fused = update.update(rng, predicted, proposed, clip)       # a candidate for each predicted hypothesis

1. Every sample and every prediction is a partition of the readings of the last frame: a sample by its segments, a
   prediction by the objects that lie at the readings. All of them together say how likely two cells of their common
   refinement belong to one object. The past is right with probability sum_j w_j Q_j^lambda, where Q_j is
   the share of the voxels of prediction j that the frame does not see through. Partitions are drawn by these odds
   (`mstfilter.fusion.cells`).
2. Each drawn partition is combined with a prediction j, drawn with probability proportional to w_j Q_j^lambda. A
   segment continues the predicted objects that lie mostly in it; an object has at most one. Objects that were seen to
   move apart are divided as in the prediction.
3. An object keeps its views: what earlier frames showed of it (`mstfilter.scene.ObjectView`). It is completed from
   the readings of this frame and from its views together. So evidence is remembered and guesses are not: no voxel
   that was guessed at an earlier pause is carried on. A predicted object without readings stays with probability
   (Q_j q)^lambda, where q is the share of its own voxels that the frame does not see through, unless the frame
   refutes all its views. At the first pause, the candidates are the samples.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice, zip_longest
from typing import ClassVar, NamedTuple

import networkx as nx
import numpy as np
from scipy.spatial import cKDTree

from mstfilter.completion import ClipCompleter, Completer, Completion, Extrude, arbitrate, occupancy_of
from mstfilter.completion.observed import frame_points
from mstfilter.errors import check_integer, check_number
from mstfilter.fusion.cells import LEAST, Cells, PairEvidence
from mstfilter.fusion.conflicts import check_grid
from mstfilter.fusion.division import NoDivision, PartRule, divided, split_segments
from mstfilter.fusion.free_space import FreeSpace, log_quality
from mstfilter.fusion.interfaces import Division, Evidence, PairOdds, Projection
from mstfilter.fusion.update import scored
from mstfilter.scene import Clip, Frame, Hypothesis, ObjectRecord, ObjectView, VoxelGrid
from mstfilter.smc import Population, Systematic, Update, child

_EDGE = 0.1  # a segment and a predicted object with more than this share of the smaller in common are in conflict
_SAME = 0.5  # share of a predicted object's readings in the segment that continues it, if both have no other conflict
_CONTAINED = 0.8  # the same, if they have other conflicts


@dataclass(frozen=True, eq=False)
class Readings:
    """The depth readings of a frame inside the grid."""

    pixels: np.ndarray  #: (m,) flat pixels
    voxels: np.ndarray  #: (m, 3) voxels

    @classmethod
    def of(cls, frame: Frame, grid: VoxelGrid) -> Readings:
        """Of a frame."""
        return cls(*frame_points(frame, grid))

    def mask(self, chosen: np.ndarray, frame: Frame) -> np.ndarray:
        """Pixels (H, W) bool of the chosen readings (m,) bool."""
        mask = np.zeros(frame.depth.size, bool)
        mask[self.pixels[chosen]] = True
        return mask.reshape(frame.depth.shape)

    def labels(self, labels: np.ndarray, reach: float) -> np.ndarray:
        """Label (m,) of each reading: of its voxel, or of the nearest object within `reach` voxels; 0 is none."""
        occupied, (voxels, of_reading) = np.argwhere(labels), self._distinct
        _, nearest = cKDTree(occupied).query(voxels, distance_upper_bound=reach + 1e-6)
        found = np.append(labels[tuple(occupied.T)], 0).astype(np.int64)  # the last one is that of no neighbour
        return found[nearest][of_reading]

    @cached_property
    def _distinct(self) -> tuple[np.ndarray, np.ndarray]:
        """The voxels (k, 3) with readings, and that of each reading (m,)."""
        voxels, of_reading = np.unique(self.voxels, axis=0, return_inverse=True)
        return voxels, of_reading.ravel()


class _Part(NamedTuple):
    """An object of a candidate."""

    readings: np.ndarray  #: (m,) bool, its readings
    continues: tuple[ObjectRecord, ...]  #: the predicted objects that it continues, the largest first
    predicted: Completion | None = None  #: the voxels of a predicted object without readings


class _Past(NamedTuple):
    """A prediction."""

    objects: np.ndarray  #: (m,) its object of each reading, 0 is none
    prediction: Hypothesis
    refined: Hypothesis  #: without what the frame sees through
    right: float  #: the probability that it is right


@dataclass(frozen=True)
class PartitionUpdate(Update):
    """Partition of the readings, and completion from all views.

    Parameters
    ----------
    completer : Completer
        Completes the objects. That of the proposal is then of no use, and may be `SurfaceOnly`.
    free_space : Projection
        Gives the share Q of a prediction that the frame does not see through, and the objects that are left.
    division, parts : Division, PartRule
        Objects of both sides whose parts move apart in the clip are split first, if `parts` says so.
    pairs : PairOdds
        The log odds that two cells belong to one object.
    occupied_log_odds : float
        Added to the log odds of every voxel that the completer is not certain about, since the network is calibrated
        for its own training scenes. It was fitted in `experiments/partition_fit`.
    evidence : tuple of Evidence
        Terms whose sum is the log weight of a candidate. Without them all candidates have equal weights, as they are
        drawn from what they approximate.
    quality_exponent : float
        lambda. With 0 the past is always taken to be right, and every hidden object stays.
    n_candidates : int
        Candidates after the first pause; 0 means one for each predicted hypothesis, or four if there is evidence.
    reach : float
        Voxels between a reading and the predicted object that explains it, at most.
    n_views : int
        Views that an object keeps, at most: the latest ones.
    threshold : float
        Smallest probability of an occupied voxel.
    """

    completer: Completer = field(default_factory=Extrude)
    free_space: Projection = FreeSpace()  # noqa: RUF009 (frozen)
    division: Division = NoDivision()  # noqa: RUF009 (frozen)
    parts: PartRule = PartRule()  # noqa: RUF009 (frozen)
    pairs: PairOdds = PairEvidence()  # noqa: RUF009 (frozen)
    occupied_log_odds: float = 0.6
    evidence: tuple[Evidence, ...] = ()
    quality_exponent: float = 3.0
    n_candidates: int = 0
    reach: float = 1.5
    n_views: int = 4
    threshold: float = 0.5

    properly_weighted: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_integer("n_candidates", self.n_candidates, at_least=0)
        check_integer("n_views", self.n_views, at_least=0)
        check_number("threshold", self.threshold, at_least=0, at_most=1)
        check_number("quality_exponent", self.quality_exponent, at_least=0)
        check_number("occupied_log_odds", self.occupied_log_odds)
        check_number("reach", self.reach, at_least=0)

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """Candidates. Without a proposal the refined predictions pass."""
        grid = observation.grid
        sides = (("predicted", predicted), ("proposed", proposed))
        for name, k, hypothesis in ((n, k, h) for n, p in sides if p is not None for k, h in enumerate(p.particles)):
            check_grid(f"{name} hypothesis {k}", hypothesis, grid)
        readings = Readings.of(observation.after, grid)
        if predicted is None:
            assert proposed is not None
            candidates = [
                [_Part(segments == k, ()) for k in np.unique(segments[segments > 0])]
                for segments in self._segments(proposed, readings, observation)
            ]
            return self._candidates(
                rng, candidates, readings, observation, proposed.log_weights, proposed.parents, {}
            )
        refined, quality = self.free_space.refine(predicted.particles, observation)
        log_right = self.quality_exponent * log_quality(quality)
        log_weights = predicted.log_weights + log_right
        notes = {"quality": quality.tolist()}
        if proposed is None:
            return Population(refined, log_weights, predicted.parents, notes)
        n = self.n_candidates or (4 if self.evidence else 1) * len(predicted)
        j = Systematic().select(child(rng, "predicted"), log_weights, n)[0]
        predictions = divided(self.division, self.parts, tuple(predicted.particles), observation, proposed=False)
        past = [readings.labels(h.labels, self.reach) for h in predictions]
        segments = self._segments(proposed, readings, observation)
        cells = Cells.of(readings.pixels, observation.after.depth.shape, segments, past)
        right = np.exp(log_right)
        log_odds = self.pairs.log_odds(cells, predicted.weights * right, observation)
        known = [_Past(*one) for one in zip(past, predictions, refined, right.tolist(), strict=True)]
        drawn = cells.draw(child(rng, "partition"), log_odds, n)
        chosen = np.pad(drawn, ((0, 0), (0, 1)))[:, cells.of_reading]  # the last column is no object
        few = LEAST * observation.after.depth.size / 307200
        candidates = [
            self._parts(child(rng, "hidden", c), segment, known[b], few)
            for c, (segment, b) in enumerate(zip(chosen, j.tolist(), strict=True))
        ]
        parents = {"previous": predicted.parents.get("previous", np.full(len(predicted), -1))[j]}
        return self._candidates(rng, candidates, readings, observation, np.zeros(n), parents, notes)

    def _segments(self, proposed: Population, readings: Readings, clip: Clip) -> list[np.ndarray]:
        """The segment (m,) of each reading in each sample, 0 is none.

        A reading belongs to the segment of its voxel, or of the nearest within a voxel: at the borders of objects,
        pixels of one object have readings of another.
        """
        motions = self.division.divide(clip)
        distinct = {id(h): h for h in proposed.particles}
        found = {}
        for name, h in distinct.items():
            own = readings.labels(h.labels, 1.0)
            if motions is not None:
                own = split_segments(own, motions.ravel()[readings.pixels], readings.voxels, self.parts)
            found[name] = own
        return [found[id(h)] for h in proposed.particles]

    def _candidates(
        self,
        rng: np.random.Generator,
        candidates: Sequence[Sequence[_Part]],
        readings: Readings,
        clip: Clip,
        log_weights: np.ndarray,
        parents: Mapping[str, np.ndarray],
        notes: dict,
    ) -> Population:
        """The candidates, built and weighted by evidence."""
        built = self._complete(rng, candidates, readings, clip)
        total, scores = scored(self.evidence, built, clip)
        return Population(built, log_weights + total, parents, {**notes, "scores": scores})

    def _parts(self, rng: np.random.Generator, segments: np.ndarray, known: _Past, few: float) -> list[_Part]:
        """The objects of a candidate, from the segment (m,) of each reading, 0 is none, and from a prediction."""
        prediction, refined = known.prediction, known.refined
        past = np.where(segments > 0, known.objects, 0)
        shape = int(segments.max(initial=0)) + 1, int(past.max(initial=0)) + 1
        shared = np.bincount(segments * shape[1] + past, minlength=shape[0] * shape[1]).reshape(shape)
        main = np.append(0, shared[1:, 1:].argmax(axis=1) + 1) if shape[1] > 1 else np.zeros(shape[0], int)
        rivals = np.array([shared[main == b, b].sum() for b in range(shape[1])])  # in segments that are mainly b
        sizes, past_sizes = shared.sum(axis=1), shared.sum(axis=0)
        common = np.where(shared > _EDGE * np.minimum.outer(sizes, past_sizes), shared, 0)
        common[:, (rivals == 0) & (past_sizes < few)] = 0  # readings of others that lie at a hidden object
        record_of = {record.label: record for record in prediction.objects}
        parts: list[_Part] = []
        seen: set[int] = set()
        for of_sample, of_past in _components(common, sizes):
            seen.update(of_past)
            least = _SAME if len(of_sample) == len(of_past) == 1 else _CONTAINED
            owner = np.zeros(len(segments), np.int64)  # of the readings of which the prediction gives the partition
            heir = {main[a]: a for a in of_sample if common[a, main[a]] > least * rivals[main[a]]}
            whole: list[tuple[np.ndarray, list[int]]] = []
            for a in of_sample:  # an object with an heir has no other one
                held = {b: heir[b] == a if b in heir else common[a, b] > least * past_sizes[b] for b in of_past}
                own = sorted((b for b in of_past if held[b]), key=lambda b: -shared[a, b])
                inside = segments == a
                within = [b for b in of_past if common[a, b]]
                if any(record_of[b].apart & {record_of[c].id for c in within} for b in within):
                    usual = max(within, key=lambda b: shared[a, b])
                    owner[inside] = np.where(np.isin(past, within), past, usual)[inside]
                else:
                    whole.append((inside, own))
            parts += [_Part(inside | np.isin(owner, own), tuple(record_of[b] for b in own)) for inside, own in whole]
            rest = [b for b in of_past if not any(b in own for _, own in whole) and (owner == b).any()]
            parts += [_Part(owner == b, (record_of[b],)) for b in rest]
        before, after = prediction.volumes(), Counter(prediction.labels[refined.labels > 0].tolist())
        kept = {k: (after[k] / max(before[k], 1)) ** self.quality_exponent for k in record_of if k not in seen}
        hidden = [k for k, share in kept.items() if rng.random() < known.right * share]
        return parts + [
            _Part(segments < 0, (record_of[k],), _left(prediction, refined, k, self.threshold)) for k in hidden
        ]

    def _complete(
        self, rng: np.random.Generator, candidates: Sequence[Sequence[_Part]], readings: Readings, clip: Clip
    ) -> tuple[Hypothesis, ...]:
        """The hypotheses. Each distinct object is completed once, all together.

        Objects without readings and views keep their predicted voxels.
        """
        completer = self.completer.at(clip) if isinstance(self.completer, ClipCompleter) else self.completer
        every = [part for parts in candidates for part in parts]
        views = [self._latest(*(record.views for record in part.continues)) for part in every]
        seen = [k for k, part in enumerate(every) if part.readings.any() or views[k]]
        streams = [child(rng, "completion", k) for k in seen]
        masks = [readings.mask(every[k].readings, clip.after) for k in seen]
        again = completer.complete_each(streams, clip.after, masks, clip.grid, [views[k] for k in seen])
        completed = dict(zip(seen, (c.shifted(self.occupied_log_odds) for c in again), strict=True))
        built, at = [], 0
        for parts in candidates:
            found, records = [], []
            heir = {record.id: part.continues[0].id for part in parts for record in part.continues}
            for label, part in enumerate(parts, start=1):
                completion = completed.get(at, part.predicted)
                assert completion is not None
                found.append(completion)
                records.append(_record(part, label, clip.index, completion.key, self._latest(completion.views), heir))
                at += 1
            labels = arbitrate(found, clip.grid, self.threshold)
            present = np.bincount(labels.ravel(), minlength=len(found) + 1)
            kept = tuple(record for record in records if present[record.label])
            built.append(Hypothesis(labels, clip.grid, kept, occupancy_of(found, labels, clip.grid)))
        return tuple(built)

    def _latest(self, *histories: tuple[ObjectView, ...]) -> tuple[ObjectView, ...]:
        """The latest views of several objects, each with its oldest view first."""
        newest = (view for level in zip_longest(*map(reversed, histories)) for view in level if view is not None)
        return tuple(islice(newest, self.n_views))[::-1]


def _left(prediction: Hypothesis, refined: Hypothesis, label: int, threshold: float) -> Completion:
    """What free space leaves of a predicted object. Its voxels have at least the probability `threshold`."""
    crop, left = prediction.crop(label), refined.shares.probability
    p = crop.occupied if crop.probability is None else np.maximum(crop.probability, threshold * crop.occupied)
    p = np.where(left[crop.box] > 0, p, 0).astype(np.float32)
    return Completion(crop.offset, p, np.zeros(p.shape, np.int32), prediction.record(label).completion_key or "")


def _components(common: np.ndarray, sizes: np.ndarray) -> list[tuple[list[int], list[int]]]:
    """Segments and predicted objects of each component, from their conflicts (s + 1, p + 1) and sizes (s + 1,)."""
    graph = nx.Graph()
    graph.add_nodes_from((0, a) for a in np.flatnonzero(sizes).tolist() if a)
    graph.add_edges_from(((0, a), (1, b)) for a, b in np.argwhere(common).tolist() if a and b)
    components = sorted(sorted(found) for found in nx.connected_components(graph))
    return [([k for side, k in found if side == 0], [k for side, k in found if side == 1]) for found in components]


def _record(
    part: _Part, label: int, birth: int, key: str, views: tuple[ObjectView, ...], heir: Mapping[int, int]
) -> ObjectRecord:
    """The record of an object: of the predicted object that it continues, or new.

    `heir` has the id of the object that continues each predicted one.
    """
    if not part.continues:
        return ObjectRecord.born(label, birth, key, views)
    apart = frozenset(heir.get(k, k) for record in part.continues for k in record.apart)
    return replace(part.continues[0].changed(), label=label, completion_key=key, views=views, apart=apart)

"""A measurement update that partitions the image, and completes every object from all that was seen of it.

>>> update = PartitionUpdate(completer=NetworkCompleter())
>>> fused = update.update(rng, predicted, proposed, clip)       # candidates of sampled pairs, with weights

A sample and a prediction are read as partitions of the readings of the last frame: the sample by its segments, the
prediction by the objects that lie at the readings. The conflict graph has an edge for each segment and predicted
object that share readings. Each of its components gets the partition of one side, drawn at random. A segment
with objects that were seen to move apart always gets that of the prediction.

An object of the result continues the predicted object with which it shares most readings, and keeps its views: what
earlier frames showed of it (`mstfilter.scene.ObjectView`). It is completed from the readings of this frame and from
its views together. So evidence is remembered and guesses are not: no voxel that was guessed at an earlier pause is
carried on. Predicted objects without readings stay, unless the frame sees through them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, NamedTuple

import networkx as nx
import numpy as np
from scipy.ndimage import distance_transform_edt

from mstfilter.completion import ClipCompleter, Completer, Completion, Extrude, arbitrate, occupancy_of
from mstfilter.completion.observed import frame_points
from mstfilter.errors import check_choice, check_integer, check_number
from mstfilter.fusion.cells import Cells, PairEvidence
from mstfilter.fusion.conflicts import check_grid
from mstfilter.fusion.division import NoDivision, PartRule, divided
from mstfilter.fusion.free_space import FreeSpace, log_quality
from mstfilter.fusion.interfaces import Division, Evidence, Projection
from mstfilter.fusion.update import parents_of_pairs, scored
from mstfilter.scene import Clip, Frame, Hypothesis, ObjectRecord, ObjectView, VoxelGrid
from mstfilter.smc import Population, Systematic, Update, child

_EDGE = 0.1  # share of the smaller of a segment and an object that they have in common if they are in conflict
_SAME = 0.5  # share of a predicted object's readings in the segment that continues it, if both have no other conflict
_CONTAINED = 0.8  # the same, if they have other conflicts


class Readings(NamedTuple):
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
        found = labels[tuple(self.voxels.T)].astype(np.int64)
        left = np.flatnonzero(found == 0)
        if not len(left):
            return found
        low = np.maximum(self.voxels[left].min(axis=0) - 3, 0)
        high = np.minimum(self.voxels[left].max(axis=0) + 4, labels.shape)
        box = labels[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
        if box.any():
            distance, index = distance_transform_edt(box == 0, return_indices=True)
            at = tuple((self.voxels[left] - low).T)
            found[left] = np.where(distance[at] <= reach, box[tuple(axis[at] for axis in index)], 0)
        return found


class _Part(NamedTuple):
    """An object of a candidate."""

    readings: np.ndarray  #: (m,) bool, its readings
    continues: tuple[ObjectRecord, ...]  #: the predicted objects that it continues, the largest first
    predicted: Completion | None = None  #: the voxels of a predicted object without readings


@dataclass(frozen=True)
class PartitionUpdate(Update):
    """Partition of the readings, and completion from all views.

    Parameters
    ----------
    completer : Completer
        Completes the objects. That of the proposal is then of no use, and may be `SurfaceOnly`.
    free_space : Projection
        Gives the share Q of a prediction that the frame does not see through, and the objects that are left.
    division : Division
        Objects of both sides whose parts move apart in the clip are split first.
    parts : PartRule
        When a part of an object becomes a separate object.
    evidence : tuple of Evidence
        Terms whose sum is the log weight of a candidate, to select among more candidates than hypotheses. Without
        them all candidates have equal weights: they are drawn by the weights of their pairs, log w = log w_i + log
        w_j + lambda log Q_j.
    quality_exponent : float
        lambda.
    n_candidates : int
        Candidates; 0 means one for each hypothesis of the larger side.
    partitions : {"sides", "pairs"}
        "sides": each component of the conflict graph gets the partition of the sample or of the prediction. "pairs":
        partitions are drawn by what all samples and predictions say of pairs of cells (`mstfilter.fusion.cells`).
    past : float
        Probability that a component of the conflict graph gets the partition of the prediction, for "sides".
    pairs : PairEvidence
        The log odds of pairs, for "pairs".
    reach : float
        Voxels between a reading and the predicted object that explains it, at most.
    least_kept : float
        Share of its voxels that a predicted object without readings must keep. The frame sees through the others.
    n_views : int
        Views that an object keeps, at most: the latest ones.
    threshold : float
        Smallest probability of an occupied voxel.
    """

    completer: Completer = field(default_factory=Extrude)
    free_space: Projection = FreeSpace()  # noqa: RUF009 (frozen)
    division: Division = NoDivision()  # noqa: RUF009 (frozen)
    parts: PartRule = PartRule()  # noqa: RUF009 (frozen)
    evidence: tuple[Evidence, ...] = ()
    quality_exponent: float = 3.0
    n_candidates: int = 0
    partitions: Literal["sides", "pairs"] = "sides"
    past: float = 0.5
    pairs: PairEvidence = PairEvidence()  # noqa: RUF009 (frozen)
    reach: float = 1.5
    least_kept: float = 0.5
    n_views: int = 4
    threshold: float = 0.5

    properly_weighted: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_integer("n_candidates", self.n_candidates, at_least=0)
        check_integer("n_views", self.n_views, at_least=0)
        check_choice("partitions", self.partitions, ("sides", "pairs"))
        for name, largest in (("past", 1.0), ("least_kept", 1.0), ("threshold", 1.0)):
            check_number(name, getattr(self, name), at_least=0, at_most=largest)
        check_number("quality_exponent", self.quality_exponent, at_least=0)
        check_number("reach", self.reach, at_least=0)

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """Candidates. Without a proposal the refined predictions pass."""
        frame, grid = observation.after, observation.grid
        notes: dict = {}
        if predicted is None:
            assert proposed is not None
            empty = Hypothesis(np.zeros(grid.shape, np.uint16), grid)
            predicted, log_q = Population((empty,)), np.zeros(1)
            refined: tuple[Hypothesis, ...] = (empty,)
        else:
            refined, quality = self.free_space.refine(predicted.particles, observation)
            log_q, notes = self.quality_exponent * log_quality(quality), {"quality": quality.tolist()}
        if proposed is None:
            return Population(refined, predicted.log_weights + log_q, predicted.parents, notes)
        for name, hypotheses in (("predicted", predicted.particles), ("proposed", proposed.particles)):
            for k, hypothesis in enumerate(hypotheses):
                check_grid(f"{name} hypothesis {k}", hypothesis, grid)
        i, j = self._pairs(child(rng, "pairs"), proposed, predicted, log_q)
        predictions = divided(self.division, self.parts, tuple(predicted.particles), observation, proposed=False)
        samples = divided(self.division, self.parts, tuple(proposed.particles), observation, proposed=True)
        readings = Readings.of(frame, grid)
        past = [readings.labels(h.labels, self.reach) for h in predictions]
        segments = [readings.labels(h.labels, 1.0) for h in samples]
        if self.partitions == "pairs":
            cells = Cells.of(readings.pixels, frame.depth.shape, segments, past)
            weights = Population(predicted.particles, predicted.log_weights + log_q).weights
            log_odds = self.pairs.log_odds(cells, weights)
            drawn = cells.draw(child(rng, "partition"), log_odds, len(i))
            chosen = list(np.pad(drawn, ((0, 0), (0, 1)))[:, cells.of_reading])  # the last column is no object
        else:
            chosen = [segments[a] for a in i.tolist()]
        candidates = []
        for number, b in enumerate(j.tolist()):
            stream = child(rng, "candidate", number)
            candidates.append(self._partition(stream, chosen[number], past[b], predictions[b], refined[b]))
        built = self._complete(rng, candidates, readings, observation)
        parents = parents_of_pairs(proposed, i, predicted, j)
        if self.partitions == "pairs":  # all samples made it
            parents["proposed"] = np.full(len(i), -1)
        total, scores = scored(self.evidence, built, observation)
        return Population(built, total, parents, {**notes, "scores": scores})

    def _pairs(
        self, rng: np.random.Generator, proposed: Population, predicted: Population, log_q: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Sample and prediction of each candidate, drawn by weight."""
        n = self.n_candidates or max(len(predicted), len(proposed))
        sides = [
            Systematic().resample(child(rng, name), Population(range(len(log_w)), log_w), n).realised().particles
            for name, log_w in (("proposed", proposed.log_weights), ("predicted", predicted.log_weights + log_q))
        ]
        i, j = (np.asarray(side) for side in sides)
        return i, child(rng, "order").permutation(j)

    def _partition(
        self,
        rng: np.random.Generator,
        segments: np.ndarray,
        past: np.ndarray,
        prediction: Hypothesis,
        refined: Hypothesis,
    ) -> list[_Part]:
        """The objects of a candidate, from the segment and the predicted object (m,) of each reading, 0 is none."""
        past = np.where(segments > 0, past, 0)
        shape = int(segments.max(initial=0)) + 1, int(past.max(initial=0)) + 1
        shared = np.bincount(segments * shape[1] + past, minlength=shape[0] * shape[1]).reshape(shape)
        record_of = {record.label: record for record in prediction.objects}
        parts: list[_Part] = []
        seen: set[int] = set()
        for of_sample, of_past in _components(shared):
            seen.update(of_past)
            alone = len(of_sample) == len(of_past) == 1
            by_sample = not of_past or alone or self.partitions == "pairs" or rng.random() >= self.past
            owner = np.zeros(len(segments), np.int64)  # of the readings of which the prediction gives the partition
            for a in of_sample:
                least = (_SAME if alone else _CONTAINED) * shared.sum(axis=0)
                own = sorted((b for b in of_past if shared[a, b] > least[b]), key=lambda b: -shared[a, b])
                if by_sample and not any(record_of[b].apart & {record_of[c].id for c in own} for b in own):
                    parts.append(_Part(segments == a, tuple(record_of[b] for b in own)))
                else:
                    inside, among = segments == a, own if by_sample else of_past
                    nearest = max(among, key=lambda b: shared[a, b])
                    owner[inside] = np.where(np.isin(past, among), past, nearest)[inside]
            parts += [_Part(owner == b, (record_of[b],)) for b in of_past if (owner == b).any()]
        before = prediction.volumes()
        after = Counter(prediction.labels[refined.labels > 0].tolist())
        nothing = np.zeros(len(segments), bool)
        hidden = [k for k in record_of if k not in seen and after[k] > self.least_kept * before[k]]
        return parts + [_Part(nothing, (record_of[k],), _left(prediction, refined, k)) for k in hidden]

    def _complete(
        self, rng: np.random.Generator, candidates: Sequence[Sequence[_Part]], readings: Readings, clip: Clip
    ) -> tuple[Hypothesis, ...]:
        """The hypotheses. Each distinct object is completed once, all together.

        Objects without readings and views keep their predicted voxels.
        """
        completer = self.completer.at(clip) if isinstance(self.completer, ClipCompleter) else self.completer
        every = [part for parts in candidates for part in parts]
        views = [self._latest(view for record in part.continues for view in record.views) for part in every]
        seen = [k for k, part in enumerate(every) if part.readings.any() or (completer.remembers and views[k])]
        streams = [child(rng, "completion", k) for k in seen]
        objects = [(readings.mask(every[k].readings, clip.after), views[k]) for k in seen]
        completed = dict(zip(seen, completer.complete_again(streams, clip.after, objects, clip.grid), strict=True))
        built, at = [], 0
        for parts in candidates:
            found, records = [], []
            for label, part in enumerate(parts, start=1):
                completion, view = completed.get(at, (part.predicted, None))
                assert completion is not None
                known = views[at] if view is None else self._latest((*views[at], view))
                found.append(completion)
                records.append(_record(part, label, clip.index, completion.key, known))
                at += 1
            labels = arbitrate(found, clip.grid, self.threshold)
            present = np.bincount(labels.ravel(), minlength=len(found) + 1)
            kept = tuple(record for record in records if present[record.label])
            built.append(Hypothesis(labels, clip.grid, kept, occupancy_of(found, labels, clip.grid)))
        return tuple(built)

    def _latest(self, views: Iterable[ObjectView]) -> tuple[ObjectView, ...]:
        return tuple(views)[-self.n_views :] if self.n_views else ()


def _left(prediction: Hypothesis, refined: Hypothesis, label: int) -> Completion:
    """What free space leaves of a predicted object."""
    crop, left = prediction.crop(label), refined.shares.probability
    p = crop.occupied if crop.probability is None else crop.probability
    p = np.where(left[crop.box] > 0, p, 0).astype(np.float32)
    return Completion(crop.offset, p, np.zeros(p.shape, np.int32), prediction.record(label).completion_key or "")


def _components(shared: np.ndarray) -> list[tuple[list[int], list[int]]]:
    """Segments and predicted objects of each component, from their numbers of common readings (s + 1, p + 1)."""
    graph = nx.Graph()
    sizes, past_sizes = shared.sum(axis=1), shared.sum(axis=0)
    for a in range(1, len(shared)):
        if sizes[a]:
            graph.add_node((0, a))
        for b in range(1, len(past_sizes)):
            if shared[a, b] > _EDGE * min(sizes[a], past_sizes[b]):
                graph.add_edge((0, a), (1, b))
    components = sorted(sorted(found) for found in nx.connected_components(graph))
    return [([k for side, k in found if side == 0], [k for side, k in found if side == 1]) for found in components]


def _record(part: _Part, label: int, birth: int, key: str, views: tuple[ObjectView, ...]) -> ObjectRecord:
    """The record of an object: of the predicted object that it continues, or new."""
    if not part.continues:
        return ObjectRecord.born(label, birth, key, views)
    apart = frozenset().union(*(record.apart for record in part.continues))
    return replace(part.continues[0].changed(), label=label, views=views, apart=apart)

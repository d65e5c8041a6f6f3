"""The measurement update: it weighs partitions of the image, and completes every object from all its views.

>>> update = PartitionUpdate(completer=NetworkCompleter())
>>> fused = update.update(rng, predicted, proposed, clip)       # weighted candidates, built on access

This update takes the place of section IV-D of the paper. It treats samples and predictions as what they say about the
last frame: which of its depth readings belong together. Voxels are not fused at all; those of an object are estimated
anew from everything that was seen of it.

A *candidate* is one complete answer: it chooses a prediction j, a partition of the readings of each part of the
image, and the occluded objects that stay. Its weight is

    ``w_j Q_j^lambda`` times the probabilities of its partitions and of its choice of occluded objects,

where w_j is the weight of prediction j, and Q_j tells how well the observed free space agrees with it.

1. **Free space.** As in the paper, Q_j is the share of the voxels of prediction j that the frame does not observe as
   free. Its visible surface is tested too: A_j is the share of it with which the readings agree, and A_j^lambda is
   the probability that the prediction is *valid*, which means that it shows the present scene. (The exponent lambda
   is the field `quality_exponent`.) A single object can fail as well: if the readings agree with less than the share
   `least_agreement` of its visible surface, it is *refuted*, and no candidate contains it.
2. **Partitions.** A sample groups the readings by segment, a prediction by the predicted object at each reading. The
   samples and prediction j together give the odds that two readings belong to one object, and these determine the
   probabilities of the partitions of each part of the image (`mstfilter.mst.partition.cells`). Only the most probable
   candidates are described (`mstfilter.mst.partition.candidates`), and only those that the resampler of the filter
   selects are completed.
3. **Association.** Segments and predicted objects are the vertices of a *conflict graph*. In each of its components,
   the rules in `mstfilter.mst.partition.association` decide which segment continues which object. Merges follow from
   the partition; in the paper, they are drawn at random.
4. **Occluded objects.** A predicted object without conflict has few readings or none. If q is the share of its voxels
   that the frame does not observe as free, it stays with probability (A_j q)^lambda, so it is in some candidates and
   not in others. (A_j is that of the whole prediction.)
5. **Completion.** An object keeps its views, which are its observations in earlier frames
   (`mstfilter.scene.ObjectView`). A visible object is completed from its readings and from the views of the predicted
   objects that it continues, an occluded one from its views alone. The completer drops views that contradict the
   frame, and an object without any voxel is removed. Completions of earlier pauses are not used again, so their
   errors do not add up. Only an occluded object without any view, as with completers that use none, keeps
   its predicted voxels outside free space.

At the first pause the candidates are the distinct samples, and every segment is a new object. So a hypothesis
contains only objects that some frame has shown.

To change one factor of the weight, replace the field that makes it:

==================  ==================================================================================
`free_space`        what counts as free, so Q_j and q: a `mstfilter.scene.Projection`
`pairs`             image against past: a `PairOdds`; common motion is the field `together` of `PairEvidence`
`temperature`       how even the probabilities of partitions are
`quality_exponent`  how strongly Q_j, A_j and q count
`least_agreement`   whether surfaces are tested at all, and when an object is refuted
`evidence`          further factors: terms of your own (`mstfilter.scene.Evidence`), for which candidates are built
==================  ==================================================================================

The notes of the result contain all candidates as segmentations of the last frame with their weights
(`mstfilter.scene.WeightedSegmentations`). A belief reads its probabilities there, rather than from the few hypotheses
that resampling keeps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import islice, zip_longest
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.special import logsumexp

from mstfilter.base.fields import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, Share
from mstfilter.base.processes import each
from mstfilter.mst.completion import Completer, Completion, Extrude, arbitrate, occupancy_of
from mstfilter.mst.partition.association import Overlaps, recognised
from mstfilter.mst.partition.candidates import Choices, largest
from mstfilter.mst.partition.cells import Cells, PairEvidence, PairOdds, Readings
from mstfilter.mst.partition.motions import common_motions
from mstfilter.scene import (
    Clip,
    Evidence,
    Frame,
    FreeSpace,
    Hypothesis,
    ObjectRecord,
    ObjectView,
    Projection,
    WeightedSegmentations,
    check_grids,
    common_refinement,
    foreground,
    log_quality,
    posed_camera,
    surface_agreement,
)
from mstfilter.smc import Candidates, Key, Population, Update, first_seen, key_of


@dataclass(frozen=True, eq=False)
class Prediction:
    """A predicted hypothesis, compared with the last frame."""

    hypothesis: Hypothesis
    refined: Hypothesis  #: without the voxels that the frame observes as free
    p_valid: float  #: probability A^lambda that the prediction is valid
    objects: np.ndarray  #: (m,) predicted object at each reading, 0 is none or a refuted object
    refuted: frozenset[int]  #: labels of the objects that the frame does not show at their places

    @cached_property
    def shares_left(self) -> dict[int, float]:
        """The share q of each object's voxels that the frame does not observe as free, by label."""
        left = Counter(self.hypothesis.labels[self.refined.labels > 0].tolist())
        return {label: left[label] / n for label, n in self.hypothesis.volumes().items()}

    def remaining(self, record: ObjectRecord, threshold: float) -> Completion:
        """The voxels of an object outside free space. Occupied voxels get at least the probability `threshold`."""
        crop, left = self.hypothesis.crop(record.label), self.refined.shares.probability
        p = crop.occupied if crop.probability is None else np.maximum(crop.probability, threshold * crop.occupied)
        p = np.where(left[crop.box] > 0, p, 0).astype(np.float32)
        return Completion(crop.offset, p, np.zeros(p.shape, np.int32), record.completion_key or "")


class SceneObject(NamedTuple):
    """An object of a candidate, before its completion."""

    readings: np.ndarray  #: (m,) bool, its readings in the last frame
    tracks: tuple[ObjectRecord, ...] = ()  #: the predicted objects that it continues, that with most readings first
    remains: Completion | None = (
        None  #: of an occluded object, its predicted voxels that are left; None for a segment
    )


@dataclass(frozen=True)
class PartitionUpdate(Update):
    """Partition of the depth readings, and completion of objects from all views.

    Parameters
    ----------
    completer : Completer
        Completes the objects. The shapes that the completer of the proposal made only say which depth readings
        belong to a segment, so `SurfaceOnly` is enough there.
    free_space : Projection
        Computes the voxels of a prediction that the frame does not observe as free, and their share Q.
    pairs : PairOdds
        The log odds that two cells belong to one object.
    temperature : float
        T. A partition gets a probability in proportion to P^(1/T), where P is that from the pairs of cells. So a
        higher T makes the probabilities more even (`experiments/weights` compares several T).
    evidence : tuple of Evidence
        Terms that are added to the log weights of candidates, which have to be built for this. Without terms, only
        the candidates that resampling selects are built.
    quality_exponent : float
        Exponent lambda of Q, A and q. If lambda is 0, every occluded object is kept.
    n_candidates : int
        Largest number of candidates after the first pause. 0 means 20 for each predicted hypothesis.
    n_scored : int
        With `evidence`, this number of candidates is built and scored, and the others are discarded.
    reach : float
        Largest distance in voxels between a reading and the predicted object to which the reading belongs.
    n_views : int
        Number of its latest views that an object keeps.
    threshold : float
        Smallest probability of an occupied voxel.
    mend : bool
        Whether missing readings of objects are estimated, as in `ObjectRule`.
    least_agreement : float
        Least share of the visible surface of a predicted object with which the depth readings must agree. If 0,
        surfaces are not tested: no object is refuted, and Q replaces A.
    """

    completer: Completer = field(default_factory=Extrude)
    free_space: Projection = FreeSpace()  # noqa: RUF009 (frozen)
    pairs: PairOdds = PairEvidence()  # noqa: RUF009 (frozen)
    temperature: PositiveFloat = 1.0
    evidence: tuple[Evidence, ...] = ()
    quality_exponent: NonNegativeFloat = 3.0
    n_candidates: NonNegativeInt = 0
    n_scored: PositiveInt = 20
    reach: NonNegativeFloat = 1.5
    n_views: NonNegativeInt = 4
    threshold: Share = 0.45
    mend: bool = True
    least_agreement: Share = 0.7

    properly_weighted: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """Weighted candidates; each hypothesis is built at its first access.

        Without a proposal, the result is the predictions after free-space projection.
        """
        check_grids("predicted", () if predicted is None else predicted.particles, observation.grid)
        check_grids("proposed", () if proposed is None else proposed.particles, observation.grid)
        found = foreground(observation.after, observation.grid)
        # Free-space projection does not use the estimates of depth.
        mended = Clip((found.frame,), observation.grid, observation.index) if self.mend else observation
        readings = Readings.of(mended.after, mended.grid)
        measured = mended.after.depth == found.frame.depth  # if not `mend`, objects have measured depth only
        raised = readings.of_image(found.pixels & measured)
        if predicted is None:
            assert proposed is not None
            described, segments = _distinct(proposed, _segments(proposed, readings, raised))
            objects_of = partial(_new_objects, segments)
            cells_of, partitions = _refined(segments)
        else:
            projected = self._project(predicted, observation)
            if proposed is None:
                return projected
            predictions = self._predictions(predicted, projected, readings, observation.after)
            segments = _segments(proposed, readings, raised)
            weights = proposed.weights if np.ptp(proposed.log_weights) else None
            bodies = [common_motions(one.hypothesis) for one in predictions]
            cells = Cells.of(readings, segments, [one.objects for one in predictions], weights, bodies)
            choices = self._choices(cells, predictions, projected.log_weights, mended)
            described = choices.described(projected)
            objects_of = partial(self._associate, cells, predictions, choices)
            cells_of, partitions = cells.of_reading + 1, choices.partitions
        seen = WeightedSegmentations(
            readings.image(cells_of), partitions, described.weights, posed_camera(mended.after)
        )
        described = replace(described, notes={**described.notes, "segmentations": seen})
        key = key_of(rng)

        def build(candidate: int) -> Hypothesis:
            return self._hypothesis(key.child("candidate", candidate), *objects_of(candidate), readings, mended)

        candidates = replace(described, particles=Candidates(build, len(described)))
        return self._scored(candidates, observation) if self.evidence else candidates

    # 1. Free-space projection -----------------------------------------------------------------------------------

    def _project(self, predicted: Population, clip: Clip) -> Population:
        """The predictions without the voxels that the frame observes as free, weighted by w_j Q_j^lambda."""
        refined, quality = self.free_space.refine(predicted.particles, clip)
        log_weights = predicted.log_weights + self.quality_exponent * log_quality(quality)
        return Population(refined, log_weights, predicted.parents, {"quality": quality.tolist()})

    def _predictions(
        self, predicted: Population, projected: Population, readings: Readings, frame: Frame
    ) -> list[Prediction]:
        """Compares each predicted hypothesis with the last frame."""
        quality = np.exp(log_quality(np.array(projected.notes["quality"])))
        columns = zip(predicted.particles, projected.particles, quality.tolist(), strict=True)
        return each(lambda one: self._prediction(*one, readings, frame), columns)

    def _prediction(
        self, hypothesis: Hypothesis, refined: Hypothesis, quality: float, readings: Readings, frame: Frame
    ) -> Prediction:
        of_objects, of_scene = np.zeros(0), quality
        if self.least_agreement:
            of_objects, of_scene = surface_agreement(hypothesis, frame)
        refuted = np.flatnonzero(of_objects < self.least_agreement)  # NaN, unknown, is not refuted
        objects = readings.labels(hypothesis.labels, self.reach)
        objects[np.isin(objects, refuted)] = 0
        p_valid = of_scene**self.quality_exponent
        return Prediction(hypothesis, refined, p_valid, objects, frozenset(refuted.tolist()))

    # 2. Partitions of the image, and their weights --------------------------------------------------------------

    def _choices(
        self, cells: Cells, predictions: Sequence[Prediction], log_weights: np.ndarray, clip: Clip
    ) -> Choices:
        """The most probable candidates. `log_weights` (predictions,) are log (w_j Q_j^lambda)."""
        n = self.n_candidates or 20 * len(predictions)
        # Row j has the weights of the predictions given that prediction j is used alone.
        given_one = np.diag([one.p_valid for one in predictions])
        log_odds = [self.pairs.log_odds(cells, weights, clip) for weights in given_one]
        choices = Choices.of(cells, log_weights - logsumexp(log_weights), log_odds, n, self.temperature)
        counts = [cells.counts(one.objects) for one in predictions]
        overlaps = (
            Overlaps.of(partition, counts[j], cells.readings.smallest_region)
            for j, partition in zip(choices.prediction, choices.partitions, strict=True)
        )
        stay = [self._stay(predictions[j], one) for j, one in zip(choices.prediction, overlaps, strict=True)]
        return choices.with_occluded(stay, n)

    def _stay(self, prediction: Prediction, overlaps: Overlaps) -> dict[int, float]:
        """Probability (A_j q)^lambda that each occluded object of a prediction stays, by label."""
        q = prediction.shares_left
        occluded = sorted(q.keys() - overlaps.visible - prediction.refuted)
        return {label: prediction.p_valid * q[label] ** self.quality_exponent for label in occluded}

    # 3. Association, 4. occluded objects ------------------------------------------------------------------------

    def _associate(
        self, cells: Cells, predictions: Sequence[Prediction], choices: Choices, candidate: int
    ) -> tuple[list[SceneObject], list[ObjectRecord]]:
        """The objects of a candidate, and the predicted objects that are lost.

        The objects are the segments of the partition, and the occluded objects that stay.
        """
        prediction, partition = predictions[choices.prediction[candidate]], choices.partitions[candidate]
        segments = cells.to_readings(partition)
        overlaps = Overlaps.of(partition, cells.counts(prediction.objects), cells.readings.smallest_region)
        record_of = {record.label: record for record in prediction.hypothesis.objects}
        visible = [
            SceneObject(segments == segment, tuple(record_of[k] for k in tracks))
            for component in overlaps.components()
            for segment, tracks in overlaps.tracks(component).items()
        ]
        none = np.zeros(len(segments), bool)
        stay = [record_of[label] for label in choices.staying[candidate]]
        objects = visible + [SceneObject(none, (one,), prediction.remaining(one, self.threshold)) for one in stay]
        kept = {track.label for one in objects for track in one.tracks}
        return objects, [record for label, record in record_of.items() if label not in kept]

    # 5. Completion ----------------------------------------------------------------------------------------------

    def _hypothesis(
        self, key: Key, objects: Sequence[SceneObject], lost: Sequence[ObjectRecord], readings: Readings, clip: Clip
    ) -> Hypothesis:
        """The hypothesis of a candidate. An object is omitted if all its voxels belong to other objects."""
        completions = self._completions(key, objects, readings, clip)
        new = [k for k, one in enumerate(objects) if not one.tracks and completions[k].views]
        again = recognised(lost, [completions[k].views[-1] for k in new])
        tracks = {new[k]: (record,) for k, record in again.items()}
        objects = [one._replace(tracks=tracks.get(k, one.tracks)) for k, one in enumerate(objects)]
        labels = arbitrate(completions, clip.grid, self.threshold)
        present = set(np.unique(labels[labels > 0]).tolist())
        known = {record.id for record in lost}.union(record.id for one in objects for record in one.tracks)
        records = [
            self._record(label, *one, clip.index, known)
            for label, one in enumerate(zip(objects, completions, strict=True), start=1)
            if label in present
        ]
        return Hypothesis(labels, clip.grid, tuple(records), occupancy_of(completions, labels, clip.grid))

    def _completions(
        self, key: Key, objects: Sequence[SceneObject], readings: Readings, clip: Clip
    ) -> list[Completion]:
        """Each object, completed from its readings and the views of its tracks.

        An object without readings and views keeps its predicted voxels outside free space.
        """
        completer = self.completer.at(clip)
        views = [self._latest(*(track.views for track in one.tracks)) for one in objects]
        seen = [k for k, one in enumerate(objects) if one.readings.any() or views[k]]
        streams = [key.child(k).generator() for k in seen]
        masks = [readings.mask(objects[k].readings) for k in seen]
        found = completer.complete_each(streams, clip.after, masks, clip.grid, [views[k] for k in seen])
        completed = dict(zip(seen, found, strict=True))
        completed |= {k: one.remains for k, one in enumerate(objects) if k not in completed and one.remains}
        return [completed[k] for k in range(len(objects))]

    def _record(
        self, label: int, one: SceneObject, completion: Completion, pause: int, known: Collection[int]
    ) -> ObjectRecord:
        """The `ObjectRecord` of the first predicted object that an object continues, or a new `ObjectRecord`.

        A new object gets none of the ids `known`, which predicted objects have.
        """
        key, views = completion.key, self._latest(completion.views)
        if not one.tracks:
            return ObjectRecord.born(label, pause, key, views, known)
        record = one.tracks[0].changed()
        last_seen = pause if one.readings.any() else record.last_seen
        return replace(record, label=label, last_seen=last_seen, completion_key=key, views=views)

    def _latest(self, *histories: tuple[ObjectView, ...]) -> tuple[ObjectView, ...]:
        """The latest views of several objects. For each object, the oldest view is first."""
        newest = (view for level in zip_longest(*map(reversed, histories)) for view in level if view is not None)
        return tuple(islice(newest, self.n_views))[::-1]

    # Evidence of built candidates -------------------------------------------------------------------------------

    def _scored(self, candidates: Population, clip: Clip) -> Population:
        """Build the `n_scored` candidates of largest weight, and add the evidence to their log weights."""
        kept = largest(candidates.log_weights, self.n_scored)
        built, scores = candidates.take(kept).realised(), {}
        total = np.zeros(len(built))
        for k, term in enumerate(self.evidence):
            name, score = type(term).__name__, term.log_score(built.particles, clip)
            scores[f"{name} {k}" if name in scores else name] = score.round(3).tolist()
            total += score
        discarded = round(max(0.0, 1 - float(np.exp(candidates.log_weights[kept]).sum())), 4)
        notes = {**built.notes, "discarded_mass": discarded, "scores": scores}
        return replace(built, log_weights=built.log_weights + total, notes=notes)


def _segments(proposed: Population, readings: Readings, raised: np.ndarray) -> list[np.ndarray]:
    """The segment (m,) of each reading in each sample, where 0 means none. `raised` (m,) bool: above the table.

    A reading above the table belongs to the segment of its voxel, or to the nearest segment within one voxel. At a
    border, a pixel of one object can measure the depth of another object. Any other reading belongs to the segment
    of its voxel, or to the table if the voxel contains a reading above the table.
    """
    beside, voxels = readings.share_voxel(raised), tuple(readings.voxels.T)

    def labels(h: Hypothesis) -> np.ndarray:
        return np.where(raised, readings.labels(h.labels, 1.0), np.where(beside, 0, h.labels[voxels]))

    found = {id(h): labels(h) for h in {id(h): h for h in proposed.particles}.values()}
    return [found[id(h)] for h in proposed.particles]


def _distinct(proposed: Population, segments: Sequence[np.ndarray]) -> tuple[Population, list[np.ndarray]]:
    """The distinct samples, weighted by the total weight of equal samples, and their segments (m,)."""
    which = first_seen(one.tobytes() for one in segments)
    example = np.unique(which, return_index=True)[1]
    merged = proposed.take(example, np.log(np.bincount(which, proposed.weights)))
    return merged, [segments[k] for k in example]


def _refined(segments: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The cell (m,) of each reading, 0 for none, and the segment (s, K) of each cell in each sample (m,)."""
    found = common_refinement(segments)
    return found.cells, found.objects[:, 1:]


def _new_objects(segments: Sequence[np.ndarray], candidate: int) -> tuple[list[SceneObject], list[ObjectRecord]]:
    """The segments (m,) of a candidate as new objects. No object is lost."""
    own = segments[candidate]
    return [SceneObject(own == k) for k in np.unique(own[own > 0])], []

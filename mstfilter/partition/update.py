"""The measurement update: partitions of the image are weighed, and every object is completed from all its views.

>>> update = PartitionUpdate(completer=NetworkCompleter())
>>> fused = update.update(rng, predicted, proposed, clip)       # weighted candidates, built on access

The update replaces section IV-D of the paper. In the paper, a sample of the image and a prediction are two sets of
voxels, which are crossed. In this update, both are partitions of the depth readings of the last frame. The voxels of
an object are estimated again from everything that was observed of it.

1. **Free-space projection** (as in the paper). Q_j is the share of the voxels of prediction j that the frame does not
   observe as free. The visible surface is tested too: A_j is the share of the surface of prediction j that the frame
   shows at its place. A_j^lambda is used as the probability that prediction j *holds*, which means that it shows the
   present scene. A predicted object is *refuted* and leaves the prediction if less than `least_agreement` of its
   visible surface is at its place.
2. **Partitions.** A sample groups the readings by its segments. A prediction groups the readings by the objects that
   lie at the readings. The samples and prediction j give the odds that two readings belong to one object. These odds
   give the partitions of each part of the image a probability (`mstfilter.partition.cells`). A candidate is a
   prediction j and one partition of each part. Its weight is w_j Q_j^lambda times the probabilities of the partitions
   (`mstfilter.partition.candidates`). The most probable candidates are described. The resampler of the filter selects
   among them, and only these are completed. The paper crosses each sample with each prediction.
3. **Association.** Segments and predicted objects form a *conflict graph*. In the *components* of the graph, segments
   continue predicted objects by the rules in `mstfilter.partition.association`. At most one segment continues an
   object that is split. The other segments are new objects. The paper draws which conflicts end in a merge. Here the
   partition determines the merges.
4. **Occluded objects.** A predicted object without conflict has no readings or very few. It stays with
   probability (A_j q)^lambda, so there are candidates with it and without it. Here q is the share of its own voxels
   that the frame does not observe as free. A_j says whether the prediction can be trusted at all, and q whether this
   object is still there.
5. **Completion.** An object keeps its views: what earlier frames showed of it (`mstfilter.scene.ObjectView`). A
   visible object is completed from its readings in this frame and from the views of the objects that it continues. An
   occluded object is completed from its views only. The completer drops views that the frame refutes. An object
   without any voxel is removed. Observations are kept, and completions are not: no voxel from a completion at an
   earlier pause is used again. The exception is an occluded object without views, which occurs if the completer does
   not use views. The object keeps its voxels outside free space.

At the first pause the candidates are the distinct samples, so every segment is a new object. Hypotheses have no
objects that no frame has shown.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import islice, zip_longest
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from scipy.special import logsumexp

from mstfilter.completion import ClipCompleter, Completer, Completion, Extrude, arbitrate, occupancy_of
from mstfilter.fields import Bounds, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, Share
from mstfilter.partition.association import Overlaps
from mstfilter.partition.candidates import Choices, largest
from mstfilter.partition.cells import Cells, PairEvidence, PairOdds, Readings
from mstfilter.processes import each
from mstfilter.scene import (
    Clip,
    Evidence,
    Frame,
    FreeSpace,
    Hypothesis,
    ObjectRecord,
    ObjectView,
    Projection,
    check_grids,
    foreground,
    log_quality,
    surface_agreement,
)
from mstfilter.smc import Candidates, Key, Population, Update, first_seen, key_of


@dataclass(frozen=True, eq=False)
class Prediction:
    """A predicted hypothesis and its evidence in the last frame."""

    hypothesis: Hypothesis
    refined: Hypothesis  #: without the voxels that the frame observes as free
    holds: float  #: probability that it holds, A^lambda
    objects: np.ndarray  #: (m,) its object at each reading, 0 is none or a refuted object
    refuted: frozenset[int]  #: labels of the objects that the frame does not show at their places

    @cached_property
    def shares_left(self) -> dict[int, float]:
        """The share q of each object's voxels that the frame does not observe as free, by label."""
        left = Counter(self.hypothesis.labels[self.refined.labels > 0].tolist())
        return {label: left[label] / n for label, n in self.hypothesis.volumes().items()}

    def remaining(self, record: ObjectRecord, threshold: float) -> Completion:
        """The voxels of an object outside free space, with at least the probability `threshold`."""
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
    """Partition of the readings, and completion from all views.

    Parameters
    ----------
    completer : Completer
        Completes the objects. The completer of the proposal is then not used, and may be `SurfaceOnly`.
    free_space : Projection
        Computes the share Q of a prediction that the frame does not observe as free, and the remaining voxels.
    pairs : PairOdds
        The log odds that two cells belong to one object.
    temperature : float
        T. Partitions of a component have probabilities in proportion to P^(1/T), where P is their probability by the
        pairs. A higher T makes the probabilities more even.
    occupied_log_odds : float
        Added to the log odds of every uncertain voxel, for completers whose probabilities are too low or too high.
        `experiments/partition_fit` fits it.
    evidence : tuple of Evidence
        Terms that are added to the log weights of built candidates. Without terms, only candidates that are selected
        are built.
    quality_exponent : float
        lambda, the exponent of Q, A and q. With 0, every prediction holds, and every occluded object is kept.
    n_candidates : int
        Largest number of candidates after the first pause. 0 means 20 for each predicted hypothesis.
    n_scored : int
        Number of candidates that are built and scored by `evidence`.
    reach : float
        Largest distance in voxels between a reading and the predicted object that explains it.
    n_views : int
        Number of latest views that an object keeps.
    threshold : float
        Smallest probability of an occupied voxel.
    mend : bool
        Whether missing readings of objects are estimated, as in `ObjectRule`.
    least_agreement : float
        Least share of the visible surface of a predicted object that the frame shows at its place. With 0, surfaces
        are not tested: no object is refuted, and Q replaces A.
    """

    completer: Completer = field(default_factory=Extrude)
    free_space: Projection = FreeSpace()  # noqa: RUF009 (frozen)
    pairs: PairOdds = PairEvidence()  # noqa: RUF009 (frozen)
    temperature: PositiveFloat = 1.0
    occupied_log_odds: Annotated[float, Bounds()] = 0.0
    evidence: tuple[Evidence, ...] = ()
    quality_exponent: NonNegativeFloat = 3.0
    n_candidates: NonNegativeInt = 0
    n_scored: PositiveInt = 20
    reach: NonNegativeFloat = 1.5
    n_views: NonNegativeInt = 4
    threshold: Share = 0.5
    mend: bool = True
    least_agreement: Share = 0.7

    properly_weighted: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """Weighted candidates, which are built on access.

        Without a proposal, the result is the predictions after free-space projection.
        """
        check_grids("predicted", () if predicted is None else predicted.particles, observation.grid)
        check_grids("proposed", () if proposed is None else proposed.particles, observation.grid)
        clip = self._mended(observation)
        readings = Readings.of(clip.after, clip.grid)
        if predicted is None:
            assert proposed is not None
            described, segments = _distinct(proposed, _segments(proposed, readings))
            objects_of = partial(_new_objects, segments)
        else:
            projected = self._project(predicted, observation)
            if proposed is None:
                return projected
            predictions = self._predictions(predicted, projected, readings, observation.after)
            cells = Cells.of(readings, _segments(proposed, readings), [one.objects for one in predictions])
            choices = self._choices(cells, predictions, projected.log_weights, clip)
            described = choices.described(projected)
            objects_of = partial(self._associate, cells, predictions, choices)
        key = key_of(rng)

        def build(candidate: int) -> Hypothesis:
            return self._hypothesis(key.child("candidate", candidate), objects_of(candidate), readings, clip)

        candidates = replace(described, particles=Candidates(build, len(described)))
        return self._scored(candidates, observation) if self.evidence else candidates

    def _mended(self, clip: Clip) -> Clip:
        """The last frame, with estimates of missing readings of objects. Free-space projection does not use them."""
        return Clip((foreground(clip.after, clip.grid).frame,), clip.grid, clip.index) if self.mend else clip

    # 1. Free-space projection -----------------------------------------------------------------------------------

    def _project(self, predicted: Population, clip: Clip) -> Population:
        """The predictions without the voxels that the frame observes as free, weighted by w_j Q_j^lambda."""
        refined, quality = self.free_space.refine(predicted.particles, clip)
        log_weights = predicted.log_weights + self.quality_exponent * log_quality(quality)
        return Population(refined, log_weights, predicted.parents, {"quality": quality.tolist()})

    def _predictions(
        self, predicted: Population, projected: Population, readings: Readings, frame: Frame
    ) -> list[Prediction]:
        """The evidence about each prediction in the last frame."""
        quality = np.exp(log_quality(np.array(projected.notes["quality"])))
        columns = zip(predicted.particles, projected.particles, quality.tolist(), strict=True)
        return each(lambda one: self._prediction(*one, readings, frame), columns)

    def _prediction(
        self,
        hypothesis: Hypothesis,
        refined: Hypothesis,
        quality: float,
        readings: Readings,
        frame: Frame,
    ) -> Prediction:
        of_objects, of_scene = np.zeros(0), quality
        if self.least_agreement:
            of_objects, of_scene = surface_agreement(hypothesis, frame)
        refuted = np.flatnonzero(of_objects < self.least_agreement)  # NaN, unknown, is not refuted
        objects = readings.labels(hypothesis.labels, self.reach)
        objects[np.isin(objects, refuted)] = 0
        holds = of_scene**self.quality_exponent
        return Prediction(hypothesis, refined, holds, objects, frozenset(refuted.tolist()))

    # 2. Partitions of the image, and their weights --------------------------------------------------------------

    def _choices(
        self, cells: Cells, predictions: Sequence[Prediction], log_weights: np.ndarray, clip: Clip
    ) -> Choices:
        """The most probable candidates. `log_weights` (predictions,) are log (w_j Q_j^lambda)."""
        n = self.n_candidates or 20 * len(predictions)
        valid = np.diag([one.holds for one in predictions])  # row j: prediction j is the past
        log_odds = [self.pairs.log_odds(cells, one, clip) for one in valid]
        choices = Choices.of(cells, log_weights - logsumexp(log_weights), log_odds, n, self.temperature)
        counts = [cells.counts(one.objects) for one in predictions]
        overlaps = (
            Overlaps.of(partition, counts[j], cells.readings.smallest_region)
            for j, partition in zip(choices.prediction, choices.partitions, strict=True)
        )
        stay = [self._stay(predictions[j], one) for j, one in zip(choices.prediction, overlaps, strict=True)]
        return choices.with_occluded(stay, n)

    def _stay(self, prediction: Prediction, overlaps: Overlaps) -> dict[int, float]:
        """Probability (A_j q)^lambda of each occluded object of a prediction to stay, by its label."""
        q = prediction.shares_left
        occluded = sorted(q.keys() - overlaps.visible - prediction.refuted)
        return {label: prediction.holds * q[label] ** self.quality_exponent for label in occluded}

    # 3. Association, 4. occluded objects ------------------------------------------------------------------------

    def _associate(
        self, cells: Cells, predictions: Sequence[Prediction], choices: Choices, candidate: int
    ) -> list[SceneObject]:
        """The objects of a candidate: the segments of its partition, and the occluded objects that stay."""
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
        stay = [record_of[label] for label in choices.occluded[candidate]]
        return visible + [SceneObject(none, (one,), prediction.remaining(one, self.threshold)) for one in stay]

    # 5. Completion ----------------------------------------------------------------------------------------------

    def _hypothesis(self, key: Key, objects: Sequence[SceneObject], readings: Readings, clip: Clip) -> Hypothesis:
        """A candidate. An object is dropped if all its voxels belong to other objects."""
        completions = self._completions(key, objects, readings, clip)
        labels = arbitrate(completions, clip.grid, self.threshold)
        present = set(np.unique(labels).tolist())
        records = [
            self._record(label, *one, clip.index)
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
        completer = self.completer.at(clip) if isinstance(self.completer, ClipCompleter) else self.completer
        views = [self._latest(*(track.views for track in one.tracks)) for one in objects]
        seen = [k for k, one in enumerate(objects) if one.readings.any() or views[k]]
        streams = [key.child(k).generator() for k in seen]
        masks = [readings.mask(objects[k].readings) for k in seen]
        found = completer.complete_each(streams, clip.after, masks, clip.grid, [views[k] for k in seen])
        completed = {k: one.shifted(self.occupied_log_odds) for k, one in zip(seen, found, strict=True)}
        completed |= {k: one.remains for k, one in enumerate(objects) if k not in completed and one.remains}
        return [completed[k] for k in range(len(objects))]

    def _record(self, label: int, one: SceneObject, completion: Completion, birth: int) -> ObjectRecord:
        """The record of an object: the record of the first object that it continues, or a new record."""
        key, views = completion.key, self._latest(completion.views)
        if not one.tracks:
            return ObjectRecord.born(label, birth, key, views)
        return replace(one.tracks[0].changed(), label=label, completion_key=key, views=views)

    def _latest(self, *histories: tuple[ObjectView, ...]) -> tuple[ObjectView, ...]:
        """The latest views of several objects. For each object, the oldest view is first."""
        newest = (view for level in zip_longest(*map(reversed, histories)) for view in level if view is not None)
        return tuple(islice(newest, self.n_views))[::-1]

    # Evidence of built candidates -------------------------------------------------------------------------------

    def _scored(self, candidates: Population, clip: Clip) -> Population:
        """The `n_scored` candidates of largest weight, built and weighted by the evidence as well."""
        kept = largest(candidates.log_weights, self.n_scored)
        built, scores = candidates.take(kept).realised(), {}
        total = np.zeros(len(built))
        for k, term in enumerate(self.evidence):
            name, score = type(term).__name__, term.log_score(built.particles, clip)
            scores[f"{name} {k}" if name in scores else name] = score.round(3).tolist()
            total += score
        return replace(built, log_weights=built.log_weights + total, notes={**built.notes, "scores": scores})


def _segments(proposed: Population, readings: Readings) -> list[np.ndarray]:
    """The segment (m,) of each reading in each sample, where 0 means none.

    A reading belongs to the segment of its voxel, or to the nearest segment within a voxel. At borders, some pixels
    of one object have readings of another.
    """
    found = {id(h): readings.labels(h.labels, 1.0) for h in {id(h): h for h in proposed.particles}.values()}
    return [found[id(h)] for h in proposed.particles]


def _distinct(proposed: Population, segments: Sequence[np.ndarray]) -> tuple[Population, list[np.ndarray]]:
    """The distinct samples with the total weight of the equal ones, and their segments (m,)."""
    which = first_seen(one.tobytes() for one in segments)
    example = np.unique(which, return_index=True)[1]
    merged = proposed.take(example, np.log(np.bincount(which, proposed.weights)))
    return merged, [segments[k] for k in example]


def _new_objects(segments: Sequence[np.ndarray], candidate: int) -> list[SceneObject]:
    """The segments (m,) of a candidate as new objects."""
    own = segments[candidate]
    return [SceneObject(own == k) for k in np.unique(own[own > 0])]

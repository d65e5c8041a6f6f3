"""The objects of a scene as one table: what is there, where, how certain, and which other object it may belong to.

>>> table = Belief.of_step(state, info).objects()
>>> print(table)                                       # a line for each object
>>> table[0].existence, table[0].centre, table[0].spread, table[0].visible
>>> table[0].one_with                                  # {number of another object: probability that both are one}
>>> corners, triangles = table[0].mesh()               # a smooth surface in world metres
>>> table.rows()                                       # for JSON or a data frame; table.rows(T_base_world)
>>> later.objects(previous=table)                      # the same objects keep their numbers

Each hypothesis numbers its objects as it likes and divides the scene in its own way. So the table takes the objects
of one hypothesis, `Belief.estimate`, and asks the others about each:

- Does it exist? It does in a hypothesis in which objects occupy more than half of its voxels.
- Is it one with another object? It is in a hypothesis in which one object has most voxels of both.
- Is it several objects? It is in a hypothesis in which two objects have .15 of its voxels each.
- Where is it, and how large? Objects of different hypotheses are matched one to one by the intersection over union of
  their voxels, with the largest sum. Those that match with .3 or more are the same object, unless one of them is
  several objects of the other hypothesis.

Objects where the estimate has nothing, such as a hidden object that only some hypotheses remember, follow as further
rows. Another reading of visible pixels is no further object; the questions above tell of it. If the belief has all
weighted segmentations of the last image, the first three questions about a visible object are asked of its pixels and
of these segmentations, so the answers do not come in steps of a fifth.

An object has the number of the object of the previous table with which it shares most voxels, from which it
descends, or which had its colours and size, one to one. The `id` of a record alone does not follow an object: another
hypothesis may be the estimate now, and it has its own ids.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count, product
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import RigidTransform

from mstfilter.base.errors import InputError
from mstfilter.base.lazy import late
from mstfilter.mst.belief.rows import object_row
from mstfilter.scene import Camera, CommonRefinement, Crop, Hypothesis, ObjectRecord, main_colour, project

if TYPE_CHECKING:
    from mstfilter.mst.belief.queries import Belief

_SAME = 0.3  # least intersection over union of one object in two hypotheses
_SHOWN = 0.01  # least probability of "one" that is noted
_PART = 0.15  # share of an object from which a part of it counts
#: Worth of an equal id and of equal colours and size, beside the overlap with the previous voxels; least sum.
_DESCENT, _ALIKE, _LEAST_SCORE = 0.5, 0.3, 0.2
_LEVELS = (np.arange(10) + 0.5) / 10  # the shape at level u has the voxels of at least this probability
_RANGE = (0.1, 0.9)  # quantiles of the volume


@dataclass(frozen=True, eq=False)
class BelievedObject:
    """One object, as all hypotheses together describe it. Lengths are in metres, in the frame of the grid."""

    number: int  #: names the object in this table and in later ones
    hypothesis: int  #: index in `Belief.hypotheses` of the one that it is taken from
    label: int  #: in this hypothesis
    in_estimate: bool  #: whether this hypothesis is `Belief.estimate()`
    record: ObjectRecord  #: in this hypothesis
    existence: float  #: probability that there is an object
    visible: bool  #: whether the last image shows it
    last_seen: int  #: index of the last pause at which it was seen
    several: float  #: probability that it is several objects, if it exists
    one_with: Mapping[int, float]  #: probability that it and another object are one, if both exist, by number; > .01
    centre: np.ndarray  #: (3,) mean of the middle
    spread: np.ndarray  #: (3,) standard deviation of the middle, over hypotheses and shapes
    T_world_box: RigidTransform  #: frame of the oriented box (`Hypothesis.box`)
    sides: np.ndarray  #: (3,) lengths of the box
    volume: float  #: expected volume, cubic metres
    volume_range: tuple[float, float]  #: from the quantile .1 to .9 of the volume
    colour: tuple[int, int, int] | None  #: main colour (r, g, b) of what was seen; None if not known
    shape: Crop  #: voxels with probability .5 or more, and the probabilities of all voxels, if the object exists
    origin: np.ndarray = field(repr=False)  #: (3,) lower corner of the grid
    voxel_size: float = field(repr=False)

    mesh = late("mstfilter.app.report.export:smooth_mesh", "Corners and triangles of a smooth surface of the object.")

    @property
    def pose(self) -> RigidTransform:
        """Rigid motion in world metres since the object was first proposed (`Hypothesis.pose`)."""
        return self.record.pose

    @property
    def lineage(self) -> tuple[int, int]:
        """Id and birth of its record: equal for one object in hypotheses that descend from one another."""
        return self.record.id, self.record.birth

    @property
    def shift(self) -> np.ndarray:
        """(3,) metres, how far its middle has moved since the object was first proposed."""
        return np.asarray(self.centre - self.pose.inv().apply(self.centre))

    def __repr__(self) -> str:
        return f"BelievedObject {self.text}"

    @property
    def text(self) -> str:
        """One line of words."""
        where = ", ".join(f"{x:.2f}" for x in self.centre)
        sides = " x ".join(f"{100 * side:.0f}" for side in self.sides)
        parts = [f"{self.number}: {self.existence:.2f} that it exists, at ({where}) m, {sides} cm"]
        low, high = (1e6 * v for v in self.volume_range)
        parts.append(f"{1e6 * self.volume:.0f} cm3 ({low:.0f} to {high:.0f})")
        if not self.visible:
            parts.append(f"hidden, last seen at pause {self.last_seen}")
        if self.several > _PART:
            parts.append(f"{self.several:.2f} that it is several")
        parts += [f"{p:.2f} that it is one with {other}" for other, p in self.one_with.items()]
        return ", ".join(parts)

    def row(self, T_frame_world: RigidTransform | None = None) -> dict[str, Any]:
        """The figures by name, of plain types, in the frame of the grid or another one: for JSON or a data frame."""
        return object_row(self, T_frame_world)


@dataclass(frozen=True, eq=False)
class ObjectTable:
    """The objects of a belief, those of the estimate first, in order of their labels."""

    objects: tuple[BelievedObject, ...]
    n_hypotheses: int
    last_number: int = 0  #: largest number of an object so far; no number is used for two objects

    def __len__(self) -> int:
        return len(self.objects)

    def __iter__(self) -> Iterator[BelievedObject]:
        return iter(self.objects)

    @overload
    def __getitem__(self, k: int) -> BelievedObject: ...
    @overload
    def __getitem__(self, k: slice) -> tuple[BelievedObject, ...]: ...
    def __getitem__(self, k: int | slice) -> BelievedObject | tuple[BelievedObject, ...]:
        return self.objects[k]

    def by_number(self, number: int) -> BelievedObject:
        """The object with a number. Raises InputError if the table has none."""
        for one in self:
            if one.number == number:
                return one
        raise InputError(f"no object has number {number}", f"numbers: {[one.number for one in self]}")

    def __repr__(self) -> str:
        n, hidden = len(self), sum(not one.visible for one in self)
        head = (
            f"{n} object{'s' * (n != 1)}{f', {hidden} hidden' if hidden else ''}, from {self.n_hypotheses} hypotheses"
        )
        return "\n  ".join([head, *(one.text for one in self)])

    _repr_html_ = late("mstfilter.app.report.display:to_html", "What a notebook shows.")

    def rows(self, T_frame_world: RigidTransform | None = None) -> list[dict[str, Any]]:
        """`BelievedObject.row` of every object."""
        return [one.row(T_frame_world) for one in self]

    def renumbered(self, numbers: Sequence[int]) -> ObjectTable:
        """The table with other numbers, one for each object."""
        new = dict(zip((one.number for one in self), numbers, strict=True))
        objects = (
            replace(one, number=new[one.number], one_with={new[k]: p for k, p in one.one_with.items()})
            for one in self
        )
        return replace(self, objects=tuple(objects), last_number=max([self.last_number, *numbers]))


def object_table(belief: Belief, camera: Camera | None = None, previous: ObjectTable | None = None) -> ObjectTable:
    """The objects of a belief; see `Belief.objects`."""
    matching = _Matching(belief)
    if camera is None and belief.seen is not None:
        camera = belief.seen.camera
    if camera is not None:
        matching.keep_unseen(camera)
    rows = matching.rows
    kept = [matching.votes(i, label) for i, label in rows]
    votes = list(kept)
    mass = [matching.mass] * len(rows)
    if camera is not None and rows:
        refined, weights = belief.refined_image(camera)
        for r, (i, label) in enumerate(rows):
            shown = np.bincount(refined.cells[matching.pixels(i, label, camera)], minlength=len(refined.sizes))
            if matching.is_visible(i, label) and shown.any():
                votes[r], mass[r] = _votes(refined, shown), weights
    objects = []
    for r in range(len(rows)):
        one_with = {}
        for other in range(len(rows)):
            # A visible and a hidden object can be compared in the kept hypotheses alone.
            a, b, w = votes[r], votes[other], mass[r]
            if w is not mass[other]:
                a, b, w = kept[r], kept[other], matching.mass
            if other != r and (p := a.one_with(b, w)) > _SHOWN:
                one_with[other] = p
        objects.append(matching.described(r, votes[r], mass[r], one_with))
    return _numbered(ObjectTable(tuple(objects), len(belief)), previous)


def _numbered(table: ObjectTable, previous: ObjectTable | None) -> ObjectTable:
    """The table with numbers that continue those of the previous one, from objects numbered by their rows."""
    earlier = () if previous is None else previous.objects
    last = 0 if previous is None else previous.last_number
    score = np.zeros((len(table), len(earlier)))
    for (r, now), (k, before) in product(enumerate(table), enumerate(earlier)):
        descends = now.lineage == before.lineage
        score[r, k] = _jaccard(now.shape, before.shape) + _DESCENT * descends + _ALIKE * _likeness(now, before)
    pairs = zip(*linear_sum_assignment(-score), strict=True)
    known = {int(r): earlier[k].number for r, k in pairs if score[r, k] >= _LEAST_SCORE}
    fresh = count(last + 1)
    numbers = [known.get(r) or next(fresh) for r in range(len(table))]
    return replace(table.renumbered(numbers), last_number=next(fresh) - 1)


def _likeness(a: BelievedObject, b: BelievedObject) -> float:
    """Common share of the colours that were seen, times the root of the ratio of the volumes; 0 to 1."""
    first, second = _colours(a.record), _colours(b.record)
    if first is None or second is None:
        return 0.0
    common = np.minimum(first / first.sum(), second / second.sum()).sum()
    return float(common * np.sqrt(min(a.volume, b.volume) / max(a.volume, b.volume)))


def _colours(record: ObjectRecord) -> np.ndarray | None:
    """The areas of the colours that all views have seen; None if there are none."""
    known = [view.colours for view in record.views if view.colours.any()]
    return np.sum(known, axis=0) if known else None


def _jaccard(a: Crop, b: Crop) -> float:
    """Intersection over union of the voxels of two crops of one grid."""
    low = np.maximum(a.offset, b.offset)
    high = np.minimum(a.offset + a.occupied.shape, b.offset + b.occupied.shape)
    if (high <= low).any():
        return 0.0
    one, other = (
        crop.occupied[tuple(slice(i, j) for i, j in zip(low - crop.offset, high - crop.offset, strict=True))]
        for crop in (a, b)
    )
    shared = int((one & other).sum())
    return shared / max(int(a.occupied.sum() + b.occupied.sum()) - shared, 1)


@dataclass(frozen=True, eq=False)
class _Votes:
    """What n segmentations say of one object."""

    exists: np.ndarray  # (n,) bool
    several: np.ndarray  # (n,) bool
    owner: np.ndarray  # (n,) the object with most of it, 0 if there is none

    def probability(self, weights: np.ndarray) -> float:
        return float(np.clip(weights @ self.exists, 0, 1))

    def given(self, event: np.ndarray, weights: np.ndarray) -> float:
        """Probability of an event (n,) bool, if the object exists."""
        return float(np.clip(weights @ (event & self.exists) / max(self.probability(weights), 1e-12), 0, 1))

    def one_with(self, other: _Votes, weights: np.ndarray) -> float:
        """Probability that this object and another one are one, if both exist."""
        both = self.exists & other.exists
        same = both & (self.owner == other.owner) & (self.owner > 0)
        return float(np.clip(weights @ same / max(float(weights @ both), 1e-12), 0, 1))


def _votes(refined: CommonRefinement, counts: np.ndarray) -> _Votes:
    """The votes of segmentations on an object with so many positions in each cell (k,)."""
    present = np.flatnonzero(counts)
    shares = []
    for row in refined.objects[:, present]:
        number, index = np.unique(row, return_inverse=True)
        shares.append(dict(zip(number.tolist(), (np.bincount(index, counts[present]) / counts.sum()), strict=True)))
    owned = [{k: share for k, share in one.items() if k > 0} for one in shares]
    return _Votes(
        np.array([one.get(0, 0.0) < 0.5 for one in shares]),
        np.array([sum(share >= _PART for share in one.values()) > 1 for one in owned]),
        np.array([max(one, key=lambda k: one[k]) if one else 0 for one in owned]),
    )


class _Matching:
    """The rows of the table, and the objects of each hypothesis that they are."""

    def __init__(self, belief: Belief) -> None:
        self.belief, self.hypotheses, self.mass = belief, *belief.distinct
        self._images: dict[int, np.ndarray] = {}
        self.refined = belief.refined_voxels
        self.shared = self.refined.overlaps()
        self.jaccard = self.refined.jaccard(self.shared)
        records = [h.objects for h in self.hypotheses]
        now = max((one.last_seen for own in records for one in own), default=0)
        self.now = now if belief.pause is None else belief.pause
        estimate = belief.estimate()
        first = next(i for i, h in enumerate(self.hypotheses) if h is estimate)
        self.rows = [(first, one.label) for one in records[first]]  # hypothesis and label of each row
        self.in_estimate = len(self.rows)
        for i in np.argsort(-self.mass, kind="stable").tolist():
            if i == first:
                continue
            matched = self.matches(i)
            for one in records[i]:
                if one.label not in matched and self._is_elsewhere(i, one.label, first):
                    self.rows.append((i, one.label))

    def pixels(self, i: int, label: int, camera: Camera) -> np.ndarray:
        """Where an image shows an object of hypothesis i (H, W)."""
        if i not in self._images:
            self._images[i] = project(self.hypotheses[i], camera)
        return np.asarray(self._images[i] == label)

    def keep_unseen(self, camera: Camera) -> None:
        """Remove further rows whose pixels show objects of the estimate: these are other readings of the image."""
        if not self.rows[self.in_estimate :]:
            return
        taken = project(self.belief.estimate(), camera) > 0
        further = [
            (i, label)
            for i, label in self.rows[self.in_estimate :]
            if not self.is_visible(i, label) or not _most(taken[self.pixels(i, label, camera)])
        ]
        self.rows = self.rows[: self.in_estimate] + further

    def _number(self, i: int, label: int) -> int:
        """Number in the refinement of an object of a hypothesis."""
        return int(self.refined.first[i]) + 1 + [one.label for one in self.hypotheses[i].objects].index(label)

    def _is_elsewhere(self, i: int, label: int, first: int) -> bool:
        """Whether objects of hypothesis `first` and of other rows have less than half of an object."""
        k = self._number(i, label)
        of_first = self.shared[k, self.refined.first[first] + 1 : self.refined.first[first + 1] + 1].sum()
        others = [self.shared[k, self._number(*row)] for row in self.rows[self.in_estimate :]]
        return bool(max([of_first, *others]) < 0.5 * self.shared[k, k])

    def matches(self, i: int) -> dict[int, int]:
        """The row of each object of hypothesis i that is the object of a row, by label."""
        own = [one.label for one in self.hypotheses[i].objects]
        numbers, columns = [self._number(i, label) for label in own], [self._number(*row) for row in self.rows]
        shared = self.shared[np.ix_(numbers, columns)]
        of_own, of_row = self.shared[numbers, numbers][:, None], self.shared[columns, columns]
        merges = (shared > 0.5 * of_row).sum(axis=1, keepdims=True) > 1  # it has most of two rows
        splits = ((shared > 0.5 * of_own) & (of_own > _PART * of_row)).sum(axis=0) > 1  # the row has two such objects
        table = np.where(merges | splits, 0, self.jaccard[np.ix_(numbers, columns)])
        table[np.equal.outer(numbers, columns)] = 1  # a row is its own object, also if it has most of two others
        pairs = zip(*linear_sum_assignment(-table), strict=True)
        return {own[a]: int(r) for a, r in pairs if table[a, r] >= _SAME}

    @cached_property
    def label_of(self) -> list[dict[int, int]]:
        """For each hypothesis, its label of each row that it has."""
        return [{r: label for label, r in self.matches(i).items()} for i in range(len(self.hypotheses))]

    def votes(self, i: int, label: int) -> _Votes:
        """The votes of the kept hypotheses on the voxels of an object of hypothesis i."""
        own = self.refined.objects[i] == self._number(i, label)
        return _votes(self.refined, np.where(own, self.refined.sizes, 0))

    def is_visible(self, i: int, label: int) -> bool:
        """Whether the last image shows an object of hypothesis i."""
        return self.hypotheses[i].record(label).last_seen >= self.now

    def described(self, r: int, votes: _Votes, mass: np.ndarray, one_with: dict[int, float]) -> BelievedObject:
        """Row r."""
        (i, label), grid = self.rows[r], self.belief.grid
        having = [(k, of[r]) for k, of in enumerate(self.label_of) if r in of]
        shapes = [_stored(self.hypotheses[k], own) for k, own in having]
        weight = np.array([self.mass[k] for k, _ in having]) / sum(self.mass[k] for k, _ in having)
        middles, volumes, of_shape = [], [], []
        for w, (voxels, p) in zip(weight, shapes, strict=True):
            points = np.stack(np.unravel_index(voxels, grid.shape), axis=1)
            for level in _LEVELS:
                inside = p >= level
                if inside.any():
                    middles.append(points[inside].mean(axis=0))
                    volumes.append(float(inside.sum()))
                    of_shape.append(w)
        share = np.array(of_shape) / np.sum(of_shape)
        middle, volume = np.array(middles), np.array(volumes) * grid.voxel_size**3
        mean = share @ middle
        order = np.argsort(volume)
        at = np.searchsorted(np.cumsum(share[order]), np.array(_RANGE) - 1e-9)
        record, (frame, sides) = self.hypotheses[i].record(label), self.hypotheses[i].box(label)
        colours = _colours(record)
        return BelievedObject(
            number=r,
            hypothesis=self.belief.hypotheses.index(self.hypotheses[i]),
            label=label,
            in_estimate=r < self.in_estimate,
            record=record,
            existence=votes.probability(mass),
            visible=self.is_visible(i, label),
            last_seen=record.last_seen,
            several=votes.given(votes.several, mass),
            one_with=one_with,
            centre=grid.centre_of(mean),
            spread=np.sqrt(share @ (middle - mean) ** 2) * grid.voxel_size,
            T_world_box=frame,
            sides=sides,
            volume=float(share @ volume),
            volume_range=(float(volume[order[at[0]]]), float(volume[order[min(at[1], len(order) - 1)]])),
            colour=None if colours is None else main_colour(colours),
            shape=_mean_shape(shapes, weight, grid.shape),
            origin=grid.origin,
            voxel_size=grid.voxel_size,
        )


def _most(values: np.ndarray) -> bool:
    """Whether more than half of the values (n,) bool are True."""
    return bool(2 * values.sum() > len(values))


def _stored(hypothesis: Hypothesis, label: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat voxels (m,) of an object and their probabilities (m,), which are at least .5 where it is the label."""
    voxels, owners, p = hypothesis.shares.stored
    own = (owners == label) & (p > 0)
    labelled = np.flatnonzero(hypothesis.labels == label)
    found = np.union1d(labelled, voxels[own])
    probability = np.zeros(len(found))
    probability[np.searchsorted(found, voxels[own])] = p[own]
    at = np.searchsorted(found, labelled)
    probability[at] = np.maximum(probability[at], 0.5)
    return found, probability


def _mean_shape(shapes: list[tuple[np.ndarray, np.ndarray]], weights: np.ndarray, shape: tuple[int, ...]) -> Crop:
    """The weighted mean of the probabilities of the voxels of several shapes."""
    voxels, index = np.unique(np.concatenate([v for v, _ in shapes]), return_inverse=True)
    p = np.bincount(index, np.concatenate([w * p for w, (_, p) in zip(weights, shapes, strict=True)]))
    at = np.stack(np.unravel_index(voxels, shape), axis=1)
    low = at.min(axis=0)
    box = np.zeros(at.max(axis=0) - low + 1)
    box[tuple((at - low).T)] = p
    return Crop(box >= 0.5, low, box)

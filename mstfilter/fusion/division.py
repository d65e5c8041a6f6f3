"""Objects that hold two things which were seen to move apart, taken apart; and the memory that they did.

>>> hypothesis = take_apart(hypothesis, motions, clip)              # by what this clip has shown
>>> proposed = part_like(proposed, predicted)                       # by what earlier ones have shown

Once two touching objects have been pulled apart, a later image may well show them as one again. Each object
remembers from whom it came apart (`ObjectRecord.apart`), and fusion never makes one of the two again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from mstfilter.fusion.conflicts import claimed, overlapping
from mstfilter.fusion.interfaces import Division
from mstfilter.scene import MAX_LABEL, Clip, Hypothesis, ObjectRecord, frame_geometry, project
from mstfilter.tracking import MotionSegmentation

__all__ = ["NoDivision", "PartRule", "RigidMotions", "part_like", "remember_like", "take_apart"]

_INSIDE = 0.5  # of a predicted object, for a proposed one to hold it


@dataclass(frozen=True)
class NoDivision(Division):
    """Divides no object."""

    def divide(self, clip: Clip) -> None:
        """Return None."""


@dataclass(frozen=True)
class RigidMotions(Division):
    """Pixels that followed different rigid motions in the clip belong to different objects.

    Parameters
    ----------
    motions : MotionSegmentation
        Groups the pixels of the last frame by rigid motion.
    """

    motions: MotionSegmentation = field(default_factory=MotionSegmentation)

    def divide(self, clip: Clip) -> np.ndarray | None:
        """Number of the motion of each pixel: 0 at rest, 1, 2, ... moving, -1 unknown; None for a single frame."""
        return self.motions.labels(clip)


@dataclass(frozen=True)
class PartRule:
    """When a part of an object is worth an object of its own.

    Parameters
    ----------
    min_pixels : int
        Visible pixels of known motion that a part needs.
    min_share : float
        ... and the share of the object's pixels of known motion.
    pure : float
        Share of an object's pixels of known motion that must agree for it to count as having moved so.
    """

    min_pixels: int = 40
    min_share: float = 0.25
    pure: float = 0.8


def take_apart(
    hypothesis: Hypothesis, motions: np.ndarray, clip: Clip, rule: PartRule = PartRule(), proposed: bool = True
) -> Hypothesis:
    """The hypothesis with objects parted by motion, and with the memory of what moved apart.

    Parameters
    ----------
    hypothesis : Hypothesis
        About the end of the clip.
    motions : (H, W) int
        Number of the motion of each pixel of the last frame, -1 unknown (`Division.divide`).
    clip : Clip
    rule : PartRule
    proposed : bool
        Whether the hypothesis comes from the proposal: keeps the ids of new parts of both sides different.
    """
    image = project(hypothesis, clip.after.camera)
    known = (image > 0) & (motions >= 0)
    if not known.any() or motions[known].min() == motions[known].max():
        return hypothesis
    n = int(motions.max()) + 1
    size = int(hypothesis.labels.max()) + 1
    count = np.bincount(image[known].astype(np.int64) * n + motions[known], minlength=size * n).reshape(size, n)
    total = count.sum(axis=1, keepdims=True)
    parts = (count >= rule.min_pixels) & (count >= rule.min_share * total)
    labels, origin = hypothesis.labels, {}
    for label in np.flatnonzero(parts.sum(axis=1) >= 2).tolist():
        labels, made = _parted_by_pixels(
            hypothesis, labels, label, np.flatnonzero(parts[label]), image, motions, clip
        )
        origin.update(made)
    went = {
        k: int(count[k].argmax())
        for k in range(size)
        if count[k].max() >= max(rule.min_pixels, rule.pure * total[k, 0])
    }
    for label, (_, motion) in origin.items():
        went[label] = motion
    divided = _with_parts(hypothesis, labels, {k: parent for k, (parent, _) in origin.items()}, clip.index, proposed)
    return _remember(divided, went)


def _parted_by_pixels(
    hypothesis: Hypothesis,
    labels: np.ndarray,
    label: int,
    numbers: np.ndarray,
    image: np.ndarray,
    motions: np.ndarray,
    clip: Clip,
) -> tuple[np.ndarray, dict[int, tuple[int, int]]]:
    """Each voxel goes to the motion of the nearest visible one. Returns labels, new label -> (parent, motion)."""
    geometry = frame_geometry(clip.after, hypothesis.grid)
    at = np.nonzero(hypothesis.labels == label)
    pixel = geometry.pixel[at]
    with np.errstate(invalid="ignore"):
        near = np.abs(geometry.signed[at]) < 2 * hypothesis.grid.voxel_size
    seen = near & (pixel >= 0) & (image.ravel()[pixel] == label)
    number = np.where(seen, motions.ravel()[pixel], -1)
    number[~np.isin(number, numbers)] = -1
    seeds = number >= 0
    present = np.unique(number[seeds])
    if len(present) < 2:
        return labels, {}
    voxels = np.stack(at, axis=1)
    _, nearest = cKDTree(voxels[seeds]).query(voxels)
    return _split(labels, at, number[seeds][nearest], label)


def _split(
    labels: np.ndarray, at: tuple[np.ndarray, ...], part: np.ndarray, label: int
) -> tuple[np.ndarray, dict[int, tuple[int, int]]]:
    """New labels for all parts but the largest; new label -> (parent label, part)."""
    present, counts = np.unique(part, return_counts=True)
    largest = int(present[counts.argmax()])
    free = int(labels.max()) + 1
    if free + len(present) > MAX_LABEL:
        return labels, {}
    out, made = labels.copy(), {label: (label, largest)}
    for k in present.tolist():
        if k != largest:
            out[tuple(a[part == k] for a in at)] = free
            made[free] = (label, k)
            free += 1
    return out, made


def _with_parts(
    hypothesis: Hypothesis, labels: np.ndarray, parents: dict[int, int], birth: int, proposed: bool
) -> Hypothesis:
    """Records of a hypothesis whose objects were parted: the largest part goes on, the others are new."""
    if labels is hypothesis.labels:
        return hypothesis
    records = []
    for record in hypothesis.objects:
        records.append(record.changed() if record.label in parents else record)
    for label, parent in sorted(parents.items()):
        if label != parent:
            own = label if proposed else MAX_LABEL - label
            new = ObjectRecord.born(own, birth)
            records.append(replace(new, label=label, apart=hypothesis.record(parent).apart))
    return Hypothesis(labels, hypothesis.grid, tuple(sorted(records, key=lambda r: r.label)))


def _remember(hypothesis: Hypothesis, went: dict[int, int]) -> Hypothesis:
    """Objects whose motions differ know each other as apart."""
    movers = [(r.id, went[r.label]) for r in hypothesis.objects if r.label in went]
    records = []
    for record in hypothesis.objects:
        apart = record.apart
        if record.label in went:
            apart = apart | {other for other, motion in movers if motion != went[record.label]}
        # What knew the parent as apart knows its parts so, too.
        records.append(replace(record, apart=apart))
    by_id = {r.id: r for r in records}
    for record in records:
        for other in record.apart:
            if other in by_id and record.id not in by_id[other].apart:
                by_id[other] = replace(by_id[other], apart=by_id[other].apart | {record.id})
    return Hypothesis(hypothesis.labels, hypothesis.grid, tuple(by_id[r.id] for r in records))


def part_like(proposed: Hypothesis, predicted: Hypothesis) -> Hypothesis:
    """The proposal with every object parted that covers predicted objects which came apart before.

    Its voxels go to the nearest of these. What holds less than half of one of them is only its neighbour, seen or
    moved a little wrong.
    """
    if not any(record.apart for record in predicted.objects):
        return proposed
    pairs = zip(*(a.tolist() for a in overlapping(claimed(proposed.labels, predicted.labels))), strict=True)
    inverse, volume = {r.label: r for r in predicted.objects}, predicted.volumes()
    within: dict[int, list[ObjectRecord]] = {}
    for label, k, common in pairs:
        if common >= _INSIDE * volume[k]:
            within.setdefault(label, []).append(inverse[k])
    labels, parents = proposed.labels, {}
    for label, inside in within.items():
        ids = {r.id for r in inside}
        seeds = [r.label for r in inside if r.apart & ids]
        if len(seeds) < 2:
            continue
        at = np.nonzero(proposed.labels == label)
        there = predicted.labels[at]
        seed = np.isin(there, seeds)
        voxels = np.stack(at, axis=1)
        _, nearest = cKDTree(voxels[seed]).query(voxels)
        labels, made = _split(labels, at, there[seed][nearest].astype(np.int64), label)
        parents.update({k: parent for k, (parent, _) in made.items()})
    birth = max((r.birth for r in proposed.objects), default=0)
    return _with_parts(proposed, labels, parents, birth, True)


def remember_like(child: Hypothesis, parent: Hypothesis, own: Mapping[int, int]) -> Hypothesis:
    """The child with what a parent remembers of objects that came apart.

    The heirs of a parent's object are the child's object `own` [label] that it is part of, and the one that has most
    of its voxels now: an object that was painted over lives on in what covers it.
    """
    if not any(record.apart for record in parent.objects):
        return child
    label_of = {r.id: r.label for r in parent.objects}
    heirs: dict[int, set[int]] = {}
    for record in parent.objects:
        if record.apart:
            now = np.bincount(child.labels[parent.labels == record.label])
            heirs[record.id] = {own[record.label]} if record.label in own else set()
            heirs[record.id] |= {int(now.argmax())} - {0}
    ids = {r.label: r.id for r in child.objects}
    apart = {r.label: set(r.apart) for r in child.objects}
    for record in parent.objects:
        for other in record.apart & label_of.keys():
            for a in heirs[record.id]:
                apart[a] |= {ids[b] for b in heirs.get(other, set()) if b != a}
    records = tuple(replace(r, apart=frozenset(apart[r.label])) for r in child.objects)
    return Hypothesis(child.labels, child.grid, records)

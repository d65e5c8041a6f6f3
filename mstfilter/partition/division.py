"""Splits objects whose parts move apart in a clip, and remembers the split.

>>> hypothesis = split_by_motion(hypothesis, motions, clip)         # by the motions of this clip

After two touching objects have moved apart, a segmentation of a later image may show them as one object again.
`ObjectRecord.apart` lists the ids of the objects from which an object has moved apart.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from mstfilter.results import Checked, check_array, returns
from mstfilter.scene import MAX_LABEL, Clip, Hypothesis, ObjectRecord, frame_geometry, project
from mstfilter.tracking import MotionSegmentation

_PURE = 0.8  # share of an object's pixels of known motion that must have one motion for the object to have it
_INSIDE = 0.5  # share of a predicted object that must lie in a proposed object to count as inside


def _check_division(self: Division, found: np.ndarray | None, clip: Clip) -> np.ndarray | None:
    return None if found is None else check_array(found, clip.after.depth.shape, "iu", at_least=-1)


class Division(Checked, ABC):
    """Groups the pixels of a frame by object, as far as the clip shows it."""

    @returns(_check_division)
    @abstractmethod
    def divide(self, clip: Clip) -> np.ndarray | None:
        """Numbers (H, W) int32 of the pixels of the last frame; None if the clip gives no information.

        Pixels with different numbers >= 0 belong to different objects; -1 is unknown. A clip of a single frame, for
        example, gives no information.
        """


@dataclass(frozen=True)
class NoDivision(Division):
    """Divides no object."""

    def divide(self, clip: Clip) -> None:
        return None


@dataclass(frozen=True)
class RigidMotions(Division):
    """Pixels that `motions` groups by different rigid motions in the clip belong to different objects."""

    motions: MotionSegmentation = field(default_factory=MotionSegmentation)

    def divide(self, clip: Clip) -> np.ndarray | None:
        return self.motions.labels(clip)


@dataclass(frozen=True)
class PartRule:
    """When a part of an object becomes a separate object.

    It needs at least `min_pixels` visible pixels of known motion, and the share `min_share` of those of the object.
    """

    min_pixels: int = 40
    min_share: float = 0.25


def split_by_motion(
    hypothesis: Hypothesis, motions: np.ndarray, clip: Clip, rule: PartRule = PartRule(), proposed: bool = True
) -> Hypothesis:
    """Split objects of a hypothesis about the end of a clip by motion, and record which objects moved apart.

    `motions` (H, W) is the result of `Division.divide`. New parts of proposed and predicted hypotheses get different
    ids.
    """
    image = project(hypothesis, clip.after.camera)
    count, parts = _counts(image, motions, rule)
    if not len(count):
        return hypothesis
    total = count.sum(axis=1)
    labels, origin = hypothesis.labels, {}
    for label in np.flatnonzero(parts.sum(axis=1) >= 2).tolist():
        labels, made = _split_by_pixels(hypothesis, labels, label, np.flatnonzero(parts[label]), image, motions, clip)
        origin.update(made)
    motion_of = {
        k: int(count[k].argmax())
        for k in range(len(count))
        if count[k].max() >= max(rule.min_pixels, _PURE * total[k])
    }
    for label, (_, motion) in origin.items():
        motion_of[label] = motion
    divided = _with_parts(hypothesis, labels, {k: parent for k, (parent, _) in origin.items()}, clip.index, proposed)
    return _record_apart(divided, motion_of)


def split_segments(segments: np.ndarray, motions: np.ndarray, voxels: np.ndarray, rule: PartRule) -> np.ndarray:
    """Segments (m,) of readings in `voxels` (m, 3), those with several of the `motions` (m,) split; 0 is no segment.

    A reading gets the part of the nearest reading of its segment whose motion is a part; motion -1 is unknown.
    """
    _, parts = _counts(segments, motions, rule)
    found = segments.copy()
    for label in np.flatnonzero(parts.sum(axis=1) >= 2).tolist():
        at = np.flatnonzero(segments == label)
        number = motions[at]
        part = _nearest(tuple(voxels[at].T), number, np.isin(number, np.flatnonzero(parts[label])))
        found[at] = np.where(part == part[0], label, found.max() + 1 + part)
    return found


def _counts(labels: np.ndarray, motions: np.ndarray, rule: PartRule) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (k, n) of each label with each motion, and which of them are parts; empty if there is one motion."""
    known = (labels > 0) & (motions >= 0)
    if not known.any() or motions[known].min() == motions[known].max():
        return np.zeros((0, 1), int), np.zeros((0, 1), bool)
    n, size = int(motions.max()) + 1, int(labels.max()) + 1
    count = np.bincount(labels[known].astype(np.int64) * n + motions[known], minlength=size * n).reshape(size, n)
    return count, (count >= rule.min_pixels) & (count >= rule.min_share * count.sum(axis=1, keepdims=True))


def _split_by_pixels(
    hypothesis: Hypothesis,
    labels: np.ndarray,
    label: int,
    numbers: np.ndarray,
    image: np.ndarray,
    motions: np.ndarray,
    clip: Clip,
) -> tuple[np.ndarray, dict[int, tuple[int, int]]]:
    """Give each voxel the motion of the nearest visible voxel; see `_split` for the result."""
    geometry = frame_geometry(clip.after, hypothesis.grid)
    at = np.nonzero(hypothesis.labels == label)
    pixel = geometry.pixel[at]
    with np.errstate(invalid="ignore"):
        near = np.abs(geometry.signed[at]) < 2 * hypothesis.grid.voxel_size
    seen = near & (pixel >= 0) & (image.ravel()[pixel] == label)
    number = np.where(seen, motions.ravel()[pixel], -1)
    number[~np.isin(number, numbers)] = -1
    seeds = number >= 0
    if len(np.unique(number[seeds])) < 2:
        return labels, {}
    return _split(labels, at, _nearest(at, number, seeds), label)


def _nearest(at: tuple[np.ndarray, ...], values: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The value (n,) of the nearest seed of each voxel `at`; `seeds` (n,) bool selects voxels."""
    voxels = np.stack(at, axis=1)
    _, nearest = cKDTree(voxels[seeds]).query(voxels)
    return np.asarray(values[seeds][nearest])


def _split(
    labels: np.ndarray, at: tuple[np.ndarray, ...], part: np.ndarray, label: int
) -> tuple[np.ndarray, dict[int, tuple[int, int]]]:
    """Give all parts but the largest new labels. Returns labels and label -> (parent label, part)."""
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
    """The hypothesis after a split: the largest part keeps the record of its parent, the others get new records."""
    if labels is hypothesis.labels:
        return hypothesis
    records = [replace(r.changed(), views=()) if r.label in parents else r for r in hypothesis.objects]
    for label, parent in sorted(parents.items()):
        if label != parent:
            new = ObjectRecord.born(label if proposed else MAX_LABEL - label, birth)
            records.append(replace(new, label=label, apart=hypothesis.record(parent).apart))
    return hypothesis.relabelled(labels, tuple(sorted(records, key=lambda r: r.label)))


def _record_apart(hypothesis: Hypothesis, motion_of: dict[int, int]) -> Hypothesis:
    """Record objects with different motions as apart, in both records. `motion_of` maps labels to motions."""
    moved = [(r.id, motion_of[r.label]) for r in hypothesis.objects if r.label in motion_of]
    apart = {r.id: set(r.apart) for r in hypothesis.objects}
    for k, motion in moved:
        apart[k] |= {other for other, other_motion in moved if other_motion != motion}
    for k in list(apart):
        for other in apart[k] & apart.keys():
            apart[other].add(k)
    records = tuple(replace(r, apart=frozenset(apart[r.id])) for r in hypothesis.objects)
    return replace(hypothesis, objects=records)


def divided(
    division: Division, parts: PartRule, hypotheses: tuple[Hypothesis, ...], clip: Clip, proposed: bool
) -> tuple[Hypothesis, ...]:
    """Hypotheses about the end of a clip with objects split by motion. A repeated hypothesis is split once."""
    motions = division.divide(clip)
    if motions is None:
        return hypotheses
    distinct = {id(h): h for h in hypotheses}
    split = {name: split_by_motion(h, motions, clip, parts, proposed) for name, h in distinct.items()}
    return tuple(split[id(h)] for h in hypotheses)

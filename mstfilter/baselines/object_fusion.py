"""MID-Fusion-style: one map of objects, each a volume of signed distances that is tracked and averaged over time.

>>> mstfilter.preset("object_fusion")

A re-implementation of the idea of Xu et al. 2019 ("MID-Fusion: Octree-based Object-Level Multi-Instance Dynamic
SLAM") within this package's interfaces, not of their program. At every pause

1. the map's objects follow the clip by the same tracker as in all other filters (the filter's transition);
2. the masks of the single-frame segmentation are matched with the rendered map by their overlap;
3. every object's volume takes in the images of the clip, each from the pose that registration of depth and colour,
   frame by frame, gives; surfaces count within the object's mask, free space counts wherever it is seen;
4. masks that match nothing, and are not covered by what does, become objects: completed as everywhere else.

There is one hypothesis: a wrong mask is never reconsidered, two objects never become one. Between pauses the map is
kept as every hypothesis is, as voxels; a volume begins anew with their signed distance at `prior_weight`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import numpy as np

from mstfilter.baselines.volumes import ObjectVolume
from mstfilter.errors import InputError
from mstfilter.fusion import FreeSpace, Projection
from mstfilter.scene import Clip, Frame, Hypothesis, ObjectRecord, VoxelGrid, depth_sigma, project
from mstfilter.scoring import overlap
from mstfilter.smc import Population, Update, union
from mstfilter.tracking import Array, DenseFlow, Segment, Track, apply, refine, segments_of

__all__ = ["ObjectFusion"]


class _Match(NamedTuple):
    """Masks (H, W) bool by the label of the object that they show, and labels of samples that are new objects."""

    masks: dict[int, np.ndarray]
    new: list[int]


@dataclass(frozen=True)
class ObjectFusion(Update):
    """Object-level volumetric fusion, MID-Fusion-style.

    Parameters
    ----------
    free_space : Projection
        Clears the tracked map first, as in the other filters.
    truncation : float
        Of the signed distances, metres. Twice a voxel is better than three times: .01-.02 of quality on scenes for
        tuning.
    prior_weight : float
        Images that what the map held before counts for.
    match_iou : float
        Smallest overlap (intersection over union of pixels) of a mask with the rendered object that it shows.
    new_share : float
        A mask without a match is a new object where less than this share of it shows objects that are known.
    min_pixels : int
        Smallest mask of a new object, in pixels of a 640 x 480 image; scales with the image's area.
    min_agreement : float
        Share of an object's visible points that must lie on the measured surface (3 sigma + 5 mm) if an image between
        pauses is to be taken in; the first that fails ends the way back of what moves.
    min_voxels : int
        Objects with fewer voxels left are forgotten.
    between : bool
        Take in the images between the pauses.
    """

    free_space: Projection = field(default_factory=FreeSpace)
    truncation: float = 0.02
    prior_weight: float = 2.0
    match_iou: float = 0.3
    new_share: float = 0.5
    min_pixels: int = 60
    min_agreement: float = 0.6
    min_voxels: int = 8
    between: bool = True

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not self.truncation > 0 or not self.prior_weight > 0:
            raise InputError(
                f"object fusion has truncation {self.truncation} m and prior_weight {self.prior_weight}, expected > 0"
            )

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Clip,
    ) -> Population:
        """The map after the clip; at the first pause the proposed segmentation, completed."""
        if predicted is None:
            return union(None, proposed)
        maps, notes = [], []
        for j, old in enumerate(predicted.particles):
            sample = None if proposed is None else proposed.particles[j % len(proposed)]
            new, note = self._fuse(old, sample, observation)
            maps.append(new)
            notes.append(note)
        return Population(tuple(maps), predicted.log_weights, predicted.parents, {"maps": notes})

    def _fuse(self, old: Hypothesis, sample: Hypothesis | None, clip: Clip) -> tuple[Hypothesis, dict[str, int]]:
        frame, grid = clip.after, clip.grid
        known = old.n_objects
        # Records begin anew at every pause, so what the tracker has not moved has not moved in this clip.
        moved = {r.label for r in old.objects if not np.array_equal(r.motion.as_matrix(), np.eye(4))}
        old = self.free_space.refine((old,), clip)[0][0]
        match = self._match(old, sample, frame)
        volumes = {r.label: self._begin(old, r.label) for r in old.objects}
        taken = 0
        if self.between and len(clip) > 2 and old.objects:
            volumes, taken = self._take_between(volumes, old, moved, clip)
        everything = np.zeros(frame.depth.shape, np.int32)
        for label, mask in match.masks.items():
            everything[mask] = label
        for label, volume in volumes.items():
            mine, others = everything == label, (everything > 0) & (everything != label)
            volumes[label] = volume.integrate(frame, grid, np.eye(4), mine, others)
        records = {r.label: r for r in old.objects}
        for k in match.new:
            assert sample is not None
            label = max(volumes, default=0) + 1
            volumes[label] = ObjectVolume.of(sample.mask(k), grid, self.truncation, 1.0)
            records[label] = ObjectRecord.born(k, clip.index, sample.record(k).completion_key)
        fused = self._assemble(volumes, records, grid)
        note = {"matched": len(match.masks) - len(match.new), "new": len(match.new), "images": taken}
        return fused, note | {"forgotten": known + len(match.new) - fused.n_objects}

    def _begin(self, old: Hypothesis, label: int) -> ObjectVolume:
        return ObjectVolume.of(old.mask(label), old.grid, self.truncation, self.prior_weight)

    def _match(self, old: Hypothesis, sample: Hypothesis | None, frame: Frame) -> _Match:
        """Which mask shows which object. New ones get numbers beyond the map's."""
        rendered = project(old, frame.camera) if old.objects else np.zeros(frame.depth.shape, np.uint16)
        if sample is None or not sample.objects:
            return _Match({int(k): rendered == k for k in np.unique(rendered) if k > 0}, [])
        seen = project(sample, frame.camera)
        table = overlap(seen, rendered)
        iou = np.where((table.labels_a > 0)[:, None] & (table.labels_b > 0)[None, :], table.jaccard(), 0.0)
        masks: dict[int, np.ndarray] = {}
        left = {int(k) for k in table.labels_a if k > 0}
        while iou.size and iou.max() >= self.match_iou:  # best pairs first, one to one
            a, b = np.unravel_index(int(iou.argmax()), iou.shape)
            masks[int(table.labels_b[b])] = seen == table.labels_a[a]
            left.discard(int(table.labels_a[a]))
            iou[a], iou[:, b] = 0, 0
        new, free = [], max((r.label for r in old.objects), default=0)
        smallest = max(1.0, self.min_pixels * frame.depth.size / 307200)
        for k in sorted(left):
            row = int(np.searchsorted(table.labels_a, k))
            size = int(table.sizes_a[row])
            known = int(table.counts[row][table.labels_b > 0].sum())
            if size >= smallest and known < self.new_share * size:
                new.append(k)
                masks[free + len(new)] = seen == k
        return _Match(masks, new)

    def _take_between(
        self, volumes: dict[int, ObjectVolume], old: Hypothesis, moved: set[int], clip: Clip
    ) -> tuple[dict[int, ObjectVolume], int]:
        """Go back through the clip from its end, frame by frame, and take in what agrees.

        Labels not in `moved` rested throughout.
        """
        tracks = DenseFlow().track(clip)  # shared with the tracker; registration does not look at it
        segments = segments_of(old, clip.after)
        poses: dict[int, Array] = {label: np.eye(4) for label in volumes if label in segments}
        rested = {label for label in poses if label not in moved}
        taken = 0
        for position in range(len(clip) - 2, 0, -1):
            frame = clip.frames[position]
            pair = Clip((clip.after, frame), clip.grid)
            for label in list(poses):
                track, T = Track(segments[label], pair, tracks), poses[label]
                if label not in rested and len(segments[label].support) >= 12:
                    T = refine(track, T)
                if not self._agrees(track, T, frame):
                    if label not in rested:
                        del poses[label]
                    continue
                poses[label] = T
                mine = _shown(segments[label], clip.after, T, frame)
                volumes[label] = volumes[label].integrate(frame, clip.grid, T, mine, np.zeros_like(mine))
                taken += 1
        return volumes, taken

    def _agrees(self, track: Track, T: Array, frame: Frame) -> bool:
        """Whether a moved object's visible points lie on the surface that a frame measures."""
        points = track.points[:: max(1, len(track.points) // 400)]
        uv, z = frame.camera.project(apply(T, points))
        pixel = np.rint(np.where(np.isfinite(uv), uv, -1))
        inside = (pixel >= 0).all(axis=1) & (pixel < [frame.camera.width, frame.camera.height]).all(axis=1)
        u, v = pixel[inside].astype(np.int64).T
        known = frame.valid[v, u]
        behind = (z[inside] - frame.depth[v, u])[known]
        visible = behind < 0.015  # what is hidden says nothing
        if visible.sum() < max(12, 0.3 * len(points)):
            return False
        near = np.abs(behind[visible]) <= 0.005 + 3 * depth_sigma(z[inside][known][visible])
        return bool(near.mean() >= self.min_agreement)

    def _assemble(
        self, volumes: dict[int, ObjectVolume], records: dict[int, ObjectRecord], grid: VoxelGrid
    ) -> Hypothesis:
        """One label grid: a voxel goes to the object in whose masks it was seen most, then to the deepest."""
        labels = np.zeros(grid.shape, np.uint16)
        share, depth = np.zeros(grid.shape), np.zeros(grid.shape)
        for label, volume in volumes.items():
            inside = volume.occupied
            if inside.sum() < self.min_voxels:
                continue
            mine = volume.own / np.maximum(volume.own + volume.other, 1e-9)
            box = volume.box
            better = inside & ((mine > share[box]) | ((mine == share[box]) & (-volume.distance > depth[box])))
            labels[box][better] = label
            share[box][better] = mine[better]
            depth[box][better] = -volume.distance[better]
        present = [int(k) for k in np.unique(labels) if k > 0]
        kept = tuple(replace(records[k], label=k).changed() for k in present)
        return Hypothesis(labels, grid, kept)


def _shown(segment: Segment, after: Frame, T: Array, frame: Frame) -> np.ndarray:
    """(H, W) bool: where a segment of the last frame is seen in an earlier one."""
    import cv2

    uv, _ = frame.camera.project(apply(T, after.points.reshape(-1, 3)[segment.support]))
    pixel = np.rint(np.where(np.isfinite(uv), uv, -1))
    inside = (pixel >= 0).all(axis=1) & (pixel < [frame.camera.width, frame.camera.height]).all(axis=1)
    u, v = pixel[inside].astype(np.int64).T
    image = np.zeros(frame.depth.shape, np.uint8)
    image[v, u] = 1
    return cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0

"""A baseline in the style of MID-Fusion: one map of objects, each a tracked volume of signed distances.

>>> mstfilter.preset("object_fusion")

The baseline is a re-implementation of the idea of Xu et al. 2019 ("MID-Fusion: Octree-based Object-Level
Multi-Instance Dynamic SLAM") within the interfaces of this package. The baseline is not a port of their program. At
every pause these steps are performed:

1. The transition of the filter tracks the objects of the map through the clip.
2. The masks of the single-frame segmentation are matched with the rendered map by overlap.
3. The volume of every object is averaged with the images of the clip. The pose of each image comes from
   frame-by-frame registration of depth and colour. Surface is used only within the object's mask.
4. Masks without a match that do not show known objects become new objects, with the usual completion.

There is one hypothesis. Wrong masks are never revised, and two objects are never merged. Between pauses the map is
stored as voxels, like every hypothesis. A volume starts with the signed distance of its voxels.

>>> volume = ObjectVolume.of(hypothesis.mask(3), grid, truncation=0.03, weight=2.0)
>>> volume = volume.integrate(frame, grid, np.eye(4), mask, others)
>>> volume.occupied                     # (a, b, c) bool, at volume.box of the grid
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from mstfilter.mst.testing import scene_example
from mstfilter.mst.tracking import DenseFlow, Segment, Track, move_points, refine_motion, segments_of
from mstfilter.scene import (
    Clip,
    Frame,
    FreeSpace,
    Hypothesis,
    ObjectRecord,
    Projection,
    VoxelGrid,
    depth_sigma,
    project,
    scaled_area,
)
from mstfilter.scoring import overlap
from mstfilter.smc import Population, Update, union

#: Truncation of the signed distances in metres. Two voxels are better than three by .01 to .02 of quality on tuning
#: scenes.
_TRUNCATION = 0.02
#: Weight of the map before the clip, in images.
_PRIOR_WEIGHT = 2.0
#: Least intersection over union, in pixels, of a mask and the rendered object that it shows.
_MATCH_IOU = 0.3
#: A mask without a match is a new object if less than this share of it shows known objects.
_NEW_SHARE = 0.5
#: Smallest mask of a new object, in pixels of a 640 x 480 image; scales with the area of the image.
_MIN_PIXELS = 60
#: Least share of an object's visible points that lie on the measured surface (3 sigma + 5 mm) in an image between
#: pauses that is integrated. The first image that fails ends the integration of a moving object.
_MIN_AGREEMENT = 0.6
#: Objects with fewer voxels are removed.
_MIN_VOXELS = 8


class _Match(NamedTuple):
    """Masks (H, W) bool by the label of the object that they show, and labels of the sample that are new objects."""

    masks: dict[int, np.ndarray]
    new: list[int]


example = scene_example  # of `mstfilter check update.object_fusion`


@dataclass(frozen=True)
class ObjectFusion(Update):
    """Object-level volumetric fusion in the style of MID-Fusion; `free_space` first clears the tracked map."""

    free_space: Projection = field(default_factory=FreeSpace)

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Clip
    ) -> Population:
        """The map, updated by the clip. At the first pause the map is the proposed segmentation."""
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
        # Records are reset at every pause, so an object with identity motion has not moved in this clip.
        moved = {r.label for r in old.objects if not np.array_equal(r.motion.as_matrix(), np.eye(4))}
        old = self.free_space.refine((old,), clip)[0][0]
        match = self._match(old, sample, frame)
        volumes = {r.label: ObjectVolume.of(old.mask(r.label), grid, _TRUNCATION, _PRIOR_WEIGHT) for r in old.objects}
        n_images = 0
        if len(clip) > 2 and old.objects:
            volumes, n_images = self._integrate_between(volumes, old, moved, clip)
        shown = np.zeros(frame.depth.shape, np.int32)
        for label, mask in match.masks.items():
            shown[mask] = label
        for label, volume in volumes.items():
            mask, others = shown == label, (shown > 0) & (shown != label)
            volumes[label] = volume.integrate(frame, grid, np.eye(4), mask, others)
        records, taken = {r.label: r for r in old.objects}, {r.id for r in old.objects}
        for k in match.new:
            assert sample is not None
            label = max(volumes, default=0) + 1
            volumes[label] = ObjectVolume.of(sample.mask(k), grid, _TRUNCATION, 1.0)
            records[label] = ObjectRecord.born(k, clip.index, sample.record(k).completion_key, taken=taken)
        fused = self._assemble(volumes, records, grid)
        note = {"matched": len(match.masks) - len(match.new), "new": len(match.new), "images": n_images}
        return fused, note | {"forgotten": known + len(match.new) - fused.n_objects}

    def _match(self, old: Hypothesis, sample: Hypothesis | None, frame: Frame) -> _Match:
        """Match masks with objects of the map. New objects get the next labels."""
        rendered = project(old, frame.camera) if old.objects else np.zeros(frame.depth.shape, np.uint16)
        if sample is None or not sample.objects:
            return _Match({int(k): rendered == k for k in np.unique(rendered) if k > 0}, [])
        seen = project(sample, frame.camera)
        table = overlap(seen, rendered)
        iou = np.where((table.labels_a > 0)[:, None] & (table.labels_b > 0)[None, :], table.jaccard(), 0.0)
        masks: dict[int, np.ndarray] = {}
        unmatched = {int(k) for k in table.labels_a if k > 0}
        while iou.size and iou.max() >= _MATCH_IOU:  # best pairs first, one to one
            a, b = np.unravel_index(int(iou.argmax()), iou.shape)
            masks[int(table.labels_b[b])] = seen == table.labels_a[a]
            unmatched.discard(int(table.labels_a[a]))
            iou[a], iou[:, b] = 0, 0
        new, free = [], max((r.label for r in old.objects), default=0)
        smallest = scaled_area(_MIN_PIXELS, frame.depth.size)
        for k in sorted(unmatched):
            row = int(np.searchsorted(table.labels_a, k))
            size = int(table.sizes_a[row])
            known = int(table.counts[row][table.labels_b > 0].sum())
            if size >= smallest and known < _NEW_SHARE * size:
                new.append(k)
                masks[free + len(new)] = seen == k
        return _Match(masks, new)

    def _integrate_between(
        self, volumes: dict[int, ObjectVolume], old: Hypothesis, moved: set[int], clip: Clip
    ) -> tuple[dict[int, ObjectVolume], int]:
        """Integrate the frames of the clip from last to first, as long as they agree with the object.

        Objects with labels not in `moved` were at rest in the whole clip.
        """
        tracks = DenseFlow().track(clip)  # shared with the tracker; registration does not use it
        segments = segments_of(old, clip.after)
        poses: dict[int, np.ndarray] = {label: np.eye(4) for label in volumes if label in segments}
        rested = {label for label in poses if label not in moved}
        n_images = 0
        for position in range(len(clip) - 2, 0, -1):
            frame = clip.frames[position]
            pair = Clip((clip.after, frame), clip.grid)
            for label in list(poses):
                track, T = Track(segments[label], pair, tracks), poses[label]
                if label not in rested and len(segments[label].support) >= 12:
                    T = refine_motion(track, T)
                if not self._agrees(track, T, frame):
                    if label not in rested:
                        del poses[label]
                    continue
                poses[label] = T
                mask = _shown(segments[label], clip.after, T, frame)
                volumes[label] = volumes[label].integrate(frame, clip.grid, T, mask, np.zeros_like(mask))
                n_images += 1
        return volumes, n_images

    def _agrees(self, track: Track, T: np.ndarray, frame: Frame) -> bool:
        """Whether a moved object's visible points lie on the surface that a frame measures."""
        points = track.points[:: max(1, len(track.points) // 400)]
        u, v, z, inside = frame.camera.pixels_of(move_points(T, points))
        u, v, z = u[inside], v[inside], z[inside]
        known = frame.valid[v, u]
        behind = (z - frame.depth[v, u])[known]
        visible = behind < 0.015  # points further behind the measured surface are occluded
        if visible.sum() < max(12, 0.3 * len(points)):
            return False
        near = np.abs(behind[visible]) <= 0.005 + 3 * depth_sigma(z[known][visible])
        return bool(near.mean() >= _MIN_AGREEMENT)

    def _assemble(
        self, volumes: dict[int, ObjectVolume], records: dict[int, ObjectRecord], grid: VoxelGrid
    ) -> Hypothesis:
        """One label grid. A voxel goes to the object with the largest share of masks, then to the deepest one."""
        labels = np.zeros(grid.shape, np.uint16)
        share, depth = np.zeros(grid.shape), np.zeros(grid.shape)
        for label, volume in volumes.items():
            inside = volume.occupied
            if inside.sum() < _MIN_VOXELS:
                continue
            ratio = volume.hits / np.maximum(volume.hits + volume.other_hits, 1e-9)
            box = volume.box
            better = inside & ((ratio > share[box]) | ((ratio == share[box]) & (-volume.distance > depth[box])))
            labels[box][better] = label
            share[box][better] = ratio[better]
            depth[box][better] = -volume.distance[better]
        present = [int(k) for k in np.unique(labels) if k > 0]
        kept = tuple(replace(records[k], label=k).changed() for k in present)
        return Hypothesis(labels, grid, kept)


def _shown(segment: Segment, after: Frame, T: np.ndarray, frame: Frame) -> np.ndarray:
    """Pixels (H, W) bool of an earlier frame that show a segment of the last frame."""
    u, v, _, inside = frame.camera.pixels_of(move_points(T, after.points.reshape(-1, 3)[segment.support]))
    image = np.zeros(frame.depth.shape, np.uint8)
    image[v[inside], u[inside]] = 1
    return cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0


@dataclass(frozen=True, eq=False)
class ObjectVolume:
    """Truncated signed distances of one object in a box of the grid (Curless and Levoy 1996)."""

    offset: np.ndarray  #: (3,) int, index of the box's first voxel in the grid
    distance: np.ndarray  #: (a, b, c) metres to the surface, negative inside, clipped to +-`truncation`
    weight: np.ndarray  #: (a, b, c) number of images averaged in each distance
    hits: np.ndarray  #: (a, b, c) number of images with the voxel at the surface and in the mask of the object
    other_hits: np.ndarray  #: (a, b, c) the same for the masks of other objects
    truncation: float  #: metres

    @classmethod
    def of(cls, mask: np.ndarray, grid: VoxelGrid, truncation: float, weight: float) -> ObjectVolume:
        """The volume of voxels (X, Y, Z) bool, not empty, with a margin of `truncation` on all sides."""
        margin = int(np.ceil(truncation / grid.voxel_size)) + 1
        where = np.nonzero(mask)
        low = np.array([max(int(w.min()) - margin, 0) for w in where])
        high = np.array([min(int(w.max()) + 1 + margin, n) for w, n in zip(where, grid.shape, strict=True)])
        inside = mask[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
        # The surface lies half a voxel from the last centre inside and the first centre outside.
        depth_inside = distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1, 1:-1]
        signed = np.where(inside, 0.5 - depth_inside, distance_transform_edt(~inside) - 0.5)
        distance = np.clip(signed * grid.voxel_size, -truncation, truncation)
        full = np.full(inside.shape, float(weight))
        return cls(low, distance, full, full, np.zeros(inside.shape), truncation)

    @property
    def box(self) -> tuple[slice, slice, slice]:
        """Slices of the box in the grid."""
        a, b, c = (slice(int(o), int(o) + n) for o, n in zip(self.offset, self.distance.shape, strict=True))
        return a, b, c

    @property
    def occupied(self) -> np.ndarray:
        """Voxels (a, b, c) bool inside the surface that were shown by more masks of this object than of others."""
        return (self.distance < 0) & (self.hits > self.other_hits)

    def integrate(
        self, frame: Frame, grid: VoxelGrid, T: np.ndarray, mask: np.ndarray, others: np.ndarray
    ) -> ObjectVolume:
        """The volume averaged with another image.

        `T` (4, 4) is the motion in world metres from the pose of the volume to the pose in the frame. `mask` and
        `others` (H, W) bool are the pixels of this object and of others. Surface is integrated only in `mask`.
        """
        index = np.stack(np.meshgrid(*(np.arange(n) for n in self.distance.shape), indexing="ij"), axis=-1)
        u, v, z, inside = frame.camera.pixels_of(move_points(T, grid.centre_of(index.reshape(-1, 3) + self.offset)))
        inside &= (z > 1e-6) & frame.valid[v, u]
        sdf = np.where(inside, frame.depth[v, u] - z, -np.inf)
        near = np.abs(sdf) <= self.truncation
        taken = (sdf > self.truncation) | (near & mask[v, u])
        shape = self.distance.shape
        w = taken.reshape(shape).astype(float)
        step = np.where(taken, np.clip(sdf, -self.truncation, self.truncation), 0).reshape(shape)
        weight = self.weight + w
        return replace(
            self,
            distance=(self.distance * self.weight + step * w) / weight,
            weight=weight,
            hits=self.hits + (near & mask[v, u]).reshape(shape),
            other_hits=self.other_hits + (near & others[v, u]).reshape(shape),
        )

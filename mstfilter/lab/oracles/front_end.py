"""Oracles of the front end: true boundaries, masks and completion.

>>> boundary = TrueBoundary()                    # the boundary map, below an ordinary tree
>>> proposal = TrueMasks()                       # every sample is the true segmentation of the image
>>> completer = TrueCompletion()                 # the true voxels of what a mask shows

A mask that shows exactly one object is completed to all voxels of the object, including hidden voxels. In general, a
true voxel belongs to the mask that contains its pixel. The pixel of a voxel is the pixel nearest to the projection of
the voxel, among all pixels that show the object. So a mask of one part of an object is completed to that part, and a
mask of two objects to both objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mstfilter.lab.oracles.truth import Need, UsesTruth
from mstfilter.mst.completion import Completer, Completion, Extrude, SurfaceOnly, observed_box
from mstfilter.mst.segmentation import BoundaryModel, ColourDepthBoundary, ObjectRule, complete_segments
from mstfilter.scene import (
    Clip,
    Frame,
    ObjectView,
    VoxelGrid,
    content_key,
    memo,
    read_only,
    scaled_area,
    scaled_length,
)
from mstfilter.scoring import MIN_PIXELS
from mstfilter.smc import Population, Proposal

_REACH = 4.0  # distance to a true border up to which strength is kept, in pixels of an image of 640 px width


@dataclass(frozen=True)
class TrueMasks(UsesTruth, Proposal):
    """Identical hypotheses from the true masks of the clip's last frame.

    The method `foreground` of `objects` determines which pixels can belong to an object. Completed voxels of
    probability `threshold` or more are occupied.
    """

    completer: Completer = field(default_factory=Extrude)
    objects: ObjectRule = field(default_factory=ObjectRule)
    threshold: float = 0.45

    properly_weighted: ClassVar[bool] = False
    needs: ClassVar[tuple[Need, ...]] = ("voxels", "instance")

    def masks(self, frame: Frame, clip: Clip) -> np.ndarray:
        """(H, W) int32 true object of each pixel of the clip's last frame; 0 for objects with too few pixels."""
        image = self.truth.instance(clip.index)
        counts = np.bincount(image.ravel())
        enough = counts >= scaled_area(MIN_PIXELS, image.size)
        enough[0] = False
        return np.where(enough[image] & self.objects.foreground(frame, clip.grid).pixels, image, 0).astype(np.int32)

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        """`n` copies of one hypothesis about the scene at the end of the clip."""
        true = self.masks(observation.after, observation)
        shown = np.unique(true[true > 0]).astype(np.int64)
        particles, counts = complete_segments(
            rng, observation, [shown] * n, lambda segment: true == segment, self.completer, self.threshold
        )
        return Population(particles, notes={"objects": counts["objects"]})


@dataclass(frozen=True)
class TrueBoundary(UsesTruth, BoundaryModel):
    """The measured border strength near true borders between objects in the image, and 0 elsewhere.

    The model `measured` gives the strength, because segmentation trees are fitted to measured strengths.
    """

    measured: BoundaryModel = field(default_factory=ColourDepthBoundary)

    needs: ClassVar[tuple[Need, ...]] = ("voxels", "instance")

    def boundary(self, frame: Frame) -> np.ndarray:
        """Boundary map (H, W) float32 of a frame at a pause."""
        import cv2

        image = self.truth.instance(self.truth.pause_of(frame))
        if frame.robot_mask is not None:
            image = np.where(frame.robot_mask, -1, image)
        edge = np.zeros(image.shape, np.uint8)  # 1 on both sides of a border
        across, down = image[:, 1:] != image[:, :-1], image[1:] != image[:-1]
        edge[:, 1:][across] = edge[:, :-1][across] = 1
        edge[1:][down] = edge[:-1][down] = 1
        size = 2 * max(1, round(scaled_length(_REACH, frame.camera.width))) + 1
        near = cv2.dilate(edge, np.ones((size, size), np.uint8)) > 0
        return np.where(near, self.measured.boundary(frame), 0).astype(np.float32)


_STRAY = 0.1  # an object with a smaller share of a mask is not shown by it
_WHOLE = 0.75  # share of the pixels of an object in a mask that shows all of it


@dataclass(frozen=True)
class TrueCompletion(UsesTruth, SurfaceOnly):
    """The true voxels of the objects that a mask shows. A mask without true objects gives its visible surface.

    `objects` determines which pixels can belong to an object. True voxels are assigned to pixels of their object. A
    mask with at least 75 % of an object's pixels gets all voxels of the object. An object is ignored if it covers
    less than 10 % of a mask and the mask covers less than half of the object.
    """

    objects: ObjectRule = ObjectRule()  # noqa: RUF009 (frozen)

    needs: ClassVar[tuple[Need, ...]] = ("voxels", "instance")

    def complete_each(
        self,
        rngs: Sequence[np.random.Generator],
        frame: Frame,
        masks: Sequence[np.ndarray],
        grid: VoxelGrid,
        views: Sequence[tuple[ObjectView, ...]] | None = None,
    ) -> list[Completion]:
        """The completions of several masks of a frame at a pause. `views` are not used."""
        t = self.truth.pause_of(frame)
        owner = np.where(self.objects.foreground(frame, grid).pixels, self.truth.instance(t), 0).ravel()
        voxels, pixel = memo(
            "true_pixels", (frame.key, grid.key, self.bound_key), lambda: self._pixels(frame, grid, t)
        )
        return [
            self._true(rng, frame, np.asarray(mask, bool), grid, voxels, pixel, owner)
            for rng, mask in zip(rngs, masks, strict=True)
        ]

    def _true(
        self,
        rng: np.random.Generator,
        frame: Frame,
        mask: np.ndarray,
        grid: VoxelGrid,
        voxels: np.ndarray,
        pixel: np.ndarray,
        owner: np.ndarray,
    ) -> Completion:
        shown = np.bincount(owner[mask.ravel()], minlength=int(owner.max(initial=0)) + 1)
        shown[0] = 0
        of_object = shown / np.maximum(np.bincount(owner, minlength=len(shown)), 1)
        stray = (shown < _STRAY * shown.sum()) & (of_object < 0.5)
        of_voxel = owner[pixel]
        inside = mask.ravel()[pixel] & ~stray[of_voxel]
        filled = voxels[inside | (of_object[of_voxel] >= _WHOLE)]
        if not len(filled):
            return super().complete_each([rng], frame, [mask], grid)[0]
        offset, seen = observed_box(frame, mask, grid, self)
        low, high = filled.min(axis=0), filled.max(axis=0) + 1
        if seen.points.size:
            low, high = np.minimum(low, offset), np.maximum(high, offset + seen.points.shape)
        shape = tuple((high - low).tolist())
        probability, points = np.zeros(shape, np.float32), np.zeros(shape, np.int32)
        probability[tuple((filled - low).T)] = 1
        if seen.points.size:
            box = tuple(slice(a, a + n) for a, n in zip((offset - low).tolist(), seen.points.shape, strict=True))
            points[box] = seen.points
        name = content_key("true", np.packbits(mask), frame.key, grid.key)
        return Completion(read_only(low), read_only(probability), read_only(points), name.hex()[:16])

    def _pixels(self, frame: Frame, grid: VoxelGrid, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Voxels (n, 3) of all objects that the frame shows, and the flat pixel (n,) of each voxel."""
        from scipy.spatial import cKDTree

        labels, image = self.truth.labels(t), self.truth.instance(t)
        object_pixels = self.objects.foreground(frame, grid).pixels
        found, pixels = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
        for k in np.unique(labels):
            shown = image == k
            if k == 0 or not shown.any():
                continue
            usable = shown & object_pixels
            v, u = np.nonzero(usable if usable.any() else shown)
            index = np.argwhere(labels == k)
            uv, _ = frame.camera.project(grid.centre_of(index))
            _, nearest = cKDTree(np.stack([u, v], axis=1)).query(uv)
            found.append(index)
            pixels.append(v[nearest] * image.shape[1] + u[nearest])
        return read_only(np.concatenate(found)), read_only(np.concatenate(pixels))

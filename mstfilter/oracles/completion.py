"""Completion by the truth: what lies behind a mask's pixels.

>>> completer = TrueCompletion()

A mask that shows exactly one object gets all of that object's voxels, the hidden ones included. In general a true
voxel belongs to the mask that holds the pixel, of all that show its object, at which it is seen or which is nearest
in the image to where it would be; so parts of an object get their part of it, and a mask over two objects gets both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mstfilter.completion import Completer, Completion, Evidence, evidence
from mstfilter.oracles.truth import Need, UsesTruth
from mstfilter.scene import Frame, VoxelGrid, content_key, memo, read_only
from mstfilter.segmentation import ObjectRule

__all__ = ["TrueCompletion"]


@dataclass(frozen=True)
class TrueCompletion(UsesTruth, Completer):
    """True voxels of what a mask shows. A mask that shows no true object keeps its visible surface.

    Parameters
    ----------
    objects : ObjectRule
        Which pixels can belong to an object: masks hold no others, so voxels are given to these.
    """

    objects: ObjectRule = ObjectRule()  # noqa: RUF009 (frozen)

    needs: ClassVar[tuple[Need, ...]] = ("voxels", "instance")

    def fill(self, rng: np.random.Generator, seen: Evidence) -> np.ndarray:
        """1 on the visible surface: what is left to do where the mask shows no true object."""
        return seen.own.astype(np.float32)

    def complete(
        self, rng: np.random.Generator, frame: Frame, masks: Sequence[np.ndarray], grid: VoxelGrid
    ) -> list[Completion]:
        """Complete several masks of a frame at a pause."""
        t = self.truth.pause_of(frame)
        voxels, pixel = memo(
            "true_pixels",
            (frame.key, grid.key, self.bound_key),
            lambda: self._pixels(frame, grid, t),
        )
        return [self._true(rng, frame, np.asarray(mask, bool), grid, voxels, pixel) for mask in masks]

    def _true(
        self,
        rng: np.random.Generator,
        frame: Frame,
        mask: np.ndarray,
        grid: VoxelGrid,
        voxels: np.ndarray,
        pixel: np.ndarray,
    ) -> Completion:
        mine = voxels[mask.ravel()[pixel]]
        if not len(mine):
            return super().complete(rng, frame, [mask], grid)[0]
        offset, seen = evidence(frame, mask, grid, self)
        low, high = mine.min(axis=0), mine.max(axis=0) + 1
        if seen.points.size:
            low, high = np.minimum(low, offset), np.maximum(high, offset + seen.points.shape)
        shape = tuple((high - low).tolist())
        probability, points = np.zeros(shape, np.float32), np.zeros(shape, np.int32)
        probability[tuple((mine - low).T)] = 1
        if seen.points.size:
            box = tuple(slice(a, a + n) for a, n in zip((offset - low).tolist(), seen.points.shape, strict=True))
            points[box] = seen.points
        name = content_key("true", np.packbits(mask), frame.key, grid.key)
        return Completion(read_only(low), read_only(probability), read_only(points), name.hex()[:16])

    def _pixels(self, frame: Frame, grid: VoxelGrid, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Voxels (n, 3) of all objects that the frame shows, and the flat pixel (n,) that each belongs to."""
        from scipy.spatial import cKDTree

        labels, image = self.truth.labels(t), self.truth.instance(t)
        own = self.objects.object_pixels(frame, grid)
        found, pixels = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
        for k in np.unique(labels):
            shown = image == k
            if k == 0 or not shown.any():
                continue
            usable = shown & own
            v, u = np.nonzero(usable if usable.any() else shown)
            index = np.argwhere(labels == k)
            uv, _ = frame.camera.project(grid.centre_of(index))
            _, nearest = cKDTree(np.stack([u, v], axis=1)).query(uv)
            found.append(index)
            pixels.append(v[nearest] * image.shape[1] + u[nearest])
        return read_only(np.concatenate(found)), read_only(np.concatenate(pixels))

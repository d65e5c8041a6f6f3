"""Tracked segments: the visible part of each object, the data about its motion, and the test for objects at rest.

Hypotheses share most of their objects, so there are far fewer distinct segments than hypotheses times objects, and
each is tracked once. The key by which they are told apart is the hash of the projected mask and of the voxels.

>>> segments = segments_of(hypothesis, clip.before)                       # doctest: +SKIP
>>> track = Track(segments[label], clip, DenseFlow().track(clip))         # doctest: +SKIP
>>> StaticTest().rests(track)                                             # doctest: +SKIP

A `Track` is what a motion rule works on: a segment, with the flow and the features of the clip.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mstfilter.base.results import Checked, check_array, check_list, returns
from mstfilter.mst.tracking.features import SiftMatching, matched_colour, smooth_colour
from mstfilter.mst.tracking.flow import ClipTracks
from mstfilter.mst.tracking.registration import Surface, prepare
from mstfilter.scene import Clip, Frame, Hypothesis, content_key, read_only, render_hypothesis, scaled_length

_TABLE_HEIGHT = 0.004  # metres; lower points belong to the table
_LEAST_INTERIOR = 60  # pixels off the rim, in an image of any size, that determine a motion without the rim
_MATCH_REACH = 5  # pixels of an image of 640 columns between a match and the mask in which it ends
_MAX_CHANGED = 0.03  # largest fraction of changed pixels, among the comparable ones, of an object at rest
_MIN_COMPARED = 0.3  # smallest fraction of comparable pixels of an object at rest
_OCCLUDED_MARGIN = 0.015  # metres; a pixel whose depth decreased by more is occluded and not comparable


@dataclass(frozen=True, eq=False)
class Segment:
    """The visible part of one object."""

    key: bytes  #: hash of the content; equal keys are the same tracking problem
    pixels: np.ndarray  #: (M,) int64, sorted flat pixels of the projected mask
    #: (S,) int64, sorted flat pixels of the mask whose measured depth agrees with the object. The mask of a voxel
    #: object extends slightly beyond the object itself.
    support: np.ndarray


def segments_of(hypothesis: Hypothesis, frame: Frame) -> dict[int, Segment]:
    """The segments of a hypothesis in a frame, by label. Hidden objects have no segment.

    `Segment.support` has the pixels above the table where measured and rendered depth differ by less than two voxels.
    """
    labels, depth = render_hypothesis(hypothesis, frame.camera)
    with np.errstate(invalid="ignore"):
        agrees = np.abs(frame.depth - depth) < 2.0 * hypothesis.grid.voxel_size
        agrees &= frame.points[..., 2] > _TABLE_HEIGHT
    agrees &= frame.valid
    # Pixels on the rim of a mask mix depth and colour with the background.
    interior = _interior(labels)
    voxels = _indices_by_label(hypothesis.labels)
    out = {}
    for label, pixels in _indices_by_label(labels).items():
        support = pixels[agrees.ravel()[pixels]]
        inner = support[interior.ravel()[support]]
        support = inner if len(inner) >= _LEAST_INTERIOR else support
        out[label] = Segment(content_key(pixels, content_key(voxels[label])), pixels, support)
    return out


def _interior(labels: np.ndarray) -> np.ndarray:
    """Pixels with the same label as their four neighbours."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    padded = np.pad(labels, 1)
    return (cv2.erode(padded, cross) == cv2.dilate(padded, cross))[1:-1, 1:-1]


def _indices_by_label(labels: np.ndarray) -> dict[int, np.ndarray]:
    """Ascending flat indices of each non-zero label of an array."""
    flat = labels.ravel()
    index = np.flatnonzero(flat)
    index = index[np.argsort(flat[index], kind="stable")]
    parts = np.split(index, np.flatnonzero(np.diff(flat[index].astype(np.int64))) + 1)
    return {int(flat[part[0]]): part for part in parts if len(part)}


@dataclass(frozen=True, eq=False)
class Track:
    """A segment with the flow and the features of a clip."""

    segment: Segment
    clip: Clip
    flow: ClipTracks  #: the dense flow of the clip
    followed: np.ndarray | None = None  #: (H, W) bool, the support in the last frame according to a `MaskTracker`

    @cached_property
    def mask(self) -> np.ndarray:
        """The support in the first frame, (H, W) bool."""
        image = np.zeros(self.clip.before.depth.shape, bool)
        image.ravel()[self.segment.support] = True
        return read_only(image)

    @cached_property
    def target_mask(self) -> np.ndarray:
        """The support in the last frame (H, W) bool, from the mask tracker or else from the flow."""
        if self.followed is not None:
            return self.followed & self.clip.after.valid
        return self.flow.warp(self.mask.astype(np.uint8)) > 0

    @cached_property
    def points(self) -> np.ndarray:
        """World points of the support in the first frame, (S, 3) metres."""
        return read_only(self.clip.before.points.reshape(-1, 3)[self.segment.support])

    @cached_property
    def surface(self) -> Surface | None:
        """The visible surface in the first frame; None if it has too few points."""
        return prepare(self.points)

    @cached_property
    def near(self) -> cKDTree:
        """Search tree of the points of `surface`; empty if there is no surface."""
        return cKDTree(np.empty((0, 3)) if self.surface is None else self.surface.points)

    @cached_property
    def target_surface(self) -> Surface | None:
        """The surface of the target mask in the last frame, above the table; None if it has too few points."""
        after = self.clip.after
        with np.errstate(invalid="ignore"):
            pixels = self.target_mask & after.valid & (after.points[..., 2] > _TABLE_HEIGHT)
        return prepare(after.points[pixels])

    @cached_property
    def flow_pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """World points (K, 3) in the first and last frame of the points that the flow followed to the end."""
        before, after = self.clip.before, self.clip.after
        chosen = self.flow.points_in(self.mask)
        u, v = self.flow.start[chosen].T
        end_u, end_v = np.rint(self.flow.end[chosen]).astype(np.int64).T
        q = after.points[end_v, end_u]
        keep = after.valid[end_v, end_u] & (q[:, 2] > _TABLE_HEIGHT)
        return read_only(before.points[v, u][keep]), read_only(q[keep])

    def sift_pairs(self, sift: SiftMatching, in_target: bool) -> tuple[np.ndarray, np.ndarray]:
        """World points of SIFT matches that start in the mask and, with `in_target`, end near the target mask."""
        last = None
        if in_target:
            side = 2 * max(1, round(scaled_length(_MATCH_REACH, self.mask.shape[1]))) + 1
            last = cv2.dilate(self.target_mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        matches = sift.match(self.clip.before, self.clip.after)
        chosen = matches.within(self.mask, last)
        return matches.p[chosen], matches.q[chosen]

    def sample(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """At most n points of the support, evenly spaced, and their slightly blurred colours, both (n, 3)."""
        pixels = self.sampled(n)
        colours = smooth_colour(self.clip.before, 5).reshape(-1, 3)[pixels]
        return self.clip.before.points.reshape(-1, 3)[pixels], colours.astype(np.float64)

    def sampled(self, n: int) -> np.ndarray:
        """Flat pixels, in the first frame, of the points that `sample` returns."""
        last = len(self.segment.support) - 1
        return self.segment.support[np.unique(np.linspace(0, last, n if last >= 0 else 0).astype(np.int64))]

    @property
    def colour_after(self) -> np.ndarray:
        """Slightly blurred colour (H, W, 3) of the last frame in the exposure of the first."""
        return matched_colour(self.clip.after, self.clip.before, 5)


def _check_masks(
    self: MaskTracker, found: Sequence[np.ndarray], clip: Clip, masks: Sequence[np.ndarray]
) -> list[np.ndarray]:
    shape = clip.after.depth.shape
    return [check_array(mask, shape, "b") for mask in check_list(found, len(masks), object, "masks")]


class MaskTracker(Checked, ABC):
    """Follows masks through a clip."""

    @returns(_check_masks)
    @abstractmethod
    def track(self, clip: Clip, masks: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Masks (H, W) bool of the last frame, one for each of the masks (H, W) bool of the first frame.

        An empty mask means that the object is lost. Masks may overlap, but a result should not depend on the others.
        """


@dataclass(frozen=True)
class StaticTest:
    """Tests whether an object was at rest. Objects that pass this test keep their voxels exactly.

    Tracking damages objects at rest: labels leak between touching objects that look the same, and the registration of
    symmetric objects drifts. So objects whose pixels are unchanged are not tracked. If `enabled` is False, every
    object is tracked, as published.
    """

    enabled: bool = True

    def rests(self, track: Track) -> bool:
        """Whether the visible part of the object is unchanged."""
        if not self.enabled:
            return False
        support = track.segment.support
        before, after = track.clip.before, track.clip.after
        with np.errstate(invalid="ignore"):
            nearer = before.depth.ravel()[support] - after.depth.ravel()[support] > _OCCLUDED_MARGIN
        compared = after.valid.ravel()[support] & ~nearer
        n = int(compared.sum())
        if n < max(1.0, _MIN_COMPARED * len(support)):
            return False
        changed = compared & ~track.flow.coherently_unchanged.ravel()[support]
        return bool(changed.sum() <= _MAX_CHANGED * n)

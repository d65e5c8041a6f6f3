"""All the evidence about one segment's motion, gathered when it is asked for.

A `Track` joins the segment with the clip's shared flow and features. Motion rules look at nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mstfilter.scene import Clip
from mstfilter.tracking.features import SiftMatching
from mstfilter.tracking.flow import ClipTracks
from mstfilter.tracking.photometry import matched_colour, smooth_colour
from mstfilter.tracking.registration import Surface, prepare
from mstfilter.tracking.segments import Segment

__all__ = ["Track"]

Array = NDArray[np.float64]

FLOOR = 0.004  # metres: lower points are the table


@dataclass(frozen=True, eq=False)
class Track:
    """A segment in a clip.

    Attributes
    ----------
    segment : Segment
    clip : Clip
    flow : ClipTracks, what was followed through the clip.
    """

    segment: Segment
    clip: Clip
    flow: ClipTracks

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """(H, W) the supported pixels in the first frame."""
        return self._image(self.segment.support)

    @cached_property
    def target_mask(self) -> NDArray[np.bool_]:
        """(H, W) where flow carries them in the last frame."""
        return self.flow.warp(self.mask.astype(np.uint8)) > 0

    @cached_property
    def points(self) -> Array:
        """(S, 3) world points of the supported pixels."""
        return self.clip.before.points.reshape(-1, 3)[self.segment.support]

    @cached_property
    def target_points(self) -> Array:
        """(R, 3) world points under the target mask in the last frame, above the table."""
        after = self.clip.after
        points = after.points[self.target_mask & after.valid]
        return points[points[:, 2] > FLOOR]

    @cached_property
    def surface(self) -> Surface | None:
        """The visible surface before, ready for registration."""
        return prepare(self.points)

    @cached_property
    def target_surface(self) -> Surface | None:
        """The surface under the target mask, ready for registration."""
        return prepare(self.target_points)

    @cached_property
    def flow_pairs(self) -> tuple[Array, Array]:
        """World points (K, 3) before and after of the points that flow followed to the end."""
        before, after = self.clip.before, self.clip.after
        chosen = self.flow.points_in(self.mask)
        u, v = self.flow.start[chosen].T
        end_u, end_v = np.rint(self.flow.end[chosen]).astype(np.int64).T
        q = after.points[end_v, end_u]
        keep = after.valid[end_v, end_u] & (q[:, 2] > FLOOR)
        return before.points[v, u][keep], q[keep]

    def sift_pairs(self, sift: SiftMatching, in_target: bool) -> tuple[Array, Array]:
        """World points of SIFT matches that start in the mask (and end in the target mask, 5 px wider)."""
        import cv2

        last = None
        if in_target:
            last = cv2.dilate(self.target_mask.astype(np.uint8), np.ones((11, 11), np.uint8)) > 0
        matches = sift.match(self.clip.before, self.clip.after)
        chosen = matches.within(self.mask, last)
        return matches.p[chosen], matches.q[chosen]

    def sample(self, n: int) -> tuple[Array, Array]:
        """At most n supported points, evenly spread, and their slightly blurred colours, (n, 3) each."""
        chosen = np.unique(np.linspace(0, len(self.segment.support) - 1, n).astype(np.int64))
        chosen = chosen[chosen >= 0]
        colours = smooth_colour(self.clip.before, 5).reshape(-1, 3)[self.segment.support[chosen]]
        return self.points[chosen], colours.astype(np.float64)

    @property
    def colour_after(self) -> NDArray[np.float32]:
        """Slightly blurred colour of the last frame in the exposure of the first, (H, W, 3)."""
        return matched_colour(self.clip.after, self.clip.before, 5)

    def _image(self, pixels: NDArray[np.int64]) -> NDArray[np.bool_]:
        image = np.zeros(self.clip.before.depth.shape, bool)
        image.ravel()[pixels] = True
        return image

"""Colours and features of the frames of a clip: exposure matching and SIFT matches.

>>> matches = SiftMatching().match(clip.before, clip.after)     # doctest: +SKIP
>>> matches.p, matches.q                                        # doctest: +SKIP

Features are detected once, in the whole image, and shared by all hypotheses and segments.

When something moves, automatic exposure and white balance change the colour of everything: in real clips, most of an
untouched table differs by more than 12 grey levels. `matched_colour` removes this change by a gain and an offset for
each channel, fitted where the depth is unchanged.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import cv2
import numpy as np

from mstfilter.base.fields import Bounded, PositiveFloat
from mstfilter.scene import Frame, depth_sigma, memo, scaled_area

_DEPTH_SIGMAS = 4.0  # limit of the difference of two readings, in its standard deviations
_LEAST_STILL = 500  # pixels of an image of 640 x 480 with the same depth that determine the exposure
_N_EXPOSURE_PIXELS = 20000
_MAX_PAIRS = 20000  # matches with the smallest descriptor distances are kept
_PRIOR_VARIANCE = 20.0**2  # grey levels squared; where colours vary less, the gain stays near 1


def same_depth(first: Frame, other: Frame) -> np.ndarray:
    """(H, W) bool: pixels with readings that agree in both frames up to the sensor noise; False on the robot."""
    limit = _DEPTH_SIGMAS * np.sqrt(2.0) * depth_sigma(first.depth)
    with np.errstate(invalid="ignore"):
        return (np.abs(other.depth - first.depth) <= limit) & first.valid & other.valid


def smooth_colour(frame: Frame, width: int = 3) -> np.ndarray:
    """Colour (H, W, 3) blurred over ``width`` pixels, to reduce the effect of shifts by less than a pixel."""
    return memo(
        "smooth colour", (frame.key, width), lambda: cv2.GaussianBlur(frame.rgb, (width, width), 0).astype(np.float32)
    )


def matched_colour(frame: Frame, reference: Frame, width: int = 3) -> np.ndarray:
    """Smooth colour (H, W, 3) of a frame, converted to the exposure of the reference. Cached by content."""

    def compute() -> np.ndarray:
        gain, offset = _exposure(frame, reference)
        return smooth_colour(frame, width) * gain + offset

    return memo("matched colour", (frame.key, reference.key, width), compute)


def _exposure(frame: Frame, reference: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Gain (3,) and offset (3,) that map colours of the frame to those of the reference."""
    still = np.flatnonzero(same_depth(reference, frame))
    if len(still) < scaled_area(_LEAST_STILL, frame.depth.size):  # without depth: most of the image may be still
        still = np.arange(frame.depth.size)
    still = still[:: max(1, len(still) // _N_EXPOSURE_PIXELS)]
    x_all = smooth_colour(frame).reshape(-1, 3)[still].astype(np.float64)
    y_all = smooth_colour(reference).reshape(-1, 3)[still].astype(np.float64)
    inside = ((x_all > 3) & (x_all < 252) & (y_all > 3) & (y_all < 252)).all(axis=1)  # not saturated
    x_all, y_all = x_all[inside], y_all[inside]
    gain, offset = np.ones(3), np.zeros(3)
    if len(x_all) < 100:
        return gain.astype(np.float32), offset.astype(np.float32)
    for c in range(3):
        x, y = x_all[:, c], y_all[:, c]
        g, o = 1.0, float(np.median(y - x))
        for _ in range(5):
            error = np.abs(y - (g * x + o))
            keep = error <= max(2.5 * float(np.median(error)), 1.0)
            mx, my = x[keep].mean(), y[keep].mean()
            before = g, o
            g = (((x[keep] - mx) * (y[keep] - my)).mean() + _PRIOR_VARIANCE) / (x[keep].var() + _PRIOR_VARIANCE)
            o = my - g * mx
            if (g, o) == before:
                break
        if 0.4 < g < 2.5:
            gain[c], offset[c] = g, o
    return gain.astype(np.float32), offset.astype(np.float32)


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of matching features."""

    before: np.ndarray  #: (N, 2) int32 pixels (column, row) in the first and last frame
    after: np.ndarray
    p: np.ndarray  #: (N, 3) float64 world points of these pixels, metres
    q: np.ndarray

    def within(self, first: np.ndarray, last: np.ndarray | None = None) -> np.ndarray:
        """Indices of the pairs that start inside the mask ``first`` (H, W) and end inside ``last``, if given."""
        keep = first[self.before[:, 1], self.before[:, 0]]
        if last is not None:
            keep = keep & last[self.after[:, 1], self.after[:, 0]]
        return np.flatnonzero(keep)


@dataclass(frozen=True)
class SiftMatching(Bounded):
    """Matches SIFT features of two frames (Lowe, IJCV 2004; OpenCV's defaults).

    Parameters
    ----------
    mutual : bool
        If True, keep a pair only if each feature is the best match of the other and passes the ratio test (`ratio`).
        If False, keep every pair within the three radii below, as the authors' program does. A later clustering
        rejects wrong pairs.
    ratio : float
        Largest ratio of the best to the second best descriptor distance. Used if `mutual`.
    descriptor_radius : float
        Largest descriptor distance (SIFT descriptors have length 512).
    search_share : float
        Search radius in the image, as a fraction of its width.
    search_distance : float
        Search radius in space, metres.
    """

    mutual: bool = True
    ratio: float = 0.85
    descriptor_radius: PositiveFloat = 250.0
    search_share: PositiveFloat = 0.35
    search_distance: PositiveFloat = 0.40

    def match(self, before: Frame, after: Frame) -> Matches:
        """Matches of two frames. Cached by content."""
        key = (before.key, after.key, astuple(self))
        return memo("sift matches", key, lambda: _match(before, after, self), shared=True)


def _features(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and descriptors (N, 128) of features that have a depth reading and are not on the robot."""

    def compute() -> tuple[np.ndarray, np.ndarray]:
        grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        keypoints, descriptors = cv2.SIFT_create().detectAndCompute(grey, None)  # type: ignore[attr-defined]
        if descriptors is None:
            return np.empty((0, 2), np.int32), np.empty((0, 128), np.float32)
        height, width = frame.depth.shape
        pixel = np.rint([k.pt for k in keypoints]).astype(np.int32)
        pixel = np.clip(pixel, 0, [width - 1, height - 1]).astype(np.int32)
        keep = frame.valid[pixel[:, 1], pixel[:, 0]]
        return pixel[keep], descriptors[keep]

    return memo("sift features", (frame.key,), compute)


def _match(before: Frame, after: Frame, settings: SiftMatching) -> Matches:
    (pixel_a, words_a), (pixel_b, words_b) = _features(before), _features(after)
    if len(pixel_a) < 2 or len(pixel_b) < 2:
        i = j = np.empty(0, np.int64)
    else:
        squared = (words_a**2).sum(1)[:, None] + (words_b**2).sum(1)[None] - 2.0 * words_a @ words_b.T
        distance = np.sqrt(np.maximum(squared, 0.0))
        points_a = before.points[pixel_a[:, 1], pixel_a[:, 0]].astype(np.float32)
        points_b = after.points[pixel_b[:, 1], pixel_b[:, 0]].astype(np.float32)
        reach = settings.search_share * before.depth.shape[1]
        distance[_far(pixel_a.astype(np.float32), pixel_b.astype(np.float32), reach)] = np.inf
        distance[_far(points_a, points_b, settings.search_distance)] = np.inf
        distance[distance > settings.descriptor_radius] = np.inf
        i, j = _mutual(distance, settings.ratio) if settings.mutual else np.nonzero(np.isfinite(distance))
        if len(i) > _MAX_PAIRS:
            best = np.sort(np.argsort(distance[i, j], kind="stable")[:_MAX_PAIRS])
            i, j = i[best], j[best]
        if settings.mutual:
            # SIFT returns a point once per dominant orientation; keep its best match only.
            order = np.argsort(distance[i, j], kind="stable")
            _, first = np.unique(pixel_a[i[order]], axis=0, return_index=True)
            chosen = np.sort(order[first])
            i, j = i[chosen], j[chosen]
    a, b = pixel_a[i], pixel_b[j]
    return Matches(a, b, before.points[a[:, 1], a[:, 0]], after.points[b[:, 1], b[:, 0]])


def _far(a: np.ndarray, b: np.ndarray, reach: float) -> np.ndarray:
    """Whether points a (N, d) and b (M, d) are farther apart than reach, (N, M) bool."""
    squared = np.zeros((len(a), len(b)), np.float32)
    for axis in range(a.shape[1]):
        squared += (a[:, axis, None] - b[None, :, axis]) ** 2
    return squared > reach**2


def _mutual(distance: np.ndarray, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs that are mutual best matches and pass the ratio test against the second best match of the row."""
    j = distance.argmin(axis=1)
    i = np.arange(len(j))
    best = distance[i, j]
    second = np.partition(distance, 1, axis=1)[:, 1]
    # An infinite best means no match in reach. An infinite second best always passes.
    with np.errstate(invalid="ignore"):
        keep = np.isfinite(best) & (best <= ratio * second) & (distance.argmin(axis=0)[j] == i)
    return i[keep], j[keep]

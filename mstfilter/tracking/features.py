"""SIFT matches between the first and last frame of a clip, lifted to space.

Features are found once in the whole image, not once per segment, and shared by all hypotheses.

>>> matches = SiftMatching().match(clip.before, clip.after)     # doctest: +SKIP
>>> matches.p, matches.q                                        # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from mstfilter.errors import InputError
from mstfilter.scene import Frame, memo

__all__ = ["Matches", "SiftMatching"]


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of features that look alike.

    Attributes
    ----------
    before, after : (N, 2) int32 pixels (column, row) in the first and last frame.
    p, q : (N, 3) float64 world points there, metres.
    """

    before: NDArray[np.int32]
    after: NDArray[np.int32]
    p: NDArray[np.float64]
    q: NDArray[np.float64]

    def within(self, first: NDArray[np.bool_], last: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        """Indices of the pairs that start inside mask ``first`` and, if given, end inside ``last`` (H, W)."""
        keep = first[self.before[:, 1], self.before[:, 0]]
        if last is not None:
            keep = keep & last[self.after[:, 1], self.after[:, 0]]
        return np.flatnonzero(keep)


@dataclass(frozen=True)
class SiftMatching:
    """Which SIFT features of two frames are taken for the same point (Lowe, IJCV 2004; OpenCV's defaults).

    Parameters
    ----------
    mutual : bool
        Keep a pair only if each is the other's best within reach, and clearly (`ratio`). False: every pair
        within all three radii, one to many, as the authors' code does; clustering has to sort them out.
    ratio : float
        Best descriptor distance over second best, within reach; larger is ambiguous. Used if `mutual`.
    descriptor_radius : float
        Largest descriptor distance (SIFT descriptors have length 512).
    search_share : float
        Reach in the image as a share of its width.
    search_distance : float
        Reach in space, metres.
    max_pairs : int
        Beyond this only the most alike pairs are kept (one-to-many matching can give very many).
    """

    mutual: bool = True
    ratio: float = 0.85
    descriptor_radius: float = 250.0
    search_share: float = 0.35
    search_distance: float = 0.40
    max_pairs: int = 20000

    def __post_init__(self) -> None:
        if self.descriptor_radius <= 0 or self.search_share <= 0 or self.search_distance <= 0:
            raise InputError(
                f"SIFT radii must be positive: descriptor {self.descriptor_radius}, "
                f"image {self.search_share}, space {self.search_distance}"
            )

    def match(self, before: Frame, after: Frame) -> Matches:
        """Pairs between two frames. Memoised by content."""
        key = (before.key, after.key, astuple(self))
        return memo("sift matches", key, lambda: _match(before, after, self), stored_as=Matches)


def _features(frame: Frame) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Pixels (N, 2) and descriptors (N, 128) of the features with a depth reading off the robot."""

    def compute() -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        import cv2

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
        if len(i) > settings.max_pairs:
            best = np.sort(np.argsort(distance[i, j], kind="stable")[: settings.max_pairs])
            i, j = i[best], j[best]
        if settings.mutual:
            # SIFT lists a point once for every strong orientation: one point is one inlier.
            order = np.argsort(distance[i, j], kind="stable")
            _, first = np.unique(pixel_a[i[order]], axis=0, return_index=True)
            chosen = np.sort(order[first])
            i, j = i[chosen], j[chosen]
    a, b = pixel_a[i], pixel_b[j]
    return Matches(a, b, before.points[a[:, 1], a[:, 0]], after.points[b[:, 1], b[:, 0]])


def _far(a: NDArray[np.float32], b: NDArray[np.float32], reach: float) -> NDArray[np.bool_]:
    """(N, M) bool: farther apart than reach."""
    squared = np.zeros((len(a), len(b)), np.float32)
    for axis in range(a.shape[1]):
        squared += (a[:, axis, None] - b[None, :, axis]) ** 2
    return squared > reach**2


def _mutual(distance: NDArray[np.float32], ratio: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs that are each other's best and clearly better than the row's second best."""
    j = distance.argmin(axis=1)
    i = np.arange(len(j))
    best = distance[i, j]
    second = np.partition(distance, 1, axis=1)[:, 1]
    # Where the best is infinite nothing is within reach; a lone match in reach has no rival.
    with np.errstate(invalid="ignore"):
        keep = np.isfinite(best) & (best <= ratio * second) & (distance.argmin(axis=0)[j] == i)
    return i[keep], j[keep]

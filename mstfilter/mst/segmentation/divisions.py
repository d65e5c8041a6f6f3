"""Ways to divide a region of an image into two, and what can be measured of them.

Things that people put down stand beside each other or on each other, so two objects that touch are usually divided
by an upright or by a level plane. The plane need not be seen everywhere: where print or low contrast hides the
border, it still goes on. So the divisions of a region are

- *upright* and *level* planes through its readings along which there is more evidence of a border than beside them,
- the same planes at the middle and the thirds of the region, where a row of equal things would be divided,
- merges of a segmentation tree inside the region, which follow borders of any form.

>>> image = SeamImage.of(frame, boundary, seen)
>>> found = divisions(image, pixels, parts)       # of the region with these flat pixels; parts of a tree
>>> found[0].kind, found[0].side.mean()           # the kind, and the share of the pixels on the first side

The axes of the world are those of the table: z points up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy.special import expit

from mstfilter.mst.segmentation.regions import SeenBorders
from mstfilter.scene import Frame, posed_camera, scaled_area, scaled_length

KINDS = ("upright", "level", "tree")
_ANGLES = np.deg2rad(np.arange(0, 180, 5))  # of the normals of upright planes
_STEP = 0.003  # metres between planes
_MOST = {"upright": 6, "level": 3, "tree": 5, "middle": 4}  # divisions of each kind
_SAME = 0.9  # two divisions with a larger overlap (IoU of both sides) are the same
_LEAST_SHARE, _LEAST_PIXELS = 0.04, 150  # of a side; pixels of an image of 640 x 480
_MARGIN = 3  # pixels of an image 640 wide: evidence so close to the outline of a region is that of the outline
_MOST_POINTS = 2500  # readings that vote for planes
_UNKNOWN = -8.0  # log odds, and the largest size of them: a tree without a merge that resembles a division


class TreePart(NamedTuple):
    """A part of a region that a segmentation tree knows."""

    side: np.ndarray  #: (n,) bool, its pixels among those of the region
    odds: float  #: log odds of the merge that joins it to the rest: different objects against one


class Division(NamedTuple):
    """A region divided into two sides."""

    side: np.ndarray  #: (n,) bool, the pixels of the region that are on the first side
    kind: str  #: one of `KINDS`
    normal: np.ndarray  #: (3,) of the plane, in the world; zero for a division of the tree
    offset: float  #: of the plane along its normal, metres
    overlap: float  #: 0 .. 1, with the part of the tree that is most similar (IoU of both sides, the smaller one)
    odds: float  #: log odds of that part, -8 .. 8


@dataclass(frozen=True, eq=False)
class SeamImage:
    """What the measurements of divisions read; images are (H, W)."""

    frame: Frame
    points: np.ndarray  #: (H, W, 3) in the world, metres; NaN without a reading
    evidence: np.ndarray  #: 0 .. 1, evidence of a border between objects
    boundary: np.ndarray  #: 0 .. 1, of `BoundaryModel`
    seen: SeenBorders

    @classmethod
    def of(cls, frame: Frame, boundary: np.ndarray, seen: SeenBorders) -> SeamImage:
        """The images of a frame, its boundary map and the output of the border network."""
        evidence = (expit(seen.border.astype(np.float64)) + boundary) / 2
        points = posed_camera(frame).unproject(frame.depth)
        return cls(frame, points, evidence.astype(np.float32), boundary, seen)


def divisions(image: SeamImage, pixels: np.ndarray, parts: Sequence[TreePart] = ()) -> list[Division]:
    """The divisions of the region with the flat `pixels` (n,); see the module.

    `parts` are those of the region that a tree knows, in order of importance. Divisions that are nearly equal occur
    once; both sides of each have a sensible size.
    """
    points = image.points.reshape(-1, 3)[pixels]
    evidence = _inner_evidence(image, pixels)
    found = _Distinct(parts, len(pixels), _least(image, len(pixels)))
    for part in parts:
        if found.count("tree") < _MOST["tree"]:
            found.add(part.side, "tree", np.zeros(3), 0.0)
    read = np.isfinite(points[:, 2])
    if read.sum() > 20:
        known = points[read]
        some = np.linspace(0, len(known) - 1, min(len(known), _MOST_POINTS)).astype(int)
        axes = {
            "upright": np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(len(_ANGLES))]),
            "level": np.array([[0.0, 0.0, 1.0]]),
        }
        filled = np.where(read[:, None], points, known.mean(axis=0))
        for kind, normals in axes.items():
            for _, k, offset in _peaks(known[some], evidence[read][some], normals):
                if found.count(kind) >= _MOST[kind]:
                    break
                found.add(filled @ normals[k] < offset, kind, normals[k], offset)
        for normal, offset in _middles(known[some])[: _MOST["middle"]]:
            kind = "level" if normal[2] else "upright"
            found.add(filled @ normal < offset, kind, normal, offset)
    return found.divisions


def _least(image: SeamImage, n: int) -> float:
    return max(_LEAST_SHARE * n, scaled_area(_LEAST_PIXELS, image.evidence.size))


class _Distinct:
    """Divisions that differ from one another."""

    def __init__(self, parts: Sequence[TreePart], n: int, least: float) -> None:
        self.parts, self.n, self.least = parts, n, least
        self.divisions: list[Division] = []

    def count(self, kind: str) -> int:
        return sum(one.kind == kind for one in self.divisions)

    def add(self, side: np.ndarray, kind: str, normal: np.ndarray, offset: float) -> None:
        size = int(side.sum())
        if min(size, self.n - size) < self.least:
            return
        if any(division_overlap(side, other.side) > _SAME for other in self.divisions):
            return
        overlap, odds = 0.0, _UNKNOWN
        for part in self.parts:
            if (common := division_overlap(side, part.side)) > overlap:
                overlap, odds = common, part.odds
        self.divisions.append(
            Division(side, kind, normal, offset, overlap, float(np.clip(odds, _UNKNOWN, -_UNKNOWN)))
        )


def division_overlap(one: np.ndarray, other: np.ndarray) -> float:
    """How similar two divisions of a region are, given a side (n,) bool of each: 1 if they are the same."""
    common, a, b, n = int((one & other).sum()), int(one.sum()), int(other.sum()), len(one)
    return max(_overlap(common, a, b, n), _overlap(b - common, n - a, b, n))


def _overlap(common: int, a: int, b: int, n: int) -> float:
    """The smaller IoU of two sides and of their complements, from numbers of pixels."""
    union = a + b - common
    return min(common / max(union, 1), (n - union) / max(n - common, 1))


def _inner_evidence(image: SeamImage, pixels: np.ndarray) -> np.ndarray:
    """The evidence (n,) at the pixels of a region, without that near its outline."""
    h, w = image.evidence.shape
    mask = np.zeros((h, w), np.uint8)
    mask.ravel()[pixels] = 1
    margin = 2 * max(1, round(scaled_length(_MARGIN, w))) + 1
    inner = cv2.erode(mask, np.ones((margin, margin), np.uint8), borderValue=0)
    return np.asarray((image.evidence * inner).ravel()[pixels])


def _peaks(points: np.ndarray, evidence: np.ndarray, normals: np.ndarray) -> list[tuple[float, int, float]]:
    """Planes along which there is more evidence than beside them: (score, index of the normal, offset), best first.

    The score of a plane is the excess of the evidence at the points near it, in units of the standard deviation that
    the sum over as many points drawn at random has.
    """
    mean, spread = float(evidence.mean()), max(float(evidence.std()), 1e-3)
    found = []
    for k, normal in enumerate(normals):
        along = points @ normal
        low = float(along.min())
        at = ((along - low) / _STEP).astype(int)
        n = np.bincount(at, minlength=3).astype(float)
        total = np.bincount(at, evidence, minlength=3)
        n, total = (np.convolve(values, (0.5, 1.0, 0.5), "same") for values in (n, total))
        score = (total - mean * n) / (spread * np.sqrt(n + 5))
        padded = np.pad(score, 1, constant_values=-np.inf)
        peak = (score >= padded[:-2]) & (score > padded[2:]) & (score > 0)
        found += [(float(score[j]), k, low + (j + 0.5) * _STEP) for j in np.flatnonzero(peak)]
    return sorted(found, key=lambda one: -one[0])


def _middles(points: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Planes at the middle of the longer and the shorter side and of the height of the points, and at the thirds."""
    (_, _), _, turn = cv2.minAreaRect(points[:, :2].astype(np.float32))
    found, spans = [], []
    for angle in (turn, turn + 90):
        normal = np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle)), 0.0])
        low, high = np.percentile(points @ normal, (1, 99))
        spans.append((high - low, normal, low))
    spans.sort(key=lambda one: -one[0])
    for length, normal, low in spans:
        found.append((normal, float(low + length / 2)))
    low, high = np.percentile(points[:, 2], (1, 99))
    found.append((np.array([0.0, 0.0, 1.0]), float((low + high) / 2)))
    length, normal, low = spans[0]
    return found + [(normal, float(low + share * length)) for share in (1 / 3, 2 / 3)]

"""Scores of a hypothesis against what is known about a real image.

>>> image_scores(image, truth, frame, grid)      # quality, pieces, merged, missed, invented, found
>>> witness_scores(hypothesis, frame, witness)   # what a second camera says
>>> pixel_forecasts(belief, camera, labels)      # of "do these two pixels show one object?"
"""

from __future__ import annotations

from collections.abc import Sequence as Several
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter
from sequences import WALL, Truth

from mstfilter import Belief
from mstfilter.scene import Camera, Frame, Hypothesis, VoxelGrid, frame_geometry, scaled_area
from mstfilter.scoring import weighted_coverage
from mstfilter.scoring.forecasts import ForecastTable

PIECE = 0.1  # share of a true object's pixels that an object needs to be a piece of it
FOUND = 0.25  # share of a true object's pixels that objects must cover, else it is missed; likewise for invented ones
TALL = 0.04  # metres above the table
READABLE = 0.25  # share of an object's pixels that need a reading to count in `quality_readable`
# Metres: witness surface above the table, behind depth 1, before depth 2; distance of surface of the wall.
LEAST = 200  # pixels of an object that pairs of pixels are drawn from, in an image of 640 x 480
SOFTENING = 0.04  # of forecasts for pairs of pixels, as `ForecastTable.log_loss` has it: none is below .02
PAIRS = 12  # of pixels, for each object and each pair of objects that touch
_TOUCH = 5  # pixels: windows in which two objects touch
_SEEN, _BEHIND, _FRONT, _AT_WALL = 0.03, 0.02, 0.03, 0.03


def image_scores(image: np.ndarray, truth: Truth, frame: Frame, grid: VoxelGrid) -> dict[str, float]:
    """Scores of the projection (H, W) of a hypothesis. Pixels that are unknown or outside the workspace do not count.

    `quality` is the symmetric weighted coverage of objects, `quality_readable` that without true objects that have
    readings on fewer than a quarter of their pixels. `pieces` are further pieces of true objects, `merged` further
    true objects in an object; `missed` and `invented` are objects without a counterpart. `tall_missed` of
    `tall` counts true objects above 4 cm with readings on most of their pixels. `found` is the mean over true objects
    of the share of their pixels in the object that has most of them.
    """
    with np.errstate(invalid="ignore"):
        index = (frame.points[..., :2] - grid.origin[:2]) / (np.array(grid.shape[:2]) * grid.voxel_size)
        outside = ((index < 0) | (index >= 1)).any(axis=-1) & np.isfinite(frame.depth)
    known = (truth.labels >= 0) & ~outside
    found, labels = np.where(known, image, 0).astype(np.int64), np.where(known, truth.labels, 0)
    table = np.zeros((int(labels.max()) + 1, int(found.max()) + 1), np.int64)
    np.add.at(table, (labels[known], found[known]), 1)
    objects = np.flatnonzero(table.sum(axis=1))
    objects = objects[objects > 0]
    shares = table[:, 1:] / np.maximum(table.sum(axis=1, keepdims=True), 1)
    covered, main = shares.sum(axis=1), shares.argmax(axis=1) if shares.shape[1] else np.zeros(len(table), int)
    pieces = (shares[objects] >= PIECE).sum(axis=1)
    seen = [k for k in objects if covered[k] >= FOUND]
    readings = np.array([np.isfinite(frame.depth[labels == k]).mean() for k in objects])
    with np.errstate(invalid="ignore"):
        heights = np.array([np.percentile(z, 95) if len(z) else 0.0 for z in _heights(frame, labels, objects)])
    tall = (heights > TALL) & (readings > 0.5)
    sizes = table[:, 1:].sum(axis=0)
    unreadable = np.isin(labels, objects[readings < READABLE])
    return {
        "quality": weighted_coverage(found, labels),
        "quality_readable": weighted_coverage(np.where(unreadable, 0, found), np.where(unreadable, 0, labels)),
        "objects": float((sizes > 0).sum()),
        "true_objects": float(len(objects)),
        "pieces": float(np.maximum(pieces - 1, 0).sum()),
        "merged": float(len(seen) - len({main[k] for k in seen})),
        "missed": float(len(objects) - len(seen)),
        "invented": float(((sizes > 0) & (table[1:, 1:].sum(axis=0) < FOUND * sizes)).sum()),
        "tall": float(tall.sum()),
        "tall_missed": float((tall & (covered[objects] < FOUND)).sum()),
        "found": float(shares[objects].max(axis=1, initial=0).mean()) if len(objects) else np.nan,
    }


class PixelPairs(NamedTuple):
    """Pairs of pixels and whether they show one object: within objects, and across borders of objects that touch."""

    a: np.ndarray  #: (k,) flat pixels
    b: np.ndarray  #: (k,)
    same: np.ndarray  #: (k,) bool
    objects: dict[int, np.ndarray]  #: flat pixels of each true object that is large enough
    touching: list[tuple[int, int]]  #: true objects that are neighbours in the image

    @classmethod
    def of(cls, labels: np.ndarray) -> PixelPairs:
        """Pairs from true labels (H, W); always the same ones."""
        rng, flat = np.random.default_rng(0), labels.ravel()
        sizes = np.bincount(np.maximum(flat, 0))
        large = [int(k) for k in np.flatnonzero(sizes >= scaled_area(LEAST, labels.size)) if k > 0]
        objects = {k: np.flatnonzero(flat == k) for k in large}
        touching = touching_pairs(labels, large)
        ends = [*((k, k) for k in objects), *touching]
        a, b = (
            np.concatenate([rng.choice(objects[pair[side]], PAIRS) for pair in ends] or [np.zeros(0, np.int64)])
            for side in (0, 1)
        )
        return cls(a, b, np.repeat([i == j for i, j in ends], PAIRS), objects, touching)


def touching_pairs(labels: np.ndarray, objects: Several[int]) -> list[tuple[int, int]]:
    """The pairs of some objects that are neighbours in the image, along at least some pixels."""
    shown = np.where(np.isin(labels, objects), labels, 0)
    high = maximum_filter(shown, _TOUCH)
    low = minimum_filter(np.where(shown > 0, shown, shown.max() + 1), _TOUCH)
    at = (high > low) & (low > 0)
    pairs, counts = np.unique(np.stack([low[at], high[at]]), axis=1, return_counts=True)
    return [(int(a), int(b)) for (a, b), n in zip(pairs.T, counts, strict=True) if n >= 4 * _TOUCH]


def pixel_forecasts(belief: Belief, camera: Camera, labels: np.ndarray) -> ForecastTable:
    """Forecasts, in hundredths, of "do these two pixels show one object?"; empty without objects.

    A pixel without an object shows none, so a missed object costs.
    """
    pairs = PixelPairs.of(labels)
    if not len(pairs.a):
        return ForecastTable.of([], [])
    rows = [np.divmod(flat, labels.shape[1]) for flat in (pairs.a, pairs.b)]
    forecast = belief.same_object_at_pixels(camera, *(np.column_stack([c, r]) for r, c in rows))
    return ForecastTable.of(np.round(np.clip(forecast, 0, 1), 2), pairs.same)


def _heights(frame: Frame, labels: np.ndarray, objects: np.ndarray) -> list[np.ndarray]:
    """Heights above the table of the readings of each object."""
    z = frame.points[..., 2]
    return [z[(labels == k) & np.isfinite(z)] for k in objects]


def identities(image: np.ndarray, hypothesis: Hypothesis, truth: Truth) -> dict[str, int]:
    """True name -> id of the object that has most of its pixels, if it has half of those of any object."""
    found = {}
    for k, name in truth.names.items():
        counts = np.bincount(image[truth.labels == k])
        if len(counts) > 1 and counts[1:].max() > 0.5 * counts.sum():
            found[name] = hypothesis.record(int(counts[1:].argmax()) + 1).id
    return found


def kept(history: Several[dict[str, int]]) -> tuple[int, int]:
    """How often an object that is named at two pauses in a row keeps its id, and how often it is named so."""
    pairs = [(a[n], b[n]) for a, b in pairwise(history) for n in a.keys() & b.keys()]
    return sum(a == b for a, b in pairs), len(pairs)


def witness_scores(hypothesis: Hypothesis, frame: Frame, witness: Frame) -> dict[str, float]:
    """`covered` and `in_free_space`, by a camera that sees what is hidden from the filtered one.

    Of the voxels with surface that the witness sees more than 3 cm above the table and that lie more than 2 cm behind
    the readings of `frame`, `covered` is the share within a voxel of the hypothesis. Of the voxels of the hypothesis
    in view of the witness, `in_free_space` is the share more than 3 cm in front of its readings. `covered_objects` is
    `covered` without the voxels within 3 cm of the wall, which is no object.
    """
    grid = hypothesis.grid
    points = witness.points[witness.valid & (witness.points[..., 2] > _SEEN)]
    index = grid.index_of(points)
    surface = np.zeros(grid.shape, bool)
    surface[tuple(index[grid.contains(index)].T)] = True
    with np.errstate(invalid="ignore"):
        hidden = np.argwhere(surface & (frame_geometry(frame, grid).signed > _BEHIND))
        in_front = frame_geometry(witness, grid).signed
        occupied = hypothesis.labels > 0
        near = binary_dilation(occupied, np.ones((3, 3, 3)))
        seen = occupied & np.isfinite(in_front)
        free = seen & (in_front < -_FRONT)
    covered = near[tuple(hidden.T)]
    objects = np.abs(grid.centre_of(hidden) @ WALL[0] - WALL[1]) > _AT_WALL
    return {
        "covered": float(covered.mean()) if len(hidden) else np.nan,
        "covered_objects": float(covered[objects].mean()) if objects.any() else np.nan,
        "in_free_space": float(free.sum() / max(int(seen.sum()), 1)),
    }

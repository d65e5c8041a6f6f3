"""What one frame says about hypotheses: observed free space, and terms of a score.

>>> refined, quality = FreeSpace().project(hypothesis, frame)           # one hypothesis, one frame
>>> refined, quality = FreeSpace().refine(hypotheses, clip)             # several, at the end of a clip
>>> log_score = evidence.log_score(hypotheses, clip)                    # (n,) nats, larger is better

Free-space projection is the first step of the measurement update (paper, section IV-D). The quality of a prediction
is Q = 1 - (cleared voxels) / (occupied voxels). An update adds lambda log Q to the log weight of the prediction. The
factor lambda is the parameter `quality_exponent` of the update.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Annotated, Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import Bounds, NonNegativeFloat
from mstfilter.base.results import Checked, check_array, check_list, check_pair, check_type, describe_value, returns
from mstfilter.scene.arrays import component_key, read_only
from mstfilter.scene.cache import memo
from mstfilter.scene.camera import scaled_area
from mstfilter.scene.frame import Clip, Frame, depth_sigma
from mstfilter.scene.geometry import frame_geometry
from mstfilter.scene.rendering import Rendering, render_hypothesis
from mstfilter.scene.support import foreground
from mstfilter.scene.voxels import Hypothesis, VoxelGrid

_SMALLEST_QUALITY = 1e-3


Projected = tuple[Hypothesis, float]  #: a hypothesis, and the share of voxels that it has kept


def _check_projected(self: Projection, found: Projected, hypothesis: Hypothesis, frame: Frame) -> Projected:
    projected, share = check_pair(found, "a hypothesis", "a share")
    check_type(projected, Hypothesis, "a Hypothesis")
    if not isinstance(share, Real) or not 0 <= float(share) <= 1 + 1e-9:
        raise InputError(f"returns the share {describe_value(share)}, expected a number from 0 to 1")
    return projected, float(share)


def _check_refined(self: Projection, found: Any, hypotheses: Sequence[Hypothesis], clip: Clip) -> Any:
    n = len(hypotheses)
    refined, shares = check_pair(found, "hypotheses", "shares")
    return tuple(check_list(refined, n, Hypothesis, "hypotheses")), check_array(shares, (n,), "iuf", 0, 1)


class Projection(Checked, ABC):
    """Base class of components that change a hypothesis so that the hypothesis agrees with a frame."""

    @returns(_check_projected)
    @abstractmethod
    def project(self, hypothesis: Hypothesis, frame: Frame) -> Projected:
        """The nearest hypothesis that agrees with a frame, and the share of kept voxels (0 to 1)."""

    @returns(_check_refined)
    def refine(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> tuple[tuple[Hypothesis, ...], np.ndarray]:
        """Apply `project` to the last frame of a clip. Returns n hypotheses, and their shares (n,) of kept voxels."""
        pairs = [self.project(hypothesis, clip.after) for hypothesis in hypotheses]
        return tuple(h for h, _ in pairs), np.array([q for _, q in pairs])


@dataclass(frozen=True)
class NoFreeSpace(Projection):
    """Returns every hypothesis unchanged, with the share 1 of kept voxels."""

    def project(self, hypothesis: Hypothesis, frame: Frame) -> Projected:
        return hypothesis, 1.0


@dataclass(frozen=True)
class FreeSpace(Projection):
    """Clears voxels that the depth image observes as free.

    A voxel is free if its centre lies in front of the measured surface by more than the sum of two margins, one for
    the size of the voxel and one for the noise of the sensor (`mstfilter.scene.depth_sigma`). Voxels that are not
    observed (no depth reading, robot pixel, outside the image, behind a surface) are kept, and so is a voxel that
    contains a measured point.

    With several cameras (`Frame.views`), a voxel is free if at least one observes it as free and none measures a
    point in it.

    Parameters
    ----------
    margin_voxels : float
        Margin for the size of a voxel, in voxels.
    margin_sigmas : float
        Margin for the noise, in standard deviations of a depth reading at the range of the surface.
    table_height : float
        Voxels with centres below this height (metres above the table) are always cleared.
    """

    margin_voxels: NonNegativeFloat = 0.5
    margin_sigmas: NonNegativeFloat = 3.0
    table_height: Annotated[float, Bounds()] = 0.0

    def known_free(self, frame: Frame, grid: VoxelGrid) -> np.ndarray:
        """Voxels (X, Y, Z) bool that a frame observes as free. The result is cached."""
        key = (frame.key, grid.key, component_key(self))
        return memo("known_free", key, lambda: read_only(self._known_free(frame, grid)))

    def _known_free(self, frame: Frame, grid: VoxelGrid) -> np.ndarray:
        free, hit = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
        for view in frame.all_views:
            geometry = frame_geometry(view, grid)
            # The noise is that of the reading, so it is computed at the range of the measured surface.
            noise = depth_sigma(geometry.z - geometry.signed)
            margin = self.margin_voxels * grid.voxel_size + self.margin_sigmas * noise
            with np.errstate(invalid="ignore"):
                free |= geometry.signed < -margin
            points = grid.index_of(view.points[view.valid])
            hit[tuple(points[grid.contains(points)].T)] = True
        free &= ~hit
        below = grid.origin[2] + (np.arange(grid.shape[2]) + 0.5) * grid.voxel_size < self.table_height
        free[:, :, below] = True
        return free

    def project(self, hypothesis: Hypothesis, frame: Frame) -> Projected:
        """Clear the voxels that the frame observes as free. Without occupied voxels, the returned share is 1."""
        return cleared(hypothesis, self.known_free(frame, hypothesis.grid))


def cleared(hypothesis: Hypothesis, free: np.ndarray) -> Projected:
    """A hypothesis without the voxels `free` (X, Y, Z) bool, and the share of its occupied voxels that remain."""
    occupied = hypothesis.labels != 0
    possible = occupied if hypothesis.occupancy is None else hypothesis.occupancy.probability > 0
    if not (possible & free).any():
        return hypothesis, 1.0
    quality = 1.0 - int((occupied & free).sum()) / max(int(occupied.sum()), 1)
    return hypothesis.without(possible & free), quality


def log_quality(quality: np.ndarray) -> np.ndarray:
    """log max(Q, 1e-3), shape (n,), for shares Q (n,) of kept voxels. The bound 1e-3 keeps all weights positive."""
    return np.log(np.maximum(quality, _SMALLEST_QUALITY))


_LEAST_PIXELS = 30  # in an image of 640 x 480 pixels: an object with fewer of them is not tested


def surface_agreement(hypothesis: Hypothesis, frame: Frame) -> tuple[np.ndarray, float]:
    """Fraction of the visible surface that a frame confirms, for each object and for the whole hypothesis.

    The hypothesis is rendered, and the pixels inside the rendered outlines are used, except those without a depth
    reading, and those with a reading in front of the surface, which another object may hide. At each remaining pixel,
    the surface is confirmed if the pixel can belong to an object (`foreground`) and the reading is not far behind the
    surface. The tolerance, in front and behind, is the edge of a voxel plus three standard deviations of the depth
    noise.

    Returns
    -------
    of_objects : (k,) ndarray
        Fraction of confirmed pixels for each label. It is NaN for label 0, for objects with few used pixels, and
        for objects with fewer used pixels than pixels without a reading.
    of_scene : float
        Fraction of confirmed pixels among the used pixels of the whole image, or 1 if no pixel is used.
    """
    rendered, shown = render_hypothesis(hypothesis, frame.camera), foreground(frame, hypothesis.grid).pixels
    would_show = _interior(rendered, hypothesis.grid.voxel_size * frame.camera.K[0, 0])
    if frame.robot_mask is not None:
        would_show &= ~frame.robot_mask
    labels, depth = rendered.labels[would_show], rendered.depth[would_show]
    tolerance = hypothesis.grid.voxel_size + 3 * depth_sigma(depth)
    with np.errstate(invalid="ignore"):
        behind = np.where(frame.valid, frame.depth, np.nan)[would_show] - depth
        at_its_place = shown[would_show] & (behind <= tolerance)
        used = behind >= -tolerance
    agrees = at_its_place[used]
    n = int(hypothesis.labels.max(initial=0)) + 1
    total, pixels = np.bincount(labels[used], agrees, n), np.bincount(labels[used], minlength=n)
    enough = pixels >= max(scaled_area(_LEAST_PIXELS, frame.depth.size), 1)
    enough &= pixels > np.bincount(labels[np.isnan(behind)], minlength=n)
    of_objects = np.divide(total, pixels, out=np.full(n, np.nan), where=enough)
    return of_objects, float(agrees.mean()) if len(agrees) else 1.0


def _interior(rendered: Rendering, size: float) -> np.ndarray:
    """Pixels (H, W) bool at least half a voxel inside object outlines. A voxel edge is `size` / depth pixels long."""
    import cv2

    shown = rendered.labels > 0
    if not shown.any():
        return shown
    width = 2 * max(1, round(size / 2 / float(np.median(rendered.depth[shown])))) + 1
    square = np.ones((width, width), np.uint8)
    return np.asarray(shown & (cv2.erode(rendered.labels, square) == cv2.dilate(rendered.labels, square)))


class Evidence(Checked, ABC):
    """A term in the score of candidate hypotheses, for the field `evidence` of an update.

    (The *log evidence* of a filter is something else: the log probability density of all observations.)

    The docstring of each term lists the data that it uses, so that you see whether terms share data.
    """

    @returns(lambda self, found, hypotheses, clip: check_array(found, (len(hypotheses),)).astype(np.float64))
    @abstractmethod
    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        """Finite log scores (n,), in nats and up to a common constant, of hypotheses at the end of a clip."""


def check_grid(name: str, hypothesis: Hypothesis, grid: VoxelGrid) -> None:
    """Raise InputError if the grid of a hypothesis differs from `grid`."""
    if hypothesis.grid != grid:
        found, expected = (
            f"{g.shape} voxels of {g.voxel_size:g} m at {g.origin.tolist()}" for g in (hypothesis.grid, grid)
        )
        raise InputError(
            f"grid of {name} is {found}, expected {expected}",
            "all hypotheses of a run share the workspace of its clips",
            "parts of one session: open the later part with later.in_world_of(first)",
        )


def check_grids(side: str, hypotheses: Sequence[Hypothesis], grid: VoxelGrid) -> None:
    """Raise InputError if a hypothesis has a grid other than `grid`. `side` names the hypotheses in the message."""
    for k, hypothesis in enumerate(hypotheses):
        check_grid(f"{side} hypothesis {k}".strip(), hypothesis, grid)

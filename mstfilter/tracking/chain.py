"""An object followed from frame to frame through a clip, by its complete shape.

>>> chain = follow(rng, track)                    # doctest: +SKIP
>>> chain.T, chain.score                          # doctest: +SKIP

An object that turns shows another side in the last frame, so few of its points can be compared with the first frame.
After a small motion, most points can be compared. The chain consists of frames between which the object moves by at
least one or two pixels. In each frame of the chain, the voxels of the object are rendered at the place of the object
in this frame. The pixels whose depth agrees with the rendering show the object. They include surface that the first
frame does not show. Optical flow and `refine_motion` give the motion of these pixels to the next frame of the chain.
The motion of the clip is the product of these motions.

Errors accumulate along the chain, mostly on surfaces without texture. `MstRule` uses the motion only if the motion
agrees better with the last frame than all other motions. The measures are `MotionResidual` and `shape_cost`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mstfilter.scene import Crop, Frame, VoxelGrid, object_depth, scaled_area
from mstfilter.tracking import rigid
from mstfilter.tracking.flow import advance
from mstfilter.tracking.residual import MotionResidual, refine_motion
from mstfilter.tracking.segments import TABLE_HEIGHT, Track, evenly

_MOVED = 0.002  # of the image width; the motion of the pixels between two frames of the chain
_LEAST_PIXELS = 150  # that show the object, at each frame of 640 x 480 pixels
_LARGEST_SCORE = 1.5  # mean of S between frames
_AGREES = 1.5  # voxels between the rendered and the measured depth
_N_POINTS, _N_SCORED = 500, 300  # pixels that are moved by the flow, and that are scored, evenly spaced
_LEAST_PAIRS, _INLIER, _SCALE = 12, 0.008, 0.004  # points; metres
_RESIDUAL = MotionResidual(track_weight=0.0, target_weight=0.0)


class Chain(NamedTuple):
    """The motion of an object through a clip, from frame to frame."""

    T: np.ndarray  #: (4, 4) motion, world metres
    n_pixels: int  #: smallest number of pixels that show the object in a frame
    score: float  #: mean of S of `MotionResidual` between consecutive frames of the chain


def follow(rng: np.random.Generator, track: Track) -> Chain | None:
    """Follow an object through the used frames of the flow.

    The result is None if too few pixels show the object in a frame, or if the mean of S between frames is too large.
    """
    clip, crop, fewest = track.clip, track.crop, len(track.segment.pixels)
    unknown = replace(track.flow, source=np.full(track.flow.source.shape, -1, np.int32))
    T, step, scores, k, frame = np.eye(4), np.eye(4), [], 0, clip.before
    while k < len(track.flow.flows):
        pixels = _shown(crop, clip.grid, frame, T)
        fewest = min(fewest, len(pixels))
        if fewest < scaled_area(_LEAST_PIXELS, frame.depth.size):
            return None
        k, last, p, q = _pairs(track, k, frame, pixels)
        shown = replace(track.segment, pixels=pixels, support=pixels)
        pair = Track(shown, replace(clip, frames=(frame, last), times=()), unknown)
        step = refine_motion(pair, _fit(rng, p, q, step))
        scores.append(_RESIDUAL.scores(pair, step[None], _N_SCORED)[0])
        T, frame = step @ T, last
    if not scores or not np.mean(scores) <= _LARGEST_SCORE:
        return None
    return Chain(T, fewest, float(np.mean(scores)))


def _shown(crop: Crop, grid: VoxelGrid, frame: Frame, T: np.ndarray) -> np.ndarray:
    """Flat pixels (n,) of a frame whose depth agrees with the voxels of an object that has moved by T."""
    camera = frame.camera.at(rigid.rigid_transform(rigid.invert(T) @ frame.camera.pose.as_matrix()))
    window, depth = object_depth(crop.occupied, crop.box, grid, camera)
    with np.errstate(invalid="ignore"):
        agrees = np.abs(frame.depth[window] - depth) < _AGREES * grid.voxel_size
        agrees &= frame.points[window][..., 2] > TABLE_HEIGHT
    rows, columns = np.nonzero(agrees & frame.valid[window])
    return np.asarray((rows + window[0].start) * frame.depth.shape[1] + columns + window[1].start)


def _pairs(track: Track, k: int, first: Frame, pixels: np.ndarray) -> tuple[int, Frame, np.ndarray, np.ndarray]:
    """Points (n, 3) of some pixels of used frame k, and the same points in a later used frame, by the flow.

    The later frame is the first one in which the pixels have moved enough, or else the last frame. Returns its number
    among the used frames, the frame, and the points in both frames.
    """
    height, width = first.depth.shape
    chosen = evenly(pixels, _N_POINTS)
    start = at = np.stack([chosen % width, chosen // width], axis=1).astype(np.float32)
    frame, ok = first, np.ones(len(chosen), bool)
    for fields in track.flow.flows[k:]:
        there, back = fields.astype(np.float32)
        k, a, frame = k + 1, frame, track.clip.frames[track.flow.used[k + 1]]
        at, valid = advance(at, there, back, a, frame)
        ok &= valid
        if np.median(np.linalg.norm(at - start, axis=1)) > _MOVED * width:
            break
    u, v = np.clip(np.rint(at), 0, [width - 1, height - 1]).astype(np.int64).T
    q = frame.points[v, u]
    ok &= frame.valid[v, u] & (q[:, 2] > TABLE_HEIGHT)
    return k, frame, first.points.reshape(-1, 3)[chosen[ok]], q[ok]


def _fit(rng: np.random.Generator, p: np.ndarray, q: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """The motion (4, 4) that moves most of the points p (n, 3) to q (n, 3); `otherwise` if there are too few."""
    fit = rigid.ransac(rng, p, q, _INLIER) if len(p) >= _LEAST_PAIRS else None
    if fit is None or len(fit.inliers) < _LEAST_PAIRS:
        return otherwise
    return rigid.refine_robust(fit.T, p, q, _SCALE)

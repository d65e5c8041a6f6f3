"""An object followed from frame to frame through a clip, by its complete shape.

>>> chain = follow(rng, track)                    # doctest: +SKIP
>>> chain.T, chain.score                          # doctest: +SKIP

An object that turns shows another side in the last frame, so few of its points can be compared with the first frame.
Between neighbouring frames, most points can be compared. In every `_STRIDE`-th used frame, the voxels of the object
are rendered at its present place. The pixels whose depth agrees with the rendering show the object, and can show
surface that is hidden in the first frame. Optical flow and `refine_motion` move these pixels to the next of these
frames. The motion of the clip is the product of these motions.

The errors of these motions accumulate, above all along surfaces without texture. So the resulting motion is compared
with others by `MotionResidual` and `shape_cost`.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mstfilter.scene import Crop, Frame, VoxelGrid, object_depth, scaled_area
from mstfilter.tracking import rigid
from mstfilter.tracking.flow import advance
from mstfilter.tracking.residual import MotionResidual, refine_motion
from mstfilter.tracking.segments import TABLE_HEIGHT, Track

_STRIDE = 2  # used frames of the flow per motion
_LEAST_PIXELS = 150  # that show the object, at each frame of 640 x 480 pixels
_LARGEST_SCORE = 2.0  # mean of S between frames
_AGREES = 1.5  # voxels between the rendered and the measured depth
_N_POINTS, _N_SCORED = 250, 300  # pixels that are moved by the flow, and that are scored, evenly spaced
_LEAST_PAIRS, _INLIER, _SCALE = 12, 0.008, 0.004  # points; metres
_RESIDUAL = MotionResidual(track_weight=0.0, target_weight=0.0)


class Chain(NamedTuple):
    """The motion of an object through a clip."""

    T: np.ndarray  #: (4, 4) motion, world metres
    n_pixels: int  #: smallest number of pixels that show the object in a frame
    score: float  #: mean of S of `MotionResidual` between consecutive frames of the chain


def follow(rng: np.random.Generator, track: Track) -> Chain | None:
    """Follow an object through the used frames of the flow.

    The result is None if too few pixels show the object in a frame, or if the mean of S between frames is too large.
    """
    flow, clip = track.flow, track.clip
    unknown = replace(flow, source=np.full(flow.source.shape, -1, np.int32))
    T, step, fewest, scores, frames = np.eye(4), np.eye(4), len(track.segment.pixels), [], [clip.before]
    for i, j in pairwise([*range(0, len(flow.flows), _STRIDE), len(flow.flows)]):
        frames = [frames[-1], *(clip.frames[k] for k in flow.used[i + 1 : j + 1])]
        pixels = _shown(track.crop, clip.grid, frames[0], T)
        fewest = min(fewest, len(pixels))
        if fewest < scaled_area(_LEAST_PIXELS, frames[0].depth.size):
            return None
        shown = replace(track.segment, pixels=pixels, support=pixels)
        pair = Track(shown, replace(clip, frames=(frames[0], frames[-1]), times=()), unknown)
        by_flow = _by_flow(rng, frames, pixels, flow.flows[i:j])
        step = refine_motion(pair, step if by_flow is None else by_flow)
        scores.append(_RESIDUAL.scores(pair, step[None], _N_SCORED)[0])
        T = step @ T
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


def _by_flow(
    rng: np.random.Generator, frames: list[Frame], pixels: np.ndarray, flows: np.ndarray
) -> np.ndarray | None:
    """The motion (4, 4) of some flat pixels from the first to the last frame by the flow; None if it is not known.

    `flows` (n - 1, 2, h, w, 2) are the flows between consecutive frames, forward and back, as in `ClipTracks`.
    """
    first, last = frames[0], frames[-1]
    height, width = first.depth.shape
    chosen = pixels[np.unique(np.linspace(0, len(pixels) - 1, _N_POINTS).astype(np.int64))]
    at, ok = np.stack([chosen % width, chosen // width], axis=1).astype(np.float32), np.ones(len(chosen), bool)
    for (a, b), (there, back) in zip(pairwise(frames), flows.astype(np.float32), strict=True):
        at, valid = advance(at, there, back, a, b)
        ok &= valid
    u, v = np.clip(np.rint(at), 0, [width - 1, height - 1]).astype(np.int64).T
    p, q = first.points.reshape(-1, 3)[chosen], last.points[v, u]
    ok &= last.valid[v, u] & (q[:, 2] > TABLE_HEIGHT)
    fit = rigid.ransac(rng, p[ok], q[ok], _INLIER) if ok.sum() >= _LEAST_PAIRS else None
    if fit is None or len(fit.inliers) < _LEAST_PAIRS:
        return None
    return rigid.refine_robust(fit.T, p[ok], q[ok], _SCALE)

"""Comparison of a motion with the last frame: the residual that ranks motions, and refinement.

The residual compares depth and colour at the positions of the moved surface. With predicted depth z and measured
depth m, the cost of a point is

- ``min(|z - m| / s, cap)^2 + min(|colour difference| / c, cap)^2``, where s is the sensor noise at this range;
- a constant if z is behind m by more than a margin (occluded);
- a larger constant outside the image;
- 0, and not counted, without a reading, on the robot, or if the point is occluded and its surface faces away.

The score S, of which less is better, is the mean cost of the counted points plus two terms. One grows with the
fraction of visible points on pixels that the flow traces back to another object, and so tells two objects apart that
look the same. The other grows with the fraction of the surface that the flow traces back to this object but that is
far from the moved one. Without it, a position hidden behind another object would score as well as a visible one.

`refine_motion` improves a motion by Gauss-Newton steps on projective point-to-plane distances and colour. It compares
every moved point with the measurement at its pixel, so errors of the tracked mask have no effect. Colour is needed
where depth leaves a motion open, such as the rotation of a can about its axis.

>>> MotionResidual().score(track, T)                      # doctest: +SKIP
>>> refine_motion(track, T)                               # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mstfilter.mst.tracking.rigid import invert, move_points
from mstfilter.mst.tracking.segments import Track
from mstfilter.scene import Camera, Frame, depth_sigma, memo

_DEPTH_SCALE = 1.5  # unit of depth differences, in standard deviations of the difference of two readings
_COLOUR_SCALE = 25.0  # unit of colour differences (Euclidean RGB), grey levels
_CAP = 4.0  # largest normalised difference
_OCCLUDED_COST, OUTSIDE_COST = 5.6, 16.0  # of an occluded point and of a point outside the image
_OCCLUDED_MARGIN = 0.015  # metres; points farther behind the measured surface are occluded
_FACING_AWAY = -0.1  # cosine of normal and ray; the visible side of a surface is below
_EXPLAINED = 0.01  # metres from the moved surface to a measured point that it explains
_MIN_COUNTED = 0.3  # smallest fraction of counted points; with fewer the score is infinite
_N_SCORED, _N_REFINED = 1200, 800  # largest numbers of points of a segment, evenly spaced
_GATES = (0.03, 0.03, 0.02, 0.02, 0.015, 0.015, 0.01, 0.01)  # metres, one per iteration
_DAMPING = 1e-3  # of the largest eigenvalue; keeps directions that the data do not determine


@dataclass(frozen=True)
class MotionResidual:
    """Robust residual of a motion.

    `track_weight` is added to S if all visible points are on pixels that the flow traces back to another object.
    `target_weight` is added to S if the motion explains no point that the flow traces back to this object. S is
    infinite if less than `min_visible` of the points would be visible. The identity is excepted: an object at rest
    can become hidden, but no image supports a motion to one of many hidden positions.
    """

    track_weight: float = 1.0
    target_weight: float = 2.0
    min_visible: float = 0.05

    def score(self, track: Track, T: np.ndarray) -> float:
        """S of a motion (4, 4); infinite if too few points can be compared."""
        return float(self.scores(track, T[None])[0])

    def scores(self, track: Track, motions: np.ndarray, n_points: int = _N_SCORED) -> np.ndarray:
        """S (K,) of motions (K, 4, 4), computed from at most ``n_points`` points."""
        points, colours = track.sample(n_points)
        if not len(points):
            return np.full(len(motions), np.inf)
        after, moved = track.clip.after, move_points(motions, points)
        u, v, z, inside = after.camera.pixels_of(moved)
        measured = after.depth[v, u].astype(np.float64)
        counted = inside & after.valid[v, u]
        behind = z - measured
        scale = _DEPTH_SCALE * np.sqrt(2.0) * depth_sigma(measured)
        red, green, blue = np.moveaxis(track.colour_after[v, u] - colours, -1, 0)
        colour = np.sqrt(red**2 + green**2 + blue**2)  # faster than a reduction over three elements
        with np.errstate(invalid="ignore"):
            hidden = behind > _OCCLUDED_MARGIN
            cost = np.minimum(np.abs(behind) / scale, _CAP) ** 2
            cost = cost + np.minimum(colour / _COLOUR_SCALE, _CAP) ** 2
        cost = np.where(hidden, _OCCLUDED_COST, cost)
        candidates = counted & hidden
        counted[candidates] = ~_facing_away(track, motions, moved, n_points, candidates)
        n_outside = (~inside).sum(axis=-1)
        n = n_outside + counted.sum(axis=-1)
        total = np.where(counted, cost, 0.0).sum(axis=-1) + OUTSIDE_COST * n_outside
        # Fraction of the visible points that land on pixels of another object according to the flow.
        source = track.flow.source[v, u]
        with_source = counted & ~hidden & (source >= 0)
        foreign = (with_source & ~track.mask.ravel()[source]).sum(axis=-1)
        share_foreign = foreign / np.maximum(with_source.sum(axis=-1), 1)
        mean = total / np.maximum(n, 1) + self.track_weight * share_foreign
        if self.target_weight:
            mean = mean + self.target_weight * _unexplained(track, motions, n_points // 8)
        supported = (counted & ~hidden).sum(axis=-1) + n_outside >= self.min_visible * len(points)
        supported |= (motions == np.eye(4)).all(axis=(1, 2))
        return np.where(supported & (n >= max(_MIN_COUNTED * len(points), 1)), mean, np.inf)


def _facing_away(track: Track, motions: np.ndarray, moved: np.ndarray, n: int, at: np.ndarray) -> np.ndarray:
    """Whether the surface faces away from the camera at the moved points (K, N, 3) that `at` (K, N) selects."""
    normal = normals(track.clip.before).reshape(-1, 3)[track.sampled(n)] @ np.swapaxes(motions[:, :3, :3], -1, -2)
    ray = moved[at] - track.clip.after.camera.position
    with np.errstate(invalid="ignore"):
        return np.einsum("ni,ni->n", normal[at], ray) > _FACING_AWAY * np.linalg.norm(ray, axis=-1)


def _unexplained(track: Track, motions: np.ndarray, n: int) -> np.ndarray:
    """Fraction (K,) of about n target points that are far from the moved surface; 0 if a surface is missing."""
    source, target = track.surface, track.target_surface
    if source is None or target is None:
        return np.zeros(len(motions))
    points = target.points[:: max(1, len(target.points) // max(n, 1))]
    at_source = move_points(invert(motions), points)
    distance, _ = track.near.query(at_source, distance_upper_bound=_EXPLAINED)
    return (~np.isfinite(distance)).mean(axis=-1)


def normals(frame: Frame) -> np.ndarray:
    """World unit normals (H, W, 3) that face the camera, with NaN where they are unknown. Cached by content."""

    def compute() -> np.ndarray:
        valid = np.isfinite(frame.depth)
        points = np.where(valid[..., None], frame.points, 0.0).astype(np.float32)
        weight = cv2.blur(valid.astype(np.float32), (5, 5))
        with np.errstate(invalid="ignore", divide="ignore"):
            smooth = cv2.blur(points, (5, 5)) / weight[..., None]
        out = np.full(points.shape, np.nan, np.float32)
        across = smooth[2:-2, 4:] - smooth[2:-2, :-4]
        down = smooth[4:, 2:-2] - smooth[:-4, 2:-2]
        normal = np.cross(down, across)
        with np.errstate(invalid="ignore", divide="ignore"):
            out[2:-2, 2:-2] = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        # At a depth edge the difference spans two surfaces.
        jump = np.maximum(np.linalg.norm(across, axis=-1), np.linalg.norm(down, axis=-1)) > 0.05
        out[2:-2, 2:-2][jump | ~valid[2:-2, 2:-2]] = np.nan
        return out

    return memo("normals", (frame.key,), compute)


def _gradients(track: Track) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The smoothed grey last image, and its derivatives along columns and rows in grey levels per pixel."""

    def compute() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        grey = track.colour_after.mean(axis=2)
        down, across = np.gradient(grey)
        return grey, across, down

    return memo("grey gradients", (track.clip.after.key, track.clip.before.key), compute)


def refine_motion(track: Track, T: np.ndarray) -> np.ndarray:
    """Improve a motion (4, 4) of a segment. The motion is returned unchanged if too few points can be compared."""
    points, colours = track.sample(_N_REFINED)
    grey = colours.mean(axis=1)
    for gate in _GATES:
        change = _improvement(track, move_points(T, points), grey, gate)
        if change is None:
            return T
        T = change @ T
    return T


def _improvement(track: Track, x: np.ndarray, before_grey: np.ndarray, gate: float) -> np.ndarray | None:
    """The motion (4, 4) of one Gauss-Newton step; None if fewer than 12 points can be compared.

    `x` (N, 3) are the moved points, `before_grey` (N,) their grey values in the first frame. `gate` is the largest
    distance in metres between a point and the measurement at its pixel.
    """
    after = track.clip.after
    height, width = after.depth.shape
    surface_normals, (grey, across, down) = normals(after), _gradients(track)
    uv, z = after.camera.project(x)
    ok = (np.isfinite(uv) & (uv >= 0.5) & (uv <= [width - 1.5, height - 1.5])).all(axis=1)
    u, v = np.rint(uv[ok]).astype(np.int64).T
    normal = surface_normals[v, u].astype(np.float64)
    offset = x[ok] - after.points[v, u]
    with np.errstate(invalid="ignore"):
        distance = np.einsum("ni,ni->n", normal, offset)
        near = after.valid[v, u] & np.isfinite(distance) & (np.linalg.norm(offset, axis=1) < gate)
    if near.sum() < 12:
        return None
    rows = np.flatnonzero(ok)[near]
    u, v, x, z = u[near], v[near], x[rows], z[rows]
    unit = _DEPTH_SCALE * np.sqrt(2.0) * depth_sigma(z)
    # Grey value at the projected point, to first order around the pixel.
    du, dv = uv[rows, 0] - u, uv[rows, 1] - v
    gx, gy = across[v, u].astype(np.float64), down[v, u].astype(np.float64)
    r_colour = (grey[v, u] + gx * du + gy * dv - before_grey[rows]) / _COLOUR_SCALE
    slope_colour = _grey_slope(after.camera, x, z, gx, gy) / (z * _COLOUR_SCALE)[:, None]
    return _gauss_newton(x, (distance[near] / unit, normal[near] / unit[:, None]), (r_colour, slope_colour))


def _grey_slope(camera: Camera, x: np.ndarray, z: np.ndarray, gx: np.ndarray, gy: np.ndarray) -> np.ndarray:
    """Derivative (N, 3) of the grey value with respect to the position of a point, times its depth `z` (N,).

    `gx` and `gy` (N,) are the derivatives of the image along columns and rows.
    """
    K, world_to_camera = camera.K, camera.pose.as_matrix()[:3, :3].T
    camera_x = (x - camera.position) @ world_to_camera.T
    per_pixel = np.stack(
        [
            gx * K[0, 0],
            gx * K[0, 1] + gy * K[1, 1],
            -(gx * K[0, 0] * camera_x[:, 0] + gy * K[1, 1] * camera_x[:, 1]) / z,
        ],
        axis=1,
    )
    return per_pixel @ world_to_camera


def _gauss_newton(x: np.ndarray, *terms: tuple[np.ndarray, np.ndarray]) -> np.ndarray | None:
    """The motion (4, 4) of a step that reduces robust residuals of points x (N, 3); None if it is not finite.

    A term consists of residuals (N,) and their derivatives (N, 3) with respect to the positions of the points.
    """
    centre = x.mean(axis=0)
    radius = max(float(np.sqrt(((x - centre) ** 2).sum(axis=1).mean())), 1e-3)
    H, b = np.zeros((6, 6)), np.zeros(6)
    for residual, slope in terms:
        (ax, ay, az), (sx, sy, sz) = ((x - centre) / radius).T, slope.T
        J = np.stack([ay * sz - az * sy, az * sx - ax * sz, ax * sy - ay * sx, sx, sy, sz], axis=1)
        weight = (1.0 + residual**2 / 4.0) ** -2
        H += (J * weight[:, None]).T @ J
        b += J.T @ (weight * residual)
    step = -np.linalg.solve(H + _DAMPING * np.linalg.eigvalsh(H)[-1] * np.eye(6), b)
    change = np.eye(4)
    change[:3, :3] = Rotation.from_rotvec(step[:3] / radius).as_matrix()
    change[:3, 3] = centre + step[3:] - change[:3, :3] @ centre
    return change if np.isfinite(change).all() else None

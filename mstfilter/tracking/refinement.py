"""Polish a motion against the whole last frame: projective point-to-plane and colour, Gauss-Newton.

Registration works on a tracked mask and inherits its errors. Here every moved point is compared with what
the last frame measures at the pixel where it falls, so no mask is needed; colour holds the directions that
depth does not see (a can's spin, a book sliding in its own plane).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mstfilter.scene import Frame, depth_sigma, memo
from mstfilter.tracking import rigid
from mstfilter.tracking.track import Track

__all__ = ["normals", "refine"]

Array = NDArray[np.float64]

N_POINTS = 800
GATES = (0.03, 0.03, 0.02, 0.02, 0.015, 0.015, 0.01, 0.01)  # metres, one an iteration
DAMPING = 1e-3  # of the largest eigenvalue: directions the data do not see stay as they are


def normals(frame: Frame) -> NDArray[np.float32]:
    """World unit normals (H, W, 3) that face the camera, NaN where unknown. Memoised by content."""

    def compute() -> NDArray[np.float32]:
        import cv2

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
        # Across a depth edge the difference spans two surfaces.
        jump = np.maximum(np.linalg.norm(across, axis=-1), np.linalg.norm(down, axis=-1)) > 0.05
        out[2:-2, 2:-2][jump | ~valid[2:-2, 2:-2]] = np.nan
        return out

    return memo("normals", (frame.key,), compute)


def _gradients(track: Track) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Smoothed grey last image and its derivatives along columns and rows, grey levels a pixel."""

    def compute() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        grey = track.colour_after.mean(axis=2)
        down, across = np.gradient(grey)
        return grey, across, down

    return memo("grey gradients", (track.clip.after.key, track.clip.before.key), compute)


def refine(track: Track, T: Array, depth_scale: float = 1.5, colour_scale: float = 25.0) -> Array:
    """Improve a motion (4, 4) of a segment; the scales are those of `Residual`.

    Returns
    -------
    (4, 4) motion; unchanged where too few points can be compared.
    """
    points, colours = track.sample(N_POINTS)
    after = track.clip.after
    surface_normals, (grey, across, down) = normals(after), _gradients(track)
    before_grey = colours.mean(axis=1)
    height, width = after.depth.shape
    K, world_to_camera = after.camera.K, after.camera.pose.as_matrix()[:3, :3].T
    for gate in GATES:
        x = rigid.apply(T, points)
        uv, z = after.camera.project(x)
        ok = (np.isfinite(uv) & (uv >= 0.5) & (uv <= [width - 1.5, height - 1.5])).all(axis=1)
        u, v = np.rint(uv[ok]).astype(np.int64).T
        normal = surface_normals[v, u].astype(np.float64)
        offset = x[ok] - after.points[v, u]
        with np.errstate(invalid="ignore"):
            distance = np.einsum("ni,ni->n", normal, offset)
            near = after.valid[v, u] & np.isfinite(distance) & (np.linalg.norm(offset, axis=1) < gate)
        if near.sum() < 12:
            return T
        rows = np.flatnonzero(ok)[near]
        u, v, x, z = u[near], v[near], x[rows], z[rows]
        centre = x.mean(axis=0)
        radius = max(float(np.sqrt(((x - centre) ** 2).sum(axis=1).mean())), 1e-3)
        r_depth = distance[near] / (depth_scale * np.sqrt(2.0) * depth_sigma(z))
        j_depth = normal[near] / (depth_scale * np.sqrt(2.0) * depth_sigma(z))[:, None]
        # Grey value where the point falls, to first order around the pixel.
        du, dv = uv[rows, 0] - u, uv[rows, 1] - v
        gx, gy = across[v, u].astype(np.float64), down[v, u].astype(np.float64)
        r_colour = (grey[v, u] + gx * du + gy * dv - before_grey[rows]) / colour_scale
        camera_x = (x - after.camera.position) @ world_to_camera.T
        per_pixel = np.stack(
            [
                gx * K[0, 0],
                gx * K[0, 1] + gy * K[1, 1],
                -(gx * K[0, 0] * camera_x[:, 0] + gy * K[1, 1] * camera_x[:, 1]) / z,
            ],
            axis=1,
        )
        j_colour = per_pixel @ world_to_camera / (z * colour_scale)[:, None]
        H, b = np.zeros((6, 6)), np.zeros(6)
        for residual, slope in ((r_depth, j_depth), (r_colour, j_colour)):
            J = np.hstack([np.cross((x - centre) / radius, slope), slope])
            weight = (1.0 + residual**2 / 4.0) ** -2
            H += (J * weight[:, None]).T @ J
            b += J.T @ (weight * residual)
        step = -np.linalg.solve(H + DAMPING * np.linalg.eigvalsh(H)[-1] * np.eye(6), b)
        change = np.eye(4)
        change[:3, :3] = Rotation.from_rotvec(step[:3] / radius).as_matrix()
        change[:3, 3] = centre + step[3:] - change[:3, :3] @ centre
        if not np.isfinite(change).all():
            return T
        T = change @ T
    return T

"""Pictures of hypotheses: overlays on the camera's image, and the voxels seen from a fixed oblique viewpoint.

>>> picture = overlay(rgb, project(hypothesis, camera), {1: (51, 111, 185)})        # (H, W, 3) uint8
>>> view = viewpoint(hypotheses, camera)
>>> picture = voxel_picture(hypothesis.labels, hypothesis.grid, view, {1: (51, 111, 185)})   # (h, w, 4) uint8

Voxels are drawn by the package's own ray caster: every ray's first face gives the normal, a blurred occupancy
gives soft shadows in corners and on the table, and lines are drawn where one object or face meets another.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from mstfilter.report.palette import GREY, Colour
from mstfilter.scene.camera import Camera, look_at
from mstfilter.scene.rendering import render
from mstfilter.scene.voxels import Hypothesis, VoxelGrid

__all__ = ["layer", "overlay", "png_bytes", "viewpoint", "voxel_picture"]

_LIGHT = np.array([-0.35, -0.45, 0.82])  # towards the light, in axes of the view: right, towards the eye, up
_TABLE = np.array([236.0, 234.0, 229.0])


def png_bytes(image: np.ndarray) -> bytes:
    """PNG of (H, W, 3) RGB or (H, W, 4) RGBA uint8; the same pixels give the same bytes."""
    import cv2

    order = [2, 1, 0, 3][: image.shape[2]]
    return bytes(cv2.imencode(".png", np.ascontiguousarray(image[..., order]), [cv2.IMWRITE_PNG_COMPRESSION, 9])[1])


def jpeg_bytes(image: np.ndarray, quality: int = 90) -> bytes:
    """JPEG of (H, W, 3) RGB uint8."""
    import cv2

    return bytes(cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])[1])


def _painted(labels: np.ndarray, colours: Mapping[int, Colour]) -> np.ndarray:
    """(..., 3) float colour of each label; grey where none is named."""
    table = np.tile(np.array(GREY, float), (int(labels.max(initial=0)) + 1, 1))
    for label, rgb in colours.items():
        if 0 <= label < len(table):
            table[label] = rgb
    return table[labels]


def layer(
    labels: np.ndarray, colours: Mapping[int, Colour], *, scale: int = 1, fill: float = 0.42, line: int = 2
) -> np.ndarray:
    """The overlay of a label image as a picture of its own: translucent fill, opaque contours.

    Parameters
    ----------
    labels : (H, W) integer
        0 stays transparent.
    colours : mapping
        ``{label: (r, g, b)}``.
    scale : int
        Pixels of the result for one of the label image, for crisp contours.
    fill : float
        Opacity inside.
    line : int
        Width of the contour in pixels of the result.

    Returns
    -------
    (scale H, scale W, 4) uint8
        RGBA, not premultiplied.
    """
    labels = np.kron(labels, np.ones((scale, scale), labels.dtype)) if scale > 1 else labels
    inside = labels > 0
    edge = np.zeros(labels.shape, bool)
    for axis in (0, 1):
        for step in range(1, line + 1):
            for sign in (step, -step):
                other = np.roll(labels, sign, axis=axis)
                differs = other != labels
                # What np.roll brings in from the other side of the image is no neighbour.
                ends = [slice(None)] * 2
                ends[axis] = slice(0, sign) if sign > 0 else slice(sign, None)
                differs[tuple(ends)] = False
                edge |= differs
    edge &= inside
    out = np.zeros((*labels.shape, 4), np.uint8)
    out[..., :3] = np.rint(_painted(labels, colours))
    out[..., 3] = np.where(edge, 255, np.where(inside, round(255 * fill), 0))
    out[~inside] = 0
    return out


def overlay(
    rgb: np.ndarray, labels: np.ndarray, colours: Mapping[int, Colour], *, fill: float = 0.42, line: int = 2
) -> np.ndarray:
    """An image (H, W, 3) with a label image (H, W) drawn over it: translucent fill and contours."""
    above = layer(labels, colours, fill=fill, line=line).astype(float)
    alpha = above[..., 3:] / 255
    return np.rint(rgb * (1 - alpha) + above[..., :3] * alpha).astype(np.uint8)


def viewpoint(
    hypotheses: Iterable[Hypothesis | tuple[np.ndarray, VoxelGrid]],
    camera: Camera | None = None,
    width: int = 640,
    height: int = 480,
) -> Camera:
    """A camera that looks down obliquely at all occupied voxels of all hypotheses and fits them all.

    Parameters
    ----------
    hypotheses : iterable of Hypothesis or (labels, grid)
        Where nothing is occupied the middle of the workspace is looked at.
    camera : Camera, optional
        The real one. The view is from its side, turned by 35 degrees, so that right stays right.
    width, height : int
        Pixels of the picture.
    """
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    for item in hypotheses:
        labels, grid = (item.labels, item.grid) if isinstance(item, Hypothesis) else item
        for axis in range(3):
            hit = np.flatnonzero((labels > 0).any(axis=tuple(a for a in range(3) if a != axis)))
            if len(hit):
                lower[axis] = min(lower[axis], grid.origin[axis] + hit[0] * grid.voxel_size)
                upper[axis] = max(upper[axis], grid.origin[axis] + (hit[-1] + 1) * grid.voxel_size)
    if not np.isfinite(lower).all():
        middle = (grid.origin + grid.upper) / 2
        lower, upper = middle - 0.15, middle + 0.15
        lower[2], upper[2] = 0.0, 0.1
    lower[2] = min(lower[2], 0.0)
    target = (lower + upper) / 2

    away = np.array([0.0, -1.0, 0.0]) if camera is None else camera.position - target
    azimuth = np.arctan2(away[1], away[0]) - np.radians(35 if camera is not None else 0)
    elevation = np.radians(33)
    direction = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    corners = np.array(np.meshgrid(*zip(lower, upper, strict=True), indexing="ij")).reshape(3, -1).T
    focal = 2.6 * width  # a long lens: nearly parallel, calm edges
    pose = look_at(target + direction, target)
    local = (corners - target) @ pose.rotation.as_matrix()
    # Far enough for every corner to fall inside the picture with a margin.
    half = 0.5 * np.array([width, height]) * 0.88
    distance = max(float((focal * np.abs(local[:, :2]) / half - local[:, 2:]).max()), 0.2)
    return Camera.from_intrinsics(
        focal,
        focal,
        (width - 1) / 2,
        (height - 1) / 2,
        width,
        height,
        look_at(target + direction * distance, target),
    )


def voxel_picture(
    labels: np.ndarray, grid: VoxelGrid, view: Camera, colours: Mapping[int, Colour], supersample: int = 2
) -> np.ndarray:
    """The voxels from a viewpoint, on the table plane, as RGBA (view.height, view.width, 4) uint8.

    Parameters
    ----------
    labels : (X, Y, Z) integer
        0 is free.
    grid : VoxelGrid
        Where the voxels are.
    view : Camera
        See `viewpoint`.
    colours : mapping
        ``{label: (r, g, b)}``.
    supersample : int
        Rays a pixel and axis.
    """
    camera = view.scaled(supersample)
    seen = render(labels, grid, camera)
    hit = seen.labels > 0
    frame = _view_axes(camera)
    light = _LIGHT @ frame
    light = light / np.linalg.norm(light)

    rays = camera.rays() @ camera.pose.rotation.as_matrix().T
    depth = np.where(hit, seen.depth, 0.0)
    points = camera.position + rays * depth[..., None]
    shade = _Shade(labels, grid)
    colour = np.zeros((*hit.shape, 3))
    alpha = np.zeros(hit.shape)

    if hit.any():
        p, r = points[hit], rays[hit]
        normal = _normals(p, r, grid)
        n = np.zeros_like(p)
        n[np.arange(len(p)), np.abs(normal) - 1] = np.sign(normal)
        diffuse = 0.5 + 0.5 * (n @ light)
        open_sky = 1.0 - 0.62 * shade.at(p + n * 1.6 * grid.voxel_size, "near")
        value = (0.50 + 0.58 * diffuse) * open_sky
        base = _painted(seen.labels[hit], colours)
        bright = np.clip(value, 0, 1.12)[:, None]
        colour[hit] = np.where(bright <= 1, base * bright, base + (255 - base) * (bright - 1))
        alpha[hit] = 1.0
        side = np.zeros(hit.shape, np.int64)
        side[hit] = normal + 8 * np.floor(np.abs(p[np.arange(len(p)), np.abs(normal) - 1]) / grid.voxel_size + 0.5)
        crease, border = _lines(seen.labels, side, hit)
        colour *= np.where(border, 0.42, np.where(crease, 0.86, 1.0))[..., None]
    _table(colour, alpha, hit, camera, rays, grid, shade)
    return _reduced(colour, alpha, supersample)


def _view_axes(camera: Camera) -> np.ndarray:
    """Rows: right, level towards the eye, up."""
    R = camera.pose.rotation.as_matrix()
    right = R[:, 0] * np.array([1, 1, 0])
    right /= np.linalg.norm(right)
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([right, np.cross(right, up), up])


def _normals(points: np.ndarray, rays: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Signed axis (+-1, +-2, +-3) of the face that each ray meets: the axis that is nearest to a lattice plane."""
    u = (points - grid.origin) / grid.voxel_size
    axis = np.abs(u - np.rint(u)).argmin(axis=1)
    return np.where(rays[np.arange(len(rays)), axis] > 0, -1, 1) * (axis + 1)


class _Shade:
    """Blurred occupancy: how much stands around a point."""

    def __init__(self, labels: np.ndarray, grid: VoxelGrid) -> None:
        from scipy.ndimage import gaussian_filter

        self._pad = 12
        solid = np.pad((labels > 0).astype(np.float32), self._pad)
        self._grid = grid
        self._near = gaussian_filter(solid, 1.8, truncate=3)
        self._far = gaussian_filter(solid, 4.0, truncate=3)

    def at(self, points: np.ndarray, reach: str) -> np.ndarray:
        """Occupancy (n,) in [0, 1] around points (n, 3) in metres."""
        from scipy.ndimage import map_coordinates

        volume = self._near if reach == "near" else self._far
        u = (points - self._grid.origin) / self._grid.voxel_size - 0.5 + self._pad
        return map_coordinates(volume, u.T, order=1, mode="nearest")


def _lines(labels: np.ndarray, side: np.ndarray, hit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels where the face changes within an object, and where the object changes."""
    crease, border = np.zeros(hit.shape, bool), np.zeros(hit.shape, bool)
    for axis in (0, 1):
        a = [slice(None)] * 2
        b = [slice(None)] * 2
        a[axis], b[axis] = slice(None, -1), slice(1, None)
        first, second = tuple(a), tuple(b)
        other = labels[first] != labels[second]
        border[first] |= other & hit[first]
        border[second] |= other & hit[second]
        crease[first] |= (side[first] != side[second]) & hit[first] & hit[second]
    return crease & ~border, border


def _table(
    colour: np.ndarray,
    alpha: np.ndarray,
    hit: np.ndarray,
    camera: Camera,
    rays: np.ndarray,
    grid: VoxelGrid,
    shade: _Shade,
) -> None:
    """Draw the plane z = 0 where nothing stands before it: soft shadows, a line every 10 cm, fading outwards."""
    free = ~hit & (rays[..., 2] < -1e-6)
    if not free.any():
        return
    r = rays[free]
    along = -camera.position[2] / r[:, 2]
    p = camera.position + r * along[:, None]
    size = grid.voxel_size
    shadow = 0.55 * shade.at(p + [0, 0, 1.2 * size], "far") + 0.45 * shade.at(p + [0, 0, 0.8 * size], "near")
    width = 0.75 * along / camera.K[0, 0]
    to_line = np.abs(p[:, :2] / 0.1 - np.rint(p[:, :2] / 0.1)).min(axis=1) * 0.1
    value = (1 - 0.75 * np.clip(shadow * 1.5, 0, 1)) * np.where(to_line < width, 0.93, 1.0)
    colour[free] = _TABLE * value[:, None]
    # Fades out with the distance from the middle of the picture, where the table has no edge to show.
    rows, columns = np.nonzero(free)
    x = (columns / (hit.shape[1] - 1) - 0.5) * 2
    y = (rows / (hit.shape[0] - 1) - 0.5) * 2
    alpha[free] = np.clip((1.0 - np.hypot(x, y)) / 0.22, 0, 1)


def _reduced(colour: np.ndarray, alpha: np.ndarray, factor: int) -> np.ndarray:
    """Mean over blocks, colour weighted by opacity."""
    h, w = alpha.shape[0] // factor, alpha.shape[1] // factor
    blocks = (h, factor, w, factor)
    opacity = alpha.reshape(blocks).mean(axis=(1, 3))
    weighted = (colour * alpha[..., None]).reshape(*blocks, 3).mean(axis=(1, 3))
    rgb = weighted / np.maximum(opacity, 1e-9)[..., None]
    out = np.concatenate([np.clip(rgb, 0, 255), 255 * opacity[..., None]], axis=-1)
    return np.rint(out).astype(np.uint8)

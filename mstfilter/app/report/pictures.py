"""Pictures of hypotheses: colours, overlays on the camera's image, and voxels from an oblique viewpoint.

>>> picture = overlay(rgb, project(hypothesis, camera), {1: (51, 111, 185)})        # (H, W, 3) uint8
>>> view = viewpoint(hypotheses, camera)
>>> picture = voxel_picture(hypothesis.labels, hypothesis.grid, view, {1: (51, 111, 185)})   # (h, w, 4) uint8
>>> colour(0), colour(1)                                                            # of identities
((51, 111, 185), (238, 145, 56))

The first six colours of the palette were chosen by hand. Each further colour is as distant as possible from all
earlier colours. The distance of two colours is their smallest Oklab distance in three kinds of vision: normal,
protanopia and deuteranopia (Machado, Oliveira, Fernandes 2009, severity 1).

Voxels are rendered by ray casting. The brightness of a face depends on its normal. Lines are drawn along the borders
of objects and of faces.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Mapping

import numpy as np

from mstfilter.scene import Camera, Hypothesis, VoxelGrid, look_at, memo, render

Colour = tuple[int, int, int]

_HEX = (
    "336fb9 ee9138 2ca281 93285c a3d3eb e8d34f d381d8 4f4100 502684 70f6b5 "
    "a95317 876888 eba9b2 968727 52a9fe e66d71 577251 075c70 9dbe7c 6892ac"
)

#: Twenty colours, 8-bit sRGB.
PALETTE: tuple[Colour, ...] = tuple((int(h[:2], 16), int(h[2:4], 16), int(h[4:], 16)) for h in _HEX.split())

UNASSIGNED_COLOUR: Colour = (140, 143, 148)  #: Colour of objects without an identity

_Volume = Hypothesis | tuple[np.ndarray, VoxelGrid]
_LIGHT = np.array([-0.35, -0.45, 0.82])  # direction to the light in axes of the view: right, towards the eye, up
_TABLE_GREY = 128.0
_RAYS = 2  # per pixel and axis of a voxel picture


def colour(identity: int) -> Colour:
    """Colour of an identity 0, 1, 2, ... The palette repeats after twenty colours. Negative identities are grey."""
    return UNASSIGNED_COLOUR if identity < 0 else PALETTE[identity % len(PALETTE)]


def hexadecimal(rgb: Colour) -> str:
    """``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*rgb)


def png_bytes(image: np.ndarray) -> bytes:
    """PNG file of an RGB (H, W, 3) or RGBA (H, W, 4) uint8 image. The same pixels give the same bytes."""
    import cv2

    order = [2, 1, 0, 3][: image.shape[2]]
    return bytes(cv2.imencode(".png", np.ascontiguousarray(image[..., order]), [cv2.IMWRITE_PNG_COMPRESSION, 6])[1])


def jpeg_bytes(image: np.ndarray) -> bytes:
    """JPEG file of an RGB (H, W, 3) uint8 image."""
    import cv2

    return bytes(cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 92])[1])


def data_uri(data: bytes, kind: str = "png") -> str:
    """An image file as a data URI."""
    return f"data:image/{kind};base64,{b64encode(data).decode()}"


def _label_colours(labels: np.ndarray, colours: Mapping[int, Colour]) -> np.ndarray:
    """Colour (..., 3) float of each label; grey for labels without a colour."""
    table = np.tile(np.array(UNASSIGNED_COLOUR, float), (int(labels.max(initial=0)) + 1, 1))
    for label, rgb in colours.items():
        if 0 <= label < len(table):
            table[label] = rgb
    return table[labels]


def overlay_layer(
    labels: np.ndarray, colours: Mapping[int, Colour], *, scale: int = 1, fill: float = 0.42, line: int = 2
) -> np.ndarray:
    """A layer that shows a label image over a photo: translucent fill and opaque contours.

    `fill` is the opacity inside, and `line` is the width of the contour in pixels of the result. The result is (scale
    H, scale W, 4) uint8, RGBA, not premultiplied. Label 0 is transparent.
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    labels = labels.repeat(scale, axis=0).repeat(scale, axis=1)
    inside = labels > 0
    edge = np.zeros(labels.shape, bool)
    for axis in (0, 1):
        for extreme in (maximum_filter1d, minimum_filter1d):
            edge |= extreme(labels, 2 * line + 1, axis, mode="nearest") != labels
    edge &= inside
    out = np.zeros((*labels.shape, 4), np.uint8)
    out[..., :3] = np.rint(_label_colours(labels, colours))
    out[..., 3] = np.where(edge, 255, np.where(inside, round(255 * fill), 0))
    out[~inside] = 0
    return out


def border_colour(one_object: float) -> Colour:
    """Colour of a border: from yellow, where it certainly separates two objects, to pink, where there is one."""
    r, g, b = np.rint(np.array([255, 214, 64]) * (1 - one_object) + np.array([244, 44, 148]) * one_object).astype(int)
    return int(r), int(g), int(b)


def overlay(
    rgb: np.ndarray, labels: np.ndarray, colours: Mapping[int, Colour], *, fill: float = 0.42, line: int = 2
) -> np.ndarray:
    """An image (H, W, 3) with a label image (H, W) drawn over it: translucent fill and contours.

    Inside objects the image is grey (luma of ITU-R BT.601), so that an object has the hue of its label's colour.
    """
    above = overlay_layer(labels, colours, fill=fill, line=line).astype(float)
    alpha = above[..., 3:] / 255
    grey = rgb @ np.array([0.299, 0.587, 0.114])
    below = np.where(labels[..., None] > 0, grey[..., None], rgb)
    return np.rint(below * (1 - alpha) + above[..., :3] * alpha).astype(np.uint8)


def _occupied_points(volumes: Iterable[_Volume]) -> tuple[np.ndarray, VoxelGrid]:
    """Centres (n, 3) of the voxels that are occupied in any of the volumes, and the grid of the last volume."""
    occupied: dict[bytes, tuple[np.ndarray, VoxelGrid]] = {}
    for item in volumes:
        labels, grid = (item.labels, item.grid) if isinstance(item, Hypothesis) else item
        earlier = occupied.get(grid.key)
        occupied[grid.key] = ((labels > 0) if earlier is None else earlier[0] | (labels > 0), grid)
    return np.concatenate([g.centre_of(np.argwhere(mask)) for mask, g in occupied.values()]), grid


def close_up(volumes: Iterable[_Volume], camera: Camera) -> tuple[float, float, float, float]:
    """Part of the image that shows all occupied voxels, with a margin: x, y, width, height in pixels.

    The part has the proportions of the image. Without occupied voxels the part is the whole image.
    """
    size = np.array([camera.width, camera.height], float)
    uv = camera.project(_occupied_points(volumes)[0])[0]
    uv = np.clip(uv[np.isfinite(uv).all(axis=-1)], 0, size)
    if len(uv) == 0:
        return 0.0, 0.0, *size.tolist()
    lower, upper = uv.min(axis=0), uv.max(axis=0)
    share = float(np.clip(((upper - lower) / size).max() * 1.3 + 0.06, 0.2, 1))
    corner = np.clip((lower + upper - share * size) / 2, 0, (1 - share) * size)
    x, y, width, height = np.round([*corner, *(share * size)], 1).tolist()
    return x, y, width, height


def viewpoint(
    volumes: Iterable[_Volume], camera: Camera | None = None, width: int = 600, height: int = 450
) -> Camera:
    """A camera that looks down obliquely and shows the occupied voxels of all volumes.

    A volume is a hypothesis or a pair (labels, grid). If no voxel is occupied, the view shows the middle of the
    workspace. If `camera` is given, the view has the azimuth of `camera`, turned by 35 degrees.
    """
    points, grid = _occupied_points(volumes)
    if len(points) == 0:
        points = (grid.origin + grid.upper) / 2 * [1, 1, 0] + [[-0.15, -0.15, 0], [0.15, 0.15, 0.1]]
    points = np.concatenate([points, points * [1, 1, 0]])  # with the table below the objects
    target = (points.min(axis=0) + points.max(axis=0)) / 2

    away = np.array([0.0, -1.0, 0.0]) if camera is None else camera.position - target
    azimuth = np.arctan2(away[1], away[0]) - np.radians(35 if camera is not None else 0)
    elevation = np.radians(33)
    direction = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    focal = 2.6 * width  # a long lens: nearly parallel projection
    axes = look_at(target + direction, target).rotation.as_matrix()
    local = (points - target) @ axes
    middle = (local.min(axis=0) + local.max(axis=0)) / 2 * [1, 1, 0]
    target, local = target + axes @ middle, local - middle
    # At this distance every voxel is inside the picture, with a margin.
    half = 0.5 * np.array([width, height]) * 0.8
    distance = max(float((focal * np.abs(local[:, :2]) / half - local[:, 2:]).max()), 0.2)
    centre = ((width - 1) / 2, (height - 1) / 2)
    return Camera.from_intrinsics(
        focal, focal, *centre, width, height, look_at(target + direction * distance, target)
    )


def voxel_picture(labels: np.ndarray, grid: VoxelGrid, view: Camera, colours: Mapping[int, Colour]) -> np.ndarray:
    """Render voxels on the table plane as RGBA (view.height, view.width, 4) uint8, with a `view` from `viewpoint`."""
    camera = view.scaled(_RAYS)
    seen = render(labels, grid, camera)
    hit = seen.labels > 0
    light = _LIGHT @ _view_axes(camera)
    light = light / np.linalg.norm(light)

    rays = camera.rays() @ camera.pose.rotation.as_matrix().T
    depth = np.where(hit, seen.depth, 0.0)
    points = camera.position + rays * depth[..., None]
    colour = np.zeros((*hit.shape, 3))
    alpha = np.zeros(hit.shape)

    if hit.any():
        p, r = points[hit], rays[hit]
        normal = _normals(p, r, grid)
        axis = np.abs(normal) - 1
        diffuse = 0.5 + 0.5 * np.sign(normal) * light[axis]
        colour[hit] = _label_colours(seen.labels[hit], colours) * (0.43 + 0.57 * diffuse)[:, None]
        alpha[hit] = 1.0
        side = np.zeros(hit.shape, np.int64)
        side[hit] = normal + 8 * np.floor(np.abs(p[np.arange(len(p)), axis]) / grid.voxel_size + 0.5)
        crease, border = _lines(seen.labels, side, hit)
        colour *= np.where(border, 0.42, np.where(crease, 0.86, 1.0))[..., None]
    return _over(_reduced(colour, alpha, _RAYS), memo("report_table", (view.key,), lambda: _table(view)))


def _view_axes(camera: Camera) -> np.ndarray:
    """Axes of the view as rows: right, horizontally towards the camera, up."""
    R = camera.pose.rotation.as_matrix()
    right = R[:, 0] * np.array([1, 1, 0])
    right /= np.linalg.norm(right)
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([right, np.cross(right, up), up])


def _normals(points: np.ndarray, rays: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Signed axis (+-1, +-2, +-3) of the face that each ray hits: the axis of the nearest plane between voxels."""
    u = (points - grid.origin) / grid.voxel_size
    axis = np.abs(u - np.rint(u)).argmin(axis=1)
    return np.where(rays[np.arange(len(rays)), axis] > 0, -1, 1) * (axis + 1)


def _lines(labels: np.ndarray, side: np.ndarray, hit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels on the borders of faces within an object, and pixels on the borders of objects."""
    crease, border = np.zeros(hit.shape, bool), np.zeros(hit.shape, bool)
    for first, second in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        other = labels[first] != labels[second]
        border[first] |= other & hit[first]
        border[second] |= other & hit[second]
        crease[first] |= (side[first] != side[second]) & hit[first] & hit[second]
    return crease & ~border, border


def _table(view: Camera) -> np.ndarray:
    """Picture (H, W, 4) float of the plane z = 0: grey, translucent, with lines every 10 cm, fading at the border."""
    rays = view.rays() @ view.pose.rotation.as_matrix().T
    below = rays[..., 2] < -1e-6
    along = np.where(below, -view.position[2] / np.where(below, rays[..., 2], -1), 0)
    xy = (view.position + rays * along[..., None])[..., :2]
    # Lines are a pixel wide, with soft borders of half a pixel.
    pixel = along / view.K[0, 0]
    to_line = np.abs(xy / 0.1 - np.rint(xy / 0.1)).min(axis=-1) * 0.1
    line = np.clip(1.2 - to_line / np.maximum(pixel, 1e-9), 0, 1)
    y, x = np.mgrid[-1 : 1 : view.height * 1j, -1 : 1 : view.width * 1j]
    fade = np.clip((1.0 - np.hypot(x, y)) / 0.25, 0, 1)
    table = np.full((*fade.shape, 4), _TABLE_GREY)
    table[..., 3] = 255 * (0.13 + 0.16 * line) * np.where(below, fade * fade * (3 - 2 * fade), 0)
    return table


def _over(front: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Alpha composition of `front` over `back`, both RGBA pictures (H, W, 4) float, as uint8."""
    a, b = front[..., 3:] / 255, back[..., 3:] / 255
    alpha = a + b * (1 - a)
    rgb = (front[..., :3] * a + back[..., :3] * b * (1 - a)) / np.maximum(alpha, 1e-9)
    return np.rint(np.concatenate([np.clip(rgb, 0, 255), 255 * alpha], axis=-1)).astype(np.uint8)


def _reduced(colour: np.ndarray, alpha: np.ndarray, factor: int) -> np.ndarray:
    """Mean over blocks of `factor` x `factor` pixels, with colour weighted by opacity."""
    h, w = alpha.shape[0] // factor, alpha.shape[1] // factor
    blocks = (h, factor, w, factor)
    opacity = alpha.reshape(blocks).mean(axis=(1, 3))
    weighted = (colour * alpha[..., None]).reshape(*blocks, 3).mean(axis=(1, 3))
    rgb = weighted / np.maximum(opacity, 1e-9)[..., None]
    return np.concatenate([rgb, 255 * opacity[..., None]], axis=-1)

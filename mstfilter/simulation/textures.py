"""Textures in body coordinates: which chart a surface point lies on, and what is printed there.

A body's skin is a handful of flat charts (`draw_skin`), a point finds its chart and place by its body
coordinates and normal alone (`locate`), and an `Atlas` holds the charts of all bodies in one array, so
that shading is one gather. Charts are seen from outside with their upper edge up: text is never mirrored.

>>> import numpy as np
>>> from mstfilter.simulation.shapes import draw_shape
>>> from mstfilter.simulation.textures import draw_skin
>>> skin = draw_skin(np.random.default_rng(1), draw_shape(np.random.default_rng(0), "carton"))
>>> len(skin.charts), skin.gloss < 0.2
(7, True)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.simulation import printing
from mstfilter.simulation.pools import ANY, Pool
from mstfilter.simulation.shapes import Shape

__all__ = ["Atlas", "Skin", "draw_skin", "locate", "srgb_to_linear"]

SIDE, TOP, BOTTOM, INSIDE = range(4)


@dataclass(frozen=True, eq=False)
class Skin:
    """What a body looks like.

    Parameters
    ----------
    charts : tuple of (h, w, 3) uint8
        Six faces (-x, +x, -y, +y, -z, +z) or side, top, bottom, inside; then the plain colour.
    gloss : float
        Strength of the highlight, 0 .. 1.
    """

    charts: tuple[np.ndarray, ...]
    gloss: float


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Linear intensity of display values, both in 0 .. 1."""
    value = np.asarray(value, dtype=np.float32)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _face_axes(face: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors to the right and up on a face seen from outside."""
    normal = np.zeros(3)
    normal[face // 2] = 1.0 if face % 2 else -1.0
    up = np.array([0.0, 1.0, 0.0]) if face // 2 == 2 else np.array([0.0, 0.0, 1.0])
    return np.cross(up, normal), up


def chart_sizes(shape: Shape) -> list[tuple[float, float]]:
    """(width, height) in metres of each chart of a shape, the plain one left out."""
    if shape.print_as == "box":
        return [(2 * abs(r @ shape.half), 2 * abs(u @ shape.half)) for r, u in map(_face_axes, range(6))]
    across = 2 * float(min(shape.half[0], shape.half[1]))
    tall = 2 * float(shape.half[2])
    return [(np.pi * across, tall), (across, across), (across, across), (np.pi * across, tall)]


def locate(shape: Shape, points: np.ndarray, normals: np.ndarray, plain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Chart number (n,) and place (n, 2) in it, 0 .. 1 from its upper left corner.

    Parameters
    ----------
    shape : Shape
        Whose surface.
    points, normals : (n, 3)
        In the body's frame, metres; outward unit normals.
    plain : (n,) bool
        Points of pieces in plain colour.
    """
    place = np.zeros((len(points), 2), np.float32)
    if shape.print_as == "box":
        axis = np.argmax(np.abs(normals), axis=1)
        chart = 2 * axis + (normals[np.arange(len(points)), axis] > 0)
        for face in range(6):
            on = chart == face
            right, up = _face_axes(face)
            place[on, 0] = 0.5 + 0.5 * (points[on] @ right) / abs(right @ shape.half)
            place[on, 1] = 0.5 - 0.5 * (points[on] @ up) / abs(up @ shape.half)
        return np.where(plain, 6, chart), place
    radius = float(min(shape.half[0], shape.half[1]))
    outward = points[:, 0] * normals[:, 0] + points[:, 1] * normals[:, 1]
    chart = np.where(outward < 0, INSIDE, SIDE)
    chart = np.where(normals[:, 2] > 0.75, TOP, np.where(normals[:, 2] < -0.75, BOTTOM, chart))
    wall = (chart == SIDE) | (chart == INSIDE)
    place[:, 0] = np.where(
        wall,
        np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5,
        0.5 + 0.5 * points[:, 0] / radius * np.where(chart == BOTTOM, -1.0, 1.0),
    )
    place[:, 1] = 0.5 - 0.5 * np.where(wall, points[:, 2] / shape.half[2], points[:, 1] / radius)
    return np.where(plain, 4, chart), place


def draw_skin(rng: np.random.Generator, shape: Shape, pool: Pool = ANY) -> Skin:
    """A texture that suits the shape.

    Parameters
    ----------
    rng : numpy.random.Generator
        Draws everything.
    shape : Shape
        For the charts' sizes and the styles that suit it.
    pool : Pool
        Which hues and names occur.
    """
    style = shape.finish[int(rng.integers(len(shape.finish)))]
    sizes = chart_sizes(shape)
    pair = (printing.shade(rng, pool=pool), printing.shade(rng, (0.55, 0.95), 0.65, pool))
    words = printing.brand(rng, pool)
    gloss = {"label": 0.30, "ceramic": 0.35, "carton": 0.12}.get(style, 0.04)
    if style == "carton":
        # The two broadest faces carry front and back, the narrow upright ones the sides.
        wide = sorted(range(4), key=lambda k: -sizes[k][0])[:2]
        charts = []
        for k, (w, h) in enumerate(sizes):
            role = "end" if k >= 4 else ("front" if k == wide[0] else "back" if k == wide[1] else "side")
            charts.append(printing.carton_face(rng, w, h, pair, words, role, pool))
    elif style == "label":
        metal = (176, 176, 180)
        ends = [
            printing.lid(rng, w, metal if k == 0 else pair[1], k == 0, pool)
            for k, (w, _) in enumerate([sizes[TOP]] * 2)
        ]
        top = ends[int(rng.integers(2))]
        charts = [printing.label_side(rng, *sizes[SIDE], pair, words, pool), top, ends[0]]
        charts.append(printing.glaze(rng, *sizes[INSIDE], pair, 0))
    elif style == "ceramic":
        pale = printing.shade(rng, (0.7, 0.95), 0.45, pool)
        motif = int(rng.integers(3))
        charts = [
            printing.glaze(rng, w, h, (pale, pair[0]), motif if k == SIDE else 0) for k, (w, h) in enumerate(sizes)
        ]
    elif style == "wood":
        tone = printing.wood(rng, 0.01, 0.01)[0, 0]
        charts = [printing.wood(rng, w, h, (int(tone[0]), int(tone[1]), int(tone[2]))) for w, h in sizes]
    elif style == "cloth":
        state = rng.bit_generator.state
        charts = []
        for w, h in sizes:
            rng.bit_generator.state = state  # the same weave on every face
            charts.append(printing.cloth(rng, w, h, pool))
    elif style == "peel":
        ripe = (int(rng.uniform(205, 228)), int(rng.uniform(175, 195)), int(rng.uniform(60, 95)))
        charts = [printing.peel(rng, w, h, ripe) for w, h in sizes]
    else:
        # Stone and foam: tones of one colour, not camouflage.
        r, g, b = (int(0.65 * first + 0.35 * second) for first, second in zip(*pair, strict=True))
        charts = [printing.speckle(rng, w, h, (pair[0], (r, g, b))) for w, h in sizes]
    plain = np.ascontiguousarray(np.broadcast_to(charts[0].reshape(-1, 3).mean(axis=0).astype(np.uint8), (2, 2, 3)))
    if style == "ceramic":
        plain = np.ascontiguousarray(np.broadcast_to(charts[INSIDE][0, 0], (2, 2, 3)))
    return Skin((*charts, plain), gloss)


class Atlas:
    """The charts of many skins in one array, at the resolution a camera can see.

    Parameters
    ----------
    skins : sequence of Skin
        Charts are numbered skin by skin.
    texel : float
        Metres a texel; charts are averaged down to it.
    """

    def __init__(self, skins: list[Skin], texel: float) -> None:
        import cv2

        shrink = printing.DOT / texel
        first: list[int] = []
        width: list[int] = []
        height: list[int] = []
        texels: list[np.ndarray] = []
        start = 0
        self.base: list[int] = []
        self.gloss = [skin.gloss for skin in skins]
        for skin in skins:
            self.base.append(len(width))
            for chart in skin.charts:
                size = (max(2, round(chart.shape[1] * shrink)), max(2, round(chart.shape[0] * shrink)))
                if shrink < 1 and size[0] <= chart.shape[1] and size[1] <= chart.shape[0]:
                    chart = cv2.resize(chart, size, interpolation=cv2.INTER_AREA)
                first.append(start)
                height.append(chart.shape[0])
                width.append(chart.shape[1])
                texels.append(chart.reshape(-1, 3))
                start += chart.shape[0] * chart.shape[1]
        self._first, self._width, self._height = np.array(first), np.array(width), np.array(height)
        self._texels = srgb_to_linear(np.concatenate(texels).astype(np.float32) / 255.0)

    def colour(self, skin: int, chart: np.ndarray, place: np.ndarray) -> np.ndarray:
        """(n, 3) float32 linear albedo at places (n, 2) of charts (n,) of a skin, interpolated bilinearly."""
        chart = chart + self.base[skin]
        w, h = self._width[chart], self._height[chart]
        x = np.clip(place[:, 0] * w - 0.5, 0, w - 1.001)
        y = np.clip(place[:, 1] * h - 0.5, 0, h - 1.001)
        x0, y0 = x.astype(np.int64), y.astype(np.int64)
        fx, fy = (x - x0).astype(np.float32)[:, None], (y - y0).astype(np.float32)[:, None]
        at = self._first[chart] + y0 * w + x0
        t = self._texels
        upper = t[at] * (1 - fx) + t[at + 1] * fx
        lower = t[at + w] * (1 - fx) + t[at + w + 1] * fx
        return upper * (1 - fy) + lower * fy

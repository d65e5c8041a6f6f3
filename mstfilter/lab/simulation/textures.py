"""Textures of objects, and the room around the objects.

The texture (`Skin`) of an object consists of a few flat images, called charts. From the position and the normal
of a surface point, `texture_coordinates` computes a chart and the coordinates in the chart. An `Atlas` holds the
texture images of all objects in one array. A chart shows the surface from outside with the upper edge up.

>>> import numpy as np
>>> from mstfilter.lab.simulation.shapes import draw_shape
>>> from mstfilter.lab.simulation.textures import draw_skin
>>> skin = draw_skin(np.random.default_rng(1), draw_shape(np.random.default_rng(0), "carton"))
>>> len(skin.charts), skin.gloss < 0.2
(7, True)

A `Room` consists of table top, floor, wall, light and exposure. `draw_room` draws a room for each scene.

>>> from mstfilter.lab.simulation.textures import draw_room
>>> room = draw_room(np.random.default_rng(0), texel=0.004)
>>> room.table.ndim, room.lamp.shape
(3, (4, 3))
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.lab.simulation import printing
from mstfilter.lab.simulation.shapes import ANY, Pool, Shape
from mstfilter.lab.simulation.world import TABLE

_SIDE, _TOP, _BOTTOM, _INSIDE = range(4)


@dataclass(frozen=True, eq=False)
class Skin:
    """Texture of a body: flat images (h, w, 3) uint8, called charts, and the strength of the highlight, 0 .. 1.

    Charts show six faces (-x, +x, -y, +y, -z, +z) or side, top, bottom and inside. The last chart has one colour.
    A body of several parts has a texture for each part.
    """

    charts: tuple[np.ndarray, ...]
    gloss: float
    parts: tuple[Skin, ...] = ()

    @property
    def surfaces(self) -> tuple[Skin, ...]:
        """The textures in the order of `Shape.surfaces`."""
        return self.parts or (self,)


def linear_light(image: np.ndarray) -> np.ndarray:
    """Linear intensity 0 .. 1, float32, of an sRGB image."""
    value = image.astype(np.float32) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _face_axes(face: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors to the right and up on a face seen from outside."""
    normal = np.zeros(3)
    normal[face // 2] = 1.0 if face % 2 else -1.0
    up = np.array([0.0, 1.0, 0.0]) if face // 2 == 2 else np.array([0.0, 0.0, 1.0])
    return np.cross(up, normal), up


def _chart_sizes(shape: Shape) -> list[tuple[float, float]]:
    """Width and height in metres of each texture image of a shape, except the image with one colour."""
    if shape.print_as == "box":
        return [(2 * abs(r @ shape.half), 2 * abs(u @ shape.half)) for r, u in map(_face_axes, range(6))]
    across = 2 * float(min(shape.half[0], shape.half[1]))
    tall = 2 * float(shape.half[2])
    return [(np.pi * across, tall), (across, across), (across, across), (np.pi * across, tall)]


def texture_coordinates(
    shape: Shape, points: np.ndarray, normals: np.ndarray, plain: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Texture image number (n,) and texture coordinates (n, 2) of surface points.

    `points`, in metres, and outward unit `normals` (n, 3) are in body axes. `plain` (n,) bool marks points without
    texture. Texture coordinates are 0 .. 1 from the upper left corner.
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
    chart = np.where(outward < 0, _INSIDE, _SIDE)
    chart = np.where(normals[:, 2] > 0.75, _TOP, np.where(normals[:, 2] < -0.75, _BOTTOM, chart))
    wall = (chart == _SIDE) | (chart == _INSIDE)
    place[:, 0] = np.where(
        wall,
        np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5,
        0.5 + 0.5 * points[:, 0] / radius * np.where(chart == _BOTTOM, -1.0, 1.0),
    )
    place[:, 1] = 0.5 - 0.5 * np.where(wall, points[:, 2] / shape.half[2], points[:, 1] / radius)
    return np.where(plain, 4, chart), place


def draw_skin(rng: np.random.Generator, shape: Shape, pool: Pool = ANY) -> Skin:
    """Draw a texture that is suitable for the shape, with hues and names from a pool."""
    style = shape.finish[int(rng.integers(len(shape.finish)))]
    sizes = _chart_sizes(shape)
    pair = (printing.shade(rng, pool=pool), printing.shade(rng, (0.55, 0.95), 0.65, pool))
    words = printing.brand(rng, pool)
    glosses = {"label": 0.30, "ceramic": 0.35, "glazed": 0.35, "carton": 0.12, "plain": 0.15, "metal": 0.40}
    gloss = glosses.get(style, 0.04)
    if style == "carton":
        # Front and back are on the two broadest upright faces, the sides on the narrow ones.
        wide = sorted(range(4), key=lambda k: -sizes[k][0])[:2]
        charts = []
        for k, (w, h) in enumerate(sizes):
            role = "end" if k >= 4 else ("front" if k == wide[0] else "back" if k == wide[1] else "side")
            charts.append(printing.carton_face(rng, w, h, pair, words, role, pool))
    elif style == "label":
        metal = (176, 176, 180)
        bottom = printing.lid(rng, sizes[_TOP][0], metal, True, pool)
        printed = printing.lid(rng, sizes[_TOP][0], pair[1], False, pool)
        top = (bottom, printed)[int(rng.integers(2))]
        side = printing.label_side(rng, *sizes[_SIDE], pair, words, pool)
        charts = [side, top, bottom, printing.glaze(rng, *sizes[_INSIDE], pair, 0)]
    elif style == "ceramic":
        pale = printing.shade(rng, (0.7, 0.95), 0.45, pool)
        motif = int(rng.integers(3))
        charts = [
            printing.glaze(rng, w, h, (pale, pair[0]), motif if k == _SIDE else 0) for k, (w, h) in enumerate(sizes)
        ]
    elif style == "glazed":
        # Of one colour: white, black or a hue.
        kind = float(rng.uniform())
        grey = int(rng.uniform(*((225, 250) if kind < 0.4 else (25, 60))))
        tone = printing.shade(rng, (0.3, 0.95), 0.7, pool) if kind > 0.55 else (grey, grey, grey - 3)
        charts = [printing.glaze(rng, w, h, (tone, tone), 0) for w, h in sizes]
    elif style == "wood":
        tone = printing.wood(rng, 0.01, 0.01)[0, 0]
        charts = [printing.wood(rng, w, h, (int(tone[0]), int(tone[1]), int(tone[2]))) for w, h in sizes]
    elif style == "cloth":
        state = rng.bit_generator.state
        charts = []
        for w, h in sizes:
            rng.bit_generator.state = state  # every face has the same weave
            charts.append(printing.cloth(rng, w, h, pool))
    elif style == "plain":
        # Handles, toys and tools: dark tones are as frequent as light ones.
        tone = printing.shade(rng, (0.08, 0.5) if rng.uniform() < 0.5 else (0.4, 0.95), 0.8, pool)
        charts = [printing.plastic(rng, w, h, tone) for w, h in sizes]
    elif style == "metal":
        grey = int(rng.uniform(95, 175))
        charts = [printing.metal(rng, w, h, grey) for w, h in sizes]
    elif style == "peel":
        ripe = (int(rng.uniform(205, 228)), int(rng.uniform(175, 195)), int(rng.uniform(60, 95)))
        charts = [printing.peel(rng, w, h, ripe) for w, h in sizes]
    else:
        # Stone and foam have tones of one colour.
        r, g, b = (int(0.65 * first + 0.35 * second) for first, second in zip(*pair, strict=True))
        charts = [printing.speckle(rng, w, h, (pair[0], (r, g, b))) for w, h in sizes]
    colour = charts[_INSIDE][0, 0] if style == "ceramic" else charts[0].reshape(-1, 3).mean(axis=0)
    plain = np.broadcast_to(colour.astype(np.uint8), (2, 2, 3))
    return Skin((*charts, plain), gloss)


def sliced(skin: Skin, axis: int, n: int) -> list[Skin]:
    """The texture of a box cut into n boxes of equal length along a body axis, from the lowest to the highest.

    The cut faces have the textures of the ends.
    """
    pieces: list[list[np.ndarray]] = [[] for _ in range(n)]
    for face in range(6):
        right, up = _face_axes(face)
        chart = skin.charts[face]
        if face // 2 == axis:
            parts = [chart] * n
        elif right[axis]:
            parts = np.array_split(chart, n, axis=1)[:: int(np.sign(right[axis]))]
        else:
            parts = np.array_split(chart, n, axis=0)[:: -int(np.sign(up[axis]))]
        for piece, part in zip(pieces, parts, strict=True):
            piece.append(np.ascontiguousarray(part))
    return [Skin((*charts, skin.charts[-1]), skin.gloss) for charts in pieces]


class Atlas:
    """The texture images of many objects in one array, averaged to pixels of `texel` metres."""

    def __init__(self, skins: list[Skin], texel: float) -> None:
        import cv2

        shrink = printing.DOT / texel
        texels: list[np.ndarray] = []
        self._base = np.cumsum([0, *(len(skin.charts) for skin in skins)])
        self.gloss = [skin.gloss for skin in skins]
        for chart in (chart for skin in skins for chart in skin.charts):
            size = (max(2, round(chart.shape[1] * shrink)), max(2, round(chart.shape[0] * shrink)))
            if shrink < 1 and size[0] <= chart.shape[1] and size[1] <= chart.shape[0]:
                chart = cv2.resize(chart, size, interpolation=cv2.INTER_AREA)
            texels.append(chart)
        self._height, self._width = np.array([chart.shape[:2] for chart in texels]).T
        self._first = np.cumsum([0, *(self._height * self._width)[:-1]])
        self._texels = linear_light(np.concatenate([chart.reshape(-1, 3) for chart in texels]))

    def colour(self, skin: int, chart: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Linear albedo (n, 3) float32 of a texture, interpolated at the coordinates `place` (n, 2)."""
        chart = chart + self._base[skin]
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


@dataclass(frozen=True, eq=False)
class Room:
    """Table, floor, wall and lights around a scene. Colours are linear, float32."""

    table: np.ndarray  #: (h, w, 3) albedo of the table top, row 0 at its far edge
    rim: np.ndarray  #: (3,) albedo of the table's edge
    floor: np.ndarray  #: (3,) albedo of the floor
    wall: np.ndarray  #: (3,) albedo of the wall
    carpet: np.ndarray  #: (n, n) relative brightness of a tile of the floor, which is repeated
    lamp: np.ndarray  #: (k, 3) metres, point sources of the lamp; several make soft shadows
    lamp_colour: np.ndarray  #: (3,) irradiance of the whole lamp on a surface that faces the lamp
    sky: np.ndarray  #: (m, 3) metres, point sources of the ceiling, for diffuse light from above
    sky_colour: np.ndarray  #: (3,) irradiance of the whole ceiling
    ambient: np.ndarray  #: (3,) irradiance without direction
    exposure: np.ndarray  #: (3,) gain of each channel: exposure and white balance


def _table_top(rng: np.random.Generator, texel: float) -> np.ndarray:
    width, depth = 2 * TABLE[0][0], 2 * TABLE[0][1]
    kind = int(rng.integers(4))
    if kind == 3:  # laminate
        grey = int(rng.uniform(150, 205))
        tones = ((grey, grey, int(grey * 0.97)), (grey + 8, grey + 7, grey + 4))
        return printing.speckle(rng, width, depth, tones, texel)
    beech, oak, walnut = (222, 200, 176), (196, 168, 134), (124, 102, 82)
    colour = (beech, oak, walnut)[kind]
    jitter = rng.uniform(0.94, 1.05) * rng.uniform(0.985, 1.015, 3)
    r, g, b = (int(min(255.0, c * j)) for c, j in zip(colour, jitter, strict=True))
    return printing.wood(rng, width, depth, (r, g, b), texel)


def draw_room(rng: np.random.Generator, texel: float) -> Room:
    """Draw the surroundings of a scene. `texel` is the pixel size of the table's texture in metres."""
    table = linear_light(_table_top(rng, texel))
    side = -1.0 if rng.uniform() < 0.5 else 1.0
    centre = np.array([side * rng.uniform(0.35, 0.8), rng.uniform(-0.7, 0.1), rng.uniform(1.3, 1.7)])
    spread = rng.uniform(0.08, 0.14)
    corners = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]) * spread
    angle = np.arange(4) * (2 * np.pi / 4) + rng.uniform(0, 2 * np.pi)
    ring = np.stack([1.6 * np.cos(angle), 1.6 * np.sin(angle), np.full(4, 1.5)], axis=1)
    warm = np.array([1.0, rng.uniform(0.93, 1.0), rng.uniform(0.82, 0.98)])
    tile = 1.0 + 0.06 * printing.noise(rng, (256, 256), (40, 40), 5)
    # Exposure: the table gets a middle to light tone, with some error.
    light = 1.05
    tone = float(rng.uniform(0.42, 0.58)) if table.mean() > 0.25 else float(rng.uniform(0.24, 0.36))
    gain = tone / (float(table.mean()) * light)
    balance = rng.uniform(0.97, 1.03, 3)
    grey = rng.uniform(0.16, 0.4) * rng.uniform(0.92, 1.08, 3)

    def single(values: np.ndarray) -> np.ndarray:
        return np.asarray(values, dtype=np.float32)

    return Room(
        table=table,
        rim=single(0.6 * table.mean(axis=(0, 1))),
        floor=single(grey),
        wall=single(rng.uniform(0.45, 0.65) * rng.uniform(0.95, 1.05, 3)),
        carpet=single(tile),
        lamp=centre + corners,
        lamp_colour=single(rng.uniform(0.45, 0.8) * warm),
        sky=np.concatenate([ring, [[0.0, 0.0, 2.2]]]),
        sky_colour=single(0.60 * rng.uniform(0.96, 1.04, 3)),
        ambient=single(np.full(3, 0.12)),
        exposure=single(gain * balance),
    )

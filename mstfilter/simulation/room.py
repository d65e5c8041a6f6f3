"""What surrounds the objects: table top, floor, wall, lamps, exposure; drawn anew for every scene.

>>> import numpy as np
>>> from mstfilter.simulation.room import draw_room
>>> room = draw_room(np.random.default_rng(0), texel=0.004)
>>> room.table.ndim, room.lamp.shape
(3, (4, 3))
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.simulation import printing
from mstfilter.simulation.textures import srgb_to_linear
from mstfilter.simulation.world import TABLE

__all__ = ["Room", "draw_room"]


@dataclass(frozen=True, eq=False)
class Room:
    """Surroundings of a scene. Colours are linear.

    Parameters
    ----------
    table : (h, w, 3) float32
        Albedo of the table top, row 0 at its far edge.
    rim, floor, wall : (3,) float32
        Albedo of the table's edge, the floor and the wall.
    carpet : (n, n) float32
        Relative brightness of the floor, a tile repeated.
    lamp : (k, 3) metres
        Points of the lamp; several make soft shadows.
    lamp_colour : (3,) float32
        Irradiance of the whole lamp on a surface that faces it.
    sky : (m, 3) metres
        Points of the ceiling, for soft light from above.
    sky_colour : (3,) float32
        Irradiance of the whole ceiling.
    ambient : (3,) float32
        Light from everywhere.
    exposure : (3,) float32
        Gain of each channel: exposure and white balance.
    """

    table: np.ndarray
    rim: np.ndarray
    floor: np.ndarray
    wall: np.ndarray
    carpet: np.ndarray
    lamp: np.ndarray
    lamp_colour: np.ndarray
    sky: np.ndarray
    sky_colour: np.ndarray
    ambient: np.ndarray
    exposure: np.ndarray


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
    """Surroundings of a new scene; `texel` is the resolution of the table top in metres."""
    table = srgb_to_linear(_table_top(rng, texel).astype(np.float32) / 255.0)
    side = -1.0 if rng.uniform() < 0.5 else 1.0
    centre = np.array([side * rng.uniform(0.35, 0.8), rng.uniform(-0.7, 0.1), rng.uniform(1.3, 1.7)])
    spread = rng.uniform(0.08, 0.14)
    corners = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]) * spread
    angle = np.arange(4) * (2 * np.pi / 4) + rng.uniform(0, 2 * np.pi)
    ring = np.stack([1.6 * np.cos(angle), 1.6 * np.sin(angle), np.full(4, 1.5)], axis=1)
    warm = np.array([1.0, rng.uniform(0.93, 1.0), rng.uniform(0.82, 0.98)])
    tile = 1.0 + 0.06 * printing.noise(rng, (256, 256), (40, 40), 5)
    # The exposure meter: the table comes out at a middle to light tone, with some error.
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

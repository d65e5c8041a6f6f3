"""Shapes for training: many kinds of objects with sizes over a broad range.

The simulated scenes of the studies draw from a catalogue of household objects (`mstfilter.lab.simulation.shapes`).
Training draws from these kinds instead, so a network does not learn the catalogue's sizes.

>>> shape = draw_training_shape(np.random.default_rng(0), "cone")
>>> shape.family
'cone'
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from mstfilter.lab.simulation.shapes import Shape
from mstfilter.lab.simulation.solids import Piece, box, capsule, cylinder, ellipsoid, frustum, hull, ring

_ANY_SIDE = ((1, 1.0), (2, 1.0), (3, 1.0), (-3, 0.5))
_UPRIGHT = ((3, 0.8), (-3, 0.1), (1, 0.1))


def _length(rng: np.random.Generator, low: float, high: float) -> float:
    """A length, uniform on a logarithmic scale."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _block(rng: np.random.Generator) -> list[Piece]:
    a, b, c = (_length(rng, 0.016, 0.11) for _ in range(3))
    return [box((a, b, c))]


def _can(rng: np.random.Generator) -> list[Piece]:
    return [cylinder(_length(rng, 0.018, 0.085), _length(rng, 0.014, 0.12))]


def _cone(rng: np.random.Generator) -> list[Piece]:
    wide = _length(rng, 0.025, 0.085)
    return [frustum((wide, 0.0), (wide * rng.uniform(0.15, 0.9), _length(rng, 0.03, 0.22)))]


def _egg(rng: np.random.Generator) -> list[Piece]:
    size = _length(rng, 0.02, 0.065)
    a, b, c = (size * rng.uniform(0.7, 1.3) for _ in range(3))
    return [ellipsoid((a, b, c))]


def _pebble(rng: np.random.Generator) -> list[Piece]:
    """A superellipsoid."""
    points = rng.normal(size=(120, 3))
    points /= (np.abs(points) ** rng.uniform(2.2, 6.0)).sum(axis=1, keepdims=True) ** 0.25
    points = np.clip(points / np.abs(points).max(axis=0), -0.95, 0.95)
    return [hull(points * [_length(rng, 0.018, 0.085) for _ in range(3)])]


def _stone(rng: np.random.Generator) -> list[Piece]:
    """A random polytope."""
    points = rng.normal(size=(int(rng.integers(8, 25)), 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return [hull(points * [_length(rng, 0.025, 0.09) for _ in range(3)])]


def _pill(rng: np.random.Generator) -> list[Piece]:
    half = _length(rng, 0.02, 0.08)
    return [capsule((-half, 0, 0), (half, 0, 0), _length(rng, 0.012, 0.04))]


def _angle(rng: np.random.Generator) -> list[Piece]:
    """Two boxes at a right angle."""
    thick, deep = _length(rng, 0.012, 0.04), _length(rng, 0.015, 0.06)
    long, wide = (thick + _length(rng, 0.02, 0.12) for _ in range(2))
    return [
        box((long / 2, thick / 2, deep), (long / 2, thick / 2, 0)),
        box((thick / 2, (wide - thick) / 2, deep), (thick / 2, (wide + thick) / 2, 0)),
    ]


def _assembly(rng: np.random.Generator) -> list[Piece]:
    """Two to four boxes and cylinders, each joined to an earlier one."""
    pieces: list[Piece] = []
    at = np.zeros(3)
    for _ in range(int(rng.integers(2, 5))):
        half = np.array([_length(rng, 0.014, 0.06) for _ in range(3)])
        one = box(tuple(half), at) if rng.uniform() < 0.7 else cylinder(float(half[:2].mean()), float(half[2]), at)
        pieces.append(one)
        axis = int(rng.integers(3))
        at = at + np.sign(rng.uniform(-1, 1)) * half[axis] * np.eye(3)[axis] * 1.2 + rng.uniform(-0.01, 0.01, 3)
    return pieces


def _bottle(rng: np.random.Generator) -> list[Piece]:
    radius, body = _length(rng, 0.02, 0.05), _length(rng, 0.05, 0.16)
    neck, shoulder, cap = radius * rng.uniform(0.3, 0.7), _length(rng, 0.012, 0.05), _length(rng, 0.012, 0.05)
    return [
        cylinder(radius, body / 2, (0, 0, body / 2)),
        frustum((radius, body), (neck, body + shoulder)),
        cylinder(neck, cap / 2, (0, 0, body + shoulder + cap / 2)),
    ]


def _bowl(rng: np.random.Generator) -> list[Piece]:
    rim, height, wall = _length(rng, 0.04, 0.10), _length(rng, 0.025, 0.08), rng.uniform(0.008, 0.013)
    foot, bend = rim * rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.6)
    knee = foot + rng.uniform(0.5, 0.9) * (rim - foot)
    walls = ring([(foot - wall, foot, 0.0), (knee - wall, knee, bend * height), (rim - wall, rim, height)], 14)
    middle = foot - 0.5 * wall
    return [frustum((middle, 0.0), (middle + (knee - foot) * wall / (bend * height), wall)), *walls]


def _mug(rng: np.random.Generator) -> list[Piece]:
    radius, height, wall = _length(rng, 0.03, 0.06), _length(rng, 0.05, 0.13), rng.uniform(0.008, 0.013)
    upper = radius * rng.uniform(0.9, 1.2)
    pieces = ring([(radius - wall, radius, 0.0), (upper - wall, upper, height)], 14)
    pieces.append(cylinder(radius - 0.5 * wall, wall / 2, (0, 0, wall / 2)))
    if rng.uniform() < 0.6:
        turn = np.linspace(-np.pi / 2, np.pi / 2, 6)
        reach, tall = rng.uniform(0.02, 0.04), rng.uniform(0.25, 0.4) * height
        path = [(radius - 0.003 + reach * np.cos(a), 0.0, height / 2 + tall * np.sin(a)) for a in turn]
        pieces += [capsule(a, b, 0.0075) for a, b in pairwise(path)]
    return pieces


def _tube(rng: np.random.Generator) -> list[Piece]:
    outer, half = _length(rng, 0.025, 0.07), _length(rng, 0.012, 0.09)
    inner = max(outer - rng.uniform(0.009, 0.02), 0.2 * outer)
    return ring([(inner, outer, -half), (inner, outer, half)], 14)


def _hook(rng: np.random.Generator) -> list[Piece]:
    """A bent bar of round section."""
    bend, reach = _length(rng, 0.05, 0.15), np.deg2rad(rng.uniform(25, 70))
    turn = np.linspace(-reach, reach, 7)
    path = np.stack([bend * np.sin(turn), bend * (np.cos(turn) - 1.0), 0.0 * turn], axis=1)
    thick = _length(rng, 0.010, 0.025)
    ends = rng.uniform(0.5, 1.0)
    return [capsule(a, b, thick * r) for a, b, r in zip(path, path[1:], (ends, 0.9, 1, 1, 0.9, ends), strict=False)]


def _carton(rng: np.random.Generator) -> list[Piece]:
    return [box((_length(rng, 0.012, 0.035), _length(rng, 0.03, 0.085), _length(rng, 0.05, 0.12)))]


def _tile(rng: np.random.Generator) -> list[Piece]:
    """A book, a keyboard, or another flat box."""
    return [box((_length(rng, 0.025, 0.11), _length(rng, 0.04, 0.14), _length(rng, 0.005, 0.016)))]


def _rod(rng: np.random.Generator) -> list[Piece]:
    return [cylinder(_length(rng, 0.006, 0.016), _length(rng, 0.035, 0.11))]


def _tool(rng: np.random.Generator) -> list[Piece]:
    """A grip with a head at its end: a hammer, a brush, or a flat pan."""
    grip, thick = _length(rng, 0.04, 0.1), _length(rng, 0.007, 0.016)
    head = _length(rng, 0.012, 0.05), _length(rng, 0.012, 0.05), rng.uniform(0.8, 1.6) * thick
    round_head = rng.uniform() < 0.3
    end = cylinder(head[0], head[2], (grip + head[0], 0, 0)) if round_head else box(head, (grip + head[0], 0, 0))
    return [capsule((-grip, 0, 0), (grip, 0, 0), thick), end]


def _vase(rng: np.random.Generator) -> list[Piece]:
    """A vessel with a thin wall and a random profile."""
    height, wide = _length(rng, 0.05, 0.2), _length(rng, 0.025, 0.075)
    wall = rng.uniform(0.006, 0.012)
    radii = np.maximum(wide * rng.uniform(0.6, 1.0, 4), 2 * wall)
    levels = height * np.array([0.0, rng.uniform(0.2, 0.4), rng.uniform(0.55, 0.8), 1.0])
    walls = ring([(r - wall, r, z) for r, z in zip(radii.tolist(), levels.tolist(), strict=True)], 14)
    return [cylinder(radii[0] - 0.5 * wall, wall / 2, (0, 0, wall / 2)), *walls]


def _jug(rng: np.random.Generator) -> list[Piece]:
    """A large mug or a filled vessel, with a handle."""
    radius, height = _length(rng, 0.035, 0.075), _length(rng, 0.08, 0.2)
    wall, upper = rng.uniform(0.006, 0.012), radius * rng.uniform(0.6, 1.2)
    if rng.uniform() < 0.5:
        pieces = [frustum((radius, 0.0), (upper, height))]
    else:
        pieces = ring([(radius - wall, radius, 0.0), (upper - wall, upper, height)], 14)
        pieces.append(cylinder(radius - 0.5 * wall, wall / 2, (0, 0, wall / 2)))
    reach, tall, thick = rng.uniform(0.025, 0.05), rng.uniform(0.2, 0.4) * height, _length(rng, 0.006, 0.012)
    start, middle = min(radius, upper) - 0.003, rng.uniform(0.45, 0.6) * height
    turn = np.linspace(-np.pi / 2, np.pi / 2, 6)
    path = [(start + reach * np.cos(a), 0.0, middle + tall * np.sin(a)) for a in turn]
    return pieces + [capsule(a, b, thick) for a, b in pairwise(path)]


def _wedge(rng: np.random.Generator) -> list[Piece]:
    """A triangular prism."""
    long, wide, high = (_length(rng, 0.03, 0.14) for _ in range(3))
    top = rng.uniform(0, long)
    triangle = np.array([(0, 0), (long, 0), (top, high)])
    return [hull([(x, y, z) for x, z in triangle for y in (0, wide)])]


def _tee(rng: np.random.Generator) -> list[Piece]:
    """Two boxes in the form of a T."""
    thick, deep = _length(rng, 0.012, 0.035), _length(rng, 0.015, 0.06)
    bar, stem = _length(rng, 0.03, 0.08), _length(rng, 0.03, 0.12)
    return [box((bar, thick, deep)), box((thick, stem / 2, deep), (0, thick + stem / 2, 0))]


#: Kinds of shapes: maker, rest poses, and how often they are drawn.
_KINDS: dict[str, tuple[Callable[[np.random.Generator], list[Piece]], tuple[tuple[int, float], ...], float]] = {
    "block": (_block, _ANY_SIDE, 4.0),
    "can": (_can, _UPRIGHT, 3.0),
    "cone": (_cone, _UPRIGHT, 1.0),
    "egg": (_egg, _ANY_SIDE, 1.0),
    "pebble": (_pebble, _ANY_SIDE, 1.5),
    "stone": (_stone, _ANY_SIDE, 1.0),
    "pill": (_pill, ((3, 1.0),), 0.7),
    "angle": (_angle, _ANY_SIDE, 1.0),
    "assembly": (_assembly, _ANY_SIDE, 1.5),
    "bottle": (_bottle, _UPRIGHT, 1.5),
    "bowl": (_bowl, ((3, 0.8), (-3, 0.2)), 1.0),
    "mug": (_mug, ((3, 0.7), (-3, 0.15), (1, 0.15)), 1.0),
    "tube": (_tube, ((3, 0.6), (1, 0.4)), 0.6),
    "hook": (_hook, ((3, 1.0),), 0.7),
    "carton": (_carton, ((3, 0.6), (2, 0.2), (1, 0.2)), 2.0),
    "tile": (_tile, ((3, 0.85), (2, 0.1), (1, 0.05)), 1.2),
    "rod": (_rod, ((1, 0.8), (3, 0.2)), 0.7),
    "tool": (_tool, ((3, 1.0),), 0.8),
    "vase": (_vase, _UPRIGHT, 1.0),
    "jug": (_jug, _UPRIGHT, 1.0),
    "wedge": (_wedge, _ANY_SIDE, 1.0),
    "tee": (_tee, _ANY_SIDE, 1.0),
}

HELD_OUT = ("wedge", "tee")  #: Kinds that no network is trained on; they measure how it does on new shapes
THIN = ("bowl", "mug", "tube", "vase", "jug")  #: Kinds with walls that can be thinner than a voxel of 1 cm
TRAINED = tuple(kind for kind in _KINDS if kind not in HELD_OUT)


def draw_training_shape(rng: np.random.Generator, kind: str, scale: float = 1.0) -> Shape:
    """Draw a shape of a kind, with all lengths times `scale`. Its mass follows from 500 kg per cubic metre."""
    maker, rests, _ = _KINDS[kind]
    pieces = [_scaled(piece, scale) for piece in maker(rng)]
    mass = 500.0 * sum(piece.volume for piece in pieces)
    return Shape(kind, kind, pieces, max(mass, 0.02), "box", rests, ("speckle",), rolling=0.001)


def _scaled(piece: Piece, scale: float) -> Piece:
    vertices = None if piece.vertices is None else scale * piece.vertices
    size = tuple(scale * length for length in piece.size)
    return replace(piece, size=size, centre=scale * piece.centre, vertices=vertices)


def draw_kind(rng: np.random.Generator, kinds: tuple[str, ...]) -> str:
    """Draw one of some kinds, by how common they are."""
    share = np.array([_KINDS[kind][2] for kind in kinds])
    return kinds[int(rng.choice(len(kinds), p=share / share.sum()))]

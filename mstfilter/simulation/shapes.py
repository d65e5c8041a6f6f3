"""What scenes for tuning and scenes for reporting draw from: disjoint sizes, hues and printed names.

Both pools cover the same range in alternate bands, so that one is not harder than the other.

>>> import numpy as np
>>> from mstfilter.simulation.shapes import REPORTED, TUNING
>>> sizes = [[pool.factor(np.random.default_rng(k)) for k in range(99)] for pool in (TUNING, REPORTED)]
>>> len({int(s / 0.025) for s in sizes[0]} & {int(s / 0.025) for s in sizes[1]})
0


Families of household objects, made of convex pieces.

`draw_shape(rng, family)` gives a `Shape`: pieces in the frame of the body (origin at the middle of the
bounding box, z up in its main pose), the poses in which it rests, its mass and how print lies on it.

>>> import numpy as np
>>> from mstfilter.simulation.shapes import draw_shape
>>> shape = draw_shape(np.random.default_rng(0), "can")
>>> shape.n_pieces, shape.family
(1, 'can')

Sizes and masses follow objects of the YCB set (B. Calli, A. Walsman, A. Singh, S. Srinivasa, P. Abbeel, A. M. Dollar,
"Benchmarking in manipulation research: the YCB object and model set", IEEE Robotics & Automation Magazine 22(3),
2015, table of objects), rounded: cracker, sugar, pudding and gelatin box, soup, tuna and coffee can, mug, bowl,
banana, ball. Crisps are cut to 0.20 m (the set's can has 0.25 m). Tea, biscuits, bricks, bottle, soap and angle are
of our own making, of like size. Each measure is scaled by up to 10 %. Walls of bowl and mug are 1 cm, thicker than
the real ones: a thinner wall falls between the centres of 1 cm voxels and would be missing from the truth.


Volumetric truth: which voxels lie in which object, hidden ones included.

>>> import numpy as np
>>> from mstfilter.scene import VoxelGrid
>>> from mstfilter.simulation.shapes import draw_shape
>>> from mstfilter.simulation.shapes import label_voxels
>>> ball = draw_shape(np.random.default_rng(0), "ball")
>>> grid = VoxelGrid((-0.2, -0.2, -0.2), 0.01, (40, 40, 40))
>>> labels = label_voxels([ball], np.eye(4)[None], grid)
>>> bool(abs(labels.sum() * 1e-6 / ball.pieces[0].volume - 1) < 0.1)
True
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import VoxelGrid
from mstfilter.simulation.solids import Piece, box, capsule, cylinder, ellipsoid, frustum, hull, ring

__all__ = ["ANY", "FAMILIES", "Pool", "REPORTED", "Shape", "TUNING", "draw_shape", "label_voxels"]

_SMALLEST, _BAND = 0.90, 0.025
# Bands of sizes from 0.9 to 1.1 of each pool; both have mean 1.
_SIZE_BANDS = ((0, 3, 4, 7), (1, 2, 5, 6))
_N_HUES = 12
_MARGIN = 0.04  # of a band is left free at either side


@dataclass(frozen=True)
class Pool:
    """A part of all sizes, hues and names.

    Parameters
    ----------
    half : {0, 1, None}
        Which of the two disjoint parts; None for everything.
    """

    half: int | None = None

    def factor(self, rng: np.random.Generator) -> float:
        """By what a measure is scaled, 0.9 .. 1.1."""
        u = float(rng.uniform())
        if self.half is None:
            return _SMALLEST + 8 * _BAND * u
        bands = _SIZE_BANDS[self.half]
        k = int(u * len(bands))
        return _SMALLEST + _BAND * (bands[k] + _within(u * len(bands) - k))

    def hue(self, rng: np.random.Generator) -> float:
        """A hue, 0 .. 1."""
        u = float(rng.uniform())
        if self.half is None:
            return u
        k = int(u * _N_HUES / 2)
        return (2 * k + self.half + _within(u * _N_HUES / 2 - k)) / _N_HUES

    def name(self, rng: np.random.Generator, names: Sequence[str]) -> str:
        """One of the pool's names."""
        own = names if self.half is None else names[self.half :: 2]
        return own[int(rng.integers(len(own)))]


def _within(share: float) -> float:
    return _MARGIN + (1 - 2 * _MARGIN) * share


ANY, TUNING, REPORTED = Pool(), Pool(0), Pool(1)

WALL = 0.010

# Rest poses: which body axis points up (sign * (axis + 1)).
UP_X, UP_Y, UP_Z, DOWN_Z = 1, 2, 3, -3


@dataclass(frozen=True, eq=False)
class Shape:
    """A rigid object.

    Parameters
    ----------
    family : str
        One of FAMILIES.
    name : str
        Which member of the family.
    pieces : tuple of Piece
        Convex; their union is the object.
    half : (3,) metres
        Half edges of the bounding box, centred on the origin.
    mass : float
        Kilograms.
    print_as : {"box", "lathe"}
        How the texture is laid on: six faces, or side / top / bottom / inside of a turned solid.
    rests : tuple of (axis, weight)
        Which body axis points up when it is put down, with relative frequencies.
    finish : tuple of str
        Styles of texture that suit it.
    rolling : float
        Rolling friction, metres.
    """

    family: str
    name: str
    pieces: tuple[Piece, ...]
    half: np.ndarray
    mass: float
    print_as: str
    rests: tuple[tuple[int, float], ...]
    finish: tuple[str, ...]
    rolling: float = 0.0005

    @property
    def n_pieces(self) -> int:
        """Number of convex pieces."""
        return len(self.pieces)

    @property
    def radius(self) -> float:
        """Of a sphere about the origin that holds the object, metres."""
        return float(np.linalg.norm(self.half))

    @cached_property
    def density(self) -> float:
        """Mass over the sum of the pieces' volumes, kg / m^3."""
        return self.mass / sum(piece.volume for piece in self.pieces)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """(...) bool: points (..., 3) of the body's frame that lie in the object."""
        points = np.asarray(points)
        found = np.zeros(points.shape[:-1], bool)
        for piece in self.pieces:
            lower, upper = piece.bounds()
            near = ~found & (points >= lower - 1e-6).all(axis=-1) & (points <= upper + 1e-6).all(axis=-1)
            found[near] = piece.inside(points[near])
        return found


def _centred(pieces: list[Piece]) -> tuple[tuple[Piece, ...], np.ndarray]:
    bounds = [piece.bounds() for piece in pieces]
    lower = np.min([b[0] for b in bounds], axis=0)
    upper = np.max([b[1] for b in bounds], axis=0)
    middle = (lower + upper) / 2
    moved = tuple(Piece(p.kind, p.size, p.centre - middle, p.rotation, p.vertices, p.plain) for p in pieces)
    return moved, (upper - lower) / 2


def _make(
    family: str,
    name: str,
    pieces: list[Piece],
    mass: float,
    print_as: str,
    rests: tuple[tuple[int, float], ...],
    finish: tuple[str, ...],
    rolling: float = 0.0005,
) -> Shape:
    moved, half = _centred(pieces)
    return Shape(family, name, moved, half, mass, print_as, rests, finish, rolling)


def _choose(rng: np.random.Generator, table: Mapping[str, tuple[float, ...]]) -> tuple[str, tuple[float, ...]]:
    name = list(table)[int(rng.integers(len(table)))]
    return name, table[name]


def _carton(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    table = {
        "cracker": (0.060, 0.160, 0.210, 0.41),
        "sugar": (0.038, 0.089, 0.175, 0.51),
        "pudding": (0.035, 0.110, 0.089, 0.19),
        "gelatin": (0.028, 0.085, 0.073, 0.10),
        "tea": (0.070, 0.125, 0.080, 0.12),
    }
    name, (x, y, z, mass) = _choose(rng, table)
    half = (x * scale() / 2, y * scale() / 2, z * scale() / 2)
    # On its broad side, on its long narrow side, upright.
    rests = ((UP_X, 0.35), (UP_Y, 0.25), (UP_Z, 0.40))
    return _make("carton", name, [box(half)], mass, "box", rests, ("carton",))


def _brick(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    table = {"cube": (0.07, 0.07, 0.07), "brick": (0.05, 0.076, 0.10), "plank": (0.03, 0.09, 0.15)}
    name, edges = _choose(rng, table)
    x, y, z = (edge * scale() / 2 for edge in edges)
    mass = 600.0 * 8.0 * x * y * z
    rests = ((UP_X, 0.5), (UP_Y, 0.3), (UP_Z, 0.2))
    return _make("brick", name, [box((x, y, z))], mass, "box", rests, ("wood", "cloth", "speckle"))


def _can(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    table = {
        "soup": (0.033, 0.101, 0.35),
        "coffee": (0.051, 0.139, 0.41),
        "tuna": (0.0425, 0.033, 0.17),
        "crisps": (0.0375, 0.20, 0.21),
        "biscuits": (0.075, 0.055, 0.40),
    }
    name, (radius, height, mass) = _choose(rng, table)
    piece = cylinder(radius * scale(), height * scale() / 2)
    return _make("can", name, [piece], mass, "lathe", ((UP_Z, 1.0),), ("label",))


def _bottle(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    radius, body, neck = 0.034 * scale(), 0.115 * scale(), 0.014 * scale()
    shoulder, cap = 0.028, 0.030 * scale()
    knee = (0.80 * radius, body + 0.6 * shoulder)
    pieces = [
        cylinder(radius, body / 2, (0, 0, body / 2)),
        frustum((radius, body), knee),
        frustum(knee, (neck, body + shoulder)),
        cylinder(neck, cap / 2, (0, 0, body + shoulder + cap / 2)),
    ]
    return _make("bottle", "bottle", pieces, 0.35, "lathe", ((UP_Z, 1.0),), ("label",))


def _bowl(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    rim, height, foot = 0.0795 * scale(), 0.053 * scale(), 0.042 * scale()
    knee = foot + 0.68 * (rim - foot)
    walls = ring([(foot - WALL, foot, 0.0), (knee - WALL, knee, 0.45 * height), (rim - WALL, rim, height)])
    # The floor's rim lies in the middle of the sloping wall.
    middle = foot - 0.5 * WALL
    floor = frustum((middle, 0.0), (middle + (knee - foot) * WALL / (0.45 * height), WALL))
    return _make("bowl", "bowl", [floor, *walls], 0.25, "lathe", ((UP_Z, 0.8), (DOWN_Z, 0.2)), ("ceramic",))


def _mug(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    radius, height = 0.041 * scale(), 0.082 * scale()
    pieces = ring([(radius - WALL, radius, 0.0), (radius - WALL, radius, height)])
    pieces.append(cylinder(radius - 0.5 * WALL, WALL / 2, (0, 0, WALL / 2)))
    # Half a torus, as a chain of capsules; its ends reach into the wall.
    turn = np.linspace(-np.pi / 2, np.pi / 2, 6)
    reach, tall = 0.032, 0.32 * height
    path = [(radius - 0.003 + reach * np.cos(a), 0.0, height / 2 + tall * np.sin(a)) for a in turn]
    pieces += [capsule(a, b, 0.0075, plain=True) for a, b in pairwise(path)]
    return _make("mug", "mug", pieces, 0.20, "lathe", ((UP_Z, 0.85), (DOWN_Z, 0.15)), ("ceramic",))


def _ball(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    radius = 0.036 * scale()
    piece = ellipsoid((radius, radius, radius))
    return _make("ball", "ball", [piece], 0.10, "lathe", ((UP_Z, 1.0),), ("ceramic", "speckle"), rolling=0.003)


def _soap(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    # A superellipsoid |x/a|^e + |y/b|^e + |z/c|^e = 1: a bar of soap or a rounded flask.
    name, measures = _choose(rng, {"bar": (0.048, 0.032, 0.020), "flask": (0.042, 0.026, 0.075)})
    half = np.array([h * scale() for h in measures])
    azimuth, height = np.linspace(-np.pi, np.pi, 24, endpoint=False), np.linspace(-np.pi / 2, np.pi / 2, 13)
    a, b = np.meshgrid(azimuth, height[1:-1])
    round_ = np.stack([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)], axis=-1).reshape(-1, 3)
    round_ = np.concatenate([round_, [[0, 0, 1], [0, 0, -1]]])
    exponent = 4.0
    round_ /= (np.abs(round_) ** exponent).sum(axis=1, keepdims=True) ** (1.0 / exponent)
    # Cut flat where it would rock: real ones do not balance on a point.
    round_ = np.clip(round_, -0.94, 0.94) / 0.94
    mass = 800.0 * 6.0 * float(np.prod(half))
    return _make("soap", name, [hull(round_ * half)], mass, "box", ((UP_Y, 0.3), (UP_Z, 0.7)), ("speckle", "cloth"))


def _angle(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    thick, long, wide, deep = 0.035 * scale(), 0.12 * scale(), 0.085 * scale(), 0.05 * scale()
    pieces = [
        box((long / 2, thick / 2, deep / 2), (long / 2, thick / 2, 0)),
        box((thick / 2, (wide - thick) / 2, deep / 2), (thick / 2, (wide + thick) / 2, 0)),
    ]
    rests = ((UP_Z, 0.6), (UP_Y, 0.4))
    return _make("angle", "angle", pieces, 0.22, "box", rests, ("wood", "speckle", "cloth"))


def _banana(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    bend, reach = 0.105 * scale(), np.deg2rad(48.0)
    turn = np.linspace(-reach, reach, 8)
    path = np.stack([bend * np.sin(turn), bend * (np.cos(turn) - 1.0), 0.0 * turn], axis=1)
    thick = 0.018 * np.array([0.62, 0.88, 1.0, 1.0, 1.0, 0.88, 0.62])
    pieces = [capsule(a, b, r) for a, b, r in zip(path, path[1:], thick, strict=False)]
    return _make("banana", "banana", pieces, 0.12, "box", ((UP_Z, 1.0),), ("peel",), rolling=0.002)


_MAKERS: dict[str, Callable[[np.random.Generator, Callable[[], float]], Shape]] = {
    "carton": _carton,
    "can": _can,
    "bottle": _bottle,
    "bowl": _bowl,
    "mug": _mug,
    "brick": _brick,
    "soap": _soap,
    "angle": _angle,
    "ball": _ball,
    "banana": _banana,
}

FAMILIES: tuple[str, ...] = tuple(_MAKERS)
"""Names that `draw_shape` knows."""


def draw_shape(rng: np.random.Generator, family: str, pool: Pool = ANY) -> Shape:
    """A new member of a family.

    Parameters
    ----------
    rng : numpy.random.Generator
        Draws the member and its measures.
    family : str
        One of FAMILIES.
    pool : Pool
        Each measure is scaled by a factor drawn from it.

    Raises
    ------
    InputError
        If there is no such family.
    """
    if family not in _MAKERS:
        raise InputError(f"no family of shapes is called {family!r}", f"there are {', '.join(FAMILIES)}")
    return _MAKERS[family](rng, lambda: pool.factor(rng))


def label_voxels(shapes: Sequence[Shape], poses: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Labels (X, Y, Z) uint16: k + 1 where the voxel's centre lies in shape k, 0 where it lies in none.

    Parameters
    ----------
    shapes : sequence of Shape
        The objects.
    poses : (n, 4, 4)
        T_world_object of each.
    grid : VoxelGrid
        Workspace.

    Notes
    -----
    Objects at rest overlap by less than a millimetre; a centre that lies in two goes to the first.
    """
    labels = np.zeros(grid.shape, np.uint16)
    for k, (shape, pose) in enumerate(zip(shapes, poses, strict=True)):
        reach = np.abs(pose[:3, :3]) @ shape.half + grid.voxel_size
        low = np.maximum(grid.index_of(pose[:3, 3] - reach), 0)
        high = np.minimum(grid.index_of(pose[:3, 3] + reach) + 1, grid.shape)
        if (high <= low).any():
            continue
        box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
        index = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), -1)
        local = (grid.centre_of(index) - pose[:3, 3]) @ pose[:3, :3]
        free = labels[box] == 0
        labels[box][free & shape.inside(local)] = k + 1
    return labels

"""Household objects: shapes, sizes and voxels.

`draw_shape(rng, family)` returns a `Shape` with convex pieces in body axes, rest poses, mass and texture layout. The
origin of the body axes is the middle of the bounding box. In the upright pose, the z axis points up.

>>> import numpy as np
>>> from mstfilter.lab.simulation.shapes import draw_shape
>>> shape = draw_shape(np.random.default_rng(0), "can")
>>> len(shape.pieces), shape.family
(1, 'can')

Sizes and masses are rounded values of the YCB set (Calli et al., "Benchmarking in manipulation research: the YCB
object and model set", IEEE Robotics & Automation Magazine 22(3), 2015). The boxes of crackers, sugar, pudding and
gelatin, cans of soup, tuna and coffee, mug, bowl, banana and ball are from the YCB set. The crisps can is 0.20 m high
(0.25 m in the YCB set). Each length is scaled at random by up to 10 %. The walls of bowl and mug are 1 cm thick, as a
thinner wall could lie between the centres of 1 cm voxels.

A `Shape` can also be a mesh (`Shape.of_surface`), or several shapes that are one rigid body (`Shape.of_parts`), such
as a pack of cans.

`label_voxels` returns the true volume: all voxels of each object, visible or not. A voxel belongs to an object if

- its centre is inside the object, or
- a wall thinner than a voxel passes through it: let f be the share of the voxel that is inside, and F the largest
  share of a cube of the same size that contains the voxel's centre. The wall is thin if F < 0.7, and the voxel
  belongs to the object if also f >= 0.48 F.

Across a plane wall of any thickness, the second rule gives a layer of about one voxel (with 0.5, exactly one), so a
thin wall has no holes, and solid objects keep their volume. The inside of a mesh is a matter of the parity of rays
(`surfaces`). No wall of the objects that are made of pieces is thinner than 0.7 voxels of 1 cm, so for them the first
rule decides, and the second is not evaluated. With larger voxels, the walls of bowls and mugs may have holes.

>>> from mstfilter.scene import VoxelGrid
>>> from mstfilter.lab.simulation.shapes import label_voxels
>>> ball = draw_shape(np.random.default_rng(0), "ball")
>>> labels = label_voxels([ball], np.eye(4)[None], VoxelGrid((-0.2, -0.2, -0.2), 0.01, (40, 40, 40)))
>>> bool(abs(labels.sum() * 1e-6 / ball.pieces[0].volume - 1) < 0.1)
True
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.lab.simulation.solids import Piece, box, capsule, cylinder, ellipsoid, frustum, hull, placed, ring
from mstfilter.lab.simulation.surfaces import MeshSurface
from mstfilter.scene import VoxelGrid

_SMALLEST, _BAND = 0.90, 0.025
# Bands of sizes from 0.9 to 1.1 in each pool; both have mean 1.
_SIZE_BANDS = ((0, 3, 4, 7), (1, 2, 5, 6))
_N_HUES = 12
_MARGIN = 0.04  # share of a band that is left free at either side

_THIN = 0.7  # a wall is thin where no cube of the size of a voxel is filled to this share
_HALF = 0.48  # share of the largest share; at a half, a plane wall is one voxel thick, and rounding makes holes
_FINE = 4  # points a voxel and axis, for shares of volume
_WALL = 0.010  # thickness of the walls of bowl and mug, metres

# Rest poses: which body axis points up (sign * (axis + 1)).
_UP_X, _UP_Y, _UP_Z, _DOWN_Z = 1, 2, 3, -3


@dataclass(frozen=True)
class Pool:
    """A set of sizes, hues and names from which the objects of scenes are drawn.

    Scenes for tuning and scenes for reporting use disjoint pools. Both pools cover the same range of sizes in
    alternate bands, so that the pools are equally difficult.
    """

    half: int | None = None  #: {0, 1, None}: which of the two disjoint pools; None for all sizes, hues and names

    def factor(self, rng: np.random.Generator) -> float:
        """Random factor that scales a length, 0.9 .. 1.1."""
        u = float(rng.uniform())
        if self.half is None:
            return _SMALLEST + 8 * _BAND * u
        bands = _SIZE_BANDS[self.half]
        k = int(u * len(bands))
        return _SMALLEST + _BAND * (bands[k] + _within_band(u * len(bands) - k))

    def hue(self, rng: np.random.Generator) -> float:
        """A hue, 0 .. 1."""
        u = float(rng.uniform())
        if self.half is None:
            return u
        k = int(u * _N_HUES / 2)
        return (2 * k + self.half + _within_band(u * _N_HUES / 2 - k)) / _N_HUES

    def name(self, rng: np.random.Generator, names: Sequence[str]) -> str:
        """Draw one of the `names` that belong to the pool."""
        available = names if self.half is None else names[self.half :: 2]
        return available[int(rng.integers(len(available)))]


def _within_band(share: float) -> float:
    return _MARGIN + (1 - 2 * _MARGIN) * share


ANY, TUNING, REPORTED = Pool(), Pool(0), Pool(1)


@dataclass(frozen=True, eq=False)
class Shape:
    """A rigid object."""

    family: str  #: one of SHAPE_FAMILIES
    name: str  #: member of the family
    #: Convex pieces of the object, moved so that the bounding box of the object is centred on the origin.
    pieces: Sequence[Piece]
    mass: float  #: kilograms
    #: {"box", "lathe"}: layout of the texture: six faces, or side, top, bottom and inside of a turned solid.
    print_as: str
    #: tuple of (axis, weight) body axes that can point up at rest, with relative frequencies.
    rests: tuple[tuple[int, float], ...]
    finish: tuple[str, ...]  #: styles of texture that suit the object
    rolling: float = 0.0005  #: rolling friction, metres

    surface: MeshSurface | None = None  #: the mesh of an object that is not just its pieces
    scale: float = 1.0  #: size of the object divided by the size of the mesh
    parts: tuple[Part, ...] = ()  #: shapes that are one body

    half: np.ndarray = field(init=False)  #: Half edges (3,) of the bounding box, metres

    def __post_init__(self) -> None:
        if self.surface is not None:
            object.__setattr__(self, "half", self.scale * self.surface.half)
            return
        bounds = [piece.bounds() for piece in self.pieces]
        if self.parts:
            bounds = [part.bounds() for part in self.parts]
        lower, upper = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
        middle = (lower + upper) / 2
        moved = tuple(replace(piece, centre=piece.centre - middle) for piece in self.pieces)
        object.__setattr__(self, "pieces", moved)
        object.__setattr__(self, "half", (upper - lower) / 2)
        parts = tuple(replace(part, position=part.position - middle) for part in self.parts)
        object.__setattr__(self, "parts", parts)

    @classmethod
    def of_surface(
        cls, surface: MeshSurface, scale: float, family: str, name: str, mass: float, finish: tuple[str, ...]
    ) -> Shape:
        """The shape of a mesh, `scale` times as large as the mesh."""
        pieces = tuple(placed(piece, np.eye(3), np.zeros(3), scale) for piece in surface.pieces)
        print_as = "lathe" if finish[0] in ("label", "ceramic", "glazed") else "box"
        rolling = 0.004
        return cls(family, name, pieces, mass, print_as, ((_UP_Z, 1.0),), finish, rolling, surface, scale)

    @classmethod
    def of_parts(cls, family: str, name: str, parts: Sequence[Part]) -> Shape:
        """Several shapes that are one rigid body."""
        pieces = [placed(p, part.rotation, part.position) for part in parts for p in part.shape.pieces]
        mass, finish = sum(part.shape.mass for part in parts), parts[0].shape.finish
        return cls(family, name, pieces, mass, "box", ((_UP_Z, 1.0),), finish, parts=tuple(parts))

    @property
    def surfaces(self) -> tuple[Part, ...]:
        """The shapes with textures of their own: the parts of a body of several parts, or the shape itself."""
        return self.parts or (Part(self, np.eye(3), np.zeros(3)),)

    @cached_property
    def corners(self) -> np.ndarray:
        """Points (n, 3) in body axes whose convex hull contains the object."""
        if self.parts:
            return np.concatenate([p.shape.corners @ p.rotation.T + p.position for p in self.parts])
        if self.surface is not None:
            from scipy.spatial import ConvexHull

            vertices = self.scale * self.surface.vertices
            return np.asarray(vertices[ConvexHull(vertices).vertices])
        return np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * self.half

    @property
    def radius(self) -> float:
        """Radius in metres of a sphere about the origin that contains the object."""
        return float(np.linalg.norm(self.half))

    @cached_property
    def density(self) -> float:
        """Mass divided by the sum of the volumes of the pieces, kg / m^3."""
        return self.mass / sum(piece.volume for piece in self.pieces)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """(...) bool: whether points (..., 3) in body axes are in the object."""
        points = np.asarray(points)
        found = np.zeros(points.shape[:-1], bool)
        if self.parts:
            for part in self.parts:
                found |= part.shape.inside((points - part.position) @ part.rotation)
            return found
        if self.surface is not None:
            volume = self.surface.inside
            index = np.floor((points / self.scale - volume.origin) / volume.cell).astype(np.int64)
            valid = ((index >= 0) & (index < volume.share.shape)).all(axis=-1)
            found[valid] = volume.share[tuple(index[valid].T)] >= 0.5
            return found
        for piece in self.pieces:
            lower, upper = piece.bounds()
            near = ~found & (points >= lower - 1e-6).all(axis=-1) & (points <= upper + 1e-6).all(axis=-1)
            found[near] = piece.inside(points[near])
        return found


@dataclass(frozen=True, eq=False)
class Part:
    """A shape in a body of several parts."""

    shape: Shape
    rotation: np.ndarray  #: (3, 3) columns are the axes of the part in the body
    position: np.ndarray  #: (3,) metres: origin of the part in the body

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Minimum and maximum corner of a box in the body's frame that contains the part."""
        reach = np.abs(self.rotation) @ self.shape.half
        return self.position - reach, self.position + reach


def label_voxels(
    shapes: Sequence[Shape], poses: np.ndarray, grid: VoxelGrid, thin: Collection[int] = ()
) -> np.ndarray:
    """Labels (X, Y, Z) uint16: k + 1 for the voxels of shape k (see the definition above), and 0 for other voxels.

    `poses` (n, 4, 4) are T_world_object. Objects at rest overlap by less than a millimetre. A voxel of two objects
    gets the label of the object that has its centre, and otherwise of the first object. The rule of thin
    walls is for meshes, and for the shapes with the indices `thin`.
    """
    labels = np.zeros(grid.shape, np.uint16)
    walled: list[tuple[tuple[slice, ...], np.ndarray, int]] = []
    for k, (whole, pose) in enumerate(zip(shapes, poses, strict=True)):
        for part in whole.surfaces:
            turn = pose[:3, :3] @ part.rotation if whole.parts else pose[:3, :3]
            at = pose[:3, 3] + pose[:3, :3] @ part.position if whole.parts else pose[:3, 3]
            reach = np.abs(turn) @ part.shape.half + grid.voxel_size
            low = np.maximum(grid.index_of(at - reach), 0)
            high = np.minimum(grid.index_of(at + reach) + 1, grid.shape)
            if (high <= low).any():
                continue
            block = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
            labels[block][(labels[block] == 0) & _centres_inside(part.shape, turn, at, grid, low, high)] = k + 1
            if k in thin or part.shape.surface is not None:
                walled.append((block, _thin_walls(part.shape, turn, at, grid, low, high), k))
    for block, walls, k in walled:
        labels[block][(labels[block] == 0) & walls] = k + 1
    return labels


def _centres_inside(
    shape: Shape, turn: np.ndarray, at: np.ndarray, grid: VoxelGrid, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Which voxels from index `low` (3,) to `high` (3,) have their centres in a shape with pose (turn, at)."""
    if shape.surface is not None:
        first = turn.T @ (grid.centre_of(low) - at) / shape.scale
        step = grid.voxel_size / shape.scale
        return shape.surface.inside.resampled(first, turn.T, step, tuple(high - low)) >= 0.5
    index = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), -1)
    return shape.inside((grid.centre_of(index) - at) @ turn)


def _filled(
    shape: Shape, turn: np.ndarray, at: np.ndarray, origin: np.ndarray, step: float, size: tuple[int, ...]
) -> np.ndarray:
    """How far a raster of points (size) from `origin` (3,) on, in world axes, is inside a shape: 0 .. 1, float32."""
    if shape.surface is not None:
        first = turn.T @ (origin - at) / shape.scale
        return shape.surface.inside.resampled(first, turn.T, step / shape.scale, size, blur=True)
    filled = np.empty(size, np.float32)
    for i in range(size[0]):
        plane = np.stack(np.meshgrid([i], np.arange(size[1]), np.arange(size[2]), indexing="ij"), -1)
        filled[i : i + 1] = shape.inside((origin + step * plane - at) @ turn)
    return filled


def _thin_walls(
    shape: Shape, turn: np.ndarray, at: np.ndarray, grid: VoxelGrid, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Which voxels from index `low` (3,) to `high` (3,) a thin wall passes through."""
    from scipy.ndimage import maximum_filter, uniform_filter

    step = grid.voxel_size / _FINE
    first = grid.centre_of(low - 1) - (_FINE - 1) / 2 * step
    size = tuple(int(n) for n in (high - low + 2) * _FINE)
    # Entry i is the share of the cube of the points i .. i + 3, which is voxel low - 1 for i = 0.
    share = uniform_filter(_filled(shape, turn, at, first, step, size), _FINE, mode="constant", origin=-_FINE // 2)
    most = maximum_filter(share, _FINE + 1)
    voxels = tuple(slice(_FINE, -_FINE, _FINE) for _ in range(3))
    f, largest = share[voxels], most[voxels]
    return (largest < _THIN) & (f >= _HALF * largest) & (f > 0.01)


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
    rests = ((_UP_X, 0.35), (_UP_Y, 0.25), (_UP_Z, 0.40))
    return Shape("carton", name, [box(half)], mass, "box", rests, ("carton",))


def _brick(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    table = {"cube": (0.07, 0.07, 0.07), "brick": (0.05, 0.076, 0.10), "plank": (0.03, 0.09, 0.15)}
    name, edges = _choose(rng, table)
    x, y, z = (edge * scale() / 2 for edge in edges)
    mass = 600.0 * 8.0 * x * y * z
    rests = ((_UP_X, 0.5), (_UP_Y, 0.3), (_UP_Z, 0.2))
    return Shape("brick", name, [box((x, y, z))], mass, "box", rests, ("wood", "cloth", "speckle"))


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
    return Shape("can", name, [piece], mass, "lathe", ((_UP_Z, 1.0),), ("label",))


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
    return Shape("bottle", "bottle", pieces, 0.35, "lathe", ((_UP_Z, 1.0),), ("label",))


def _bowl(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    rim, height, foot = 0.0795 * scale(), 0.053 * scale(), 0.042 * scale()
    knee = foot + 0.68 * (rim - foot)
    walls = ring([(foot - _WALL, foot, 0.0), (knee - _WALL, knee, 0.45 * height), (rim - _WALL, rim, height)])
    # The floor's rim lies in the middle of the sloping wall.
    middle = foot - 0.5 * _WALL
    floor = frustum((middle, 0.0), (middle + (knee - foot) * _WALL / (0.45 * height), _WALL))
    return Shape("bowl", "bowl", [floor, *walls], 0.25, "lathe", ((_UP_Z, 0.8), (_DOWN_Z, 0.2)), ("ceramic",))


def _mug(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    radius, height = 0.041 * scale(), 0.082 * scale()
    pieces = ring([(radius - _WALL, radius, 0.0), (radius - _WALL, radius, height)])
    pieces.append(cylinder(radius - 0.5 * _WALL, _WALL / 2, (0, 0, _WALL / 2)))
    # Half a torus, as a chain of capsules; its ends reach into the wall.
    turn = np.linspace(-np.pi / 2, np.pi / 2, 6)
    reach, tall = 0.032, 0.32 * height
    path = [(radius - 0.003 + reach * np.cos(a), 0.0, height / 2 + tall * np.sin(a)) for a in turn]
    pieces += [capsule(a, b, 0.0075, plain=True) for a, b in pairwise(path)]
    return Shape("mug", "mug", pieces, 0.20, "lathe", ((_UP_Z, 0.85), (_DOWN_Z, 0.15)), ("ceramic",))


def _ball(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    radius = 0.036 * scale()
    piece = ellipsoid((radius, radius, radius))
    return Shape("ball", "ball", [piece], 0.10, "lathe", ((_UP_Z, 1.0),), ("ceramic", "speckle"), rolling=0.003)


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
    return Shape("soap", name, [hull(round_ * half)], mass, "box", ((_UP_Y, 0.3), (_UP_Z, 0.7)), ("speckle", "cloth"))


def _angle(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    thick, long, wide, deep = 0.035 * scale(), 0.12 * scale(), 0.085 * scale(), 0.05 * scale()
    pieces = [
        box((long / 2, thick / 2, deep / 2), (long / 2, thick / 2, 0)),
        box((thick / 2, (wide - thick) / 2, deep / 2), (thick / 2, (wide + thick) / 2, 0)),
    ]
    rests = ((_UP_Z, 0.6), (_UP_Y, 0.4))
    return Shape("angle", "angle", pieces, 0.22, "box", rests, ("wood", "speckle", "cloth"))


def _banana(rng: np.random.Generator, scale: Callable[[], float]) -> Shape:
    bend, reach = 0.105 * scale(), np.deg2rad(48.0)
    turn = np.linspace(-reach, reach, 8)
    path = np.stack([bend * np.sin(turn), bend * (np.cos(turn) - 1.0), 0.0 * turn], axis=1)
    thick = 0.018 * np.array([0.62, 0.88, 1.0, 1.0, 1.0, 0.88, 0.62])
    pieces = [capsule(a, b, r) for a, b, r in zip(path, path[1:], thick, strict=False)]
    return Shape("banana", "banana", pieces, 0.12, "box", ((_UP_Z, 1.0),), ("peel",), rolling=0.002)


def board(rng: np.random.Generator) -> Shape:
    """A cutting board."""
    half = (float(rng.uniform(0.14, 0.19)), float(rng.uniform(0.10, 0.13)), float(rng.uniform(0.006, 0.011)))
    return Shape(
        "board", "board", [box(half)], 5000 * float(np.prod(half)), "box", ((_UP_Z, 1.0),), ("wood", "plain")
    )


def tray(rng: np.random.Generator) -> Shape:
    """A tray with a rim."""
    x, y, z = float(rng.uniform(0.15, 0.20)), float(rng.uniform(0.11, 0.14)), float(rng.uniform(0.014, 0.022))
    wall = 0.005  # half of the thickness of floor and rim, metres
    pieces = [box((x, y, wall), (0, 0, wall))]
    pieces += [box((x, wall, z - wall), (0, s * (y - wall), z + wall)) for s in (-1, 1)]
    pieces += [box((wall, y - 2 * wall, z - wall), (s * (x - wall), 0, z + wall)) for s in (-1, 1)]
    return Shape("tray", "tray", pieces, 0.7, "box", ((_UP_Z, 1.0),), ("wood", "plain"))


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

SHAPE_FAMILIES: tuple[str, ...] = tuple(_MAKERS)  #: Names of the families of objects


def draw_shape(rng: np.random.Generator, family: str, pool: Pool = ANY) -> Shape:
    """Draw a member of one of `SHAPE_FAMILIES`. Each length is scaled by a random factor from the pool."""
    if family not in _MAKERS:
        raise InputError(f"unknown family of shapes {family!r}", f"known: {', '.join(SHAPE_FAMILIES)}")
    return _MAKERS[family](rng, lambda: pool.factor(rng))

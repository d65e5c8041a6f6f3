"""Groups: objects that stand together by hand, and bodies that look like several objects.

A group is a row (side by side), a stack (one on another) or a pack (a grid of equal things). What it looks like is
drawn first: two to six parts, equal or different. Then it is either *one*: a rigid body of all parts without gaps,
such as a box with two prints, a pack of cans or an object of two parts; or each part is an object, set down by hand:
offset by up to 1 cm, turned by up to 5 degrees, with gaps of up to 2 mm. The parameter `one_share` of a family is the
probability of one.

>>> import numpy as np
>>> from dataclasses import replace
>>> from mstfilter.lab.simulation.families import scene_family
>>> from mstfilter.lab.simulation.groups import draw_group
>>> from mstfilter.lab.simulation.shapes import ANY
>>> family = replace(scene_family("row"), one_share=1.0)
>>> group = draw_group(np.random.default_rng(0), family, ANY)
>>> group.one, len(group.shapes()) == 1, len(group.parts) >= 2
(True, True, True)

A push can tell one from several. `choose_group_push` looks for pushes with an aim: "apart" moves one part and not the
others (or, if the group is one, the whole), "together" moves all parts as one body, and "nothing" moves no group.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.lab.simulation.families import SceneFamily
from mstfilter.lab.simulation.objects import MeshPool, ObjectSet
from mstfilter.lab.simulation.shapes import Part, Pool, Shape, draw_shape
from mstfilter.lab.simulation.solids import box
from mstfilter.lab.simulation.textures import Skin, draw_skin, sliced
from mstfilter.lab.simulation.world import FingerPush, PhysicsWorld, draw_push, tried_pushes
from mstfilter.scene import Frame, Recording

_OFFSET, _TURN, _GAP = 0.01, np.deg2rad(5.0), 0.002  # largest errors of setting down by hand
_APART, _STILL = 0.010, 0.001  # metres: parts moved apart; nothing moved
_RIGID = 0.004  # metres: change of a distance in parts that moved as one body
_HIGHEST = 0.26  # top of a stack, metres
_UPRIGHT_KINDS = ("box", "can", "bottle", "cup", "other")  # kinds of meshes that stand in groups


def about_z(angle: float) -> np.ndarray:
    """Rotation (3, 3) about the z axis, radians."""
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Group:
    """Parts that stand together. The origin of the frame of the group is on the table, below its middle."""

    kind: str  #: "row", "stack" or "pack"
    parts: tuple[Part, ...]  #: in the frame of the group
    skins: tuple[Skin, ...]
    one: bool  #: whether the parts are one rigid body
    #: What the parts look like: equal with "one print" over all, with the "same print" or with "own prints"; or
    #: "different" parts.
    look: str
    objects: tuple[int, ...] = ()  #: indices of the objects in the scene: one for all parts, or one for each

    def shapes(self) -> list[Shape]:
        """The shapes of the objects."""
        return [self._body()] if self.one else [part.shape for part in self.parts]

    def skins_of_objects(self) -> list[Skin]:
        """The textures of the objects."""
        return [Skin((), self.skins[0].gloss, self.skins)] if self.one else list(self.skins)

    def _body(self) -> Shape:
        return Shape.of_parts(self.kind, f"one of {len(self.parts)}", self.parts)

    def poses(self) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Index, rotation (3, 3) and position (3,) of each object in the frame of the group."""
        if not self.one:
            return [(k, p.rotation, p.position) for k, p in zip(self.objects, self.parts, strict=True)]
        return [(self.objects[0], np.eye(3), self.parts[0].position - self._body().parts[0].position)]

    def part_poses(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (m, 3, 3) and positions (m, 3) of the parts in the world, from poses (n, 4, 4) of all objects."""
        if not self.one:
            own = poses[list(self.objects)]
            return own[:, :3, :3], own[:, :3, 3]
        pose, parts = poses[self.objects[0]], self._body().parts
        turns = np.array([pose[:3, :3] @ part.rotation for part in parts])
        return turns, np.array([pose[:3, :3] @ part.position + pose[:3, 3] for part in parts])

    def stands(self, poses: np.ndarray) -> bool:
        """Whether the parts are still within 8 mm of where they stood to each other, and upright."""
        _, at = self.part_poses(poses)
        meant = np.array([part.position for part in self.parts])
        distance = np.linalg.norm(at[:, None] - at[None], axis=2)
        planned = np.linalg.norm(meant[:, None] - meant[None], axis=2)
        height = np.abs(at[:, 2] - meant[:, 2]).max()
        return bool(np.abs(distance - planned).max() < 0.008 and height < 0.008)

    def describe(self) -> dict[str, Any]:
        """The group in the manifest of a recording: ids of objects, and each part in the frame of its object."""
        parts = self._body().parts if self.one else [Part(p.shape, np.eye(3), np.zeros(3)) for p in self.parts]
        owners = self.objects * (len(parts) if self.one else 1)
        described = [
            {
                "object": k + 1,
                "family": part.shape.family,
                "position_m": part.position.tolist(),
                "rotation": part.rotation.tolist(),
                "half_m": part.shape.half.tolist(),
            }
            for k, part in zip(owners, parts, strict=True)
        ]
        objects = [k + 1 for k in self.objects]
        return {"kind": self.kind, "one": self.one, "look": self.look, "objects": objects, "parts": described}


def _book(rng: np.random.Generator, pool: Pool) -> Shape:
    half = np.array([float(rng.uniform(0.010, 0.034)), 0.065 * pool.factor(rng), 0.10 * pool.factor(rng)]) / (2, 1, 1)
    mass = 700.0 * 8 * float(np.prod(half))
    return Shape(
        "book", "book", [box((half[0], half[1], half[2]))], mass, "box", ((1, 0.6), (2, 0.2), (3, 0.2)), ("carton",)
    )


def _small_box(rng: np.random.Generator, pool: Pool) -> Shape:
    x, y, z = (float(rng.uniform(*span)) * pool.factor(rng) for span in ((0.02, 0.045), (0.02, 0.045), (0.025, 0.08)))
    finish = ("carton", "plain", "wood")[int(rng.integers(3))]
    mass = 400.0 * 8 * x * y * z
    return Shape("box", "box", [box((x, y, z))], mass, "box", ((1, 0.2), (2, 0.2), (3, 0.6)), (finish,))


def _draw_part(
    rng: np.random.Generator,
    family: SceneFamily,
    pool: Pool,
    meshes: ObjectSet | None,
    mesh_pool: MeshPool,
    kind: str,
) -> Shape:
    if meshes is not None and rng.uniform() < family.mesh_share:
        return meshes.draw(rng, mesh_pool, _UPRIGHT_KINDS)
    if kind == "book":
        return _book(rng, pool)
    if kind == "box":
        return _small_box(rng, pool)
    return draw_shape(rng, kind, pool)


def _lay(up: int) -> np.ndarray:
    """The rotation (3, 3) that turns a body axis (sign * (axis + 1)) upwards."""
    x, y, z = np.eye(3)
    if up < 0:
        return np.diag([1.0, -1.0, -1.0])
    return np.array({1: (-z, y, x), 2: (x, -z, y), 3: (x, y, z)}[up])


def _draw_stance(rng: np.random.Generator, shape: Shape, flat: bool = False) -> np.ndarray:
    """A rest orientation (3, 3), turned by a multiple of 90 degrees; `flat`: with the shortest axis up."""
    ups, weights = [up for up, _ in shape.rests], np.array([w for _, w in shape.rests])
    up = ups[int(rng.choice(len(ups), p=weights / weights.sum()))]
    if flat:
        up = min(ups, key=lambda axis: shape.half[abs(axis) - 1])
    quarter = about_z(0.0) if rng.uniform() < 0.5 else np.rint(about_z(np.pi / 2))
    return np.asarray(quarter @ _lay(up))


def _extent(shape: Shape, rotation: np.ndarray) -> np.ndarray:
    """Half edges (3,) of the bounding box of a turned shape."""
    return np.asarray(np.abs(rotation) @ shape.half)


@dataclass(frozen=True)
class _Look:
    """Parts with their orientations and textures, before they are set down."""

    shapes: list[Shape]
    turns: list[np.ndarray]
    skins: list[Skin]
    name: str  #: see `Group.look`


def _draw_look(
    rng: np.random.Generator,
    kinds: Sequence[str],
    n: int,
    draw: Callable[[str], Shape],
    pool: Pool,
    axis: int,
    flat: bool = False,
) -> _Look:
    """`n` parts along an `axis` of the group. They are equal with probability one half.

    Equal boxes have one print that continues over all, a print of their own, or the same print.
    """
    kind = kinds[int(rng.integers(len(kinds)))]
    first = draw(kind)
    turn = _draw_stance(rng, first, flat)
    if rng.uniform() < 0.5:
        shapes, turns = [first] * n, [turn] * n
        way = int(rng.integers(3))
        if way == 0 and len(first.pieces) == 1 and first.pieces[0].kind == "box":
            along = turn[axis]  # the body axis along which the parts follow one another
            body = int(np.abs(along).argmax())
            half = first.half * np.where(np.arange(3) == body, n, 1)
            whole = Shape(first.family, first.name, [box((half[0], half[1], half[2]))], first.mass, "box",
                          first.rests, first.finish)  # fmt: skip
            skins = sliced(draw_skin(rng, whole, pool), body, n)[:: 1 if along[body] > 0 else -1]
            return _Look(shapes, turns, skins, "one print")
        skin = draw_skin(rng, first, pool)
        skins = [skin if way == 1 or k == 0 else draw_skin(rng, first, pool) for k in range(n)]
        return _Look(shapes, turns, skins, "same print" if way == 1 else "own prints")
    shapes = [first]
    while len(shapes) < n:
        shapes.append(draw(kind if rng.uniform() < 0.6 else kinds[int(rng.integers(len(kinds)))]))
    turns = [turn] + [_draw_stance(rng, shape, flat) for shape in shapes[1:]]
    return _Look(shapes, turns, [draw_skin(rng, shape, pool) for shape in shapes], "different")


def draw_group(
    rng: np.random.Generator,
    family: SceneFamily,
    pool: Pool,
    meshes: ObjectSet | None = None,
    mesh_pool: MeshPool = "all",
) -> Group:
    """Draw a group of the kind of the family, from generated objects, and from meshes if there are any."""

    def draw(kind: str) -> Shape:
        return _draw_part(rng, family, pool, meshes, mesh_pool, kind)

    one = bool(rng.uniform() < family.one_share)
    makers = {"row": _row, "stack": _stack, "pack": _pack}
    parts, skins, look = makers[family.groups](rng, draw, pool, one)
    middle = np.mean([part.position for part in parts], axis=0) * (1, 1, 0)
    parts = [Part(part.shape, part.rotation, part.position - middle) for part in parts]
    return Group(family.groups, tuple(parts), tuple(skins), one, look)


_Drawn = tuple[list[Part], list[Skin], str]


def _row(rng: np.random.Generator, draw: Callable[[str], Shape], pool: Pool, one: bool) -> _Drawn:
    n = 2 if rng.uniform() < 0.7 else 3
    look = _draw_look(rng, ("carton", "carton", "can", "book", "box"), n, draw, pool, 0)
    parts, edge = [], 0.0
    for k, (shape, turn) in enumerate(zip(look.shapes, look.turns, strict=True)):
        angle = float(rng.uniform(-_TURN, _TURN)) if k and not one else 0.0
        offset = float(rng.uniform(-_OFFSET, _OFFSET)) if k and not one else 0.0
        gap = float(rng.uniform(0.0003, _GAP)) if k and not one else 0.0
        half = _extent(shape, turn)
        reach = half[0] * np.cos(angle) + (half[1] * abs(np.sin(angle)) if shape.family != "can" else 0.0)
        # Fronts are in line, as when things are pushed against a ruler.
        front = half[1] - _extent(look.shapes[0], look.turns[0])[1]
        parts.append(Part(shape, about_z(angle) @ turn, np.array([edge + gap + reach, front + offset, half[2]])))
        edge += gap + 2 * reach
    return parts, look.skins, look.name


def _stack(rng: np.random.Generator, draw: Callable[[str], Shape], pool: Pool, one: bool) -> _Drawn:
    for _ in range(50):
        n = 2 if rng.uniform() < 0.75 else 3
        look = _draw_look(rng, ("carton", "book", "box", "can"), n, draw, pool, 2, flat=bool(rng.uniform() < 0.6))
        sizes = [_extent(shape, turn) for shape, turn in zip(look.shapes, look.turns, strict=True)]
        order = sorted(range(n), key=lambda k: -float(sizes[k][0] * sizes[k][1]))
        if len({id(shape) for shape in look.shapes}) == 1:
            order = list(range(n))
        wide = all((sizes[b][:2] <= sizes[a][:2] * 1.15).all() for a, b in pairwise(order))
        slender = sum(s[2] for s in sizes) / min(float(s[:2].min()) for s in sizes)
        if wide and slender < 6 and 2 * sum(s[2] for s in sizes) < _HIGHEST:
            break
    parts, height, at = [], 0.0, np.zeros(2)
    for level, k in enumerate(order):
        angle = float(rng.uniform(-_TURN, _TURN)) if level and not one else 0.0
        if level and not one:
            room = np.minimum(_OFFSET, 0.35 * sizes[k][:2])
            at = at + rng.uniform(-room, room)
        parts.append(Part(look.shapes[k], about_z(angle) @ look.turns[k], np.array([*at, height + sizes[k][2]])))
        height += 2 * sizes[k][2]
    return parts, [look.skins[k] for k in order], look.name


def _pack(rng: np.random.Generator, draw: Callable[[str], Shape], pool: Pool, one: bool) -> _Drawn:
    columns, rows = ((2, 1), (3, 1), (2, 2), (3, 2))[int(rng.choice(4, p=(0.15, 0.2, 0.3, 0.35)))]
    for _ in range(50):
        shape = draw(("can", "can", "bottle", "box", "carton")[int(rng.integers(5))])
        turn = _draw_stance(rng, shape)
        half = _extent(shape, turn)
        if half[0] < 0.06 and half[1] < 0.06 and half[2] / min(half[:2]) < 4:
            break
    skin = draw_skin(rng, shape, pool)
    alike = bool(rng.uniform() < 0.75)
    parts, skins = [], []
    step = 2 * half[:2] + (0.0 if one else 0.0003)
    for i in range(columns):
        for j in range(rows):
            at = step * (i, j)
            if not one:
                at = at + (i, j) * rng.uniform(0, _GAP, 2)
            angle = float(rng.uniform(0, 2 * np.pi)) if shape.family in ("can", "bottle") else 0.0
            spin = about_z(angle)
            parts.append(Part(shape, spin @ turn, np.array([*at, half[2]])))
            skins.append(skin if alike else draw_skin(rng, shape, pool))
    return parts, skins, "same print" if alike else "own prints"


def part_image(recording: Recording, frame: int) -> np.ndarray:
    """Which part each pixel of a frame shows (H, W) uint16: 1, 2, ... in the order of the groups and their parts.

    Parts of one body are told apart by their places in the manifest. Pixels without a group, and pixels of a group
    without a depth reading, are 0. With this image, the probability that two parts are one object can be asked of a
    filter, whether they are or not.
    """
    instance, image, poses = recording.instance(frame), recording.frames[frame], recording.poses(frame)
    if instance is None or poses is None:
        raise InputError(f"recording {recording.name} has no true poses and instances", "simulate it")
    return parts_in(image, instance, poses, recording.manifest.get("groups", []))


def parts_in(
    image: Frame, instance: np.ndarray, poses: Mapping[int, np.ndarray], groups: Sequence[Mapping[str, Any]]
) -> np.ndarray:
    """As `part_image`, from a frame with the object (H, W) of each pixel, poses (4, 4) of the objects, and groups."""
    points = image.camera.unproject(image.depth)
    found = np.zeros(instance.shape, np.uint16)
    number = 0
    for group in groups:
        best = np.full(instance.shape, np.inf)
        for part in group["parts"]:
            number += 1
            pose = poses[part["object"]]
            turn = pose[:3, :3] @ np.array(part["rotation"])
            at = pose[:3, :3] @ part["position_m"] + pose[:3, 3]
            with np.errstate(invalid="ignore"):
                outside = np.abs((points - at) @ turn) - part["half_m"]
                distance = outside.max(axis=-1)
                nearer = (instance == part["object"]) & (distance < best)
            best[nearer] = distance[nearer]
            found[nearer] = number
    return found


def choose_group_push(
    rng: np.random.Generator, world: PhysicsWorld, family: SceneFamily, groups: Sequence[Group], aim: str
) -> FingerPush:
    """Simulate candidate pushes and choose one with an aim (see above). The world does not change.

    If no candidate has the aim, a push is taken that moves some object. Raises InputError if there is none.
    """
    before = world.poses()
    fallback: FingerPush | None = None
    for push, result, after in tried_pushes(world, family, lambda: _draw_group_push(rng, world, family, groups, aim)):
        if any(_has_aim(group, before, after, aim) for group in groups) and (
            aim != "nothing" or all(_has_aim(group, before, after, aim) for group in groups)
        ):
            return push
        if fallback is None and result.moved(family.move_threshold):
            fallback = push
    if fallback is None:
        raise InputError(
            f"scene family {family.name!r}: none of {4 * family.n_candidates} pushes moves an object "
            "without dropping one",
            "raise push_speed, frames_per_clip or n_candidates",
        )
    return fallback


def _has_aim(group: Group, before: np.ndarray, after: np.ndarray, aim: str) -> bool:
    """Whether a group moved as the aim of a push says, from the poses (n, 4, 4) of all objects before and after."""
    turns, at = group.part_poses(before)
    new_turns, new_at = group.part_poses(after)
    moved = np.linalg.norm(new_at - at, axis=1)
    distance, new_distance = (np.linalg.norm(a[:, None] - a[None], axis=2) for a in (at, new_at))
    change = float(np.abs(new_distance - distance).max())
    if aim == "nothing":
        return bool(moved.max() < _STILL)
    if aim == "together":
        cosine = (np.einsum("nij,nij->n", turns, new_turns) - 1) / 2
        turned = np.arccos(np.clip(cosine, -1, 1))
        return bool(moved.min() > 2 * _APART and change < _RIGID and np.ptp(turned) < np.deg2rad(5))
    return bool(moved.max() > 2 * _APART) if group.one else bool(change > _APART)


def _draw_group_push(
    rng: np.random.Generator, world: PhysicsWorld, family: SceneFamily, groups: Sequence[Group], aim: str
) -> FingerPush:
    """A random push: towards the middle of a group, towards one of its parts, or towards any object."""
    push = draw_push(rng, world, family)
    if aim == "nothing":
        return push
    group = groups[int(rng.integers(len(groups)))]
    _, at = group.part_poses(world.poses())
    if aim == "apart":
        goal = at[int(rng.integers(len(at))), :2] + rng.uniform(-0.02, 0.02, 2)
        angle = float(rng.uniform(0, 2 * np.pi))
    else:
        goal = at[:, :2].mean(axis=0) + rng.uniform(-0.005, 0.005, 2)
        spread = at[:, :2] - at[:, :2].mean(axis=0)
        axis = np.linalg.svd(spread)[2][0] if np.abs(spread).max() > 0.01 else rng.standard_normal(2)
        angle = float(np.arctan2(axis[1], axis[0]) + np.pi * rng.integers(2) + rng.normal(0, 0.05))
    direction = np.array([np.cos(angle), np.sin(angle)])
    reach = float(np.abs((at[:, :2] - goal) @ direction).max())
    start = goal - direction * (reach + float(rng.uniform(0.08, 0.14)))
    end = start + direction * float(np.linalg.norm(np.subtract(push.end, push.start)))
    return FingerPush((float(start[0]), float(start[1])), (float(end[0]), float(end[1])), push.seconds)

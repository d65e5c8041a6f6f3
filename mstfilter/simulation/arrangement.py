"""Putting objects on the table: clusters, twins in contact, things on top of each other.

Each object is slid towards the cluster until it all but touches (bisection on MuJoCo's own contacts), so
that contact is designed and not left to chance; then physics settles the whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Camera
from mstfilter.simulation.families import SceneFamily
from mstfilter.simulation.shapes import Shape, draw_shape
from mstfilter.simulation.textures import Skin, draw_skin
from mstfilter.simulation.world import OBJECT_GROUP, World

__all__ = ["Things", "arrange", "draw_things"]

Stance = Literal["any", "tall", "low"]
"""Which of its rest poses a shape takes."""

TOUCH = 0.0003
"""Gap left between objects put in contact, metres; settling closes it."""

CENTRE = np.array([0.02, 0.02])
_ATTEMPTS = 30
_HIGHEST = 0.30  # of a stack, metres: the camera still sees its top
_PATIENCE = 4  # attempts before less is asked for
_HIDING_PLACES = 24


@dataclass(frozen=True)
class Things:
    """What lies on the table.

    Parameters
    ----------
    shapes : tuple of Shape
    skins : tuple of Skin
    twin_of : tuple of int
        Number of the object that this one repeats, -1 for none.
    """

    shapes: tuple[Shape, ...]
    skins: tuple[Skin, ...]
    twin_of: tuple[int, ...]


def draw_things(rng: np.random.Generator, family: SceneFamily) -> Things:
    """Shapes and textures of a scene. Kinds vary: none comes back before all others have been used."""
    count = int(rng.integers(family.n_objects_min, family.n_objects_max + 1))
    names = list(family.shape_families())
    shapes: list[Shape] = []
    skins: list[Skin] = []
    bag: list[str] = []
    while len(shapes) < count - family.n_twins:
        if not bag:
            # Packaging is what lies on tables: cartons and cans come more often.
            often = [name for name in names for _ in range({"carton": 3, "can": 2}.get(name, 0))]
            bag = [str(name) for name in rng.permutation(names + often)]
        shape = draw_shape(rng, bag.pop(), family.pool)
        shapes.append(shape)
        skins.append(draw_skin(rng, shape, family.pool))
    twin_of = [-1] * len(shapes)
    # Twins are of kinds that print makes recognisable and that stand firmly.
    fit = [k for k, s in enumerate(shapes) if s.family not in ("bowl", "ball")] or list(range(len(shapes)))
    for _ in range(family.n_twins):
        original = fit[int(rng.integers(len(fit)))]
        shapes.append(shapes[original])
        skins.append(skins[original])
        twin_of.append(original)
    return Things(tuple(shapes), tuple(skins), tuple(twin_of))


def _rest(rng: np.random.Generator, shape: Shape, stance: Stance = "any") -> tuple[np.ndarray, float]:
    """An orientation in which the shape rests, and the height of its origin above what it stands on."""
    from scipy.spatial.transform import Rotation

    weights = np.array([w for _, w in shape.rests])
    up = shape.rests[int(rng.choice(len(weights), p=weights / weights.sum()))][0]
    if stance != "any":
        ordered = sorted((axis for axis, _ in shape.rests), key=lambda axis: shape.half[abs(axis) - 1])
        up = ordered[-1 if stance == "tall" else 0]
    axis = abs(up) - 1
    turn = {0: ("y", -90.0), 1: ("x", 90.0), 2: ("x", 0.0 if up > 0 else 180.0)}[axis]
    lay = Rotation.from_euler(turn[0], turn[1], degrees=True)
    yaw = Rotation.from_euler("z", float(rng.uniform(0, 2 * np.pi)))
    return (yaw * lay).as_matrix(), float(shape.half[axis])


def _standing_height(shape: Shape) -> float:
    """How high the shape is at most, at rest, metres."""
    return 2 * max(float(shape.half[abs(axis) - 1]) for axis, _ in shape.rests)


def _slide_in(world: World, k: int, goal: np.ndarray, angle: float, height: float, rotation: np.ndarray) -> float:
    """Least distance from `goal` along a direction at which object k overlaps nothing, metres.

    Found by stepping inwards until the first overlap and bisecting.
    """
    direction = np.array([np.cos(angle), np.sin(angle)])

    def free(distance: float) -> bool:
        world.place(k, (*(goal + distance * direction), height), rotation)
        world.forward()
        return not world.overlaps(k)

    out = 0.02
    while not free(out):
        out += 0.05
    inner = out - 0.006
    while inner > 0 and free(inner):
        out, inner = inner, inner - 0.006
    inner = max(inner, 0.0)
    for _ in range(7):
        middle = (out + inner) / 2
        out, inner = (middle, inner) if free(middle) else (out, middle)
    return out


def _farthest(world: World) -> float:
    """Radius of the patch of table on which the objects lie, metres."""
    return min(0.32, 0.20 + 0.012 * world.n_objects)


def _beside(
    rng: np.random.Generator,
    world: World,
    k: int,
    neighbours: list[int],
    gap: float,
    towards: np.ndarray | None = None,
    attempts: int = _ATTEMPTS,
    stance: Stance = "any",
) -> bool:
    """Put object k next to one of its `neighbours`, `gap` metres from what it meets first.

    `towards` (2,): about in which direction from the neighbour; by default any.
    """
    start = world.positions()[k].copy()
    for _ in range(attempts):
        near = neighbours[int(rng.integers(len(neighbours)))]
        goal = world.positions()[near, :2]
        rotation, height = _rest(rng, world.shapes[k], stance)
        angle = float(rng.uniform(0, 2 * np.pi))
        if towards is not None:
            angle = float(np.arctan2(towards[1], towards[0]) + rng.normal(0.0, 0.2))
        distance = _slide_in(world, k, goal, angle, height + 0.0002, rotation)
        place = goal + (distance + gap) * np.array([np.cos(angle), np.sin(angle)])
        world.place(k, (*place, height + 0.0002), rotation)
        world.forward()
        reach = world.shapes[k].radius + world.shapes[near].radius
        if distance < reach and np.linalg.norm(place - CENTRE) < _farthest(world) and not world.overlaps(k):
            return True
    world.place(k, start, np.eye(3))
    return False


def _on_top(rng: np.random.Generator, world: World, k: int, placed: list[int]) -> bool:
    """Put object k on a flat object that is broad enough, if there is one."""
    start = world.positions()[k].copy()
    flat = [j for j in placed if world.shapes[j].family in ("carton", "brick", "can", "angle")]
    for j in rng.permutation(flat) if flat else []:
        below = world.poses()[j]
        top = below[2, 3] + float(np.abs(below[2, :3]) @ world.shapes[j].half)
        rotation, height = _rest(rng, world.shapes[k])
        if top > 0.16 or top + 2 * height > _HIGHEST:
            continue
        place = below[:2, 3] + rng.uniform(-0.01, 0.01, 2)
        world.place(k, (*place, top + height + 0.0005), rotation)
        world.forward()
        if not world.overlaps(k):
            return True
    world.place(k, start, np.eye(3))
    return False


def _height(world: World, k: int) -> float:
    """How high above the table an object reaches, metres."""
    pose = world.poses()[k]
    return float(pose[2, 3] + np.abs(pose[2, :3]) @ world.shapes[k].half)


def _visible(world: World, camera: Camera) -> np.ndarray:
    """(n,) pixels of each object that a camera sees."""
    turn = camera.pose.as_matrix()[:3, :3]
    geom, _, _ = world.cast(np.array(camera.position), camera.rays().reshape(-1, 3) @ turn.T, (OBJECT_GROUP,))
    return np.bincount(world.geom_object[geom[geom >= 0]], minlength=world.n_objects + 1)[1 : world.n_objects + 1]


def _behind(rng: np.random.Generator, world: World, k: int, placed: list[int], camera: Camera) -> bool:
    """Put object k behind one of the tallest where the camera sees it least, if there is room."""
    start, best = world.positions()[k].copy(), None
    tallest = sorted(placed, key=lambda j: -_height(world, j))[:5]
    for _ in range(_HIDING_PLACES):
        near = tallest[int(rng.integers(len(tallest)))]
        away = world.positions()[near, :2] - np.array(camera.position)[:2]
        if not _beside(rng, world, k, [near], TOUCH, away, 1, "low"):
            continue
        seen = int(_visible(world, camera)[k])
        if best is None or seen < best[0]:
            best = (seen, world.positions()[k].copy(), world.rotations()[k])
        if seen == 0:
            break
    world.place(k, *(best[1:] if best else (start, np.eye(3))))
    world.forward()
    return best is not None


def _try(
    rng: np.random.Generator, world: World, family: SceneFamily, twin_of: tuple[int, ...], need: tuple[int, int]
) -> bool:
    originals = [int(k) for k in rng.permutation([k for k, t in enumerate(twin_of) if t < 0])]
    twins = [k for k, t in enumerate(twin_of) if t >= 0]
    stacked = originals[len(originals) - min(family.n_stacked, len(originals) - 1) :] if family.n_stacked else []
    # What is to be hidden is small and stands on the table; it comes when the tall ones are there.
    lone = [k for k in originals if k not in stacked and k not in twin_of]
    hidden = sorted(lone, key=lambda k: world.shapes[k].radius)[: min(family.n_hidden, len(lone) - 1)]
    standing = [k for k in originals if k not in stacked and k not in hidden]
    walls = sorted(standing, key=lambda k: -_standing_height(world.shapes[k]))[: len(hidden)]
    camera = family.camera().scaled(160 / family.width)
    placed: list[int] = []
    order: list[int] = []
    for k in originals:
        if k not in stacked and k not in hidden:
            order += [k, *(t for t in twins if twin_of[t] == k)]
    order += [t for k in stacked for t in (k, *(t for t in twins if twin_of[t] == k))]
    order += hidden
    for k in order:
        if not placed:
            rotation, height = _rest(rng, world.shapes[k], "tall" if k in walls else "any")
            world.place(k, (*(CENTRE + rng.uniform(-0.05, 0.05, 2)), height + 0.0002), rotation)
        elif twin_of[k] >= 0:
            if not _beside(rng, world, k, [twin_of[k]], TOUCH):
                return False
        elif k in hidden:
            if not (_behind(rng, world, k, placed, camera) or _beside(rng, world, k, placed, TOUCH)):
                return False
        elif not (k in stacked and _on_top(rng, world, k, placed)):
            gap = TOUCH if rng.uniform() < family.contact else float(rng.uniform(0.01, 0.04))
            if not _beside(rng, world, k, placed, gap, stance="tall" if k in walls else "any"):
                return False
        placed.append(k)
    world.forward()
    if not world.settle():
        return False
    at = world.positions()
    if not family.holds(at).all() or world.deepest_overlap() > 0.0015:
        return False
    if family.n_hidden:
        unseen = int((_visible(world, camera) == 0).sum())
        if unseen < need[1] or unseen > world.n_objects / 3:
            return False
    touching = {(c.first, c.second) for c in world.contacts()}
    return sum((min(k, t), max(k, t)) in touching for k, t in enumerate(twin_of) if t >= 0) >= need[0]


def arrange(rng: np.random.Generator, world: World, family: SceneFamily, twin_of: tuple[int, ...]) -> None:
    """Place all objects and let them come to rest; twins touch each other (in a dense heap, most do).

    Raises
    ------
    InputError
        If the objects do not fit on the table in many attempts.
    """
    empty = world.save()
    twins = sum(t >= 0 for t in twin_of)
    for attempt in range(_ATTEMPTS):
        world.restore(empty)
        # In a dense heap settling may part some twins or show what was hidden: then fewer will do.
        patient = attempt < _PATIENCE
        touching = (twins if twins < 3 else twins - 1) if patient else (twins + 1) // 2
        hidden = (family.n_hidden + 1) // 2 if attempt < 2 * _PATIENCE else 0
        need = touching, hidden
        if _try(rng, world, family, twin_of, need):
            return
    raise InputError(
        f"scene family {family.name!r}: {world.n_objects} objects could not be arranged in {_ATTEMPTS} attempts",
        "ask for fewer or smaller objects, or fewer twins",
    )

"""Placement of objects on the table: clusters, pairs of touching identical objects (twins), stacks, hidden objects.

Each object is moved towards the cluster until the object nearly touches another object. The position is found by
bisection with MuJoCo's contact test. After placement, the physics runs until all objects are at rest. Groups of
objects (`groups`) are placed first, as they stand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.lab.simulation.families import SceneFamily
from mstfilter.lab.simulation.groups import Group, about_z, draw_group
from mstfilter.lab.simulation.objects import MeshPool
from mstfilter.lab.simulation.shapes import Pool, Shape, board, draw_shape, tray
from mstfilter.lab.simulation.surfaces import MeshSurface
from mstfilter.lab.simulation.textures import Skin, draw_skin
from mstfilter.lab.simulation.world import MESH_GROUP, OBJECT_GROUP, PhysicsWorld, Wall
from mstfilter.scene import Camera

_RestPose = Literal["any", "tall", "low"]  # which of its rest poses a shape takes

_TOUCH = 0.0003  # gap between objects put in contact, metres; settling closes it
_CENTRE = np.array([0.02, 0.02])
_ATTEMPTS = 30
_PATIENCE = 4  # attempts with all requirements
_HIDING_PLACES = 24
_HIGHEST = 0.30  # top of a stack, metres: still in view


@dataclass(frozen=True)
class SceneObjects:
    """Shapes and textures of the objects of a scene."""

    shapes: tuple[Shape, ...]
    skins: tuple[Skin, ...] = ()
    twin_of: tuple[int, ...] = ()  #: For each object, the index of the object that it copies, or -1; empty for none
    groups: tuple[Group, ...] = ()  #: objects that stand together; they come first
    n_dropped: int = 0  #: number of objects that fall onto others; they come last
    base: bool = False  #: whether the first object is a board or tray on which others stand
    wall: Wall | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "twin_of", self.twin_of or (-1,) * len(self.shapes))


def draw_objects(
    rng: np.random.Generator, family: SceneFamily, pool: Pool, mesh_pool: MeshPool = "all"
) -> SceneObjects:
    """Draw the shapes and textures of a scene, from all families of objects. Most frequent are cartons and cans.

    Objects are meshes of `mesh_pool` if the family has a folder of meshes.
    """
    count = int(rng.integers(family.n_objects_min, family.n_objects_max + 1))
    names = list(family.shape_families())
    meshes = family.object_set()
    shapes: list[Shape] = []
    skins: list[Skin] = []
    wall = None
    base = False
    if family.furniture and rng.uniform() < family.furniture:
        kind = int(rng.integers(3))
        if kind == 0:
            wall = draw_wall(rng)
        else:
            base = True
            shapes.append(board(rng) if kind == 1 else tray(rng))
            skins.append(draw_skin(rng, shapes[0], pool))
    groups: list[Group] = []
    for _ in range(family.n_groups):
        group = draw_group(rng, family, pool, meshes, mesh_pool)
        new = range(len(shapes), len(shapes) + (1 if group.one else len(group.parts)))
        groups.append(replace(group, objects=tuple(new)))
        shapes += group.shapes()
        skins += group.skins_of_objects()
    others = len(shapes)
    bag: list[str] = []
    while len(shapes) - others < count - family.n_twins - family.n_groups:
        if meshes is not None and rng.uniform() < family.mesh_share:
            shape = meshes.draw(rng, mesh_pool, but=tuple(s.name for s in shapes))
        else:
            if not bag:
                # Cartons and cans, which are common on tables, are more frequent.
                extra = [name for name in names for _ in range({"carton": 3, "can": 2}.get(name, 0))]
                bag = [str(name) for name in rng.permutation(names + extra)]
            shape = draw_shape(rng, bag.pop(), pool)
        shapes.append(shape)
        skins.append(draw_skin(rng, shape, pool))
    twin_of = [-1] * len(shapes)
    # Twins have a recognisable texture and stand firmly.
    fit = [k for k, s in enumerate(shapes) if k >= others and s.family not in ("bowl", "ball")]
    fit = fit or list(range(others, len(shapes)))
    for _ in range(family.n_twins):
        original = fit[int(rng.integers(len(fit)))]
        shapes.append(shapes[original])
        skins.append(skins[original])
        twin_of.append(original)
    return SceneObjects(tuple(shapes), tuple(skins), tuple(twin_of), tuple(groups), family.n_dropped, base, wall)


def draw_wall(rng: np.random.Generator) -> Wall:
    """A wall behind the objects, or to their left or right."""
    height = float(rng.uniform(0.15, 0.35))
    if rng.uniform() < 0.6:
        return Wall((0.8, 0.01, height), (0.0, float(rng.uniform(0.40, 0.55)), height))
    side = -1.0 if rng.uniform() < 0.5 else 1.0
    return Wall((0.01, 0.5, height), (side * float(rng.uniform(0.40, 0.5)), 0.2, height))


def _draw_rest_pose(rng: np.random.Generator, shape: Shape, pose: _RestPose = "any") -> tuple[np.ndarray, float]:
    """A rest orientation (3, 3) of a shape, and the height of its origin above the support."""
    from scipy.spatial.transform import Rotation

    if shape.surface is not None:
        rotation = _mesh_pose(rng, shape.surface, pose)
        return rotation, float(-(shape.corners @ rotation.T)[:, 2].min())
    weights = np.array([w for _, w in shape.rests])
    up = shape.rests[int(rng.choice(len(weights), p=weights / weights.sum()))][0]
    if pose != "any":
        ordered = sorted((axis for axis, _ in shape.rests), key=lambda axis: shape.half[abs(axis) - 1])
        up = ordered[-1 if pose == "tall" else 0]
    axis = abs(up) - 1
    turn = {0: ("y", -90.0), 1: ("x", 90.0), 2: ("x", 0.0 if up > 0 else 180.0)}[axis]
    lay = Rotation.from_euler(turn[0], turn[1], degrees=True)
    yaw = Rotation.from_euler("z", float(rng.uniform(0, 2 * np.pi)))
    return (yaw * lay).as_matrix(), float(shape.half[axis])


def _mesh_pose(rng: np.random.Generator, surface: MeshSurface, pose: _RestPose) -> np.ndarray:
    """An orientation (3, 3) of a mesh: most often upright or on a side, seldom in a pose in which it cannot rest."""
    from scipy.spatial.transform import Rotation

    drawn, yaw = float(rng.uniform()), about_z(float(rng.uniform(0, 2 * np.pi)))
    stances = surface.stances
    if not stances or (pose == "any" and drawn > 0.95):
        return Rotation.random(random_state=rng).as_matrix()
    ups, tilts = np.array([up for up, _ in stances]), np.array([tilt for _, tilt in stances])
    if pose != "any":
        heights = np.array([np.ptp(surface.vertices @ up) for up in ups])
        chosen = int(heights.argmax() if pose == "tall" else heights.argmin())
        return yaw @ _turn_up(ups[chosen])
    upright = np.flatnonzero(ups[:, 2] > np.cos(np.deg2rad(30)))
    if drawn < 0.7 and len(upright):
        return yaw @ _turn_up(ups[upright[int(ups[upright, 2].argmax())]])
    sides = np.flatnonzero(np.abs(ups[:, 2]) < 0.7)
    sides = sides if len(sides) else np.arange(len(ups))
    weights = np.minimum(tilts[sides], 1.0)
    return yaw @ _turn_up(ups[sides[int(rng.choice(len(sides), p=weights / weights.sum()))]])


def _turn_up(up: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) that turns a unit vector upwards."""
    from scipy.spatial.transform import Rotation

    axis = np.cross(up, (0.0, 0.0, 1.0))
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        return np.diag([1.0, np.sign(up[2]), np.sign(up[2])])
    return Rotation.from_rotvec(axis / length * np.arctan2(length, up[2])).as_matrix()


def _contact_distance(
    world: PhysicsWorld, k: int, goal: np.ndarray, angle: float, height: float, rotation: np.ndarray
) -> float:
    """Smallest distance in metres from `goal`, in direction `angle`, at which object k overlaps no other object.

    The distance is found by steps inwards until the first overlap, and then by bisection.
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


def _put_beside(
    rng: np.random.Generator,
    world: PhysicsWorld,
    k: int,
    neighbours: list[int],
    gap: float,
    towards: np.ndarray | None = None,
    attempts: int = _ATTEMPTS,
    pose: _RestPose = "any",
) -> bool:
    """Move object k towards one of `neighbours`, up to `gap` metres from the first object on the path.

    `towards` (2,) is the approximate direction from the neighbour, or None for any direction.
    """
    table_radius = min(0.32, 0.20 + 0.012 * world.n_objects)
    start = world.positions()[k]
    for _ in range(attempts):
        near = neighbours[int(rng.integers(len(neighbours)))]
        goal = world.positions()[near, :2]
        rotation, height = _draw_rest_pose(rng, world.shapes[k], pose)
        angle = float(rng.uniform(0, 2 * np.pi))
        if towards is not None:
            angle = float(np.arctan2(towards[1], towards[0]) + rng.normal(0.0, 0.2))
        distance = _contact_distance(world, k, goal, angle, height + 0.0002, rotation)
        place = goal + (distance + gap) * np.array([np.cos(angle), np.sin(angle)])
        world.place(k, (*place, height + 0.0002), rotation)
        world.forward()
        reach = world.shapes[k].radius + world.shapes[near].radius
        if distance < reach and np.linalg.norm(place - _CENTRE) < table_radius and not world.overlaps(k):
            return True
    world.place(k, start, np.eye(3))
    return False


def _put_on_top(rng: np.random.Generator, world: PhysicsWorld, k: int, placed: list[int]) -> bool:
    """Put object k on top of a flat object if there is room."""
    start = world.positions()[k]
    flat = [j for j in placed if world.shapes[j].family in ("carton", "brick", "can", "angle", "box", "book")]
    for j in rng.permutation(flat) if flat else []:
        below, top = world.positions()[j], _top(world, j)
        rotation, height = _draw_rest_pose(rng, world.shapes[k])
        if top > 0.16 or top + 2 * height > _HIGHEST:
            continue
        place = below[:2] + rng.uniform(-0.01, 0.01, 2)
        world.place(k, (*place, top + height + 0.0005), rotation)
        world.forward()
        if not world.overlaps(k):
            return True
    world.place(k, start, np.eye(3))
    return False


def _top(world: PhysicsWorld, k: int) -> float:
    """Height of the top of an object above the table, metres."""
    pose, shape = world.poses()[k], world.shapes[k]
    if shape.surface is not None:
        return float(pose[2, 3] + (shape.corners @ pose[2, :3]).max())
    return float(pose[2, 3] + np.abs(pose[2, :3]) @ shape.half)


def _drop(rng: np.random.Generator, world: PhysicsWorld, k: int, placed: list[int]) -> bool:
    """Hold object k just above another object, so that it falls into, onto or against the other one."""
    from scipy.spatial.transform import Rotation

    start = world.positions()[k]
    for j in rng.permutation(placed):
        top = _top(world, int(j))
        rotation, _ = _draw_rest_pose(rng, world.shapes[k])
        rotation = Rotation.from_rotvec(rng.normal(0, 0.35, 3)).as_matrix() @ rotation
        corners = world.shapes[k].corners @ rotation.T
        wide = 0.5 * float(np.linalg.norm(world.shapes[int(j)].half[:2]))
        place = world.positions()[j, :2] + rng.uniform(-wide, wide, 2)
        if top + np.ptp(corners[:, 2]) > _HIGHEST:
            continue
        world.place(k, (*place, top - corners[:, 2].min() + 0.003), rotation)
        world.forward()
        if not world.overlaps(k):
            return True
    world.place(k, start, np.eye(3))
    return False


def _put_on_base(rng: np.random.Generator, world: PhysicsWorld, k: int, base: int) -> bool:
    """Put object k on a free place of a board or tray."""
    start, shape = world.positions()[k], world.shapes[base]
    floor = _top(world, base) - 2 * shape.half[2] + min(p.bounds()[1][2] + shape.half[2] for p in shape.pieces)
    for _ in range(8):
        rotation, height = _draw_rest_pose(rng, world.shapes[k])
        turn = world.rotations()[base]
        local = rng.uniform(-0.8, 0.8, 2) * shape.half[:2]
        place = world.positions()[base, :2] + turn[:2, :2] @ local
        world.place(k, (*place, floor + height + 0.0005), rotation)
        world.forward()
        if not world.overlaps(k):
            return True
    world.place(k, start, np.eye(3))
    return False


def _put_apart(rng: np.random.Generator, world: PhysicsWorld, family: SceneFamily, k: int) -> bool:
    """Put object k on a free place of the table at which all of it is in view."""
    start, shape = world.positions()[k], world.shapes[k]
    reach = np.array([family.workspace_x, family.workspace_y]) / 2
    for _ in range(_ATTEMPTS):
        rotation, height = _draw_rest_pose(rng, shape)
        place = np.array([*rng.uniform(-reach, reach), height + 0.0002])
        if not family.contains_points(shape.corners @ rotation.T + place).all():
            continue
        world.place(k, place, rotation)
        world.forward()
        if not world.overlaps(k):
            return True
    world.place(k, start, np.eye(3))
    world.forward()
    return False


def _place_group(rng: np.random.Generator, world: PhysicsWorld, group: Group, first: bool) -> bool:
    """Place a group where it overlaps no other object."""
    radius = 0.05 if first else min(0.28, 0.16 + 0.012 * world.n_objects)
    for _ in range(_ATTEMPTS):
        angle, reach = rng.uniform(0, 2 * np.pi), radius * np.sqrt(rng.uniform())
        at = _CENTRE + reach * np.array([np.cos(angle), np.sin(angle)])
        turn = about_z(float(rng.uniform(0, 2 * np.pi)))
        for k, rotation, position in group.poses():
            world.place(k, turn @ position + (*at, 0.0002), turn @ rotation)
        world.forward()
        if not any(world.overlaps(k) for k in group.objects):
            return True
    return False


def _visible_pixels(world: PhysicsWorld, camera: Camera) -> np.ndarray:
    """Number of visible pixels of each object (n,)."""
    turn = camera.pose.as_matrix()[:3, :3]
    geom, _, _ = world.cast(
        np.array(camera.position), camera.rays().reshape(-1, 3) @ turn.T, (OBJECT_GROUP, MESH_GROUP)
    )
    return np.bincount(world.geom_object[geom[geom >= 0]], minlength=world.n_objects + 1)[1 : world.n_objects + 1]


def _put_behind(rng: np.random.Generator, world: PhysicsWorld, k: int, placed: list[int], camera: Camera) -> bool:
    """Put object k behind one of the tallest objects, at the tried position with the fewest visible pixels."""
    start, best = world.positions()[k], None
    tallest = sorted(placed, key=lambda j: -_top(world, j))[:5]
    for _ in range(_HIDING_PLACES):
        near = tallest[int(rng.integers(len(tallest)))]
        away = world.positions()[near, :2] - np.array(camera.position)[:2]
        if not _put_beside(rng, world, k, [near], _TOUCH, away, 1, "low"):
            continue
        seen = int(_visible_pixels(world, camera)[k])
        if best is None or seen < best[0]:
            best = (seen, world.positions()[k], world.rotations()[k])
        if seen == 0:
            break
    world.place(k, *(best[1:] if best else (start, np.eye(3))))
    world.forward()
    return best is not None


def _try_arrangement(
    rng: np.random.Generator,
    world: PhysicsWorld,
    family: SceneFamily,
    objects: SceneObjects,
    n_touching: int,
    n_unseen: int,
) -> bool:
    """Place all objects once. Returns whether enough twins touch and enough objects are hidden."""
    twin_of, fixed = objects.twin_of, [k for group in objects.groups for k in group.objects]
    fixed += [0] if objects.base else []
    originals = [int(k) for k in rng.permutation([k for k, t in enumerate(twin_of) if t < 0 and k not in fixed])]
    dropped = [k for k in originals if k not in twin_of][: objects.n_dropped]
    originals = [k for k in originals if k not in dropped]
    twins = [k for k, t in enumerate(twin_of) if t >= 0]
    stacked = originals[len(originals) - min(family.n_stacked, len(originals) - 1) :] if family.n_stacked else []
    # Hidden objects are small ones without twins; they are placed last, behind the tall ones.
    lone = [k for k in originals if k not in stacked and k not in twin_of]
    hidden = sorted(lone, key=lambda k: world.shapes[k].radius)[: min(family.n_hidden, len(lone) - 1)]
    standing = [k for k in originals if k not in stacked and k not in hidden]
    heights = [max(shape.half[abs(axis) - 1] for axis, _ in shape.rests) for shape in world.shapes]
    tall = sorted(standing, key=lambda k: -heights[k])[: len(hidden)]
    camera = family.camera().scaled(160 / family.width)
    order = [j for k in standing + stacked for j in (k, *(t for t in twins if twin_of[t] == k))] + hidden
    placed: list[int] = []
    apart: list[int] = []  # those of the placed objects beside which no other object is put
    if objects.base:
        turn = about_z(float(rng.uniform(0, 2 * np.pi)))
        world.place(0, (*_CENTRE, world.shapes[0].half[2] + 0.0002), turn)
        placed.append(0)
    for group in objects.groups:
        if not _place_group(rng, world, group, not placed):
            return False
        placed += group.objects
    for k in order:
        pose: _RestPose = "tall" if k in tall else "any"
        on_base = objects.base and k not in hidden and twin_of[k] < 0 and rng.uniform() < 0.6
        if on_base and _put_on_base(rng, world, k, 0):
            placed.append(k)
            continue
        free = family.apart > 0 and k in standing and k not in twin_of and twin_of[k] < 0
        if free and rng.uniform() < family.apart and _put_apart(rng, world, family, k):
            placed.append(k)
            apart.append(k)
            continue
        others = [j for j in placed if j not in apart]
        if not others:
            rotation, height = _draw_rest_pose(rng, world.shapes[k], pose)
            world.place(k, (*(_CENTRE + rng.uniform(-0.05, 0.05, 2)), height + 0.0002), rotation)
            if apart:
                world.forward()
                if world.overlaps(k):
                    return False
        elif twin_of[k] >= 0:
            if not _put_beside(rng, world, k, [twin_of[k]], _TOUCH):
                return False
        elif k in hidden:
            if not (_put_behind(rng, world, k, placed, camera) or _put_beside(rng, world, k, others, _TOUCH)):
                return False
        elif not (k in stacked and _put_on_top(rng, world, k, placed)):
            gap = _TOUCH if rng.uniform() < family.contact else float(rng.uniform(0.01, 0.04))
            if not _put_beside(rng, world, k, others, gap, pose=pose):
                return False
        placed.append(k)
    world.forward()
    if not world.settle(placed):
        return False
    if dropped:
        for k in dropped:
            if not _drop(rng, world, k, placed):
                return False
            placed.append(k)
        if not (world.settle() or world.settle()):
            return False
    if not family.contains_points(world.positions()).all() or world.deepest_overlap() > 0.0015:
        return False
    if not all(group.stands(world.poses()) for group in objects.groups):
        return False
    if family.n_hidden:
        unseen = int((_visible_pixels(world, camera) == 0).sum())
        if unseen < n_unseen or unseen > world.n_objects / 3:
            return False
    touching = set(world.contacts())
    return sum((min(k, t), max(k, t)) in touching for k, t in enumerate(twin_of) if t >= 0) >= n_touching


def arrange_objects(
    rng: np.random.Generator, world: PhysicsWorld, family: SceneFamily, objects: SceneObjects
) -> None:
    """Place all objects, with touching twins and hidden objects, and run the physics until all objects are at rest.

    In a dense heap, the physics may separate twins or reveal hidden objects. After some attempts, fewer touching
    twins and hidden objects are sufficient. Raises InputError if the objects do not fit on the table.
    """
    empty = world.save()
    twins = sum(t >= 0 for t in objects.twin_of)
    most = 2 * _ATTEMPTS  # of a dense scene of meshes, one attempt in twenty succeeds
    for attempt in range(most):
        world.restore(empty)
        n_touching = (twins if twins < 3 else twins - 1) if attempt < _PATIENCE else (twins + 1) // 2
        n_unseen = (family.n_hidden + 1) // 2 if attempt < 2 * _PATIENCE else 0
        if _try_arrangement(rng, world, family, objects, n_touching, n_unseen):
            return
    raise InputError(
        f"scene family {family.name!r}: {world.n_objects} objects could not be arranged in {most} attempts",
        "use fewer or smaller objects, or fewer twins",
    )

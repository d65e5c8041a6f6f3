"""Physics by MuJoCo: a table, rigid objects and a finger that pushes objects.

>>> import numpy as np
>>> from mstfilter.lab.simulation.shapes import draw_shape
>>> from mstfilter.lab.simulation.world import PhysicsWorld
>>> world = PhysicsWorld([draw_shape(np.random.default_rng(0), "can")])
>>> world.place(0, (0.0, 0.0, 0.1), np.eye(3))
>>> bool(world.settle())
True

The time step is 2 ms, the integrator is implicit, and friction cones are elliptic. Objects are unions of convex
pieces with torsional and rolling friction. Rays hit the mesh of an object that has one, and the pieces of others. The
finger is a capsule on three slides with stiff position actuators. The arm above the finger is visible but has no
contacts.

An action is a `FingerPush`: the finger comes down, moves in a straight line, and goes up and away. `choose_push`
simulates dozens of candidate pushes from one state, and takes the first push that moves enough objects and neither
topples nor drops an object.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mstfilter.base.errors import InputError
from mstfilter.lab.simulation.families import SceneFamily
from mstfilter.lab.simulation.shapes import Part, Shape
from mstfilter.lab.simulation.solids import Piece
from mstfilter.scene import VoxelGrid

FINGER_ID = 255  #: Instance id of finger and arm

TABLE = ((0.85, 0.66, 0.02), (0.0, 0.04, -0.02))  #: Half edges and centre of the table top; its upper face is z = 0

FLOOR_HEIGHT = -0.72

ROOM_GROUP, OBJECT_GROUP, FINGER_GROUP = 0, 1, 2  #: Groups of geoms that rays can be limited to
PIECE_GROUP, MESH_GROUP = 3, 4  #: Pieces of objects with a mesh (not visible, but cheap for rays), and meshes

_TIME_STEP = 0.002
_WALL_DISTANCE = 1.9
_PARKED = np.array([0.0, -4.0, 1.0])  # the finger between actions: behind the camera
_FINGER_RADIUS = 0.011
_FINGER_HALF = 0.10
_CONTACT_GAP = 0.0005  # nearer pairs are contacts (without force): bodies at rest touch up to solver noise
# conaffinity 4 matches no contype, so a visible geom touches nothing. MuJoCo's rays skip the bounding volumes of
# geoms with contype = conaffinity = 0.
_VISIBLE = 'contype="0" conaffinity="4" mass="0"'
_AWAY = 50.0  # where objects are before they are placed

# Height of the middle of the finger while it pushes (its tip is 12 mm above the table), and before and after.
_LOW = _FINGER_HALF + _FINGER_RADIUS + 0.012
_HIGH = _LOW + 0.26

# Shares of the time of an action: coming down, pushing, going up. The rest is for settling.
_DOWN, _PUSH, _UP = 0.17, 0.60, 0.15


def _numbers(values: ArrayLike | None) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(values).ravel())


def _geom_xml(piece: Piece, mesh: str, density: float, rolling: float, group: int) -> str:
    from scipy.spatial.transform import Rotation

    quaternion = Rotation.from_matrix(piece.rotation).as_quat(scalar_first=True)
    solid = (
        f'type="mesh" mesh="{mesh}"' if piece.kind == "hull" else f'type="{piece.kind}" size="{_numbers(piece.size)}"'
    )
    return (
        f'<geom {solid} pos="{_numbers(piece.centre)}" quat="{_numbers(quaternion)}" density="{density!r}" '
        f'group="{group}" gap="{_CONTACT_GAP}" condim="{6 if rolling > 0.0005 else 4}" '
        f'friction="0.55 0.01 {rolling!r}"/>'
    )


def _surface_xml(part: Part, name: str) -> tuple[str, str]:
    """The mesh and the geom of the surface of a part, which rays hit."""
    from scipy.spatial.transform import Rotation

    surface = part.shape.surface
    assert surface is not None
    faces = " ".join(map(str, surface.faces.ravel().tolist()))
    vertices = part.shape.scale * surface.vertices
    quaternion = Rotation.from_matrix(part.rotation).as_quat(scalar_first=True)
    return (
        f'<mesh name="{name}" vertex="{_numbers(vertices)}" face="{faces}" inertia="shell"/>',
        f'<geom type="mesh" mesh="{name}" pos="{_numbers(part.position)}" quat="{_numbers(quaternion)}" {_VISIBLE} '
        f'group="{MESH_GROUP}"/>',
    )


def _model_xml(shapes: Sequence[Shape], arm: bool, wall: Wall | None) -> str:
    meshes, bodies = [], []
    for i, shape in enumerate(shapes):
        geoms = []
        groups = [
            OBJECT_GROUP if part.shape.surface is None else PIECE_GROUP
            for part in shape.surfaces
            for _ in part.shape.pieces
        ]
        for j, (piece, group) in enumerate(zip(shape.pieces, groups, strict=True)):
            name = f"m{i}_{j}"
            if piece.kind == "hull":
                meshes.append(f'<mesh name="{name}" vertex="{_numbers(piece.vertices)}" inertia="convex"/>')
            geoms.append(_geom_xml(piece, name, float(shape.density), shape.rolling, group))
        for j, part in enumerate(shape.surfaces):
            if part.shape.surface is not None:
                mesh, geom = _surface_xml(part, f"s{i}_{j}")
                meshes.append(mesh)
                geoms.append(geom)
        at = _numbers((_AWAY + 2.0 * i, 0.0, 1.0))
        bodies.append(f'<body name="o{i}" pos="{at}"><freejoint/>{"".join(geoms)}</body>')
    axes = zip("xyz", ("1 0 0", "0 1 0", "0 0 1"), strict=True)
    slides = "".join(f'<joint name="{name}" type="slide" axis="{axis}"/>' for name, axis in axes)
    visible = f'{_VISIBLE} group="{FINGER_GROUP}"'
    limbs = ""
    if arm:
        limbs = (
            f'<geom type="cylinder" size="0.028 0.035" pos="0 0 0.13" {visible}/>'
            f'<geom type="capsule" size="0.034" fromto="0 0.02 0.19 0.10 0.85 0.95" {visible}/>'
        )
    motors = "".join(f'<position joint="{a}" kp="2500" kv="70.710678"/>' for a in "xyz")
    half, middle = TABLE
    room = f'group="{ROOM_GROUP}"'
    near = (
        ""
        if wall is None
        else (
            f'<geom type="box" size="{_numbers(wall.half)}" pos="{_numbers(wall.centre)}" {room} condim="4" '
            f'friction="0.5 0.01 0.0005"/>'
        )
    )
    return f"""<mujoco>
<compiler angle="radian"/>
<option timestep="{_TIME_STEP}" integrator="implicitfast" cone="elliptic" impratio="5"/>
<asset>{"".join(meshes)}</asset>
<worldbody>
<geom type="box" size="{_numbers(half)}" pos="{_numbers(middle)}" {room} condim="4" friction="0.6 0.01 0.0005"/>
<geom type="plane" size="0 0 1" pos="0 0 {FLOOR_HEIGHT}" {room} contype="0" conaffinity="0"/>
<geom type="plane" size="0 0 1" pos="0 {_WALL_DISTANCE} 0" zaxis="0 -1 0" {room} contype="0" conaffinity="0"/>{near}
<body name="finger" gravcomp="1">{slides}
<geom type="capsule" size="{_FINGER_RADIUS} {_FINGER_HALF}" mass="0.5" group="{FINGER_GROUP}" condim="4"
 friction="0.55 0.01 0.0005"/>{limbs}</body>
{"".join(bodies)}
</worldbody>
<actuator>{motors}</actuator>
</mujoco>"""


@dataclass(frozen=True)
class Wall:
    """A wall that stands on the table or behind it, parallel to the axes. It belongs to the room and never moves."""

    half: tuple[float, float, float]  #: half edges, metres
    centre: tuple[float, float, float]  #: metres


class PhysicsWorld:
    """Objects on a table, and a finger.

    Object k has the shape ``shapes[k]``, and the id k + 1 in images, voxels and poses. Objects start far from the
    table. `place` puts one object on the table.
    """

    def __init__(self, shapes: Sequence[Shape], arm: bool = True, wall: Wall | None = None) -> None:
        import mujoco

        if not 1 <= len(shapes) < FINGER_ID:
            raise InputError(f"a world of {len(shapes)} objects, expected 1 .. {FINGER_ID - 1}")
        self.shapes = tuple(shapes)
        self._mj = mujoco
        self.model = mujoco.MjModel.from_xml_string(_model_xml(shapes, arm, wall))
        self.data = mujoco.MjData(self.model)
        bodies = np.array([self.model.body(f"o{i}").id for i in range(len(shapes))])
        ids = np.zeros(self.model.nbody, np.int32)
        ids[bodies] = np.arange(1, len(shapes) + 1)
        ids[self.model.body("finger").id] = FINGER_ID
        #: Instance id of each geom: 0 for the room, 1 .. n for objects, 255 for finger and arm.
        self.geom_object: np.ndarray = ids[self.model.geom_bodyid]
        #: Index of each geom among the pieces of its body.
        self.geom_piece: np.ndarray = np.arange(self.model.ngeom) - self.model.body_geomadr[self.model.geom_bodyid]
        #: The shapes with textures of their own, as pairs of object and part, and for each geom the index of its pair
        #: (-1 for room, finger and arm).
        self.surfaces: tuple[tuple[int, Part], ...] = tuple(
            (k, part) for k, s in enumerate(shapes) for part in s.surfaces
        )
        self.geom_surface: np.ndarray = np.full(self.model.ngeom, -1)
        self._meshes = np.zeros(self.model.ngeom, bool)
        self.has_meshes: bool = any(part.shape.surface is not None for _, part in self.surfaces)
        first = 0
        for shape, body in zip(shapes, bodies.tolist(), strict=True):
            count = len(shape.surfaces)
            owner = np.repeat(np.arange(count), [len(part.shape.pieces) for part in shape.surfaces])
            with_mesh = [j for j, part in enumerate(shape.surfaces) if part.shape.surface is not None]
            start, n = int(self.model.body_geomadr[body]), int(self.model.body_geomnum[body])
            self.geom_surface[start : start + n] = first + np.concatenate([owner, np.array(with_mesh, int)])
            self._meshes[start + len(owner) : start + n] = True
            first += count
        joints = self.model.body_jntadr[bodies]
        #: Indices (n, 7) of position and quaternion (w, x, y, z) of each object in `data.qpos`.
        self.pose_index: np.ndarray = self.model.jnt_qposadr[joints][:, None] + np.arange(7)
        self._velocity_index = self.model.jnt_dofadr[joints][:, None] + np.arange(6)
        self.move_finger(_PARKED)

    @property
    def n_objects(self) -> int:
        """Number of objects."""
        return len(self.shapes)

    @property
    def time(self) -> float:
        """Simulated seconds."""
        return float(self.data.time)

    def place(self, k: int, position: ArrayLike, rotation: ArrayLike) -> None:
        """Set the pose of object k, with zero velocity."""
        from scipy.spatial.transform import Rotation

        quaternion = Rotation.from_matrix(np.asarray(rotation)).as_quat(scalar_first=True)
        self.data.qpos[self.pose_index[k]] = np.concatenate([position, quaternion])
        self.data.qvel[self._velocity_index[k]] = 0.0

    def positions(self) -> np.ndarray:
        """Origins of the objects (n, 3), metres."""
        return self.data.qpos[self.pose_index[:, :3]]

    def rotations(self) -> np.ndarray:
        """Orientations of the objects (n, 3, 3)."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(self.data.qpos[self.pose_index[:, 3:]], scalar_first=True).as_matrix()

    def poses(self) -> np.ndarray:
        """T_world_object (n, 4, 4)."""
        poses = np.tile(np.eye(4), (self.n_objects, 1, 1))
        poses[:, :3, :3] = self.rotations()
        poses[:, :3, 3] = self.positions()
        return poses

    def finger_position(self) -> np.ndarray:
        """Middle of the finger (3,), metres."""
        return self.data.qpos[:3].copy()

    def move_finger(self, position: ArrayLike) -> None:
        """Set the position of the finger, with zero velocity."""
        self.data.qpos[:3] = position
        self.data.qvel[:3] = 0.0
        self.data.ctrl[:] = position

    def forward(self) -> None:
        """Update contacts and positions of all geoms."""
        self._mj.mj_forward(self.model, self.data)

    def step(self, n: int = 1) -> None:
        """Advance by n time steps of 2 ms."""
        self._mj.mj_step(self.model, self.data, n)

    def settle(self, only: Sequence[int] | None = None) -> bool:
        """Run until no object moves faster than 0.01 m/s or rad/s for 0.1 s. Returns False after 4 s of motion.

        `only` has the objects that count, if others are not placed yet.
        """
        index = self._velocity_index if only is None else self._velocity_index[list(only)]
        calm = 0
        for _ in range(200):
            self.step(10)
            calm = calm + 1 if np.abs(self.data.qvel[index]).max() < 0.01 else 0
            if calm >= 5:
                break
        self.forward()
        return calm >= 5

    def contacts(self) -> list[tuple[int, int]]:
        """Pairs (i, j), i < j, of objects at most a millimetre apart. Call `forward` before."""
        pairs = np.sort(self.geom_object[self.data.contact.geom.reshape(-1, 2)], axis=1)
        objects = (pairs[:, 0] >= 1) & (pairs[:, 1] < FINGER_ID)
        return [(i - 1, j - 1) for i, j in np.unique(pairs[objects], axis=0).tolist()]

    def overlaps(self, k: int | None = None) -> bool:
        """Whether object k (None: the finger) overlaps another object. Call `forward` before."""
        body = FINGER_ID if k is None else k + 1
        pairs, distance = self.geom_object[self.data.contact.geom.reshape(-1, 2)], self.data.contact.dist
        return bool(((distance < 0) & (pairs == body).any(axis=1) & (pairs >= 1).all(axis=1)).any())

    def deepest_overlap(self) -> float:
        """Greatest depth (m) at which objects overlap each other or the table. Call `forward` before."""
        contact = self.data.contact
        objects = (self.geom_object[contact.geom.reshape(-1, 2)] > 0).any(axis=1)
        return float(-contact.dist[objects].min(initial=0.0))

    def save(self) -> np.ndarray:
        """The full state of the simulation. A restored simulation gives bit-identical results."""
        kind = self._mj.mjtState.mjSTATE_INTEGRATION
        state = np.empty(self._mj.mj_stateSize(self.model, kind))
        self._mj.mj_getState(self.model, self.data, state, kind)
        return state

    def restore(self, state: np.ndarray) -> None:
        """Return to a saved state."""
        self._mj.mj_setState(self.model, self.data, state, self._mj.mjtState.mjSTATE_INTEGRATION)
        self.forward()

    def cast(
        self, origin: ArrayLike, directions: np.ndarray, groups: Sequence[int] = (0, 1, 2, 4), data: Any = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cast rays from one point (3,), in metres, along directions (n, 3) of any length.

        `groups` has the numbers of the geom groups that rays can hit: 0 for the room, 1 for objects without a mesh, 2
        for finger and arm, 3 for the convex pieces of objects with a mesh, 4 for meshes. `data` is another state of
        the same model. The default is the state of the world after `forward`. Returns the first geom (n,) int32 that
        each ray hits (-1 for none), the distance (n,), and the normal (n, 3) of the surface. The distance is in units
        of the length of the direction.
        """
        n = len(directions)
        geom, distance = np.full(n, -1, np.int32), np.full(n, -1.0)
        normal = np.zeros((n, 3))
        if n:
            state = self.data if data is None else data
            visible = np.isin(np.arange(6), groups).astype(np.uint8)
            start = np.asarray(origin, dtype=np.float64)
            rays = np.ascontiguousarray(directions, dtype=np.float64).reshape(-1)
            flat = normal.reshape(-1)
            self._mj.mj_multiRay(self.model, state, start, rays, visible, True, -1, geom, distance, flat, n, 1e6)
            if self.has_meshes:  # the faces of a mesh may be turned inside out
                on = np.flatnonzero((geom >= 0) & self._meshes[geom])
                turned = on[(directions[on] * normal[on]).sum(axis=1) > 0]
                normal[turned] *= -1.0
        return geom, distance, normal


@dataclass(frozen=True)
class FingerPush:
    """A straight push along the table."""

    start: tuple[float, float]  #: (x, y) metres, where the finger comes down
    end: tuple[float, float]  #: (x, y) metres, where the finger goes up
    seconds: float  #: from one pause to the next, without the time to settle
    height: float = _LOW  #: metres, of the middle of the finger above the table

    @classmethod
    def with_tip(cls, start: np.ndarray, end: np.ndarray, seconds: float) -> FingerPush:
        """A push from one point (3,) to another, at which the tip of the finger touches an object."""
        height = float(start[2]) + _FINGER_HALF
        return cls((float(start[0]), float(start[1])), (float(end[0]), float(end[1])), seconds, max(height, _LOW))

    def swept(self, grid: VoxelGrid) -> np.ndarray:
        """(X, Y, Z) bool: voxels with centres in the volume that the finger sweeps."""
        centres = grid.centres()
        a, b = np.array(self.start), np.array(self.end)
        along = np.clip((centres[..., :2] - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-12), 0.0, 1.0)
        beside = np.linalg.norm(centres[..., :2] - a - along[..., None] * (b - a), axis=-1)
        above = np.abs(centres[..., 2] - self.height)
        return np.asarray((beside <= _FINGER_RADIUS) & (above <= _FINGER_HALF + _FINGER_RADIUS))

    def target(self, t: float) -> np.ndarray:
        """Target position (3,) of the finger t seconds after the pause."""
        a, b = np.array(self.start), np.array(self.end)
        share = t / self.seconds
        if share < _DOWN:
            return np.array([*a, _HIGH + (self.height - _HIGH) * share / _DOWN])
        if share < _DOWN + _PUSH:
            return np.array([*(a + (b - a) * (share - _DOWN) / _PUSH), self.height])
        if share < _DOWN + _PUSH + _UP:
            return np.array([*b, self.height + (_HIGH - self.height) * (share - _DOWN - _PUSH) / _UP])
        return _PARKED


@dataclass(frozen=True)
class PushEffect:
    """The effect of a push on the objects."""

    displacement: np.ndarray  #: (n,) metres, distance that each object's origin moved
    turned: np.ndarray  #: (n,) radians, angle by which each object turned
    settled: bool  #: whether all objects came to rest
    kept: bool  #: whether all objects are still on the table, in the workspace and in view

    def moved(self, threshold: float) -> int:
        """Number of objects that moved farther than `threshold` metres."""
        return int((self.displacement > threshold).sum())


def advance_push(world: PhysicsWorld, push: FingerPush, start: float, stop: float) -> None:
    """Simulate a push from `start` to `stop`, in seconds after the pause."""
    first, last = round(start / _TIME_STEP), round(stop / _TIME_STEP)
    parked = round((_DOWN + _PUSH + _UP) * push.seconds / _TIME_STEP)
    for k in range(first, last):
        if k == 0:
            world.move_finger(push.target(0.0))
        elif k == parked:
            world.move_finger(_PARKED)
        if k < parked:
            world.data.ctrl[:] = push.target(k * _TIME_STEP)
        world.step()
    world.forward()


def finish_push(world: PhysicsWorld) -> bool:
    """Park the finger and wait until all objects are at rest. Returns False if objects still move after 4 s."""
    world.move_finger(_PARKED)
    return world.settle()


def play_push(world: PhysicsWorld, push: FingerPush, family: SceneFamily) -> PushEffect:
    """Simulate a push and wait until all objects are at rest."""
    before = world.poses()
    advance_push(world, push, 0.0, push.seconds)
    return push_effect(world, before, finish_push(world), family)


def push_effect(world: PhysicsWorld, before: np.ndarray, settled: bool, family: SceneFamily) -> PushEffect:
    """The effect of a push, computed from the present poses and the poses `before` the push (n, 4, 4)."""
    after = world.positions()
    trace = np.einsum("nij,nij->n", before[:, :3, :3], world.rotations())
    kept = bool(family.contains_points(after).all())
    moved = np.linalg.norm(after - before[:, :3, 3], axis=1)
    # The trace of R_before^T R_after is 1 + 2 cos(angle).
    return PushEffect(moved, np.arccos(np.clip((trace - 1) / 2, -1, 1)), settled, kept)


def is_clear(world: PhysicsWorld, at: tuple[float, float]) -> bool:
    """Whether the finger can come down at the position `at` without touching an object."""
    saved = world.save()
    for height in np.linspace(_HIGH, _LOW, 5):
        world.move_finger((*at, height))
        world.forward()
        overlaps = world.overlaps()
        if overlaps:
            break
    world.restore(saved)
    return not overlaps


def draw_push(rng: np.random.Generator, world: PhysicsWorld, family: SceneFamily) -> FingerPush:
    """A random push towards one object, preferably in the direction of another object."""
    at = world.positions()[:, :2]
    goal = at[int(rng.integers(len(at)))]
    others = at[np.linalg.norm(at - goal, axis=1) > 1e-6]
    if len(others) and rng.uniform() < 0.7:
        near = others[np.argsort(np.linalg.norm(others - goal, axis=1))[: min(3, len(others))]]
        towards = near[int(rng.integers(len(near)))] - goal
        angle = float(np.arctan2(towards[1], towards[0]) + rng.normal(0, 0.25))
    else:
        angle = float(rng.uniform(0, 2 * np.pi))
    direction = np.array([np.cos(angle), np.sin(angle)])
    length = family.push_speed * _PUSH * family.action_seconds
    aim = goal + rng.uniform(-0.02, 0.02, 2)
    start = aim - direction * float(rng.uniform(0.07, 0.13))
    end = start + direction * length
    return FingerPush((float(start[0]), float(start[1])), (float(end[0]), float(end[1])), family.action_seconds)


def tried_pushes(
    world: PhysicsWorld, family: SceneFamily, draw: Callable[[], FingerPush]
) -> Iterator[tuple[FingerPush, PushEffect, np.ndarray]]:
    """Simulate up to 4 `family.n_candidates` drawn pushes: pushes, their effects, and the poses (n, 4, 4) afterwards.

    Pushes that begin inside an object, drop an object or leave one in motion are left out. The world does not change.
    """
    saved = world.save()
    for _ in range(4 * family.n_candidates):
        push = draw()
        if not is_clear(world, push.start):
            continue
        effect = play_push(world, push, family)
        after = world.poses()
        world.restore(saved)
        if effect.kept and effect.settled:
            yield push, effect, after


def choose_push(rng: np.random.Generator, world: PhysicsWorld, family: SceneFamily) -> FingerPush:
    """Simulate candidate pushes and choose a push that moves objects. The world does not change.

    The first candidate that moves `family.min_moved` objects and topples `family.min_toppled` is taken. If the latter
    is 0, the candidate must topple none. If no candidate does so, the candidate with the best balance of moved and
    toppled objects is taken. Candidates that drop an object or leave an object in motion are discarded. Raises
    InputError if no candidate moves any object.
    """
    best: tuple[float, FingerPush] | None = None
    for push, result, _ in tried_pushes(world, family, lambda: draw_push(rng, world, family)):
        count = result.moved(family.move_threshold)
        toppled = int((result.turned > np.deg2rad(75)).sum())
        if count == 0:
            continue
        wanted = family.min_toppled
        if count >= family.min_moved and (toppled >= wanted if wanted else toppled == 0):
            return push
        score = min(count, family.min_moved) + (min(toppled, wanted) if wanted else -0.7 * toppled)
        if best is None or score > best[0]:
            best = (score, push)
    if best is None:
        raise InputError(
            f"scene family {family.name!r}: none of {4 * family.n_candidates} pushes moves an object "
            f"by more than {family.move_threshold} m without dropping one",
            "lower move_threshold, or raise push_speed, frames_per_clip or n_candidates",
        )
    return best[1]

"""The physical world: a table, rigid objects, a finger that pushes; MuJoCo inside.

>>> import numpy as np
>>> from mstfilter.simulation.shapes import draw_shape
>>> from mstfilter.simulation.world import World
>>> world = World([draw_shape(np.random.default_rng(0), "can")])
>>> world.place(0, (0.0, 0.0, 0.1), np.eye(3))
>>> bool(world.settle())
True

Time step 2 ms, implicit integration, elliptic friction cones. Objects are unions of convex pieces (no
decomposition), each with torsional and rolling friction. The finger is a capsule on three slides driven by
stiff position actuators; the arm above it is seen by the camera but touches nothing.


Pushes: a finger comes down, moves in a straight line, goes up and away.

Which push is made is decided by trying: candidate lines through the objects are simulated from the saved
state and the first is kept that moves enough of them without dropping any off the table. Physics is so
cheap beside rendering that dozens may be tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mstfilter.errors import InputError
from mstfilter.simulation.families import SceneFamily
from mstfilter.simulation.shapes import Shape
from mstfilter.simulation.solids import Piece

__all__ = [
    "Contact",
    "Effect",
    "FINGER_ID",
    "PARKED",
    "Push",
    "TABLE",
    "TIME_STEP",
    "World",
    "cast",
    "choose_push",
    "play",
]

TIME_STEP = 0.002
FINGER_ID = 255
"""Instance id of finger and arm."""

PARKED = np.array([0.0, -4.0, 1.0])
"""Where the finger waits: behind the camera."""

FINGER_RADIUS = 0.011
FINGER_HALF = 0.10

# Half edges and centre of the table top; its upper face is z = 0.
TABLE = ((0.85, 0.66, 0.02), (0.0, 0.04, -0.02))
FLOOR, WALL = -0.72, 1.9

# Pairs nearer than this are listed as contacts (without force): bodies at rest touch up to solver noise.
NEAR = 0.0005

ROOM_GROUP, OBJECT_GROUP, FINGER_GROUP = 0, 1, 2
_AWAY = 50.0


@dataclass(frozen=True)
class Contact:
    """Two objects (numbers from 0) within a millimetre, and how deep they overlap (m, negative: a gap)."""

    first: int
    second: int
    depth: float


def _numbers(values: ArrayLike | None) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(values).ravel())


def _geom(piece: Piece, mesh: str, density: float, rolling: float) -> str:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(piece.rotation).as_quat()
    what = (
        f'type="mesh" mesh="{mesh}"' if piece.kind == "hull" else f'type="{piece.kind}" size="{_numbers(piece.size)}"'
    )
    return (
        f'<geom {what} pos="{_numbers(piece.centre)}" quat="{_numbers((w, x, y, z))}" density="{density!r}" '
        f'group="{OBJECT_GROUP}" gap="{NEAR}" condim="{6 if rolling > 0.0005 else 4}" '
        f'friction="0.55 0.01 {rolling!r}"/>'
    )


def _model_xml(shapes: Sequence[Shape], arm: bool) -> str:
    meshes, bodies = [], []
    for i, shape in enumerate(shapes):
        geoms = []
        for j, piece in enumerate(shape.pieces):
            name = f"m{i}_{j}"
            if piece.kind == "hull":
                meshes.append(f'<mesh name="{name}" vertex="{_numbers(piece.vertices)}" inertia="convex"/>')
            geoms.append(_geom(piece, name, float(shape.density), shape.rolling))
        at = _numbers((_AWAY + 2.0 * i, 0.0, 1.0))
        bodies.append(f'<body name="o{i}" pos="{at}"><freejoint/>{"".join(geoms)}</body>')
    slides = "".join(
        f'<joint name="{a}" type="slide" axis="{v}"/>'
        for a, v in zip("xyz", ("1 0 0", "0 1 0", "0 0 1"), strict=True)
    )
    # Bit 2 meets no other geom's: nothing is touched, yet rays are told of the bounds (they ignore 0 and 0).
    seen = f'contype="0" conaffinity="4" mass="0" group="{FINGER_GROUP}"'
    limbs = ""
    if arm:
        limbs = (
            f'<geom type="cylinder" size="0.028 0.035" pos="0 0 0.13" {seen}/>'
            f'<geom type="capsule" size="0.034" fromto="0 0.02 0.19 0.10 0.85 0.95" {seen}/>'
        )
    gains = 'kp="2500" kv="70.710678"'
    motors = "".join(f'<position joint="{a}" {gains}/>' for a in "xyz")
    half, middle = TABLE
    return f"""<mujoco>
<compiler angle="radian"/>
<option timestep="{TIME_STEP}" integrator="implicitfast" cone="elliptic" impratio="5"/>
<asset>{"".join(meshes)}</asset>
<worldbody>
<geom type="box" size="{_numbers(half)}" pos="{_numbers(middle)}" group="{ROOM_GROUP}" condim="4"
 friction="0.6 0.01 0.0005"/>
<geom type="plane" size="0 0 1" pos="0 0 {FLOOR}" group="{ROOM_GROUP}" contype="0" conaffinity="0"/>
<geom type="plane" size="0 0 1" pos="0 {WALL} 0" zaxis="0 -1 0" group="{ROOM_GROUP}" contype="0" conaffinity="0"/>
<body name="finger" gravcomp="1">{slides}
<geom type="capsule" size="{FINGER_RADIUS} {FINGER_HALF}" mass="0.5" group="{FINGER_GROUP}" condim="4"
 friction="0.55 0.01 0.0005"/>{limbs}</body>
{"".join(bodies)}
</worldbody>
<actuator>{motors}</actuator>
</mujoco>"""


class World:
    """Objects on a table, and a finger.

    Parameters
    ----------
    shapes : sequence of Shape
        Object k of the world is shapes[k]; its id in images, voxels and poses is k + 1. They start far away:
        `place` puts one on the table.
    arm : bool
        Give the finger an arm that is seen (and casts shadows) but touches nothing.
    """

    def __init__(self, shapes: Sequence[Shape], arm: bool = True) -> None:
        import mujoco

        if not 1 <= len(shapes) < FINGER_ID:
            raise InputError(f"a world of {len(shapes)} objects, expected 1 .. {FINGER_ID - 1}")
        self.shapes = tuple(shapes)
        self._mj = mujoco
        self.model = mujoco.MjModel.from_xml_string(_model_xml(shapes, arm))
        self.data = mujoco.MjData(self.model)
        body_of_object = [
            mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, f"o{i}") for i in range(len(shapes))
        ]
        self._bodies = np.array(body_of_object)
        self._finger = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, "finger")
        ids = np.zeros(self.model.nbody, np.int32)
        ids[self._bodies] = np.arange(1, len(shapes) + 1)
        ids[self._finger] = FINGER_ID
        self.geom_object: np.ndarray = ids[self.model.geom_bodyid]
        """Instance id of every geom: 0 the room, 1 .. n objects, 255 finger and arm."""
        self.geom_piece: np.ndarray = np.arange(self.model.ngeom) - self.model.body_geomadr[self.model.geom_bodyid]
        """Number of every geom among the pieces of its body."""
        self._qpos = self.model.jnt_qposadr[self.model.body_jntadr[self._bodies]]
        self._dof = self.model.jnt_dofadr[self.model.body_jntadr[self._bodies]]
        self.move_finger(PARKED)

    @property
    def n_objects(self) -> int:
        """Number of objects."""
        return len(self.shapes)

    @property
    def time(self) -> float:
        """Simulated seconds."""
        return float(self.data.time)

    def place(self, k: int, position: ArrayLike, rotation: ArrayLike) -> None:
        """Put object k somewhere, at rest."""
        from scipy.spatial.transform import Rotation

        x, y, z, w = Rotation.from_matrix(np.asarray(rotation)).as_quat()
        at = self._qpos[k]
        self.data.qpos[at : at + 3] = position
        self.data.qpos[at + 3 : at + 7] = (w, x, y, z)
        self.data.qvel[self._dof[k] : self._dof[k] + 6] = 0.0

    def positions(self) -> np.ndarray:
        """(n, 3) origins of the objects, metres."""
        return np.stack([self.data.qpos[a : a + 3] for a in self._qpos])

    def rotations(self) -> np.ndarray:
        """(n, 3, 3) orientations of the objects."""
        from scipy.spatial.transform import Rotation

        quaternions = np.stack([self.data.qpos[a + 3 : a + 7] for a in self._qpos])
        return Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()

    def poses(self) -> np.ndarray:
        """(n, 4, 4) T_world_object."""
        poses = np.tile(np.eye(4), (self.n_objects, 1, 1))
        poses[:, :3, :3] = self.rotations()
        poses[:, :3, 3] = self.positions()
        return poses

    def finger_position(self) -> np.ndarray:
        """(3,) middle of the finger, metres."""
        return self.data.qpos[:3].copy()

    def move_finger(self, position: ArrayLike) -> None:
        """Put the finger somewhere at once, at rest."""
        self.data.qpos[:3] = position
        self.data.qvel[:3] = 0.0
        self.data.ctrl[:] = position

    def steer_finger(self, target: ArrayLike) -> None:
        """Set where the finger's motors drive it."""
        self.data.ctrl[:] = target

    def forward(self) -> None:
        """Bring contacts and positions of all geoms up to date."""
        self._mj.mj_forward(self.model, self.data)

    def step(self, n: int = 1) -> None:
        """Advance by n time steps of 2 ms."""
        self._mj.mj_step(self.model, self.data, n)

    def settle(self, limit: float = 4.0, speed: float = 0.01) -> bool:
        """Run until no object moves faster than `speed` (m/s, rad/s) for 0.1 s; False at the time limit (s)."""
        calm = 0
        for _ in range(int(limit / (10 * TIME_STEP))):
            self.step(10)
            fastest = max(np.abs(self.data.qvel[d : d + 6]).max() for d in self._dof)
            calm = calm + 1 if fastest < speed else 0
            if calm >= 5:
                self.forward()
                return True
        self.forward()
        return False

    def contacts(self) -> list[Contact]:
        """Pairs of objects that touch now, within a millimetre; the deepest contact of each pair."""
        deepest: dict[tuple[int, int], float] = {}
        contact = self.data.contact
        for (a, b), dist in zip(contact.geom, contact.dist, strict=True):
            i, j = sorted((int(self.geom_object[a]), int(self.geom_object[b])))
            if i >= 1 and j < FINGER_ID:
                deepest[i - 1, j - 1] = max(deepest.get((i - 1, j - 1), -np.inf), -float(dist))
        return [Contact(i, j, depth) for (i, j), depth in sorted(deepest.items())]

    def overlaps(self, k: int | None = None) -> bool:
        """Whether object k (None: the finger) overlaps an object, after `forward`."""
        mine = FINGER_ID if k is None else k + 1
        contact = self.data.contact
        for (a, b), dist in zip(contact.geom, contact.dist, strict=True):
            pair = (int(self.geom_object[a]), int(self.geom_object[b]))
            if dist < 0 and mine in pair and min(pair) >= 1:
                return True
        return False

    def deepest_overlap(self) -> float:
        """Metres by which objects overlap each other or the table, at most, after `forward`."""
        contact = self.data.contact
        objects = (self.geom_object[contact.geom] > 0).any(axis=1) if len(contact.dist) else np.zeros(0, bool)
        return float(max(0.0, -contact.dist[objects].min())) if objects.any() else 0.0

    def save(self) -> np.ndarray:
        """The full state of the integration; `restore` continues from it bit by bit."""
        what = self._mj.mjtState.mjSTATE_INTEGRATION
        state = np.empty(self._mj.mj_stateSize(self.model, what))
        self._mj.mj_getState(self.model, self.data, state, what)
        return state

    def restore(self, state: np.ndarray) -> None:
        """Go back to a saved state."""
        self._mj.mj_setState(self.model, self.data, state, self._mj.mjtState.mjSTATE_INTEGRATION)
        self.forward()

    def cast(
        self, origin: ArrayLike, directions: np.ndarray, groups: Sequence[int] = (0, 1, 2)
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays from one point through the world as it is after `forward`.

        Parameters
        ----------
        origin : (3,) metres
        directions : (n, 3)
            Of any length.
        groups : sequence of int
            Which geoms are seen: 0 the room, 1 objects, 2 finger and arm.

        Returns
        -------
        geom (n,) int32, -1 where nothing is hit; distance (n,) in units of each direction's length; normal
        (n, 3).
        """
        return cast(self.model, self.data, origin, directions, groups)

    def qpos_of(self, k: int) -> slice:
        """Where object k's place and orientation stand among the coordinates."""
        return slice(int(self._qpos[k]), int(self._qpos[k]) + 7)

    def another_data(self) -> tuple[Any, Any]:
        """MuJoCo's module and a further state of the same model, which physics never touches."""
        return self._mj, self._mj.MjData(self.model)


def cast(
    model: Any, data: Any, origin: ArrayLike, directions: np.ndarray, groups: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays from one point through a state whose kinematics are up to date; see `World.cast`."""
    import mujoco

    n = len(directions)
    geom, distance = np.full(n, -1, np.int32), np.full(n, -1.0)
    normal = np.zeros((n, 3))
    if n:
        seen = np.isin(np.arange(6), groups).astype(np.uint8)
        start = np.asarray(origin, dtype=np.float64)
        rays = np.ascontiguousarray(directions, dtype=np.float64).reshape(-1)
        mujoco.mj_multiRay(model, data, start, rays, seen, True, -1, geom, distance, normal.reshape(-1), n, 1e6)
    return geom, distance, normal


LOW = FINGER_HALF + FINGER_RADIUS + 0.012
"""Height of the finger's middle while it pushes: its tip is 12 mm above the table."""

HIGH = LOW + 0.26

# Shares of an action's time: coming down, pushing, going up; the rest belongs to settling.
DOWN, PUSH, UP = 0.17, 0.60, 0.15


@dataclass(frozen=True)
class Push:
    """A straight push along the table.

    Parameters
    ----------
    start, end : (x, y) metres
        Path of the finger while it is down.
    seconds : float
        From one pause to the next, settling apart.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    seconds: float

    def target(self, t: float) -> np.ndarray:
        """(3,) where the finger is driven t seconds after the pause."""
        a, b = np.array(self.start), np.array(self.end)
        share = t / self.seconds
        if share < DOWN:
            return np.array([*a, HIGH + (LOW - HIGH) * share / DOWN])
        if share < DOWN + PUSH:
            return np.array([*(a + (b - a) * (share - DOWN) / PUSH), LOW])
        if share < DOWN + PUSH + UP:
            return np.array([*b, LOW + (HIGH - LOW) * (share - DOWN - PUSH) / UP])
        return PARKED


@dataclass(frozen=True)
class Effect:
    """What a push did.

    Parameters
    ----------
    displacement : (n,) metres
        How far each object's origin moved.
    turned : (n,) radians
        How far each object turned.
    settled : bool
        Whether all came to rest.
    kept : bool
        Whether all are still on the table, in the workspace and in view.
    """

    displacement: np.ndarray
    turned: np.ndarray
    settled: bool
    kept: bool

    def moved(self, threshold: float) -> int:
        """Number of objects that moved farther than `threshold` metres."""
        return int((self.displacement > threshold).sum())


def advance(world: World, push: Push, start: float, stop: float) -> None:
    """Carry the push on from `start` to `stop`, seconds after its pause."""
    first, last = round(start / TIME_STEP), round(stop / TIME_STEP)
    parked = round((DOWN + PUSH + UP) * push.seconds / TIME_STEP)
    for k in range(first, last):
        if k == 0:
            world.move_finger(push.target(0.0))
        elif k == parked:
            world.move_finger(PARKED)
        if k < parked:
            world.steer_finger(push.target(k * TIME_STEP))
        world.step()
    world.forward()


def finish(world: World) -> bool:
    """After the last step of a push: wait until all is at rest; False if that took too long."""
    world.move_finger(PARKED)
    return world.settle()


def play(world: World, push: Push, family: SceneFamily) -> Effect:
    """Carry out a whole push and wait until all is at rest."""
    before, turn = world.positions(), world.rotations()
    advance(world, push, 0.0, push.seconds)
    settled = finish(world)
    return effect(world, before, turn, settled, family)


def effect(world: World, before: np.ndarray, turn: np.ndarray, settled: bool, family: SceneFamily) -> Effect:
    """The effect of a push, from positions (n, 3) and rotations (n, 3, 3) before it."""
    after = world.positions()
    trace = np.einsum("nij,nij->n", turn, world.rotations())
    kept = bool(family.holds(after).all())
    moved = np.linalg.norm(after - before, axis=1)
    return Effect(moved, np.arccos(np.clip((trace - 1) / 2, -1, 1)), settled, kept)


def _clear(world: World, at: tuple[float, float]) -> bool:
    """Whether the finger can come down at a place without meeting an object."""
    saved = world.save()
    good = True
    for height in np.linspace(HIGH, LOW, 5):
        world.move_finger((*at, height))
        world.forward()
        if world.overlaps():
            good = False
            break
    world.restore(saved)
    return good


def _candidate(rng: np.random.Generator, world: World, family: SceneFamily) -> Push:
    """A line towards one object, preferably one with others behind it."""
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
    length = family.push_speed * PUSH * family.action_seconds
    aim = goal + rng.uniform(-0.02, 0.02, 2)
    start = aim - direction * float(rng.uniform(0.07, 0.13))
    end = start + direction * length
    return Push((float(start[0]), float(start[1])), (float(end[0]), float(end[1])), family.action_seconds)


def choose_push(rng: np.random.Generator, world: World, family: SceneFamily) -> Push:
    """A push that moves something, chosen by simulating candidates; the world is left as it was.

    The first candidate wins that moves `family.min_moved` objects; else the one that moves most. None may
    drop an object, leave one in motion or knock one over where another choice exists.

    Raises
    ------
    InputError
        If no candidate moves any object.
    """
    saved = world.save()
    best: tuple[float, Push] | None = None
    for _ in range(4 * family.n_candidates):
        push = _candidate(rng, world, family)
        if not _clear(world, push.start):
            continue
        result = play(world, push, family)
        world.restore(saved)
        if not (result.kept and result.settled):
            continue
        count = result.moved(family.move_threshold)
        toppled = int((result.turned > np.deg2rad(75)).sum())
        if count == 0:
            continue
        if count >= family.min_moved and toppled == 0:
            return push
        score = min(count, family.min_moved) - 0.7 * toppled
        if best is None or score > best[0]:
            best = (score, push)
    if best is None:
        raise InputError(
            f"scene family {family.name!r}: no push of {4 * family.n_candidates} tried moves an object "
            f"by more than {family.move_threshold} m without dropping one",
            "lower move_threshold, or raise push_speed, the length of an action or n_candidates",
        )
    return best[1]

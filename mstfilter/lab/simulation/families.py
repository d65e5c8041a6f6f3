"""Families of simulated scenes: a family and one integer seed define a recording.

>>> from mstfilter.lab.simulation import scene_family
>>> scene_family("demo").n_frames, scene_family("table").grid().shape
(15, (100, 100, 50))

A family is a frozen `SceneFamily`. `dataclasses.replace` makes variants for `simulate_recording`. The command line
and the studies use the names in `SCENE_FAMILIES`. New kinds of objects are added to `_MAKERS` in `shapes`. The
studies use `s1`, `s2` and `s3` with 5, 9 and 15 to 20 objects and the same camera, sensor and textures. The field
`catalogue` separates scenes for tuning from scenes for reporting. In `s1` to `s3`, the seed determines the catalogue.

`m1`, `m2` and `m3` are like `s1` to `s3` with meshes of real objects (`objects`). The seed also determines the pool
of meshes: below 1000 tuning, from 1000 on reported. Networks are trained on scenes with ``mesh_pool="training"``.

In `row`, `stack` and `pack`, some things are several objects that touch, and some are one object that looks like
several: a box with two prints, a pack of cans, a body of two parts. `one_share` is the share of the latter, and
`push_aims` says whether a push moves one object of a group, moves the group as one body, or leaves all groups alone.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from mstfilter.base.errors import InputError, check_integer, suggestion
from mstfilter.base.fields import Bounded, Bounds, NonNegativeInt, PositiveFloat, PositiveInt, Share
from mstfilter.lab.simulation.objects import MeshPool, ObjectSet, open_objects
from mstfilter.lab.simulation.sensor import SENSORS, DepthSensor
from mstfilter.lab.simulation.shapes import ANY, REPORTED, SHAPE_FAMILIES, TUNING, Pool
from mstfilter.scene import Camera, VoxelGrid, look_at

_LOOKS_AT = np.array([0.02, 0.05, 0.04])
_TOWARDS_CAMERA = np.array([0.03, -0.77, 0.54]) / np.linalg.norm([0.03, -0.77, 0.54])

GENERATOR_VERSION = 7  #: Raised whenever the bytes of the recording of a seed change

FIRST_REPORTED_SEED = 1000  #: With the catalogue "by seed", seeds from this one on draw from the reported pool

_POOLS = {"tuning": TUNING, "reported": REPORTED, "any": ANY}

_ImageSize = Annotated[int, Bounds(at_least=16, at_most=4096)]
_Edge = Annotated[float, Bounds(at_least=0.1, at_most=2.0)]
_Degrees = Annotated[float, Bounds(at_least=-25.0, at_most=50.0, unit="number of degrees")]

PUSH_AIMS = ("apart", "together", "nothing")  #: What a push does to groups of objects
_FIRST_ADDED = "sensor"  # fields from this one on are described only if they differ from the default


@dataclass(frozen=True)
class SceneFamily(Bounded):
    """Parameters for sampling, pushing and rendering scenes."""

    name: str = "table"  #: name of the family
    n_objects_min: PositiveInt = 5  #: range of the number of objects on the table, twins included; uniform
    n_objects_max: int = 6  #: see `n_objects_min`
    n_twins: int = 1  #: objects that repeat the shape and texture of another object and touch it
    n_stacked: int = 0  #: objects that are put on top of another object, if there is room
    #: Small objects that are put behind tall objects, seen from the camera. If `n_hidden` > 0, at most a third of all
    #: objects is hidden at the first pause.
    n_hidden: int = 0
    #: Probability that an object without a twin touches another object; otherwise the gap is 1 - 4 cm.
    contact: Share = 0.6
    shapes: str = "all"  #: families of objects, separated by commas; "all" for every family
    #: Pool of sizes and textures: one of two disjoint pools, or all. "by seed": the tuning pool for seeds below 1000,
    #: the reported pool from 1000 on.
    catalogue: Literal["tuning", "reported", "any", "by seed"] = "any"
    n_actions: NonNegativeInt = 3  #: number of pushes
    frames_per_clip: Annotated[int, Bounds(at_least=2)] = 15  #: frames from one pause to the next, both included
    fps: Annotated[float, Bounds(at_least=0.5, at_most=60.0)] = 5.0  #: frames per second
    push_speed: Annotated[float, Bounds(at_least=0.01, at_most=0.5)] = 0.10  #: speed of the finger, m/s
    min_moved: PositiveInt = 2  #: objects that an action should move; fewer if no candidate push moves as many
    #: Objects that an action should topple or turn by more than 75 degrees; fewer if no candidate push does. With 0,
    #: pushes that topple objects are avoided.
    min_toppled: NonNegativeInt = 0
    #: Displacement from which an object counts as moved, metres.
    move_threshold: Annotated[float, Bounds(at_least=0.0001, at_most=0.5)] = 0.02
    n_candidates: PositiveInt = 24  #: a push is chosen from at most 4 `n_candidates` simulated pushes
    arm: bool = True  #: whether the finger has a visible arm
    #: Size of the images, pixels. The camera is a Kinect's (focal length 525 pixels at 640 x 480), scaled.
    width: _ImageSize = 640
    height: _ImageSize = 480
    supersample: bool = True  #: smooth the edges of objects with three rays per pixel
    #: From the camera to the middle of the table, metres.
    camera_distance: Annotated[float, Bounds(at_least=0.5, at_most=2.0)] = 0.8
    workspace_x: _Edge = 1.0  #: edges in metres of the voxel grid, which stands on the middle of the table
    workspace_y: _Edge = 1.0
    workspace_z: _Edge = 0.5
    voxel_size: Annotated[float, Bounds(at_least=0.001, at_most=0.1)] = 0.01  #: edge of a voxel, metres
    #: Depth camera: errors, missing readings and focal length; see `SENSORS`.
    sensor: Literal["xtion", "d415", "d435", "azure", "l515"] = "xtion"
    camera_higher: _Degrees = 0.0  #: degrees by which the camera looks down more steeply than by 35 degrees
    #: Folder of meshes, of which the objects are drawn; see `mstfilter.lab.simulation.objects`. Variables of the
    #: environment are replaced. Empty for generated objects.
    objects: str = ""
    mesh_share: Share = 1.0  #: probability that an object is a mesh, if `objects` names a folder
    #: Pool of meshes. "by seed": the tuning pool for seeds below 1000, the reported pool from 1000 on.
    mesh_pool: Literal["training", "tuning", "reported", "all", "by seed"] = "all"
    object_scale: PositiveFloat = 1.0  #: factor of the lengths in the files of meshes, 0.001 for millimetres
    object_up: Literal["auto", "y", "z"] = "auto"  #: axis that points up in the files; "auto": y for glTF, else z
    n_dropped: NonNegativeInt = 0  #: objects that fall into, onto or against another object
    #: Probability that an object stands at any free place of the table in view, instead of beside another object.
    #: Twins and objects that are stacked, hidden or dropped stand where they have to.
    apart: Share = 0.0
    furniture: Share = 0.0  #: probability that a wall, a board or a tray is in view
    groups: Literal["", "row", "stack", "pack"] = ""  #: how the objects of a group stand
    n_groups: NonNegativeInt = 0  #: groups of objects; the other objects are alone
    one_share: Share = 0.5  #: probability that a group is one object that looks like several
    #: What pushes do to groups, separated by commas: `apart`, `together`, `nothing`. Each push draws one. Empty:
    #: pushes do not heed groups.
    push_aims: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("n_objects_max", self.n_objects_max, at_least=self.n_objects_min, at_most=40)
        for field in ("n_twins", "n_stacked", "n_hidden"):
            check_integer(field, getattr(self, field), at_least=0, at_most=self.n_objects_min - 1)
        check_integer("n_groups", self.n_groups, at_least=0, at_most=self.n_objects_min)
        check_integer("n_dropped", self.n_dropped, at_least=0, at_most=self.n_objects_min - 1)
        if self.n_groups and not self.groups:
            raise InputError(
                f"scene family {self.name!r}: {self.n_groups} groups of no kind", "groups=row, stack or pack"
            )
        self.aims()
        self.shape_families()
        if self.n_actions and self.action_seconds < 1.0:
            raise InputError(
                f"scene family {self.name!r}: an action lasts {self.action_seconds:.2f} s "
                f"({self.frames_per_clip} frames at {self.fps} fps), too short to push anything",
                "use more frames per clip or fewer frames per second; an action needs at least 1 s",
            )

    @property
    def action_seconds(self) -> float:
        """Seconds from one pause to the next, without the time until objects are at rest."""
        return (self.frames_per_clip - 1) / self.fps

    @property
    def n_frames(self) -> int:
        """Number of frames of a recording."""
        return 1 + self.n_actions * (self.frames_per_clip - 1)

    def pool(self, seed: int) -> Pool:
        """The set of sizes and textures from which the scene of a seed is drawn."""
        if self.catalogue == "by seed":
            return TUNING if seed < FIRST_REPORTED_SEED else REPORTED
        return _POOLS[self.catalogue]

    def shape_families(self) -> tuple[str, ...]:
        """Names of the families of objects."""
        names = SHAPE_FAMILIES if self.shapes.strip() == "all" else tuple(s.strip() for s in self.shapes.split(","))
        unknown = [name for name in names if name not in SHAPE_FAMILIES]
        if unknown:
            raise InputError(
                f"scene family {self.name!r}: unknown family of shapes {unknown[0]!r}",
                f"known: {', '.join(SHAPE_FAMILIES)}; or all",
            )
        return names

    def aims(self) -> tuple[str, ...]:
        """The parts of `push_aims`."""
        names = tuple(name.strip() for name in self.push_aims.split(",") if name.strip())
        for name in names:
            if name not in PUSH_AIMS:
                raise InputError(f"scene family {self.name!r}: unknown aim of pushes {name!r}", *PUSH_AIMS)
        return names

    def depth_sensor(self) -> DepthSensor:
        """The model of the depth camera."""
        return SENSORS[self.sensor]

    def object_set(self) -> ObjectSet | None:
        """The objects with meshes; None if all objects are generated. Raises InputError if a mesh is not usable."""
        return open_objects(self.objects, self.object_scale, self.object_up) if self.objects else None

    def object_pool(self, seed: int) -> MeshPool:
        """The pool of meshes from which the scene of a seed is drawn."""
        if self.mesh_pool == "by seed":
            return "tuning" if seed < FIRST_REPORTED_SEED else "reported"
        return self.mesh_pool

    def described(self) -> dict[str, Any]:
        """The fields, without later additions at their defaults. A folder of objects is its name and content."""
        names = [f.name for f in fields(self)]
        added = names[names.index(_FIRST_ADDED) :]
        default = {f.name: f.default for f in fields(self)}
        found = {k: v for k, v in asdict(self).items() if k not in added or v != default[k]}
        if (objects := self.object_set()) is not None:
            found |= {"objects": Path(objects.folder).name, "objects_key": objects.key}
        return found

    def camera(self) -> Camera:
        """The camera, which looks down at the middle of the table, scaled to the images of the family."""
        towards = _TOWARDS_CAMERA
        if self.camera_higher:
            across = float(np.hypot(*towards[:2]))
            angle = np.arctan2(towards[2], across) + np.deg2rad(self.camera_higher)
            towards = np.array([*(towards[:2] / across * np.cos(angle)), np.sin(angle)])
        eye = _LOOKS_AT + self.camera_distance * towards
        focal = self.depth_sensor().focal
        kinect = Camera.from_intrinsics(focal, focal, 319.5, 239.5, 640, 480, look_at(eye, _LOOKS_AT))
        scaled = kinect.scaled(self.width / 640.0)
        # Images that are not 4 : 3 are cut or extended above and below, with the same middle.
        K = scaled.K.copy()
        K[1, 2] += (self.height - scaled.height) / 2
        return Camera(K, self.width, self.height, kinect.T_world_camera)

    def contains_points(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool: whether points (n, 3) are above the table, in the workspace and in the image, with a margin."""
        uv, depth = self.camera().project(points)
        size = np.array((self.width, self.height))
        with np.errstate(invalid="ignore"):
            seen = (depth > 0) & ((uv > 0.05 * size) & (uv < 0.95 * size)).all(axis=1)
        reach = np.array([self.workspace_x, self.workspace_y]) / 2 - 0.05
        return seen & (np.abs(points[:, :2]) < reach).all(axis=1) & (points[:, 2] > 0)

    def grid(self) -> VoxelGrid:
        """The voxel grid of the workspace."""
        x, y, z = self.workspace_x, self.workspace_y, self.workspace_z
        return VoxelGrid.from_bounds(np.array([-x / 2, -y / 2, 0.0]), np.array([x / 2, y / 2, z]), self.voxel_size)


_STUDIED = SceneFamily(
    name="s1", n_objects_min=5, n_objects_max=5, n_twins=1, n_stacked=1, contact=0.8, catalogue="by seed", n_actions=4
)

_S2 = replace(_STUDIED, name="s2", n_objects_min=9, n_objects_max=9, n_twins=2, n_stacked=2, n_hidden=1, min_moved=3)

_DEMO = SceneFamily(
    name="demo",
    n_objects_min=5,
    n_objects_max=5,
    n_actions=2,
    frames_per_clip=8,
    fps=4.0,
    push_speed=0.12,
    width=320,
    height=240,
    workspace_x=0.8,
    workspace_y=0.8,
    workspace_z=0.3,
)

#: The named families.
SCENE_FAMILIES: dict[str, SceneFamily] = {
    "demo": _DEMO,
    # Small objects stand behind tall ones, and three pushes hide and uncover objects: earlier images show more than
    # the latest one.
    "occlusion": replace(
        _DEMO, name="occlusion", n_objects_min=7, n_objects_max=7, n_hidden=2, n_actions=3, frames_per_clip=10
    ),
    "table": SceneFamily(name="table"),
    "s1": _STUDIED,
    "s2": _S2,
    "s3": replace(
        _STUDIED, name="s3", n_objects_min=15, n_objects_max=20, n_twins=4, n_stacked=4, n_hidden=3, min_moved=3
    ),
    # Every push topples or turns an object, which shows sides that were hidden.
    "topple": replace(_S2, name="topple", min_moved=1, min_toppled=1),
}

_MESHES: dict[str, Any] = {
    "objects": "$MSTFILTER_OBJECTS", "mesh_pool": "by seed", "apart": 0.8, "furniture": 0.2, "min_moved": 2
}  # fmt: skip
_GROUPED = replace(_STUDIED, n_twins=0, n_stacked=0, min_moved=1, push_aims="apart, together, nothing")
SCENE_FAMILIES |= {
    "m1": replace(SCENE_FAMILIES["s1"], name="m1", n_twins=0, n_dropped=1, **_MESHES),
    "m2": replace(_S2, name="m2", n_twins=1, n_stacked=1, n_dropped=1, **_MESHES),
    "m3": replace(SCENE_FAMILIES["s3"], name="m3", n_twins=2, n_stacked=2, n_dropped=2, **_MESHES),
    "row": replace(_GROUPED, name="row", n_objects_min=3, n_objects_max=5, groups="row", n_groups=2),
    "stack": replace(_GROUPED, name="stack", n_objects_min=3, n_objects_max=5, groups="stack", n_groups=2),
    "pack": replace(_GROUPED, name="pack", n_objects_min=2, n_objects_max=4, groups="pack", n_groups=1),
}


def scene_family(name: str) -> SceneFamily:
    """A family of `SCENE_FAMILIES`. Raises InputError if the name is unknown."""
    if name not in SCENE_FAMILIES:
        raise InputError(
            f"unknown scene family {name!r}", *suggestion(name, SCENE_FAMILIES), f"known: {', '.join(SCENE_FAMILIES)}"
        )
    return SCENE_FAMILIES[name]

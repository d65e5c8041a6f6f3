"""What the generators of training samples share: clutter at rest under physics, its cameras, and files of samples.

>>> world = Clutter().draw(np.random.default_rng(0))
>>> camera = draw_camera(rng, (0, 0), elevation=(22, 68), distance=(0.55, 1.05))
>>> View.of(world, camera).instance
>>> CompletionSamples.write(folder, seed=0, n_scenes=1000, workers=2)      # resumable
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from mst_training.shapes import TRAINED, draw_kind, draw_training_shape
from mstfilter.base.errors import InputError
from mstfilter.base.files import atomic_path
from mstfilter.base.processes import environment
from mstfilter.base.reading import MAX_WEIGHTS, read_arrays
from mstfilter.lab.simulation.arrangement import SceneObjects, arrange_objects, draw_wall
from mstfilter.lab.simulation.families import SceneFamily
from mstfilter.lab.simulation.objects import MeshPool, open_objects
from mstfilter.lab.simulation.shapes import Shape
from mstfilter.lab.simulation.world import MESH_GROUP, OBJECT_GROUP, ROOM_GROUP, PhysicsWorld
from mstfilter.scene import Camera, look_at, scene_cache

WIDTH, HEIGHT = 320, 240  # pixels of an image
_LONGEST = 0.45  # longest side to which a mesh is enlarged, metres


@dataclass(frozen=True)
class Clutter:
    """What the scenes of a training look like: 2 to 12 objects, at rest under physics."""

    kinds: tuple[str, ...] = TRAINED  #: generated shapes (`mst_training.shapes`)
    objects: str = ""  #: folder of meshes (`open_objects`); none if empty
    pool: MeshPool = "training"
    #: Range of the factor by which the objects of a scene are larger than drawn. Above 1, half of the scenes whose
    #: range starts at 1 are not larger.
    sizes: tuple[float, float] = (1.0, 1.0)
    walls: float = 0.0  #: share of the scenes with a wall behind or beside the objects
    alike: float = 0.0  #: share of the scenes in which several objects have the same shape, and all touch

    def draw(self, rng: np.random.Generator) -> PhysicsWorld | None:
        """Draw a scene; None if the objects do not fit."""
        least, largest = self.sizes
        n = int(rng.integers(2, 13 if least <= 1 else 7))
        larger = least > 1 or (largest > 1 and rng.uniform() < 0.5)
        scale = least * (largest / least) ** rng.uniform() if larger else 1.0
        share = float(rng.uniform()) if self.objects else 0.0
        shapes = [self._shape(rng, scale, share) for _ in range(n)]
        alike = self.alike > 0 and rng.uniform() < self.alike
        if alike:
            some = int(rng.integers(1, 4))
            shapes = [shapes[k % some] for k in range(n)]
        wall = draw_wall(rng) if self.walls and rng.uniform() < self.walls else None
        world = PhysicsWorld(shapes, arm=False, wall=wall)
        n_dropped = int(rng.integers(0, n // 2 + 1)) if rng.uniform() < 0.6 else 0
        family = SceneFamily(
            name="training",
            n_objects_min=n - n_dropped,
            n_objects_max=n,
            n_twins=0,
            contact=1.0 if alike else float(rng.uniform(0.3, 1.0)),
            n_actions=0,
        )
        order = rng.permutation(n)
        try:
            # Dropped objects start far away; the others are arranged first.
            first = PhysicsWorld([shapes[k] for k in order[n_dropped:]], arm=False, wall=wall)
            arrange_objects(rng, first, family, SceneObjects(first.shapes, wall=wall))
        except InputError:
            return None
        placed = zip(order[n_dropped:].tolist(), first.positions(), first.rotations(), strict=True)
        for k, position, rotation in placed:
            world.place(k, position, rotation)
        world.forward()
        for k in order[:n_dropped].tolist():
            near = world.positions()[order[n_dropped:]]
            at = near[int(rng.integers(len(near))), :2] + rng.normal(0.0, 0.03, 2)
            above = 0.12 + shapes[k].radius + rng.uniform(0.0, 0.1)
            world.place(k, (*at, above), Rotation.random(rng=rng).as_matrix())
            world.forward()
            if not world.overlaps(k):
                world.settle()
            else:
                put_away(world, k)
        world.forward()
        return world

    def _shape(self, rng: np.random.Generator, scale: float, share: float) -> Shape:
        """A mesh with probability `share`, or a generated shape."""
        if not share or rng.uniform() >= share:
            return draw_training_shape(rng, draw_kind(rng, self.kinds), scale)
        drawn = open_objects(self.objects).draw(rng, self.pool)
        scale = min(scale, max(_LONGEST / (2 * float(drawn.half.max())), 1.0))
        assert drawn.surface is not None
        size = drawn.scale * scale
        mass = drawn.mass * scale**3
        return Shape.of_surface(drawn.surface, size, drawn.family, drawn.name, mass, drawn.finish)


def put_away(world: PhysicsWorld, k: int) -> None:
    """Put object k far beside the table."""
    world.place(k, (10.0 + 2.0 * k, 0.0, 1.0), np.eye(3))


def on_table(poses: np.ndarray) -> np.ndarray:
    """Objects (n,) bool with poses (n, 4, 4) in the middle of the table."""
    return np.asarray((np.abs(poses[:, :2, 3]) < 0.4).all(axis=1) & (poses[:, 2, 3] > 0))


def draw_camera(
    rng: np.random.Generator,
    middle: ArrayLike,
    elevation: tuple[float, float],
    distance: tuple[float, float],
    zoom: float = 1.0,
) -> Camera:
    """Draw a camera that looks at the table near `middle` (x, y), from an elevation in degrees and a distance in m.

    The focal length is that of a Kinect times `zoom`.
    """
    target = np.append(middle, 0.05) + rng.normal(0.0, 0.03, 3)
    azimuth, raised, far = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(*elevation)), rng.uniform(*distance)
    flat = np.cos(raised)
    away = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(raised)])
    focal = 525.0 * zoom
    camera = Camera.from_intrinsics(focal, focal, 319.5, 239.5, 640, 480, look_at(target + far * away, target))
    return camera.scaled(WIDTH / 640)


def displaced(rng: np.random.Generator, camera: Camera) -> Camera:
    """The camera with a small error of its pose, as of a calibration."""
    shift, tilt = rng.normal(0.0, 0.0015, 3), Rotation.from_rotvec(rng.normal(0.0, 0.003, 3))
    return camera.at(RigidTransform.from_components(shift, tilt) * camera.pose)


def world_rays(camera: Camera) -> np.ndarray:
    """Directions (n, 3) of all pixels in the world, of unit z-depth."""
    return camera.rays().reshape(-1, 3) @ camera.pose.as_matrix()[:3, :3].T


def cast(world: PhysicsWorld, camera: Camera, groups: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Geom (n,), z-depth (n,) and normal (n, 3) of every pixel of a camera (`PhysicsWorld.cast`)."""
    return world.cast(np.array(camera.position), world_rays(camera), groups)


@dataclass(frozen=True, eq=False)
class View:
    """What a camera without noise sees of a scene; n is the number of pixels."""

    camera: Camera
    geom: np.ndarray  #: (n,) of `PhysicsWorld.cast`, -1 for none
    points: np.ndarray  #: (n, 3) in the world; the camera's position where the ray hits nothing
    normal: np.ndarray  #: (n, 3)
    instance: np.ndarray  #: (H, W) uint8, object of every pixel, 0 for none
    depth: np.ndarray  #: (H, W) float32 metres, NaN for none
    slant: np.ndarray  #: (H, W) float32, cosine of the angle of incidence

    @classmethod
    def of(cls, world: PhysicsWorld, camera: Camera) -> Self:
        """The view of all pixels of a camera."""
        rays = world_rays(camera)
        geom, z, normal = cast(world, camera, (ROOM_GROUP, OBJECT_GROUP, MESH_GROUP))
        hit = geom >= 0
        instance = np.where(hit, world.geom_object[np.maximum(geom, 0)], 0).astype(np.uint8)
        points = np.array(camera.position) + rays * np.where(hit, z, 0)[:, None]
        cosine = np.abs((rays * normal).sum(axis=1)) / np.linalg.norm(rays, axis=1)
        images = (instance, np.where(hit, z, np.nan).astype(np.float32), cosine.astype(np.float32))
        return cls(camera, geom, points, normal, *(image.reshape(HEIGHT, WIDTH) for image in images))


class Samples:
    """Samples as a dataclass of arrays; the first axis of each is the sample.

    A subclass defines the arrays, and how one scene gives samples.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]
    clutter: ClassVar[Clutter] = Clutter()

    @classmethod
    def of_world(cls, rng: np.random.Generator, world: PhysicsWorld, index: int) -> Self | None:
        """The samples of scene number `index`; None if it shows no object."""
        raise NotImplementedError

    @classmethod
    def of_scene(cls, seed: int, index: int, clutter: Clutter | None = None) -> Self:
        """The samples of scene number `index`, which follow from the arguments alone."""
        clutter = clutter or cls.clutter
        for attempt in range(20):
            rng = np.random.default_rng([seed, index, attempt])
            world = clutter.draw(rng)
            samples = None if world is None else cls.of_world(rng, world, index)
            if samples is not None:
                return samples
        raise InputError(f"no scene could be made of {clutter}")

    @classmethod
    def write(
        cls,
        folder: str | Path,
        seed: int,
        n_scenes: int,
        workers: int = 1,
        clutter: Clutter | None = None,
        per_file: int = 10,
    ) -> list[Path]:
        """Write the samples of scenes 0 .. n - 1 to files of a folder; existing files are kept.

        The files are the same for any number of workers.
        """
        jobs = [
            (
                Path(folder) / f"scenes-{start:06d}.npz",
                cls,
                seed,
                range(start, min(start + per_file, n_scenes)),
                clutter,
            )
            for start in range(0, n_scenes, per_file)
        ]
        if workers > 1:
            with environment(), ProcessPoolExecutor(workers) as pool:
                list(pool.map(_write_file, jobs))
        else:
            for job in jobs:
                _write_file(job)
        return [job[0] for job in jobs]

    @classmethod
    def read(cls, paths: Sequence[Path]) -> Self:
        """The samples of files."""
        return cls.join([cls(**read_arrays(path, "samples of a training", limit=MAX_WEIGHTS)) for path in paths])

    def save(self, path: str | Path) -> None:
        """Write the samples to an npz file that `read` reads."""
        columns: dict[str, Any] = self.columns()
        with atomic_path(Path(path)) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **columns)

    def columns(self) -> dict[str, np.ndarray]:
        """The arrays by name."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    def __len__(self) -> int:
        return len(next(iter(self.columns().values())))

    def take(self, index: np.ndarray) -> Self:
        """Some samples."""
        return type(self)(*(values[index] for values in self.columns().values()))

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """All samples of several parts."""
        return cls(*(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(cls)))


def _write_file(job: tuple[Path, type[Samples], int, range, Clutter | None]) -> None:
    path, samples, seed, scenes, clutter = job
    if not path.exists():
        made = samples.join([samples.of_scene(seed, k, clutter) for k in scenes])
        scene_cache.clear()
        made.save(path)

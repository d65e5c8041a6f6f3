"""The rendered poses (`Stage`), and the light on the table (`LightMap`) and on bodies (`BodyColours`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mstfilter.lab.simulation.shapes import Shape
from mstfilter.lab.simulation.textures import Atlas, Room, linear_light, texture_coordinates
from mstfilter.lab.simulation.world import (
    FINGER_GROUP,
    FINGER_ID,
    MESH_GROUP,
    OBJECT_GROUP,
    PIECE_GROUP,
    PhysicsWorld,
)

SHADOW_GROUPS = (OBJECT_GROUP, FINGER_GROUP, MESH_GROUP)  #: Geoms that cast shadows on bodies
_TABLE_SHADOW_GROUPS = (OBJECT_GROUP, FINGER_GROUP, PIECE_GROUP)  # on the table, the pieces of meshes do
_NEAR = 0.008  # points of a block of pixels that share shadow rays: metres between them at most

_LIFT = 0.0012  # metres off the surface, against shadows of a surface on itself
_MAP_LOW, _MAP_HIGH = np.array([-0.62, -0.55]), np.array([0.62, 0.66])
_FINGER_COLOUR = np.array([0.09, 0.095, 0.105], np.float32)


class Stage:
    """The poses at which bodies are rendered, without the small vibrations of the simulated poses.

    Soft contacts make bodies at rest move by micrometres between frames. A rendered pose changes only if a point of
    the body has moved by more than `tolerance` metres. Images, recorded poses and volumes agree exactly, because all
    use the rendered poses.
    """

    def __init__(self, world: PhysicsWorld, tolerance: float) -> None:
        import mujoco

        self.world, self.tolerance = world, tolerance
        self._mj, self._data = mujoco, mujoco.MjData(world.model)
        self._radius = np.array([shape.radius for shape in world.shapes])
        self.poses: np.ndarray = world.poses()  #: T_world_object (n, 4, 4) as rendered
        self._finger = world.finger_position()
        self._data.qpos[:] = world.data.qpos
        mujoco.mj_kinematics(world.model, self._data)

    def follow(self) -> None:
        """Update the rendered poses of the finger, and of objects that have moved by more than the tolerance."""
        world = self.world
        now, finger = world.poses(), world.finger_position()
        shift = np.linalg.norm(now[:, :3, 3] - self.poses[:, :3, 3], axis=1)
        turn = np.linalg.norm(now[:, :3, :3] - self.poses[:, :3, :3], axis=(1, 2))
        moved = shift + turn * self._radius > self.tolerance
        if not moved.any() and (finger == self._finger).all():
            return
        self.poses = np.where(moved[:, None, None], now, self.poses)
        self._finger = finger
        index = world.pose_index[moved]
        self._data.qpos[:3] = finger
        self._data.qpos[index] = world.data.qpos[index]
        self._mj.mj_kinematics(world.model, self._data)

    def save(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The rendered poses, as the parameter of `restore`."""
        return self.poses.copy(), self._finger.copy(), self._data.qpos.copy()

    def restore(self, saved: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
        """Set the rendered poses to saved poses."""
        self.poses, self._finger = saved[0].copy(), saved[1].copy()
        self._data.qpos[:] = saved[2]
        self._mj.mj_kinematics(self.world.model, self._data)

    def cast(
        self, origin: ArrayLike, directions: np.ndarray, groups: Sequence[int] = (0, 1, 2, 4)
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cast rays as in `PhysicsWorld.cast`, with bodies at the rendered poses."""
        return self.world.cast(origin, directions, groups, self._data)


class _Shared(NamedTuple):
    """Which points share shadow rays."""

    first: np.ndarray  #: (n,) the first point of the block and geom of each point, or itself if that one is not near
    beside: (
        np.ndarray
    )  #: (n, 4) the first points of the same geom in the blocks beside, or `first` where there is none

    @classmethod
    def of(cls, block: np.ndarray, stride: int, geom: np.ndarray, points: np.ndarray) -> _Shared:
        """Points (n, 3) on geoms (n,) in blocks (n,) of pixels; `stride` is from one row of blocks to the next."""
        n_geoms = int(geom.max(initial=0)) + 1
        keys, example, same = np.unique(block * n_geoms + geom, return_index=True, return_inverse=True)
        first = example[same.reshape(-1)]
        apart = np.abs(points - points[first]).max(axis=1, initial=0.0) > _NEAR
        first = np.where(apart, np.arange(len(geom)), first)
        beside = []
        for step in (-1, 1, -stride, stride):
            key = (block + step) * n_geoms + geom
            at = np.searchsorted(keys, key).clip(0, len(keys) - 1)
            beside.append(np.where(keys[at] == key, example[at], first))
        return cls(first, np.stack(beside, axis=1))

    def among(self, chosen: np.ndarray) -> _Shared:
        """The same among the chosen points (n,) bool, which share rays with chosen points only."""
        new = np.cumsum(chosen) - 1
        return _Shared(new[self.first[chosen]], new[self.beside[chosen]])


def _cosine_to_light(
    stage: Stage, light: np.ndarray, points: np.ndarray, normal: np.ndarray, shared: _Shared | None = None
) -> np.ndarray:
    """Cosine (n,) float32 of the angle between normal and light direction at points (n, 3), 0 in shadow.

    With `shared`, a point is in shadow if the first point of its block is. At the border of a shadow, where a block
    beside differs, each point has its own ray.
    """
    ray = points - light
    cosine = -_dot(ray, normal) / np.sqrt(_dot(ray, ray))
    if shared is not None:
        own = np.unique(shared.first)
        _, distance, _ = stage.cast(light, ray[own], SHADOW_GROUPS)
        clear = np.zeros(len(points), bool)
        clear[own] = (distance < 0) | (distance > 1.0 - 1e-6)
        border = (clear[shared.beside] != clear[shared.first][:, None]).any(axis=1) & (cosine > 0)
        border = np.flatnonzero(border & (shared.first != np.arange(len(points))))
        _, distance, _ = stage.cast(light, ray[border], SHADOW_GROUPS)
        clear = clear[shared.first]
        clear[border] = (distance < 0) | (distance > 1.0 - 1e-6)
        return np.where(clear, np.maximum(cosine, 0.0), 0.0).astype(np.float32)
    lit = np.flatnonzero(cosine > 0.0)
    _, distance, _ = stage.cast(light, ray[lit], SHADOW_GROUPS)
    visible = (distance < 0) | (distance > 1.0 - 1e-6)
    result = np.zeros(len(points), np.float32)
    result[lit[visible]] = cosine[lit[visible]]
    return result


class LightMap:
    """Raster of the light on the table, with points `spacing` metres apart.

    A value is the mean, over the sources `lights` (k, 3), of the cosine of the angle of incidence (0 in shadow).
    """

    def __init__(self, spacing: float, lights: np.ndarray) -> None:
        self._spacing, self._lights = spacing, lights
        nx, ny = (np.ceil((_MAP_HIGH - _MAP_LOW) / spacing).astype(int) + 1).tolist()
        x, y = _MAP_LOW[0] + spacing * np.arange(nx), _MAP_LOW[1] + spacing * np.arange(ny)
        grid = np.meshgrid(x, y, indexing="ij")
        self._shape = (nx, ny)
        self._rays = np.stack([grid[0].ravel(), grid[1].ravel(), np.full(nx * ny, _LIFT)], axis=1) - lights[:, None]
        self._cosine = (-self._rays[:, :, 2] / np.linalg.norm(self._rays, axis=2)).astype(np.float32)
        self._values = np.zeros(nx * ny, np.float32)

    def update(self, stage: Stage) -> None:
        """Compute the raster from shadow rays at the rendered poses."""
        self._values[:] = 0
        for light, rays, cosine in zip(self._lights, self._rays, self._cosine, strict=True):
            _, distance, _ = stage.cast(light, rays, _TABLE_SHADOW_GROUPS)
            dark = (distance >= 0) & (distance <= 1.0 - 1e-6)
            self._values += np.where(dark, np.float32(0), cosine)
        self._values /= np.float32(len(self._lights))

    def sample(self, xy: np.ndarray) -> np.ndarray:
        """Interpolated values (n,) at points (n, 2) of the table. Points outside the map take the border value."""
        place = np.clip((xy - _MAP_LOW) / self._spacing, 0, np.array(self._shape) - 1.001)
        at = place.astype(np.int64)
        share = (place - at).astype(np.float32)
        values, ny = self._values, self._shape[1]
        corner = at[:, 0] * ny + at[:, 1]
        low = values[corner] * (1 - share[:, 1]) + values[corner + 1] * share[:, 1]
        high = values[corner + ny] * (1 - share[:, 1]) + values[corner + ny + 1] * share[:, 1]
        return low * (1 - share[:, 0]) + high * share[:, 0]


class BodyColours:
    """Colours of points on objects and on the finger, seen from the camera at `eye` (3,).

    Blocks of pixels have numbers; `stride` is the difference of the numbers from one row of blocks to the next.
    """

    def __init__(self, stage: Stage, atlas: Atlas, room: Room, eye: np.ndarray, stride: int) -> None:
        self._stage, self._atlas, self._room, self._eye, self._stride = stage, atlas, room, eye, stride
        #: Of each surface of the world, the index of its first piece among the pieces of its body.
        self._first_piece: list[int] = []
        for shape in stage.world.shapes:
            counts = [len(part.shape.pieces) for part in shape.surfaces]
            self._first_piece += np.cumsum([0, *counts[:-1]]).tolist()

    def at(
        self, geom: np.ndarray, points: np.ndarray, normal: np.ndarray, block: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Linear colours (n, 3) float32 of points (n, 3) with normals (n, 3) on MuJoCo geoms (n,).

        `block` (n,) is the number of the block of pixels of each point; near points of a block share shadow rays in
        worlds with meshes, for which rays take longer. Also returns the share of light that the points reflect (n,),
        and the strength of the highlight (n,) of a lamp at the camera, 0 .. 1.
        """
        room, instance = self._room, self._stage.world.geom_object[geom]
        albedo, gloss, smooth = self._materials(instance, geom, points, normal)
        # Highlight by Blinn and Phong: the normal against the half vector between eye and lamp.
        middle = _unit(self._eye - points) + _unit(room.lamp.mean(axis=0) - points)
        highlight = np.clip(_dot(_unit(middle), smooth), 0, 1).astype(np.float32) ** 40
        # Light reflected by the table reaches surfaces that face down or sideways, less near the table.
        bounce = ((0.5 - 0.5 * smooth[:, 2]) * np.clip(points[:, 2] / 0.05, 0.35, 1)).astype(np.float32)
        shared = _Shared.of(block, self._stride, geom, points) if self._stage.world.has_meshes else None
        off_surface = (points + _LIFT * normal).astype(np.float32)
        lamp, sky = self._light(instance, off_surface, smooth.astype(np.float32), shared)
        reflected = bounce[:, None] * (np.float32(0.55 / 0.6) * room.rim)
        colour = albedo * (lamp + sky + room.ambient + reflected) + (gloss * highlight)[:, None] * lamp
        mirror = np.clip(_dot(_unit(self._eye - points), smooth), 0, 1).astype(np.float32) ** 40
        return colour, albedo.mean(axis=1), np.minimum(2.5 * gloss, 1.0) * mirror

    def _materials(
        self, instance: np.ndarray, geom: np.ndarray, points: np.ndarray, normal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Albedo (n, 3), gloss (n,) and smooth normal (n, 3) of points."""
        world, poses = self._stage.world, self._stage.poses
        albedo = np.empty((len(points), 3), np.float32)
        albedo[instance == FINGER_ID] = _FINGER_COLOUR
        gloss = np.full(len(points), 0.25, np.float32)
        smooth = normal.copy()
        surface_of = world.geom_surface[geom]
        for s in np.unique(surface_of[surface_of >= 0]):
            k, part = world.surfaces[s]
            shape: Shape = part.shape
            on = np.flatnonzero(surface_of == s)
            turn, at = poses[k, :3, :3], poses[k, :3, 3]
            if world.shapes[k].parts:
                turn, at = turn @ part.rotation, at + turn @ part.position
            local = _rotate(points[on] - at, turn.T)
            facing = _rotate(normal[on], turn.T)
            gloss[on] = self._atlas.gloss[s]
            if shape.surface is not None:
                cell = shape.surface.look_up(local / shape.scale, facing)
                rounded = shape.surface.smooth(cell, facing)
                if shape.surface.colours is not None:
                    albedo[on] = linear_light(shape.surface.colours[cell])
                else:
                    chart, place = texture_coordinates(shape, local, facing, np.zeros(len(on), bool))
                    albedo[on] = self._atlas.colour(int(s), chart, place)
            else:
                plain = np.array([p.plain for p in shape.pieces])[world.geom_piece[geom[on]] - self._first_piece[s]]
                chart, place = texture_coordinates(shape, local, facing, plain)
                albedo[on] = self._atlas.colour(int(s), chart, place)
                rounded = _round_off(shape, local, facing, plain)
            smooth[on] = _rotate(rounded, turn)
        return albedo, gloss, smooth

    def _light(
        self, instance: np.ndarray, points: np.ndarray, normal: np.ndarray, shared: _Shared | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Light (n, 3) from the lamp, and light (n, 3) from the ceiling, at points (n, 3)."""
        room, finger = self._room, instance == FINGER_ID
        # Points of the finger share no rays with other bodies.
        among_others = None if shared is None else shared.among(~finger)
        lamp, sky = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
        for light in room.lamp:
            lamp += _cosine_to_light(self._stage, light, points.astype(float), normal, shared)
        for light in room.sky:
            cosine = np.empty(len(points), np.float32)
            # Finger and arm are dark: shadows of the ceiling's light on them would be invisible.
            cosine[finger] = np.maximum(_dot(_unit(light - points[finger]), normal[finger]), 0.0)
            cosine[~finger] = _cosine_to_light(
                self._stage, light, points[~finger].astype(float), normal[~finger], among_others
            )
            sky += cosine
        lamp, sky = lamp / np.float32(len(room.lamp)), sky / np.float32(len(room.sky))
        return lamp[:, None] * room.lamp_colour, sky[:, None] * room.sky_colour


# Sums are written out: the last bit of a matrix product depends on the number of its rows, and so would the image.


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.sqrt(_dot(a, a))[:, None]


def _rotate(a: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return np.stack([a[:, 0] * r[0] + a[:, 1] * r[1] + a[:, 2] * r[2] for r in turn], axis=1)


def _round_off(shape: Shape, points: np.ndarray, normal: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Smooth normals of a solid of revolution made of flat facets. Each normal gets the azimuth of its point."""
    if shape.print_as != "lathe" or len(shape.pieces) == 1:
        return normal
    radius = np.hypot(points[:, 0], points[:, 1])
    valid = ~plain & (radius > 1e-4)
    outward = points[valid, :2] / radius[valid, None]
    flat = np.hypot(normal[valid, 0], normal[valid, 1]) * np.sign((outward * normal[valid, :2]).sum(axis=1))
    rounded = normal.copy()
    rounded[valid, :2] = outward * flat[:, None]
    return rounded

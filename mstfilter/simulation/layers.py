"""Rays of the renderer and the light at their end points, updated only where something moved.

`Stage` holds the poses that are rendered. `PixelRays` casts one ray through each pixel and stores what it hits.
`LightMap` stores light on the table. The result of a ray is valid until a body moves that the ray hits before or
after the motion. The light at a point from a light source is valid until a body moves between them. Rays and light
are decided by conservative bounds (`solids.may_meet`). So the images equal those of casting every ray in every frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from mstfilter.simulation.shapes import Shape
from mstfilter.simulation.solids import may_meet
from mstfilter.simulation.textures import Atlas, Room, texture_coordinates
from mstfilter.simulation.world import FINGER_GROUP, FINGER_ID, OBJECT_GROUP, PhysicsWorld

SHADOW_GROUPS = (OBJECT_GROUP, FINGER_GROUP)  #: Geoms that cast shadows

_LIFT = 0.0012  # metres off the surface, against shadows of a surface on itself
_MAP_LOW, _MAP_HIGH = np.array([-0.62, -0.55]), np.array([0.62, 0.66])
_FINGER_COLOUR = np.array([0.09, 0.095, 0.105], np.float32)
UNKNOWN = -2  #: Geom of a ray that has not been cast


class Stage:
    """The poses that are rendered, which are those of the physics without tremor.

    Soft contacts make bodies at rest move by micrometres between frames. A rendered pose is kept until a point of the
    body is farther than `tolerance` metres from it. Images, poses and volumes all use the rendered poses, so they
    agree exactly. A body that has not moved is not rendered again. The world is not changed.
    """

    def __init__(self, world: PhysicsWorld, tolerance: float) -> None:
        import mujoco

        self.world, self.tolerance = world, tolerance
        self._mj, self._data = mujoco, mujoco.MjData(world.model)
        self._radius = np.array([shape.radius for shape in world.shapes])
        # Every object lies in a capsule along its longest edge.
        half = np.array([shape.half for shape in world.shapes])
        long = half.max(axis=1)
        across = np.sqrt((half**2).sum(axis=1) - long**2)
        inward = np.minimum(0.35 * across, long)
        self._axis = np.eye(3)[half.argmax(axis=1)] * (long - inward)[:, None]
        self._thick = np.hypot(across, inward)
        self.poses: np.ndarray = world.poses()  #: T_world_object (n, 4, 4) as rendered
        self._finger = world.finger_position()
        self._data.qpos[:] = world.data.qpos
        mujoco.mj_kinematics(world.model, self._data)

    def follow(self) -> None:
        """Update the rendered poses to those of the world, within the tolerance."""
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
        """The rendered poses, for `restore`."""
        return self.poses.copy(), self._finger.copy(), self._data.qpos.copy()

    def restore(self, saved: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
        """Return to saved poses."""
        self.poses, self._finger = saved[0].copy(), saved[1].copy()
        self._data.qpos[:] = saved[2]
        self._mj.mj_kinematics(self.world.model, self._data)

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Poses (k, 12) of all bodies that cast shadows, and capsules (k, 7) that contain them.

        Equal rows of the first array are equal poses. `solids.may_meet` describes the second array.
        """
        model, data, n = self.world.model, self._data, len(self.poses)
        limbs = np.flatnonzero(self.world.geom_object == FINGER_ID)
        # Finger and arm are capsules and cylinders, which lie in the capsule of their radius and axis.
        limb_axis = data.geom_xmat[limbs].reshape(-1, 3, 3)[:, :, 2] * model.geom_size[limbs, 1:2]
        axis = np.concatenate([np.einsum("nij,nj->ni", self.poses[:, :3, :3], self._axis), limb_axis])
        at = np.concatenate([self.poses[:, :3, 3], data.geom_xpos[limbs]])
        radius = np.concatenate([self._thick, model.geom_size[limbs, 0]]) + 0.002
        rows = [self.poses[:, :3].reshape(n, 12), np.resize(self._finger, (len(limbs), 12))]
        return np.concatenate(rows), np.column_stack([at - axis, at + axis, radius])

    def cast(
        self, origin: ArrayLike, directions: np.ndarray, groups: Sequence[int] = (0, 1, 2)
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`PhysicsWorld.cast` with the rendered poses."""
        return self.world.cast(origin, directions, groups, self._data)


def _cosine_to_light(stage: Stage, light: np.ndarray, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Cosine (n,) float32 between the normals (n, 3) of points (n, 3) and a light source, 0 in its shadow."""
    ray = points - light
    length = np.sqrt(ray[:, 0] ** 2 + ray[:, 1] ** 2 + ray[:, 2] ** 2)
    cosine = -(ray[:, 0] * normal[:, 0] + ray[:, 1] * normal[:, 1] + ray[:, 2] * normal[:, 2]) / length
    lit = np.flatnonzero(cosine > 0.0)
    _, distance, _ = stage.cast(light, ray[lit], SHADOW_GROUPS)
    visible = (distance < 0) | (distance > 1.0 - 1e-6)
    result = np.zeros(len(points), np.float32)
    result[lit[visible]] = cosine[lit[visible]]
    return result


class LightMap:
    """Mean of cosine times visibility of light sources (k, 3) on the table, on a raster with a spacing in metres.

    So a shadow on the table costs rays at the resolution of the raster, not of the image. `pixels` (n, 2) are the
    points of the table in the image.
    """

    def __init__(self, spacing: float, lights: np.ndarray, pixels: np.ndarray) -> None:
        self._spacing, self._lights = spacing, lights
        nx, ny = (np.ceil((_MAP_HIGH - _MAP_LOW) / spacing).astype(int) + 1).tolist()
        x, y = _MAP_LOW[0] + spacing * np.arange(nx), _MAP_LOW[1] + spacing * np.arange(ny)
        grid = np.meshgrid(x, y, indexing="ij")
        self._shape = (nx, ny)
        self._rays = np.stack([grid[0].ravel(), grid[1].ravel(), np.full(nx * ny, _LIFT)], axis=1) - lights[:, None]
        self._cosine = (-self._rays[:, :, 2] / np.linalg.norm(self._rays, axis=2)).astype(np.float32)
        self._dark = np.zeros(self._cosine.shape, bool)
        self._values = np.zeros(nx * ny, np.float32)
        self._pixels = self._locate(pixels)

    def update(self, stage: Stage, moved: np.ndarray) -> None:
        """Cast shadow rays again where one of the capsules (k, 7) may intersect them."""
        self._values[:] = 0
        for light, rays, cosine, dark in zip(self._lights, self._rays, self._cosine, self._dark, strict=True):
            which = np.flatnonzero(may_meet(moved, light, rays))
            _, distance, _ = stage.cast(light, rays[which], SHADOW_GROUPS)
            dark[which] = (distance >= 0) & (distance <= 1.0 - 1e-6)
            self._values += np.where(dark, np.float32(0), cosine)
        self._values /= np.float32(len(self._lights))

    def at_pixels(self) -> np.ndarray:
        """Values (n,) at the pixels of the table."""
        return self._interpolate(*self._pixels)

    def sample(self, xy: np.ndarray) -> np.ndarray:
        """Bilinear values (n,) at points (n, 2) of the table. Beyond the map, the value at its border is used."""
        return self._interpolate(*self._locate(xy))

    def _locate(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        place = np.clip((xy - _MAP_LOW) / self._spacing, 0, np.array(self._shape) - 1.001)
        at = place.astype(np.int64)
        return at[:, 0] * self._shape[1] + at[:, 1], (place - at).astype(np.float32)

    def _interpolate(self, corner: np.ndarray, share: np.ndarray) -> np.ndarray:
        values, ny = self._values, self._shape[1]
        low = values[corner] * (1 - share[:, 1]) + values[corner + 1] * share[:, 1]
        high = values[corner + ny] * (1 - share[:, 1]) + values[corner + ny + 1] * share[:, 1]
        return low * (1 - share[:, 0]) + high * share[:, 0]


class PixelRays:
    """Rays from the camera at `eye` (3,), one per pixel, with their hits among the geoms of some groups.

    `directions` (n, 3) have length 1 along the optical axis.
    """

    def __init__(
        self, stage: Stage, atlas: Atlas, room: Room, eye: np.ndarray, directions: np.ndarray, groups: Sequence[int]
    ) -> None:
        self.stage, self.room, self.eye, self.directions = stage, room, eye, directions
        self._atlas, self._groups = atlas, tuple(groups)
        self._lights = np.concatenate([room.lamp, room.sky])
        n = len(directions)
        self.geom = np.full(n, UNKNOWN, np.int32)
        self.depth = np.empty(n)
        self.normal = np.empty((n, 3))
        self._albedo = np.empty((n, 3), np.float32)
        self._smooth = np.empty((n, 3), np.float32)
        self._lifted = np.empty((n, 3), np.float32)
        self._highlight = np.empty(n, np.float32)
        self._bounce = np.empty(n, np.float32)
        self._cosine = np.empty((len(self._lights), n), np.float32)

    def update(self, pixels: np.ndarray, moved: np.ndarray, limit: np.ndarray | None = None) -> None:
        """Update some pixels (m,) and drop all others.

        `moved` (k, 7) are capsules, in metres, of bodies that moved since the last update, at their old and new
        poses. Hits beyond the depth `limit` (n,) are ignored.
        """
        other = np.ones(len(self.geom), bool)
        other[pixels] = False
        self.geom[other] = UNKNOWN
        stale = (self.geom[pixels] == UNKNOWN) | may_meet(moved, self.eye, self.directions[pixels])
        new, kept = pixels[stale], pixels[~stale]
        geom, z, normal = self.stage.cast(self.eye, self.directions[new], self._groups)
        if limit is not None:
            with np.errstate(invalid="ignore"):
                geom[z > limit[new]] = -1
        self.geom[new], self.depth[new], self.normal[new] = geom, z, normal
        bodies = self.is_body(new)
        self._shade(new[bodies])
        self._light(new[bodies], None)
        self._light(kept[self.is_body(kept)], moved)

    def instance(self, pixels: np.ndarray) -> np.ndarray:
        """Instance id (k,) of the hits of the rays; 0 for the room or nothing."""
        geom = self.geom[pixels]
        return np.where(geom >= 0, self.stage.world.geom_object[np.maximum(geom, 0)], 0)

    def is_body(self, pixels: np.ndarray) -> np.ndarray:
        return self.instance(pixels) > 0

    def points(self, pixels: np.ndarray) -> np.ndarray:
        """End points (k, 3) of the rays."""
        return self.eye + self.directions[pixels] * self.depth[pixels, None]

    def _shade(self, pixels: np.ndarray) -> None:
        """Albedo, smooth normal, highlight and bounced light of pixels on bodies, without casting rays."""
        instance, geom = self.instance(pixels), self.geom[pixels]
        points, normal = self.points(pixels), self.normal[pixels]
        world, poses = self.stage.world, self.stage.poses
        albedo = np.empty((len(pixels), 3), np.float32)
        albedo[instance == FINGER_ID] = _FINGER_COLOUR
        gloss = np.full(len(pixels), 0.25, np.float32)
        smooth = normal.copy()
        for k in np.unique(instance[instance != FINGER_ID]) - 1:
            shape: Shape = world.shapes[k]
            on = np.flatnonzero(instance == k + 1)
            turn = poses[k, :3, :3]
            local = _rotate(points[on] - poses[k, :3, 3], turn.T)
            facing = _rotate(normal[on], turn.T)
            plain = np.array([piece.plain for piece in shape.pieces])[world.geom_piece[geom[on]]]
            chart, place = texture_coordinates(shape, local, facing, plain)
            albedo[on] = self._atlas.colour(int(k), chart, place)
            gloss[on] = self._atlas.gloss[k]
            smooth[on] = _rotate(_round_off(shape, local, facing, plain), turn)
        # Highlight by Blinn and Phong: the normal against the half vector between eye and lamp.
        middle = _unit(self.eye - points) + _unit(self.room.lamp.mean(axis=0) - points)
        highlight = np.clip(_dot(_unit(middle), smooth), 0, 1).astype(np.float32) ** 40
        self._albedo[pixels], self._smooth[pixels] = albedo, smooth
        self._lifted[pixels] = points + _LIFT * normal
        self._highlight[pixels] = gloss * highlight
        # Light reflected by the table reaches surfaces that face down or sideways, less near the table.
        self._bounce[pixels] = (0.5 - 0.5 * smooth[:, 2]) * np.clip(points[:, 2] / 0.05, 0.35, 1)

    def _light(self, pixels: np.ndarray, moved: np.ndarray | None) -> None:
        """Light of each source at pixels on bodies; with `moved`, only where these bodies may cast a shadow."""
        lifted, n_lamps = self._lifted[pixels], len(self.room.lamp)
        for k, light in enumerate(self._lights):
            which = pixels
            if moved is not None:
                which = pixels[may_meet(moved, light, lifted - light)]
            normal = self._smooth[which]
            if k >= n_lamps:
                # Finger and arm are dark: shadows of the ceiling's light on them would be invisible.
                finger = self.instance(which) == FINGER_ID
                towards = _unit(light - self._lifted[which[finger]])
                self._cosine[k, which[finger]] = np.maximum(_dot(towards, normal[finger]), 0.0)
                which, normal = which[~finger], normal[~finger]
            points = self._lifted[which].astype(float)
            self._cosine[k, which] = _cosine_to_light(self.stage, light, points, normal)

    def colour(self, pixels: np.ndarray) -> np.ndarray:
        """Linear colours (k, 3) float32 of pixels on bodies."""
        room, n_lamps = self.room, len(self.room.lamp)
        total = [np.zeros(len(pixels), np.float32), np.zeros(len(pixels), np.float32)]
        for k, cosine in enumerate(self._cosine):
            total[int(k >= n_lamps)] += cosine[pixels]
        lamp = (total[0] / np.float32(n_lamps))[:, None] * room.lamp_colour
        sky = (total[1] / np.float32(len(room.sky)))[:, None] * room.sky_colour
        bounce = self._bounce[pixels, None] * (np.float32(0.55 / 0.6) * room.rim)
        return self._albedo[pixels] * (lamp + sky + room.ambient + bounce) + self._highlight[pixels, None] * lamp


# Sums are written out: the last bit of a matrix product depends on the number of its rows.


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.sqrt(_dot(a, a))[:, None]


def _rotate(a: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return np.stack([a[:, 0] * r[0] + a[:, 1] * r[1] + a[:, 2] * r[2] for r in turn], axis=1)


def _round_off(shape: Shape, points: np.ndarray, normal: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Normals of a turned solid made of flat wedges, with the azimuth of the point instead of the facet's azimuth."""
    if shape.print_as != "lathe" or len(shape.pieces) == 1:
        return normal
    radius = np.hypot(points[:, 0], points[:, 1])
    valid = ~plain & (radius > 1e-4)
    outward = points[valid, :2] / radius[valid, None]
    flat = np.hypot(normal[valid, 0], normal[valid, 1]) * np.sign((outward * normal[valid, :2]).sum(axis=1))
    rounded = normal.copy()
    rounded[valid, :2] = outward * flat[:, None]
    return rounded

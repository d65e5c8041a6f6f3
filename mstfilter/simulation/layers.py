"""The world as it is shown: poses that follow physics but not its trembling.

Bodies at rest creep and tremble by micrometres between frames, as soft contacts do. What is shown keeps a pose
until some point of the body is more than a tolerance away from it. Pictures, poses and volumes are all taken
from what is shown, so they agree exactly; and a body that is shown in the same place need not be drawn again.


Light that reaches surfaces from a few points of lamp and ceiling, and what stands in its way.

A shadow changes only where a body moved: every point keeps, for each light, what it got from it, and asks
again only if a body that moved can lie between. Light on the table is held in maps in table coordinates, so
that a shadow costs rays of the map's resolution, not the image's.


One ray through every pixel, with all that is known about what it meets; asked again only where needed.

A ray's answer holds until a body moves that the ray meets before or after; the light at the point it meets
holds, light by light, until a body moves between. Both are decided by bounds that err on one side only, so a
picture is the same as if everything were cast anew.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from mstfilter.simulation.shapes import Shape
from mstfilter.simulation.solids import Bounds
from mstfilter.simulation.textures import Atlas, Room, locate
from mstfilter.simulation.world import FINGER_GROUP, FINGER_ID, OBJECT_GROUP, World, cast

__all__ = ["CASTERS", "LIFT", "Layer", "LightMap", "Stage", "shine"]


class Stage:
    """What a camera sees of a world.

    Parameters
    ----------
    world : World
        Followed; never changed.
    tolerance : float
        Metres by which what is shown may lag behind. 0: it never does.
    """

    def __init__(self, world: World, tolerance: float = 0.0) -> None:
        self.world, self.tolerance = world, tolerance
        self._mj, self._data = world.another_data()
        self._radius = np.array([shape.radius for shape in world.shapes])
        # Every object lies in a capsule along its longest edge.
        half = np.array([shape.half for shape in world.shapes])
        longest = half.argmax(axis=1)
        long = half.max(axis=1)
        across = np.sqrt((half**2).sum(axis=1) - long**2)
        inward = np.minimum(0.35 * across, long)
        self._axis = np.eye(3)[longest] * (long - inward)[:, None]
        self._thick = np.hypot(across, inward)
        self._poses = world.poses()
        self._finger = world.finger_position()
        self._show(world.data.qpos)

    def _show(self, qpos: np.ndarray) -> None:
        self._data.qpos[:] = qpos
        self._mj.mj_kinematics(self.world.model, self._data)

    def follow(self) -> None:
        """Catch up with the world. Following a second time changes nothing."""
        world = self.world
        now, finger = world.poses(), world.finger_position()
        shift = np.linalg.norm(now[:, :3, 3] - self._poses[:, :3, 3], axis=1)
        turn = np.linalg.norm(now[:, :3, :3] - self._poses[:, :3, :3], axis=(1, 2))
        gone = shift + turn * self._radius > self.tolerance
        if not gone.any() and (finger == self._finger).all():
            return
        self._poses = np.where(gone[:, None, None], now, self._poses)
        self._finger = finger
        qpos = self._data.qpos.copy()
        qpos[:3] = finger
        for k in np.flatnonzero(gone):
            at = world.qpos_of(int(k))
            qpos[at] = world.data.qpos[at]
        self._show(qpos)

    @property
    def poses(self) -> np.ndarray:
        """(n, 4, 4) T_world_object as shown."""
        return self._poses.copy()

    def key(self) -> np.ndarray:
        """(n + 1, 12): place and orientation of every object, then of the finger; equal rows are the same pose."""
        rows = self._poses[:, :3].reshape(len(self._poses), 12)
        return np.concatenate([rows, np.resize(self._finger, (1, 12))])

    def bounds(self) -> tuple[Bounds, np.ndarray]:
        """Capsules around all that is cast shadows by, and the row of `key` that each belongs to."""
        model, data = self.world.model, self._data
        at, axis = self._poses[:, :3, 3], np.einsum("nij,nj->ni", self._poses[:, :3, :3], self._axis)
        limbs = np.flatnonzero(self.world.geom_object == FINGER_ID)
        # Capsules and cylinders alike: both lie in the capsule of their radius and axis.
        limb_axis = data.geom_xmat[limbs].reshape(-1, 3, 3)[:, :, 2] * model.geom_size[limbs, 1:2]
        at, axis = np.concatenate([at, data.geom_xpos[limbs]]), np.concatenate([axis, limb_axis])
        radius = np.concatenate([self._thick, model.geom_size[limbs, 0]]) + 0.002
        rows = np.minimum(np.arange(len(at)), len(self._poses))
        return Bounds(at - axis, at + axis, radius), rows

    def cast(
        self, origin: ArrayLike, directions: np.ndarray, groups: Sequence[int] = (0, 1, 2)
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays through what is shown; see `World.cast`."""
        return cast(self.world.model, self._data, origin, directions, groups)


CASTERS = (OBJECT_GROUP, FINGER_GROUP)
LIFT = 0.0012
"""Metres off the surface, against shadows on itself."""

_MAP_LOW, _MAP_HIGH = np.array([-0.62, -0.55]), np.array([0.62, 0.66])


def shine(stage: Stage, light: np.ndarray, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(n,) float32 cosine towards a light at points (n, 3) of normals (n, 3), 0 in its shadow."""
    ray = points - light
    length = np.sqrt(ray[:, 0] ** 2 + ray[:, 1] ** 2 + ray[:, 2] ** 2)
    cosine = -(ray[:, 0] * normal[:, 0] + ray[:, 1] * normal[:, 1] + ray[:, 2] * normal[:, 2]) / length
    lit = np.flatnonzero(cosine > 0.0)
    _, distance, _ = stage.cast(light, ray[lit], CASTERS)
    visible = (distance < 0) | (distance > 1.0 - 1e-6)
    got = np.zeros(len(points), np.float32)
    got[lit[visible]] = cosine[lit[visible]]
    return got


class LightMap:
    """Light on the table from some lamps, at a raster of its points, and at the table's pixels.

    Parameters
    ----------
    spacing : float
        Of the raster, metres.
    lights : (k, 3) metres
    pixels : (n, 2) metres
        Places of the table that the camera's pixels see.
    """

    def __init__(self, spacing: float, lights: np.ndarray, pixels: np.ndarray) -> None:
        self._spacing, self._lights = spacing, lights
        nx, ny = (np.ceil((_MAP_HIGH - _MAP_LOW) / spacing).astype(int) + 1).tolist()
        x, y = _MAP_LOW[0] + spacing * np.arange(nx), _MAP_LOW[1] + spacing * np.arange(ny)
        grid = np.meshgrid(x, y, indexing="ij")
        self.shape = (nx, ny)
        self._rays = np.stack([grid[0].ravel(), grid[1].ravel(), np.full(nx * ny, LIFT)], axis=1) - lights[:, None]
        self._short = self._rays.astype(np.float32)
        cosine = -self._rays[:, :, 2] / np.linalg.norm(self._rays, axis=2)
        self._cosine = cosine.astype(np.float32)
        self._dark = np.zeros(self._cosine.shape, bool)
        self._values = np.zeros(nx * ny, np.float32)
        self._corner, self._share = self._locate(pixels)
        self.at_pixels: np.ndarray = np.zeros(len(pixels), np.float32)
        """(n,) mean over lights of cosine times visibility at the pixels."""

    def update(self, stage: Stage, bounds: Bounds, fresh: bool) -> None:
        """Ask again where one of the bounds may stand in the way; everywhere if the map is `fresh`."""
        maybe = np.zeros(len(self._values), bool)
        for light, rays, short, dark in zip(self._lights, self._rays, self._short, self._dark, strict=True):
            which = np.flatnonzero(bounds.seen_from(light).meet(short))
            _, distance, _ = stage.cast(light, rays[which], CASTERS)
            dark[which] = (distance >= 0) & (distance <= 1.0 - 1e-6)
            maybe[which] = True
        if fresh:
            maybe[:] = True
        nodes = np.flatnonzero(maybe)
        total = np.zeros(len(nodes), np.float32)
        for cosine, dark in zip(self._cosine, self._dark, strict=True):
            total += np.where(dark[nodes], np.float32(0), cosine[nodes])
        total /= np.float32(len(self._lights))
        changed = np.zeros(len(maybe), bool)
        changed[nodes] = fresh | (total != self._values[nodes])
        self._values[nodes] = total
        ny = self.shape[1]
        corner = changed.copy()
        corner[:-1] |= changed[1:]
        corner[:-ny] |= changed[ny:]
        corner[: -ny - 1] |= changed[ny + 1 :]
        which = np.flatnonzero(corner[self._corner])
        self.at_pixels[which] = self._between(self._corner[which], self._share[which])

    def sample(self, xy: np.ndarray) -> np.ndarray:
        """Bilinear values (n,) at places (n, 2) of the table; the border's value beyond it."""
        return self._between(*self._locate(xy))

    def _locate(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        place = np.clip((xy - _MAP_LOW) / self._spacing, 0, np.array(self.shape) - 1.001)
        at = place.astype(np.int64)
        return at[:, 0] * self.shape[1] + at[:, 1], (place - at).astype(np.float32)

    def _between(self, corner: np.ndarray, share: np.ndarray) -> np.ndarray:
        values, ny = self._values, self.shape[1]
        low = values[corner] * (1 - share[:, 1]) + values[corner + 1] * share[:, 1]
        high = values[corner + ny] * (1 - share[:, 1]) + values[corner + ny + 1] * share[:, 1]
        return low * (1 - share[:, 0]) + high * share[:, 0]


_FINGER_COLOUR = np.array([0.09, 0.095, 0.105], np.float32)
_UNKNOWN = -2


class Layer:
    """Rays of one camera, one a pixel.

    Parameters
    ----------
    stage : Stage
    atlas : Atlas
        Colours of the objects.
    room : Room
        Light.
    eye : (3,) metres
    directions : (n, 3)
        Of every pixel's ray; of length 1 along the optical axis.
    groups : sequence of int
        Which geoms the rays see.
    """

    def __init__(
        self, stage: Stage, atlas: Atlas, room: Room, eye: np.ndarray, directions: np.ndarray, groups: Sequence[int]
    ) -> None:
        self.stage, self.room, self.eye, self.directions = stage, room, eye, directions
        self._atlas, self._groups = atlas, tuple(groups)
        self._short = directions.astype(np.float32)
        self._lights = np.concatenate([room.lamp, room.sky])
        n = len(directions)
        self.geom = np.full(n, _UNKNOWN, np.int32)
        self.depth = np.empty(n)
        self.normal = np.empty((n, 3))
        self._albedo = np.empty((n, 3), np.float32)
        self._smooth = np.empty((n, 3), np.float32)
        self._lifted = np.empty((n, 3), np.float32)
        self._shine = np.empty(n, np.float32)
        self._below = np.empty(n, np.float32)
        self._got = np.empty((len(self._lights), n), np.float32)

    def forget(self) -> None:
        """Know nothing."""
        self.geom[:] = _UNKNOWN

    def update(self, pixels: np.ndarray, moved: Bounds, limit: np.ndarray | None = None) -> np.ndarray:
        """Bring some pixels up to date, forget all others; which pixels (k,) were cast anew.

        Parameters
        ----------
        pixels : (m,) int
        moved : Bounds
            Of what moved since the last update, where it was and where it is.
        limit : (n,) metres, optional
            Hits farther than this are none.
        """
        known = self.geom[pixels] != _UNKNOWN
        other = np.ones(len(self.geom), bool)
        other[pixels] = False
        self.geom[other] = _UNKNOWN
        stale = ~known
        if len(moved):
            old = np.flatnonzero(known)
            stale[old] |= moved.seen_from(self.eye).meet(self._short[pixels[old]])
        anew, kept = pixels[stale], pixels[~stale]
        geom, z, normal = self.stage.cast(self.eye, self.directions[anew], self._groups)
        if limit is not None:
            with np.errstate(invalid="ignore"):
                geom[z > limit[anew]] = -1
        self.geom[anew], self.depth[anew], self.normal[anew] = geom, z, normal
        things = self.is_thing(anew)
        self._dress(anew[things])
        self._light(anew[things], None)
        if len(moved):
            self._light(kept[self.is_thing(kept)], moved)
        return anew

    def owner(self, pixels: np.ndarray) -> np.ndarray:
        """(k,) instance id of what the rays meet, 0 for the room or nothing."""
        geom = self.geom[pixels]
        return np.where(geom >= 0, self.stage.world.geom_object[np.maximum(geom, 0)], 0)

    def is_thing(self, pixels: np.ndarray) -> np.ndarray:
        """(k,) bool: whether an object, the finger or the arm is met."""
        return self.owner(pixels) > 0

    def points(self, pixels: np.ndarray) -> np.ndarray:
        """(k, 3) where the rays end."""
        return self.eye + self.directions[pixels] * self.depth[pixels, None]

    def _dress(self, pixels: np.ndarray) -> None:
        """Colour, smooth normal, highlight and cover of pixels on things: all that does not ask for rays."""
        owner, geom = self.owner(pixels), self.geom[pixels]
        points, normal = self.points(pixels), self.normal[pixels]
        world, poses = self.stage.world, self.stage.poses
        albedo = np.empty((len(pixels), 3), np.float32)
        albedo[owner == FINGER_ID] = _FINGER_COLOUR
        gloss = np.full(len(pixels), 0.25, np.float32)
        smooth = normal.copy()
        for k in np.unique(owner[owner != FINGER_ID]) - 1:
            shape: Shape = world.shapes[k]
            on = np.flatnonzero(owner == k + 1)
            turn = poses[k, :3, :3]
            local = _turned(points[on] - poses[k, :3, 3], turn.T)
            facing = _turned(normal[on], turn.T)
            plain = np.array([piece.plain for piece in shape.pieces])[world.geom_piece[geom[on]]]
            chart, place = locate(shape, local, facing, plain)
            albedo[on] = self._atlas.colour(int(k), chart, place)
            gloss[on] = self._atlas.gloss[k]
            smooth[on] = _turned(_round_off(shape, local, facing, plain), turn)
        middle = _unit(self.eye - points) + _unit(self.room.lamp.mean(axis=0) - points)
        glint = np.clip(_dot(_unit(middle), smooth), 0, 1).astype(np.float32) ** 40
        self._albedo[pixels], self._smooth[pixels] = albedo, smooth
        self._lifted[pixels] = points + LIFT * normal
        self._shine[pixels] = gloss * glint
        # Light thrown up by the table reaches what faces down or sideways, less under cover.
        self._below[pixels] = (0.5 - 0.5 * smooth[:, 2]) * np.clip(points[:, 2] / 0.05, 0.35, 1)

    def _light(self, pixels: np.ndarray, moved: Bounds | None) -> None:
        """What pixels on things get from each light; asked again only behind `moved`."""
        lifted, n_lamps = self._lifted[pixels], len(self.room.lamp)
        for k, light in enumerate(self._lights):
            which = pixels
            if moved is not None:
                which = pixels[moved.seen_from(light).meet(lifted - light.astype(np.float32))]
            normal = self._smooth[which]
            if k >= n_lamps:
                # Dark finger and arm: shadows of the ceiling's light on them are not seen.
                finger = self.owner(which) == FINGER_ID
                towards = _unit(light - self._lifted[which[finger]])
                self._got[k, which[finger]] = np.maximum(_dot(towards, normal[finger]), 0.0)
                which, normal = which[~finger], normal[~finger]
            self._got[k, which] = shine(self.stage, light, self._lifted[which].astype(float), normal)

    def colour(self, pixels: np.ndarray) -> np.ndarray:
        """(k, 3) float32 linear colours of pixels on things."""
        room, n_lamps = self.room, len(self.room.lamp)
        total = [np.zeros(len(pixels), np.float32), np.zeros(len(pixels), np.float32)]
        for k, got in enumerate(self._got):
            total[int(k >= n_lamps)] += got[pixels]
        lamp = (total[0] / np.float32(n_lamps))[:, None] * room.lamp_colour
        sky = (total[1] / np.float32(len(room.sky)))[:, None] * room.sky_colour
        bounce = self._below[pixels, None] * (np.float32(0.55 / 0.6) * room.rim)
        return self._albedo[pixels] * (lamp + sky + room.ambient + bounce) + self._shine[pixels, None] * lamp


# Sums written out: a matrix product's last bit depends on how many rows it has.


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.sqrt(_dot(a, a))[:, None]


def _turned(a: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return np.stack([a[:, 0] * r[0] + a[:, 1] * r[1] + a[:, 2] * r[2] for r in turn], axis=1)


def _round_off(shape: Shape, points: np.ndarray, normal: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Normals of a turned solid made of flat wedges: the facets' azimuth is replaced by the point's own."""
    if shape.print_as != "lathe" or shape.n_pieces == 1:
        return normal
    radius = np.hypot(points[:, 0], points[:, 1])
    good = ~plain & (radius > 1e-4)
    outward = points[good, :2] / radius[good, None]
    flat = np.hypot(normal[good, 0], normal[good, 1]) * np.sign((outward * normal[good, :2]).sum(axis=1))
    rounded = normal.copy()
    rounded[good, :2] = outward * flat[:, None]
    return rounded

"""Colour, depth and instance images by ray casting: no display, no GPU, no GL.

One ray a pixel gives depth and instance; colours come from a few shadow rays to a lamp and to the ceiling,
and one gather from the texture atlas. What an empty table looks like is computed once; rays are cast only
where an object, the finger or the arm may be seen. Light on the table is held in two maps in table
coordinates, so that a shadow costs rays of the map's resolution, not the image's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mstfilter.scene.camera import Camera
from mstfilter.simulation.room import Room
from mstfilter.simulation.shapes import Shape
from mstfilter.simulation.textures import Atlas, Skin, locate
from mstfilter.simulation.world import FINGER_GROUP, FINGER_ID, OBJECT_GROUP, ROOM_GROUP, TABLE, World

__all__ = ["Renderer", "View", "seen_texel"]

_CASTERS = (OBJECT_GROUP, FINGER_GROUP)
_BIAS = 0.0012  # metres off the surface, against shadows on itself
_MAP_LOW, _MAP_HIGH = np.array([-0.62, -0.55]), np.array([0.62, 0.66])
_OFFSETS = ((-0.34, 0.14), (0.34, -0.14))  # of further rays within a pixel on an edge
_FINGER_COLOUR = np.array([0.09, 0.095, 0.105], np.float32)


@dataclass(frozen=True, eq=False)
class View:
    """A noiseless picture.

    Parameters
    ----------
    colour : (H, W, 3) float32
        Linear intensity before exposure.
    depth : (H, W) float32 metres
        z-depth of the first surface; NaN where there is none.
    instance : (H, W) uint8
        0 the room, 1 .. n objects, 255 finger and arm.
    slant : (H, W) float32
        Cosine between the surface's normal and the ray.
    """

    colour: np.ndarray
    depth: np.ndarray
    instance: np.ndarray
    slant: np.ndarray


def seen_texel(camera: Camera) -> float:
    """What a pixel covers at a typical range of 0.85 m, metres: finer print cannot be seen."""
    return 0.85 / float(camera.K[0, 0]) * 0.8


class _Map:
    """Light on the table from some lamps, at a raster of its points."""

    def __init__(self, spacing: float, lights: np.ndarray) -> None:
        self._spacing, self._lights = spacing, lights
        nx, ny = (np.ceil((_MAP_HIGH - _MAP_LOW) / spacing).astype(int) + 1).tolist()
        x, y = _MAP_LOW[0] + spacing * np.arange(nx), _MAP_LOW[1] + spacing * np.arange(ny)
        grid = np.meshgrid(x, y, indexing="ij")
        self._rays = np.stack([grid[0].ravel(), grid[1].ravel(), np.full(nx * ny, _BIAS)], axis=1) - lights[:, None]
        length = np.linalg.norm(self._rays, axis=2, keepdims=True)
        self._unit = (self._rays / length).astype(np.float32)
        self._cosine = -self._unit[:, :, 2]
        self.shape = (nx, ny)

    def shine(self, world: World, centres: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """(n,) mean over lights of cosine times visibility; spheres bound all that throws a shadow."""
        total = self._cosine.sum(axis=0)
        for light, rays, unit, cosine in zip(self._lights, self._rays, self._unit, self._cosine, strict=True):
            maybe = np.flatnonzero(_meets(unit, centres - light, radii))
            _, distance, _ = world.cast(light, rays[maybe], _CASTERS)
            dark = maybe[(distance >= 0) & (distance <= 1.0 - 1e-6)]
            total[dark] -= cosine[dark]
        return total / len(self._lights)

    def sample(self, values: np.ndarray, xy: np.ndarray) -> np.ndarray:
        """Bilinear values (n,) at places (n, 2) of the table; the border's value beyond it."""
        place = np.clip((xy - _MAP_LOW) / self._spacing, 0, np.array(self.shape) - 1.001)
        at = place.astype(np.int64)
        f = (place - at).astype(np.float32)
        flat = at[:, 0] * self.shape[1] + at[:, 1]
        low = values[flat] * (1 - f[:, 1]) + values[flat + 1] * f[:, 1]
        flat = flat + self.shape[1]
        high = values[flat] * (1 - f[:, 1]) + values[flat + 1] * f[:, 1]
        return low * (1 - f[:, 0]) + high * f[:, 0]


def _meets(unit: np.ndarray, centres: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """(n,) bool: rays of directions (n, 3) from the origin that meet one of the spheres."""
    along = unit @ centres.T.astype(np.float32)
    least = ((centres**2).sum(axis=1) - radii**2).astype(np.float32)
    return ((along > 0) & (along * along > least)).any(axis=1) | bool((least < 0).any())


class Renderer:
    """Renders a world as it is now.

    Parameters
    ----------
    world : World
        Read at every call of `render`.
    skins : sequence of Skin
        One an object.
    room : Room
        Surroundings and light.
    camera : Camera
        With a pose.
    supersample : bool
        Further rays for pixels on edges.
    """

    def __init__(
        self, world: World, skins: Sequence[Skin], room: Room, camera: Camera, supersample: bool = True
    ) -> None:
        self.world, self.room, self.camera, self.supersample = world, room, camera, supersample
        self._atlas = Atlas(list(skins), seen_texel(camera))
        turn = camera.pose.as_matrix()[:3, :3]
        self._axis = turn[:, 2]
        self._directions = camera.rays().reshape(-1, 3) @ turn.T
        self._eye = np.array(camera.position)
        self._steepness = np.linalg.norm(self._directions, axis=1)
        self._unit = (self._directions / self._steepness[:, None]).astype(np.float32)
        fine = max(0.004, 2.0 / float(camera.K[0, 0]))
        self._lamp_map, self._sky_map = _Map(fine, room.lamp), _Map(2 * fine, room.sky)
        self._background()

    def _background(self) -> None:
        """The room without objects: constant from frame to frame but for the light on the table."""
        geom, z, normal = self.world.cast(self._eye, self._directions, (ROOM_GROUP,))
        points = self._eye + self._directions * z[:, None]
        self._room_depth = np.where(geom >= 0, z, np.nan).astype(np.float32)
        self._room_slant = self._slant(np.arange(len(z)), normal)
        self._room_normal = normal.astype(np.float32)
        self._room_albedo = self._room_colours(geom, points, normal)
        self._on_table = (geom == 0) & (normal[:, 2] > 0.5)
        self._room_light = self._away_light(geom, points, normal)
        self._table_xy = points[self._on_table, :2]

    def _slant(self, pixels: np.ndarray, normal: np.ndarray) -> np.ndarray:
        return np.abs((self._unit[pixels] * normal).sum(axis=1)).astype(np.float32)

    def _room_colours(self, geom: np.ndarray, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """(n, 3) albedo of points of the room."""
        room = self.room
        colour = np.broadcast_to(room.wall, (len(geom), 3)).copy()
        top = (geom == 0) & (normal[:, 2] > 0.5)
        colour[(geom == 0) & ~top] = room.rim
        h, w = room.table.shape[:2]
        (half_x, half_y, _), (x, y, _) = TABLE
        column = np.clip(((points[top, 0] - x) / half_x * 0.5 + 0.5) * w, 0, w - 1).astype(np.int64)
        row = np.clip((0.5 - (points[top, 1] - y) / half_y * 0.5) * h, 0, h - 1).astype(np.int64)
        colour[top] = room.table[row, column]
        floor = geom == 1
        n = len(room.carpet)
        tile = np.floor(points[floor, :2] / 0.008).astype(np.int64) % n
        colour[floor] = room.floor * room.carpet[tile[:, 0], tile[:, 1], None]
        return colour

    def _away_light(self, geom: np.ndarray, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """(n, 3) light on floor, wall and the table's rim: no shadows, a soft fall-off with distance."""
        lamp = self.room.lamp.mean(axis=0)
        reach = np.linalg.norm(points - lamp, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            cosine = np.clip(((lamp - points) * normal).sum(axis=1) / reach, 0.15, 1)
        fall = np.clip(3.0 / np.maximum(reach, 1.0) ** 2, 0, 1)[:, None]
        light = 0.5 * self.room.sky_colour + self.room.ambient + self.room.lamp_colour * cosine[:, None] * fall
        return np.nan_to_num(light).astype(np.float32)

    def _shining(self, lights: np.ndarray, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """(n,) mean over lights of cosine times visibility."""
        total = np.zeros(len(points), np.float32)
        for light in lights:
            ray = points - light
            length = np.linalg.norm(ray, axis=1)
            cosine = -(ray * normal).sum(axis=1) / length
            lit = np.flatnonzero(cosine > 0.0)
            _, distance, _ = self.world.cast(light, ray[lit], _CASTERS)
            visible = (distance < 0) | (distance > 1.0 - 1e-6)
            total[lit[visible]] += cosine[lit[visible]]
        return total / len(lights)

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres (k, 3) and radii (k,) of spheres that bound objects, finger and arm."""
        world = self.world
        limbs = np.flatnonzero(world.geom_object == FINGER_ID)
        centres = np.concatenate([world.positions(), world.data.geom_xpos[limbs]])
        radii = np.concatenate([[shape.radius for shape in world.shapes], world.model.geom_rbound[limbs]])
        return centres, radii + 0.002

    def render(self) -> View:
        """The picture of the world as it is now (after `World.forward`)."""
        h, w = self.camera.height, self.camera.width
        depth, slant = self._room_depth.copy(), self._room_slant.copy()
        normal = self._room_normal.copy()
        instance = np.zeros(h * w, np.uint8)
        centres, radii = self._bounds()
        lamp = self._lamp_map.shine(self.world, centres, radii)
        sky = self._sky_map.shine(self.world, centres, radii)
        light = self._room_light.copy()
        light[self._on_table] = self._table_light(lamp, sky, self._table_xy)
        colour = self._room_albedo * light

        near = np.flatnonzero(_meets(self._unit, centres - self._eye, radii))
        geom, z, found = self.world.cast(self._eye, self._directions[near], _CASTERS)
        front = (geom >= 0) & ~(z > depth[near])
        hit, geom, z, found = near[front], geom[front], z[front], found[front]
        depth[hit], normal[hit], slant[hit] = z, found, self._slant(hit, found)
        instance[hit] = self.world.geom_object[geom]
        colour[hit] = self._shade(geom, self._eye + self._directions[hit] * z[:, None], found)
        if self.supersample and len(hit):
            self._smooth(colour, instance, normal, lamp, sky)
        return View(colour.reshape(h, w, 3), depth.reshape(h, w), instance.reshape(h, w), slant.reshape(h, w))

    def _table_light(self, lamp: np.ndarray, sky: np.ndarray, xy: np.ndarray) -> np.ndarray:
        room = self.room
        light = self._lamp_map.sample(lamp, xy)[:, None] * room.lamp_colour
        light += self._sky_map.sample(sky, xy)[:, None] * room.sky_colour
        return light + room.ambient

    def _shade(self, geom: np.ndarray, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """(n, 3) colours of points on objects, finger and arm."""
        owner = self.world.geom_object[geom]
        albedo = np.empty((len(geom), 3), np.float32)
        gloss = np.full(len(geom), 0.25, np.float32)
        albedo[owner == FINGER_ID] = _FINGER_COLOUR
        smooth = normal.copy()
        positions, rotations = self.world.positions(), self.world.rotations()
        for k, shape in enumerate(self.world.shapes):
            on = np.flatnonzero(owner == k + 1)
            if len(on) == 0:
                continue
            local = (points[on] - positions[k]) @ rotations[k]
            facing = normal[on] @ rotations[k]
            pieces = self.world.geom_piece[geom[on]]
            plain = np.array([piece.plain for piece in shape.pieces])[pieces]
            chart, place = locate(shape, local, facing, plain)
            albedo[on] = self._atlas.colour(k, chart, place)
            gloss[on] = self._atlas.gloss[k]
            smooth[on] = _round_off(shape, local, facing, plain) @ rotations[k].T
        lifted = points + _BIAS * normal
        room = self.room
        lamp = self._shining(room.lamp, lifted, smooth)[:, None]
        sky = self._shining(room.sky, lifted, smooth)[:, None]
        # Light thrown up by the table reaches what faces down or sideways, less under cover.
        below = (0.5 - 0.5 * smooth[:, 2:]).astype(np.float32) * np.clip(points[:, 2:] / 0.05, 0.35, 1).astype(
            np.float32
        )
        bounce = below * 0.55 * room.rim / 0.6
        light = lamp * room.lamp_colour + sky * room.sky_colour + room.ambient + bounce
        eye = self._eye - points
        eye /= np.linalg.norm(eye, axis=1, keepdims=True)
        to_lamp = room.lamp.mean(axis=0) - points
        to_lamp /= np.linalg.norm(to_lamp, axis=1, keepdims=True)
        middle = eye + to_lamp
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        glint = np.clip((middle * smooth).sum(axis=1), 0, 1).astype(np.float32) ** 40
        return albedo * light + (gloss * glint)[:, None] * lamp * room.lamp_colour

    def _smooth(
        self, colour: np.ndarray, instance: np.ndarray, normal: np.ndarray, lamp: np.ndarray, sky: np.ndarray
    ) -> None:
        """Mix further rays into pixels on edges."""
        h, w = self.camera.height, self.camera.width
        ids, n = instance.reshape(h, w), normal.reshape(h, w, 3)
        edge = np.zeros((h, w), bool)
        for axis in (0, 1):
            a = [slice(None), slice(None)]
            b = [slice(None), slice(None)]
            a[axis], b[axis] = slice(1, None), slice(None, -1)
            here, there = tuple(a), tuple(b)
            step = (ids[here] != ids[there]) | ((n[here] * n[there]).sum(axis=-1) < 0.7) & (ids[here] > 0)
            edge[here] |= step
            edge[there] |= step
        pixels = np.flatnonzero(edge)
        total = np.zeros((len(pixels), 3), np.float32)
        row, column = np.divmod(pixels, w)
        K, turn = self.camera.K, self.camera.pose.as_matrix()[:3, :3]
        for dv, du in _OFFSETS:
            y = (row + dv - K[1, 2]) / K[1, 1]
            x = (column + du - K[0, 2]) / K[0, 0]
            ray = np.stack([x, y, np.ones_like(x)], axis=1) @ turn.T
            geom, z, found = self.world.cast(self._eye, ray)
            points = self._eye + ray * z[:, None]
            thing = self.world.geom_object[geom] > 0
            part = np.empty_like(total)
            part[thing] = self._shade(geom[thing], points[thing], found[thing])
            room = ~thing
            albedo = self._room_colours(geom[room], points[room], found[room])
            light = self._away_light(geom[room], points[room], found[room])
            table = (geom[room] == 0) & (found[room][:, 2] > 0.5)
            light[table] = self._table_light(lamp, sky, points[room][table, :2])
            part[room] = albedo * light
            total += part
        colour[pixels] = (colour[pixels] + total) / (1 + len(_OFFSETS))


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

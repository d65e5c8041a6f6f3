"""Colour, depth and instance images by ray casting. The renderer needs no display, GPU or OpenGL.

One ray per pixel gives the depth and the instance label. Colours are computed from textures and from shadow rays to a
lamp and the ceiling.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mstfilter.lab.simulation.lighting import SHADOW_GROUPS, BodyColours, LightMap, Stage
from mstfilter.lab.simulation.sensor import NEIGHBOURS
from mstfilter.lab.simulation.textures import Atlas, Room, Skin
from mstfilter.lab.simulation.world import FINGER_GROUP, MESH_GROUP, OBJECT_GROUP, ROOM_GROUP, TABLE, PhysicsWorld
from mstfilter.scene import Camera

_BLOCK = 3  # side of the blocks of pixels that share shadow rays in worlds with meshes
_OFFSETS = ((-0.34, 0.14), (0.34, -0.14))  # of further rays within a pixel on an edge: rows, columns


@dataclass(frozen=True, eq=False)
class View:
    """Rendered images without sensor noise."""

    colour: np.ndarray  #: (H, W, 3) float32, linear intensity before exposure
    depth: np.ndarray  #: (H, W) float32 metres, z-depth of the first surface; NaN for none
    instance: np.ndarray  #: (H, W) uint8, 0 for the room, 1 .. n for objects, 255 for finger and arm
    slant: np.ndarray  #: (H, W) float32, cosine between the surface's normal and the ray
    reflectance: np.ndarray  #: (H, W) float32, share of light that the surface reflects
    shine: np.ndarray  #: (H, W) float32, strength of the highlight of a lamp at the camera, 0 .. 1


def visible_texel(camera: Camera) -> float:
    """Size in metres of the smallest texture detail that a camera resolves at a typical range of 0.85 m."""
    return 0.85 / float(camera.K[0, 0]) * 0.8


class Renderer:
    """Renders the current state of a world.

    Each object has one texture (`Skin`). `supersample` casts additional rays for pixels on edges. Rendered poses may
    differ from simulated poses by `tolerance` metres; see `Stage`.
    """

    def __init__(
        self,
        world: PhysicsWorld,
        skins: Sequence[Skin],
        room: Room,
        camera: Camera,
        supersample: bool,
        tolerance: float = 0.0,
    ) -> None:
        self.room, self.camera = room, camera
        self.stage = Stage(world, tolerance)
        atlas = Atlas([one for skin in skins for one in skin.surfaces], visible_texel(camera))
        turn = camera.pose.as_matrix()[:3, :3]
        self._eye = np.array(camera.position)
        self._rays = camera.rays().reshape(-1, 3) @ turn.T
        self._unit = (self._rays / np.linalg.norm(self._rays, axis=1)[:, None]).astype(np.float32)
        K = camera.K
        shifts = [np.array([du / K[0, 0], dv / K[1, 1], 0.0]) @ turn.T for dv, du in _OFFSETS]
        rows, columns = np.indices((camera.height, camera.width)) // _BLOCK
        self._block = (rows * camera.width + columns).ravel()
        self._further = [self._rays + shift for shift in shifts] if supersample else []
        self._bodies = BodyColours(self.stage, atlas, room, self._eye, camera.width)
        self._render_background()
        fine = max(0.004, 2.0 / float(K[0, 0]))
        self._lamp_map, self._sky_map = LightMap(fine, room.lamp), LightMap(2 * fine, room.sky)

    def _render_background(self) -> None:
        """Render the room without objects. Later images recompute only the light on the table."""
        geom, z, normal = self.stage.cast(self._eye, self._rays, (ROOM_GROUP,))
        points = self._eye + self._rays * z[:, None]
        self._room_depth = np.where(geom >= 0, z, np.nan).astype(np.float32)
        self._room_slant = self._slant(np.arange(len(z)), normal)
        self._room_normal = normal.astype(np.float32)
        self._room_albedo = self._room_colours(geom, points, normal)
        self._on_table = (geom == 0) & (normal[:, 2] > 0.5)
        self._room_light = self._unshadowed_light(points, normal)
        self._room_reflectance = self._room_albedo.mean(axis=1)
        self._table_xy = points[self._on_table, :2]

    def _slant(self, pixels: np.ndarray, normal: np.ndarray) -> np.ndarray:
        unit = self._unit[pixels]
        along = unit[:, 0] * normal[:, 0] + unit[:, 1] * normal[:, 1] + unit[:, 2] * normal[:, 2]
        return np.abs(along).astype(np.float32)

    def _room_colours(self, geom: np.ndarray, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Albedo (n, 3) of points of the room."""
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

    def _unshadowed_light(self, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Light (n, 3) on floor, wall and table rim, without shadows. Light from the lamp decreases with distance."""
        lamp = self.room.lamp.mean(axis=0)
        reach = np.linalg.norm(points - lamp, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            cosine = np.clip(((lamp - points) * normal).sum(axis=1) / reach, 0.15, 1)
        fall = np.clip(3.0 / np.maximum(reach, 1.0) ** 2, 0, 1)[:, None]
        light = 0.5 * self.room.sky_colour + self.room.ambient + self.room.lamp_colour * cosine[:, None] * fall
        return np.nan_to_num(light).astype(np.float32)

    def _table_light(self, xy: np.ndarray) -> np.ndarray:
        """Light (n, 3) at points (n, 2) of the table top."""
        room, lamp, sky = self.room, self._lamp_map.sample(xy), self._sky_map.sample(xy)
        return lamp[:, None] * room.lamp_colour + sky[:, None] * room.sky_colour + room.ambient

    def render(self) -> View:
        """Images of the world in its present state."""
        h, w = self.camera.height, self.camera.width
        self.stage.follow()
        self._lamp_map.update(self.stage)
        self._sky_map.update(self.stage)
        light = self._room_light.copy()
        light[self._on_table] = self._table_light(self._table_xy)
        colour = self._room_albedo * light

        geom, z, facing = self.stage.cast(self._eye, self._rays, SHADOW_GROUPS)
        with np.errstate(invalid="ignore"):
            geom[z > self._room_depth] = -1
        hit = np.flatnonzero(geom >= 0)
        depth, slant, normal = self._room_depth.copy(), self._room_slant.copy(), self._room_normal.copy()
        instance = np.zeros(h * w, np.uint8)
        instance[hit] = self.stage.world.geom_object[geom[hit]]
        depth[hit], normal[hit] = z[hit], facing[hit]
        slant[hit] = self._slant(hit, facing[hit])
        points = self._eye + self._rays[hit] * z[hit, None]
        reflectance, shine = self._room_reflectance.copy(), np.zeros(h * w, np.float32)
        colour[hit], reflectance[hit], shine[hit] = self._bodies.at(geom[hit], points, facing[hit], self._block[hit])
        if self._further:
            edge = _edge_pixels(instance.reshape(h, w), normal.reshape(h, w, 3))
            total = np.zeros((len(edge), 3), np.float32)
            for rays in self._further:
                total += self._colours(rays[edge], self._block[edge])
            colour[edge] = (colour[edge] + total) / np.float32(1 + len(self._further))
        images = (image.reshape(h, w) for image in (depth, instance, slant, reflectance, shine))
        return View(colour.reshape(h, w, 3), *images)

    def _colours(self, rays: np.ndarray, block: np.ndarray) -> np.ndarray:
        """Colours (k, 3) of the surfaces that rays (k, 3) of pixels in blocks (k,) hit."""
        geom, z, normal = self.stage.cast(self._eye, rays, (ROOM_GROUP, OBJECT_GROUP, FINGER_GROUP, MESH_GROUP))
        points = self._eye + rays * z[:, None]
        result = np.empty((len(rays), 3), np.float32)
        body = (geom >= 0) & (self.stage.world.geom_object[geom] > 0)
        result[body] = self._bodies.at(geom[body], points[body], normal[body], block[body])[0]
        geom, points, normal = geom[~body], points[~body], normal[~body]
        albedo, light = self._room_colours(geom, points, normal), self._unshadowed_light(points, normal)
        table = (geom == 0) & (normal[:, 2] > 0.5)
        light[table] = self._table_light(points[table, :2])
        result[~body] = albedo * light
        return result


def _edge_pixels(ids: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Indices (k,) of pixels at borders of the instance image `ids`, or at sharp changes of `normal` (H, W, 3)."""
    edge = np.zeros(ids.shape, bool)
    x, y, z = (np.ascontiguousarray(normal[..., i]) for i in range(3))
    for here, there in NEIGHBOURS:
        cosine = x[here] * x[there] + y[here] * y[there] + z[here] * z[there]
        step = (ids[here] != ids[there]) | (cosine < 0.7) & (ids[here] > 0)
        edge[here] |= step
        edge[there] |= step
    return np.flatnonzero(edge)

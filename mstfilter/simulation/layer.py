"""One ray through every pixel, with all that is known about what it meets; asked again only where needed.

A ray's answer holds until a body moves that the ray meets before or after; the light at the point it meets
holds, light by light, until a body moves between. Both are decided by bounds that err on one side only, so a
picture is the same as if everything were cast anew.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mstfilter.simulation.bounds import Bounds
from mstfilter.simulation.light import LIFT, shine
from mstfilter.simulation.room import Room
from mstfilter.simulation.shapes import Shape
from mstfilter.simulation.stage import Stage
from mstfilter.simulation.textures import Atlas, locate
from mstfilter.simulation.world import FINGER_ID

__all__ = ["Layer"]

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

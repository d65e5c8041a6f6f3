"""Light that reaches surfaces from a few points of lamp and ceiling, and what stands in its way.

A shadow changes only where a body moved: every point keeps, for each light, what it got from it, and asks
again only if a body that moved can lie between. Light on the table is held in maps in table coordinates, so
that a shadow costs rays of the map's resolution, not the image's.
"""

from __future__ import annotations

import numpy as np

from mstfilter.simulation.bounds import Bounds
from mstfilter.simulation.stage import Stage
from mstfilter.simulation.world import FINGER_GROUP, OBJECT_GROUP

__all__ = ["CASTERS", "LIFT", "LightMap", "shine"]

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

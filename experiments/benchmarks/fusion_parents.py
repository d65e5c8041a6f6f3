"""Parents for the benchmark of fusion: samples and predictions of a cluttered table of boxes and cylinders.

>>> proposed, predicted = parents(np.random.default_rng(0), 5, 5)    # hypotheses of 20 objects, 100 x 100 x 50 voxels

Both describe the same table and differ as in a run: borders are shifted (those of a sample by a voxel, from
completion; those of a prediction by up to two, from tracking, with a rough surface), and some objects are split or
joined with a neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.scene import Hypothesis, VoxelGrid

GRID = VoxelGrid((-0.5, -0.5, 0.0), 0.01, (100, 100, 50))
N_OBJECTS, N_WRONG = 20, 3  # each parent joins N_WRONG pairs of objects and splits N_WRONG objects


@dataclass(frozen=True)
class Solid:
    """A box or an upright cylinder: centre and half extents in voxels, turned about the vertical."""

    round: bool
    centre: np.ndarray
    half: np.ndarray
    angle: float

    def mask(self, shift: np.ndarray, grow: float) -> np.ndarray:
        """(X, Y, Z) bool, moved by `shift` and grown by `grow` voxels to the sides."""
        x, y, z = (np.arange(n) + 0.5 for n in GRID.shape)
        x, y, z = x[:, None, None], y[None, :, None], z[None, None, :]
        cx, cy, cz = self.centre + shift
        c, s = np.cos(self.angle), np.sin(self.angle)
        u, v = c * (x - cx) + s * (y - cy), c * (y - cy) - s * (x - cx)
        a, b, h = self.half + np.array([grow, grow, 0.0])
        inside = (u / a) ** 2 + (v / b) ** 2 < 1 if self.round else (np.abs(u) < a) & (np.abs(v) < b)
        return inside & (np.abs(z - cz) < h)


def table(rng: np.random.Generator) -> list[Solid]:
    """Objects of 6 to 16 cm on 70 x 70 cm of table, each placed on top of the earlier ones."""
    top, solids = np.zeros(GRID.shape[:2]), []
    for _ in range(N_OBJECTS):
        half = np.array([*rng.uniform(3, 8, 2), rng.uniform(2.5, 6)])
        is_round = bool(rng.random() < 0.4)
        if is_round:
            half[1] = half[0]
        places = rng.uniform(15, 85, (12, 2))  # the lowest of 12 random positions is used
        angle, found = rng.uniform(0, np.pi), []
        for place in places:
            flat = Solid(is_round, np.array([*place, 0.5]), np.array([*half[:2], 1.0]), angle).mask(np.zeros(3), 0.0)
            found.append((float(top[flat[:, :, 0]].max()), place, flat[:, :, 0]))
        height, place, below = min(found, key=lambda f: f[0])
        height = min(height, GRID.shape[2] - 2 * half[2])
        solids.append(Solid(is_round, np.array([*place, height + half[2]]), half, angle))
        top[below] = height + 2 * half[2]
    return solids


def table_labels(solids: list[Solid]) -> np.ndarray:
    """(X, Y, Z) uint16: true labels."""
    labels = np.zeros(GRID.shape, np.uint16)
    for k, solid in enumerate(solids, start=1):
        labels[solid.mask(np.zeros(3), 0.0)] = k
    return labels


def _seen(rng: np.random.Generator, solids: list[Solid], shift: float, grow: float, rough: float) -> np.ndarray:
    labels = np.zeros(GRID.shape, np.uint16)
    for k, solid in enumerate(solids, start=1):
        mask = solid.mask(rng.uniform(-shift, shift, 3) * [1, 1, 0.5], rng.uniform(-grow, grow))
        labels[mask & (rng.random(GRID.shape) >= rough * _surface(mask))] = k
    names = rng.permutation(N_OBJECTS) + 1
    for k in names[:N_WRONG].tolist():  # joined with the nearest
        away = [np.linalg.norm(s.centre - solids[k - 1].centre) for s in solids]
        labels[labels == k] = int(np.argsort(away)[1]) + 1
    for new, k in enumerate(names[N_WRONG : 2 * N_WRONG].tolist(), start=N_OBJECTS + 1):
        solid, turn = solids[k - 1], rng.uniform(0, np.pi)
        x, y = (np.arange(n) + 0.5 for n in GRID.shape[:2])
        side = np.cos(turn) * (x - solid.centre[0])[:, None] + np.sin(turn) * (y - solid.centre[1])[None, :] > 0
        labels[(labels == k) & side[:, :, None]] = new
    return labels


def _surface(mask: np.ndarray) -> np.ndarray:
    inner = mask.copy()
    for axis in range(3):
        inner &= np.roll(mask, 1, axis) & np.roll(mask, -1, axis)
    return mask & ~inner


def parents(
    rng: np.random.Generator, n_proposed: int, n_predicted: int
) -> tuple[tuple[Hypothesis, ...], tuple[Hypothesis, ...]]:
    """Proposed and predicted hypotheses of one table."""
    solids = table(rng)
    proposed = tuple(Hypothesis.from_labels(_seen(rng, solids, 1.0, 0.7, 0.0), GRID, 1) for _ in range(n_proposed))
    predicted = tuple(Hypothesis.from_labels(_seen(rng, solids, 2.0, 0.3, 0.1), GRID) for _ in range(n_predicted))
    return proposed, predicted

"""Move the objects of a hypothesis by rigid motions.

``method="pull"``: every voxel x of the transformed bounding box reads the object's source at T^-1 x. The source is
the occupancy of the object when it was last changed by anything but a motion, and T the product of all motions since.
The shape therefore does not degrade with the number of motions.

``method="smooth"`` interpolates a smoothed signed distance of the source, which determines the surface better than
to half a voxel, and keeps the number of voxels. On 481 true motions of simulated objects of 50-3000 voxels the moved
true voxels have a mean Jaccard index of .877 with the true voxels after the motion; with "pull" .829.

``method="splat"``, as in the authors' program, moves voxel centres forward and rounds. It loses 3-14 % of the voxels
per step.

>>> moved = Warp().move(hypothesis, {3: T})     # doctest: +SKIP
>>> moved.hypothesis                            # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from mstfilter.errors import InputError
from mstfilter.scene import Crop, Hypothesis, ObjectRecord, VoxelGrid
from mstfilter.tracking.rigid import invert, move_points

__all__ = ["Moved", "Warp"]

_SMOOTHING = 0.5  # voxels, standard deviation; .3 to .6 differ little


@dataclass(frozen=True)
class Moved:
    """A moved hypothesis and what happened to its voxels.

    Attributes
    ----------
    hypothesis : Hypothesis
    voxels_left : number of voxels that left the grid.
    contested : number of voxels that more than one object claimed.
    dropped : ids of objects that have no voxel left.
    """

    hypothesis: Hypothesis
    voxels_left: int = 0
    contested: int = 0
    dropped: tuple[int, ...] = ()


@dataclass(eq=False)
class _Claims:
    """Voxels that objects claim: for each object its record, flat indices (N,) and depths inside it (N,)."""

    index: list[NDArray[np.int64]] = field(default_factory=list)
    depth: list[NDArray[np.float64]] = field(default_factory=list)
    record: list[ObjectRecord] = field(default_factory=list)

    def add(self, record: ObjectRecord, index: NDArray[np.int64], depth: NDArray[np.float64]) -> None:
        self.index.append(index)
        self.depth.append(depth)
        self.record.append(record)


@dataclass(frozen=True)
class Warp:
    """Moves the voxels of objects by rigid motions.

    Parameters
    ----------
    method : "pull", "smooth" or "splat"
        Read the nearest voxel of the source at T^-1 x, or its smoothed signed distance there, or move voxel centres
        forward.
    collisions : "deepest" or "label"
        Rule for voxels that several objects claim: the object in which the voxel is deepest (ties: the smaller
        residual), or the higher label (the authors' program).
    """

    method: str = "pull"
    collisions: str = "deepest"

    def __post_init__(self) -> None:
        if self.method not in ("pull", "smooth", "splat"):
            raise InputError(f"warp method {self.method!r} is unknown", "one of pull, smooth, splat")
        if self.collisions not in ("deepest", "label"):
            raise InputError(f"collision rule {self.collisions!r} is unknown", "one of deepest, label")

    def move(
        self,
        hypothesis: Hypothesis,
        motions: Mapping[int, RigidTransform],
        residuals: Mapping[int, float] | None = None,
    ) -> Moved:
        """Move objects.

        Parameters
        ----------
        hypothesis : Hypothesis
        motions : label -> RigidTransform, world metres. Objects without a motion stay.
        residuals : label -> residual of the motion, for ties.

        Returns
        -------
        Moved
            Contains the same hypothesis object if all motions are the identity.
        """
        matrices = {k: T.as_matrix() for k, T in motions.items()}
        moving = {k: T for k, T in matrices.items() if not np.array_equal(T, np.eye(4))}
        if not moving:
            return Moved(hypothesis)
        grid = hypothesis.grid
        residuals = residuals or {}
        labels = hypothesis.labels.copy()
        labels[np.isin(labels, list(moving))] = 0
        claims, records, left = _Claims(), {}, 0
        for record in hypothesis.objects:
            if record.label not in moving:
                records[record.label] = record
                continue
            index, depth, moved = self._claim(record, hypothesis, moving[record.label])
            inside = grid.contains(index)
            left += int((~inside).sum())
            flat = np.ravel_multi_index(tuple(index[inside].T), grid.shape)
            claims.add(record, flat.astype(np.int64), depth[inside])
            records[record.label] = moved
        disturbed = self._standing_claims(hypothesis, labels, claims)
        contested = self._paint(labels, claims, residuals)
        for label in disturbed:
            record = records[label]
            if record.source is None and self.method != "splat":
                # Voxels lost in this collision are restored when the object moves.
                records[label] = replace(record, source=Crop.of(hypothesis.mask(label)))
        present = np.bincount(labels.ravel(), minlength=max(records) + 1) > 0
        kept = tuple(records[k] for k in sorted(records) if present[k])
        dropped = tuple(records[k].id for k in sorted(records) if not present[k])
        return Moved(Hypothesis(labels, grid, kept), left, contested, dropped)

    def _claim(
        self, record: ObjectRecord, hypothesis: Hypothesis, T: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], ObjectRecord]:
        """Voxels (N, 3) that a moved object claims, their depth inside it (N,) in voxels, and its new record."""
        grid = hypothesis.grid
        if self.method == "splat":
            crop = Crop.of(hypothesis.mask(record.label))
            index, depth = _push(crop, T, grid)
            return index, depth, replace(record, source=None, motion=RigidTransform.identity())
        crop = record.source or Crop.of(hypothesis.mask(record.label))
        total = T if record.source is None else T @ record.motion.as_matrix()
        index, depth = (_pull_smooth if self.method == "smooth" else _pull)(crop, total, grid)
        if not len(index):  # a thin object between two rows of voxel centres
            index, depth = _push(crop, total, grid)
        return index, depth, replace(record, source=crop, motion=RigidTransform.from_matrix(total))

    def _standing_claims(self, hypothesis: Hypothesis, labels: NDArray[np.uint16], claims: _Claims) -> list[int]:
        """Add the claims of resting objects on voxels that moved objects claim. Returns the labels of these."""
        wanted = np.unique(np.concatenate(claims.index))
        holder = labels.ravel()[wanted]
        disturbed = np.unique(holder[holder > 0]).tolist()
        for label in disturbed:
            crop = Crop.of(hypothesis.mask(label))
            flat = wanted[holder == label]
            local = np.stack(np.unravel_index(flat, hypothesis.grid.shape), axis=1) - crop.offset
            claims.add(hypothesis.record(label), flat, _depth_inside(crop)[tuple(local.T)])
        return disturbed

    def _paint(self, labels: NDArray[np.uint16], claims: _Claims, residuals: Mapping[int, float]) -> int:
        """Assign every claimed voxel to one object; returns the number of contested voxels."""
        index = np.concatenate(claims.index)
        if not len(index):
            return 0
        sizes = [len(i) for i in claims.index]
        owner = np.repeat([r.label for r in claims.record], sizes)
        if self.collisions == "label":
            order = np.lexsort((-owner, index))
        else:
            depth = np.round(np.concatenate(claims.depth), 3)
            residual = np.repeat([residuals.get(r.label, 0.0) for r in claims.record], sizes)
            identity = np.repeat([r.id for r in claims.record], sizes)
            order = np.lexsort((identity, residual, -depth, index))
        index, owner = index[order], owner[order]
        first = np.append(True, index[1:] != index[:-1])
        labels.ravel()[index[first]] = owner[first]
        return len(np.unique(index[~first]))


def _depth_inside(crop: Crop) -> NDArray[np.float64]:
    """Distance of each voxel of a crop to the nearest free voxel centre, in voxels. Free outside the crop."""
    from scipy.ndimage import distance_transform_edt

    return distance_transform_edt(np.pad(crop.occupied, 1))[1:-1, 1:-1, 1:-1]


def _pull(crop: Crop, T: NDArray[np.float64], grid: VoxelGrid) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Voxels (N, 3), also outside the grid, whose centre is in the source moved by T, and their depth inside."""
    from scipy.ndimage import map_coordinates

    shape = np.array(crop.occupied.shape)
    index, home = _moved_box(crop, T, grid)
    # The tolerance makes motions by whole voxels independent of rounding errors.
    cell = np.floor(home + 1e-9).astype(np.int64)
    inside: NDArray[np.bool_] = np.asarray(((cell >= 0) & (cell < shape)).all(axis=1))
    inside[inside] = crop.occupied[tuple(cell[inside].T)]
    index, home = index[inside], home[inside]
    depth = map_coordinates(np.pad(_depth_inside(crop), 1), home.T + 0.5, order=1, mode="constant")
    return index, depth


def _moved_box(
    crop: Crop, T: NDArray[np.float64], grid: VoxelGrid, margin: int = 0
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Voxels (N, 3) of the box around the moved source, and their centres in source coordinates (voxels)."""
    corners = np.array(np.meshgrid(*[(0, n) for n in crop.occupied.shape], indexing="ij")).reshape(3, -1).T
    moved = move_points(T, grid.origin + (corners + crop.offset) * grid.voxel_size)
    lower = np.floor((moved.min(axis=0) - grid.origin) / grid.voxel_size).astype(np.int64) - margin
    upper = np.ceil((moved.max(axis=0) - grid.origin) / grid.voxel_size).astype(np.int64) + margin
    axes = [np.arange(a, b) for a, b in zip(lower, upper, strict=True)]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    home = (move_points(invert(T), grid.centre_of(index)) - grid.origin) / grid.voxel_size - crop.offset
    return index, home


def _pull_smooth(
    crop: Crop, T: NDArray[np.float64], grid: VoxelGrid
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """As `_pull`, with the smoothed signed distance; keeps the deepest voxels, as many as the source has."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

    index, home = _moved_box(crop, T, grid, 1)
    step = home[0] - np.rint(home[0] - 0.5) - 0.5
    turned = np.abs(T[:3, :3] - np.rint(T[:3, :3])).max()
    if np.abs(step).max() < 1e-6 and turned < 1e-9:
        return _pull(crop, T, grid)  # the motion maps voxel centres to voxel centres
    occupied = np.pad(crop.occupied, 3)
    signed = np.where(
        occupied, distance_transform_edt(occupied) - 0.5, 0.5 - distance_transform_edt(~occupied)
    )  # voxels; 0 halfway between the last centre inside and the first one outside
    signed = gaussian_filter(signed, _SMOOTHING)
    value = map_coordinates(signed, home.T + 2.5, order=1, mode="nearest")
    # Rounding makes the order of symmetric voxels independent of the last digit.
    best = np.argsort(-np.round(value, 6), kind="stable")[: int(crop.occupied.sum())]
    return index[best], value[best] + 0.5


def _push(crop: Crop, T: NDArray[np.float64], grid: VoxelGrid) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Voxels (N, 3) that contain moved centres of the source, and the largest depth of these centres."""
    cell = np.argwhere(crop.occupied)
    depth = _depth_inside(crop)[tuple(cell.T)]
    index = grid.index_of(move_points(T, grid.centre_of(cell + crop.offset)))
    order = np.lexsort((-depth, *index.T))
    index, depth = index[order], depth[order]
    first = np.append(True, (index[1:] != index[:-1]).any(axis=1)) if len(index) else np.zeros(0, bool)
    return index[first], depth[first]

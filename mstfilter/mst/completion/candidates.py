"""Where the bounding box of an object can be, given what was seen of it.

>>> evidence = ShapeEvidence.of(seen)
>>> groups = shape_groups(evidence, kinds)                    # each kind in each frame that it can have
>>> boxes = groups.boxes(group, u)                         # group (n,), u (d, n) standard normal: n candidates

`mstfilter.mst.completion.posterior` says what frames and candidates are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, label
from scipy.special import ndtr

from mstfilter.mst.completion.kinds import ShapeKind
from mstfilter.mst.completion.observed import ObservedBox

_OWN, _FREE, _OTHER = 96, 112, 24  # at most so many points of the object, of free space, and of other surfaces
_OUTER = 0.8  # voxels behind the measured surface, of voxels that stand for it
_LEAST_PART = 0.12  # of the visible surface, of parts that are not connected to the others
_BESIDE = 2  # voxels around the object and its shadow, in which space is asked whether it is free
_POSE, _ENDS = 3, 6  # numbers for the pose and the ends of a box
_TIGHT = 0.003  # metres, standard deviation of the end of a box about the end of the readings
_OPEN = 0.3  # an open end grows where u exceeds minus this number
_TYPICAL = 0.08  # metres, extent of an object of which little is seen
_SHRINK = 0.3  # of the extent, of a box without a handle that sticks out of it
_HIGH = 0.025  # metres above the table: an object seen only above may stand on something
_UP, _LYING, _LEANING = 0.7, 0.25, 0.05  # how objects stand
# Standard deviations of small turns about the axes, for frames that stand and others.
_TURN_UPRIGHT, _TURN = np.deg2rad([[1.5], [1.5], [4.0]]).astype(np.float32), np.float32(np.deg2rad(5.0))
_FEW = 8  # readings, with which no object is seen to lean
_ALIKE = np.deg2rad(7.0)  # frames that differ by less are one


class ShapeEvidence(NamedTuple):
    """What is known of an object, as points in metres in the box: x, y from its corner, z above the table."""

    voxel: float  #: edge of a voxel
    own: np.ndarray  #: (m, 3) of the object's surface
    normal: np.ndarray  #: (m, 3) outwards
    free: np.ndarray  #: (k, 3) centres of free voxels near the object
    other: np.ndarray  #: (j, 3) centres of voxels of other surfaces
    below: (
        np.ndarray
    )  #: (i, 3) centres of voxels of other surfaces that are below readings of the foot, and near them
    contact: float  #: share of the readings of the foot that have another surface below
    n_surface: int  #: voxels of the surface, of which `own` is a sample
    weight_free: float  #: voxels for which a point of `free` stands
    weight_other: float
    to_camera: np.ndarray  #: (3,) unit vector
    layer: np.ndarray  #: (n, 3) voxels of the visible surface
    depth: np.ndarray  #: (n,) their distance behind the measured surface, voxels
    main: np.ndarray  #: (n,) bool, without what a displaced border of the mask shows of other things
    free_voxels: np.ndarray  #: (a, b, c) bool
    size: float  #: typical extent in metres: the mean of the two largest visible ones

    @classmethod
    def of(cls, seen: ObservedBox) -> ShapeEvidence:
        """Raises IndexError if there is no visible surface."""
        rng = np.random.default_rng(0)
        voxel = seen.voxel_size
        layer = np.argwhere(seen.surface)
        depth, inwards = _depths(seen.signed, layer)
        main = _main_part(seen)[tuple(layer.T)]
        outer = np.flatnonzero(main & (depth < _OUTER))
        outer = outer if len(outer) >= _FEW else np.arange(len(layer))
        chosen = outer[_some(rng, np.arange(len(outer)), _OWN)]
        normal = -inwards[chosen]
        own = in_metres(layer[chosen], seen, voxel) + voxel * depth[chosen, None] * normal
        behind = np.argwhere(seen.behind)
        shadow = in_metres(behind, seen, voxel).mean(axis=0) if len(behind) else own.mean(axis=0)
        towards = own.mean(axis=0) - shadow + 1e-3 * normal.mean(axis=0) + (0, 0, 1e-6)
        reach = max(0.03, 0.6 * float(np.ptp(own, axis=0).max()))
        near = _within(seen, voxel, own.min(axis=0) - reach, own.max(axis=0) + reach)
        beside = binary_dilation(seen.surface | seen.behind, np.ones((3, 3, 3)), _BESIDE)
        free, other = np.argwhere(near & beside & seen.free), np.argwhere(near & beside & seen.other_surface)
        some_free, some_other = _some(rng, free, _FREE), _some(rng, other, _OTHER)
        return cls(
            voxel,
            own.astype(np.float32),
            normal.astype(np.float32),
            in_metres(some_free, seen, voxel),
            in_metres(some_other, seen, voxel),
            *_below(own, in_metres(np.argwhere(seen.other_surface & near), seen, voxel), voxel),
            len(outer),
            len(free) / max(len(some_free), 1),
            len(other) / max(len(some_other), 1),
            towards / np.linalg.norm(towards),
            layer,
            depth,
            main,
            seen.free,
            float(np.sort(np.ptp(own, axis=0))[1:].mean()),
        )

    def openness(self, axis: np.ndarray, end: float) -> float:
        """Share of the places beyond the end of the readings along `axis` (3,), at `end` metres, not seen free.

        Each place is a voxel beyond the end, in line with a reading: a bottle ends at its neck, but not its body.
        """
        beyond = self.own + (end + 1.3 * self.voxel - self.own @ axis)[:, None] * axis
        index = np.floor(beyond / self.voxel).astype(int)
        inside = ((index >= 0) & (index < self.free_voxels.shape)).all(axis=1)
        open_ = index[:, 2] >= 0
        open_[inside] &= ~self.free_voxels[tuple(index[inside].T)]
        return float(open_.mean())


def in_metres(index: np.ndarray, seen: ObservedBox, voxel: float) -> np.ndarray:
    """Centres (n, 3) float32 of voxels (n, 3)."""
    return ((index + 0.5) * voxel + (0, 0, seen.height[0] - 0.5 * voxel)).astype(np.float32)


def _some(rng: np.random.Generator, rows: np.ndarray, most: int) -> np.ndarray:
    return rows if len(rows) <= most else rows[rng.permutation(len(rows))[:most]]


def _depths(signed: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) in voxels of voxels (n, 3) from the measured surface, and unit vectors (n, 3) into the object.

    They follow from the gradient of the distance along the optical axis. Of the differences to the two neighbours
    along an axis, the smaller one counts, because the other one may cross a step in depth.
    """
    here = signed[tuple(index.T)]
    slope = np.zeros(index.shape)
    for axis in range(3):
        least = np.full(len(index), np.inf)
        for sign in (-1, 1):
            there = index.copy()
            there[:, axis] = np.clip(there[:, axis] + sign, 0, signed.shape[axis] - 1)
            change = sign * (signed[tuple(there.T)] - here)
            nearer = (there[:, axis] != index[:, axis]) & (np.abs(change) < np.abs(least))
            least[nearer] = change[nearer]
        slope[:, axis] = np.where(np.isfinite(least), least, 0)
    steep = np.maximum(np.linalg.norm(slope, axis=1), 1.0)  # along the ray, a voxel a voxel
    return np.nan_to_num(here) / steep, slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-6)


def _within(seen: ObservedBox, voxel: float, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Voxels (a, b, c) bool between two corners in metres."""
    base = np.array([0, 0, seen.height[0] - 0.5 * voxel])
    first, last = (np.clip(np.floor((at - base) / voxel).astype(int), 0, seen.free.shape) for at in (low, high))
    found = np.zeros(seen.free.shape, bool)
    found[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))] = True
    return found


class Groups(NamedTuple):
    """Kinds in frames: one row for each group of candidates that have both in common."""

    kind: np.ndarray  #: (g,) index of the kind
    prior: np.ndarray  #: (g,) prior weights; they add up to 1
    axes: np.ndarray  #: (g, 3, 3), columns are the axes of the box in the world
    support: np.ndarray  #: (g,) metres, height on which the object rests
    upright: np.ndarray  #: (g,) bool, whether the third axis is vertical
    round: np.ndarray  #: (g,) bool, whether cross-sections are circles
    ends: np.ndarray  #: (g, 2, 3) lowest and highest reading along each axis, metres
    growth: np.ndarray  #: (g, 2, 3) metres by which an end can grow: 0 where free space follows
    facing: np.ndarray  #: (g, 3) 1 where the axis points to the camera, else -1

    def boxes(self, group: np.ndarray, u: np.ndarray) -> Boxes:
        """The boxes of standard normal numbers u (9 + k, n) float32 in groups (n,); the last k are the shape."""
        axes, ends = self.axes[group].transpose(1, 2, 0), self.ends[group].transpose(1, 2, 0)
        growth, support, upright = self.growth[group].transpose(1, 2, 0), self.support[group], self.upright[group]
        ends_u = u[:_ENDS].reshape(2, 3, -1)
        out = _TIGHT * ends_u + growth * np.maximum(ends_u + _OPEN, 0)
        out -= _SHRINK * (ends[1] - ends[0]) * np.maximum(-ends_u - 1.2, 0)
        low, high = ends[0] - out[0], ends[1] + out[1]
        low[2] = np.where(upright, support + 0.5 * _TIGHT * ends_u[0, 2], low[2])
        high[2] = np.where(upright, np.maximum(high[2], low[2] + 0.004), high[2])
        half, centre = np.maximum((high - low) / 2, 0.0015), (low + high) / 2
        # The camera sees the near side of a round shape, and both ends of the axis across.
        of_circle = self.round[group]
        half[1] = np.where(of_circle, half[0], half[1])
        near = np.where(self.facing[group, 1] > 0, high[1] - half[1], low[1] + half[1])
        centre[1] = np.where(of_circle, near, centre[1])
        a, b, c = np.where(upright, _TURN_UPRIGHT, _TURN) * u[_ENDS : _ENDS + _POSE]
        turned = np.stack([axes[:, 0] + c * axes[:, 1] - b * axes[:, 2],
                           axes[:, 1] - c * axes[:, 0] + a * axes[:, 2],
                           axes[:, 2] + b * axes[:, 0] - a * axes[:, 1]], axis=1)  # fmt: skip
        return Boxes(np.einsum("ijn,jn->in", axes, centre), turned, half, ndtr(u[_ENDS + _POSE :]))


class Boxes(NamedTuple):
    """Bounding boxes with the shapes that fill them."""

    centre: np.ndarray  #: (3, n) metres
    axes: np.ndarray  #: (3, 3, n), columns are the axes of each box
    half: np.ndarray  #: (3, n) metres
    shape: np.ndarray  #: (k, n), 0 .. 1

    def take(self, index: np.ndarray | slice) -> Boxes:
        return Boxes(*(column[..., index] for column in self))

    def lowest(self, is_round: np.ndarray) -> np.ndarray:
        """Height (n,) of the lowest point of the boxes, or of the cylinders in them, metres."""
        reach = np.abs(self.axes[2]) * self.half
        across = np.where(is_round, np.hypot(self.axes[2, 0], self.axes[2, 1]) * self.half[0], reach[0] + reach[1])
        return np.asarray(self.centre[2] - across - reach[2])

    def local(self, points: np.ndarray) -> np.ndarray:
        """Points (m, 3) in the axes of each box, (3, m, n)."""
        offset = np.einsum("in,ijn->jn", self.centre, self.axes)
        found = np.empty((3, len(points), offset.shape[1]), np.float32)
        for j in range(3):
            np.matmul(points, self.axes[:, j], out=found[j])
            found[j] -= offset[j]
        return found


def shape_groups(evidence: ShapeEvidence, kinds: Sequence[ShapeKind]) -> Groups:
    """Each kind in each frame that it can have."""
    upright, leaning = _frames(evidence)
    vertical = np.array([0.0, 0.0, 1.0])
    lying = [frame[:, axis] for frame in upright for axis in (0, 1)]
    leant = [frame[:, axis] for frame in leaning for axis in range(3)]
    stands = (([vertical], _UP), (lying, _LYING), (leant, _LEANING))
    circular = [(_about(evidence, axis), share / len(axes)) for axes, share in stands for axis in axes]
    standing = [(frame, 1 / len(upright)) for frame in upright]
    others = standing + [(frame, _LEANING / len(leaning)) for frame in leaning]
    supports, rows = _supports(evidence), []
    for k, kind in enumerate(kinds):
        for axes, share in circular if kind.round else others:
            stands_up = bool(axes[2, 2] > 0.999)
            weight = kind.share * share * (1.0 if stands_up else kind.lies)
            if weight:
                rows += [(k, weight * s, axes, support, stands_up, kind.round) for support, s in supports]
    kind_of, prior, axes, support, standing_up, is_round = (np.array(column) for column in zip(*rows, strict=True))
    ends = {id(axes): _ends(evidence, axes) for axes, _ in (*circular, *others)}
    found = [ends[id(row[2])] for row in rows]
    place, growth = (np.array(column, np.float32) for column in zip(*found, strict=True))
    facing = np.where(axes.transpose(0, 2, 1) @ evidence.to_camera > 0, 1, -1)
    axes, support = axes.astype(np.float32), support.astype(np.float32)
    return Groups(kind_of, prior / prior.sum(), axes, support, standing_up, is_round, place, growth, facing)


def _ends(evidence: ShapeEvidence, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends (2, 3) of the readings along the axes of a frame, and how far each end can grow (2, 3), in metres."""
    along = evidence.own @ axes
    ends = np.sort(along, axis=0)[[len(along) // 100, -1 - len(along) // 100]]
    extent = ends[1] - ends[0]
    growth = np.array(
        [
            [evidence.openness(sign * a, sign * e) for a, e in zip(axes.T, side, strict=True)]
            for sign, side in ((-1, ends[0]), (1, ends[1]))
        ]
    )
    typical = max(evidence.size, _TYPICAL)
    return ends, growth * np.maximum(typical - extent, 0.4 * typical)


def _frames(evidence: ShapeEvidence) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Axes (3, 3) of boxes that stand on a horizontal side, and of boxes that lean."""
    normal, own = evidence.normal, evidence.own
    angles = [_least_rectangle(own[:, :2])]
    level = np.abs(normal[:, 2]) < 0.6
    if level.sum() >= 6:
        turned = np.exp(4j * np.arctan2(normal[level, 1], normal[level, 0]))
        angles.insert(0, float(np.angle(turned.mean()) / 4))
    apart = len(angles) > 1 and abs((angles[1] - angles[0] + np.pi / 4) % (np.pi / 2) - np.pi / 4) > _ALIKE
    upright = [_about_z(angle) for angle in angles[: 2 if apart else 1]]
    if len(own) < _FEW:
        return upright, []
    leaning = []
    like = normal @ normal.T > np.cos(np.deg2rad(20))
    main = normal[like[like.sum(axis=1).argmax()]].mean(axis=0)
    main /= max(float(np.linalg.norm(main)), 1e-6)
    if like.sum(axis=1).max() > 0.2 * len(own) and 0.26 < abs(main[2]) < 0.97:
        leaning.append(_leaning(own, main))
    spread, principal = np.linalg.eigh(np.cov(own.T))
    long = principal[:, 2]
    if spread[2] > 6 * spread[1] and 0.15 < abs(long[2]) < 0.97:
        across = np.cross((0, 0, 1), long)
        across /= np.linalg.norm(across)
        leaning.append(np.stack([long, across, np.cross(long, across)], axis=1))
    return upright, leaning


def _least_rectangle(flat: np.ndarray) -> float:
    """Angle in radians of the rectangle of least area around points (m, 2)."""
    angles = np.deg2rad(np.arange(0, 90, 3))
    extents = [np.ptp(flat @ np.stack([f(angles) * s, g(angles)]), axis=0) for f, g, s in _TURNS]
    return float(angles[(extents[0] * extents[1]).argmin()])


_TURNS = ((np.cos, np.sin, 1), (np.sin, np.cos, -1))  # of the first and the second axis


def _about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _leaning(own: np.ndarray, main: np.ndarray) -> np.ndarray:
    """Axes (3, 3) whose third one is a normal (3,), turned so that the box around the points is small."""
    x = np.cross((0, 0, 1), main)
    x /= np.linalg.norm(x)
    y = np.cross(main, x)
    angle = _least_rectangle(np.stack([own @ x, own @ y], axis=1))
    return np.stack([np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x, main], axis=1)


def _about(evidence: ShapeEvidence, axis: np.ndarray) -> np.ndarray:
    """Axes (3, 3) whose third one is `axis` (3,) and whose first one is across the line of sight."""
    x = np.cross(axis, evidence.to_camera)
    if np.linalg.norm(x) < 0.05:
        x = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def _supports(evidence: ShapeEvidence) -> list[tuple[float, float]]:
    """Heights on which the object may rest, with prior weights: the table, a surface below it, its lowest reading."""
    lowest = float(np.percentile(evidence.own[:, 2], 2))
    if lowest < _HIGH:
        return [(0.0, 1.0)]
    if not len(evidence.below):
        return [(0.0, 0.8), (lowest, 0.2)]
    on = 0.05 + 0.85 * evidence.contact
    top = float(np.percentile(evidence.below[:, 2], 80)) + 0.2 * evidence.voxel
    return [(0.0, 0.95 - on), (top, on), (lowest, 0.05)]


def _below(own: np.ndarray, other: np.ndarray, voxel: float) -> tuple[np.ndarray, float]:
    """Fields `below` and `contact` of the evidence.

    An object that something in front of it hides down there has no such surface nearby: it lies nearer to the camera.
    """
    foot = own[own[:, 2] < np.percentile(own[:, 2], 2) + 2 * voxel]
    if not len(other):
        return np.zeros((0, 3)), 0.0
    offset = foot[:, None] - other
    near = ((offset**2).sum(axis=2) < (2.5 * voxel) ** 2) & (offset[..., 2] > 0)
    return other[near.any(axis=0)], float(near.any(axis=1).mean())


def _main_part(seen: ObservedBox) -> np.ndarray:
    """The visible surface (a, b, c) bool without what a displaced border of the mask shows of other things.

    Those are small parts that are not connected to the others, and the foot of whatever the object stands on.
    """
    part, n = label(seen.surface, np.ones((3, 3, 3)))
    size = np.bincount(part.ravel(), minlength=n + 1)
    size[0] = 0
    kept = (size >= min(_LEAST_PART * size.sum(), size.max()))[part]  # of many equal parts, all are kept
    top = seen.height[np.flatnonzero(kept.any(axis=(0, 1)))[-1]]
    voxel = seen.voxel_size
    above = kept & (seen.height > voxel)
    return above if top > 4 * voxel and above.any() else kept
